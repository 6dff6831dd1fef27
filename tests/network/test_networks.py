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

from ..learned import EAST, LORENZ, SMALL, flow_map, solution, states

KEY = jr.key(0)
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


def test_the_activation_by_name_and_as_a_function():
    by_name, by_function = solution(activation="sin"), solution(activation=jnp.sin)
    assert bool(jnp.all(by_name(1.5) == by_function(1.5)))
    assert not bool(jnp.all(by_name(1.5) == solution()(1.5)))


@pytest.mark.parametrize(
    ("make", "error", "match"),
    [
        (lambda: solution(width=0), ValueError, "`width`"),
        (lambda: solution(depth=-1), ValueError, "`depth`"),
        (lambda: solution(activation="tan"), ValueError, "`activation`"),
        (lambda: solution(windows=0), ValueError, "`windows` must be"),
        (lambda: solution(windows=[2.0, 1.0]), ValueError, "must increase"),
        (lambda: solution(slope=-1.0), ValueError, "`slope` must be"),
        (lambda: solution(t1=0.0), ValueError, "`t0` must be less than `t1`"),
        (lambda: flow_map(max_step=0.0), ValueError, "`max_step` must be positive"),
        (lambda: flow_map(core="gated"), TypeError, "`core` is 'gated', but it must be"),
        (lambda: flow_map()(jnp.ones(4), 0.1), ValueError, "of 3 numbers, but was given one of 4"),
        (lambda: dfc.DeepONet((EAST, LORENZ.y0), 1.0, key=KEY), ValueError, "leading axis"),
        (lambda: dfc.PINN(jnp.array([1j]), 0.0, 1.0, key=KEY), TypeError, "complex"),
        (lambda: dfc.learned.Taylor(LORENZ.vector_field, 0), ValueError, "`order` must be a posit"),
        (lambda: dfc.learned.single_precision(solution()), TypeError, "contains no `DeepONet`"),
    ],
)
def test_mistakes_are_named(make, error, match):
    with pytest.raises(error, match=match):
        make()
