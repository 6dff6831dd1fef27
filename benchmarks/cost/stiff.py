"""Stiff ordinary equations by `Radau`, by Kvaerno5 of diffrax, and by the `Radau` of scipy.

For each tolerance: accepted steps, the digits of the worst component at the end, and the least
time of three solves that are compiled. The references are those of the test set of initial value
problems (Mazzia and Magherini, Bari 2008).

Run: `python benchmarks/cost/stiff.py` (a minute). `--smoke` runs one tolerance of one problem.
"""

import sys
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import diffrax_conserve as dfc

jax.config.update("jax_enable_x64", True)


def van_der_pol(t, y, args):
    return jnp.stack([y[1], 1e6 * ((1 - y[0] ** 2) * y[1] - y[0])])


def robertson(t, y, args):
    a, b, c = y
    slow, back, fast = 0.04 * a, 1e4 * b * c, 3e7 * b**2
    return jnp.stack([back - slow, slow - back - fast, fast])


def hires(t, y, args):
    a, b, c, d, e, f, g, h = y
    return jnp.stack([
        -1.71 * a + 0.43 * b + 8.32 * c + 0.0007, 1.71 * a - 8.75 * b,
        -10.03 * c + 0.43 * d + 0.035 * e, 8.32 * b + 1.71 * c - 1.12 * d,
        -1.745 * e + 0.43 * f + 0.43 * g, -280 * f * h + 0.69 * d + 1.71 * e - 0.43 * f + 0.69 * g,
        280 * f * h - 1.81 * g, -280 * f * h + 1.81 * g,
    ])  # fmt: skip


# The field, the end, the start, the absolute tolerance over the relative one, and the reference.
PROBLEMS = {
    "van der Pol, 1e6": (
        van_der_pol, 2.0, [2.0, 0.0], 1e-2, [1.706167732170483, -0.8928097010247975]
    ),
    "Robertson": (
        robertson, 1e11, [1.0, 0.0, 0.0], 1e-6,
        [0.2083340149701255e-7, 0.8333360770334713e-13, 0.9999999791665050],
    ),
    "HIRES": (
        hires, 321.8122, [1.0, 0, 0, 0, 0, 0, 0, 0.0057], 1e-2,
        [0.7371312573325668e-3, 0.1442485726316185e-3, 0.5888729740967575e-4,
         0.1175651343283149e-2, 0.2386356198831331e-2, 0.6238968252742796e-2,
         0.2849998395185769e-2, 0.2850001604814231e-2],
    ),
}  # fmt: skip


def solved(field, end, start, solver, tolerance, scale):
    """Accepted steps, the state at the end, and seconds."""

    @jax.jit
    def run(y0, tolerance):
        steps = diffrax.PIDController(rtol=tolerance, atol=tolerance * scale)
        term = diffrax.ODETerm(field)
        return diffrax.diffeqsolve(
            term, solver, 0.0, end, 1e-6, y0, stepsize_controller=steps, max_steps=100_000
        )

    y0 = jnp.array(start)
    found, least = run(y0, tolerance), np.inf
    for _ in range(3):
        begin = time.perf_counter()
        found = jax.block_until_ready(run(y0, tolerance))
        least = min(least, time.perf_counter() - begin)
    return int(found.stats["num_accepted_steps"]), found.ys[-1], least


def main(smoke):
    tolerances = [1e-4] if smoke else [1e-4, 1e-6, 1e-8]
    problems = dict([next(reversed(PROBLEMS.items()))]) if smoke else PROBLEMS
    print(
        "| problem | tolerance | `Radau`: steps | digits | ms | Kvaerno5: steps | digits | ms |",
        end="",
    )
    print(" scipy: steps |\n|---|---|---|---|---|---|---|---|---|")
    for name, (field, end, start, scale, exact) in problems.items():
        for tolerance in tolerances:
            row = [name, f"{tolerance:.0e}"]
            for solver in (dfc.Radau(), diffrax.Kvaerno5()):
                steps, y, seconds = solved(field, end, start, solver, tolerance, scale)
                digits = -np.log10(np.max(np.abs(y / np.array(exact) - 1)))
                row += [f"{steps:,}", f"{digits:.1f}", f"{1e3 * seconds:.1f}"]
            numpy_field = jax.jit(lambda t, y, field=field: field(t, y, None))
            found = solve_ivp(
                numpy_field, (0, end), start, "Radau", rtol=tolerance, atol=tolerance * scale
            )
            print("|", " | ".join([*row, f"{found.t.size - 1:,}"]), "|")


if __name__ == "__main__":
    main("--smoke" in sys.argv)
