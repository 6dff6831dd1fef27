"""F: mechanisms of the library of multibody benchmarks (M. González and others, IFToMM).

- A01: a pendulum of one metre and one kilogram, from rest beside its pivot, 10 s.
- A02: a row of N four-bar linkages, 2 N + 1 rods of one metre and one kilogram. Twice in a turn
  all rods lie in one line, and the Jacobian of the constraints loses rank. B0 starts at the top
  with 1 m/s. Here N is 2, for 10 s, as in OpenSim; the library asks for N = 40.
- A03: Andrews' mechanism, seven bodies in a plane, a motor of 0.033 N m and a spring, 0.05 s. Each
  body is a place and an angle here, 21 numbers under 20 constraints.
- A04: Bricard's mechanism, five rods of one metre and one kilogram with a square section of 0.1 m,
  six hinges, 10 s. It is over-constrained: counted naively it can not move, and it has one degree
  of freedom. Each rod is a place and a matrix here, 60 numbers under 66 constraints.

Published: the library's specification (A02), and OpenSim's times and largest change of the energy
(github.com/RehabEngGroup/MBSbenchmarksInOpenSim, commit c76fa61, an Intel i5-4570 of 2013; the
energy is read off a figure). The references are the equations in one angle at 1e-13 for A01 and
A02, and for A03 and A04 plain Dopri8 at 1e-12. The data of A03 are those of the test set of Lioen
and de Swart (CWI, 1999), which publishes the angles after 0.03 s. The library's own curve of A04,
read off a figure, has a period of 5.0 s, z down to -0.50 and y up to -0.866.
"""

import itertools
import math

import common
import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_conserve as dfc

SOURCE = (
    "lim.ii.udc.es/mbsbenchmark, A02; github.com/RehabEngGroup/MBSbenchmarksInOpenSim, commit "
    "c76fa61, OpenSim 3.2"
)
# Seconds and the largest change of the energy in joules.
OPENSIM = dict(A01=(0.637, None), A02=(0.455, None), A03=(0.384, None), A04=(0.258, 9e-7))
GRAVITY = 9.81
MAX_STEPS = 2_000


def mechanism(masses, potential, constraint, q0, v0):
    """The equations of motion of positions with diagonal masses, and what is kept."""

    def free(t, y, args):
        q, v = y
        return v, -jax.grad(potential)(q) / masses

    def energy(t, y, args):
        q, v = y
        return jnp.sum(masses * v**2) / 2 + potential(q)

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
    def potential(q):
        return GRAVITY * q[0, 1]

    problem = mechanism(1.0, potential, lambda q: q[0] @ q[0] - 1, [[-1.0, 0.0]], np.zeros((1, 2)))

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

    def potential(z):
        return GRAVITY * weights @ (to_places @ z)[:, 1]

    q0 = factor.T @ (feet + np.array([0.0, 1.0]))
    v0 = factor.T @ np.broadcast_to([1.0, 0.0], (ends, 2))
    problem = mechanism(1.0, potential, constraint, q0, v0)
    inertia, weight = ends / 3 + windows, GRAVITY * weights.sum()

    def reference(times):
        return one_angle(inertia, weight, np.pi / 2, -1.0, times)

    return problem, lambda z: (to_places @ z)[..., 0, :], reference, t1


# ---- A03: Andrews' mechanism ----

A, B, C = np.array([[-0.06934, -0.00227], [-0.03635, 0.03273], [0.014, 0.072]])
MASSES = np.array([0.04325, 0.00365, 0.02373, 0.00706, 0.0705, 0.00706, 0.05498])
INERTIAS = np.array([2.194, 0.441, 5.255, 0.5667, 11.69, 0.5667, 19.12]) * 1e-6
CRANK, ROD, COUPLER, SIDE, ARM = 0.007, 0.028, 0.02, 0.035, 0.04
# The angles of the bodies K1 to K7 at the start, and after 0.03 s as published: beta, beta + theta,
# gamma, phi + delta, delta, omega + epsilon, epsilon.
START = [-0.06171389001427645, -0.06171389001427645, 0.4552798191630703, 0.7100333697097284,
         0.4873649795438426, 1.0078790543839361, 1.2305474445498212]  # fmt: skip
PUBLISHED = [15.81077119629904, 0.05440013645606, 0.04082224013073101, -0.0103201504421644,
             0.5244099658805304, 1.582810857464958, 1.048080741042263]  # fmt: skip


def turned(angle, x, y):
    """The vector (x, y) of a body that is turned by an angle."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([x * cos - y * sin, x * sin + y * cos])


def andrews():
    """The state is the centre and the angle of each body."""

    def centres(angles):
        k1, k2, k3, k4, k5, k6, k7 = angles
        return jnp.stack([
            turned(k1, 0.00092, 0.0),
            turned(k1, CRANK, 0.0) + turned(k2, -0.0115, 0.0),
            B + turned(k3, 0.01043, -0.01874),
            A + turned(k5, ARM, 0.0) + turned(k4, 0.0, 0.01421 - COUPLER),
            A + turned(k5, 0.02308, 0.00916),
            A + turned(k7, 0.0, -ARM) + turned(k6, COUPLER - 0.01421, 0.0),
            A + turned(k7, -0.00449, -0.01228),
        ])  # fmt: skip

    def constraint(q):
        k1, k2, k3, k4, k5, k6, k7 = q[:, 2]
        joint = turned(k1, CRANK, 0.0) + turned(k2, -ROD, 0.0)
        ends = (
            B + turned(k3, 0.0, -SIDE),
            A + turned(k5, ARM, 0.0) + turned(k4, 0.0, -COUPLER),
            A + turned(k7, 0.0, -ARM) + turned(k6, COUPLER, 0.0),
        )
        loops = jnp.concatenate([joint - end for end in ends])
        return jnp.concatenate([(q[:, :2] - centres(q[:, 2])).ravel(), loops])

    def potential(q):
        spring = B + turned(q[2, 2], 0.02, -0.018) - C
        return 4530.0 * (jnp.sqrt(spring @ spring) - 0.07785) ** 2 / 2 - 0.033 * q[0, 2]

    def end_of_crank(q):
        beta = q[..., 0, 2]
        return CRANK * np.stack([np.cos(beta), np.sin(beta)], axis=-1)

    angles = jnp.asarray(START)
    q0 = jnp.concatenate([centres(angles), angles[:, None]], axis=1)
    masses = jnp.stack([MASSES, MASSES, INERTIAS], axis=1)
    problem = mechanism(masses, potential, constraint, q0, np.zeros((7, 3)))
    return problem, end_of_crank, None, 0.05


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

    def potential(q):
        return GRAVITY * jnp.sum(q[:, 0, 1])

    q0 = np.concatenate([centres[:, None], np.broadcast_to(np.eye(3), (5, 3, 3))], axis=1)
    problem = mechanism(masses, potential, constraint, q0, np.zeros((5, 4, 3)))

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
        ("A03", andrews(), ("plain", "joints", "joints and energy"), 1.0),
        ("A04", bricard(), ("plain", "joints"), 1.0),
    ):
        found, curves[name] = rows_of(name, made, programs, two, False, metric)
        rows += found
    (field, manifold, y0), *_ = andrews()
    solver = dfc.ManifoldProjection(dfx.Dopri8(), manifold)
    tight, end = jnp.array(1e-9), dfx.SaveAt(t1=True)
    angles = common.solve(field, solver, y0, jnp.array(0.03), tight, tight, end).ys[0][-1, :, 2]
    off = float(np.max(np.abs(angles - np.array(PUBLISHED))))
    return dict(source=SOURCE, opensim=OPENSIM, rows=rows, curves=curves, angles_off=off)


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
