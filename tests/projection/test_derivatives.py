"""Derivatives of a projection, against finite differences."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from ..problems import OMEGA0
from ..thinned import some_of

PROJECTIONS = {"simplified": dfc.SimplifiedNewton(), "newton": dfc.Newton()}
each_projection = pytest.mark.parametrize("projection", list(PROJECTIONS.values()), ids=PROJECTIONS)
one_projection = some_of("projection", PROJECTIONS.values(), ids=PROJECTIONS, period=2)


class Energy(eqx.Module):
    """An integral with parameters of its own."""

    inertia: jax.Array

    def __call__(self, t, w, args):
        return jnp.sum(self.inertia * w**2) / 2 + args["tilt"] * t * w[0]


def momentum(t, w, args):
    del t
    return jnp.sum(args["squares"] * w**2)


INPUTS = dict(
    inertia=jnp.array([0.1, 0.2, 0.3]),
    args={"tilt": jnp.array(0.05), "squares": jnp.array([0.01, 0.04, 0.09])},
    values=(jnp.array(0.31), jnp.array(0.142)),
    t=jnp.array(0.4),
    y=OMEGA0 + jnp.array([0.02, -0.03, 0.01]),
    metric=jnp.array([1.0, 2.0, 0.5]),
)


def projected(inputs, projection):
    manifold = (dfc.FirstIntegral(Energy(inputs["inertia"])), dfc.FirstIntegral(momentum))
    projection = eqx.tree_at(
        lambda p: p.metric, projection, inputs["metric"], is_leaf=lambda x: x is None
    )
    options = dict(t=inputs["t"], args=inputs["args"], value=inputs["values"])
    return dfc.project(manifold, inputs["y"], projection=projection, **options)[0]


def loss(inputs, projection):
    return jnp.sum(jnp.array([1.0, -2.0, 0.5]) * projected(inputs, projection) ** 3)


@one_projection
def test_gradient_agrees_with_finite_differences(projection):
    """With respect to the state, time, args, conserved values, the metric and what is in `fn`."""
    dct.assert_gradients(lambda inputs: loss(inputs, projection), INPUTS, rtol=1e-7)
    gradient = eqx.filter_jit(jax.grad(loss))(INPUTS, projection)
    for name, part in gradient.items():
        assert all(np.any(np.asarray(x) != 0) for x in jax.tree.leaves(part)), name


@one_projection
def test_a_component_that_is_never_moved_may_have_any_unit(projection):
    """The state is radial, at the distance `sqrt(1 - k z)`."""
    projection = eqx.tree_at(
        lambda p: p.metric, projection, jnp.array([1.0, 1.0, jnp.inf]), is_leaf=lambda x: x is None
    )
    circle = dfc.Constraint(lambda t, y, k: y[0] ** 2 + y[1] ** 2 + k * y[2] - 1)
    found = jax.jit(
        jax.jacfwd(lambda y, k: dfc.project(circle, y, args=k, projection=projection)[0])
    )
    exact = jax.jacfwd(
        lambda y: jnp.append(y[:2] * jnp.sqrt((1 - y[2]) / jnp.sum(y[:2] ** 2)), y[2])
    )
    for k in 1.0, 1e12, 1e28:
        y, units = jnp.array([1.01, 0.1, 0.01]), np.array([1, 1, k])
        got = found(y / units, k) / units * units[:, None]
        np.testing.assert_allclose(got, exact(y), rtol=0, atol=1e-12)


@pytest.mark.slow
@each_projection
def test_second_derivatives(projection):
    dct.assert_gradients(lambda inputs: jax.grad(loss)(inputs, projection), INPUTS, rtol=1e-6)


@one_projection
def test_a_lane_that_failed_spoils_no_other(projection):
    """In reverse mode as in forward mode, its derivative is NaN or unused, and nothing raises."""

    def one(x):
        sphere = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)
        y, info = dfc.project(sphere, x, projection=projection)
        return jnp.sum(y * jnp.array([1.0, 2.0])), info.ok

    lanes = jnp.array([[1.0, 0.3], [jnp.nan, 1.0], [jnp.inf, 1.0], [0.2, 1.4]])
    _, gradients = jax.jit(jax.vmap(jax.value_and_grad(one, has_aux=True)))(lanes)
    direction = lanes / jnp.linalg.norm(lanes, axis=1, keepdims=True)
    across = jnp.stack([-direction[:, 1], direction[:, 0]], axis=1)
    exact = across * (across @ jnp.array([1.0, 2.0]) / jnp.linalg.norm(lanes, axis=1))[:, None]
    np.testing.assert_allclose(gradients[::3], exact[::3], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-20, 1e-30])
def test_squares_that_underflow_leave_the_derivative_as_it_is(size):
    """At a saved time, in reverse mode: of an oscillator in single precision, whose energy is zero
    as a number."""
    solver = dfc.ManifoldProjection(dfx.Tsit5(), dfc.FirstIntegral(lambda t, y, a: jnp.sum(y**2)))
    term = dfx.ODETerm(lambda t, y, args: jnp.stack([y[1], -y[0]]))
    start, end, step, time = (jnp.asarray(x, jnp.float32) for x in (0, 0.2, 0.1, 0.15))

    def position(y):
        saved = dfx.SaveAt(ts=time[None])
        return dfx.diffeqsolve(term, solver, start, end, step, y, saveat=saved).ys[0, 0]

    found = jax.jit(jax.grad(position))(jnp.array([size, 0], jnp.float32))
    np.testing.assert_allclose(found, [np.cos(0.15), np.sin(0.15)], rtol=1e-5)


def test_derivatives_are_linear_or_nan():
    """Linear in the tangent, also in a very small one; where the constraint has an infinite
    derivative, NaN in both modes."""
    axes = jnp.linspace(1.0, 2.0, 20)
    manifold = dfc.Constraint(lambda t, y, args: jnp.sqrt(y[0]) + jnp.sum(axes * y[1:] ** 2) - 1)

    @jax.jit
    def both_modes(y, v):
        project = lambda y: dfc.project(manifold, y, projection=dfc.Newton())[0]  # noqa: E731
        return jax.jvp(project, (y,), (v,))[1], jax.vjp(project, y)[1](v)[0]

    rng = np.random.default_rng(0)
    y, v = rng.normal(size=(2, 21))
    y = 0.14 * y
    y[0] = 0.3
    for found, tiny in zip(both_modes(y, v), both_modes(y, 1e-14 * v), strict=True):
        assert np.all(np.isfinite(found))
        np.testing.assert_allclose(1e14 * tiny, found, rtol=0, atol=1e-11)
    on_it = np.zeros(21)
    on_it[1] = 1
    assert all(np.all(np.isnan(x)) for x in both_modes(on_it, v))


ELLIPSE = dfc.FirstIntegral(lambda t, y, args: jnp.sum((y / jnp.array([2.0, 1.0])) ** 2))


@some_of("dtype", [jnp.float64, jnp.float32], ids=["float64", "float32"], period=2)
def test_the_nearest_point_is_one_to_roundoff_whatever_the_tolerance(dtype):
    """A tolerance is for the residuals. The units make it larger than the distances."""

    def nearest(y, unit, **tolerances):
        ellipse = dfc.FirstIntegral(lambda t, y, args: ELLIPSE.fn(t, y / unit, args), value=1.0)
        return dfc.project(ellipse, y * unit, projection=dfc.Newton(**tolerances))[0] / unit

    y = jnp.asarray([3.0, 2.0], dtype)
    # The line from the candidate to a nearest point is along the gradient there.
    found = nearest(y, 1e-9, rtol=1e-6, atol=1e-6)
    (dx, dy), (gx, gy) = y - found, found / jnp.array([4.0, 1.0])
    eps = float(jnp.finfo(dtype).eps)
    assert abs(dx * gy - dy * gx) < 16 * eps
    got = jax.jacrev(lambda y: nearest(y, 1e-9, rtol=1e-6, atol=1e-6))(y)
    # For the distance `d` and the curvature `k` there, tangents are multiplied by `1 / (1 + k d)`.
    across = np.array([-gy, gx]) / np.hypot(gx, gy)
    curvature = 1 / (4 * np.hypot(gx, gy) ** 3)
    share = 1 / (1 + np.hypot(dx, dy) * curvature)
    off = abs(ELLIPSE.fn(0.0, found, None) - 1)  # the residual may be as large as its tolerance
    limit = 256 * eps + 16 * off
    np.testing.assert_allclose(got, share * np.outer(across, across), rtol=0, atol=limit)
    assert off < 1e-7


def test_beyond_the_largest_system_the_derivative_is_nan_in_everything():
    def moved(y, value):
        return dfc.project(many, y, value=value, projection=dfc.Newton())[0][3]

    many = dfc.FirstIntegral(lambda t, y, args: jnp.sum(jnp.arange(1.0, 601.0) * y**2))
    for gradient in jax.jit(jax.grad(moved, (0, 1)))(jnp.linspace(0.1, 0.9, 600), 1.0):
        assert np.all(np.isnan(gradient))


def test_the_correction_is_along_the_gradients_at_the_candidate_in_the_last_step_too():
    """So that the derivative is that of what is returned, whatever the tolerance."""
    candidates = jnp.array([[1.5, 1.0], [0.5, 1.5], [2.5, -0.3]])
    projection = dfc.SimplifiedNewton(rtol=1e-2)

    def off(y):
        found, info = dfc.project(ELLIPSE, y, value=1.0, projection=projection)
        (dx, dy), (gx, gy) = found - y, jax.grad(lambda y: ELLIPSE.fn(0, y, None))(y)
        return dx * gy - dy * gx, info.num_steps

    for found, steps in (jax.jit(jax.vmap(off))(candidates), jax.jit(off)(candidates[0])):
        assert jnp.all(steps > 1)
        assert jnp.max(jnp.abs(found)) < 1e-15
