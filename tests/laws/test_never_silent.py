"""Laws of honesty: success means on the manifold, a derivative is right or NaN, and NaN is failure.

What is right is computed here in numpy, with gradients by hand.
"""

import diffrax as dfx
import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from hypothesis import example, given

import diffrax_conserve as dfc

from ..problems import KEPLER, kepler, solve
from ..thinned import some_of

PROJECTIONS = {
    "simplified": dfc.SimplifiedNewton(),
    "newton": dfc.Newton(),
    "formula": dfc.ClosedForm(lambda t, y, args, values: args[2]),
}


def steep(t, y, args):
    """A wall and a wave: far away its gradient is larger by many orders than on the manifold."""
    a, b, _ = args
    return jnp.stack([y[0] + jnp.exp(a * y[1]), jnp.sum(y**4) - b * y[2]])


def steep_in_numpy(y, a, b):
    """The values, and the rows of the gradients."""
    y, a, b = (np.asarray(x, np.longdouble) for x in (y, a, b))
    zero, wall = np.zeros_like(a), np.exp(a * y[1])
    values = np.stack([y[0] + wall, np.sum(y**4) - b * y[2]])
    rows = np.stack([np.stack([1 + zero, a * wall, zero]), 4 * y**3 - np.stack([zero, zero, b])])
    return values, rows


@eqx.filter_jit
def projected(fn, projection, y, value, args):
    integral = dfc.FirstIntegral(fn)
    found, info = dfc.project(integral, y, value=value, args=args, projection=projection)
    return found, info.result == optx.RESULTS.successful, info.ok


coordinates = st.floats(-3, 3, allow_nan=False).map(lambda x: round(x, 6))


@pytest.mark.parametrize("name", PROJECTIONS)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@given(
    state=st.tuples(coordinates, coordinates, coordinates),
    direction=st.tuples(coordinates, coordinates, coordinates),
    decade=st.floats(-16, 3),
    a=st.floats(0.1, 30),
    b=coordinates,
)
@example(state=(0.0, 0.0, 1.0), direction=(0.0, 0.0, 1.0), decade=2.0, a=1.0, b=0.0)
def test_success_means_on_the_manifold_at_the_state_that_is_returned(
    name, dtype, state, direction, decade, a, b
):
    state, direction = np.asarray(state, dtype), np.asarray(direction, dtype)
    a, b = dtype(a), dtype(b)
    value = steep_in_numpy(state, a, b)[0].astype(dtype)
    candidate = (state + 10.0**decade * direction).astype(dtype)
    y, success, ok = projected(steep, PROJECTIONS[name], candidate, value, (a, b, candidate))
    assert bool(success) == bool(ok)
    if not success:
        return
    y = np.asarray(y)
    assert np.all(np.isfinite(y))
    values, rows = steep_in_numpy(y, a, b)
    size = np.abs(value) + np.sum(np.abs(rows * y.astype(np.longdouble)), axis=1)
    numbers = np.finfo(dtype)  # below `tiny` a number counts as zero
    assert np.all(np.abs(values - value) <= 64 * numbers.eps * size + numbers.tiny)


def powers(t, y, args):
    """Its roundoff is that of the exponent, thousands of times as large far away."""
    return jnp.exp(args[0] * jnp.log(y[0] ** 2)) + args[1] * y[1] ** 2


@some_of("name", ["simplified", "newton"], period=2)
def test_the_roundoff_that_counts_is_that_at_the_result(name):
    rng = np.random.default_rng(5)
    start = np.exp(rng.uniform(-1.6, 1.4, (2, 2000)))
    args = np.exp(rng.uniform([[-1.6], [-7.0]], [[2.0], [7.0]], (2, 2000)))
    value = np.exp(args[0] * np.log(start[0] ** 2)) + args[1] * start[1] ** 2
    candidate = start + 10 ** rng.uniform(-6, 5, 2000) * rng.normal(size=start.shape)
    given = (x.astype(np.float32) for x in (candidate.T, value, args.T))
    in_batch = eqx.filter_vmap(projected, in_axes=(None, None, 0, 0, 0))
    y, _, ok = map(np.asarray, in_batch(powers, PROJECTIONS[name], *given))
    x, v, (a, b) = (np.asarray(z, np.longdouble) for z in (y.T, value, args))
    with np.errstate(all="ignore"):
        first, second = np.exp(a * np.log(x[0] ** 2)), b * x[1] ** 2
        exponent = np.abs(a * np.log(x[0] ** 2))
        scale = np.abs(v) + (2 * a + exponent) * first + 2 * second
        off = np.abs(first + second - v) / scale / np.finfo(np.float32).eps
    assert ok.sum() > 1000
    assert np.all(off[ok] <= 64), (np.max(off[ok]), np.sum(off[ok] > 64))


@some_of("factor", [5.97e24, 1e-27], period=2)
@given(st.tuples(*[st.floats(-1, 1)] * 2), st.floats(0.5, 2))
def test_units_do_not_matter_in_single_precision(factor, displacement, size):
    """The energy of a planet in joules, or of an atom: squares of its gradient overflow, or vanish,
    in float32. On a circle both projections move to the nearest point."""
    y = np.float32(size) * np.array([0.6, 0.8], np.float32)
    candidate = y + 1e-3 * np.asarray(displacement, np.float32)
    value = jnp.float32(factor * size**2)
    radius, t_candidate = np.linalg.norm(candidate), np.array([1.0, -2.0], np.float32)
    across = t_candidate - candidate * (candidate @ t_candidate) / radius**2
    for projection in (PROJECTIONS["simplified"], PROJECTIONS["newton"]):
        found, t_found, ok = in_units(projection, candidate, t_candidate, value, factor)
        assert ok
        np.testing.assert_allclose(found, size / radius * candidate, rtol=4e-6)
        np.testing.assert_allclose(t_found, size / radius * across, rtol=2e-4, atol=1e-5)


@eqx.filter_jit
def in_units(projection, y, t_y, value, factor):
    square = dfc.FirstIntegral(lambda t, y, args: args * jnp.sum(y**2))

    def projected(y):
        y, info = dfc.project(square, y, value=value, args=factor, projection=projection)
        return y, info.ok

    return jax.jvp(projected, (y,), (t_y,), has_aux=True)


@some_of("dtype", [np.float64, np.float32], ids=["float64", "float32"], period=2)
@given(share=st.floats(0.01, 0.5), angle=st.floats(0, 6), off=st.floats(-0.1, 0.1))
def test_what_underflows_is_no_success(dtype, share, angle, off):
    """Residuals of small values underflow long before the values do."""
    numbers = np.finfo(dtype)
    size = float(numbers.tiny) ** share
    value = dtype(size**2)
    candidate = (size * (1 + off) * np.array([np.cos(angle), np.sin(angle)])).astype(dtype)
    given = candidate, 0 * candidate, value, jnp.asarray(1, dtype)
    found, _, ok = in_units(PROJECTIONS["simplified"], *given)
    error = np.sum(np.asarray(found, np.longdouble) ** 2) - value
    assert not ok or abs(error) <= 64 * numbers.eps * value
    assert ok or value <= numbers.tiny / numbers.eps


def orbit(solver, e, direction):
    """The end of an arc, and its derivative along a change of the initial state."""
    y0 = jnp.stack([1 - e, 0.0 * e]), jnp.stack([0.0 * e, jnp.sqrt((1 + e) / (1 - e))])

    def end(y0):
        term, adjoint = dfx.ODETerm(kepler), dfx.ForwardMode()
        ys = dfx.diffeqsolve(term, solver, 0.0, 0.5, 0.05, y0, adjoint=adjoint, throw=False).ys
        return jax.tree.map(lambda x: x[-1], ys)

    return jax.jvp(end, (y0,), ((direction[:2], direction[2:]),))


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, None, 0, 0))
def tangents(manifold, projection, e, direction):
    solver = dfc.ManifoldProjection(dfc.RK4(), manifold, projection=projection)
    exact = orbit(dfc.RK4(), e, direction)  # up to 1e-5
    return orbit(solver, e, direction), exact


SLOW = ("simplified", 3), ("newton", 1)


@pytest.mark.parametrize(
    ("name", "repeated"),
    [("simplified", 1), *(pytest.param(*x, marks=pytest.mark.slow) for x in SLOW)],
)
def test_a_derivative_near_parallel_gradients_is_that_of_the_flow(name, repeated):
    """The orbit differs by 1e-7. The angle between the gradients, about the eccentricity, would
    amplify that in the derivative, up to a loss of all digits. Of `Newton` it may be NaN. Integrals
    that are repeated are more than four constraints, which are eliminated without pivoting."""
    rng = np.random.default_rng(0)
    e = np.concatenate([[0.0], 10.0 ** rng.uniform(-14, -1, 399)])
    direction = rng.normal(size=(400, 4))
    (y, t), (exact, t_exact) = tangents([KEPLER] * repeated, PROJECTIONS[name], e, direction)
    found, expected = (np.concatenate(x, axis=-1) for x in (t, t_exact))
    off = np.abs(np.concatenate(y, -1) - np.concatenate(exact, -1)).max(axis=-1)
    solved = ~np.isnan(off)
    assert np.all(off[solved] < 1e-5)
    assert np.mean(solved) >= (1 if name == "newton" else 0.9)
    error = np.linalg.norm(found - expected, axis=-1) / np.linalg.norm(expected, axis=-1)
    assert np.all((error <= 1e-3) | (np.isnan(error) & ((name == "newton") | ~solved)))
    assert np.all(error[e > 1e-3] <= 1e-4)
    assert name == "newton" or repeated > 1 or np.all(error[e < 1e-5] <= 1e-7)


def test_saved_states_of_an_almost_circular_orbit_are_those_of_their_times():
    """Between steps the gradients at the interpolant span a plane that may miss the manifold."""
    times = jnp.linspace(0.01, 5.99, 200)

    def positions(speed):
        y0 = jnp.array([1.0, 0.0]), jnp.stack([0 * speed, speed])
        controller = dfx.PIDController(rtol=1e-5, atol=1e-7)
        options = dict(stepsize_controller=controller, saveat=dfx.SaveAt(ts=times))
        return solve(kepler, dfc.ManifoldProjection(dfx.Dopri5(), KEPLER), y0, t1=6.0, **options).ys

    q, _ = jax.vmap(positions)(1 + 10 ** jnp.linspace(-12, -6, 20))
    assert np.max(np.abs(q - np.stack([np.cos(times), np.sin(times)], axis=-1))) < 1e-2


@some_of("dtype", [jnp.float32, jnp.float64], ids=["float32", "float64"], period=2)
def test_an_infinite_derivative_does_not_keep_newton_from_ending(dtype):
    """The soak found it: LAPACK's singular values never end for a matrix with an infinity."""
    fn = lambda t, y, args: jnp.exp(1.9 * jnp.log(y[0] ** 2)) + 2e-3 * y[1] ** 2  # noqa: E731
    candidate = jnp.array([1.5637957, 0.07024307], dtype)
    integral, value = dfc.FirstIntegral(fn), jnp.asarray(-3536.0, dtype)
    project = jax.jit(lambda y: dfc.project(integral, y, value=value, projection=dfc.Newton())[1])
    assert not project(candidate).ok
