"""Long runs of the symmetric methods: `SymmetricProjection` and `RATTLE`.

    python benchmarks/studies/symmetric.py                 # one row for each promise, half an hour
    python benchmarks/studies/symmetric.py --only chain    # the parts whose names hold this text
    python benchmarks/studies/symmetric.py --smoke         # toy sizes

- `kepler`: an orbit with e = 0.6 in 200 steps a period, by the projected implicit midpoint rule:
  the integrals after 1,000 periods, there and back, and the phase after 10,000 periods over that of
  projected RK4 with as many evaluations of the field.
- `chain`: 20 beads on rods, 10^6 steps, and the time of a step over that of velocity Verlet without
  rods, with gravity alone and with a repulsion of all pairs.
- `molecules`: 100 rigid molecules in a trap and a wave, as lanes of a batch.

A row says what was measured, the number, and what it should be at most. Residuals are in units of
roundoff of the terms that are added. The slope of the energy is that of a line through the means of
20 blocks, over its standard error. Times are those of the processor, the least of three rounds in
which both solvers take turns.
"""

import argparse
import os
import time

if __name__ == "__main__":
    # What the documentation recommends for single trajectories.
    flag = "xla_cpu_small_while_loop_byte_threshold=65536"
    os.environ.setdefault("XLA_FLAGS", f"--xla_backend_extra_options={flag}")

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_conserve as dfc

jax.config.update("jax_enable_x64", True)

SMOKE = False
EPS = np.finfo(float).eps


def few(many, toy):
    return toy if SMOKE else many


def final(sol):
    return jax.tree.map(lambda y: y[-1], sol.ys)


@eqx.filter_jit
def solve(terms, solver, y0, t0, t1, h, saveat=None):
    return dfx.diffeqsolve(
        terms, solver, t0, t1, h, y0, max_steps=None, adjoint=dfx.ForwardMode(),
        saveat=dfx.SaveAt(t1=True, solver_state=True) if saveat is None else saveat,
    )  # fmt: skip


# ---- An orbit ----

ECCENTRICITY, STEPS, PERIOD = 0.6, 200, 2 * np.pi
START = jnp.array([1 - ECCENTRICITY, 0.0]), jnp.array([0.0, 2.0])


def attraction(t, y, args):
    q, v = y
    return v, -q / jnp.sum(q**2) ** 1.5


def energy(y):
    return jnp.sum(y[1] ** 2) / 2 - 1 / jnp.sqrt(jnp.sum(y[0] ** 2))


def momentum(y):
    return y[0][0] * y[1][1] - y[0][1] * y[1][0]


INTEGRALS = {
    "energy": dfc.FirstIntegral(lambda t, y, args: energy(y)),
    "momentum": dfc.FirstIntegral(lambda t, y, args: momentum(y)),
}


def longitudes(q, v):
    """The angle of the perihelion plus the mean anomaly: the phase of the orbit."""
    q, v = (np.asarray(x).astype(np.longdouble) for x in (q, v))
    r, l = np.hypot(*q.T), q[:, 0] * v[:, 1] - q[:, 1] * v[:, 0]
    axis = np.stack([v[:, 1] * l, -v[:, 0] * l], axis=1) - q / r[:, None]
    e = np.hypot(*axis.T)
    a = 1 / (2 / r - np.sum(v**2, axis=1))
    anomaly = np.arctan2(np.sum(q * v, axis=1) / np.sqrt(a), 1 - r / a)
    mean = anomaly - np.sum(q * v, axis=1) / np.sqrt(a)
    return np.unwrap((np.arctan2(axis[:, 1], axis[:, 0]) + mean).astype(float)), e


def evaluations(solver):
    """Of the field in a step, its Jacobian at the start counted as one."""
    count = [0]

    def counted(t, y, args):
        jax.debug.callback(lambda: count.__setitem__(0, count[0] + 1))
        return attraction(t, y, args)

    jax.block_until_ready(
        solve(dfx.ODETerm(counted), solver, START, 0.0, PERIOD, PERIOD / STEPS).ys
    )
    jax.effects_barrier()
    return count[0] / STEPS


def kepler():
    term, h, periods = dfx.ODETerm(attraction), PERIOD / STEPS, few(1000, 5)
    solver = dfc.SymmetricProjection(dfc.ImplicitMidpoint(), INTEGRALS)
    there = solve(term, solver, START, 0.0, periods * PERIOD, h)
    found = dfc.statistics(there)
    yield "kepler: largest residual over the terms, in roundoff", found.residual_after / EPS, 16
    back = solve(term, solver, final(there), periods * PERIOD, 0.0, -h)
    off = max(float(jnp.max(jnp.abs(a - b))) for a, b in zip(final(back), START, strict=True))
    yield f"kepler: there and back, {periods} periods", off, 1e-10
    yield "kepler: iterations a step", found.num_iterations / found.num_projections, 4
    cost, periods = evaluations(solver), few(10_000, 5)
    rk4 = dfc.ManifoldProjection(dfc.RK4(), INTEGRALS)
    ts = PERIOD * jnp.arange(1, periods + 1)
    phases = []
    for name, method, step in (("symmetric", solver, h), ("RK4", rk4, 4 * h / cost)):
        saveat = dfx.SaveAt(ts=ts)
        phase, e = longitudes(*solve(term, method, START, 0.0, ts[-1], step, saveat).ys)
        phases.append(np.abs(phase[-1]))
        print(f"  {name}: {PERIOD / step:.0f} steps a period, phase {phases[-1]:.2e} after "
              f"{periods} periods, half of that {np.abs(phase[periods // 2 - 1]):.2e}, "
              f"e off by {abs(e[-1] - ECCENTRICITY):.0e}", flush=True)  # fmt: skip
    yield (
        f"kepler: phase over that of RK4 at {cost:.1f} evaluations a step",
        phases[0] / phases[1],
        0.1,
    )


# ---- Constraints ----


class Verlet(dfx.AbstractSolver):
    """Velocity Verlet, without constraints."""

    term_structure = (dfx.AbstractTerm, dfx.AbstractTerm)
    interpolation_cls = dfx.LocalLinearInterpolation

    def order(self, terms):
        return 2

    def init(self, terms, t0, t1, y0, args):
        return terms[1].vf(t0, y0[0], args)

    def func(self, terms, t0, y0, args):
        return terms[0].vf(t0, y0[1], args), terms[1].vf(t0, y0[0], args)

    def step(self, terms, t0, t1, y0, args, slope, made_jump):
        h, (q, v) = t1 - t0, y0
        v = v + h / 2 * slope
        q = q + h * terms[0].vf(t0, v, args)
        slope = terms[1].vf(t1, q, args)
        y1 = q, v + h / 2 * slope
        return y1, None, dict(y0=y0, y1=y1), slope, dfx.RESULTS.successful


def pair_of_terms(potential, masses):
    def slope(t, q, args):
        return -jax.grad(potential)(q) / masses

    return dfx.ODETerm(lambda t, v, args: v), dfx.ODETerm(slope)


def residuals(constraint, q, v):
    """Of positions and velocities, in roundoff of the terms that are added."""
    rows = jnp.abs(jax.jacobian(constraint)(q)).reshape(-1, q.size)
    g, rate = jax.jvp(constraint, (q,), (v,))
    scales = rows @ jnp.abs(q).ravel(), rows @ jnp.abs(v).ravel() + jnp.max(jnp.abs(v))
    return [jnp.max(jnp.abs(x) / scale) / EPS for x, scale in zip((g, rate), scales, strict=True)]


def slope_over_error(ts, values):
    t, x = (np.mean(np.asarray(a)[1:].reshape(20, -1), axis=1) for a in (ts, values))
    t = t - t.mean()
    slope = t @ x / (t @ t)
    rest = x - x.mean() - slope * t
    return slope / np.sqrt(rest @ rest / (len(t) - 2) / (t @ t))


def ratio(run, solvers, rounds=3):
    """The time of the second solver over that of the first, and both for a step."""
    times = [[], []]
    for solver in solvers:
        jax.block_until_ready(run(solver))
    for _ in range(rounds):
        for solver, found in zip(solvers, times, strict=True):
            start = time.process_time()
            jax.block_until_ready(run(solver))
            found.append(time.process_time() - start)
    first, second = map(min, times)
    return second / first, first, second


BEADS = 20


def rods(q):
    return jnp.sum(jnp.diff(q, axis=0, prepend=jnp.zeros((1, 2))) ** 2, axis=1) - 1


def weight(q):
    return jnp.sum(q[:, 1])


def repulsion(q):
    """All pairs, as in a polymer whose beads do not pass through each other."""
    i, j = np.triu_indices(BEADS, 2)
    return weight(q) + 0.1 * jnp.sum(jnp.sum((q[i] - q[j]) ** 2, axis=1) ** -3)


def chain():
    angles = -np.pi / 2 + 1.0 * np.cos(np.arange(BEADS) / 4)
    q = jnp.cumsum(jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1), axis=0)
    h, steps = 0.005, few(10**6, 2000)
    solver = dfc.RATTLE(dfc.Constraint(lambda t, q, args: rods(q)), 1.0)
    potentials = ("gravity", weight), ("pairs", repulsion)
    for name, potential in few(potentials, potentials[1:]):
        terms = pair_of_terms(potential, 1.0)
        count = few(20_000, 200)

        def run(s, terms=terms, n=count):
            return solve(terms, s, (q, 0 * q), 0.0, n * h, h).ys

        over, *both = ratio(run, (Verlet(), solver))
        print(f"  {name}: {[f'{x / count * 1e6:.2f}' for x in both]} us a step", flush=True)
        ts = jnp.linspace(0, steps * h, 1001)
        sol = solve(terms, solver, (q, 0 * q), 0.0, ts[-1], h, dfx.SaveAt(ts=ts))
        found = jax.vmap(lambda q, v: residuals(rods, q, v))(*sol.ys)
        total = jax.vmap(lambda q, v, p=potential: jnp.sum(v**2) / 2 + p(q))(*sol.ys)
        print(f"  energy {total[0]:.3f}, spread {jnp.std(total):.1e}", flush=True)
        yield f"chain, {name}: positions, {steps} steps, in roundoff", jnp.max(found[0]), 4
        yield f"chain, {name}: velocities, in roundoff", jnp.max(found[1]), 16
        yield f"chain, {name}: slope of the energy over its error", slope_over_error(ts, total), 2
        yield f"chain, {name}: time over Verlet", over, 4


# Three atoms, as of water.
BODY = jnp.array([[0.0, 0, 0], [1, 0, 0], [0.25, 0.968, 0]])
ATOMS, CHARGES = jnp.array([[16.0], [1], [1]]), jnp.array([-0.8, 0.4, 0.4])


def distances(q):
    a, b, c = q
    return jnp.stack([jnp.sum(d**2) for d in (a - b, a - c, b - c)])


def bonds(q):
    return distances(q) - distances(BODY)


def trap(q):
    return 0.05 * jnp.sum(ATOMS * q**2) + jnp.sum(CHARGES * jnp.cos(q @ jnp.array([0.3, 0.5, 0.7])))


def molecules():
    lanes, keys = few(100, 4), jr.split(jr.key(0), 4)
    turned, _ = jnp.linalg.qr(jr.normal(keys[0], (lanes, 3, 3)))
    q = jnp.einsum("kij,aj->kai", turned, BODY) + 3 * jr.uniform(keys[1], (lanes, 1, 3))
    centre = jnp.sum(ATOMS * q, axis=1, keepdims=True) / jnp.sum(ATOMS)
    v = jnp.cross(jnp.broadcast_to(jr.normal(keys[2], (lanes, 1, 3)), q.shape), q - centre)
    v = v + 0.3 * jr.normal(keys[3], (lanes, 1, 3))
    terms, h, steps = pair_of_terms(trap, ATOMS), 0.01, few(10**6, 2000)
    solver = dfc.RATTLE(dfc.Constraint(lambda t, q, args: bonds(q)), ATOMS)

    def run(solver, count, ts=None):
        saveat = None if ts is None else dfx.SaveAt(ts=ts)

        def each(q, v):
            return solve(terms, solver, (q, v), 0.0, count * h, h, saveat).ys

        return eqx.filter_jit(jax.vmap(each))(q, v)

    count = few(5000, 100)
    over, *both = ratio(eqx.filter_jit(lambda s: run(s, count)), (Verlet(), solver))
    print(f"  {[f'{x / count * 1e6:.1f}' for x in both]} us a step of {lanes}", flush=True)
    ts = jnp.linspace(0, steps * h, 401)
    qs, vs = run(solver, steps, ts)
    found = jax.vmap(jax.vmap(lambda q, v: residuals(bonds, q, v)))(qs, vs)
    total = jax.vmap(jax.vmap(lambda q, v: jnp.sum(ATOMS * v**2) / 2 + trap(q)))(qs, vs)
    total = jnp.sum(total, axis=0)
    print(f"  energy {total[0]:.3f}, spread {jnp.std(total):.1e}", flush=True)
    yield f"{lanes} molecules: positions, {steps} steps, in roundoff", jnp.max(found[0]), 4
    yield f"{lanes} molecules: velocities, in roundoff", jnp.max(found[1]), 16
    yield f"{lanes} molecules: slope of the energy over its error", slope_over_error(ts, total), 2
    yield f"{lanes} molecules: time over Verlet", over, 4


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", default="")
    parser.add_argument("--smoke", action="store_true")
    options = parser.parse_args()
    globals()["SMOKE"] = options.smoke
    for part in (kepler, chain, molecules):
        if options.only in part.__name__:
            for what, number, target in part():
                print(f"{what}: {float(number):.3g} (target {target:g})", flush=True)


if __name__ == "__main__":
    main()
