"""How many solves that are right are refused: energies whose terms cancel, and neural Hamiltonians
that are trained through their own projected solves.

Run: `python benchmarks/studies/refusals.py`, with `--smoke` for a few of each.
"""

import sys

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax

import diffrax_conserve as dfc

# Each is p²/2 + V(q) with V(0) = 0, for amplitudes from 1e-4 to 0.3.
FORMS = {
    "1 - cos": lambda q: 1 - jnp.cos(q),
    "cosh - 1": lambda q: jnp.cosh(q) - 1,
    "sqrt - 1": lambda q: jnp.sqrt(1 + q**2) - 1,
    "exp - 1 + q": lambda q: jnp.exp(-q) + q - 1,
    "1 - exp": lambda q: 1 - jnp.exp(-(q**2)),
    "log": lambda q: jnp.log(1 + q**2) / 2,
    "1 - 1/x": lambda q: 1 - 1 / (1 + q**2 / 2),
    "checkpoint": jax.checkpoint(lambda q: 1 - jnp.cos(q)),
}


def canonical(hamiltonian):
    """The vector field of a Hamiltonian of a state (q, p)."""

    def field(t, y, args):
        gradient = jax.grad(hamiltonian, argnums=1)(args, y)
        return jnp.stack([gradient[1], -gradient[0]])

    return field


def solve(hamiltonian, y0, args, solver, steps, dt, projected=True):
    if projected:
        energy = dfc.FirstIntegral(lambda t, y, args: hamiltonian(args, y))
        solver = dfc.ManifoldProjection(solver, energy)
    dt = jnp.asarray(dt, y0.dtype)
    solution = dfx.diffeqsolve(
        dfx.ODETerm(canonical(hamiltonian)),
        solver,
        0 * dt,
        steps * dt,
        dt,
        y0,
        args,
        saveat=dfx.SaveAt(steps=True),
        max_steps=steps + 1,
        throw=False,
    )
    return solution.ys[:steps], dfx.is_okay(solution.result)


def near_rest(potential, dtype, solver, lanes):
    rng = np.random.default_rng(0)
    amplitude, angle = 10 ** rng.uniform(-4, -0.5, lanes), rng.uniform(0, 2 * np.pi, lanes)
    y0 = (amplitude * np.stack([np.cos(angle), np.sin(angle)])).T.astype(dtype)
    energy = lambda args, y: y[1] ** 2 / 2 + potential(y[0])  # noqa: E731
    done = jax.jit(jax.vmap(lambda y: solve(energy, y, None, solver, 60, 0.1)[1]))(y0)
    return int(np.sum(~np.asarray(done)))


def trained(key, dtype, epochs):
    """The failed solves of a training, whether its loss was always finite, and the failed solves
    with the network that it made."""
    a, b, c = jr.split(key, 3)
    network = eqx.nn.MLP(2, "scalar", 32, 2, jnp.tanh, dtype=dtype, key=a)
    weights, static = eqx.partition(network, eqx.is_array)
    hamiltonian = lambda weights, y: eqx.combine(weights, static)(y)  # noqa: E731
    pendulum = lambda args, y: y[1] ** 2 / 2 - jnp.cos(y[0])  # noqa: E731
    y0, others = 1.2 * jr.normal(b, (16, 2), dtype), 1.2 * jr.normal(c, (128, 2), dtype)
    batch = lambda fn, ys: jax.vmap(fn)(ys)  # noqa: E731
    true, _ = batch(lambda y: solve(pendulum, y, None, dfc.RK4(), 20, 0.1, projected=False), y0)

    def loss(weights):
        ys, done = batch(lambda y: solve(hamiltonian, y, weights, dfc.RK4(), 20, 0.1), y0)
        return jnp.mean((ys - true) ** 2), jnp.sum(~done)

    optimiser = optax.adam(3e-3)

    def update(carry, _):
        weights, state = carry
        (value, failed), gradient = jax.value_and_grad(loss, has_aux=True)(weights)
        updates, state = optimiser.update(gradient, state)
        return (optax.apply_updates(weights, updates), state), (value, failed)

    start = weights, optimiser.init(weights)
    (weights, _), (values, failed) = jax.lax.scan(update, start, None, length=epochs)
    _, done = batch(lambda y: solve(hamiltonian, y, weights, dfc.RK4(), 200, 0.1), others)
    return jnp.sum(failed), jnp.all(jnp.isfinite(values)), jnp.sum(~done)


def main(smoke=False):
    jax.config.update("jax_enable_x64", True)
    lanes, seeds, epochs = (20, 2, 2) if smoke else (1000, 24, 150)
    dtypes = (np.float64, np.float32)[: 1 if smoke else None]
    for name, potential in list(FORMS.items())[: 1 if smoke else None]:
        for dtype in dtypes:
            for solver in (dfx.Tsit5(), dfc.RK4()):
                failed = near_rest(potential, dtype, solver, lanes)
                kind = f"{name}, {dtype.__name__}, {type(solver).__name__}"
                print(f"{kind:32} {failed} of {lanes} solves refused", flush=True)
    for dtype in dtypes:
        run = jax.jit(jax.vmap(lambda key, dtype=dtype: trained(key, dtype, epochs)))
        failed, finite, frozen = map(np.asarray, run(jr.split(jr.key(0), seeds)))
        print(
            f"neural Hamiltonians, {dtype.__name__}: {np.sum(~finite)} of {seeds} trainings with "
            f"NaN, {np.sum(failed)} of {seeds * epochs * 16} solves in them refused, "
            f"{np.sum(frozen)} of {seeds * 128} frozen ones",
            flush=True,
        )


if __name__ == "__main__":
    main("--smoke" in sys.argv)
