"""Bounds by rejecting steps, as `ode15s` and CVODE have them, beside `clipped` and a projection.

For each problem and method: accepted and rejected steps, of CVODE evaluations of the field, the
error at the end, and where it fails, the time. Tolerances 1e-4 relative and 1e-8 absolute; of the
last problem 1e-1 and 1e-2. Then what bounds cost where no solution becomes negative: the time of a
solve over that of the plain one, and the error at the end.

Run: `python benchmarks/cost/reject.py` (a minute).
"""

import functools as ft

import diffrax
import jax
import jax.numpy as jnp
import measuring
import numpy as np
from sksundae.cvode import CVODE

import diffrax_conserve as dfc

jax.config.update("jax_enable_x64", True)


def tank(t, y, args):
    return -jnp.sqrt(y)


def chain(t, y, args):
    slow, fast = 2 * jnp.sqrt(y[0]), 1e4 * y[1]
    return jnp.stack([-slow, slow - fast, fast])


def reactions(t, y, args):
    return jnp.stack([-30 * y[0], 30 * y[0] - 2 * y[1], 2 * y[1]])


def three(t):
    """The exact solution of `reactions`."""
    first, second = np.exp(-30 * t), 30 / 28 * (np.exp(-2 * t) - np.exp(-30 * t))
    return np.array([first, second, 1 - first - second])


total = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y))
# The field, the start, the end, the state there, the manifold, solver and tolerances.
PROBLEMS = {
    "tank": (tank, [1.0], 3.0, np.zeros(1), (), diffrax.Kvaerno5(), 1e-4, 1e-8),
    "chain": (
        chain,
        [1.0, 0, 0],
        5.0,
        np.array([0, 0, 1.0]),
        total,
        diffrax.Kvaerno5(),
        1e-4,
        1e-8,
    ),
    "reactions": (reactions, [1.0, 0, 0], 0.5, three(0.5), total, diffrax.Bosh3(), 1e-1, 1e-2),
}


def epidemic(t, y, args):
    infected, recovered = 0.5 * y[0] * y[1], 0.1 * y[1]
    return jnp.stack([-infected, infected - recovered, recovered])


def robertson(t, y, args):
    first, second, third = 0.04 * y[0], 1e4 * y[1] * y[2], 3e7 * y[1] ** 2
    return jnp.stack([second - first, first - second - third, third])


# Solutions that stay positive without a bound: the field, the start, the end, and the solver.
POSITIVE = {
    "epidemic": (epidemic, [0.99, 0.01, 0.0], 100.0, diffrax.Tsit5()),
    "Robertson": (robertson, [1.0, 0.0, 0.0], 1e4, diffrax.Kvaerno5()),
}


def costs_of_bounds():
    within = dfc.SimplifiedNewton(lower=0.0)
    for name, (field, y0, t1, solver) in POSITIVE.items():
        methods = {
            "plain": solver,
            "bounds alone": dfc.ManifoldProjection(solver, (), projection=within),
            "total": dfc.ManifoldProjection(solver, total),
            "bounds and total": dfc.ManifoldProjection(solver, total, projection=within),
        }

        def end(solver, y0, tolerance, field=field, t1=t1):
            return diffrax.diffeqsolve(
                diffrax.ODETerm(field), solver, 0.0, t1, 1e-6, y0, max_steps=100_000,
                stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance / 1e3),
            ).ys[-1]  # fmt: skip

        y0 = jnp.array(y0)
        exact = end(solver, y0, 1e-11)
        runs = {
            method: ft.partial(jax.jit(ft.partial(end, chosen, tolerance=1e-6)), y0)
            for method, chosen in methods.items()
        }
        for run in runs.values():
            run()
        measured = measuring.take_turns(runs, 10)
        plain = measured["plain"].seconds
        for method, (seconds, answer) in measured.items():
            error = jnp.max(jnp.abs(answer - exact))
            print(f"{name}: {method}: {seconds / plain:.2f} times plain, error {error:.0e}")


def by_cvode(field, y0, t1, exact, rtol, atol, **bounds):
    compiled = jax.jit(field)

    def rhs(t, y, slope):
        slope[:] = np.asarray(compiled(t, y, None))

    found = CVODE(rhs, rtol=rtol, atol=atol, max_num_steps=5000, **bounds)
    solution = found.solve(np.array([0.0, t1]), np.array(y0))
    error = np.max(np.abs(solution.y[-1] - exact))
    end = f"error {error:.0e}" if solution.success else f"fails at {solution.t[-1]:.3f}"
    return f"{solution.nfev} evaluations, {end}"


def by_diffrax(field, y0, t1, exact, rtol, atol, solver):
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field), solver, 0.0, t1, 1e-6, jnp.array(y0), throw=False, max_steps=5000,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=atol),
        saveat=diffrax.SaveAt(steps=True),
    )  # fmt: skip
    accepted = int(solution.stats["num_accepted_steps"])
    steps = f"{accepted} + {solution.stats['num_rejected_steps']} steps"
    if solution.result != diffrax.RESULTS.successful:
        return f"{steps}, fails at {solution.ts[accepted - 1]:.3f}"
    error = np.max(np.abs(solution.ys[accepted - 1] - exact))
    ys = solution.ys[:accepted]
    matter = jnp.max(jnp.abs(jnp.sum(ys, axis=1) - 1))
    return f"{steps}, error {error:.0e}, smallest {jnp.min(ys):.0e}, total off by {matter:.0e}"


def main():
    for name, (field, y0, t1, exact, manifold, solver, *tolerances) in PROBLEMS.items():
        problem, n = (y0, t1, exact, *tolerances), len(y0)
        within = dfc.SimplifiedNewton(lower=0.0)
        rejecting = dfc.ManifoldProjection(solver, (), projection=within, max_correction=1e-6)
        moved = dfc.ManifoldProjection(solver, (), projection=within)
        projected = dfc.ManifoldProjection(solver, manifold, projection=within)
        clipped = dfc.clipped(field, lower=1e-30)
        signs = {"constraints_idx": list(range(n)), "constraints_type": [1] * n}
        print(f"{name}: CVODE: {by_cvode(field, *problem)}")
        print(f"{name}: CVODE, constraints: {by_cvode(field, *problem, **signs)}")
        for method, right_side, chosen in [
            ("plain", field, solver),
            ("rejected", field, rejecting),
            ("clipped, rejected", clipped, rejecting),
            ("clipped, bounds alone", clipped, moved),
            ("clipped, projected", clipped, projected),
        ]:
            print(f"{name}: {method}: {by_diffrax(right_side, *problem, chosen)}", flush=True)
    costs_of_bounds()


if __name__ == "__main__":
    main()
