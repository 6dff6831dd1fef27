"""Second-order training, its recipes, and training from data; without options `fit` does what the
guide advises."""

import dataclasses
import functools as ft

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import diffrax_conserve as dfc
from diffrax_conserve.learned._networks.cores import Gated
from diffrax_conserve.learned._training.data import as_data
from diffrax_conserve.learned._training.objective import Problem, advance, start
from diffrax_conserve.learned._training.second_order import (
    METHODS,
    _by_gram_matrix,
    _by_triangular_factor,
)

from ..learned import (
    EAST,
    LORENZ,
    RADIUS,
    SMALL,
    Scale,
    error_of_turning,
    flow_map,
    states,
    turning,
)
from ..problems import oscillator, refused
from ..thinned import some_of

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


@pytest.mark.parametrize("steps", [None, 2])
@pytest.mark.parametrize("method", METHODS)
def test_an_epoch_through_a_layer_returns_what_it_is_given(method, steps):
    """In its shapes: to compile one takes twenty times as long as to trace it."""
    layer = dfc.learned.ConservativeLayer(RADIUS, steps=steps)
    recipe = dfc.learned.Recipe(epochs=3, points=4, optimiser=method)
    problem, model = Problem(oscillator, None, None, None, recipe), turning(layer=layer).window(0)

    def trained():
        objective, before = start(problem, model, KEY)
        return before, advance(objective, before, *map(jnp.asarray, (0, 2, True)))

    before, after = eqx.filter_eval_shape(trained)
    assert eqx.tree_equal(before, after)


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


# ---- Flow maps from trajectories, and in other coordinates ----

RNG = np.random.default_rng(0)
Y0S = 2 * RNG.normal(size=(40, 2))
TS = 3 * np.sort(RNG.uniform(size=(40, 12)), axis=1)  # unequal steps
X, Y = Y0S.T[..., None]
EXACT = np.stack([np.cos(TS) * X + np.sin(TS) * Y, np.cos(TS) * Y - np.sin(TS) * X], axis=-1)
HOLED = np.where(np.arange(40)[:, None, None], EXACT, np.nan)


@eqx.filter_jit
def network():
    return dfc.DeepONet(Y0S, 0.5, key=jr.key(0), core="concatenated", **SMALL)


def test_every_pair_of_times_within_a_step_is_drawn_and_no_other():
    ts = np.array([[0.0, 0.2, 0.5, 0.6]])  # the longest step is 0.5
    pairs = as_data((ts, np.stack([ts, 2 * ts], axis=2)), network()).draw(1000, KEY)
    pairs = jax.tree.map(np.asarray, pairs)
    drawn = np.unique(np.stack([pairs.y0s[:, 0], pairs.y1s[:, 0]], axis=1), axis=0)
    assert drawn.tolist() == [[0.0, 0.2], [0.0, 0.5], [0.2, 0.5], [0.2, 0.6], [0.5, 0.6]]
    np.testing.assert_array_equal(pairs.hs, (pairs.y1s - pairs.y0s)[:, 0])


@pytest.mark.slow
def test_trajectories_are_solutions():
    ts, ys = dfc.learned.trajectories(oscillator, Y0S[:4], TS[:4], rtol=1e-10)
    np.testing.assert_array_equal(ts, TS[:4])
    np.testing.assert_allclose(ys, EXACT[:4], rtol=0, atol=1e-8)
    solve = lambda y0s: dfc.learned.trajectories(  # noqa: E731
        lambda t, y, args: y**2, jnp.array(y0s), [0.0, 0.5, 1.0], solver=dfx.Tsit5()
    )
    ts, ys = solve([0.5, 2.0])
    # The other one ends in finite time.
    np.testing.assert_allclose(ys, [1 / (1 / 0.5 - np.array([0.0, 0.5, 1.0]))], rtol=1e-6)
    with pytest.raises(ValueError, match="every solve failed"):
        solve([2.0, 3.0])
    with pytest.raises(IndexError, match=r"Here a state is f64\[\]. For one state"):
        dfc.learned.reachable_states(lambda t, y, args: y[::-1], EAST, 1.0, key=KEY)


def of_data(ts=TS, ys=EXACT, **options):
    return lambda: dfc.fit(network(), key=KEY, data=(ts, ys), **options)


test_data_that_make_no_sense = refused(
    (of_data(TS[0], EXACT[0]), ValueError, "leading axes"),
    (of_data(TS, EXACT[:, :-1]), ValueError, "leading axes"),
    (of_data(TS[:, ::-1]), ValueError, "must increase"),
    (of_data(TS, HOLED), ValueError, "numbers in `data` are not finite"),
    (of_data(100 * TS[:, ::4], EXACT[:, ::4]), ValueError, "No two times"),
    (lambda: dfc.fit(network(), key=KEY), TypeError, "needs a `vector_field`"),
    (of_data(sample=lambda key: EAST), TypeError, "`sample` is only used with"),
)


@pytest.mark.slow
@some_of("exponent", [0.1, 0.5, 0.75], period=3)
def test_exact_zeros_train_in_box_cox_coordinates(exponent):
    ts = jnp.broadcast_to(jnp.linspace(0, 2, 9), (40, 9))
    ys = jnp.exp(Y0S)[:, None] * jnp.exp(-ts[..., None] * jnp.array([1.0, 3.0]))
    ys = jnp.where(ys < 0.05, 0.0, ys)
    boxcox = dfc.learned.BoxCox(exponent)
    inner = dfc.DeepONet(boxcox(ys.reshape(-1, 2)), 1.0, width=8, depth=1, key=KEY)
    before = dfc.learned.Transformed(inner, boxcox)
    recipe = dataclasses.replace(dfc.learned.second_order(before, epochs=20), points=40)
    _, log = dfc.fit(before, data=(ts, ys), key=KEY, recipe=recipe)
    assert log.skipped == 0
    assert log.losses[-1] < log.losses[0]
    logarithm = dfc.learned.Transformed(inner, dfc.learned.BoxCox(0.0))
    with pytest.raises(ValueError, match="such as the logarithm of zero"):
        dfc.fit(logarithm, data=(ts, ys), key=KEY)


TRANSFORMATIONS = {
    "log": dfc.learned.BoxCox(0.0),
    "box-cox": dfc.learned.BoxCox(0.1),
    "scale": Scale(np.array([2.0, 1e-8, 30.0])),
}


@ft.cache
def decays(name):
    transformation = TRANSFORMATIONS[name]
    states = np.exp(3 * RNG.normal(size=(50, 3))) * np.array([1.0, 1e-8, 1.0])
    inner = dfc.DeepONet(jax.vmap(transformation)(states), 1.0, key=jr.key(0), **SMALL)
    return dfc.learned.Transformed(inner, transformation)


@eqx.filter_jit
def step(flow_map, y0, h):
    return flow_map(y0, h)


@pytest.mark.parametrize("name", TRANSFORMATIONS)
@given(seed=st.integers(0, 2**31), h=st.floats(0, 1))
def test_the_initial_state_is_exact_and_nothing_is_negative(name, seed, h):
    flow_map, y0 = decays(name), jnp.exp(10 * np.random.default_rng(seed).normal(size=3))
    np.testing.assert_array_equal(step(flow_map, y0, jnp.zeros(())), y0)
    if name != "scale":
        assert bool(jnp.all(step(flow_map, y0, jnp.asarray(h)) >= 0))
