"""Moving frames: a flow map commutes with the symmetries of its equations, whatever its weights."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..learned import CORES, LORENZ, SMALL, flow_map, states

VORTICES = dfc.systems.PointVortices()
# One compilation each, not one for each operation.
FRAMES = jax.jit(jax.vmap(VORTICES.frame))
STEP = 0.125


def framed(order=0, seed=0, **options):
    taylor = dfc.learned.Taylor(VORTICES.vector_field, order) if order else None
    y0s = states(system=VORTICES)
    options = SMALL | dict(taylor=taylor, frame=VORTICES.frame, key=jr.key(seed)) | options
    return dfc.DeepONet(y0s, STEP, **options)


def transformed(y, order=(1, 2, 0), angle=0.7, scale=1.3, shift=(0.3, -2.0)):
    """The same vortices under other names, turned, shifted and scaled."""
    turn = jnp.array([[jnp.cos(angle), -jnp.sin(angle)], [jnp.sin(angle), jnp.cos(angle)]])
    return scale * (y[jnp.array(order)] @ turn.T + jnp.array(shift))


# ---- The frame of three vortices ----


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (1, 0, 2), (2, 1, 0)])
def test_symmetries_leave_the_inputs_and_turn_the_basis(order):
    y0s = states(system=VORTICES)
    moved = jax.vmap(lambda y: transformed(y, order))(y0s)
    frames, others = FRAMES(y0s), FRAMES(moved)
    np.testing.assert_allclose(others.inputs, frames.inputs, atol=1e-12)
    np.testing.assert_allclose(others.clock, frames.clock / 1.3**2, rtol=1e-12)
    coefficients = jnp.array([0.3, -1.0, 0.5, 2.0])
    change = (frames.basis @ coefficients).reshape(y0s.shape)
    # A change of the state is turned and scaled, but not shifted.
    expected = jax.vmap(lambda dy: transformed(dy, order, shift=(0.0, 0.0)))(change)
    found = (others.basis @ coefficients).reshape(y0s.shape)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_the_closest_pair_is_first():
    y = jnp.array([[0.0, 0.0], [5.0, 0.0], [0.0, 0.5]])
    frame = FRAMES(y[None])
    np.testing.assert_allclose(frame.clock, 4.0, rtol=1e-14)
    np.testing.assert_allclose(frame.inputs[0, 2], 0.5 / np.hypot(5.0, 0.25), rtol=1e-14)


# ---- Flow maps with a frame ----


@pytest.mark.parametrize(("core", "order"), [("product", 0), ("concatenated", 1), ("gated", 2)])
def test_untrained_it_commutes_with_the_symmetries(core, order):
    network = framed(order, core=CORES[core])
    y0s, h = states(10, VORTICES, seed=3), 0.05
    step = jax.jit(jax.vmap(lambda y, h: network(y, h), in_axes=(0, None)))
    found = step(jax.vmap(transformed)(y0s), 1.3**2 * h)
    np.testing.assert_allclose(found, jax.vmap(transformed)(step(y0s, h)), atol=1e-12)


def test_it_starts_at_its_state_and_keeps_the_centre():
    network = framed(1)
    y0s = states(10, VORTICES, seed=3)
    step = jax.jit(jax.vmap(lambda y, h: network(y, h), in_axes=(0, None)))
    np.testing.assert_array_equal(step(y0s, 0.0), y0s)
    slope = jax.jit(jax.jacfwd(lambda h: network(VORTICES.y0, h)))(0.0)
    np.testing.assert_allclose(
        slope, VORTICES.vector_field(0.0, VORTICES.y0, None), rtol=1e-13, atol=1e-14
    )
    ys = step(y0s, STEP)
    assert jnp.max(jnp.abs(ys - y0s)) > 1e-3
    np.testing.assert_allclose(jnp.mean(ys, axis=1), jnp.mean(y0s, axis=1), atol=1e-14)


def test_its_domain_is_one_of_shapes():
    network = framed()
    y0s = states(system=VORTICES)
    contains = jax.jit(jax.vmap(lambda y: network.domain.contains(y)))
    np.testing.assert_array_equal(contains(y0s), True)
    moved = jax.vmap(lambda y: transformed(y, scale=1 + 1e-9))(y0s)
    np.testing.assert_array_equal(contains(moved), True)
    # Larger is slower, which is a part of what is known; smaller is faster.
    np.testing.assert_array_equal(contains(10 * y0s), True)
    np.testing.assert_array_equal(contains(0.01 * y0s), False)


# ---- Repeated ----


def test_a_repeated_flow_map_is_its_steps_one_after_the_other():
    inner = flow_map(taylor=dfc.learned.Taylor(LORENZ.vector_field))
    repeated = dfc.learned.Repeated(inner, 3)
    inner = eqx.filter_jit(inner)
    assert (repeated.max_step, repeated.order) == (0.75, 1)
    assert repeated.domain is repeated.flow_map.domain
    expected = LORENZ.y0
    for _ in range(3):
        expected = inner(expected, 0.2)
    np.testing.assert_allclose(repeated(LORENZ.y0, 0.6), expected, rtol=1e-13)
    gradient = jax.jit(jax.grad(lambda y: jnp.sum(repeated(y, 0.6))))(LORENZ.y0)
    chain = jax.grad(lambda y: jnp.sum(inner(inner(inner(y, 0.2), 0.2), 0.2)))
    chained = jax.jit(chain)(LORENZ.y0)
    np.testing.assert_allclose(gradient, chained, rtol=1e-12)


# ---- What is refused ----

Frame, OTHERS = dfc.learned.Frame, dfc.systems.PointVortices((1.0, 1.0))
LAYER = dfc.learned.ConservativeLayer(VORTICES.manifold)


@pytest.mark.parametrize(
    ("make", "error", "match"),
    [
        (lambda: OTHERS.frame(OTHERS.y0), ValueError, "three vortices of equal strengths"),
        (lambda: framed(frame=1.0), TypeError, None),
        (lambda: framed(frame=lambda y: y), TypeError, r"must return a .*learned\.Frame`"),
        (lambda: framed(frame=lambda y: Frame(y[0], jnp.ones((3, 2)))), ValueError, r"`\(6, m\)`"),
        (lambda: framed(layer=LAYER), ValueError, "cannot have a `layer`"),
        (lambda: framed()(jnp.ones(4), 0.1), ValueError, "for states of 6 numbers"),
        (lambda: dfc.learned.Repeated(flow_map(), 0), ValueError, "`count` must be a positive"),
        (lambda: dfc.learned.Repeated(lambda y0, h: y0, 2), TypeError, "which is no flow map"),
    ],
)
def test_mistakes_are_named(make, error, match):
    with pytest.raises(error, match=match):
        make()
