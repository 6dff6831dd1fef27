"""Projection part by part."""

import equinox as eqx
import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from ..problems import refused

INF = jnp.inf


MANIFOLD = {
    "tangent": dfc.Constraint(lambda t, y, args: jnp.sum(y[0] * y[1])),
    "circle": dfc.Constraint(lambda t, y, args: jnp.sum(y[0] ** 2) - 1),
}
FIRST, SECOND = (
    dfc.SimplifiedNewton(metric=(1.0, INF), atol=1e-15),
    dfc.SimplifiedNewton(metric=(INF, 1.0), atol=1e-15),
)
ALONG_ERROR = dfc.AlongLine(direction="error")
STAGED = dfc.Staged(("circle", FIRST), ("tangent", SECOND))
Y0 = jnp.array([1.0, 0.0]), jnp.zeros(2)


@eqx.filter_jit
def projected(y):
    return dfc.project(MANIFOLD, y, projection=STAGED)


vector = st.tuples(st.floats(-1, 1), st.floats(-1, 1)).map(np.array)


@settings(max_examples=20)
@given(st.floats(0, 6.3), vector, vector, vector)
def test_it_is_the_two_projections_by_hand(angle, velocity, dq, dv):
    """Radially to the circle, then the velocity along it: CVODE's `proj`."""
    q = np.array([np.cos(angle), np.sin(angle)]) + 1e-2 * dq
    v, unit = velocity + 1e-2 * dv, q / np.linalg.norm(q)
    (found_q, found_v), info = projected((q, v))
    assert info.ok
    np.testing.assert_allclose(found_q, unit, rtol=0, atol=4e-15)
    np.testing.assert_allclose(found_v, v - unit * (unit @ v), rtol=0, atol=4e-15)


def test_what_an_earlier_stage_reached_is_held():
    """Even where a later one may move everything."""
    radius = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
    total = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**3))
    y = jnp.array([1.0, 0.5, -0.2])
    staged = dfc.Staged((0, dfc.SimplifiedNewton()), (1, dfc.SimplifiedNewton()))
    found, info = dfc.project((radius, total), 1.01 * y, value=(1.29, 1.117), projection=staged)
    assert info.ok
    np.testing.assert_allclose([found @ found, jnp.sum(found**3)], [1.29, 1.117], rtol=4e-15)


@pytest.mark.slow
def test_derivatives_in_both_modes_agree_with_finite_differences():
    y = jnp.array([0.9, 0.5]), jnp.array([-0.4, 0.8])
    dct.assert_gradients(lambda *y: projected(y)[0], *y, rtol=1e-6)


def test_a_stage_that_cannot_hold_is_a_failure():
    """Positions on the circle cannot be reached by moving velocities."""
    wrong = dfc.Staged(("circle", SECOND), ("tangent", SECOND))
    _, info = dfc.project(MANIFOLD, (jnp.array([1.1, 0.0]), jnp.ones(2)), projection=wrong)
    assert not info.ok


def of(*stages):
    return lambda: dfc.project(MANIFOLD, Y0, projection=dfc.Staged(*stages))


test_mistakes_are_named = refused(
    (of(("circle", FIRST)), ValueError, "Give each entry one stage"),
    (of(("circle", FIRST), ("circle", SECOND)), ValueError, "Give each entry one stage"),
    (of(("no", FIRST)), ValueError, "Give each entry one stage"),
    (of(FIRST), TypeError, "must be a pair"),
    (of(("circle", ALONG_ERROR)), TypeError, "a projection with `sees_step = False`"),
)
