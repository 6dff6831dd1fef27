"""Projection with two to ten constraints, alone and in batches.

A free rigid body, with its quaternion and the angular velocity in its frame, keeps the length of
the quaternion, the energy, the angular momentum in space, or some of them. The outer solar system
keeps its ten classical integrals. For each: the first call, and seconds per step of RK4 over those
of plain RK4, of the processor and of the clock.
"""

import time

import diffrax as dfx
import jax
import jax.numpy as jnp
import measuring

import diffrax_conserve as dfc

INERTIA = jnp.array([1.0, 2.0, 3.0])


def product(p, q):
    """Of quaternions, the real part first."""
    vector = p[0] * q[1:] + q[0] * p[1:] + jnp.cross(p[1:], q[1:])
    return jnp.concatenate([(p[0] * q[0] - jnp.dot(p[1:], q[1:]))[None], vector])


def body_vector_field(t, y, args):
    q, w = y
    turning = jnp.concatenate([jnp.zeros(1), w])
    return product(q, turning) / 2, jnp.cross(INERTIA * w, w) / INERTIA


def momentum(t, y, args):
    q, w = y
    inner = jnp.concatenate([jnp.zeros(1), INERTIA * w])
    return product(product(q, inner), q * jnp.array([1, -1, -1, -1]))[1:]


LENGTH = dfc.Constraint(lambda t, y, args: jnp.sum(y[0] ** 2) - 1)
ENERGY = dfc.FirstIntegral(lambda t, y, args: jnp.sum(INERTIA * y[1] ** 2) / 2)
SQUARE = dfc.FirstIntegral(lambda t, y, args: jnp.sum((INERTIA * y[1]) ** 2))
MOMENTUM = dfc.FirstIntegral(momentum)
BODY = jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.3, 0.7, 0.5])
PLANETS = dfc.systems.OuterSolarSystem()
TEN = dict(PLANETS.manifold, centre=dfc.FirstIntegral(PLANETS.centre_of_mass))

# For each: the vector field, the manifold, the state, the step and the batches.
CASES = {
    f"body, {m} constraints": (body_vector_field, manifold, BODY, 0.05, (1, 64, 1000))
    for m, manifold in {
        2: (LENGTH, ENERGY),
        3: (LENGTH, ENERGY, SQUARE),
        4: (LENGTH, MOMENTUM),
        5: (LENGTH, ENERGY, MOMENTUM),
    }.items()
} | {"planets, 10 constraints": (PLANETS.vector_field, TEN, PLANETS.y0, 20.0, (1, 64, 100))}


def lanes(y, batch):
    """States near `y`. A quaternion has the length one in each."""
    keys = jax.random.split(jax.random.key(0), batch)
    moved = lambda key, x: x * (1 + 0.05 * jax.random.normal(key, x.shape))  # noqa: E731
    ys = jax.vmap(lambda key: jax.tree.map(lambda x: moved(key, x), y))(keys)
    if y is BODY:
        ys = (jnp.broadcast_to(y[0], (batch, 4)), ys[1])
    return ys if batch > 1 else jax.tree.map(lambda x: x[0], ys)


def measure(name, batch, steps, rounds=5):
    vector_field, manifold, y, dt, _ = CASES[name]
    y0, row = lanes(y, batch), {"problem": name, "batch": batch}
    solvers = {"plain": dfc.RK4(), "projected": dfc.ManifoldProjection(dfc.RK4(), manifold)}
    runs = {}
    for label, solver in solvers.items():

        def solve(y0, t1, solver=solver):
            term = dfx.ODETerm(vector_field)
            sol = dfx.diffeqsolve(term, solver, 0.0, t1, dt, y0, max_steps=None, throw=False)
            return sol.ys, sol.result

        many = jax.vmap(solve, (0, None)) if batch > 1 else solve
        compiled, row[f"{label} first call"] = measuring.compiled(many, y0, jnp.array(steps * dt))
        count = steps if label == "projected" else 8 * steps
        runs[label] = lambda run=compiled, t1=jnp.array(count * dt): run(y0, t1)
    best = {(label, kind): float("inf") for label in runs for kind in ("clock", "processor")}
    for _ in range(rounds):
        for label, run in runs.items():
            begin = time.perf_counter(), time.process_time()
            _, result = jax.block_until_ready(run())
            end = time.perf_counter(), time.process_time()
            count = steps if label == "projected" else 8 * steps
            for kind, a, b in zip(("clock", "processor"), begin, end, strict=True):
                best[label, kind] = min(best[label, kind], (b - a) / count)
    row["succeeded"] = bool(jnp.all(result == dfx.RESULTS.successful))
    row["projected s/step"] = best["projected", "processor"]
    for kind in ("processor", "clock"):
        row[f"over plain, {kind}"] = best["projected", kind] / best["plain", kind]
    return row


def main(argv=None):
    options = measuring.parser(__doc__, "few_constraints").parse_args(argv)
    rows = []
    for name, (*_, batches) in CASES.items():
        for batch in batches[: 2 if options.smoke else None]:
            if options.only in f"{name}, batch {batch}":
                steps = 3 if options.smoke else max(30, 20_000 // (1 + batch // 4))
                rows.append(measure(name, batch, steps))
                measuring.print_row(rows[-1])
    measuring.write(options, measuring.machine(), rows=rows)
    return rows


if __name__ == "__main__":
    main()
