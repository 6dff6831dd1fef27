"""A pool of initial states that grows by the network itself."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
import pytest

import diffrax_conserve as dfc

from ..learned import EAST, LORENZ, RADIUS, SMALL, oscillator

KEY = jr.key(5)
COUNT = 400


class Turning(eqx.Module):
    """The flow map of the oscillator, whose clock and radius may be wrong."""

    rate: Any = 1.0
    growth: Any = 0.0
    domain: Any = None
    max_step: float = 1.0

    def __call__(self, y0, h):
        c, s = jnp.cos(self.rate * h), jnp.sin(self.rate * h)
        turned = jnp.stack([c * y0[0] + s * y0[1], c * y0[1] - s * y0[0]])
        return turned * (1 + self.growth * h)


def near_east(key):
    """A state in a small piece of the ring between the radii 1 and 2."""
    low, high = jnp.array([1.0, 0.0]), jnp.array([2.0, 0.1])
    radius, angle = jr.uniform(key, (2,), minval=low, maxval=high)
    return radius * jnp.stack([jnp.cos(angle), -jnp.sin(angle)])


def radii(ys):
    return np.linalg.norm(ys, axis=-1)


Y0S = jax.vmap(near_east)(jr.split(jr.key(1), COUNT))
BOX = dfc.learned.Box.around(Y0S)
QUARTER = jnp.array([[0.0, 1.0], [-1.0, 0.0]])


def train(model=None, pool=None, key=KEY, vector_field=oscillator, epochs=40, **changes):
    """Of the clock of `Turning`, which is 10 % slow."""
    model = Turning(jnp.asarray(0.9), 0.0, BOX) if model is None else model
    pool = dfc.learned.Pool(near_east) if pool is None else pool
    parts = dict(points=60, optimiser=optax.sgd(0.02), refresh=1, check_every=10) | changes
    recipe = dfc.learned.Recipe(epochs=epochs, **parts)
    return dfc.fit(model, vector_field, key=key, sample=pool, recipe=recipe)


@functools.cache
def trained_clock():
    return train(epochs=60)


def test_the_domain_covers_where_the_pool_has_been():
    trained, log = trained_clock()
    assert log.best_epoch == 60
    ring = jax.vmap(lambda a: 1.5 * jnp.stack([jnp.cos(a), jnp.sin(a)]))(jnp.arange(0.0, 6.2, 0.1))
    inside = jax.vmap(trained.domain.contains)
    assert not bool(jnp.all(jax.vmap(BOX.contains)(ring)))
    assert bool(jnp.all(inside(ring)))
    assert bool(jnp.all(inside(Y0S)))
    corners = jnp.stack([trained.domain.lower, trained.domain.upper])
    assert float(jnp.max(jnp.abs(corners))) <= 2 + 1e-12


@pytest.mark.parametrize("options", [dict(mean_steps=1), dict(max_defect=1e-6)])
def test_states_start_again_by_chance_or_if_the_defect_is_large(options):
    trained, log = train(pool=dfc.learned.Pool(near_east, **options), epochs=60)
    assert log.best_epoch == 60
    assert float(trained.domain.lower[0]) > 0.9


def test_states_stay_on_the_manifold_of_their_own_start():
    """Though the network leaves it in every step."""
    growing = Turning(jnp.asarray(0.9), 0.05, BOX)
    kept, free = (
        train(growing, dfc.learned.Pool(near_east, manifold=manifold), epochs=60)[0].domain
        for manifold in (RADIUS, None)
    )
    assert float(jnp.min(kept.lower)) >= -2 - 1e-12
    assert float(jnp.min(free.lower)) < -2.2


def test_only_states_that_are_to_be_kept_go_on():
    trained, _ = train(pool=dfc.learned.Pool(near_east, keep=lambda y: y[1] > -0.5), epochs=60)
    assert -0.5 < float(trained.domain.lower[1]) < -0.4


def test_the_domain_is_that_of_the_model_that_is_returned():
    """The best one is that of epoch 20, when the pool is not yet trusted with a domain."""
    optimiser = optax.sgd(lambda step: jnp.where(step < 20, 0.02, -0.02))
    trained, log = train(optimiser=optimiser, epochs=60)
    assert log.best_epoch == 20
    assert eqx.tree_equal(trained.domain, BOX)


def test_two_models_are_compared_on_the_same_states():
    """Without updates none is better than the first, though the states are others each time."""
    _, log = train(optimiser=optax.sgd(0.0), vector_field=lambda t, y, args: y**3)
    assert log.best_epoch == 0
    assert len(np.unique(log.criteria)) == len(log.criteria)


def small_network(**options):
    # Normalised by states from all round the circle, as far as it will go.
    ring = jnp.concatenate([Y0S, -Y0S, Y0S @ QUARTER, -Y0S @ QUARTER])
    options = dict(core=dfc.learned.Concatenated, key=jr.key(3)) | SMALL | options
    return eqx.tree_at(lambda m: m.domain, dfc.DeepONet(ring, 1.0, **options), BOX)


@pytest.mark.parametrize("pool", [True, False], ids=["pool", "samples"])
def test_it_learns_where_it_was_never_told_to_look(pool):
    """On the other side of the circle, from samples on this one: no solution is given."""
    recipe = dataclasses.replace(dfc.learned.second_order(small_network(), epochs=200), points=40)
    sample = dfc.learned.Pool(near_east) if pool else near_east
    network, _ = dfc.fit(small_network(), oscillator, key=KEY, sample=sample, recipe=recipe)
    turn = jnp.array([[jnp.cos(1.0), -jnp.sin(1.0)], [jnp.sin(1.0), jnp.cos(1.0)]])
    error = np.max(radii(jax.jit(jax.vmap(network, (0, None)))(-Y0S, 1.0) + Y0S @ turn))
    inside = jnp.mean(jax.vmap(network.domain.contains)(-Y0S))
    assert (error < 0.02 and inside > 0.9) if pool else (error > 0.2 and inside == 0)


MANY = dfc.FirstIntegral(lambda t, y, args: jnp.ones(3) * jnp.sum(y))


PINN = dfc.PINN(EAST, 0.0, 1.0, key=KEY, **SMALL)


def integers(key):
    return jr.randint(key, (2,), 1, 5)


class Pair(Turning):
    def __call__(self, y0, h):
        return y0, h


def pool(sample=near_east, **options):
    return dfc.learned.Pool(sample, **options)


@pytest.mark.parametrize(
    ("make", "error", "match"),
    [
        (lambda: pool(manifold=lambda t, y, args: y), TypeError, "FirstIntegral"),
        (lambda: pool(manifold=()), ValueError, "nothing to conserve"),
        (lambda: pool(mean_steps=0.5), ValueError, "`mean_steps` is 0.5, but it must be at least"),
        (lambda: pool(mean_steps=float("nan")), ValueError, "`mean_steps`"),
        (lambda: pool(max_defect=0), ValueError, "`max_defect` is 0, but it must be positive"),
        (lambda: train(refresh=None), ValueError, "that is never"),
        (lambda: train(refresh=40), ValueError, "that is never"),
        (lambda: train(PINN), ValueError, "leave `sample` out"),
        (lambda: train(small_network(), pool(LORENZ.sample)), ValueError, "of 2 numbers, but was"),
        (lambda: train(Pair(jnp.array(1.0))), ValueError, "`model` returns the structure"),
        (lambda: train(pool=pool(manifold=MANY)), ValueError, "3 scalar constraints, but the"),
        (lambda: train(pool=pool(integers)), TypeError, "needs real floating-point states"),
    ],
)
def test_mistakes_are_named(make, error, match):
    with pytest.raises(error, match=match):
        make()


def test_a_pool_draws_from_given_states():
    drawn = jax.vmap(dfc.learned.Pool(Y0S))(jr.split(KEY, 20))
    assert bool(jnp.all(jnp.any(jnp.all(drawn[:, None] == Y0S, axis=2), axis=1)))
