"""PINNs and DeepONets: exact at the initial time, for every state that is a PyTree."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import diffrax_conserve as dfc

from ..learned import LORENZ, SMALL, flow_map, solution, states

MIXED = {
    "position": jnp.array([[1.0, 2.0], [3.0, -4.0]]),
    "rest": (jnp.array(0.5), [jnp.array([7.0], jnp.float32)]),
}


def stacked(state, count=5):
    return jax.tree.map(
        lambda x: x[None] + jnp.arange(count, dtype=x.dtype).reshape(-1, *[1] * x.ndim), state
    )


def same_kind(a, b):
    return jax.tree.structure(a) == jax.tree.structure(b) and all(
        x.shape == y.shape and x.dtype == y.dtype
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


def test_a_pinn_starts_at_its_initial_state_exactly():
    pinn = solution()
    assert bool(jnp.all(pinn(0.0) == LORENZ.y0))
    assert not bool(jnp.all(pinn(1.5) == LORENZ.y0))


@eqx.filter_jit
def advance(network, y0, h):
    return network(y0, h)


@given(st.integers(0, 100), st.integers(-5, 5))
def test_a_deeponet_starts_at_its_initial_state_exactly(seed, factor):
    y0 = factor * jr.normal(jr.key(seed), (3,))
    np.testing.assert_array_equal(advance(flow_map(), y0, jnp.zeros(())), y0)


def test_any_pytree_of_arrays_is_a_state():
    pinn = dfc.PINN(MIXED, 1.0, 3.0, key=jr.key(0), **SMALL)
    at = eqx.filter_jit(lambda pinn, t: pinn(t))
    assert same_kind(at(pinn, jnp.array(2.0)), MIXED)
    assert eqx.tree_equal(at(pinn, jnp.array(1.0)), MIXED)
    net = dfc.DeepONet(stacked(MIXED), 0.5, key=jr.key(0), **SMALL)
    assert same_kind(advance(net, MIXED, jnp.array(0.2)), MIXED)
    assert eqx.tree_equal(advance(net, MIXED, jnp.array(0.0)), MIXED)


def test_numbers_are_states():
    assert dfc.PINN(2, 0, 1, key=jr.key(0), **SMALL)(0.0) == 2.0
    net = dfc.DeepONet(jnp.arange(3.0), 1, key=jr.key(0), **SMALL)
    assert net(2.0, 0.0) == 2.0


def test_the_ansatz_of_the_pinn():
    pinn = solution(t1=4.0)
    largest = jnp.max(jnp.abs(LORENZ.y0))
    expected = LORENZ.y0 + 3 / 4 * largest * pinn.window(0).net(jnp.array([2 * 3 / 4 - 1]))
    np.testing.assert_allclose(pinn(3.0), expected, rtol=1e-15)


def test_the_ansatz_of_the_deeponet():
    net, y0, h = flow_map(core=dfc.learned.Product), LORENZ.y0, 0.2
    mean, deviation = jnp.mean(states(), axis=0), jnp.std(states(), axis=0)
    b = net.core.branch((y0 - mean) / deviation).reshape(3, 4)
    tau = net.core.trunk(jnp.array([2 * h / 0.25 - 1])).reshape(3, 4)
    expected = y0 + h / 0.25 * deviation * jnp.einsum("jl,jl->j", b, tau) / 2
    np.testing.assert_allclose(net(y0, h), expected, rtol=1e-14)


def test_without_normalisation_the_inputs_are_raw():
    pinn = solution(t1=4.0, normalise=False)
    np.testing.assert_allclose(
        pinn(3.0), LORENZ.y0 + 3 / 4 * pinn.window(0).net(jnp.array([3.0])), rtol=1e-15
    )
    net, y0 = flow_map(core=dfc.learned.Product, normalise=False), LORENZ.y0
    b, tau = (x.reshape(3, 4) for x in (net.core.branch(y0), net.core.trunk(jnp.array([0.2]))))
    np.testing.assert_allclose(net(y0, 0.2), y0 + 0.8 * jnp.sum(b * tau, axis=1) / 2, rtol=1e-14)


@pytest.mark.parametrize(
    ("width", "depth", "latent"), [pytest.param(5, 1, 3, marks=pytest.mark.slow), (7, 4, 2)]
)
def test_sizes(width, depth, latent):
    net = dfc.DeepONet(
        states(),
        1.0,
        width=width,
        depth=depth,
        latent=latent,
        core=dfc.learned.Product,
        key=jr.key(0),
    )
    assert [w.shape for w in net.core.branch.weights] == [
        (3, width),
        *[(width, width)] * (depth - 1),
        (width, 3 * latent),
    ]
    assert len(net.core.trunk.weights) == depth + 1


def test_the_activation_by_name_and_as_a_function():
    by_name, by_function = solution(activation="sin"), solution(activation=jnp.sin)
    assert bool(jnp.all(by_name(1.5) == by_function(1.5)))
    assert not bool(jnp.all(by_name(1.5) == solution()(1.5)))


def test_the_same_key_makes_the_same_network():
    assert eqx.tree_equal(flow_map(seed=3), flow_map(seed=3))
    assert not eqx.tree_equal(flow_map(seed=3), flow_map(seed=4))


def test_float32_stays_float32():
    y0 = LORENZ.y0.astype(jnp.float32)
    pinn = dfc.PINN(y0, 0.0, 1.0, key=jr.key(0), **SMALL)
    assert eqx.filter_eval_shape(pinn, 0.5).dtype == jnp.float32
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(eqx.filter(pinn, eqx.is_array)))


@pytest.mark.parametrize("options", [dict(width=0), dict(depth=-1), dict(activation="tan")])
def test_sizes_that_are_refused(options):
    with pytest.raises(ValueError, match=f"`{next(iter(options))}`"):
        solution(**options)


def test_what_else_is_refused():
    with pytest.raises(ValueError, match="`t0` must be less than `t1`"):
        dfc.PINN(LORENZ.y0, 1.0, 1.0, key=jr.key(0))
    with pytest.raises(ValueError, match="`max_step` must be positive"):
        dfc.DeepONet(states(), 0.0, key=jr.key(0))
    with pytest.raises(ValueError, match="leading axis"):
        dfc.DeepONet((jnp.ones(3), jnp.ones(4)), 1.0, key=jr.key(0))
    with pytest.raises(ValueError, match="states of 3 numbers, but was given one of 4"):
        flow_map()(jnp.ones(4), 0.1)
    with pytest.raises(TypeError, match="complex"):
        dfc.PINN(jnp.array([1j]), 0.0, 1.0, key=jr.key(0))
