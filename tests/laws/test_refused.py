"""Nobody who is right is refused: near rest, in other units, from an equilibrium."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve._projection.jaxprs import jaxprs_inside

from .. import fresh
from ..problems import kepler, kepler_energy, kepler_momentum, solve

ADAPTIVE = dfx.PIDController(rtol=1e-4, atol=1e-7)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, None, None, None, 0, 0, None))
def okay(field, fn, solver, controller, y0, args, times):
    t1, dt0 = times
    solver = dfc.ManifoldProjection(solver, jax.tree.map(dfc.FirstIntegral, fn))
    options = dict(stepsize_controller=controller, max_steps=4096, throw=False)
    sol = solve(field, solver, y0, t1=t1, dt0=dt0, args=args, **options)
    return dfx.is_okay(sol.result)


def pendulum(t, y, args):
    return jnp.stack([y[1], -jnp.sin(y[0])])


def pendulum_energy(t, y, args):
    """From zero: the terms near one cancel, and its gradient does not show them."""
    return y[1] ** 2 / 2 + 1 - jnp.cos(y[0])


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("fixed", [True, False], ids=["fixed", "adaptive"])
def test_a_pendulum_near_rest_is_solved(dtype, fixed):
    rng = np.random.default_rng(0)
    amplitude = 10 ** rng.uniform(-4, np.log10(0.3), 200)
    angle = rng.uniform(0, 2 * np.pi, 200)
    y0 = (amplitude * np.stack([np.cos(angle), np.sin(angle)])).T.astype(dtype)
    solver, controller = (dfc.RK4(), dfx.ConstantStepSize()) if fixed else (dfx.Tsit5(), ADAPTIVE)
    times = jnp.asarray([10.0, 0.1], dtype)
    done = okay(pendulum, pendulum_energy, solver, controller, y0, jnp.zeros(200, dtype), times)
    assert np.all(done), (np.mean(done), amplitude[~np.asarray(done)][:5])


def test_a_body_whose_motion_is_below_the_tolerance_is_solved():
    """It wobbles about an axis by a millionth; steps grow until their error is as large."""
    body, rng = dfc.systems.RigidBody(), np.random.default_rng(5)
    fns = [lambda *args, fn=entry.fn: fn(*args) for entry in body.manifold.values()]
    y0 = np.eye(3)[rng.integers(0, 3, 300)] + 10 ** rng.uniform(-7, -5) * rng.normal(size=(300, 3))
    for tol in (1e-3, 1e-5):
        controller, times = dfx.PIDController(tol, tol), jnp.array([10.0, 1.0])
        done = okay(body.vector_field, fns, dfx.Tsit5(), controller, y0, np.zeros(300), times)
        assert np.all(done), (tol, y0[~np.asarray(done)][:5])


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, 0, 0))
def to_values(fn, candidate, value):
    y, info = dfc.project(dfc.FirstIntegral(fn), candidate, value=value)
    return y, info.ok


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
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


@pytest.mark.parametrize("name", DOMAINS)
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


@pytest.mark.parametrize(("centre", "rests"), [(0.0, 0.0), (1.0, 0.0), (-30.0, 0.0), (1.0, 10.0)])
def test_a_small_vibration_far_from_the_origin_is_solved(centre, rests):
    """Its steps, which at first are much too long, are short beside the state."""
    rng = np.random.default_rng(5)
    amplitude = max(abs(centre), 1) * 10 ** rng.uniform(-10, 0, 200)
    y0 = np.stack([centre + amplitude, 0 * amplitude, rests + 0 * amplitude], axis=1)
    field = lambda t, y, args: jnp.stack([y[1], -10 * (y[0] - centre), 0 * y[2]])  # noqa: E731
    energy = lambda t, y, args: y[1] ** 2 / 2 + 5 * (y[0] - centre) ** 2  # noqa: E731
    given = dfx.Tsit5(), dfx.PIDController(rtol=1e-2, atol=1e-2), y0, jnp.zeros(200)
    done = okay(field, energy, *given, jnp.asarray([60.0, 0.01]))
    assert np.all(done), amplitude[~np.asarray(done)][:5]


def test_steps_across_an_elastic_wall_are_tried_again():
    """There a step is inaccurate, and its projection fails, until it is very short."""
    far = lambda y: jnp.maximum(jnp.abs(y[0]) - 1, 0)  # noqa: E731
    field = lambda t, y, args: jnp.stack([y[1], -args * jnp.sign(y[0]) * far(y)])  # noqa: E731
    energy = lambda t, y, args: y[1] ** 2 / 2 + args * far(y) ** 2 / 2  # noqa: E731
    rng = np.random.default_rng(3)
    y0 = np.stack([rng.uniform(-1, 1, 200), rng.normal(size=200)], axis=1, dtype=np.float32)
    stiffness, times = 10 ** rng.uniform(1, 6, 200), jnp.asarray([6.0, 0.01], jnp.float32)
    given = dfx.PIDController(1e-5, 1e-8), y0, stiffness.astype(np.float32), times
    done = okay(field, energy, dfx.Tsit5(), *given)
    assert np.sum(~done) <= 3, y0[~np.asarray(done)][:5]


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_rigid_bodies_near_a_steady_rotation_are_solved(dtype):
    """Where roundoff alone corrects by more than a step moves the state."""
    rng, inertia = np.random.default_rng(7), np.array([1, 2, 3], dtype)
    manifold = (
        lambda t, y, args: jnp.sum(y**2 / inertia) / 2,
        lambda t, y, args: jnp.sum(y**2) / 2,
    )
    beside = 10 ** rng.uniform(-9, -1, (3, 300, 1)) * rng.normal(size=(3, 300, 3))
    y0 = (np.eye(3)[:, None] + beside).reshape(900, 3)
    times = jnp.asarray([20.0, 0.02], dtype)
    given = dfc.RK4(), dfx.ConstantStepSize(), y0.astype(dtype), jnp.zeros(900, dtype), times
    done = okay(lambda t, y, args: jnp.cross(y, y / inertia), manifold, *given)
    assert np.all(done), np.mean(done)


def three_waves(t, y, args):
    return 1j * jnp.stack([jnp.conj(y[1]) * y[2], jnp.conj(y[0]) * y[2], y[0] * y[1]])


def quanta(t, y, args):
    count = y.real**2 + y.imag**2
    return count[0] + count[2], count[1] + count[2], 2 * jnp.real(y[0] * y[1] * jnp.conj(y[2]))


def test_weak_waves_beside_a_strong_one_are_solved():
    """The gradients are nearly parallel, so that roundoff of one integral is large for another."""
    rng = np.random.default_rng(1)
    y0 = rng.normal(size=(200, 3)) + 1j * rng.normal(size=(200, 3))
    y0[:, :2] *= 10 ** rng.uniform(-6, -3, (200, 1))
    controller = dfx.PIDController(rtol=1e-8, atol=1e-10)
    given = three_waves, quanta, dfx.Dopri5(), controller, y0, jnp.zeros(200)
    done = okay(*given, jnp.asarray([1.0, 0.01]))
    assert np.all(done), np.mean(done)


TODA = (
    lambda t, y, args: jnp.sum(y[1]),
    lambda t, y, args: jnp.sum(y[1] ** 2) / 2 + jnp.sum(jnp.exp(y[0] - jnp.roll(y[0], -1))),
)


def toda(t, y, args):
    force = jnp.exp(y[0] - jnp.roll(y[0], -1))
    return jnp.stack([y[1], jnp.roll(force, 1) - force])


def test_small_vibrations_are_moved_by_little():
    """The energy has only roundoff, which is not corrected where the momentum is."""
    amplitude = 10 ** np.random.default_rng(2).uniform(-12, -5, (100, 1, 1))
    y0 = jnp.asarray(amplitude * np.random.default_rng(3).normal(size=(100, 2, 3)))
    saveat = dfx.SaveAt(ts=jnp.linspace(0, 1, 23))

    def states(solver):
        return jax.jit(jax.vmap(lambda y: solve(toda, solver, y, t1=1, dt0=0.05, saveat=saveat).ys))

    manifold = tuple(map(dfc.FirstIntegral, TODA))
    moved = states(dfc.ManifoldProjection(dfx.Dopri5(), manifold))(y0) - states(dfx.Dopri5())(y0)
    assert np.max(np.abs(moved) / amplitude[..., None]) < 1e-9


def almost_circular_failures(dtype):
    rng = np.random.default_rng(6)
    e, angle = 10 ** rng.uniform(-9, -1, 500), rng.uniform(0, 2 * np.pi, 500)
    radius, cos, sin = (1 - e**2) / (1 + e * np.cos(angle)), np.cos(angle), np.sin(angle)
    speed = 1 / np.sqrt(1 - e**2)
    y0 = [[radius * cos, radius * sin], [-speed * sin, speed * (e + cos)]]
    y0 = tuple(np.stack(part, axis=1, dtype=dtype) for part in y0)
    times = jnp.asarray([2 * np.pi, 2 * np.pi / 80], dtype)
    given = kepler, (kepler_energy, kepler_momentum), dfx.Tsit5(), dfx.ConstantStepSize()
    done = okay(*given, y0, jnp.zeros(500, dtype), times)
    return e[~np.asarray(done)].tolist()


def test_almost_circular_orbits_in_a_batch_are_solved():
    """Multipliers of nearly parallel gradients are large, and cancel in the correction. By default
    flags, but not by those of the tests, XLA evaluates the residuals once for each multiplier."""
    assert fresh.interpreter()["failures"] == {"float64": [], "float32": []}


# Well depth in hartree, inverse width and equilibrium length in units of the Bohr radius, reduced
# mass in electron masses.
MOLECULES = {
    "H2": (0.1744, 1.028, 1.401, 918.1),
    "N2": (0.3640, 1.424, 2.074, 12761.0),
    "HCl": (0.1697, 0.990, 2.409, 1784.7),
    "CO": (0.4125, 1.219, 2.132, 12498.0),
}
# Hartree in joules, Bohr radius in metres, electron mass in kilograms, room temperature in hartree.
JOULE, METRE, KILOGRAM, ROOM = 4.3597e-18, 5.2918e-11, 9.1094e-31, 9.5e-4


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


@pytest.mark.parametrize(
    ("energy", "units", "dtype"),
    [(bound_morse_energy, "SI", np.float64), (morse_energy, "atomic", np.float32)],
    ids=["SI", "atomic"],
)
def test_a_molecule_from_its_equilibrium_length_is_not_refused(energy, units, dtype):
    joule, metre, kilogram = (JOULE, METRE, KILOGRAM) if units == "SI" else (1.0, 1.0, 1.0)
    rng = np.random.default_rng(1)
    for depth, width, length, mass in MOLECULES.values():
        args = depth * joule, width / metre, length * metre, mass * kilogram
        # A thermal momentum, which may be small, but not so small that a length changes by few ulp.
        thermal = rng.normal(size=100)
        thermal = np.where(np.abs(thermal) < 0.05, 0.05, thermal)
        momentum = np.sqrt(args[3] * ROOM * joule) * thermal
        y0 = np.stack([np.full(100, args[2]), momentum], axis=1).astype(dtype)
        period = 2 * np.pi / (args[1] * np.sqrt(2 * args[0] / args[3]))
        times = jnp.asarray([3 * period, period / 40], dtype)
        lanes = tuple(jnp.full(100, x, dtype) for x in args)
        done = okay(morse, energy, dfc.RK4(), dfx.ConstantStepSize(), y0, lanes, times)
        assert np.all(done), np.asarray(y0)[~np.asarray(done)][:5]


def height(q):
    return 1 - jnp.cos(q)


height_with_rule = jax.custom_vjp(height)
height_with_rule.defvjp(lambda q: (height(q), q), lambda q, g: (g * jnp.sin(q),))
HEIGHTS = {
    "rule": height_with_rule,
    "checkpoint": jax.checkpoint(height),
    "cond": lambda q: lax.cond(q > 0, height, height, q),
    "scan": lambda q: lax.scan(lambda sum, q: (sum + height(q), None), 0 * q, q[None])[0],
    "single": lambda q: height(q.astype(jnp.float32)).astype(q.dtype),
}
SPRINGS = np.array([[1.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])


def pendulum_of(height):
    return pendulum, lambda t, y, args: y[1] ** 2 / 2 + height(y[0]), 1e-3, 2


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
HIDDEN = {name: pendulum_of(height) for name, height in HEIGHTS.items()} | {
    "determinant": (in_determinant, determinant_energy, 1.0, 2),
    "matrix": (
        lambda t, y, args: jnp.concatenate([y[3:], -SPRINGS @ y[:3]]),
        lambda t, y, args: (y[3:] @ y[3:] + y[:3] @ SPRINGS @ y[:3]) / 2,
        100.0,
        6,
    ),
}


@pytest.mark.parametrize("name", HIDDEN)
def test_terms_that_no_gradient_shows_are_found(name):
    field, energy, size, n = HIDDEN[name]
    rng = np.random.default_rng(2)
    y0 = 0.1 * min(size, 1) * rng.normal(size=(100, n))
    y0 += size * np.where(np.arange(n) < n // 2, 1, 0.01)
    times = jnp.asarray([50.0, 0.1])
    done = okay(field, energy, dfx.Tsit5(), dfx.ConstantStepSize(), y0, jnp.zeros(100), times)
    assert np.all(done), np.mean(done)


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


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_amounts_may_be_spent(dtype):
    """Of an enzyme: near rest a step overshoots zero by its error."""

    def field(t, y, k):
        bound, loose, made = k[0] * y[0] * y[1], k[1] * y[2], k[2] * y[2]
        return jnp.stack([loose - bound, loose + made - bound, bound - loose - made, made])

    kept = lambda t, y, k: jnp.stack([y[1] + y[2], y[0] + y[2] + y[3]])  # noqa: E731
    bounded = dfc.SimplifiedNewton(lower=0.0)
    solver = dfc.ManifoldProjection(dfx.Tsit5(), dfc.FirstIntegral(kept), projection=bounded)

    @jax.vmap
    def done(y0, k, dt0, tol):
        options = dict(args=k, t1=5.0, dt0=dt0, throw=False, max_steps=2000)
        controllers = dfx.ConstantStepSize(), dfx.PIDController(rtol=tol, atol=tol)
        sols = [solve(field, solver, y0, stepsize_controller=x, **options) for x in controllers]
        return [dfx.is_okay(sol.result) for sol in sols]

    rng = np.random.default_rng(6)
    given = [10 ** rng.uniform(*ends, (300, n)) for *ends, n in ((-3, 1, 2), (-1, 1.5, 3))]
    y0, tol = np.pad(given[0], ((0, 0), (0, 2))), 10 ** rng.uniform(-5, -1.5, 300)
    dt0 = 0.5 / (given[1][:, 0] * np.sum(y0, axis=1) + np.sum(given[1][:, 1:], axis=1))
    results = done(*(x.astype(dtype) for x in (y0, given[1], np.maximum(dt0, 3e-3), tol)))
    assert np.all(results), [np.flatnonzero(~x)[:9] for x in np.asarray(results)]


@pytest.mark.parametrize("projection", [dfc.SimplifiedNewton(), dfc.Newton()])
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
