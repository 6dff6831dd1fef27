"""`fit` on problems that train in a second."""

import dataclasses

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
import pytest

import diffrax_conserve as dfc

from ..learned import EAST, LORENZ, RADIUS, SMALL, Still, Within, flow_map, in_single
from ..problems import oscillator, refused
from ..thinned import some_of

# Most of these trainings are too short, and say so; no library may warn of anything.
pytestmark = [
    pytest.mark.filterwarnings("error"),
    pytest.mark.filterwarnings("ignore:The trained `PINN` is not the solution"),
]
LAYER = dfc.learned.ConservativeLayer(RADIUS, steps=2)
KEY = jr.key(5)


def circle():
    """A PINN for a quarter of a turn."""
    return dfc.PINN(EAST, 0.0, 1.5, key=jr.key(0), **SMALL)


def recipe(model, epochs=60, points=30, **options):
    parts = dict(check_every=20, optimiser=optax.adam(1e-2))
    return dataclasses.replace(
        dfc.learned.paper.recipe(model, epochs=epochs, points=points), **(parts | options)
    )


def train(
    model, vector_field=oscillator, key=KEY, sample=None, args=None, progress=False, **options
):
    given = dict(key=key, sample=sample, args=args, progress=progress)
    return dfc.fit(model, vector_field, recipe=recipe(model, **options), **given)


def grid(key, count, first, last):
    return jnp.linspace(first, last, count)


def defect(pinn, points=50):
    """The mean squared defect, written out for one point at a time."""

    def one(t):
        y, velocity = jax.jvp(pinn, (t,), (jnp.ones(()),))
        return jnp.sum((velocity - oscillator(t, y, None)) ** 2)

    return float(jnp.mean(jax.jit(jax.vmap(one))(jnp.linspace(0, 1.5, points))))


def test_the_first_loss_is_that_of_the_formula_and_progress_may_end_a_training():
    model, calls = circle(), []

    def progress(*numbers):
        calls.append(numbers)
        return numbers[0] >= 20

    _, log = train(model, times=grid, progress=progress)
    np.testing.assert_allclose(log.losses[0], defect(model, 30), rtol=1e-12)
    np.testing.assert_allclose(log.criteria[0], defect(model, 30), rtol=1e-12)
    assert (log.ended, log.losses.size) == ("progress", 20)
    np.testing.assert_array_equal(log.checked, [0, 20])
    assert [call[:2] for call in calls] == [(0, 60), (20, 60)]
    assert calls[-1][3] <= calls[0][3]


@pytest.mark.slow
def test_the_best_model_is_returned_not_the_last():
    """A training that turns round and climbs."""
    optimiser = optax.sgd(lambda step: jnp.where(step < 60, 1e-2, -1e-2))
    options = dict(epochs=120, points=40, optimiser=optimiser, times=grid)
    model, log = train(circle(), **options)
    assert log.checked[log.criteria.argmin()] == 60
    assert log.criteria.min() < log.criteria[0]
    assert log.criteria[-1] > 1.01 * log.criteria.min()
    np.testing.assert_allclose(defect(model, 40), log.criteria.min(), rtol=1e-10)


@pytest.mark.slow
def test_a_planted_nan_is_survived():
    """A vector field that is NaN where the network soon is."""

    def trap(t, y, args):
        return jnp.where(y[1] < -0.5, jnp.nan, 1.0) * oscillator(t, y, args)

    model, log = train(circle(), trap, epochs=100)
    assert log.skipped > 0
    assert np.isfinite(log.criteria.min())
    assert all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(model.nets))
    assert log.criteria.min() <= log.criteria[0]


@pytest.mark.slow
def test_new_points_are_drawn_when_the_recipe_says_so():
    # Without updates the loss changes only with the points.
    still = dict(optimiser=optax.sgd(0.0), epochs=9)
    _, fixed = train(circle(), **still)
    _, fresh = train(circle(), refresh=3, **still)
    assert len(np.unique(fixed.losses)) == 1
    np.testing.assert_array_equal(np.diff(fresh.losses) != 0, [0, 0, 1, 0, 0, 1, 0, 0])


@pytest.mark.slow
@some_of("kind", ["flow map", "data", "windows"], period=3)
def test_the_second_of_several_seeds_compiles_nothing(kind, caplog):
    y0s = jnp.stack([EAST, -EAST, 0.5 * EAST[::-1]])
    ts, ys = jnp.linspace(0, 1, 4), jax.vmap(lambda y: jnp.outer(jnp.ones(4), y))(y0s)
    data = jnp.broadcast_to(ts, (3, 4)), ys + ts[:, None]

    def of_seed(seed):
        net_key, fit_key = jr.split(jr.key(seed))
        if kind == "windows":  # one of which is cut
            network = dfc.PINN(EAST, 0.0, 6.0, key=net_key, width=6)
            chosen = dataclasses.replace(dfc.learned.second_order(network, epochs=3), retries=1)
            return dfc.fit(network, oscillator, key=fit_key, recipe=chosen)
        network = dfc.DeepONet(y0s, 0.5, key=net_key, **SMALL)
        given = dict(data=data) if kind == "data" else dict(vector_field=oscillator, sample=y0s)
        chosen = dfc.learned.second_order(network, epochs=3)
        return dfc.fit(network, key=fit_key, recipe=chosen, **given)

    first, _ = of_seed(0)
    with jax.log_compiles():
        caplog.clear()
        second, _ = of_seed(1)
    assert [r.message for r in caplog.records if "Compiling" in r.message] == []
    assert not eqx.tree_equal(first, second)


@pytest.mark.slow
def test_a_line_search_of_optax():
    _, log = train(circle(), optimiser=optax.lbfgs(), epochs=20)
    assert log.skipped == 0
    assert log.criteria.min() < log.criteria[0] / 100


def test_the_losses():
    q = jnp.array([0.0, 1.0, 3.0, 1e12])
    assert dfc.learned.Recipe().loss(q[:3], jnp.array(9.0)) == 4 / 3
    bounded = dfc.learned.paper.recipe(flow_map()).loss(q, jnp.array(3.0))
    np.testing.assert_allclose(bounded, np.mean([0, 1 / (1 + 1 / 3), 3 / 2, 3.0]), rtol=1e-10)


RECIPE, TERM = dfc.learned.Recipe, dfx.ODETerm(LORENZ.vector_field)
TAYLOR = dict(vector_field=LORENZ.vector_field)


test_mistakes_are_named = refused(
    (lambda: refuse(sample=LORENZ.sample), ValueError, "leave `sample` and"),
    (lambda: refuse(Within(flow_map(), None), **TAYLOR), ValueError, "pass `sample`"),
    (lambda: refuse(vector_field=TERM), TypeError, "pass its `vector_field`"),
    (
        lambda: refuse(dfc.DeepONet(LORENZ.y0, 0.1, key=KEY, **SMALL), **TAYLOR),
        TypeError,
        r"Here a state is f64\[\]. For one state",
    ),
    (lambda: refuse(LAYER), TypeError, "max_step"),
    (lambda: refuse(Still(), sample=LORENZ.sample), ValueError, "no weights of its"),
    (lambda: refuse(flow_map(), manifold=RADIUS, **TAYLOR), ValueError, "ManifoldProjection"),
    (lambda: refuse(in_single(flow_map()), **TAYLOR), TypeError, "states are float64. Give"),
    (
        lambda: refuse(
            dfc.DeepONet(jnp.eye(2, dtype=jnp.float32), 0.5, key=KEY, **SMALL), sample=jnp.eye(2)
        ),
        TypeError,
        "weights of the model are float32",
    ),
    (lambda: refuse(data=(jnp.ones(2), jnp.ones(2))), ValueError, "and `data` out"),
    (lambda: refuse(recipe="adam"), TypeError, "`recipe` is "),
    (lambda: refuse(recipe=optax.adam(1e-3)), TypeError, "`recipe` is "),
    (lambda: refuse(key=0), TypeError, "`key` is "),
    (lambda: refuse(seconds="a"), TypeError, "`seconds` is "),
    (lambda: refuse(seconds=-1.0), ValueError, "must be positive"),
    (lambda: refuse(target=[1e-3]), TypeError, "`target` is "),
    (lambda: refuse(target=0.0), ValueError, "must be positive"),
    (lambda: RECIPE(epochs=0), ValueError, "`epochs` is 0, but it must be a positive integer"),
    (lambda: dfc.learned.second_order(circle(), epochs=0), ValueError, "`epochs` is 0, but"),
    (lambda: RECIPE(refresh=0), ValueError, "`refresh`"),
    (lambda: RECIPE(optimiser="adam"), TypeError, "`optimiser` is 'adam', .*one of 'spring'"),
    (lambda: RECIPE(optimiser="spring", damping=0.0), ValueError, "`damping` .*must be"),
)


def refuse(model=None, **options):
    model = circle() if model is None else model
    return dfc.fit(model, **(dict(vector_field=oscillator, key=KEY) | options))
