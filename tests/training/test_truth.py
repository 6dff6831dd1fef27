"""A training tells the truth; it stops and goes on, bit for bit as if it had not stopped."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
import pytest

import diffrax_conserve as dfc
from diffrax_conserve.learned._networks.trainable import Points
from diffrax_conserve.learned._training.errors import warn_off_manifold

from ..learned import EAST, LORENZ, error_of_turning, flow_map, turning
from ..problems import oscillator, refused

KEY = jr.key(5)
WRONG = "The trained `PINN` is not the solution"
pytestmark = pytest.mark.filterwarnings(f"ignore:{WRONG}")


def recipe(network, epochs=5, **options):
    found = dfc.learned.second_order(network, epochs=epochs)
    return dataclasses.replace(found, **(dict(points=40, check_every=5) | options))


@pytest.mark.slow
def test_each_leaf_counts_in_its_own_units():
    """Of the rotation as two leaves."""
    field = lambda t, y, args: {"q": 1e-9 * y["p"], "p": -1e9 * y["q"]}  # noqa: E731
    y0 = {"q": jnp.array(1e-3), "p": jnp.array(0.0)}
    network = dfc.PINN(y0, 0.0, 2.0, width=8, depth=1, slope=2.0, key=KEY)
    chosen = recipe(network, 8, retries=0)
    trained, log = dfc.fit(network, field, key=KEY, recipe=chosen)
    ts = jnp.linspace(0, 2, 300)
    found = jax.jit(jax.vmap(trained))(ts)
    errors = [
        jnp.max(jnp.abs(found["q"] - 1e-3 * jnp.cos(ts))) / jnp.max(jnp.abs(found["q"])),
        jnp.max(jnp.abs(found["p"] / 1e6 + jnp.sin(ts))),
    ]
    np.testing.assert_allclose(log.error, np.max(errors), rtol=0.02)
    assert log.error < 1e-3


@pytest.mark.slow
def test_the_estimate_of_a_flow_map_is_its_error():
    network, options = small_flow_map()
    trained, log = dfc.fit(network, **options)
    y0s = jax.vmap(LORENZ.sample)(jr.split(KEY, 64))  # those of the estimate
    exact = jax.jit(jax.vmap(lambda y0: LORENZ.reference(jnp.array([0.25]), y0)[0]))(y0s)
    errors = jax.jit(jax.vmap(trained, (0, None)))(y0s, 0.25) - exact
    expected = jnp.max(jnp.sqrt(jnp.mean(errors**2, axis=0))) / jnp.max(jnp.abs(exact))
    np.testing.assert_allclose(log.error, expected, rtol=0.3)


@pytest.mark.slow
def test_a_window_that_failed_is_trained_until_it_is_right():
    """Three turns in one window are too many for so few units."""
    network = turning(t1=20.0, width=20)
    once = recipe(network, 40, points=80, retries=0)
    with pytest.warns(UserWarning, match=r"Window 0 of 1, from 0 to 20, has an estimated error"):
        trained, log = dfc.fit(network, oscillator, key=KEY, recipe=once)
    np.testing.assert_allclose(log.error, error_of_turning(trained), rtol=0.02)
    assert log.error > 1e-2
    again = recipe(network, 40, points=80)
    trained, log = dfc.fit(network, oscillator, key=KEY, recipe=again, target=1e-5)
    assert log.ended == "target"
    assert trained.windows == log.errors.size > 1
    np.testing.assert_allclose(log.error, error_of_turning(trained), rtol=0.05, atol=1e-12)
    assert log.error < 1e-5


def taught(field=LORENZ.vector_field, make=flow_map, sample=LORENZ.sample, **options):
    def teach():
        network = make()
        chosen = dict(recipe=recipe(network, points=30)) | options
        dfc.fit(network, field, key=KEY, sample=None if make is turning else sample, **chosen)

    return teach


test_what_cannot_be_learned_is_refused = refused(
    (
        taught(lambda t, y, args: jnp.nan * y, turning),
        ValueError,
        "not finite at 1 of 1 initial states",
    ),
    (
        taught(lambda t, y, args: jnp.where(y[0] > 1.2, jnp.nan, 1.0) * y),
        ValueError,
        r"not finite at \d+ of 30 initial states, for example at",
    ),
    (taught(lambda t, y, args: jnp.cos(t) * y), ValueError, "depends on time.*autonomous"),
    (taught(lambda t, y, args: jnp.where(t > 5, 2.0, 1.0) * y), ValueError, "depends on time"),
    (
        taught(lambda t, y, args: jnp.ones(3), turning),
        ValueError,
        r"returns the structure \(3,\).*has \(2,\)",
    ),
    (taught(lambda t, y, args: (y, y)), ValueError, "returns the structure"),
    (taught(sample=np.ones((5, 2))), "for states of 3 numbers, not 2"),
    (taught(sample=np.ones(3)), "for states of 3 numbers, not 1"),
    (taught(sample=np.full((5, 3), np.nan)), "`sample` holds a state that is not finite"),
    (taught(recipe=optax.sgd(0.1)), "`recipe` is of type .*must be a `Recipe`"),
)


@pytest.mark.slow
def test_a_layer_that_cannot_be_kept_is_told():
    wrong = dfc.FirstIntegral(lambda t, y, args: y[0] ** 2 + 2 * y[1] ** 2)
    network = turning(layer=dfc.learned.ConservativeLayer(wrong))
    with pytest.warns(UserWarning, match="does not conserve `manifold` of the `layer`"):
        dfc.fit(network, oscillator, key=KEY, recipe=recipe(network, retries=0))
    root = dfc.FirstIntegral(lambda t, y, args: jnp.log(-y[0]))
    network = turning(layer=dfc.learned.ConservativeLayer(root))
    with pytest.raises(ValueError, match="values of the `layer` are not finite at 1 of 1 initial"):
        dfc.fit(network, oscillator, key=KEY)


@pytest.mark.parametrize(("sign", "told"), [(-1, []), (1, ["At 1 of the collocation points"])])
def test_points_off_the_manifold_are_told(sign, told, recwarn):
    """Of any weights: on the circle there is a state everywhere, on an empty set nowhere."""
    circle = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) + sign)
    network = turning(layer=dfc.learned.ConservativeLayer(circle)).window(0)
    warn_off_manifold(network, Points(jnp.linspace(0, 3, 5), None))
    assert [str(warning.message)[:30] for warning in recwarn] == told


def test_a_training_without_an_update_is_an_error():
    """The field is finite where it starts, and nowhere else."""

    def trap(t, y, args):
        return jnp.where(jnp.all(y == EAST), 1.0, jnp.nan) * oscillator(t, y, args)

    network = turning()
    chosen = dfc.learned.Recipe(epochs=4, points=10, optimiser=optax.adam(1e-3))
    with pytest.raises(FloatingPointError, match="None of the 4 updates was finite"):
        dfc.fit(network, trap, key=KEY, recipe=chosen)


# ---- A training stops and goes on, bit for bit as if it had not stopped ----


class Interrupt:
    """A reader of the progress who presses Ctrl-C at some epochs."""

    def __init__(self, *epochs):
        self.epochs = list(epochs)

    def __call__(self, done, total, loss, best):
        assert np.isfinite(loss)
        assert np.isfinite(best)
        if self.epochs and done >= self.epochs[0]:
            self.epochs.pop(0)
            raise KeyboardInterrupt


def small_flow_map():
    network = flow_map(core="concatenated")
    chosen = dataclasses.replace(
        dfc.learned.second_order(network, epochs=24), points=20, check_every=4
    )
    return network, dict(
        vector_field=LORENZ.vector_field, key=KEY, sample=LORENZ.sample, recipe=chosen
    )


def same(found, expected):
    (model, log), (other, other_log) = found, expected
    assert eqx.tree_equal(model, other)
    for name in ("losses", "checked", "criteria", "errors"):
        np.testing.assert_array_equal(getattr(log, name), getattr(other_log, name))
    assert log.error == other_log.error


@pytest.mark.slow
def test_a_training_goes_on_from_a_file(tmp_path):
    network, options = small_flow_map()
    whole, path = dfc.fit(network, **options), tmp_path / "training"
    # It ends before its first update.
    with pytest.warns(UserWarning, match="flow map is wrong"):
        like, log = dfc.fit(network, **options, seconds=1e-9)
    like = like, log.state
    model, log = dfc.fit(network, **options, progress=Interrupt(4))
    for stop in (12, 99):
        eqx.tree_serialise_leaves(path, (model, log.state))
        model, state = eqx.tree_deserialise_leaves(path, like)
        model, log = dfc.fit(model, **options, state=state, progress=Interrupt(stop))
    assert log.ended == "epochs"
    same((model, log), whole)


@pytest.mark.slow
def test_an_interrupted_training_goes_on():
    """Whose second window is trained again and cut, before it is right."""
    network = turning(t1=12.0, windows=2)
    options = dict(vector_field=oscillator, key=KEY, recipe=recipe(network, 20, retries=3))
    whole = dfc.fit(network, **options)
    model, state, stops = network, None, Interrupt(4, 45)
    for _ in range(3):
        # From the windows of the last piece; the original network gives the same.
        model, log = dfc.fit(model, **options, state=state, progress=stops)
        state = log.state
    assert log.ended == "epochs"
    same((model, log), whole)
    assert model.windows > network.windows
