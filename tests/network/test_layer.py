"""The conservative layer: where it moves to, and that its derivatives are those of what it does."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from ..learned import EAST, LORENZ, RADIUS, flow_map, solution
from ..problems import OMEGA0, RIGID_BODY, largest
from ..thinned import some_of

ONE = jnp.ones(())


def residual(layer, y, values):
    now = layer.values(0.0, y)
    ratios = jax.tree.map(lambda a, b: np.abs(np.subtract(a, b)) / (1 + np.abs(b)), now, values)
    return largest(ratios)


@eqx.filter_jit
def moved(layer, y, start, radius=ONE, schedule=None):
    """The state on the manifold through the state `start`, at time zero."""
    return layer(y, 0.0, (0.0, start), radius, schedule)


@given(st.integers(0, 10**6), st.integers(2, 12))
def test_it_reaches_the_manifold_from_far_away(seed, halves):
    distance = 10 ** (-halves / 2)  # from 0.1 to 1e-6
    candidate = OMEGA0 + distance * jr.normal(jr.key(seed), (3,))
    for steps in (None, 12):
        layer = dfc.learned.ConservativeLayer(RIGID_BODY, steps=steps)
        y = moved(layer, candidate, OMEGA0)
        assert residual(layer, y, layer.values(0.0, OMEGA0)) < 1e-14


def test_the_move_is_along_the_gradients_at_the_candidate():
    layer = dfc.learned.ConservativeLayer(RIGID_BODY)
    candidate = OMEGA0 + jnp.array([0.1, -0.2, 0.1])
    rows = jnp.stack(jax.tree.leaves(jax.jacrev(lambda y: layer.values(0.0, y))(candidate)))
    move = moved(layer, candidate, OMEGA0) - candidate
    multipliers = np.linalg.lstsq(rows.T, move)[0]
    np.testing.assert_allclose(rows.T @ multipliers, move, rtol=0, atol=1e-15)


def test_where_the_gradient_vanishes_nothing_blows_up():
    paper, layer = (dfc.learned.ConservativeLayer(RADIUS, steps=steps) for steps in (5, None))
    for scale in (0.0, 1e-300, 1e-12, 1e-3):
        assert float(jnp.max(jnp.abs(moved(paper, scale * EAST, EAST)))) <= 1 + 5
        y = moved(layer, scale * EAST, EAST)
        assert bool(jnp.all(y == scale * EAST) | jnp.allclose(y, EAST))


def test_dependent_integrals_change_nothing():
    once, twice = (dfc.learned.ConservativeLayer(m) for m in (RADIUS, (RADIUS, RADIUS)))
    candidate = jnp.array([1.1, 0.3])
    a, b = (moved(x, candidate, EAST) for x in (once, twice))
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-9)


def test_many_constraints_use_the_dense_solve():
    sphere = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2, axis=1))
    layer = dfc.learned.ConservativeLayer(sphere)
    y0 = jr.normal(jr.key(0), (12, 3))
    candidate = 1.1 * y0
    y = moved(layer, candidate, y0)
    np.testing.assert_allclose(y, y0, rtol=1e-14)


CANDIDATE = OMEGA0 + jnp.array([0.1, -0.2, 0.1])


def scheduled(p, s, steps=3):
    layer = dfc.learned.ConservativeLayer(RIGID_BODY, steps=steps)
    schedule = (jnp.asarray(p), jnp.asarray(s))
    return moved(layer, CANDIDATE, OMEGA0, ONE, schedule)


def test_a_schedule_blends_successive_iterates():
    np.testing.assert_array_equal(scheduled(0, 0.7), CANDIDATE)
    np.testing.assert_allclose(scheduled(1, 0.0), CANDIDATE, rtol=1e-15)
    for p in (1, 2, 3):
        # With `p` iterations in all, the layer makes them without a schedule.
        layer = dfc.learned.ConservativeLayer(RIGID_BODY, steps=p)
        expected = moved(layer, CANDIDATE, OMEGA0)
        np.testing.assert_allclose(scheduled(p, 1.0), expected, rtol=1e-15)
        blend = 0.75 * scheduled(p - 1, 1.0) + 0.25 * scheduled(p, 1.0)
        np.testing.assert_allclose(scheduled(p, 0.25), blend, rtol=1e-14)


def test_the_algorithm_as_printed():
    """Simplified Newton, `λ ← λ - (G Gᵀ)⁻¹ g` with `G` at the candidate, and its schedule."""
    layer = dfc.learned.ConservativeLayer(RADIUS, steps=3, as_printed=True)
    candidate, multiplier = jnp.array([1.1, 0.3]), 0.0
    for _ in range(3):
        y = candidate + multiplier * 2 * candidate
        multiplier -= (y @ y - 1.0) / (4 * candidate @ candidate)
    y = candidate + multiplier * 2 * candidate
    np.testing.assert_allclose(moved(layer, candidate, EAST), y, rtol=1e-14)
    recipe = dfc.learned.paper.recipe(flow_map(layer=layer), epochs=80, as_printed=True)
    found = [recipe.schedule(jnp.asarray(e), 80, 3) for e in (0, 19, 20, 45, 60, 80)]
    np.testing.assert_allclose(
        found, [(0, 0), (0, 19 / 80), (1, 1 / 4), (2, 9 / 16), (3, 3 / 4), (3, 1)]
    )


def test_derivatives_with_respect_to_the_manifold_and_the_start():
    def moved_to(omega, start):
        energy = dfc.FirstIntegral(lambda t, y, args: (y[1] ** 2 + (omega * y[0]) ** 2) / 2)
        layer = dfc.learned.ConservativeLayer(energy)
        return layer(jnp.array([1.1, 0.4]), 0.0, (0.0, jnp.stack([start, 0.3])), ONE)

    dct.assert_gradients(moved_to, 1.3, 0.9, rtol=1e-8, forward=False)


def test_the_time_derivative_of_a_conservative_network_is_tangent_to_the_manifold():
    layer = dfc.learned.ConservativeLayer(LORENZ.manifold)
    net = flow_map(layer=layer)

    @jax.jit
    def rates(t):
        state, velocity = jax.jvp(lambda h: net(LORENZ.y0, h), (t,), (ONE,))
        return velocity, jax.jvp(lambda y: layer.values(0.0, y), (state,), (velocity,))[1]

    velocity, changes = rates(jnp.array(0.2))
    assert float(jnp.linalg.norm(velocity)) > 1e-2
    assert all(abs(float(change)) < 1e-12 for change in changes.values())


def test_a_conservative_network_is_its_candidate_moved():
    layer = dfc.learned.ConservativeLayer(LORENZ.manifold)
    plain, y0 = flow_map(), LORENZ.y0
    conservative = eqx.filter_jit(flow_map(layer=layer))
    values = layer.values(0.0, y0)
    expected = moved(layer, plain(y0, 0.2), y0)
    np.testing.assert_allclose(conservative(y0, 0.2), expected, rtol=1e-14)
    assert residual(layer, conservative(y0, 0.2), values) < 1e-14
    np.testing.assert_allclose(conservative(y0, 0.0), y0, rtol=0, atol=1e-15)
    pinn = eqx.filter_jit(solution(layer=layer))
    assert residual(layer, pinn(1.5), values) < 1e-14
    np.testing.assert_allclose(pinn(0.0), y0, rtol=0, atol=1e-15)


LOGARITHM = dfc.FirstIntegral(lambda t, y, args: jnp.sum(jnp.log(y)))
TOTAL = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y))


@pytest.mark.parametrize("manifold", [LOGARITHM, (LOGARITHM, TOTAL)], ids=["one", "two"])
def test_near_and_beyond_the_end_of_a_domain_all_derivatives_are_finite(manifold):
    """A result is on the manifold, or it is the candidate, with the derivative of the candidate."""
    layer, start = dfc.learned.ConservativeLayer(manifold), jnp.array([0.8, 0.7])

    @jax.jit
    def derivatives(candidate):
        to = lambda y: layer(y, 0.0, (0.0, start), ONE)  # noqa: E731
        rate = lambda y: jax.jvp(to, (y,), (jnp.ones(2),))[1]  # noqa: E731
        return to(candidate), jax.jacrev(to)(candidate), jax.jacrev(rate)(candidate)

    for candidate in np.array([[0.9, 0.5], [2.0, 1e-3], [3.0, -0.1], [0.0, 0.0]]):
        y, slopes, curvatures = derivatives(candidate)
        assert np.all(np.isfinite(curvatures)), candidate
        if np.all(y == candidate):
            np.testing.assert_array_equal(slopes, np.eye(2))
        else:
            assert residual(layer, y, layer.values(0.0, start)) < 1e-14, candidate


@pytest.mark.slow
@some_of("steps", [None, 2], period=2)
def test_second_derivatives_are_those_of_differences(steps):
    """Also of iterations that have not converged, as in the recipe of the paper."""
    layer = dfc.learned.ConservativeLayer(RIGID_BODY, steps=steps)
    along = jnp.array([0.3, -0.5, 0.2])

    def rate(y):
        return jax.jvp(lambda y: layer(y, 0.0, (0.0, OMEGA0), ONE), (y,), (along,))[1]

    dct.assert_gradients(rate, CANDIDATE, rtol=1e-7, forward=False)


def test_what_is_refused():
    with pytest.raises(ValueError, match=r"`steps` .*must be a positive integer"):
        dfc.learned.ConservativeLayer(RADIUS, steps=0)
    with pytest.raises(ValueError, match="`as_printed` needs the number of iterations"):
        dfc.learned.ConservativeLayer(RADIUS, as_printed=True)
    with pytest.raises(TypeError, match="neither a `FirstIntegral`"):
        dfc.learned.ConservativeLayer(lambda t, y, args: y)
