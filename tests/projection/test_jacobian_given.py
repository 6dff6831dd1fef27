"""Functions with a Jacobian of their own, here calls of numpy that autodiff cannot see."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import diffrax_conserve as dfc

from ..thinned import some_of


def called(fn, *shapes):
    """`fn` of numpy as a function of `y` alone."""
    return lambda t, y, args: jax.pure_callback(
        fn, jax.ShapeDtypeStruct(shapes, y.dtype), y, vmap_method="sequential"
    )


def in_numpy(y):
    y = np.asarray(y)
    return np.asarray(y[1] ** 2 / 2 - np.cos(y[0]), y.dtype)


def slope_in_numpy(y):
    y = np.asarray(y)
    return np.stack([np.sin(y[0]), y[1]]).astype(y.dtype)


def slope(t, y, args):
    return jnp.stack([jnp.sin(y[0]), y[1]])


SEEN = dfc.FirstIntegral(lambda t, y, args: y[1] ** 2 / 2 - jnp.cos(y[0]))
CALLED = dfc.FirstIntegral(called(in_numpy), jacobian=slope)
ALL_CALLED = dfc.FirstIntegral(called(in_numpy), jacobian=called(slope_in_numpy, 2))
TERM = dfx.ODETerm(lambda t, y, args: jnp.stack([y[1], -args * jnp.sin(y[0])]))
Y0, ONE = jnp.array([1.0, 0.5]), jnp.array(1.0)
ADAPTIVE = {"dt0": None, "stepsize_controller": dfx.PIDController(rtol=1e-5, atol=1e-5)}


@eqx.filter_jit
def solve(manifold, y0=Y0, args=ONE, projection=None, **options):
    projection = dfc.SimplifiedNewton() if projection is None else projection
    solver = dfc.ManifoldProjection(dfx.Tsit5(), manifold, projection=projection)
    return dfx.diffeqsolve(TERM, solver, 0.0, 1.0, y0=y0, args=args, **({"dt0": 0.2} | options))


def same(a, b, tolerance=1e-12):
    np.testing.assert_allclose(a, b, atol=tolerance)


@some_of("manifold", [CALLED, ALL_CALLED], ids=["jax", "numpy"], period=2)
def test_a_solve_with_it_is_the_solve_with_autodiff(manifold):
    options = ADAPTIVE | {"saveat": dfx.SaveAt(ts=jnp.linspace(0, 1, 6), dense=True)}
    got, expected = solve(manifold, **options), solve(SEEN, **options)
    same(got.ys, expected.ys)
    evaluate = eqx.filter_jit(lambda sol: sol.evaluate(0.31))
    same(evaluate(got), evaluate(expected))
    for y in got.ys:
        np.testing.assert_allclose(in_numpy(y), in_numpy(Y0), atol=4e-15)


def gradient(manifold, projection=None):
    def end(y0, args):
        return solve(manifold, y0, args, projection).ys[-1] @ jnp.array([1.0, 2.0])

    return jnp.append(*jax.jit(jax.grad(end, (0, 1)))(Y0, ONE))


def tangent(manifold, projection=None):
    def end(y0, args):
        return solve(manifold, y0, args, projection, adjoint=dfx.ForwardMode()).ys[-1]

    return jax.jvp(end, (Y0, ONE), (Y0[::-1], 3 * ONE))[1]


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [gradient, tangent])
def test_derivatives_are_those_of_autodiff(derivative):
    same(derivative(CALLED), derivative(SEEN))


@pytest.mark.slow
def test_a_direction_needs_no_derivative_of_the_jacobian():
    same(gradient(ALL_CALLED, dfc.Directional()), gradient(SEEN, dfc.Directional()))


def test_what_cannot_be_seen_is_an_error_and_no_number():
    with pytest.raises(ValueError, match="callbacks do not support JVP"):
        gradient(ALL_CALLED)
    of_args = dfc.FirstIntegral(
        lambda t, y, args: args * CALLED.fn(t, y, args) + called(np.asarray)(t, args, None),
        jacobian=lambda t, y, args: args * slope(t, y, args),
    )
    with pytest.raises(ValueError, match="callbacks do not support JVP"):
        gradient(of_args)


def test_a_lane_of_a_batch_is_that_lane_alone():
    batch = jax.vmap(lambda s: solve(CALLED, s * Y0).ys[-1])(jnp.array([0.7, 1.0]))
    same(batch[0], solve(CALLED, 0.7 * Y0).ys[-1])


def test_time_parameters_and_arrays_of_the_function_are_differentiated():
    class Quadratic(eqx.Module):
        weight: jax.Array

        def __call__(self, t, y, args):
            return {"a": self.weight * jnp.stack([y @ y, t * args * y[0]])}

    def rows(t, y, args):
        return {"a": jnp.stack([6 * y, jnp.array([3 * t * args, 0.0])])}

    fn = Quadratic(jnp.array(3.0))
    given = dfc.Constraint(fn, jacobian=rows).fn
    points = (fn, jnp.array(0.7), Y0, ONE)
    directions = (Quadratic(jnp.array(0.3)), jnp.array(2.0), jnp.array([0.1, -1.0]), jnp.array(5.0))
    _, expected = jax.jvp(lambda f, t, y, args: f(t, y, args), points, directions)
    _, got = jax.jvp(
        lambda f, t, y, args: dfc.Constraint(f, jacobian=rows).fn(t, y, args), points, directions
    )
    same(got["a"], expected["a"], 1e-14)
    assert dfc.check_invariance(TERM.vector_field, CALLED, Y0[None], args=ONE).ok
    assert given(0.7, Y0, ONE)["a"].shape == (2,)


def test_a_jacobian_of_another_shape_is_refused():
    wrong = dfc.FirstIntegral(called(in_numpy), jacobian=lambda t, y, args: jnp.ones((1, 2)))
    with pytest.raises(ValueError, match="axes of that array first"):
        dfc.project(wrong, Y0, value=0.1)
    with pytest.raises(TypeError, match="not callable"):
        dfc.Constraint(called(in_numpy), jacobian=3.0)


def test_complex_states_follow_the_convention_of_jax():
    def fn(t, y, args):
        return jnp.sum(jnp.abs(y) ** 2) + y[0].real * y[1].imag

    given = dfc.FirstIntegral(fn, jacobian=lambda t, y, args: jax.grad(fn, 1)(t, y, args))
    y = jnp.array([1 + 2j, 0.5 - 1j])
    options = {"value": 6.0, "projection": dfc.SimplifiedNewton()}
    project = eqx.filter_jit(lambda manifold, y: dfc.project(manifold, y, **options))
    got, expected = (project(m, y) for m in (given, dfc.FirstIntegral(fn)))
    assert got[1].ok
    same(got[0], expected[0], 1e-14)


STATES = arrays(np.float64, 3, elements=st.floats(-10.0, 10.0, width=32))


@jax.jit
def is_wrong(y, factor, offset):
    def fn(t, y, args):
        return offset + y[0] * y[1] + y[2] ** 2 + jnp.sin(y[0])

    def scaled(t, y, args):
        return factor * jax.grad(fn, 1)(t, y, args)

    return dfc.FirstIntegral(fn, jacobian=scaled).fn.is_wrong(0.0, y, None)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@given(y=STATES, offset=st.floats(-1e10, 1e10))
@example(y=np.zeros(3), offset=0.0)
@example(y=np.full(3, np.finfo(np.float32).tiny), offset=0.0)
def test_a_right_jacobian_is_never_refused(dtype, y, offset):
    """Roundoff of a large constant is no difference."""
    assert not is_wrong(*(jnp.asarray(x, dtype) for x in (y, 1.0, offset)))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@given(y=STATES, factor=st.floats(-10.0, 0.5) | st.floats(2.0, 10.0))
@example(y=np.zeros(3), factor=2.0)
def test_a_jacobian_that_is_off_by_a_factor_is_refused(dtype, y, factor):
    assert is_wrong(*(jnp.asarray(x, dtype) for x in (y, factor, 0.0)))


def test_a_wrong_jacobian_ends_the_solve_and_names_its_entry():
    def twice(t, y, args):
        return 2 * slope(t, y, args)

    wrong = (SEEN, dfc.FirstIntegral(called(lambda y: 3 * in_numpy(y)), jacobian=twice))
    solution = solve(wrong, throw=False)
    assert "`jacobian` of entry 1" in dfx.RESULTS[solution.result]
