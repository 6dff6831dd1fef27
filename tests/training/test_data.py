"""Flow maps from trajectories, and in other coordinates."""

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
from diffrax_conserve.learned._training.data import as_data

from ..learned import EAST, SMALL, Scale
from ..problems import oscillator, refused
from ..thinned import some_of

KEY = jr.key(5)
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


def of(ts=TS, ys=EXACT, **options):
    return lambda: dfc.fit(network(), key=KEY, data=(ts, ys), **options)


test_data_that_make_no_sense = refused(
    (of(TS[0], EXACT[0]), ValueError, "leading axes"),
    (of(TS, EXACT[:, :-1]), ValueError, "leading axes"),
    (of(TS[:, ::-1]), ValueError, "must increase"),
    (of(TS, HOLED), ValueError, "numbers in `data` are not finite"),
    (of(100 * TS[:, ::4], EXACT[:, ::4]), ValueError, "No two times"),
    (lambda: dfc.fit(network(), key=KEY), TypeError, "needs a `vector_field`"),
    (of(sample=lambda key: EAST), TypeError, "`sample` is only used with"),
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
