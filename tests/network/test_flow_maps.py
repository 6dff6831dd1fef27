"""The parts of a flow map beyond branch times trunk, and the windows of a PINN."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..learned import CORES, EAST, LORENZ, flow_map, oscillator
from ..thinned import some_of

KINDS = pytest.mark.parametrize("core", CORES.values(), ids=CORES)


# ---- The Taylor polynomial ----


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_the_polynomial_of_a_linear_system(order):
    matrix = jr.normal(jr.key(0), (3, 3))
    taylor = dfc.learned.Taylor(lambda t, y, args: args * (matrix @ y), order, args=2.0)
    y0, h = jnp.array([1.0, -2.0, 0.5]), 0.3
    expected, term = np.asarray(y0), np.asarray(y0)
    for j in range(1, order + 1):
        term = 2 * h / j * (np.asarray(matrix) @ term)
        expected = expected + term
    np.testing.assert_allclose(taylor(y0, h), expected, rtol=1e-14)


def test_the_polynomial_of_any_state():
    y0 = {"a": jnp.array(1.0), "b": (jnp.ones(2, jnp.float32),)}
    taylor = dfc.learned.Taylor(lambda t, y, args: jax.tree.map(lambda x: -x, y), 3)
    y = taylor(y0, 0.1)
    assert y["b"][0].dtype == jnp.float32
    np.testing.assert_allclose(y["a"], 1 - 0.1 + 0.1**2 / 2 - 0.1**3 / 6, rtol=1e-15)


@some_of("order", [0, 1, 2, 3], ids="0123", period=2)
@KINDS
def test_untrained_it_has_the_order_of_its_polynomial(core, order):
    taylor = dfc.learned.Taylor(LORENZ.vector_field, order) if order else None
    network = flow_map(core=core, taylor=taylor)
    assert network.order == order
    steps = 0.02 / 2.0 ** np.arange(3)
    exact = LORENZ.reference(jnp.asarray(steps[::-1]))[::-1]
    errors = [jnp.linalg.norm(network(LORENZ.y0, h) - y) for h, y in zip(steps, exact, strict=True)]
    slopes = np.diff(np.log2(np.asarray(errors)))
    np.testing.assert_allclose(slopes, -(order + 1), atol=0.15)


# ---- The networks ----


def test_concatenated_inputs():
    network = flow_map(core=dfc.learned.Concatenated)
    h = 0.2
    x = jnp.append((LORENZ.y0 - network.shift) / network.scale, 2 * h / 0.25 - 1)
    first, second, last = network.core.net.weights
    z = jnp.tanh(jnp.tanh(x @ first) @ second) @ last
    np.testing.assert_allclose(
        network(LORENZ.y0, h), LORENZ.y0 + 0.8 * network.scale * z, rtol=1e-14
    )


def test_gated_inputs():
    network = flow_map(core=dfc.learned.Gated, depth=3)
    core = network.core
    assert len(core.hidden) == 3
    x = jnp.append(jnp.array([0.3, -0.2, 0.5]), 0.1)
    a, b = (jnp.tanh(x @ encoder.weights[0]) for encoder in core.encoders)
    z = x
    for layer in core.hidden:
        gate = jnp.tanh(z @ layer.weights[0])
        z = gate * a + (1 - gate) * b
    expected = z @ core.last.weights[0]
    np.testing.assert_allclose(core(x[:3], x[3]), expected, rtol=1e-14)


@KINDS
def test_every_kind_starts_at_its_state(core):
    network = flow_map(core=core, taylor=dfc.learned.Taylor(LORENZ.vector_field))
    np.testing.assert_array_equal(network(LORENZ.y0, 0.0), LORENZ.y0)
    slope = jax.jacfwd(lambda h: network(LORENZ.y0, h))(0.0)
    np.testing.assert_allclose(slope, LORENZ.vector_field(0.0, LORENZ.y0, None), rtol=1e-14)


def test_its_domain_is_the_box_round_its_states():
    states = jnp.array([[0.0, 1.0], [2.0, -1.0]])
    domain = dfc.DeepONet(states, 1.0, width=4, depth=1, key=jr.key(0)).domain
    assert domain.contains(jnp.array([1.0, 0.0]))
    assert not domain.contains(jnp.array([1.0, 1.5]))


def test_a_solve_across_windows():
    pinn = dfc.PINN(EAST, 0.0, 4.0, windows=2, width=8, depth=1, slope=2.0, key=jr.key(0))
    end = pinn.window(0)(2.0)
    pinn = eqx.tree_at(lambda p: p.y0s, pinn, jnp.stack([EAST, end]))
    ts = jnp.linspace(0, 4, 9)
    ys = eqx.filter_jit(dfx.diffeqsolve)(
        dfx.ODETerm(oscillator), dfc.PINNSolver(pinn), 0.0, 4.0, 0.4, EAST,
        saveat=dfx.SaveAt(ts=ts),
    ).ys  # fmt: skip
    np.testing.assert_allclose(ys, jax.jit(jax.vmap(pinn))(ts), atol=1e-8)


# ---- Other coordinates ----


@pytest.mark.parametrize("exponent", [0.0, 0.1, 0.125, 0.25, 0.3, 1.0])
def test_box_cox_is_a_power_and_has_an_inverse(exponent):
    y = jnp.logspace(-12, 1, 40)
    boxcox = dfc.learned.BoxCox(exponent)
    expected = (y**exponent - 1) / exponent if exponent else jnp.log(y)
    np.testing.assert_allclose(boxcox(y), expected, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(boxcox.inverse(boxcox(y)), y, rtol=1e-10, atol=1e-15)
    assert jnp.all(boxcox.inverse(-20.0 * jnp.ones(2)) >= 0)
