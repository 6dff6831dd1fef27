"""B: the pages on conservation of energy of SciMLBenchmarks and of ProbNumDiffEq (Julia).

1. SciMLBenchmarks, Hénon-Heiles and the quadrupole boson Hamiltonian to t = 1,000: the largest
   error of the energy, steps and seconds of Vern9 with and without the `ManifoldProjection` of
   DiffEqCallbacks, of the symplectic KahanLi8 and SofSpa10 in steps of 0.01, and of DPRKN12, which
   is for equations of second order; adaptive ones at 1e-14. The figures are those of the output of
   2024, in place, Julia 1.10.5 on an AMD EPYC 7502, from the first run that compiles nothing.
2. ProbNumDiffEq, "Second Order ODEs and Energy Preservation": Hénon-Heiles to t = 1,000 at Julia's
   default tolerances, where EK1 loses energy from 0.12967 to 0.12899, and a filter's update on the
   energy mends it.

Julia does not run here, so its times are of another machine. heyoka runs beside ours. The states
are judged by heyoka at tolerance 1e-20, below roundoff.
"""

import common
import diffrax as dfx
import jax.numpy as jnp
import numpy as np

import diffrax_conserve as dfc

SOURCE = (
    "SciMLBenchmarksOutput, markdown/DynamicalODE, commit 0b902c2b; "
    "ProbNumDiffEq.jl, docs/src/tutorials/dynamical_odes.md, commit 4c6cf295"
)
# Largest error of the energy, steps and seconds to t = 1,000.
PUBLISHED = {
    "henon-heiles": {
        "Vern9 with ManifoldProjection": (4.19e-15, 9_330, 0.073),
        "KahanLi8": (1.82e-14, 100_000, 0.072),
        "SofSpa10": (2.80e-14, 100_000, 0.101),
        "Vern9": (4.19e-15, 9_329, 0.035),
        "DPRKN12": (8.60e-16, 3_786, 0.0057),
    },
    "quadrupole boson": {
        "Vern9 with ManifoldProjection": (1.85e-13, 48_618, 0.494),
        "KahanLi8": (1.05e-11, 100_000, 0.078),
        "SofSpa10": (1.51e-11, 100_000, 0.115),
        "Vern9": (4.16e-12, 48_622, 0.174),
        "DPRKN12": (3.20e-12, 21_874, 0.032),
    },
}
ENERGY_OF_EK1 = (0.12967, 0.12899)
A, B, D = 1.0, 0.55, 0.4
LOOSE = (1e-3, 1e-6)  # Julia's reltol and abstol


# Each of (q, p): the Hamiltonian's potential and its force, of numbers or of heyoka's expressions.


def henon_heiles(x, y):
    return (x * x + y * y) / 2 + x * x * y - y * y * y / 3


def henon_heiles_force(x, y):
    return -x - 2 * x * y, y * y - y - x * x


def boson(x, y):
    square = x * x + y * y
    return A / 2 * square + B / 2**0.5 * x * (3 * y * y - x * x) + D / 4 * square * square


def boson_force(x, y):
    square = x * x + y * y
    first = -A * x - 3 * B / 2**0.5 * (y * y - x * x) - D * x * square
    return first, -y * (A + 3 * 2**0.5 * B * x + D * square)


PROBLEMS = {
    "henon-heiles": (henon_heiles, henon_heiles_force, [0.1, 0.0, 0.0, 0.5]),
    "quadrupole boson": (boson, boson_force, [4.919080920016389, 2.836942666663649, 0.0, 0.0]),
    "henon-heiles, ProbNumDiffEq": (henon_heiles, henon_heiles_force, [0.0, 0.1, 0.5, 0.0]),
}


def heyoka(problem, tolerance, times):
    import heyoka as hy

    _, force, start = PROBLEMS[problem]
    variables = hy.make_vars("x", "y", "u", "v")
    x, y, u, v = variables
    system = list(zip(variables, (u, v, *force(x, y)), strict=True))
    integrator = hy.taylor_adaptive(system, start, tol=tolerance)

    def run():
        integrator.time, integrator.state[:] = 0.0, start
        return integrator.propagate_grid(times)

    return run


def energies(problem, states):
    x, y, u, v = np.moveaxis(np.asarray(states), -1, 0)
    return (u**2 + v**2) / 2 + PROBLEMS[problem][0](x, y)


def rows_of(problem, settings, smoke):
    """Ours at all `settings` (solver, rtol, atol), and heyoka."""
    potential, force, start = PROBLEMS[problem]
    t1 = 20.0 if smoke else 1000.0
    times, y0 = np.linspace(0, t1, 101), jnp.array(start)
    manifold = dfc.FirstIntegral(
        lambda t, y, args: (y[2] ** 2 + y[3] ** 2) / 2 + potential(y[0], y[1])
    )

    def field(t, y, args):
        return jnp.stack([y[2], y[3], *force(y[0], y[1])])

    try:
        exact = heyoka(problem, 1e-20, times)()[-1]
    except ImportError:
        print("heyoka is not installed")
        exact = None
    saveat, runs, rows, solvers = dfx.SaveAt(ts=jnp.asarray(times)), {}, [], {}
    for inner, projected, rtol, atol in settings:
        if (inner, projected) not in solvers:
            solver = dfc.ManifoldProjection(inner, manifold) if projected else inner
            solvers[inner, projected] = solver
        solver = solvers[inner, projected]
        both = jnp.array(rtol), jnp.array(atol)
        _, path, row = common.counted(field, solver, manifold, y0, t1, *both, max_steps=150_000)
        used = np.isfinite(np.asarray(path.ts))
        states = np.asarray(path.ys)[used]
        off = np.abs(energies(problem, states) - energies(problem, np.array(start)))
        saved = common.solve(field, solver, y0, t1, *both, saveat).ys
        row |= dict(energy=float(np.max(off)), end=float(energies(problem, saved[-1])))
        if exact is not None:
            row["error"] = float(np.max(np.linalg.norm(np.asarray(saved) - exact, axis=1)))
        name = type(inner).__name__ + (" projected" if projected else "")
        rows.append(dict(problem=problem, program=name, rtol=rtol, atol=atol, **row))
        runs[len(rows) - 1] = lambda solver=solver, both=both: common.solve(
            field, solver, y0, t1, *both, saveat
        )
    if exact is not None:
        for tolerance in (1e-6, 2.0**-52):
            run = heyoka(problem, tolerance, times)
            _, _, _, steps, _, states = run()
            row = dict(problem=problem, program="heyoka", rtol=tolerance, steps=int(steps))
            off = np.abs(energies(problem, states) - energies(problem, np.array(start)))
            row |= dict(energy=float(np.max(off)), end=float(energies(problem, states[-1])))
            row["error"] = float(np.max(np.linalg.norm(states - exact, axis=1)))
            runs[len(rows)] = run
            rows.append(row)
    for i, seconds in common.timed(runs, smoke).items():
        rows[i]["seconds"] = seconds
        common.show(rows[i])
    return rows


def measure(smoke):
    tsit5, dopri8 = dfx.Tsit5(), dfx.Dopri8()
    loose = [(tsit5, projected, *LOOSE) for projected in (False, True)]
    if smoke:
        return dict(rows=rows_of("henon-heiles, ProbNumDiffEq", loose[1:], smoke))
    tight = [(dopri8, projected, x, x) for projected in (False, True) for x in (1e-10, 1e-14)]
    rows = rows_of("henon-heiles", tight, smoke) + rows_of("quadrupole boson", tight, smoke)
    rows += rows_of("henon-heiles, ProbNumDiffEq", loose, smoke)
    return dict(source=SOURCE, published=PUBLISHED, ek1=ENERGY_OF_EK1, rows=rows)


# ---- The page ----


def table(results, problem="henon-heiles"):
    heads = (
        "program",
        "tolerance",
        "error of the energy",
        "steps",
        "seconds",
        "error of the state",
    )
    rows = [
        (f"{name}, published", "", energy, steps, seconds, None)
        for name, (energy, steps, seconds) in results["published"].get(problem, {}).items()
    ]
    rows += [
        (x["program"], f"{x['rtol']:.0e}", x["energy"], x["steps"], x["seconds"], x["error"])
        for x in results["rows"]
        if x["problem"] == problem
    ]
    return common.markdown(heads, rows)


def loose_table(results):
    heads = ("program", "steps", "energy at t = 1,000", "error of the energy", "error of the state")
    first = ("EK1, published", None, f"{results['ek1'][1]:.5f}", None, None)
    rows = [
        (x["program"], x["steps"], f"{x['end']:.5f}", x["energy"], x["error"])
        if x["finished"]
        else (x["program"], x["steps"], "fails", None, None)
        for x in results["rows"]
        if x["problem"].endswith("ProbNumDiffEq") and x["program"] != "heyoka"
    ]
    return common.markdown(heads, [first, *rows])


def verdicts(results):
    for problem, published in results["published"].items():
        rows = {(x["program"], x["rtol"]): x for x in results["rows"] if x["problem"] == problem}
        mine, row = rows["Dopri8 projected", 1e-14], f"SciMLBenchmarks, {problem}"
        for who in ("Vern9 with ManifoldProjection", "DPRKN12"):
            energy, _, seconds = published[who]
            yield common.Verdict(row, "error of the energy", who, energy, mine["energy"])
            yield common.Verdict(row, "seconds (other machine)", who, seconds, mine["seconds"])
        heyoka = rows["heyoka", 2.0**-52]
        for what in ("error", "seconds"):
            yield common.Verdict(row, f"{what}, tight", "heyoka", heyoka[what], mine[what])
    start, end = results["ek1"]
    mine = next(x for x in results["rows"] if x["program"] == "Tsit5 projected")
    what = "change of the energy at default tolerances"
    yield common.Verdict("ProbNumDiffEq, henon-heiles", what, "EK1", start - end, mine["energy"])


def main(argv=None):
    return common.main("julia_energy", __doc__, measure, argv)


if __name__ == "__main__":
    main()
