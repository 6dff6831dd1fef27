"""F: mechanisms of the library of multibody benchmarks (M. González and others, IFToMM).

- A01: a pendulum of one metre and one kilogram, from rest beside its pivot, 10 s.
- A02: a row of N four-bar linkages, 2 N + 1 rods of one metre and one kilogram. Twice in a turn
  all rods lie in one line, and the Jacobian of the constraints loses rank. B0 starts at the top
  with 1 m/s. Here N is 2, for 10 s, as in OpenSim; the library asks for N = 40.
- A04: Bricard's mechanism, five rods of one metre and one kilogram with a square section of 0.1 m,
  six hinges, 10 s. It is over-constrained: counted naively it can not move, and it has one degree
  of freedom. Each rod is a place and a matrix here, 60 numbers under 66 constraints.

Published: the library's specification (A02), and OpenSim's times and largest change of the energy
(github.com/RehabEngGroup/MBSbenchmarksInOpenSim, commit c76fa61, an Intel i5-4570 of 2013; the
energy is read off a figure). The references are the equations in one angle at 1e-13 for A01 and
A02, and for A04 plain Dopri8 at 1e-12. The library's own curve of A04, read off a figure, has a
period of 5.0 s, z down to -0.50 and y up to -0.866.
"""

import itertools
import math

import common
import diffrax as dfx
import jax.numpy as jnp
import numpy as np

import diffrax_conserve as dfc

SOURCE = (
    "lim.ii.udc.es/mbsbenchmark, A02; github.com/RehabEngGroup/MBSbenchmarksInOpenSim, commit "
    "c76fa61, OpenSim 3.2"
)
# Seconds and the largest change of the energy in joules.
OPENSIM = {"A01": (0.637, None), "A02": (0.455, None), "A04": (0.258, 9e-7)}
GRAVITY = 9.81
MAX_STEPS = 2_000


def mechanism(masses, force, constraint, q0, v0):
    """The equations of motion of positions with diagonal masses, and what is kept."""

    def free(t, y, args):
        _q, v = y
        return v, force / masses * jnp.ones_like(v)

    def energy(t, y, args):
        q, v = y
        return jnp.sum(masses * v**2) / 2 - jnp.sum(force * q)

    joints = dfc.Constraint(lambda t, y, args: constraint(y[0]))
    rates = joints.derivative(free)
    field = dfc.tangent(free, rates, metric=(jnp.inf, masses))
    kept = {"joints": joints, "rates": rates, "energy": dfc.FirstIntegral(energy)}
    return field, kept, (jnp.asarray(q0), jnp.asarray(v0))


# ---- A01 and A02: in one angle ----


def one_angle(inertia, weight, angle, rate, times):
    """`inertia * angle'' = -weight * cos(angle)`, as places of the end of a rod of length one."""

    def field(t, y, args):
        return jnp.stack([y[1], -weight / inertia * jnp.cos(y[0])])

    tight = jnp.array(1e-13), jnp.array(1e-13)
    y0, saveat = jnp.array([angle, rate]), dfx.SaveAt(ts=jnp.asarray(times))
    angles = common.solve(field, dfx.Dopri8(), y0, times[-1], *tight, saveat).ys[:, 0]
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def pendulum():
    force = jnp.array([[0.0, -GRAVITY]])
    problem = mechanism(1.0, force, lambda q: q[0] @ q[0] - 1, [[-1.0, 0.0]], np.zeros((1, 2)))

    def reference(times):
        return one_angle(1.0, GRAVITY, np.pi, 0.0, times)

    return problem, lambda q: q[..., 0, :], reference, 10.0


def four_bars(windows, t1):
    """The unknowns are the ends of the upright rods, B0 to BN. Their mass matrix is that of rods
    with evenly spread mass; its Cholesky factor makes unknowns whose masses are one."""
    ends = windows + 1
    masses = np.diag([1 / 3] * ends)
    for i in range(windows):
        masses[i : i + 2, i : i + 2] += np.array([[2, 1], [1, 2]]) / 6
    factor = np.linalg.cholesky(masses)
    to_places = np.linalg.inv(factor.T)
    weights = np.full(ends, 1.5) - 0.5 * np.isin(np.arange(ends), (0, windows))
    feet = np.stack([np.arange(ends), np.zeros(ends)], axis=1)

    def constraint(z):
        places = to_places @ z
        upright, level = places - feet, places[1:] - places[:-1]
        return jnp.concatenate([jnp.sum(upright**2, 1), jnp.sum(level**2, 1)]) - 1

    force = jnp.asarray(np.linalg.solve(factor, weights[:, None] * [[0.0, -GRAVITY]]))
    q0 = factor.T @ (feet + np.array([0.0, 1.0]))
    v0 = factor.T @ np.broadcast_to([1.0, 0.0], (ends, 2))
    problem = mechanism(1.0, force, constraint, q0, v0)
    inertia, weight = ends / 3 + windows, GRAVITY * weights.sum()

    def reference(times):
        return one_angle(inertia, weight, np.pi / 2, -1.0, times)

    return problem, lambda z: (to_places @ z)[..., 0, :], reference, t1


# ---- A04: Bricard's mechanism ----

# A closed way along the edges of a cube, whose last edge, back to the origin, is the ground.
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, -1, 0], [1, -1, 1], [0, -1, 1], [0, 0, 1]], float)


def bricard():
    """The state of a rod: its centre, and the matrix of its rotation from the start, a column an
    axis. Its kinetic energy is a sum of squares of their rates: the mass, and the integrals of the
    squares of the coordinates along its axes."""
    along = CORNERS[1:] - CORNERS[:-1]
    centres = (CORNERS[1:] + CORNERS[:-1]) / 2
    moments = np.where(along != 0, 1 / 12, 0.1**2 / 12)
    masses = jnp.asarray(
        np.concatenate([np.ones((5, 1, 3)), np.repeat(moments[:, :, None], 3, 2)], 1)
    )
    # A hinge is perpendicular to both edges that meet there.
    edges = [CORNERS[0] - CORNERS[5], *along, CORNERS[0] - CORNERS[5]]
    hinges = np.array([np.cross(a, b) for a, b in itertools.pairwise(edges)])

    def constraint(q):
        place, matrix = q[:, 0], q[:, 1:]  # row k of `matrix` is where axis k of the rod points
        grams = matrix @ jnp.swapaxes(matrix, 1, 2) - jnp.eye(3)
        rows, columns = np.triu_indices(3)
        arm = jnp.einsum("ik,ikj->ij", along / 2, matrix)
        ends = jnp.concatenate([CORNERS[:1], place + arm])
        starts = jnp.concatenate([place - arm, CORNERS[5:]])
        turned = (
            jnp.einsum("ik,ikj->ij", hinges[:5], matrix),
            jnp.einsum("ik,ikj->ij", hinges[1:], matrix),
        )
        before = jnp.concatenate([hinges[:1], turned[1]])
        after = jnp.concatenate([turned[0], hinges[5:]])
        parts = (grams[:, rows, columns], ends - starts, before - after)
        return jnp.concatenate([part.ravel() for part in parts])

    force = jnp.zeros((5, 4, 3)).at[:, 0, 1].set(-GRAVITY)
    q0 = np.concatenate([centres[:, None], np.broadcast_to(np.eye(3), (5, 3, 3))], axis=1)
    problem = mechanism(masses, force, constraint, q0, np.zeros((5, 4, 3)))

    def corner(q):  # P3 of the library, the end of the second rod
        arm = np.einsum("k,...kj->...j", along[1] / 2, q[..., 1, 1:, :])
        return q[..., 1, 0, :] + arm

    return problem, corner, None, 10.0


def rows_of(name, made, programs, tolerances, smoke, metric=None):
    """All is judged at 201 times, as the library does it; saved states are projected like steps."""
    (field, manifold, y0), point, reference, t1 = made
    times = np.linspace(0, 0.5 if smoke else t1, 201)
    saveat, t1 = dfx.SaveAt(ts=jnp.asarray(times)), jnp.asarray(times[-1])
    projection = dfc.SimplifiedNewton(metric=metric, atol=1e-13)
    parts = {key: manifold[key] for key in ("joints", "rates")}
    keep = {"joints": parts, "joints and energy": manifold}
    solvers = {
        program: dfc.ManifoldProjection(dfx.Dopri8(), keep[program], projection=projection)
        if program in keep
        else dfx.Dopri8()
        for program in programs
    }

    def run(program, tolerance):
        both = jnp.array(tolerance), jnp.array(tolerance)
        return common.solve(field, solvers[program], y0, t1, *both, saveat, max_steps=MAX_STEPS)

    def tight():
        return point(np.asarray(run("plain", 1e-12).ys[0]))

    exact = reference(times) if reference else tight()
    rows, runs = [], {}
    for program, tolerance in itertools.product(programs, tolerances):
        found = run(program, tolerance)
        off = point(np.asarray(found.ys[0])) - exact
        drift = {key: common.largest(x) for key, x in dfc.drift(found, manifold).items()}
        row = dict(
            finished=bool(found.result == dfx.RESULTS.successful),
            steps=int(found.stats["num_accepted_steps"]),
            evaluations=common.evaluations(solvers[program], found.stats),
            violation=max(drift["joints"], drift["rates"]),
            energy=drift["energy"],
            error=float(np.max(np.abs(off))),
        )
        rows.append(dict(problem=name, program=f"Dopri8, {program}", tolerance=tolerance, **row))
        if row["finished"]:
            runs[len(rows) - 1] = lambda key=(program, tolerance): run(*key)
    times_of = common.timed(runs, smoke)
    for i, row in enumerate(rows):
        row["seconds"] = times_of.get(i)
        common.show(row)
    curve = dict(
        times=times[::10].tolist(), point=exact[::10].tolist(), lowest=exact.min(0).tolist()
    )
    return rows, curve | dict(highest=exact.max(0).tolist())


def measure(smoke):
    if smoke:
        rows, _ = rows_of("A01", pendulum(), ("joints",), (1e-6,), True)
        return dict(rows=rows)
    rows, curves, two = [], {}, (1e-6, 1e-9)
    for name, made, programs, metric in (
        ("A01", pendulum(), ("plain", "joints"), None),
        ("A02, N = 2", four_bars(2, 10.0), ("plain", "joints", "joints and energy"), None),
        ("A04", bricard(), ("plain", "joints"), 1.0),
    ):
        found, curves[name] = rows_of(name, made, programs, two, False, metric)
        rows += found
    return dict(source=SOURCE, opensim=OPENSIM, rows=rows, curves=curves)


# ---- The page ----


def table(results):
    heads = (
        "problem",
        "program",
        "tolerance",
        "error, m",
        "violation",
        "energy",
        "steps",
        "seconds",
    )
    keys = ("error", "violation", "energy", "steps", "seconds")
    published = [
        (name, "OpenSim, published", "", "", "", f"{energy:.0e} J" if energy else "", "", seconds)
        for name, (seconds, energy) in results["opensim"].items()
    ]
    rows = [
        (
            *(x["problem"], x["program"], f"{x['tolerance']:.0e}"),
            *((x[key] for key in keys) if x["finished"] else ("fails", "", "", x["steps"], "")),
        )
        for x in results["rows"]
    ]
    return common.markdown(heads, [*published, *rows])


def verdicts(results):
    for name, (seconds, _) in results["opensim"].items():
        mine = [
            x
            for x in results["rows"]
            if x["problem"].split(", N = 2")[0] == name and x["program"] == "Dopri8, joints"
        ]
        row, who = f"mechanisms, {name}", "OpenSim"
        what = f"seconds (other machine), tolerance {mine[0]['tolerance']:.0e}"
        yield common.Verdict(row, what, who, seconds, mine[0]["seconds"] or math.inf)


def main(argv=None):
    return common.main("mechanisms", __doc__, measure, argv)


if __name__ == "__main__":
    main()
