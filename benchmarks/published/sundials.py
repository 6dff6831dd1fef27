"""A: the two examples of SUNDIALS that project, the pendulum and the particle on a circle.

The published figures are those of `examples/cvode/serial/cvPendulum_dns.out` and
`cvParticle_dns.out` of SUNDIALS (github.com/LLNL/sundials): BDF, a projection in closed form. The
pendulum starts at rest beside its pivot. The strength of gravity makes its period 2, so that after
30 seconds it is back at rest at its start: there the exact state is known. The particle goes round
a hundred times; SUNDIALS' example gives CVODE the transpose of its Jacobian, which costs it steps,
so CVODE is run with the true one, and once as in the example.

Beside ours run CVODE itself, with the same projection, by a small C program (Debian:
libsundials-dev), and scikit-sundae's CVODE, whose bindings have no projection. Ours keep what
SUNDIALS keeps, the length and its rate; "and energy" the energy too.
"""

import ctypes
import math
from pathlib import Path

import common
import diffrax as dfx
import jax.numpy as jnp
import measuring
import numpy as np

import diffrax_conserve as dfc

SOURCE = "SUNDIALS, examples/cvode/serial, commit c8dabcea"
GRAVITY = 13.750371636040746
LIBRARIES = [f"sundials_{name}" for name in ("cvode", "nvecserial", "sunlinsoldense")]
TURNS = 100

# Tolerance: error of v_y at the end, violation, steps, evaluations, with and without projection.
PENDULUM = {
    1e-5: ((8.01e-2, 0.0, 1421, 1663 + 96), (2.10, 6.19e-4, 1549, 1757 + 112)),
    1e-6: ((1.99e-2, 0.0, 2089, 2336 + 140), (1.00, 7.05e-5, 2221, 2502 + 156)),
    1e-7: ((3.51e-3, 2.22e-16, 3013, 3293 + 204), (1.11, 6.77e-4, 3236, 3526 + 228)),
    1e-8: ((5.99e-4, 0.0, 4295, 4728 + 292), (1.95e-1, 5.35e-5, 4600, 4962 + 312)),
    1e-9: ((7.79e-5, 1.11e-16, 6542, 7056 + 436), (3.90e-2, 5.67e-6, 6661, 7123 + 448)),
}
PARTICLE = {1e-4: ((6.392827e-2, 0.0, 4131, 6030), None)}


def pendulum(t, y, args):
    x, z, u, v = y
    tension = u**2 + v**2 - GRAVITY * z
    return jnp.stack([u, v, -tension * x, -tension * z - GRAVITY])


def particle(t, y, args):
    return jnp.stack([-y[1], y[0]])


LENGTH = dfc.Constraint(lambda t, y, args: y[0] ** 2 + y[1] ** 2 - 1)
RATE = dfc.Constraint(lambda t, y, args: y[0] * y[2] + y[1] * y[3])
ENERGY = dfc.FirstIntegral(lambda t, y, args: (y[2] ** 2 + y[3] ** 2) / 2 + GRAVITY * y[1])

# Field, start, end time, what is kept, atol of rtol, the component that is judged, published, and
# whether the error estimate is projected.
PROBLEMS = {
    "pendulum": dict(
        field=pendulum,
        y0=np.array([1.0, 0.0, 0.0, 0.0]),
        t1=30.0,
        kept={"": (LENGTH, RATE), " and energy": (LENGTH, RATE, ENERGY)},
        atol=lambda rtol: rtol,
        judged=3,
        published=PENDULUM,
        more=(1e-3, 1e-4),
        define="-DPENDULUM",
        project_error=True,
    ),
    "particle": dict(
        field=particle,
        y0=np.array([1.0, 0.0]),
        t1=2 * math.pi * TURNS,
        kept={"": (LENGTH,)},
        atol=lambda rtol: 1e-5 * rtol,
        judged=1,
        published=PARTICLE,
        more=(1e-3, 1e-5, 1e-6, 1e-7, 1e-8),
        define="-DPARTICLE",
        as_published=("-DPARTICLE", "-DTRANSPOSED"),
        project_error=False,
    ),
}


def measure(smoke):
    rows = []
    for name, problem in PROBLEMS.items():
        tolerances = [*problem["more"], *problem["published"]]
        if smoke:
            problem, tolerances = problem | {"t1": 2.0}, list(problem["published"])[:1]
        rows += published(name, problem)
        found = [*ours(problem, tolerances, smoke), *cvode(problem, tolerances)]
        runs = {i: run for i, (row, run) in enumerate(found) if row["finished"]}
        times = common.timed(runs, smoke)
        for i, (row, _) in enumerate(found):
            rows.append(dict(problem=name, **row, seconds=times.get(i)))
            common.show(rows[-1])
    return dict(source=SOURCE, rows=rows)


def published(name, problem):
    for tolerance, pair in problem["published"].items():
        for projected, numbers in zip((True, False), pair, strict=True):
            if numbers is not None:
                error, violation, steps, evaluations = numbers
                yield dict(
                    problem=name,
                    program=f"CVODE, {'projected' if projected else 'plain'}, published",
                    tolerance=tolerance,
                    error=error,
                    violation=violation,
                    steps=steps,
                    evaluations=evaluations,
                )


def ours(problem, tolerances, smoke):
    solvers = {}
    for inner in (dfx.Tsit5(),) if smoke else (dfx.Tsit5(), dfx.Dopri8()):
        name = type(inner).__name__
        solvers[f"{name}, plain"] = inner
        for what, manifold in problem["kept"].items():
            solvers[f"{name}, projected{what}"] = dfc.ManifoldProjection(inner, manifold)
    field, t1, manifold = problem["field"], problem["t1"], problem["kept"][""]
    y0 = jnp.asarray(problem["y0"])
    for name, solver in solvers.items():
        for rtol in tolerances:
            atol = problem["atol"](rtol)
            tolerance = jnp.array(rtol), jnp.array(atol)
            kept = getattr(solver, "manifold", manifold)
            end, _, row = common.counted(field, solver, kept, y0, t1, *tolerance, max_steps=20_000)

            def run(solver=solver, tolerance=tolerance):
                return common.solve(field, solver, y0, t1, *tolerance, dfx.SaveAt(t1=True))

            row["error"] = error(problem, end) if row["finished"] else math.inf
            yield dict(program=name, tolerance=rtol, **row), run


def error(problem, end):
    """Of the component that the published table has; both motions are periodic."""
    j = problem["judged"]
    return abs(float(end[j] - problem["y0"][j]))


def cvode(problem, tolerances):
    yield from sundae(problem, tolerances)
    for projected in (True, False):
        name = f"CVODE, {'projected' if projected else 'plain'}, here"
        yield from compiled(name, problem, tolerances, projected, problem["define"])
    if "as_published" in problem:
        name, options = "CVODE, projected, here, their Jacobian", problem["as_published"]
        yield from compiled(name, problem, list(problem["published"]), True, *options)


def compiled(name, problem, tolerances, projected, *options):
    source = Path(__file__).parent / "cvode.c"
    library = measuring.c_library(source, *options, libraries=tuple(LIBRARIES))
    if library is None:
        print("CVODE in C is left out: it needs a C compiler and libsundials-dev")
        return
    pointer = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")
    library.integrate.argtypes = [pointer, *[ctypes.c_double] * 3, *[ctypes.c_int] * 2]
    library.integrate.argtypes += [ctypes.POINTER(ctypes.c_long)]
    for rtol in tolerances:
        counts = (ctypes.c_long * 3)()

        def run(rtol=rtol, counts=counts):
            y, tolerance = problem["y0"].copy(), (rtol, problem["atol"](rtol))
            too = problem["project_error"]
            if library.integrate(y, problem["t1"], *tolerance, projected, too, counts):
                raise RuntimeError("CVODE failed")
            return y

        end = run()
        row = dict(
            program=name,
            tolerance=rtol,
            error=error(problem, end),
            finished=True,
            steps=counts[0],
            evaluations=counts[1] + counts[2],
            violation=abs(end[0] ** 2 + end[1] ** 2 - 1),
        )
        yield row, run


def sundae(problem, tolerances):
    try:
        from sksundae.cvode import CVODE
    except ImportError:
        print("scikit-sundae is not installed")
        return

    def rates(t, y, f):
        if len(y) == 2:
            f[0], f[1] = -y[1], y[0]
            return
        x, z, u, v = y
        tension = u**2 + v**2 - GRAVITY * z
        f[0], f[1], f[2], f[3] = u, v, -tension * x, -tension * z - GRAVITY

    for rtol in tolerances:
        tolerance = dict(rtol=rtol, atol=problem["atol"](rtol), max_num_steps=10**6)

        def run(tolerance=tolerance):
            # The state at the second of two times lies on a step, not between two.
            solver = CVODE(rates, method="BDF", **tolerance)
            return solver.solve(np.array([0.0, problem["t1"]]), problem["y0"])

        found = run()
        end = found.y[-1]
        row = dict(
            program="CVODE, plain, scikit-sundae",
            tolerance=rtol,
            error=error(problem, end),
            finished=bool(found.success),
            evaluations=int(found.nfev),
            violation=abs(end[0] ** 2 + end[1] ** 2 - 1),
        )
        yield row, run


# ---- The page ----


def table(results, problem="pendulum", tolerances=(1e-5, 1e-9)):
    heads = ("program", "tolerance", "error at the end", "violation", "steps", "evaluations", "ms")
    wanted = [
        "CVODE, projected, published",
        "CVODE, projected, here",
        "CVODE, plain, here",
        "Tsit5, projected",
        "Dopri8, projected",
        "Dopri8, projected and energy",
    ]
    rows = [
        row
        for name in wanted
        for row in results["rows"]
        if row["program"] == name and row["problem"] == problem and row["tolerance"] in tolerances
    ]
    return common.markdown(
        heads,
        (
            (
                row["program"],
                f"{row['tolerance']:.0e}",
                row["error"],
                row["violation"],
                row.get("steps"),
                row["evaluations"],
                1e3 * row["seconds"] if row.get("seconds") else None,
            )
            for row in rows
        ),
    )


def verdicts(results):
    """Of our programs the one with the fewest evaluations among those that are as accurate."""
    for problem, tolerance in (("pendulum", 1e-5), ("pendulum", 1e-9), ("particle", 1e-4)):
        rows = [row for row in results["rows"] if row["problem"] == problem]
        theirs = [x for x in rows if x["program"].startswith("CVODE, projected")]
        theirs = [x for x in theirs if x["tolerance"] == tolerance]
        goal = theirs[0]["error"]
        mine = [x for x in rows if ", projected" in x["program"] and "CVODE" not in x["program"]]
        mine = [x for x in mine if x["error"] <= goal and x["finished"]]
        for what in ("evaluations", "seconds"):
            other = [x[what] for x in theirs if x.get(what)]
            if other:
                yield common.Verdict(
                    f"SUNDIALS, {problem}",
                    f"{what} to the error {common.cell(goal)}",
                    "CVODE",
                    min(other),
                    min((x[what] for x in mine), default=math.inf),
                )


def main(argv=None):
    return common.main("sundials", __doc__, measure, argv)


if __name__ == "__main__":
    main()
