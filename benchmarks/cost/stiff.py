"""Stiff ordinary equations by `Radau`, by Kvaerno5 of diffrax, and by the `Radau` of scipy.

For each tolerance: accepted steps, the digits of the worst component at the end, and the time of a
solve that is compiled. The reference is `Radau` at a tolerance of 1e-12.

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


# The field, the end, the start, and the absolute tolerance over the relative one.
PROBLEMS = {
    "van der Pol, 1e6": (van_der_pol, 2.0, [2.0, 0.0], 1e-2),
    "Robertson": (robertson, 1e11, [1.0, 0.0, 0.0], 1e-6),
    "HIRES": (hires, 321.8122, [1.0, 0, 0, 0, 0, 0, 0, 0.0057], 1e-2),
}


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
    jax.block_until_ready(run(y0, tolerance))
    begin = time.perf_counter()
    found = jax.block_until_ready(run(y0, tolerance))
    return int(found.stats["num_accepted_steps"]), found.ys[-1], time.perf_counter() - begin


def main(smoke):
    tolerances = [1e-4] if smoke else [1e-4, 1e-6, 1e-8]
    problems = dict([next(reversed(PROBLEMS.items()))]) if smoke else PROBLEMS
    print(
        "| problem | tolerance | `Radau`: steps | digits | ms | Kvaerno5: steps | digits | ms |",
        end="",
    )
    print(" scipy: steps |\n|---|---|---|---|---|---|---|---|---|")
    for name, (field, end, start, scale) in problems.items():
        exact = solved(field, end, start, dfc.Radau(), 1e-12, scale)[1]
        for tolerance in tolerances:
            row = [name, f"{tolerance:.0e}"]
            for solver in (dfc.Radau(), diffrax.Kvaerno5()):
                steps, y, seconds = solved(field, end, start, solver, tolerance, scale)
                digits = -np.log10(np.max(np.abs(y / exact - 1)))
                row += [f"{steps:,}", f"{digits:.1f}", f"{1e3 * seconds:.1f}"]
            numpy_field = jax.jit(lambda t, y, field=field: field(t, y, None))
            found = solve_ivp(
                numpy_field, (0, end), start, "Radau", rtol=tolerance, atol=tolerance * scale
            )
            print("|", " | ".join([*row, f"{found.t.size - 1:,}"]), "|")


if __name__ == "__main__":
    main("--smoke" in sys.argv)
