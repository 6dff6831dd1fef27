"""C: homogeneous projection (B. K. Tapley, arXiv:2511.02131), on a peakon and on Kepler's problem.

The set-ups are those of the paper's repository (github.com/bentaps/homproj, commit e137aba7).

1. A peakon of speed 2 of the Camassa-Holm equation on 128 points of a period of 80, to t = 100, by
   DOP853 at tolerance 1e-5. Published: with both invariants 28.4 s and 35,306 evaluations; without
   projection, and with H2 alone, the step size falls to zero. The invariants are those that the
   repository projects on. Its space discretisation conserves neither exactly: the gradient in the
   equation has differences of another order than H2, and `check_invariance` says so. They are
   integrals of the partial differential equation, and the projection stabilises.
2. Kepler's problem with eccentricity 0.8 over ten periods, by DOP853 at tolerances from 1e-14 to
   1e-3, with the energy, the angular momentum and the component of the Laplace-Runge-Lenz vector
   along the apsides. The latter depends on the other two along the orbit, so ours are also run with
   the other component, which fixes the ellipse. The paper has figures, no numbers; so homproj and
   scipy are run here.
"""

import functools as ft
import math
import time
import warnings

import common
import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate

import diffrax_conserve as dfc

SOURCE = "B. K. Tapley, arXiv:2511.02131, and github.com/bentaps/homproj, commit e137aba7"
POINTS, PERIOD, SPEED = 128, 80.0, 2.0
PUBLISHED = [
    dict(program="homproj, H1 and H2", seconds=28.4, evaluations=35_306, steps=2_934, end=100.0),
    dict(program="homproj, H2", seconds=2.11, evaluations=3_566, steps=201, end=math.nan),
    dict(program="scipy, plain", seconds=2.25, evaluations=25_730, steps=1_996, end=math.nan),
]
TOLERANCES = (1e-3, 2.2e-7, 4.6e-11, 1e-14)


# ---- A peakon ----

DX = PERIOD / POINTS


def circulant(stencil):
    """The matrix of a difference formula with coefficients by offset, periodic."""
    return sum(c * np.roll(np.eye(POINTS), k, axis=1) for k, c in stencil.items())


FIRST = circulant({-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12}) / DX
SECOND = circulant({-2: -1 / 12, -1: 4 / 3, 0: -5 / 2, 1: 4 / 3, 2: -1 / 12}) / DX**2
FLOW = -np.linalg.solve(np.eye(POINTS) - SECOND, FIRST)


def peakon(t):
    """The exact wave, with its periodic images."""
    x = np.arange(POINTS) * DX - PERIOD / 2 - SPEED * t
    distance = np.abs((x + PERIOD / 2) % PERIOD - PERIOD / 2)
    return SPEED * (np.exp(-distance) + np.exp(distance - PERIOD))


def squared_slope(u, np=jnp):
    """The mean of the squares of the slopes to the left and to the right."""
    square = ((np.roll(u, -1) - u) / DX) ** 2
    return (square + np.roll(square, 1)) / 2


def camassa_holm(t, u, args, np=jnp):
    gradient = 1.5 * u**2 + squared_slope(u, np) / 2 - SECOND @ u**2 / 2
    return FLOW @ gradient


def h1(t, u, args, np=jnp):
    return DX / 2 * np.sum(u**2 + squared_slope(u, np))


def h2(t, u, args, np=jnp):
    return DX / 2 * np.sum(u**3 + u * squared_slope(u, np))


def peakon_rows(smoke):
    t1 = 2.0 if smoke else 100.0
    tolerance = jnp.array(1e-5)
    y0 = jnp.asarray(peakon(0.0))
    both = {"H1": dfc.FirstIntegral(h1), "H2": dfc.FirstIntegral(h2)}
    # All components of a field have one unit.
    euclidean = dfc.SimplifiedNewton(metric=1.0)
    project = ft.partial(dfc.ManifoldProjection, dfx.Dopri8(), projection=euclidean)
    solvers = {"H1 and H2": project(both)}
    if not smoke:
        solvers |= {"H2": project({"H2": both["H2"]}), "plain": dfx.Dopri8()}
    for name, solver in solvers.items():
        kept = getattr(solver, "manifold", both)
        end, path, row = common.counted(
            camassa_holm, solver, kept, y0, t1, tolerance, tolerance, max_steps=20_000
        )
        error = math.sqrt(DX) * float(jnp.linalg.norm(end - peakon(t1)))
        reached = float(jnp.max(jnp.where(jnp.isfinite(path.ts), path.ts, 0)))

        def run(solver=solver):
            return common.solve(
                camassa_holm, solver, y0, t1, tolerance, tolerance, dfx.SaveAt(t1=True)
            )

        seconds = common.timed({name: run}, smoke)[name] if row["finished"] else None
        yield dict(program=f"ours, {name}", **row, error=error, end=reached, seconds=seconds)
    for name, keep in {"homproj, H1 and H2": (h1, h2), "scipy, plain": ()}.items():
        yield theirs(name, lambda t, u: camassa_holm(t, u, None, np), t1, peakon(0.0), 1e-5, keep)


def theirs(name, field, t1, y0, tolerance, integrals, exact=peakon, mode="alternating"):
    """scipy's DOP853, with homproj's projection on the `integrals` if there are any."""
    options = dict(method="DOP853", rtol=tolerance, atol=tolerance)
    begin = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if integrals:
            import homproj

            found = homproj.solve_ivp(
                field,
                (0.0, t1),
                y0,
                invariants=[lambda *u, fn=fn: fn(0.0, np.array(u), None, np) for fn in integrals],
                max_iterations=1,
                itol=1e-12,
                mode=mode,
                **options,
            )
        else:
            found = scipy.integrate.solve_ivp(field, (0.0, t1), y0, **options)
    seconds = time.process_time() - begin
    judged = integrals or (h1, h2)
    values = [[fn(0.0, u, None, np) for u in found.y.T] for fn in judged]
    violation = max(np.max(np.abs(np.array(v) / v[0] - 1)) for v in values)
    return dict(
        program=name,
        finished=bool(found.success),
        steps=len(found.t) - 1,
        evaluations=int(found.nfev),
        violation=float(violation),
        error=math.sqrt(DX) * float(np.linalg.norm(found.y[:, -1] - exact(found.t[-1]))),
        end=float(found.t[-1]),
        seconds=seconds,
    )


# ---- Kepler's problem ----


def kepler(t, y, args, np=jnp):
    x, z, u, v = y
    pull = (x**2 + z**2) ** -1.5
    return np.stack([u, v, -x * pull, -z * pull])


def energy(t, y, args, np=jnp):
    return (y[2] ** 2 + y[3] ** 2) / 2 - 1 / np.sqrt(y[0] ** 2 + y[1] ** 2)


def momentum(t, y, args, np=jnp):
    return y[0] * y[3] - y[1] * y[2]


def lenz_x(t, y, args, np=jnp):
    return y[3] * momentum(t, y, args) - y[0] / np.sqrt(y[0] ** 2 + y[1] ** 2)


def lenz_y(t, y, args, np=jnp):
    return -y[2] * momentum(t, y, args) - y[1] / np.sqrt(y[0] ** 2 + y[1] ** 2)


def kepler_rows(smoke):
    eccentricity, t1 = 0.8, (2 if smoke else 20) * math.pi
    start = [1 - eccentricity, 0.0, 0.0, math.sqrt((1 + eccentricity) / (1 - eccentricity))]
    y0, kept = jnp.array(start), (energy, momentum)
    keep = {
        "plain": (),
        "H and L": kept,
        "H, L, A_x": (*kept, lenz_x),
        "H, L, A_y": (*kept, lenz_y),
    }
    if smoke:
        keep = {"H, L, A_x": (*kept, lenz_x)}
    runs, rows = {}, []
    for name, functions in keep.items():
        manifold = tuple(map(dfc.FirstIntegral, functions or kept))
        solver = dfc.ManifoldProjection(dfx.Dopri8(), manifold) if functions else dfx.Dopri8()
        for tolerance in TOLERANCES[: 1 if smoke else None]:
            both = (jnp.array(tolerance),) * 2
            end, _, row = common.counted(kepler, solver, manifold, y0, t1, *both, max_steps=8_000)
            row["error"] = float(jnp.linalg.norm(end - y0))
            rows.append(dict(program=f"ours, {name}", tolerance=tolerance, **row))
            runs[len(rows) - 1] = lambda solver=solver, both=both: common.solve(
                kepler, solver, y0, t1, *both, dfx.SaveAt(t1=True)
            )
    for i, seconds in common.timed(runs, smoke).items():
        rows[i]["seconds"] = seconds

    def field(t, y):
        return kepler(t, y, None, np)

    three = keep["H, L, A_x"]
    for tolerance in TOLERANCES[: 1 if smoke else None]:
        for name, functions in (("homproj, H, L, A_x", three), ("scipy, plain", ())):
            row = theirs(name, field, t1, start, tolerance, functions, lambda t: start, "joint")
            row["error"] /= math.sqrt(DX)
            if not functions:
                row.pop("violation")
            rows.append(dict(tolerance=tolerance, **row))
    return rows


def measure(smoke):
    peakons, orbits = [], []
    for row in peakon_rows(smoke):
        peakons.append(row)
        common.show(row)
    for row in kepler_rows(smoke):
        orbits.append(row)
        common.show(row)
    both = {"H1": dfc.FirstIntegral(h1), "H2": dfc.FirstIntegral(h2)}
    # Between two points of the grid: on a point the wave is symmetric, and all rates vanish.
    report = dfc.check_invariance(camassa_holm, both, jnp.asarray(peakon(0.1))[None])
    check = {entry.name: entry.defect for entry in report.entries}
    return dict(source=SOURCE, published=PUBLISHED, peakon=peakons, kepler=orbits, check=check)


# ---- The page ----


def table(results):
    heads = ("Camassa-Holm", "to t = 100", "steps", "evaluations", "violation", "error", "seconds")
    rows = [(f"{x['program']}, published", x) for x in results["published"]]
    rows += [(x["program"], x) for x in results["peakon"]]
    return common.markdown(
        heads,
        (
            (
                name,
                "yes" if x["end"] == 100 else f"stops at {x['end']:.0f}".replace(" at nan", ""),
                x["steps"],
                x["evaluations"],
                x.get("violation"),
                x.get("error"),
                x["seconds"],
            )
            for name, x in rows
        ),
    )


def kepler_table(results):
    heads = ("Kepler, e = 0.8", "tolerance", "error", "violation", "evaluations", "ms")
    rows = [
        (
            x["program"],
            f"{x['tolerance']:.1e}",
            x["error"],
            x.get("violation"),
            x["evaluations"],
            1e3 * x["seconds"],
        )
        for x in results["kepler"]
        if x["tolerance"] in TOLERANCES[1:3]
    ]
    return common.markdown(heads, rows)


def verdicts(results):
    ours = next(x for x in results["peakon"] if x["program"] == "ours, H1 and H2")
    theirs = results["published"][0]
    here = next(x for x in results["peakon"] if x["program"] == "homproj, H1 and H2")
    row = "homproj, Camassa-Holm, H1 and H2"
    failed = math.inf if not ours["finished"] else 1
    yield common.Verdict(
        row, "evaluations", "homproj", theirs["evaluations"], failed * ours["evaluations"]
    )
    yield common.Verdict(
        row, "seconds", "homproj, here", here["seconds"], ours["seconds"] or failed
    )
    yield common.Verdict(row, "error", "homproj, here", here["error"], ours["error"])
    for tolerance in TOLERANCES[1:3]:
        rows = {x["program"]: x for x in results["kepler"] if x["tolerance"] == tolerance}
        a, b = rows["homproj, H, L, A_x"], rows["ours, H, L, A_x"]
        what = f"at tolerance {tolerance:.1e}"
        row = "homproj, Kepler, H, L, A_x"
        yield common.Verdict(row, f"error {what}", "homproj", a["error"], b["error"])
        yield common.Verdict(row, f"seconds {what}", "homproj", a["seconds"], b["seconds"])


def main(argv=None):
    jax.config.update("jax_enable_x64", True)
    return common.main("homproj_paper", __doc__, measure, argv)


if __name__ == "__main__":
    main()
