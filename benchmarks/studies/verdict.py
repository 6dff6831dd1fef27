"""Is what `compare` names the best? Verdicts on problems of others that nothing was chosen by.

    python benchmarks/studies/verdict.py             # one row for each problem, forty minutes
    python benchmarks/studies/verdict.py --only top  # the problems whose names hold this text
    python benchmarks/studies/verdict.py --smoke     # toy sizes

A row has what `compare` names from one start and from eight random ones. It is judged by other
solves, over an interval that is half as long again: that from one start by the same start, that from
eight by eight others. These share nothing with `compare` but the candidates: an error is the root
mean square over the components, each in the unit that a physicist would give it, the largest over
23 times inside the steps or at their ends, against DOP853 or Radau of SciPy at a tight tolerance.
The number behind a choice is its error over the least one of all candidates, in the geometric mean
over the starts: at most 1.5 is the target. The last columns are the errors of the second choice
over that without projection, in the mean and at worst, and of how many starts the errors are more
than ten times that of the reference. `benchmarks/results/verdict.json` has the rows.
"""
# ruff: noqa: E731

import argparse
import contextlib
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp

import diffrax_conserve as dfc

jax.config.update("jax_enable_x64", True)

RESULTS = Path(__file__).parents[1] / "results" / "verdict.json"
STARTS, LONGER, TIMES = 8, 1.5, 23


class Problem(NamedTuple):
    """`draw(key)` is a random start, `kept` what is conserved, as functions of the state. `scale`
    is the unit of an error, a number or like the state."""

    field: Any
    kept: dict
    draw: Any
    solver: Any
    t1: float
    dt0: float | None = None
    tol: float | None = None
    scale: Any = 1.0


PROBLEMS: dict[str, Problem] = {}


def stiff(made):
    return isinstance(made.solver, dfx.AbstractImplicitSolver)


def problem(solver, t1, **more):
    """Of a function that returns the field, what is conserved and how a start is drawn."""

    def keep(fn):
        PROBLEMS[fn.__name__.replace("_", "-")] = Problem(*fn(), solver, t1, **more)

    return keep


def unit(key, n=3):
    x = jr.normal(key, (n,))
    return x / jnp.linalg.norm(x)


# ---- Bodies ----


def top(inertia, weight, centre):
    """The equations of Euler and Poisson, in the body; `g` is the direction upwards."""
    inertia, centre = jnp.array(inertia), jnp.array(centre)

    def field(w, g):
        torque = weight * jnp.cross(g, centre) + jnp.cross(inertia * w, w)
        return torque / inertia, jnp.cross(g, w)

    energy = lambda w, g: inertia @ w**2 / 2 + weight * g @ centre
    return field, dict(energy=energy, momentum=lambda w, g: inertia * w @ g, length=lambda w, g: g @ g)


@problem(dfx.Tsit5(), 1.0, tol=1e-6, scale=dict(w=100.0, g=1.0))
def heavy_top():
    """Not quite symmetric, in SI, in two leaves."""
    field, kept = top([2.6e-4, 2.8e-4, 1.5e-4], 0.2 * 9.81 * 0.04, [0.0, 0.0, 1.0])
    spin = lambda key: 5 * jr.normal(key, (3,)) + jnp.array([0.0, 0.0, 100.0])
    draw = lambda a, b: dict(w=spin(a), g=unit(b))
    kept = {k: lambda y, f=f: f(y["w"], y["g"]) for k, f in kept.items()}
    return lambda y: dict(zip("wg", field(y["w"], y["g"]), strict=True)), kept, lambda key: draw(*jr.split(key))


@problem(dfc.RK4(), 15.0, dt0=0.1)
def kowalevski_top():
    """With the integral of fourth degree, in one array."""
    field, kept = top([2.0, 2.0, 1.0], 1.0, [1.0, 0.0, 0.0])
    fourth = lambda w, g: (w[0] ** 2 - w[1] ** 2 - g[0]) ** 2 + (2 * w[0] * w[1] - g[1]) ** 2
    kept = {k: lambda y, f=f: f(y[:3], y[3:]) for k, f in (kept | dict(fourth=fourth)).items()}
    draw = lambda a, b: jnp.concatenate([jr.normal(a, (3,)), unit(b)])
    return lambda y: jnp.concatenate(field(y[:3], y[3:])), kept, lambda key: draw(*jr.split(key))


@problem(dfx.Dopri5(), 30.0, tol=1e-5)
def restricted_three_body():
    """Near the fourth point of Lagrange of Earth and Moon, in one array; Jacobi's integral."""
    mu, turn = 0.01215, jnp.array([2.0, -2.0])

    def potential(q):
        near, far = (jnp.hypot(q[0] + x, q[1]) for x in (mu, mu - 1))
        return q @ q / 2 + (1 - mu) / near + mu / far

    field = lambda y: jnp.concatenate([y[2:], jax.grad(potential)(y[:2]) + turn * y[:1:-1]])
    point = jnp.array([0.5 - mu, 0.75**0.5, 0.0, 0.0])
    jacobi = lambda y: 2 * potential(y[:2]) - y[2:] @ y[2:]
    return field, dict(jacobi=jacobi), lambda key: point + 0.03 * jr.normal(key, (4,))


@problem(dfx.Dopri5(), 15.0, tol=1e-4)
def geodesic_of_an_ellipsoid():
    """With Joachimsthal's integral, as a pair."""
    a = 1 / jnp.array([1.0, 0.7, 0.4]) ** 2
    surface = lambda y: y[0] @ (a * y[0])
    tangent = lambda y: y[0] @ (a * y[1])
    joachimsthal = lambda y: (y[0] @ (a**2 * y[0])) * (y[1] @ (a * y[1]))
    kept = dict(surface=surface, tangent=tangent, joachimsthal=joachimsthal)
    kept["energy"] = lambda y: y[1] @ y[1]

    def draw(key):
        u, v = (unit(k) for k in jr.split(key))
        q = u / jnp.sqrt(u @ (a * u))
        v = v - (v @ (a * q)) / jnp.sum((a * q) ** 2) * a * q
        return q, v / jnp.linalg.norm(v)

    bend = lambda y: -(y[1] @ (a * y[1])) / jnp.sum((a * y[0]) ** 2) * a * y[0]
    return lambda y: (y[1], bend(y)), kept, draw


SIZES = dict(t=2000.0, r=20.0, phi=1.0, ut=1.0, ur=0.1, up=0.03)


@problem(dfx.Tsit5(), 2000.0, tol=1e-6, scale=SIZES)
def geodesic_of_schwarzschild():
    """A planet near a black hole, in six scalars; `ut` and so on are the four-velocity."""

    def field(y):
        r, ut, ur, up = (y[k] for k in ("r", "ut", "ur", "up"))
        pull = -(r - 2) / r**3 * ut**2 + ur**2 / (r * (r - 2)) + (r - 2) * up**2
        slopes = (ut, ur, up, -2 / (r * (r - 2)) * ut * ur, pull, -2 / r * ur * up)
        return dict(zip(SIZES, slopes, strict=True))

    def draw(key):
        a, b = jr.split(key)
        p, e = jr.uniform(a, minval=10.0, maxval=20.0), jr.uniform(b, minval=0.1, maxval=0.6)
        r, share = p / (1 + e), p - 3 - e**2
        ut = jnp.sqrt(((p - 2) ** 2 - 4 * e**2) / (p * share)) / (1 - 2 / r)
        return dict(zip(SIZES, (0.0 * r, r, 0.0 * r, ut, 0.0 * r, p / jnp.sqrt(share) / r**2), strict=True))

    energy = lambda y: (1 - 2 / y["r"]) * y["ut"]
    momentum = lambda y: y["r"] ** 2 * y["up"]
    length = lambda y: (y["ur"] ** 2 - energy(y) ** 2) / (1 - 2 / y["r"]) + momentum(y) * y["up"]
    return field, dict(energy=energy, momentum=momentum, length=length), draw


@problem(dfx.Dopri5(), 2.0, tol=1e-6, scale=jnp.array([2e7] * 3 + [1.4e7] * 3))
def proton_in_the_field_of_a_dipole():
    """Of the Earth, 1 MeV, in SI, in one array; its momentum about the axis is conserved."""
    k = 9.5788e7 * 3.1e-5 * 6.371e6**3

    def field(y):
        q, v, r = y[:3], y[3:], jnp.linalg.norm(y[:3])
        b = k * (3 * q[2] * q / r**5 - jnp.array([0.0, 0.0, 1.0]) / r**3)
        return jnp.concatenate([v, jnp.cross(v, b)])

    def momentum(y):
        return y[0] * y[4] - y[1] * y[3] + k * (y[0] ** 2 + y[1] ** 2) / jnp.linalg.norm(y[:3]) ** 3

    def draw(key):
        a, b = jr.split(key)
        q = jnp.array([1.9e7, 0.0, 0.0]) + 1e6 * jr.normal(a, (3,))
        return jnp.concatenate([q, 1.38e7 * unit(b)])

    return field, dict(energy=lambda y: y[3:] @ y[3:] / 2, momentum=momentum), draw


@problem(dfc.RK4(), 4.0, dt0=0.05)
def calogero_moser():
    """Four particles on a line; the traces of the powers of Lax's matrix are conserved."""
    apart = lambda q: q[:, None] - q + jnp.eye(4)
    off = 1 - jnp.eye(4)
    lax = lambda y: jnp.diag(y["p"]) + 1j * off / apart(y["q"])
    power = lambda n: lambda y: jnp.trace(jnp.linalg.matrix_power(lax(y), n)).real
    field = lambda y: dict(q=y["p"], p=2 * jnp.sum(off / apart(y["q"]) ** 3, axis=1))

    def draw(key):
        a, b = jr.split(key)
        q = 1.5 * jnp.arange(4.0) + jr.uniform(a, (4,), minval=-0.4, maxval=0.4)
        return dict(q=q, p=jr.normal(b, (4,)))

    return field, {f"trace-{n}": power(n) for n in range(1, 5)}, draw


# ---- Oscillators and waves ----


@problem(dfc.RK4(), 100.0, dt0=0.1)
def fermi_pasta_ulam_tsingou():
    """Sixteen particles between walls, of random displacements; the energy."""
    stretch = lambda q: jnp.diff(q, prepend=0.0, append=0.0)
    energy = lambda y: jnp.sum(y["p"] ** 2) / 2 + jnp.sum(stretch(y["q"]) ** 2 / 2 + stretch(y["q"]) ** 3 / 12)
    field = lambda y: dict(q=y["p"], p=jnp.diff(stretch(y["q"]) + stretch(y["q"]) ** 2 / 4))
    draw = lambda key: dict(q=0.3 * jr.normal(key, (16,)), p=jnp.zeros(16))
    return field, dict(energy=energy), draw


@problem(dfx.Heun(), 20.0, dt0=0.01)
def nose_hoover():
    """An oscillator `q, p` with a thermostat `x` and its integral `s`; the extended energy."""
    field = lambda y: jnp.stack([y[1], -y[0] - y[2] * y[1], y[1] ** 2 - 1, y[2]])
    energy = lambda y: y[:3] @ y[:3] / 2 + y[3]
    return field, dict(energy=energy), lambda key: jr.normal(key, (4,)).at[3].set(0.0)


@problem(dfx.Tsit5(), 10.0, tol=1e-5)
def ablowitz_ladik():
    """Twelve complex amplitudes on a ring."""
    field = lambda y: 1j * (jnp.roll(y, 1) + jnp.roll(y, -1)) * (1 + jnp.abs(y) ** 2)
    flow = lambda y: jnp.sum(jnp.conj(y) * jnp.roll(y, 1))
    norm = lambda y: jnp.sum(jnp.log1p(jnp.abs(y) ** 2))
    draw = lambda key: 0.5 * jr.normal(key, (12,), complex)
    return field, dict(norm=norm, energy=lambda y: flow(y).real, momentum=lambda y: flow(y).imag), draw


@problem(dfx.Bosh3(), 20.0, tol=1e-5)
def maxwell_bloch():
    """A laser field, the polarisation and the inversion, in three leaves."""
    field = lambda y: dict(e=y["p"], p=y["e"] * y["d"], d=-jnp.sum(y["e"] * y["p"], keepdims=True))
    kept = dict(
        length=lambda y: y["p"] @ y["p"] + jnp.sum(y["d"] ** 2),
        energy=lambda y: y["e"] @ y["e"] / 2 + jnp.sum(y["d"]),
        phase=lambda y: y["e"][0] * y["p"][1] - y["e"][1] * y["p"][0],
    )
    draw = lambda a, b, c: dict(e=jr.normal(a, (2,)), p=jr.normal(b, (2,)), d=jr.normal(c, (1,)))
    return field, kept, lambda key: draw(*jr.split(key, 3))


# ---- Chemistry ----

SUMS = dict(adenine=4.0, nicotinamide=1.0)
FEED = jnp.array([2.5, 0, 0, 0, 0, 0, 0, 0, 0])
HIGHEST = jnp.array([1.6, 2.2, 0.2, 0.35, 0.3, 2.7, 0.1])


@problem(dfx.Kvaerno3(), 5.0, tol=1e-5)
def glycolysis():
    """Of yeast, after Wolf and Heinrich (2000); ATP and ADP, NADH and NAD have sums."""

    def field(y):
        s1, s2, s3, s4, nadh, atp, out, adp, nad = y
        v1 = 100 * s1 * atp / (1 + (atp / 0.52) ** 4)
        v2, v3, v4 = 6 * s2 * nad, 16 * s3 * adp, 100 * s4 * nadh
        v5, v6, through = 1.28 * atp, 12 * s2 * nadh, 13 * (s4 - out)
        charge, reduced = 2 * v3 - 2 * v1 - v5, v2 - v4 - v6
        slopes = [-v1, 2 * v1 - v2 - v6, v2 - v3, v3 - v4 - through, reduced, charge]
        return FEED + jnp.stack([*slopes, 0.1 * through - 1.8 * out, -charge, -reduced])

    def draw(key):
        y = HIGHEST * jr.uniform(key, (7,), minval=0.1, maxval=1.0)
        return jnp.append(y, jnp.stack([4.0 - y[5], 1.0 - y[4]]))

    return field, dict(adenine=lambda y: y[5] + y[7], nicotinamide=lambda y: y[4] + y[8]), draw


# ---- The study ----


def coordinates(made, y0):
    """The maps from a state to a vector of real numbers in units of the scale, and back."""
    wide = lambda s, part: jax.tree.map(lambda x: jnp.broadcast_to(s, x.shape), part)
    scale = ravel_pytree(jax.tree.map(wide, made.scale, y0))[0]
    flat, back = ravel_pytree(y0)
    if not jnp.iscomplexobj(flat):
        return lambda y: ravel_pytree(y)[0] / scale, lambda x: back(x * scale)
    both = lambda x: jnp.concatenate([x.real, x.imag])
    join = lambda x: x[: flat.size] + 1j * x[flat.size :]
    return lambda y: both(ravel_pytree(y)[0] / scale), lambda x: back(join(x) * scale)


def exact(made, y0s, ts, tol):
    """The coordinates of all starts at the times, by SciPy in one solve."""
    start, state = coordinates(made, jax.tree.map(lambda x: x[0], y0s))
    x0s = jax.vmap(start)(y0s)
    fields = jax.vmap(lambda x: start(made.field(state(x))))
    field = jax.jit(lambda x: fields(x.reshape(x0s.shape)).ravel())
    options = dict(method="DOP853", fun=lambda t, x: np.asarray(field(x)))
    if stiff(made):
        jacobian = jax.jit(jax.jacfwd(field))
        options |= dict(method="Radau", jac=lambda t, x: np.asarray(jacobian(x)))
    sol = solve_ivp(y0=np.ravel(x0s), t_span=(0, ts[-1]), t_eval=ts, rtol=tol, atol=tol, **options)
    return sol.y.T.reshape(len(ts), *x0s.shape).swapaxes(0, 1)


def distance(xs, others):
    """The largest over the times of the root mean square over the components."""
    return np.max(np.sqrt(np.mean((xs - others) ** 2, axis=2)), axis=1)


def judged(made, kept, rows, y0s):
    """The errors of the choices of all rows, and those of the reference, in each start. An entry
    that is left out is zero in the place of its function, so that three programs solve all."""
    ts = LONGER * made.t1 * np.append(np.sort(np.random.default_rng(5).random(TIMES - 1)), 1)
    control = dfx.ConstantStepSize()
    if made.dt0 is None:
        control = dfx.PIDController(rtol=made.tol, atol=made.tol)
    else:
        ts = made.dt0 * np.unique(np.round(ts / made.dt0))  # ends of steps
    first = jax.tree.map(lambda x: x[0], y0s)
    to, _ = coordinates(made, first)

    @eqx.filter_jit
    def solved(flags, weights):
        """All starts, with the entries whose flag is one; without a projection if there are none."""
        values = lambda t, y, args: [f(y) * x for f, x in zip(made.kept.values(), args, strict=True)]
        projection = dfc.SimplifiedNewton(metric=weights)
        solver = dfc.ManifoldProjection(made.solver, dfc.FirstIntegral(values), projection=projection)

        def one(y0):
            sol = dfx.diffeqsolve(
                dfx.ODETerm(lambda t, y, args: made.field(y)), made.solver if flags is None else solver,
                0.0, ts[-1], made.dt0, y0, args=flags, saveat=dfx.SaveAt(ts=ts), throw=False,
                stepsize_controller=control, max_steps=100_000, adjoint=dfx.ForwardMode(),
            )  # fmt: skip
            return jax.vmap(to)(sol.ys), dfx.is_okay(sol.result)

        return jax.lax.map(one, y0s)  # one after the other, which is compiled faster than a batch

    tolerances = (1e-9, 1e-11) if stiff(made) else (1e-12, 1e-13)
    rough, truth = (exact(made, y0s, ts, tol) for tol in tolerances)
    ones, errors = jax.tree.map(lambda x: jnp.ones(x.shape), first), []
    for row in rows:
        flags = jnp.array([float(name in row.kept) for name in kept]) if row.kept else None
        xs, okay = solved(flags, ones if "metric=1.0" in row.name else None)
        errors.append(np.where(okay, distance(np.asarray(xs), truth), np.inf))
    return np.stack(errors), distance(rough, truth)


def means(errors):
    """The geometric mean of the errors of each row over the starts."""
    return np.exp(np.mean(np.log(errors), axis=1))


def study(name, made):
    field = lambda t, y, args: made.field(y)
    kept = {k: dfc.FirstIntegral(lambda t, y, args, f=f: f(y)) for k, f in made.kept.items()}
    steps = {"dt0": made.dt0} if made.tol is None else {"rtol": made.tol, "atol": made.tol}
    few, others = (jax.vmap(made.draw)(jr.split(jr.key(seed), STARTS)) for seed in (1, 2))
    copies = jax.tree.map(lambda x: jnp.stack([x[0]] * STARTS), others)  # as programs are of eight
    with contextlib.redirect_stdout(None):
        one, eight = (
            dfc.compare(field, made.solver, kept, y0s, t1=made.t1, batch=True, **steps)
            for y0s in (copies, few)
        )
    errors, doubt = judged(made, kept, one.rows, others)
    known = np.min(errors, axis=0) > 10 * doubt
    found = dict(problem=name, solver=type(made.solver).__name__)
    for case, report, part in (("one", one, errors[:, :1]), ("eight", eight, errors[:, known])):
        mean, row = means(part), report.index
        over = None if row is None or not part.size else float(mean[row] / np.min(mean))
        found |= {case: report.choice, f"{case}/best": over}
    names = [row.name for row in one.rows]
    mean, over = means(errors[:, known]), errors[eight.index or 0, known] / errors[0, known]
    found |= dict(best=names[int(np.argmin(mean))], mean=float(means(over[None])[0]))
    found |= dict(worst=float(np.max(over, initial=0)), judged=int(np.sum(known)))
    told = dict(one=one.error[:, 0], eight=means(eight.error))
    others = {k: x.tolist() for k, x in told.items()}
    return found | dict(rows=names, errors=errors.tolist(), told=others)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", default="", help="the problems whose names hold this text")
    parser.add_argument("--smoke", action="store_true", help="toy sizes")
    options = parser.parse_args()
    globals()["STARTS"] = 2 if options.smoke else STARTS
    names, found = [name for name in PROBLEMS if options.only in name], []
    head = ("problem", "solver", "one", "one/best", "eight", "eight/best", "best", "mean", "worst")
    head = (*head, "judged")
    print(*head, sep=" | ")
    for name in names[:1] if options.smoke else names:
        found.append(study(name, PROBLEMS[name]))
        cells = [found[-1][k] for k in head]
        print(*(f"{x:.3g}" if isinstance(x, float) else x for x in cells), sep=" | ", flush=True)
        if len(names) == len(PROBLEMS) and not options.smoke:
            RESULTS.write_text("[\n" + ",\n".join(map(json.dumps, found)) + "\n]\n")


if __name__ == "__main__":
    main()
