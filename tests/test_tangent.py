"""Tangent fields: mechanisms from masses, forces and position constraints alone."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc

from .problems import largest, refused, solve

EPS = np.finfo(np.float64).eps
KEYS = jr.split(jr.key(0), 20)


def mechanism(positions, force, masses):
    """The field and the manifold of masses at `q` that `positions(q) = 0` holds together."""

    def free(t, y, args):
        return y[1], force / masses

    position = dfc.Constraint(lambda t, y, args: positions(y[0]))
    manifold = {"position": position, "velocity": position.derivative(free)}
    field = dfc.tangent(free, manifold["velocity"], metric=(jnp.inf, masses))
    return field, manifold, free


GRAVITY = 9.81
PENDULUM = dfc.systems.CartesianPendulum(length=1.3, gravity=GRAVITY)
STATES = jax.jit(jax.vmap(PENDULUM.sample))(KEYS)
ROD, ROD_MANIFOLD, FALLING = mechanism(
    lambda q: jnp.sum(q**2) - 1.3**2, jnp.array([0.0, -GRAVITY]), jnp.ones(2)
)

MASSES, LENGTHS = np.array([1.0, 0.7]), np.array([1.0, 0.6])
DOUBLE, DOUBLE_MANIFOLD, _ = mechanism(
    lambda q: jnp.sum(jnp.diff(q, axis=0, prepend=0.0) ** 2, 1) - LENGTHS**2,
    -GRAVITY * MASSES[:, None] * np.array([0.0, 1.0]),
    MASSES[:, None] * np.ones((1, 2)),
)


def in_angles(t, y, args):
    """The double pendulum in angles and angular velocities, as textbooks have it."""
    (a, b), (u, v) = y
    (m1, m2), (l1, l2), d = MASSES, LENGTHS, a - b
    mass = jnp.array([[(m1 + m2) * l1, m2 * l2 * jnp.cos(d)], [m2 * l1 * jnp.cos(d), m2 * l2]])
    force = jnp.array(
        [
            -m2 * l2 * v**2 * jnp.sin(d) - (m1 + m2) * GRAVITY * jnp.sin(a),
            m2 * l1 * u**2 * jnp.sin(d) - m2 * GRAVITY * jnp.sin(b),
        ]
    )
    return y[1], jnp.linalg.solve(mass, force)


def cartesian(angles, rates):
    def positions(angles):
        return jnp.cumsum(
            LENGTHS[:, None] * jnp.stack([jnp.sin(angles), -jnp.cos(angles)], 1), axis=0
        )

    return jax.jvp(positions, (angles,), (rates,))


ANGLES = jnp.array([1.2, -0.4]), jnp.array([0.3, 1.0])
T1 = 2.0


def final(field, solver, y0, steps=2000):
    ys = solve(field, solver, y0, t1=T1, dt0=T1 / steps, max_steps=None).ys
    return jax.tree.map(lambda y: y[-1], ys)


def distance(a, b):
    return largest(jax.tree.map(jnp.subtract, a, b))


def test_the_field_is_that_of_lagrange():
    """And the multiplier the force in the rod, here for the gradient `2q`."""

    @jax.jit
    @jax.vmap
    def found(y):
        fields = ROD(0.0, y, None), PENDULUM.vector_field(0.0, y, None)
        return *fields, ROD.multipliers(0.0, y)

    field, known, forces = found(STATES)
    assert distance(field, known) < 100 * EPS
    q, v = STATES
    tension = (jnp.sum(v**2, 1) - GRAVITY * q[:, 1]) / jnp.sum(q**2, 1)
    assert jnp.allclose(2 * forces, -tension, rtol=1e-13, atol=1e-13)


@pytest.mark.slow
def test_projecting_the_free_field_is_not_enough():
    """diffrax issue 328: it succeeds, on the manifold, and is wrong however short the steps."""
    end = jax.tree.map(lambda y: y[-1], PENDULUM.reference(jnp.array([0.0, T1])))
    nearest = dfc.SimplifiedNewton(metric=1.0)
    solver = dfc.ManifoldProjection(dfc.RK4(), ROD_MANIFOLD["position"], projection=nearest)
    assert all(distance(final(FALLING, solver, PENDULUM.y0, n), end) > 0.1 for n in (200, 400))


@pytest.mark.slow
def test_a_mechanism_agrees_with_angles():
    solver = dfc.ManifoldProjection(dfc.RK4(), DOUBLE_MANIFOLD)
    end = cartesian(*final(in_angles, dfc.RK4(), ANGLES))
    found = final(DOUBLE, solver, cartesian(*ANGLES))
    assert distance(found, end) < 1e-8


@pytest.mark.slow
def test_all_constraints_make_the_same_field_as_that_of_the_velocity():
    both = dfc.tangent(FALLING, ROD_MANIFOLD, metric=(jnp.inf, jnp.ones(2)))
    one, two = jax.jit(jax.vmap(lambda y: [f(0.0, y, None) for f in (ROD, both)]))(STATES)
    assert distance(one, two) < 100 * EPS
    assert dfc.check_invariance(ROD, ROD_MANIFOLD, STATES).ok


@pytest.mark.slow
def test_a_gain_lets_the_residual_decay():
    """`g' = -gain g`, also for an integral with a value and a constraint that moves with time."""
    manifold = (
        dfc.Constraint(lambda t, y, args: jnp.sum(y[:2] ** 2) - (2 + jnp.sin(t))),
        dfc.FirstIntegral(lambda t, y, args: y[2] + y[0] ** 3, value=0.4),
    )
    field = dfc.tangent(lambda t, y, args: jnp.cos(y + t), manifold, gain=3.0)
    y0 = jnp.array([1.0, 0.5, 0.2])
    end = final(field, dfc.RK4(), y0)
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
    (lambda: dfc.tangent(dfx.ODETerm(FALLING), ROW), TypeError, "vector_field"),
    (lambda: dfc.tangent(FALLING, ROW, gain=1.0), ValueError, "no value that it could return"),
    (lambda: dfc.tangent(FALLING, GROWING, gain=1.0), ValueError, "changes at its `rate`"),
    (
        lambda: dfc.tangent(FALLING, ROW, metric=(1.0,))(0.0, PENDULUM.y0, None),
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
