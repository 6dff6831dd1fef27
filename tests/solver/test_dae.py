"""Index-1 equations: solutions that are known, and another form of the same equations."""

import dataclasses

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import diffrax_conserve as dfc
from diffrax_conserve._numerics.metric import Diagonal
from diffrax_conserve._numerics.problem import problem_of

from ..problems import EPS, assert_lanes, difference, largest, refused
from ..thinned import some_of


def pair(f, g):
    return dfc.DAE(f, algebraic=g)


# `x = z³ + z` and `x' = -a z`: so `3/2 z² + log z + a t` is constant.
CUBIC = pair(lambda t, x, z, a: -a * z, lambda t, x, z, a: z**3 + z - x)
PRECISE = dfx.PIDController(rtol=1e-11, atol=1e-11)


def constant(t, z, a):
    return 1.5 * z**2 + np.log(z) + a * t


@eqx.filter_jit
def solve(dae, solver, x, guess, args, *, t1=1.0, controller=PRECISE, **options):
    saveat = dfx.SaveAt(ts=jnp.linspace(0, t1, 11, dtype=x.dtype))
    options = dict(saveat=saveat, max_steps=4096, dt0=None, throw=False) | options
    t1, y0 = jnp.asarray(t1, jnp.result_type(x)), dae.consistent(x, guess, args=args)
    options |= dict(args=args, stepsize_controller=controller)
    return dfx.diffeqsolve(dae.term, dae.wrap(solver), 0, t1, y0=y0, **options)


def ends(x, a, adjoint):
    steps = dict(controller=dfx.ConstantStepSize(), dt0=0.01, max_steps=128)
    saveat = dfx.SaveAt(t1=True)
    found = solve(CUBIC, dfc.RK4(), x, x / 2, a, adjoint=adjoint, saveat=saveat, **steps)
    return jax.tree.map(lambda y: y[-1], found.ys)


@some_of(
    "solver, dtype, tol",
    [
        (dfx.Tsit5(), np.float64, 1e-11),
        (dfx.Kvaerno5(), np.float64, 1e-11),
        (dfx.Tsit5(), np.float32, 1e-6),
    ],
    ids=["Tsit5", "Kvaerno5", "float32"],
    period=3,
)
def test_a_known_solution(solver, dtype, tol):
    """At saved times too, where Kvaerno5 has a dense output of order 3."""
    a, start, guess = (jnp.array(x, dtype) for x in (0.7, 2, 1))
    ts = dfx.SubSaveAt(ts=jnp.linspace(0, 1, 11, dtype=dtype))
    saveat = dfx.SaveAt(subs=[dfx.SubSaveAt(t0=True, steps=True), ts])
    options = dict(saveat=saveat, controller=dfx.PIDController(rtol=tol, atol=tol))
    found = solve(CUBIC, solver, start, guess, a, **options)
    assert found.result == dfx.RESULTS.successful
    (ts, _), ((_, z), saved) = jax.tree.map(np.asarray, (found.ts, found.ys))
    ts, z = ts[~np.isinf(ts)], z[~np.isinf(ts)]
    assert largest(constant(ts, z, a) - constant(0, z[0], a)) < 100 * tol
    x, z = saved
    assert z.dtype == dtype
    assert largest((z**3 + z - x) / x) < 4 * np.finfo(dtype).eps


MODES = [(jax.jacfwd, dfx.ForwardMode()), (jax.jacrev, dfx.RecursiveCheckpointAdjoint())]


@some_of("mode, adjoint", MODES, ids=["forward", "reverse"], period=2)
def test_derivatives_are_exact(mode, adjoint):
    """Of the final `z` by `a` and by the initial `x`, from the constant."""

    def twice(*p):
        found = ends(*p, adjoint)
        return found, found

    x, a = jnp.array(2.0), jnp.array(0.7)
    found, (_, z1) = jax.jit(mode(twice, argnums=(0, 1), has_aux=True))(x, a)
    slope = lambda z: 3 * z + 1 / z  # noqa: E731
    by_x = slope(1.0) / 4 / slope(z1)  # `z = 1` and `dx/dz = 4` at the start
    by_a = -1 / slope(z1)
    assert np.allclose(found[1], (by_x, by_a), rtol=1e-8)
    factor = 3 * z1**2 + 1
    assert np.allclose(found[0], (by_x * factor, by_a * factor), rtol=1e-8)


@pytest.mark.slow
def test_a_derivative_of_the_consistent_state():
    """The second one too, by what `g` closes over: `z³ + z = c`."""

    def root(c):
        dae = pair(lambda *_: 0.0, lambda t, x, z, args: z**3 + z - c)
        return dae.consistent(jnp.array(0.0), jnp.array(0.1))[1]

    z, first, second = (f(2.0) for f in (root, jax.grad(root), jax.jacfwd(jax.grad(root))))
    assert np.allclose((z, first, second), (1, 1 / 4, -6 / 4**3), rtol=1e-14)


@pytest.mark.slow
def hanging(t, y, dy, args):
    (q, v, force), (dq, dv, _) = y, dy
    return dq - v, dv + force * q + jnp.array([0.0, 9.81]), jnp.sum(q**2) - 1


HANGING = dfc.DAE(residual=hanging)


@pytest.mark.parametrize("little", [0.0, 1e-16, -1e-16, 1e-12, 1e-9])
def test_a_pendulum_at_its_lowest_point_keeps_its_velocity(little):
    """Whether a component is zero or nearly so changes no other."""
    guess = jnp.array([little, -1.0]), jnp.array([2.4, little / 7]), jnp.array(0.0)
    q, v, force = HANGING.consistent(guess)
    assert difference((q, v), guess[:2]) <= 4 * abs(little) + 1e-15
    assert float(force) == pytest.approx(9.81 + 2.4**2)


def test_one_lane_equals_that_lane_alone():
    lanes = jnp.stack([jnp.linspace(0.5, 3, 3), jnp.linspace(0.2, 1, 3)], axis=1)
    assert_lanes(lambda lane: ends(*lane, dfx.ForwardMode()), lanes, 4 * EPS)


@pytest.mark.slow
def test_an_event():
    """At `z = 1/2`, at a time known from the constant, on `g = 0`."""
    event = dfx.Event(lambda t, y, args, **_: y[1] - 0.5, optx.Newton(1e-12, 1e-12))
    x, a, saveat = jnp.array(2.0), jnp.array(0.7), dfx.SaveAt(t1=True)
    options = dict(dt0=0.002, controller=dfx.ConstantStepSize())
    found = solve(CUBIC, dfc.RK4(), x, x, a, t1=5.0, event=event, saveat=saveat, **options)
    assert abs(found.ts[-1] - (constant(0, 1.0, a) - constant(0, 0.5, a)) / a) < 1e-11
    assert abs(found.ys[0][-1] - 0.625) < 4 * EPS


# ---- Poor guesses, and failures ----

DIODE = pair(lambda t, x, z, args: 0 * x, lambda t, x, z, args: x - z - 1e-6 * jnp.expm1(z / 0.025))


def test_newton_finds_the_voltage_at_a_diode():
    """From guesses at which the current is 1e80 A, or at which it is the least current."""
    x, guess = np.meshgrid(np.linspace(-5, 5, 9), np.linspace(-5, 5, 11))
    x, z = map(np.asarray, jax.jit(jax.vmap(DIODE.consistent))(x.ravel(), guess.ravel()))
    off = x - z - 1e-6 * np.expm1(z / 0.025)
    scale = np.abs(x) + np.abs(z) + 1e-6 * np.exp(z / 0.025) * np.abs(z) / 0.025
    assert largest(off / (scale + 1e-6)) < 4 * EPS


SOURCE = pair(lambda t, x, z, a: 0 * x, lambda t, x, z, a: x - a * jnp.expm1(z / 0.025))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_diode_at_rest_is_a_guess_for_every_current(dtype):
    """There a correction is longer than the voltage by the ratio of both currents."""
    current, least, guess = map(np.ravel, np.meshgrid([1e-3, 1, 30], [1e-6, 1e-9, 1e-14], [0, 0.4]))
    given = (x.astype(dtype) for x in (current, guess, least))
    _, z = jax.jit(jax.vmap(lambda x, z, a: SOURCE.consistent(x, z, args=a)))(*given)
    assert largest(z / (0.025 * np.log1p(current / least)) - 1) < 4 * np.finfo(dtype).eps


def current(gate, source, drain):
    """Of a transistor (C. Enz, F. Krummenacher and E. Vittoz, 1995), in volts and amperes."""
    squared = lambda u: jax.nn.softplus(u / 0.0517) ** 2  # noqa: E731
    pinch_off = (gate - 0.5) / 1.3
    forward, reverse = squared(pinch_off - source), squared(pinch_off - drain)
    return 1.7e-6 * (forward - reverse) * (1 + 0.1 * (drain - source))


def test_two_inverters_have_a_state_at_every_input():
    """One voltage is of 1e-10, the difference of two of 1.8, so that its corrections are roundoff
    while the other still moves."""

    def left_over(t, x, z, args):
        gate = jnp.stack([x, z[0]])
        return current(1.8 - gate, 0.0, 1.8 - z) - current(gate, 0.0, z) - 1e-12 * z

    inverters = pair(lambda t, x, z, args: 0 * x, left_over)
    x = np.linspace(0, 1.8, 37)
    guess = np.where(x[:, None] < 0.9, [1.8, 0.0], [0.0, 1.8])
    _, z = jax.jit(jax.vmap(inverters.consistent))(x, guess)
    g = jax.vmap(lambda x, z: left_over(0, x, z, None))
    matrix = jax.vmap(jax.jacfwd(lambda z, x: left_over(0, x, z, None)))(z, x)
    more = np.linalg.solve(matrix, g(x, z)[..., None])[..., 0]
    assert np.all(np.abs(more) <= 1e-15 + 1e-9 * np.abs(z))


def test_a_jump_before_a_diode_is_told_at_once():
    """Where it is declared. There Newton's method ends far away from the state."""
    current = lambda z: 1e-9 * jnp.expm1(z / 0.025)  # noqa: E731
    source = lambda t: jnp.where(t > 0.25, 5.0, 0.0)  # noqa: E731
    rectifier = pair(
        lambda t, x, z, a: (current(z) - x / 1e4) / 1e-5,
        lambda t, x, z, a: source(t) - x - z - 100 * current(z),
    )
    jump = dfx.ClipStepSizeController(dfx.PIDController(1e-6, 1e-8), jump_ts=[0.25])
    x = jnp.array(0.0)
    found = solve(rectifier, dfc.Radau(), x, x, None, controller=jump, dt0=0.1)
    assert "a step cannot start" in dfx.RESULTS[found.result]
    assert found.stats["num_steps"] < 20


def test_a_guess_at_which_roundoff_hides_the_unknowns_is_told():
    """An amplifier (Ebers and Moll), with 12 V where a junction has 0.7: a current of 1e187 A. No
    equation is to blame; from zero there is a state."""

    def left_over(t, x, z, args):
        base, collector, emitter = z
        forward, reverse = (1e-14 * jnp.expm1((base - v) / 0.02585) for v in (emitter, collector))
        out, into = forward - 2 * reverse, forward / 100 + reverse
        of_base = (12 - base) / 47e3 - base / 10e3 - into - (base - x) / 1e5
        return jnp.stack([of_base, (12 - collector) / 3.3e3 - out, out + into - emitter / 1e3])

    amplifier = pair(lambda t, x, z, args: -x + z[1], left_over)
    x, z = amplifier.consistent(jnp.array(0.0), jnp.zeros(3))
    assert largest(left_over(0.0, x, z, None)) < 1e-15
    fresh = pair(lambda t, x, z, args: z[1] - x, left_over)
    with pytest.raises(ValueError, match="roundoff hides"):
        fresh.consistent(x, jnp.array([12.0, 0, 0]))


def test_a_residual_in_any_unit_is_no_root():
    """Where it changes its sign by a jump, also if the squares of its terms overflow."""
    dae = pair(lambda t, x, z, a: 0 * x, lambda t, x, z, a: a * (jnp.sign(z - x) + z - x))
    find = jax.jit(lambda a: dae.consistent(jnp.array(1.0), jnp.array(1.5), args=a)[1])
    assert all(jnp.isnan(find(a)) for a in (1.0, 1e-160, 1e160))


def test_an_unknown_that_is_zero():
    """There the roundoff of the constants inside `g` is larger than all terms that its gradient
    shows."""
    dae = pair(lambda *_: 0.0, lambda t, x, z, a: a * (z + 0.1) - x)
    root = lambda a: dae.consistent(0.1 * a, 0 * a, args=a)[1]  # noqa: E731
    assert largest(jax.jit(jax.vmap(root))(np.array([3.0, 0.3, 49.0]))) <= EPS


@pytest.mark.slow
def test_an_ill_conditioned_matrix():
    matrix = 1 / (jnp.arange(8)[:, None] + jnp.arange(8) + 1.0)
    dae = pair(lambda t, x, z, a: -x, lambda t, x, z, a: a @ z - x)
    x = matrix @ jnp.ones(8)
    steps = dict(controller=dfx.ConstantStepSize(), dt0=1e-2, saveat=dfx.SaveAt(t1=True))
    found = solve(dae, dfx.Tsit5(), x, jnp.zeros(8), matrix, **steps)
    assert largest(matrix @ found.ys[1][0] - np.exp(-1) * x) < 1e-8


def test_units_change_nothing():
    """Equations and unknowns in other units: `A z + z³ = b`, with `A` not diagonally dominant."""
    matrix, b = np.random.default_rng(1).normal(size=(4, 4)), np.arange(1.0, 5.0)
    rows, columns = 2.0 ** np.array([30, 0, -30, 7]), 2.0 ** np.array([-40, 20, 0, 5])

    @jax.jit
    def root(rows, columns):
        g = lambda t, x, z, args: rows * (matrix @ (z * columns) + (z * columns) ** 3 - b)  # noqa: E731
        dae = pair(lambda *_: 0.0, g)
        return dae.consistent(jnp.array(0.0), 0.1 * jnp.ones(4) / columns)[1] * columns

    assert np.allclose(root(rows, columns), root(np.ones(4), np.ones(4)), rtol=1e-13)


CIRCLE = pair(lambda t, x, z, a: a, lambda t, x, z, a: x**2 + z**2 - 1)


@pytest.mark.parametrize(
    ("dae", "x", "z"), [(CIRCLE, 1.0, 0.0), (CIRCLE, 2.0, 1.0)], ids=["singular", "no root"]
)
def test_a_singular_state_is_refused(dae, x, z, errors_raise):
    given = jnp.array(x), jnp.array(z), jnp.array(1.0)
    consistent = lambda x, z, args: dae.consistent(x, z, args=args)  # noqa: E731
    with pytest.raises(ValueError, match=r"^`consistent` found no state"):
        consistent(*given)
    with pytest.raises(Exception, match="`consistent` found no state"):
        eqx.filter_jit(consistent)(*given)


@some_of("controller", [PRECISE, dfx.ConstantStepSize()], ids=["adaptive", "fixed"], period=2)
def test_a_solve_into_a_singular_state_fails(controller):
    """On a circle `z` ends at `x = 1`, which is reached at `t = 1`."""
    start = jnp.array(0.0), jnp.array(1.0), jnp.array(1.0)
    options = dict(controller=controller, dt0=0.01, saveat=dfx.SaveAt(t1=True))
    found = solve(CIRCLE, dfx.Heun(), *start, t1=2.0, **options)
    assert found.result != dfx.RESULTS.successful


X = jnp.ones(2)
PAIRED = pair(lambda t, x, z, args: (x, x), lambda t, x, z, args: x - z)
COMPLEX = dfc.DAE(lambda t, y, args: y, mass=lambda t, y, args: 1j * jnp.eye(2))
SPARE = pair(lambda t, x, z, args: x, lambda t, x, z, args: x - z)


test_mistakes_are_named = refused(
    (lambda: pair(lambda t, y, args: y, CUBIC.algebraic), TypeError, "`f` of a"),
    (lambda: pair(CUBIC.f, 1.0), TypeError, "`algebraic` of a"),
    (lambda: CUBIC.wrap(dfx.Tsit5), TypeError, "`solver` is"),
    (lambda: SPARE.consistent(X, jnp.array(1.0)), ValueError, "numbers, but `z` has"),
    (lambda: CUBIC.consistent(X, jnp.array([1, 1])), TypeError, "floating-point"),
    (lambda: CUBIC.term.vf(0.0, X[0], None), ValueError, r"a pair `\(x, z\)`"),
    (lambda: PAIRED.consistent(X[0], X[0]), ValueError, "`f` returns .* like `x`"),
    (lambda: dfc.DAE(CUBIC.f, mass=1j * np.eye(2)), ValueError, "dtype complex128"),
    (lambda: COMPLEX.consistent(X), ValueError, "dtype complex128.* 2 rows"),
    # The pair is taken as its parts.
    (lambda: PAIRED.report((X[0], X[0])), ValueError, "`f` returns .* like `x`"),
)


@some_of("k", [1, 3, 60], period=3)
def test_the_derivative_of_forces_does_not_depend_on_their_sizes(k):
    """A fluid in a row of `k + 1` pipes, whose pressures hold its speeds together. In a step the
    sizes of unknowns are those of their motion, which for pressures may have any ratios. With `D`
    for the differences, `D (a s - Dᵀ p) = 0`, so that `∂p/∂a = (D Dᵀ)⁻¹ D s`."""
    differences = np.eye(k + 1)[:k] - np.eye(k + 1)[1:]
    push, n = np.sin(np.arange(k + 1.0)), 2 * k + 1

    def f(t, y, a):
        speed, pressure = y[: k + 1], y[k + 1 :]
        force = a * push - jnp.pad(pressure, (0, 1)) + jnp.pad(pressure, (1, 0))
        return jnp.concatenate([force - speed**2 / 10, speed[:-1] - speed[1:]])

    dae = dfc.DAE(f, mass=np.diag(np.r_[np.ones(k + 1), np.zeros(k)]))
    solver, y0 = dae.wrap(dfc.Radau()), dae.consistent(jnp.ones(n), args=1.0)
    sizes = 10.0 ** np.r_[np.zeros(k + 1), np.random.default_rng(0).uniform(-8, 0, k)]

    def projected(a):
        problem = problem_of(solver.manifold, jnp.zeros(2 * k), 0.0, y0, a)
        problem = dataclasses.replace(problem, factor=Diagonal(jnp.asarray(sizes)))
        return solver.projection.solve(problem, y0)[0]

    _, tangent = jax.jit(lambda a: jax.jvp(projected, (a,), (1.0,)))(1.0)
    exact = np.linalg.solve(differences @ differences.T, differences @ push)
    np.testing.assert_allclose(tangent[k + 1 :], exact, rtol=0, atol=1e-9 * np.max(abs(exact)))
    np.testing.assert_allclose(tangent[: k + 1], 0, atol=1e-9)


def test_the_derivative_in_single_precision_does_not_depend_on_the_unit_of_a_force():
    """A pendulum of index 3: the mass is a factor of the force, and of nothing else. Compared with
    an ordinary differential equation for the angle."""

    def residual(t, y, slope, args):
        (q, v, force), (dq, dv, _), (mass, gravity) = y, slope, args
        down = jnp.array([0, 1], q.dtype)
        return dq - v, mass * dv + force * q + mass * gravity * down, jnp.sum(q**2) - 1

    dae = dfc.DAE(residual=residual)
    guess = tuple(np.array(x, np.float32) for x in ([0.6, -0.8], [0.8, 0.6], 0))

    def end(gravity, mass):
        y0 = dae.consistent(guess, args=(mass, gravity))
        steps = dfx.PIDController(rtol=1e-5, atol=1e-5)
        t0, t1, dt0 = np.float32([0, 2, 0.01])
        found = dfx.diffeqsolve(
            *(dae.term, dae.wrap(dfc.Radau()), t0, t1, dt0, y0, (mass, gravity)),
            **dict(stepsize_controller=steps, adjoint=dfx.ForwardMode(), max_steps=200),
        )
        q, v, force = (x[-1] for x in found.ys)
        return jnp.concatenate([q, v, force[None] / mass])

    def by_angle(gravity):
        field = lambda t, y, args: jnp.stack([y[1], -gravity * jnp.sin(y[0])])  # noqa: E731
        y0 = jnp.array([np.arctan2(0.6, 0.8), 1.0])
        options = dict(stepsize_controller=PRECISE, adjoint=dfx.ForwardMode(), max_steps=4096)
        found = dfx.diffeqsolve(dfx.ODETerm(field), dfx.Tsit5(), 0, 2, 0.01, y0, **options)
        angle, speed = found.ys[-1]
        sine, cosine = jnp.sin(angle), jnp.cos(angle)
        return jnp.stack([sine, -cosine, cosine * speed, sine * speed, speed**2 + gravity * cosine])

    one, masses = jnp.float32(1), jnp.array([1e-12, 1e-8, 1e-4, 1, 1e4], jnp.float32)
    tangent = lambda mass: jax.jvp(lambda g: end(g, mass), (9.81 * one,), (one,))[1]  # noqa: E731
    expected = jax.jvp(by_angle, (9.81,), (1.0,))[1]
    for found in jax.jit(jax.vmap(tangent))(masses):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4 * largest(expected))


def test_a_solve_that_meets_a_fold_ends_there():
    """`x = 1 - z²` with `x' = 1` has no solution after `t = 1`."""
    dae = pair(lambda t, x, z, args: jnp.ones_like(x), lambda t, x, z, args: 1 - z**2 - x)
    steps = dfx.PIDController(rtol=1e-4, atol=1e-4)
    y0 = dae.consistent(jnp.zeros(1), jnp.ones(1))
    options = dict(stepsize_controller=steps, max_steps=1000, throw=False)
    found = dfx.diffeqsolve(dae.term, dae.wrap(dfc.Radau()), 0.0, 2.0, 0.01, y0, **options)
    assert found.result == dfx.RESULTS.nonlinear_divergence
    assert found.stats["num_steps"] < 250


def test_second_derivatives_of_a_consistent_state():
    """The force in a pendulum of mass `m` is `m (w² + g cos θ)`, by its velocity `w`. While one
    stage is sought, the constraints of others are rows of zeros."""
    down = jnp.array([0.0, -9.81])

    def equations(t, y, slopes, mass):
        (q, v, force), (dq, dv, _) = y, slopes
        return dq - v, mass * (dv - down) + force * q, jnp.sum(q**2) - 1

    dae, q = dfc.DAE(residual=equations), jnp.array([0.6, -0.8])

    def force(w):
        return dae.consistent((q, w * jnp.array([0.8, 0.6]), jnp.array(2.0)), args=1.3)[2]

    assert np.isclose(jax.jit(jax.jacrev(jax.jacfwd(force)))(0.4), 2 * 1.3, rtol=1e-12)
