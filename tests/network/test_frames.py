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


def test_its_basis_spans_what_the_vector_field_can_do():
    y0s = states(system=VORTICES)
    frames = FRAMES(y0s)
    rates = jax.vmap(lambda y: VORTICES.vector_field(0.0, y, None))(y0s).reshape(len(y0s), 6)
    coefficients = jax.vmap(dfc.learned.Frame.measure)(frames, rates)
    again = jnp.einsum("snm,sm->sn", frames.basis, coefficients) * frames.clock[:, None]
    np.testing.assert_allclose(again, rates, atol=1e-12)


def test_the_closest_pair_is_first():
    y = jnp.array([[0.0, 0.0], [5.0, 0.0], [0.0, 0.5]])
    frame = FRAMES(y[None])
    np.testing.assert_allclose(frame.clock, 4.0, rtol=1e-14)
    np.testing.assert_allclose(frame.inputs[0, 2], 0.5 / np.hypot(5.0, 0.25), rtol=1e-14)


@pytest.mark.parametrize("strengths", [(1.0, 1.0), (1.0, 1.0, 2.0), (1.0, 1.0, 1.0, 1.0)])
def test_other_vortices_have_no_such_frame(strengths):
    system = dfc.systems.PointVortices(strengths)
    with pytest.raises(ValueError, match="three vortices of equal strengths"):
        system.frame(system.y0)


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


def test_wrong_frames_are_named():
    y0s = states(5, VORTICES)
    options = dict(key=jr.key(0), **SMALL)
    with pytest.raises(TypeError):
        dfc.DeepONet(y0s, 1.0, frame=1.0, **options)
    with pytest.raises(TypeError, match=r"must return a `diffrax_conserve\.learned\.Frame`"):
        dfc.DeepONet(y0s, 1.0, frame=lambda y: y, **options)
    with pytest.raises(ValueError, match=r"`\(6, m\)`"):
        dfc.DeepONet(y0s, 1.0, frame=lambda y: dfc.learned.Frame(y[0], jnp.ones((3, 2))), **options)
    with pytest.raises(ValueError, match="cannot have a `layer`"):
        framed(layer=dfc.learned.ConservativeLayer(VORTICES.manifold))
    with pytest.raises(ValueError, match="for states of 6 numbers"):
        framed()(jnp.ones(4), 0.1)


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


def test_a_flow_map_without_a_domain_repeated():
    class Still(eqx.Module):
        max_step: float = 1.0

        def __call__(self, y0, h):
            return y0

    repeated = dfc.learned.Repeated(Still(), 2)
    assert repeated.order == 0
    assert repeated.domain is None


def test_wrong_repetitions_are_named():
    with pytest.raises(ValueError, match="`count` must be a positive integer"):
        dfc.learned.Repeated(flow_map(), 0)
    with pytest.raises(TypeError, match="which is no flow map"):
        dfc.learned.Repeated(lambda y0, h: y0, 2)
    with pytest.raises(ValueError, match="Train its inner"):
        dfc.fit(dfc.learned.Repeated(flow_map(), 2), LORENZ.vector_field, key=jr.key(0))
