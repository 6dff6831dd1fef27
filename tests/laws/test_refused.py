"""Nobody who is right is refused: near rest, in other units, from an equilibrium."""

from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve._fast.jaxprs import jaxprs_inside

from ..problems import kepler, kepler_energy, kepler_momentum, solve
from ..thinned import some_of

FIXED, LOOSE = dfx.ConstantStepSize(), dfx.PIDController(rtol=1e-4, atol=1e-7)


class Case(NamedTuple):
    """Solves that must succeed, but for those that are allowed to fail. `args` are those of each
    lane, `times` the end and the first step."""

    field: Any
    functions: Any
    y0: Any
    times: tuple[float, float]
    args: Any = None
    solver: dfx.AbstractSolver = dfx.Tsit5()
    controller: dfx.AbstractStepSizeController = FIXED
    projection: dfc.AbstractProjection = dfc.SimplifiedNewton()
    allowed: int = 0


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, 0, 0, None))
def okay(case, y0, args, times):
    t1, dt0 = times
    manifold = jax.tree.map(dfc.FirstIntegral, case.functions)
    solver = dfc.ManifoldProjection(case.solver, manifold, projection=case.projection)
    options = dict(stepsize_controller=case.controller, max_steps=4096, throw=False)
    sol = solve(case.field, solver, y0, t1=t1, dt0=dt0, args=args, **options)
    return dfx.is_okay(sol.result)


def failures(case, dtype):
    args = np.zeros(len(jax.tree.leaves(case.y0)[0])) if case.args is None else case.args
    y0, args, times = jax.tree.map(lambda x: jnp.asarray(x, dtype), (case.y0, args, case.times))
    return np.flatnonzero(~okay(case._replace(y0=None, args=None, times=None), y0, args, times))


def pendulum(t, y, args):
    return jnp.stack([y[1], -jnp.sin(y[0])])


def pendulum_energy(t, y, args):
    """From zero: the terms near one cancel, and its gradient does not show them."""
    return y[1] ** 2 / 2 + 1 - jnp.cos(y[0])


def vibrations(rng, centre, rests):
    """Small, in numbers far from zero, the velocity too: first steps are much too long, but short
    beside the state."""
    amplitude = max(abs(centre), 1) * 10 ** rng.uniform(-10, 0, 200)
    y0 = np.stack([centre + amplitude, centre + 0 * amplitude, rests + 0 * amplitude], axis=1)
    moved = lambda y: (y[0] - centre, y[1] - centre)  # noqa: E731
    field = lambda t, y, args: jnp.stack([moved(y)[1], -10 * moved(y)[0], 0 * y[2]])  # noqa: E731
    energy = lambda t, y, args: moved(y)[1] ** 2 / 2 + 5 * moved(y)[0] ** 2  # noqa: E731
    return Case(field, energy, y0, (60.0, 0.01), controller=dfx.PIDController(1e-2, 1e-2))


def elastic_walls(rng):
    """There a step is inaccurate, and its projection fails, until it is very short."""
    far = lambda y: jnp.maximum(jnp.abs(y[0]) - 1, 0)  # noqa: E731
    field = lambda t, y, args: jnp.stack([y[1], -args * jnp.sign(y[0]) * far(y)])  # noqa: E731
    energy = lambda t, y, args: y[1] ** 2 / 2 + args * far(y) ** 2 / 2  # noqa: E731
    y0 = np.stack([rng.uniform(-1, 1, 200), rng.normal(size=200)], axis=1)
    options = dict(args=10 ** rng.uniform(1, 6, 200), controller=dfx.PIDController(1e-5, 1e-8))
    return Case(field, energy, y0, (6.0, 0.01), allowed=3, **options)


def steady_rotations(rng, **options):
    """Where roundoff alone corrects by more than a step moves the state, and adaptive steps grow
    until their error is as large as the wobble."""
    inertia = np.array([1.0, 2.0, 3.0])
    of = lambda y: inertia.astype(y.dtype)  # noqa: E731
    field = lambda t, y, args: jnp.cross(y, y / of(y))  # noqa: E731
    kept = lambda t, y, args: (jnp.sum(y**2 / of(y)) / 2, jnp.sum(y**2) / 2)  # noqa: E731
    beside = 10 ** rng.uniform(-9, -1, (3, 300, 1)) * rng.normal(size=(3, 300, 3))
    y0 = (np.eye(3)[:, None] + beside).reshape(900, 3)
    return Case(field, kept, y0, (20.0, 0.02), **options)


def almost_circular(rng):
    """Multipliers of nearly parallel gradients are large, and cancel in the correction."""
    e, angle = 10 ** rng.uniform(-9, -1, 500), rng.uniform(0, 2 * np.pi, 500)
    radius, cos, sin = (1 - e**2) / (1 + e * np.cos(angle)), np.cos(angle), np.sin(angle)
    speed = 1 / np.sqrt(1 - e**2)
    y0 = [[radius * cos, radius * sin], [-speed * sin, speed * (e + cos)]]
    y0 = tuple(np.stack(part, axis=1) for part in y0)
    return Case(kepler, (kepler_energy, kepler_momentum), y0, (2 * np.pi, 2 * np.pi / 80))


def laplace_vector(t, y, args):
    q, p = y
    momentum = q[0] * p[1] - q[1] * p[0]
    return momentum * jnp.stack([p[1], -p[0]]) - q / jnp.sqrt(jnp.sum(q**2))


def with_laplace_vectors(rng):
    """Four integrals, of which three are independent. The first two are nearly parallel."""
    functions = kepler_energy, kepler_momentum, laplace_vector
    return Case(kepler, functions, almost_circular(rng).y0, (5.0, 0.01), solver=dfc.RK4())


def turning_tops(rng):
    """Of a symmetric top, steadily or almost: its four integrals are dependent at such states."""
    inertia, up = np.array([1.0, 1.0, 0.5]), np.array([0.0, 0.0, 1.0])
    split = lambda y: (y[:3], y[3:], y[:3] / inertia)  # noqa: E731

    def field(t, y, args):
        momentum, axis, rate = split(y)
        turned = jnp.cross(momentum, rate) + jnp.cross(axis, up)
        return jnp.concatenate([turned, jnp.cross(axis, rate)])

    def kept(t, y, args):
        momentum, axis, rate = split(y)
        energy = momentum @ rate / 2 + axis[2]
        return jnp.stack([energy, momentum @ axis, axis @ axis, momentum[2]])

    tilt, rate, zero = 0.7, 0.8, np.zeros(200)
    steady = [0, rate * np.sin(tilt), 1 / rate + rate * np.cos(tilt), 0, np.sin(tilt), np.cos(tilt)]
    beside = np.stack([10 ** rng.uniform(-16, -5, 200), *5 * [zero]], axis=1)
    return Case(field, kept, np.array(steady) + beside, (10.0, 0.05), solver=dfc.RK4())


def enzymes(rng):
    """Amounts that may be spent: near rest a step overshoots zero by its error."""

    def field(t, y, k):
        bound, loose, made = k[0] * y[0] * y[1], k[1] * y[2], k[2] * y[2]
        return jnp.stack([loose - bound, loose + made - bound, bound - loose - made, made])

    kept = lambda t, y, k: jnp.stack([y[1] + y[2], y[0] + y[2] + y[3]])  # noqa: E731
    y0, rates = np.zeros((100, 4)), 10 ** rng.uniform(-1, 1.5, (100, 3))
    y0[:, :2] = 10 ** rng.uniform(-3, 1, (100, 2))
    options = dict(controller=LOOSE, projection=dfc.SimplifiedNewton(lower=0.0))
    return Case(field, kept, y0, (5.0, 3e-3), rates, **options)


# Of N2 the well depth in hartree, inverse width and equilibrium length in units of the Bohr radius,
# reduced mass in electron masses.
NITROGEN = 0.3640, 1.424, 2.074, 12761.0
# Hartree in joules, Bohr radius in metres, electron mass in kilograms, room temperature in hartree.
SI, ROOM = (4.3597e-18, 5.2918e-11, 9.1094e-31), 9.5e-4


def stretched(y, args):
    _, width, length, _ = args
    return jnp.exp(-width * (y[0] - length))


def morse(t, y, args):
    depth, width, _, mass = args
    e = stretched(y, args)
    return jnp.stack([y[1] / mass, -2 * depth * width * e * (1 - e)])


def morse_energy(t, y, args):
    return y[1] ** 2 / (2 * args[3]) + args[0] * (1 - stretched(y, args)) ** 2


def bound_morse_energy(t, y, args):
    """The same energy from the dissociated molecule."""
    return morse_energy(t, y, args) - args[0]


def molecules(rng, energy, units):
    """From the equilibrium length, where the potential has no slope."""
    joule, metre, kilogram = units
    depth, width, length, mass = NITROGEN
    args = depth * joule, width / metre, length * metre, mass * kilogram
    # A thermal momentum, which may be small, but not so small that a length changes by few ulp.
    thermal = rng.normal(size=100)
    thermal = np.where(np.abs(thermal) < 0.05, 0.05, thermal)
    momentum = np.sqrt(args[3] * ROOM * joule) * thermal
    y0 = np.stack([np.full(100, args[2]), momentum], axis=1)
    period = 2 * np.pi / (args[1] * np.sqrt(2 * args[0] / args[3]))
    lanes = tuple(np.full(100, x) for x in args)
    return Case(morse, energy, y0, (3 * period, period / 40), lanes, solver=dfc.RK4())


def height(q):
    return 1 - jnp.cos(q)


height_with_rule = jax.custom_vjp(height)
height_with_rule.defvjp(lambda q: (height(q), q), lambda q, g: (g * jnp.sin(q),))
HEIGHTS = {
    "itself": height,
    "rule": height_with_rule,
    "checkpoint": jax.checkpoint(height),
    "cond": lambda q: lax.cond(q > 0, height, height, q),
    "scan": lambda q: lax.scan(lambda sum, q: (sum + height(q), None), 0 * q, q[None])[0],
    "single": lambda q: height(q.astype(jnp.float32)).astype(q.dtype),
}
SPRINGS = np.array([[1.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])


NUMBERS = np.arange(1.0, 9.0)


def determinant_energy(t, y, args):
    matrix = jnp.diag(NUMBERS * (1 + y[0] ** 2)) + 1e5
    return jnp.sum(y**2) / 2 + jnp.linalg.slogdet(matrix)[1] / 2


def in_determinant(t, y, args):
    a = 1 + y[0] ** 2
    return jnp.stack([y[1], -y[0] * (1 + 7 / a + 1 / (a + 1e5 * np.sum(1 / NUMBERS)))])


# Pendulums whose height is inside other operations, a determinant in whose elimination large
# numbers cancel, and a chain of springs far from the origin, where the products of the stiffness
# matrix cancel.
HIDDEN = {
    name: (pendulum, lambda t, y, args, fn=fn: y[1] ** 2 / 2 + fn(y[0]), 1e-3, 2)
    for name, fn in HEIGHTS.items()
} | {
    "determinant": (in_determinant, determinant_energy, 1.0, 2),
    "matrix": (
        lambda t, y, args: jnp.concatenate([y[3:], -SPRINGS @ y[:3]]),
        lambda t, y, args: (y[3:] @ y[3:] + y[:3] @ SPRINGS @ y[:3]) / 2, 100.0, 6,
    ),
}  # fmt: skip


def hidden(rng, name):
    field, energy, size, n = HIDDEN[name]
    y0 = 0.1 * min(size, 1) * rng.normal(size=(100, n))
    y0 += size * np.where(np.arange(n) < n // 2, 1, 0.01)
    return Case(field, energy, y0, (50.0, 0.1))


BOTH, DOUBLE, SINGLE = (np.float64, np.float32), (np.float64,), (np.float32,)
# What makes a case, with a seed, and the dtypes in which it is solved.
CASES = {
    "elastic walls": (elastic_walls, {}, 3, SINGLE),
    "steady rotations, fixed": (steady_rotations, {"solver": dfc.RK4()}, 7, BOTH),
    "steady rotations": (steady_rotations, {"controller": dfx.PIDController(1e-3, 1e-3)}, 5, BOTH),
    # By the flags of `make slow`, but not by those of the tests, XLA evaluates the residuals once
    # for each multiplier.
    "almost circular orbits": (almost_circular, {}, 6, BOTH),
    "with Laplace vectors": (with_laplace_vectors, {}, 2, DOUBLE),
    "turning tops": (turning_tops, {}, 2, DOUBLE),
    "enzymes": (enzymes, {}, 6, BOTH),
    "N2 in atomic units": (molecules, {"energy": morse_energy, "units": (1, 1, 1)}, 1, SINGLE),
    "N2 in SI": (molecules, {"energy": bound_morse_energy, "units": SI}, 1, DOUBLE),
}
for _centre, _rests in ((0.0, 0.0), (1.0, 0.0), (-30.0, 0.0), (1.0, 10.0)):
    _given = {"centre": _centre, "rests": _rests}
    CASES[f"vibrations at {_centre:g}, {_rests:g}"] = vibrations, _given, 5, DOUBLE
for _name in HIDDEN:
    CASES[f"terms that no gradient shows, {_name}"] = hidden, {"name": _name}, 2, DOUBLE
# Of each way to refuse a right solve one.
FIRST = (
    "elastic walls",
    "turning tops",
    "vibrations at 1, 10",
    "N2 in SI",
    "terms that no gradient shows, scan",
)
SOLVED = [
    pytest.param(name, dtype, marks=() if name in FIRST else pytest.mark.slow)
    for name, (*_, dtypes) in CASES.items()
    for dtype in dtypes
]


@pytest.mark.parametrize(("name", "dtype"), SOLVED)
def test_right_solves_succeed(name, dtype):
    make, options, seed, _ = CASES[name]
    case = make(np.random.default_rng(seed), **options)
    found = failures(case, dtype)
    assert len(found) <= case.allowed, jax.tree.map(lambda x: x[found[:5]], case.y0)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, 0, 0))
def to_values(fn, candidate, value):
    y, info = dfc.project(dfc.FirstIntegral(fn), candidate, value=value)
    return y, info.ok


@some_of("dtype", [np.float64, np.float32], ids=["float64", "float32"], period=2)
def test_far_candidates_reach_a_pendulum_near_rest(dtype):
    """The terms that cancel at the result are not those at the candidate."""
    rng = np.random.default_rng(1)
    angle, amplitude = rng.uniform(0, 2 * np.pi, 500), 10 ** rng.uniform(-4, -1, 500)
    q, p = amplitude * np.cos(angle), amplitude * np.sin(angle)
    value = p**2 / 2 + 2 * np.sin(q / 2) ** 2
    candidate = np.stack([q, p], axis=1) + rng.normal(size=(500, 2))
    found = to_values(pendulum_energy, candidate.astype(dtype), value.astype(dtype))
    y, okay = map(np.asarray, found)
    assert np.all(okay), np.mean(okay)
    q, p = y.astype(np.longdouble).T
    off = np.abs(p**2 / 2 + 2 * np.sin(q / 2) ** 2 - value)
    assert np.all(off <= 64 * np.finfo(dtype).eps), np.max(off)


def three_bodies(t, y, args):
    apart = y.reshape(3, 2) - jnp.roll(y.reshape(3, 2), 1, axis=0)
    return jnp.sum(1 / jnp.linalg.norm(apart, axis=1))


DOMAINS = {
    "logarithms": (2, lambda t, y, args: jnp.sum(y - jnp.log(y)), np.exp),
    "a root": (2, lambda t, y, args: jnp.sqrt(y[0]) + 0.1 * y[1], np.exp),
    "collisions": (6, three_bodies, np.asarray),
}


@some_of("name", DOMAINS, period=3)
def test_newton_does_not_leave_the_domain_of_a_function(name):
    """Full steps lead to negative numbers, or so far away that nothing changes there."""
    n, fn, state = DOMAINS[name]
    rng = np.random.default_rng(3)
    start = state(0.5 * rng.normal(size=(300, n)))
    candidate = start + rng.normal(size=start.shape)
    value = jax.vmap(lambda y: fn(0.0, y, None))
    inside = np.isfinite(value(candidate)) & np.isfinite(value(start))
    y, okay = to_values(fn, candidate[inside], value(start)[inside])
    assert np.all(okay), np.mean(okay)
    off = np.abs(value(y) - value(start)[inside])
    assert np.all(off <= 1e-13 * (1 + np.abs(value(y)))), np.max(off)


@pytest.mark.usefixtures("errors_raise")
def test_a_branch_that_is_not_taken_does_not_run():

    def energy(t, y, args):
        return jnp.sum(eqx.error_if(y, jnp.abs(y) > 1e3, "too large") ** 2)

    _, info = dfc.project(dfc.FirstIntegral(energy, value=1.0), jnp.array([0.3, 1.2]))
    assert info.ok


def test_an_energy_of_many_pairs_needs_no_memory_for_all_of_them():
    """Its sums go row by row; what is measured at the start must not keep the rows."""

    def energy(t, q, args):
        def of_row(row):
            return jnp.sum(1 / jnp.sqrt(jnp.sum((row - q) ** 2, axis=1) + 1e-4))

        return -jnp.sum(lax.map(jax.checkpoint(of_row), q))

    def start(q, value):
        return dfc.project(dfc.FirstIntegral(energy), q, value=value)

    q = jax.random.normal(jax.random.key(0), (1000, 3))
    needed = jax.jit(start).lower(q, energy(0.0, q, None)).compile().memory_analysis()
    assert needed.temp_size_in_bytes < 100 * q.nbytes, needed  # one array for all pairs is 333


@some_of(
    "projection", [dfc.SimplifiedNewton(), dfc.Newton()], ids=["simplified", "newton"], period=2
)
def test_products_of_matrices_have_all_digits(projection):
    """By default those in float32 have three on a GPU: a right network was refused there."""
    matrix = jnp.linspace(-1.0, 1.0, 48, dtype=jnp.float32).reshape(6, 8)
    product = lambda t, y, args: jnp.tanh(matrix @ y)  # noqa: E731
    kept = dfc.FirstIntegral(product, rate=product)
    solver = dfc.ManifoldProjection(dfx.Euler(), kept, projection=projection)

    def saved(y0):
        options = dict(saveat=dfx.SaveAt(ts=jnp.ones(1)), adjoint=dfx.ForwardMode())
        return solve(lambda t, y, args: -y, solver, y0, **options).ys

    closed = jax.make_jaxpr(lambda y: jax.jvp(saved, (y,), (y,)))(jnp.ones(8, jnp.float32))
    jaxprs, precisions = [closed.jaxpr], set()
    for jaxpr in jaxprs:
        for eqn in jaxpr.eqns:
            jaxprs.extend(inside.jaxpr for inside in jaxprs_inside(eqn))
            if eqn.primitive.name == "dot_general":
                precisions.add(eqn.params["precision"])
    assert precisions == {(lax.Precision.HIGHEST, lax.Precision.HIGHEST)}


@pytest.mark.slow
def test_small_vibrations_are_moved_by_little():
    """The energy has only roundoff, which is not corrected where the momentum is."""
    toda, rng = dfc.systems.TodaLattice(particles=3), np.random.default_rng(2)
    amplitude = 10 ** rng.uniform(-12, -5, (100, 1))
    y0 = tuple(jnp.asarray(amplitude * rng.normal(size=(2, 100, 3))))
    manifold = dfc.FirstIntegral(toda.linear_momentum), dfc.FirstIntegral(toda.energy)

    @jax.jit
    @jax.vmap
    def moved(y0):
        solvers = dfx.Dopri5(), dfc.ManifoldProjection(dfx.Dopri5(), manifold)
        options = dict(dt0=0.05, saveat=dfx.SaveAt(ts=jnp.linspace(0, 1, 23)))
        plain, projected = (solve(toda.vector_field, x, y0, **options).ys for x in solvers)
        return jax.tree.map(lambda a, b: jnp.max(jnp.abs(a - b)), plain, projected)

    assert all(np.all(part < 1e-9 * amplitude[:, 0]) for part in moved(y0))
