"""Which `max_correction` lets every solve of the catalogue through, and catches what is wrong.

For each system the solves of the README's table, and others with coarse steps, are run with several
limits. A limit is right if it changes none of them. Run:
`python benchmarks/studies/max_correction.py`, with `--smoke` for one system.
"""

import math
import sys

import diffrax as dfx
import jax
import jax.numpy as jnp

import diffrax_conserve as dfc

LIMITS = (0.1, 0.2, 0.5, 1.0, 2.0, math.inf)
CASES = {
    "Euler / 20": (dfx.Euler(), 1 / 20, None),
    "Heun / 2": (dfx.Heun(), 1 / 2, None),
    "RK4": (dfc.RK4(), 1.0, None),
    "Tsit5": (dfx.Tsit5(), 1.0, None),
    "Bosh3 1e-3": (dfx.Bosh3(), 1.0, 1e-3),
    "Tsit5 1e-6": (dfx.Tsit5(), 1.0, 1e-6),
}


def counts_of(system, solver, factor, rtol, limits, num_steps=50):
    """The number of steps to the end for each limit, or `None` where the solve failed."""
    dt = factor * system.dt
    controller = dfx.ConstantStepSize() if rtol is None else dfx.PIDController(rtol=rtol, atol=rtol)

    @jax.jit
    @jax.vmap
    def solve(limit):
        solution = dfx.diffeqsolve(
            dfx.ODETerm(system.vector_field),
            dfc.ManifoldProjection(solver, system.manifold, max_correction=limit),
            0.0,
            num_steps * dt,
            dt,
            system.y0,
            args=system.args,
            stepsize_controller=controller,
            max_steps=4096,
            throw=False,
        )
        return dfx.is_okay(solution.result), solution.stats["num_steps"]

    return [int(n) if ok else None for ok, n in zip(*solve(jnp.asarray(limits)), strict=True)]


def main(smoke=False):
    jax.config.update("jax_enable_x64", True)
    print(f"{'system, solver':38}", *(f"{limit!s:>6}" for limit in LIMITS))
    for name in dfc.systems.names()[: 1 if smoke else None]:
        system = dfc.systems.get(name)
        for case, options in list(CASES.items())[: 1 if smoke else None]:
            counts = counts_of(system, *options, LIMITS)
            print(f"{name + ', ' + case:38}", *(f"{count!s:>6}" for count in counts), flush=True)
    wrong = dfc.FirstIntegral(lambda t, y, args: y[0] ** 2)
    pendulum = dfx.ODETerm(lambda t, y, args: jnp.stack([y[1], -jnp.sin(y[0])]))
    for limit in LIMITS[-1:] if smoke else LIMITS:
        solution = dfx.diffeqsolve(
            pendulum,
            dfc.ManifoldProjection(dfx.Tsit5(), wrong, max_correction=limit),
            0.0,
            10.0,
            0.1,
            jnp.array([1.0, 0.0]),
            stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
            throw=False,
        )
        print("a pendulum that keeps q², limit", limit, solution.ts, dfx.is_okay(solution.result))


if __name__ == "__main__":
    main("--smoke" in sys.argv)
