"""Second-order training and its recipes; without options `fit` does what the guide advises."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve.learned._networks.cores import Gated
from diffrax_conserve.learned._training.second_order import _by_gram_matrix, _by_triangular_factor

from ..learned import LORENZ, SMALL, error_of_turning, flow_map, states, turning
from ..problems import oscillator

KEY = jr.key(5)


# ---- One update, against what it is defined to be ----


class Powers(eqx.Module):
    """Its defect is linear in the weights: `w₀ + 2 h w₁ + 3 h² w₂` less the field."""

    weights: jax.Array
    max_step: float = eqx.field(static=True, default=1.0)

    def __call__(self, y0, h):
        return y0 + h * jnp.polyval(self.weights[::-1], h)


@pytest.mark.parametrize(
    ("method", "damping"),
    [
        ("levenberg-marquardt", lambda loss, columns: 0.3 * columns),
        ("spring", lambda loss, columns: 0.3 * loss),
    ],
)
def test_an_update_solves_the_damped_problem(method, damping):
    model = Powers(jnp.array([1.0, -0.5, 0.3]))
    recipe = dfc.learned.Recipe(
        epochs=1, points=7, optimiser=method, damping=0.3,
        times=lambda _, n, a, b: jnp.linspace(a, b, n),
    )  # fmt: skip
    trained, log = dfc.fit(
        model, lambda t, y, args: 2.0 + 0 * y, sample=lambda key: jr.normal(key),
        key=KEY, recipe=recipe,
    )  # fmt: skip
    h = np.linspace(0, 1, 7)
    matrix = np.stack([h**0, 2 * h, 3 * h**2], axis=1) / 7**0.5
    r = matrix @ np.asarray(model.weights) - 2.0 / 7**0.5
    np.testing.assert_allclose(log.losses[0], r @ r, rtol=1e-12)
    columns = np.mean(np.sum(matrix**2, axis=0))
    normal = matrix.T @ matrix + damping(r @ r, columns) * np.eye(3)
    update = np.linalg.solve(normal, -matrix.T @ r)
    np.testing.assert_allclose(trained.weights - model.weights, update, rtol=1e-8)


@pytest.mark.parametrize("shape", [(30, 7), (7, 30)])
def test_the_update_in_single_precision_is_that_in_double(shape):
    matrix, rhs = jr.normal(KEY, shape), jr.normal(KEY, shape[:1])
    double = _by_gram_matrix(matrix, rhs, jnp.asarray(1e-3))
    np.testing.assert_allclose(
        _by_triangular_factor(matrix, rhs, jnp.asarray(1e-3)), double, rtol=1e-9
    )


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 1e-20, 1e15])
def test_a_window_is_learned_to_ten_digits_in_any_unit(unit):
    pinn, log = dfc.fit(turning(unit=unit, width=30), oscillator, key=KEY)
    assert error_of_turning(pinn, unit) < 1e-8
    assert log.criteria.min() < 1e-15 * unit**2
    assert log.skipped == 0


@pytest.mark.slow
def test_a_flow_map_does_not_depend_on_the_units_of_components():
    def losses(units):
        here = units * states()
        network = dfc.DeepONet(here, 0.25, key=KEY, core="concatenated", **SMALL)
        recipe = dataclasses.replace(dfc.learned.second_order(network), epochs=20, points=50)
        options = dict(sample=here, args=units, key=KEY, recipe=recipe)
        return dfc.fit(network, field, **options)[1].losses

    def field(t, y, units):
        return units * LORENZ.vector_field(t, y / units, None)

    ones = losses(jnp.ones(3))
    assert ones[-1] < 0.5 * ones[0]
    np.testing.assert_allclose(losses(jnp.array([1.5e11, 1.0, 3e-20])), ones, rtol=1e-6)


@pytest.mark.slow
def test_the_recipe_goes_by_size():
    made = eqx.filter_jit(turning)  # in one program
    small = dfc.learned.second_order(made(3.0, width=30, windows=5))
    assert small.optimiser == "levenberg-marquardt"
    large = dfc.learned.second_order(made(3.0, width=40, depth=4))
    assert large.optimiser == "spring"
    assert large.refresh == 1
    assert dfc.learned.second_order(flow_map()).optimiser == "spring"


@pytest.mark.slow
def test_reachable_states_are_on_the_solutions():
    angles = jr.uniform(jr.key(1), (30,)) * 6
    y0s = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1) * 2
    states = dfc.learned.reachable_states(oscillator, y0s, 10.0, key=KEY)
    assert states.shape == (30, 2)
    np.testing.assert_allclose(jnp.sum(states**2, axis=1), 4, rtol=1e-4)
    assert float(jnp.max(jnp.abs(states - y0s))) > 1
    kept = dfc.learned.reachable_states(oscillator, y0s, 10.0, key=KEY, keep=lambda y: y[0] > 0)
    np.testing.assert_array_equal(kept, states[states[:, 0] > 0])


# ---- Without options `fit` does what the guide advises ----


def stiff(t, y, args):
    return -1e4 * y


def few(network, **options):
    found = dfc.learned.second_order(network, epochs=8)
    return dataclasses.replace(found, **(dict(points=10, check_every=4) | options))


def trained(field=LORENZ.vector_field, **options):
    network = flow_map()
    return dfc.fit(network, field, key=KEY, recipe=few(network, **options))[0]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The trained flow map is wrong")
@pytest.mark.parametrize(
    ("field", "options"), [(stiff, dict()), (LORENZ.vector_field, dict(taylor=0))]
)
def test_it_gets_none_where_that_would_harm_or_is_not_wanted(field, options):
    assert trained(field, **options).taylor is None


@pytest.mark.slow
def test_it_gets_the_slope_of_the_field():
    network = flow_map()
    found = dfc.fit(
        network, LORENZ.vector_field, key=KEY, sample=LORENZ.sample, recipe=few(network)
    )[0]
    assert isinstance(found.core, Gated)
    y = states(1)[0]
    np.testing.assert_allclose(found.slope(y), LORENZ.vector_field(0.0, y, None), rtol=1e-12)
