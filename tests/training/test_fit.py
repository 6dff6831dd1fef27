"""`fit` on problems that train in a second."""

import dataclasses
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jaxtyping
import numpy as np
import optax
import pytest

import diffrax_conserve as dfc
from diffrax_conserve.learned._training.recipe import complete, grid, mean, staged
from diffrax_conserve.learned.paper import _bounded

from ..learned import EAST, LORENZ, RADIUS, SMALL, Within, flow_map, oscillator

# Most of these trainings are too short, and say so.
pytestmark = pytest.mark.filterwarnings("ignore:The trained `PINN` is not the solution")
LAYER = dfc.learned.ConservativeLayer(RADIUS, steps=2)
KEY = jr.key(5)


def circle(layer=None, seed=0):
    """A PINN for a quarter of a turn."""
    return dfc.PINN(EAST, 0.0, 1.5, key=jr.key(seed), layer=layer, **SMALL)


def recipe(model, epochs=60, points=30, **options):
    parts = dict(check_every=20, optimiser=optax.adam(1e-2))
    return dataclasses.replace(
        dfc.learned.paper.recipe(model, epochs=epochs, points=points), **(parts | options)
    )


def train(
    model, vector_field=oscillator, key=KEY, sample=None, args=None, progress=False, **options
):
    return dfc.fit(
        model,
        vector_field,
        key=key,
        sample=sample,
        args=args,
        recipe=recipe(model, **options),
        progress=progress,
    )


def defect(pinn, points=50):
    """The mean squared defect, written out for one point at a time."""

    def one(t):
        y, velocity = jax.jvp(pinn, (t,), (jnp.ones(()),))
        return jnp.sum((velocity - oscillator(t, y, None)) ** 2)

    return float(jnp.mean(jax.jit(jax.vmap(one))(jnp.linspace(0, 1.5, points))))


def error(pinn):
    ts = jnp.linspace(0, 1.5, 20)
    exact = jnp.stack([jnp.cos(ts), -jnp.sin(ts)], axis=1)
    return float(jnp.max(jnp.abs(jax.jit(jax.vmap(pinn))(ts) - exact)))


# ---- It learns ----


@pytest.mark.parametrize(
    "layer", [pytest.param(None, marks=pytest.mark.slow), LAYER], ids=["standard", "conservative"]
)
def test_a_pinn_learns_a_solution(layer):
    before = circle(layer)
    after, log = train(before, epochs=300, optimiser=optax.adam(5e-3))
    assert defect(after) < defect(before) / 100
    assert error(after) < 0.05 < error(before)
    assert log.best < log.criteria[0] / 100


def test_any_flow_map_of_the_user_learns():
    class Linear(eqx.Module):
        rate: jax.Array
        max_step: float = eqx.field(static=True, default=0.5)

        def __call__(self, y0, h):
            return y0 * jnp.exp(self.rate * h)

    fitted, _ = train(
        Linear(jnp.array(0.0)),
        lambda t, y, args: args * y,
        args=-1.5,
        sample=lambda key: jr.uniform(key, minval=1.0, maxval=2.0),
        epochs=200,
        optimiser=optax.adam(0.05),
    )
    assert abs(float(fitted.rate) + 1.5) < 1e-3


# ---- What it records and returns ----


def test_the_first_loss_is_that_of_the_formula():
    points = 40

    def grid(key, count, first, last):
        return jnp.linspace(first, last, count)

    model = circle()
    _, log = train(model, epochs=1, points=points, times=grid)
    np.testing.assert_allclose(log.losses[0], defect(model, points), rtol=1e-12)
    np.testing.assert_allclose(log.criteria[0], defect(model, points), rtol=1e-12)


def test_the_best_model_is_returned_not_the_last():
    """A training that turns round and climbs."""
    optimiser = optax.sgd(lambda step: jnp.where(step < 60, 1e-2, -1e-2))
    options = dict(epochs=120, points=40, optimiser=optimiser, times=grid)
    model, log = train(circle(), **options)
    assert log.best_epoch == 60
    assert log.best == min(log.criteria) < log.criteria[0]
    assert log.criteria[-1] > 1.01 * log.best
    np.testing.assert_allclose(defect(model, 40), log.best, rtol=1e-10)


def test_the_same_key_gives_the_same_result():
    a, log_a = train(circle())
    b, log_b = train(circle())
    c, _ = train(circle(), key=jr.key(6))
    assert eqx.tree_equal(a, b)
    np.testing.assert_array_equal(log_a.losses, log_b.losses)
    assert not eqx.tree_equal(a, c)


def test_a_planted_nan_is_survived():
    """A vector field that is NaN where the network soon is."""

    def trap(t, y, args):
        return jnp.where(y[1] < -0.5, jnp.nan, 1.0) * oscillator(t, y, args)

    model, log = train(circle(), trap, epochs=100)
    assert log.skipped > 0
    assert np.isfinite(log.best)
    assert all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(model.nets))
    assert log.best <= log.criteria[0]


def test_new_points_are_drawn_when_the_recipe_says_so():
    # Without updates the loss changes only with the points.
    still = dict(optimiser=optax.sgd(0.0), epochs=9)
    _, fixed = train(circle(), **still)
    _, fresh = train(circle(), refresh=3, **still)
    assert len(np.unique(fixed.losses)) == 1
    np.testing.assert_array_equal(np.diff(fresh.losses) != 0, [0, 0, 1, 0, 0, 1, 0, 0])


def test_epochs_that_are_no_multiple_of_the_checks():
    _, log = train(circle(), epochs=45)
    np.testing.assert_array_equal(log.checked, [0, 20, 40, 45])
    assert log.losses.shape == (45,)
    assert np.all(np.isfinite(log.losses))


def test_progress(capsys):
    calls = []
    train(circle(), progress=lambda *numbers: calls.append(numbers))
    assert [call[:2] for call in calls] == [(0, 60), (20, 60), (40, 60), (60, 60)]
    assert calls[-1][3] <= calls[0][3]
    train(circle(), progress=True)
    assert "epoch 60 of 60" in capsys.readouterr().err


# ---- The schedule ----


def test_the_schedules():
    epochs, steps = 400, 3
    es = jnp.arange(epochs)
    p, s = jax.vmap(lambda e: staged(e, epochs, steps))(es)
    np.testing.assert_array_equal(p, np.repeat([0, 1, 2, 3], 100))
    np.testing.assert_allclose(s, np.tile(np.arange(100) / 100, 4), atol=1e-12)
    p, s = jax.vmap(lambda e: complete(e, epochs, steps))(es)
    np.testing.assert_array_equal(p, np.full(epochs, 3))
    np.testing.assert_array_equal(s, np.ones(epochs))


# ---- The loss ----


def test_the_losses():
    q = jnp.array([0.0, 1.0, 3.0, 1e12])
    assert mean(q[:3], jnp.array(9.0)) == 4 / 3
    bounded = _bounded(q, jnp.array(3.0))
    np.testing.assert_allclose(bounded, np.mean([0, 1 / (1 + 1 / 3), 3 / 2, 3.0]), rtol=1e-10)


# ---- What is refused ----


def test_arguments_that_are_refused():
    with pytest.raises(ValueError, match="leave `sample` out"):
        dfc.fit(circle(), oscillator, key=KEY, sample=LORENZ.sample)
    unbounded = Within(flow_map(), None)
    with pytest.raises(ValueError, match="pass `sample`"):
        dfc.fit(unbounded, LORENZ.vector_field, key=KEY)
    with pytest.raises(TypeError, match="max_step"):
        dfc.fit(LAYER, oscillator, key=KEY)
    without_weights = dfc.learned.FlowMap(lambda y0, h: y0, 1.0)
    with pytest.raises(ValueError, match="no weights of its own"):
        dfc.fit(without_weights, oscillator, key=KEY, sample=lambda key: EAST)
    with pytest.raises(ValueError, match="`epochs` is 0, but it must be at least 1"):
        dfc.learned.Recipe(epochs=0)
    with pytest.raises(ValueError, match="`refresh`"):
        dfc.learned.Recipe(refresh=0)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("recipe", "adam"),
        ("recipe", optax.adam(1e-3)),
        ("vector_field", 1.0),
        ("key", 0),
        ("progress", "yes"),
        ("seconds", "a"),
        ("target", [1e-3]),
    ],
)
def test_arguments_of_a_wrong_type_are_named(name, wrong):
    """As users see it: the run-time type checker of the suite would answer first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        with pytest.raises(TypeError, match=f"`{name}` is .*"):
            dfc.fit(circle(), **(dict(vector_field=oscillator, key=KEY) | {name: wrong}))
        with pytest.raises(TypeError, match="`optimiser` is 'adam'"):
            dfc.learned.Recipe(optimiser="adam")
        with pytest.raises(TypeError, match="`loss` is 'mean'"):
            dfc.learned.Recipe(loss="mean")
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


# ---- The real thing ----


@pytest.mark.slow
def test_the_papers_recipe_on_the_rigid_body():
    system = dfc.systems.get("rigid-body")
    layer = dfc.learned.ConservativeLayer(system.manifold, steps=5)
    pinn = dfc.learned.paper.pinn(system.y0, 0.0, system.t1, key=jr.key(2), layer=layer)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pinn, log = dfc.fit(
            pinn, system.vector_field, key=jr.key(3), recipe=dfc.learned.paper.recipe(pinn)
        )
    warned = any("is not the solution" in str(x.message) for x in caught)
    ts = jnp.linspace(0, system.t1, 100)
    error = float(jnp.max(jnp.abs(jax.vmap(pinn)(ts) - system.reference(ts))))
    # From some keys it ends at another solution, 1.3 off, with a loss of 6e-5: no recipe of this
    # kind is safe from that. Which keys depends on the roundoff of the machine.
    assert error < 1e-3 or (error > 1 and warned and log.error > 0.1 * error)
    assert log.skipped == 0
    assert log.best == min(log.criteria)
    assert log.compile_seconds < 30
