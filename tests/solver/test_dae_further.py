"""What `DAE.wrap` keeps beside the equations: exact solutions, and pendulums in angles by scipy."""

import itertools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import diffrax_conserve as dfc

from ..problems import EPS, TO_THE_END, largest, refused
from ..thinned import some_of
from .test_dae import CUBIC, constant

GRAVITY = 9.81


@eqx.filter_jit
def solve(dae, solver, ts, y0, args=None, *, dt0=None, tol=1e-8, **options):
    """With steps of fixed length if `dt0` is given."""
    steps = dfx.PIDController(rtol=tol, atol=tol) if dt0 is None else dfx.ConstantStepSize()
    options = TO_THE_END | dict(saveat=dfx.SaveAt(ts=ts), stepsize_controller=steps) | options
    return dfx.diffeqsolve(dae.term, solver, ts[0], ts[-1], dt0, y0, args, **options)


# ---- Index 1: the entry contains an unknown without a slope ----

# It leaves one state for each time, the exact one, whatever the solver is.
CLOCK = dfc.FirstIntegral(lambda t, y, a: 1.5 * y[1] ** 2 + jnp.log(y[1]) + a * t)


def test_an_integral_of_an_algebraic_unknown():
    """At saved times too, and its derivatives, by long steps of a method of order two."""
    ts = jnp.linspace(0, 1, 7)
    solver = CUBIC.wrap(dfx.Heun(), CLOCK)

    def end(z0, a):
        found = solve(CUBIC, solver, ts, (z0**3 + z0, z0), a, dt0=0.25)
        return found.ys[1][-1], (found.ys, found.result)

    both = jax.jit(jax.jacfwd(end, (0, 1), has_aux=True))
    (by_z0, by_a), (ys, result) = both(jnp.array(1.0), jnp.array(0.7))
    assert result == dfx.RESULTS.successful
    x, z = map(np.asarray, ys)
    assert largest(x - z**3 - z) < 8 * EPS
    assert largest(constant(np.asarray(ts), z, 0.7) - constant(0, 1.0, 0.7)) < 16 * EPS
    slope = lambda z: 3 * z + 1 / z  # noqa: E731
    assert np.allclose((by_z0, by_a), (slope(1.0) / slope(z[-1]), -1 / slope(z[-1])), rtol=1e-12)


def test_bounds():
    """A step of Euler's method that is too long makes an amount negative; the total is one."""
    dae = dfc.DAE(lambda t, x, z, args: -x, algebraic=lambda t, x, z, args: x + z - 1)
    y0, ts = dae.consistent(jnp.array(0.9), jnp.array(0.0)), jnp.array([0.0, 1.5])
    for lower, end in ((-jnp.inf, (-0.45, 1.45)), (0.0, (0.0, 1.0))):
        projection = dfc.Newton(lower=jnp.asarray(lower))
        solver = dae.wrap(dfx.Euler(), projection=projection)
        found = solve(dae, solver, ts, y0, dt0=1.5)
        assert found.result == dfx.RESULTS.successful
        np.testing.assert_allclose([y[-1] for y in found.ys], end, atol=4 * EPS)


# ---- Mechanisms ----


def rod(q, v, force):
    return v, -force * q - jnp.array([0.0, GRAVITY]) - 0.3 * v


# Only its velocity is told to be tangential, so that its length drifts.
ROD = dfc.DAE(
    residual=lambda t, y, dy, args: (
        dy[0] - rod(*y)[0], dy[1] - rod(*y)[1], y[0] @ y[1] + 0 * y[2]
    )
)  # fmt: skip
LENGTH = dfc.FirstIntegral(lambda t, y, args: y[0] @ y[0])
ENERGY = dfc.FirstIntegral(
    lambda t, y, args: y[1] @ y[1] / 2 + GRAVITY * y[0][1],
    rate=lambda t, y, args: -0.3 * y[1] @ y[1],
)


def test_the_length_of_a_pendulum_of_index_2_and_the_balance_of_its_energy():
    """The balance leaves the error of its integral, which is smaller than that of the state."""
    y0 = ROD.consistent((jnp.array([1.0, 0.0]), jnp.zeros(2), jnp.array(0.0)))
    assert ROD.report(y0).index == 2
    ts = jnp.linspace(0, 3, 4)
    exact = solve_ivp(
        lambda t, u: (u[1], -GRAVITY * np.sin(u[0]) - 0.3 * u[1]), (0, 3), (np.pi / 2, 0),
        method="DOP853", rtol=1e-13, atol=1e-13, t_eval=ts,
    ).y  # fmt: skip
    energy = exact[1] ** 2 / 2 - GRAVITY * np.cos(exact[0])
    off = []
    for manifold in ((), {"length": LENGTH, "energy": ENERGY}):
        found = solve(ROD, ROD.wrap(dfx.Tsit5(), manifold), ts, y0, tol=1e-5)
        assert found.result == dfx.RESULTS.successful
        q, v, _ = map(np.asarray, found.ys)
        length = largest(np.sum(q * q, axis=1) - 1)
        off.append((length, largest(np.sum(v * v, axis=1) / 2 + GRAVITY * q[:, 1] - energy)))
        place = np.stack([np.sin(exact[0]), -np.cos(exact[0])], axis=1)
        assert largest(q - place) < 1e-3
    assert off[0][0] > 1e-6
    assert off[1][0] < 8 * EPS
    assert off[1][1] < off[0][1] / 3


def double(t, y, dy, args):
    (q, v, force), (dq, dv, _) = y, dy
    a, b = q
    pull = jnp.stack([force[1] * (b - a) - force[0] * a, force[1] * (a - b)])
    return dq - v, dv - pull + jnp.array([0.0, GRAVITY]), jnp.stack([a @ a, (b - a) @ (b - a)]) - 1


def total_energy(t, y, args):
    q, v, _ = y
    return jnp.sum(v * v) / 2 + GRAVITY * jnp.sum(q[:, 1])


def places(angles):
    """Of the two masses, from angles from below; also of a tangent, with its derivatives."""
    xp = jnp if isinstance(angles, jax.Array) else np
    return xp.cumsum(xp.stack([xp.sin(angles), -xp.cos(angles)], axis=-1), axis=-2)


def in_angles(angle, end):
    """Both places at the end, of a double pendulum that starts at rest."""

    def slope(t, u):
        (p, r, w, z), d = u, u[0] - u[1]
        inertia = np.array([[2, np.cos(d)], [np.cos(d), 1]])
        turning = np.array([-np.sin(d) * z * z, np.sin(d) * w * w])
        weight = GRAVITY * np.array([2 * np.sin(p), np.sin(r)])
        return [w, z, *np.linalg.solve(inertia, turning - weight)]

    start = (angle, 0.5, 0, 0)
    found = solve_ivp(slope, (0, end), start, method="DOP853", rtol=1e-13, atol=1e-13)
    return places(found.y[:2, -1])


@pytest.mark.slow
def test_the_energy_of_a_double_pendulum_of_index_3():
    """And the derivative of its end by its start, by a difference of two solves in angles."""
    dae = dfc.DAE(residual=double)
    zero = jnp.zeros((2, 2))
    y0 = dae.consistent((places(jnp.array([1.5, 0.5])), zero, jnp.zeros(2)))
    solver = dae.wrap(dfc.Radau(), {"energy": dfc.FirstIntegral(total_energy)})
    ts = jnp.linspace(0, 2, 9)

    def end(angle):
        start = places(jnp.stack([angle, jnp.array(0.5)])), zero, y0[2]
        found = solve(dae, solver, ts, dae.consistent(start), adjoint=dfx.ForwardMode())
        return found.ys[0][-1], found

    by_angle, found = jax.jit(jax.jacfwd(end, has_aux=True))(jnp.array(1.5))
    assert found.result == dfx.RESULTS.successful
    values = np.asarray(jax.vmap(total_energy, (None, 0, None))(0.0, found.ys, None))
    assert largest(values / values[0] - 1) < 1e-14
    assert largest(found.ys[0][-1] - in_angles(1.5, 2.0)) < 1e-7
    step = 1e-4
    difference = (in_angles(1.5 + step, 2.0) - in_angles(1.5 - step, 2.0)) / (2 * step)
    assert largest(by_angle - difference) < 1e-6


# ---- Errors and failures ----


def test_a_failure_names_its_entry():
    far = dfc.FirstIntegral(lambda t, y, args: jnp.tanh(y[0]), value=jnp.array(2.0))
    options = dict(dt0=0.1, saveat=dfx.SaveAt(t1=True, solver_state=True))
    solver, y0 = CUBIC.wrap(dfx.Heun(), {"far": far}), (jnp.array(2.0), jnp.array(1.0))
    found = solve(CUBIC, solver, jnp.array([0.0, 1.0]), y0, jnp.array(0.7), **options)
    assert found.result != dfx.RESULTS.successful
    assert "manifold['further']['far']" in str(dfc.statistics(found))


test_wrong_arguments = refused(
    (lambda: CUBIC.wrap(dfx.Heun(), {"far": jnp.sum}), TypeError, "further'.*'far"),
    (lambda: CUBIC.wrap(dfx.Heun(), projection=dfc.Newton), TypeError, "which is not a projection"),
    (
        lambda: CUBIC.wrap(dfx.Heun(), projection=dfc.AlongLine(direction="step")),
        TypeError,
        "`projection` is",
    ),
)


# ---- Unknowns without slopes that are in more constraints than they can meet ----


def pendulum_with(output):
    """Of index 3, with a further unknown that is a function of the others."""

    def residual(t, y, dy, args):
        (q, v, force, further), (dq, dv, _, _) = y, dy
        down = jnp.array([0.0, -GRAVITY], q.dtype)
        return dq - v, dv + force * q - down, jnp.sum(q**2) - 1, output(further, q, v, force)

    return dfc.DAE(residual=residual)


@some_of(
    "output, dtype",
    [
        (lambda z, q, v, force: z - 0.3 * force, jnp.float64),
        (lambda z, q, v, force: z - 2e3 * force, jnp.float32),
        (lambda z, q, v, force: z * jnp.exp(q[0]) - q[1] * v[0] * force, jnp.float64),
    ],
    ids=["a share of the force", "the force in another unit", "a nonlinear function of all"],
    period=3,
)
def test_an_output_changes_nothing(output, dtype):
    """The states are those without it, and so is their derivative by the first angle."""
    alone, eps = pendulum_with(lambda z, q, v, force: z - 1), jnp.finfo(dtype).eps

    def end(dae, angle):
        q = jnp.stack([jnp.sin(angle), -jnp.cos(angle)]).astype(dtype)
        v = 0.5 * jnp.stack([jnp.cos(angle), jnp.sin(angle)]).astype(dtype)
        y0 = dae.consistent((q, v, jnp.ones((), dtype), jnp.ones((), dtype)))
        found = solve(dae, dae.wrap(dfx.Tsit5()), jnp.array([0.0, 0.3], dtype), y0, dt0=0.03)
        return (y0[:3], found.ys[:3]), found.result

    both = [
        jax.jit(lambda x, dae=dae: jax.jvp(lambda x: end(dae, x), (x,), (1.0,)))(0.7)
        for dae in (alone, pendulum_with(output))
    ]
    for (_, result), _ in both:
        assert result == dfx.RESULTS.successful
    (expected, _), (t_expected, _) = both[0]
    (same, _), (t_same, _) = both[1]
    for a, b in zip(
        jax.tree.leaves((expected, t_expected)), jax.tree.leaves((same, t_same)), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=200 * eps, atol=200 * eps)


NAMES_OF_CURRENTS = {"each": np.eye(2), "sum": np.array([[1.0, 1.0], [1.0, -1.0]])}


@some_of("solver, names", itertools.product((dfc.Radau, dfx.Tsit5), NAMES_OF_CURRENTS), period=2)
def test_cells_in_parallel_share_the_current(solver, names):
    """Two linear ones, of index 2, so that each has its share of the charge for ever, whatever the
    two unknown currents are: those of the cells, or their sum and their difference."""
    names = jnp.asarray(NAMES_OF_CURRENTS[names])

    def f(t, x, z, capacities):
        return 1e-3 * (names @ z[:2]) / capacities

    def algebraic(t, x, z, capacities):
        return jnp.append(4.3 - 0.75 * x - z[2], jnp.sum(names @ z[:2]) - 10)

    dae, time = dfc.DAE(f, algebraic=algebraic), 100.0

    def end(first):
        capacities = jnp.stack([first, jnp.array(1.1)])
        charges = jnp.array([0.29, 0.31])  # which are equal in the nearest consistent state
        y0 = dae.consistent(charges, jnp.array([1.0, 2.0, 3.0]), args=capacities)
        found = solve(dae, dae.wrap(solver()), jnp.array([0.0, time]), y0, capacities)
        x, z = jax.tree.map(lambda x: x[-1], found.ys)
        return (x, names @ z[:2], z[2]), found.result

    (state, result), (by_first, _) = jax.jit(lambda x: jax.jvp(end, (x,), (1.0,)))(1.0)
    assert result == dfx.RESULTS.successful
    charge, total = 0.3 + 1e-2 * time / 2.1, 2.1
    exact = np.full(2, charge), 10 * np.array([1.0, 1.1]) / total, 4.3 - 0.75 * charge
    for a, b in zip(state, exact, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13)
    slope = -1e-2 * time / total**2
    exact = np.full(2, slope), np.array([11.0, -11.0]) / total**2, -0.75 * slope
    for a, b in zip(by_first, exact, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11)


def test_forces_that_hardly_change_at_first_do_not_end_the_iteration_of_a_stage():
    """Three rods fall from rest. From a consistent start the first change of the iteration is small
    beside the second, by the curvature of the constraints."""

    def rods(q):
        return jnp.diff(q, axis=0, prepend=jnp.zeros((1, 2)))

    def falling(t, y, dy, args):
        (q, v, tension), (dq, dv, _) = y, dy
        pull = tension[:, None] * rods(q)
        force = pull - jnp.concatenate([pull[1:], jnp.zeros((1, 2))])
        return dq - v, dv + force - jnp.array([0.0, -9.81]), jnp.sum(rods(q) ** 2, axis=1) - 1 / 9

    dae, angles = dfc.DAE(residual=falling), jnp.array([0.0, 0.1, 0.2])
    q = jnp.cumsum(jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1) / 3, axis=0)
    y0 = dae.consistent((q, jnp.zeros((3, 2)), jnp.ones(3)))
    finder = dfx.VeryChord(rtol=1e-8, atol=1e-8)

    @jax.jit
    def end(step):
        solver = dae.wrap(dfc.Radau(root_finder=finder))
        sol = dfx.diffeqsolve(dae.term, solver, 0.0, 0.1, step, y0, max_steps=256, throw=False)
        return sol.ys[0][-1], sol.result == dfx.RESULTS.successful

    (coarse, ok), (fine, _) = end(0.02), end(5e-4)
    assert ok
    np.testing.assert_allclose(coarse, fine, atol=1e-6)
