"""Vector fields made of others: tangent ones, as of mechanisms from masses, forces and position
constraints alone, and clipped ones, which see only admissible states."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import diffrax_conserve as dfc
from diffrax_conserve._solver.state import updated_units

from .problems import EPS, difference, refused, solve
from .thinned import some_of

KEYS = jr.split(jr.key(0), 20)


GRAVITY = 9.81
PENDULUM = dfc.systems.CartesianPendulum(length=1.3, gravity=GRAVITY)


def falling(t, y, args):
    return y[1], jnp.array([0.0, -GRAVITY])


POSITION = dfc.Constraint(lambda t, y, args: jnp.sum(y[0] ** 2) - 1.3**2)
ROD_MANIFOLD = {"position": POSITION, "velocity": POSITION.derivative(falling)}
ROD = dfc.tangent(falling, ROD_MANIFOLD["velocity"], metric=(jnp.inf, jnp.ones(2)))
T1 = 2.0


@jax.jit
@jax.vmap
def drawn(key):
    return PENDULUM.sample(key)


def test_the_field_is_that_of_lagrange():
    """And the multiplier the force in the rod, here for the gradient `2q`."""

    @jax.jit
    @jax.vmap
    def found(y):
        fields = ROD(0.0, y, None), PENDULUM.vector_field(0.0, y, None)
        return *fields, ROD.multipliers(0.0, y)

    field, known, forces = found(drawn(KEYS))
    assert difference(field, known) < 100 * EPS
    q, v = map(np.asarray, drawn(KEYS))
    tension = (np.sum(v**2, 1) - GRAVITY * q[:, 1]) / np.sum(q**2, 1)
    assert np.allclose(2 * forces, -tension, rtol=1e-13, atol=1e-13)


@pytest.mark.slow
def test_all_constraints_make_the_same_field_as_that_of_the_velocity():
    both = dfc.tangent(falling, ROD_MANIFOLD, metric=(jnp.inf, jnp.ones(2)))
    one, two = jax.jit(jax.vmap(lambda y: [f(0.0, y, None) for f in (ROD, both)]))(drawn(KEYS))
    assert difference(one, two) < 100 * EPS
    assert dfc.check_invariance(ROD, ROD_MANIFOLD, drawn(KEYS)).ok


@pytest.mark.slow
def test_a_gain_lets_the_residual_decay():
    """`g' = -gain g`, also for an integral with a value and a constraint that moves with time."""
    manifold = (
        dfc.Constraint(lambda t, y, args: jnp.sum(y[:2] ** 2) - (2 + jnp.sin(t))),
        dfc.FirstIntegral(lambda t, y, args: y[2] + y[0] ** 3, value=0.4),
    )
    field = dfc.tangent(lambda t, y, args: jnp.cos(y + t), manifold, gain=3.0)
    y0 = jnp.array([1.0, 0.5, 0.2])
    end = solve(field, dfc.RK4(), y0, t1=T1, dt0=T1 / 2000, max_steps=None).ys[-1]
    before = jnp.stack([jnp.sum(y0[:2] ** 2) - 2, y0[2] + y0[0] ** 3 - 0.4])
    after = [jnp.sum(end[:2] ** 2) - (2 + jnp.sin(T1)), end[2] + end[0] ** 3 - 0.4]
    assert jnp.allclose(jnp.stack(after), before * jnp.exp(-3.0 * T1), rtol=1e-6, atol=1e-11)


def test_a_balance_is_met():
    states = jr.normal(KEYS[0], (20, 3))
    balance = dfc.FirstIntegral(
        lambda t, y, args: jnp.sum(y**2), rate=lambda t, y, args: -jnp.sum(y**4)
    )
    field = dfc.tangent(lambda t, y, args: jnp.sin(y), balance)
    assert dfc.check_invariance(field, balance, states).ok


def test_the_hidden_constraint_of_a_moving_one():
    """`d/dt` of `|q - (t², 0)|² - 1`, and once more."""

    def free(t, y, args):
        return y[1], jnp.array([0.0, -args])

    def shifted(t, y):
        return y[0] - jnp.array([t**2, 0.0])

    rod = dfc.Constraint(lambda t, y, args: jnp.sum(shifted(t, y) ** 2) - 1)
    y, t = (jnp.array([0.3, 0.4]), jnp.array([1.0, -2.0])), 1.5
    d, w = shifted(t, y), y[1] - jnp.array([2 * t, 0.0])
    first, second = rod.derivative(free), rod.derivative(free).derivative(free)
    assert jnp.allclose(first.fn(t, y, 9.0), 2 * d @ w, rtol=1e-14)
    curvature = jnp.array([0.0, -9.0]) - jnp.array([2.0, 0.0])
    assert jnp.allclose(second.fn(t, y, 9.0), 2 * (w @ w + d @ curvature), rtol=1e-14)


ROW, LIKE = dfc.FirstIntegral(lambda t, y, args: y[0]), r"`vector_field` returns the structure"
GROWING = dfc.FirstIntegral(lambda t, y, args: y, value=0.0, rate=lambda t, y, args: y)


test_mistakes_are_named = refused(
    (lambda: dfc.tangent(dfx.ODETerm(falling), ROW), TypeError, "vector_field"),
    (lambda: dfc.tangent(falling, ROW, gain=1.0), ValueError, "no value that it could return"),
    (lambda: dfc.tangent(falling, GROWING, gain=1.0), ValueError, "changes at its `rate`"),
    (lambda: dfc.tangent(falling, ROD_MANIFOLD), ValueError, r"Pass `metric=\(jnp.inf, masses"),
    (
        lambda: dfc.tangent(falling, ROW, metric=(1.0,))(0.0, PENDULUM.y0, None),
        ValueError,
        "`metric` has the structure",
    ),
    *(
        (lambda f=f, out=out: f(lambda *_: out)(0.0, jnp.ones(3), None), ValueError, LIKE)
        for out in (jnp.ones(2), (jnp.ones(3),), None)
        for f in (
            lambda field: dfc.tangent(field, ROW),
            lambda field: dfc.Constraint(ROW.fn).derivative(field).fn,
        )
    ),
)


# ---- Vector fields that see only admissible states ----

SEEN = dfc.clipped(lambda t, y, args: (2 * y[0], y[1]), lower=(0.0, -1.0), upper=(1.0, jnp.inf))
SLOPE = jax.jit(lambda y: SEEN(0.0, y, None))


@given(st.lists(st.floats(-3, 3, width=16), min_size=4, max_size=4))
def test_the_field_sees_the_nearest_admissible_state(numbers):
    a, b = np.array(numbers[:2]), np.array(numbers[2:])
    found = SLOPE((jnp.asarray(a), jnp.asarray(b)))
    assert np.array_equal(found[0], 2 * np.clip(a, 0, 1))
    assert np.array_equal(found[1], np.maximum(b, -1))


def test_the_derivative_is_that_from_inside_at_a_bound_and_zero_outside():
    slope = jax.grad(lambda y: SEEN(0.0, (y, y), None)[0])
    assert [float(slope(y)) for y in (-1e-9, 0.0, 0.5, 1.0, 1.1)] == [0, 2, 2, 2, 0]


def test_nan_stays_nan():
    assert jnp.isnan(SEEN(0.0, (jnp.nan, 0.0), None)[0])


@some_of("solver", [dfx.Tsit5(), dfx.Kvaerno3()], ids=["Tsit5", "Kvaerno3"], period=2)
def test_no_stage_is_evaluated_outside(solver):
    """`y' = -sqrt(y)` from one, which ends at `t = 2`, known from `y = (1 - t/2)²`."""
    worst = []

    def outflow(t, y, args):
        jax.debug.callback(lambda y: worst.append(float(y)), y)
        return -jnp.sqrt(y)

    field = dfc.clipped(outflow, lower=1e-30)
    controller = dfx.PIDController(rtol=1e-5, atol=1e-7)
    saveat = dfx.SaveAt(ts=jnp.array([1.0, 3.0]))
    options = dict(stepsize_controller=controller, saveat=saveat, max_steps=4096)
    found = solve(field, solver, jnp.array(1.0), t1=3.0, **options).ys
    jax.effects_barrier()
    assert np.min(worst) >= 1e-30
    assert np.allclose(found, [0.25, 0.0], rtol=0, atol=1e-4)


test_mistakes_with_bounds_are_named = refused(
    (lambda: dfc.clipped(1.0, lower=0.0), TypeError, "`vector_field` is"),
    (lambda: dfc.clipped(SEEN), ValueError, "needs a bound"),
    (lambda: dfc.clipped(SEEN, lower="0"), TypeError, "`lower` is"),
    (lambda: dfc.clipped(SEEN, lower=1.0, upper=0.0), ValueError, "at most `upper`"),
    (lambda: SEEN(0.0, jnp.ones(2), None), ValueError, "`lower` has the structure"),
    (lambda: SEEN(0.0, (1, 1), None), TypeError, "floating-point"),
)


@some_of("k, turns", [(10, 0), (10, 1), (40, 0)], period=3)
def test_a_chain_at_rest_is_pushed_at_its_end(k, turns):
    """If it is straight, each link moves by the square of what moves the next one; if it is like
    stairs, even less. The end and its derivative are those of a plain solve up to its tolerance."""
    links_along = np.eye(2)[turns * np.arange(k) % 2]

    def lengths(t, y, push):
        return jnp.sum(jnp.diff(y[0], axis=0, prepend=0.0) ** 2, axis=1) - 1

    def free(t, y, push):
        return y[1], jnp.zeros((k, 2)).at[-1, 1].set(push)

    links = dfc.Constraint(lengths)
    field = dfc.tangent(free, links.derivative(free), metric=(jnp.inf, 1.0))
    kept = dfc.ManifoldProjection(dfx.Tsit5(), (links, links.derivative(free)))

    def end(solver, push):
        y0 = jnp.asarray(np.cumsum(links_along, axis=0)), jnp.zeros((k, 2))
        steps = dfx.PIDController(rtol=1e-7, atol=1e-9)
        options = dict(stepsize_controller=steps, adjoint=dfx.ForwardMode(), max_steps=128)
        return dfx.diffeqsolve(dfx.ODETerm(field), solver, 0.0, 0.1, 1e-3, y0, push, **options).ys

    plain, projected = (
        jax.jit(lambda push, solver=solver: jax.jvp(lambda x: end(solver, x), (push,), (1.0,)))(1.0)
        for solver in (dfx.Tsit5(), kept)
    )
    for actual, expected in zip(*map(jax.tree.leaves, (projected, plain)), strict=True):
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-6 * np.max(np.abs(expected)))


def test_units_have_a_derivative_where_squares_underflow():
    """The unit `√(size change)` of a component that moves by 1e-200 from zero is its size."""
    like = jax.ShapeDtypeStruct((2,), float)
    units = lambda y: updated_units(jnp.zeros(2), jnp.abs(y), y, like)  # noqa: E731
    y = jnp.array([1e-200, 2.0])
    for value in jax.jvp(units, (y,), (y,)):
        np.testing.assert_allclose(value, y, rtol=1e-15)
