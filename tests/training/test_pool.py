"""A pool of initial states that grows by the network itself."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jaxtyping
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st

import diffrax_conserve as dfc
from diffrax_conserve.learned._networks.flow_map import as_flow_map
from diffrax_conserve.learned._training.objective import Problem, fresh_points, start
from diffrax_conserve.learned._training.pool import moved

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


class Own(eqx.Module):
    """Any function as a flow map."""

    function: Any
    weight: Any = eqx.field(default_factory=lambda: jnp.zeros(()))
    max_step: float = 1.0

    def __call__(self, y0, h):
        return self.function(y0, h)


def near_east(key):
    """A state in a small piece of the ring between the radii 1 and 2."""
    radius, angle = jr.uniform(
        key, (2,), minval=jnp.array([1.0, 0.0]), maxval=jnp.array([2.0, 0.1])
    )
    return radius * jnp.stack([jnp.cos(angle), -jnp.sin(angle)])


def radii(ys):
    return jnp.linalg.norm(ys, axis=-1)


Y0S = jax.vmap(near_east)(jr.split(jr.key(1), COUNT))
FRESH = jax.vmap(near_east)(jr.split(jr.key(2), COUNT))


@eqx.filter_jit
def move(pool, model, y0s, key, square=0.0, fresh=FRESH):
    """The states after a step, if all steps have that squared defect, and f is one."""

    def squares(steps):
        return jnp.broadcast_to(square, steps.ts.shape)

    return moved(pool, as_flow_map(model), None, squares, jnp.asarray(1.0), y0s, fresh, key)


def begun_again(ys, fresh=FRESH):
    return np.all(np.asarray(ys == fresh), axis=-1)


# ---- One step of all states ----


@given(st.integers(0, 2**31 - 1), st.floats(-0.1, 0.1))
def test_states_stay_on_the_manifold_of_their_own_start(seed, growth):
    """Though the network leaves it in every step."""
    pool = dfc.learned.Pool(near_east, manifold=RADIUS, mean_steps=1e9)
    ys, model = Y0S, Turning(jnp.asarray(0.9), jnp.asarray(growth))
    for key in jr.split(jr.key(seed), 20):
        ys = move(pool, model, ys, key)
    np.testing.assert_allclose(radii(ys), radii(Y0S), rtol=1e-14)
    # They went far: their angles are spread over the circle.
    assert float(jnp.max(radii(ys - Y0S))) > 1


@given(st.integers(0, 2**31 - 1))
def test_a_step_has_a_random_length_up_to_the_longest(seed):
    ys = move(dfc.learned.Pool(near_east, mean_steps=1e9), Turning(), Y0S, jr.key(seed))
    angles = jnp.arctan2(-ys[:, 1], ys[:, 0]) - jnp.arctan2(-Y0S[:, 1], Y0S[:, 0])
    assert float(jnp.min(angles)) >= -1e-12
    assert float(jnp.max(angles)) <= 1 + 1e-12
    # The mean of 400 uniform numbers, within six standard deviations.
    assert abs(float(jnp.mean(angles)) - 0.5) < 6 * (1 / 12 / COUNT) ** 0.5


@pytest.mark.parametrize("mean_steps", [1, 4, 20])
def test_one_state_in_mean_steps_starts_again(mean_steps):
    pool = dfc.learned.Pool(near_east, mean_steps=mean_steps)
    keys = jr.split(KEY, 25)
    share = np.mean([begun_again(move(pool, Turning(), Y0S, key)) for key in keys])
    deviation = np.sqrt((1 - 1 / mean_steps) / mean_steps / (25 * COUNT))
    assert abs(share - 1 / mean_steps) <= 5 * deviation


@pytest.mark.parametrize("square", [0.011, 1e30, jnp.inf, jnp.nan])
def test_a_step_with_a_large_defect_is_not_taken(square):
    pool = dfc.learned.Pool(near_east, mean_steps=1e9, max_defect=0.1)
    assert begun_again(move(pool, Turning(), Y0S, KEY, square)).all()
    assert not begun_again(move(pool, Turning(), Y0S, KEY, 0.009)).any()


@pytest.mark.parametrize("growth", [jnp.nan, jnp.inf, 1e308])
def test_a_state_that_is_not_finite_starts_again(growth):
    pool = dfc.learned.Pool(near_east, mean_steps=1e9, max_defect=jnp.inf)
    ys = move(pool, Turning(growth=growth, max_step=1e3), Y0S, KEY)
    assert bool(jnp.all(jnp.isfinite(ys)))
    assert begun_again(ys).mean() > 0.99


def test_a_state_whose_projection_fails_starts_again():
    """At the origin the radius has no gradient."""
    model = Own(lambda y0, h: y0 * jnp.where(y0[0] > 1.5, 0.0, 1.0))
    pool = dfc.learned.Pool(near_east, manifold=RADIUS, mean_steps=1e9)
    ys = move(pool, model, Y0S, KEY)
    np.testing.assert_array_equal(begun_again(ys), Y0S[:, 0] > 1.5)


def test_only_states_that_are_to_be_kept_go_on():
    pool = dfc.learned.Pool(near_east, mean_steps=1e9, keep=lambda y: y[1] > -0.5)
    ys = move(pool, Turning(), Y0S, KEY)
    free = move(dfc.learned.Pool(near_east, mean_steps=1e9), Turning(), Y0S, KEY)
    low = free[:, 1] <= -0.5
    assert 0 < float(jnp.mean(low)) < 1
    np.testing.assert_array_equal(ys, jnp.where(low[:, None], FRESH, free))


# ---- Trainings ----

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


def test_the_domain_is_that_of_the_model_that_is_returned():
    """The best one is that of epoch 20, when the pool is not yet trusted with a domain."""
    optimiser = optax.sgd(lambda step: jnp.where(step < 20, 0.02, -0.02))
    trained, log = train(optimiser=optimiser, epochs=60)
    assert log.best_epoch == 20
    assert eqx.tree_equal(trained.domain, BOX)


def test_a_flow_map_without_a_domain_gets_none():
    trained, _ = train(Turning(jnp.asarray(0.9)))
    assert trained.domain is None
    assert abs(float(trained.rate) - 1) < 0.05


def test_two_models_are_compared_on_the_same_states():
    """Without updates none is better than the first, though the states are others each time."""
    _, log = train(optimiser=optax.sgd(0.0), vector_field=lambda t, y, args: y**3)
    assert log.best_epoch == 0
    assert len(np.unique(log.criteria)) == len(log.criteria)


def test_the_same_key_gives_the_same_result():
    a, log_a = train(epochs=60)
    b, log_b = trained_clock()
    c, _ = train(epochs=60, key=jr.key(6))
    assert eqx.tree_equal(a, b)
    np.testing.assert_array_equal(log_a.losses, log_b.losses)
    assert not eqx.tree_equal(a, c)


def small_network(**options):
    # Normalised by states from all round the circle, as far as it will go.
    ring = jnp.concatenate([Y0S, -Y0S, Y0S @ QUARTER, -Y0S @ QUARTER])
    network = dfc.DeepONet(
        ring, 1.0, core=dfc.learned.Concatenated, key=jr.key(3), **(SMALL | options)
    )
    return eqx.tree_at(lambda m: m.domain, network, BOX)


def fitted(network, sample, epochs=300, field=oscillator):
    recipe = dataclasses.replace(dfc.learned.second_order(network, epochs=epochs), points=40)
    return dfc.fit(network, field, key=KEY, sample=sample, recipe=recipe)


def error_opposite(network):
    """Of a step on the other side of the circle."""
    turn = jnp.array([[jnp.cos(1.0), -jnp.sin(1.0)], [jnp.sin(1.0), jnp.cos(1.0)]])
    ends = jax.jit(jax.vmap(network, (0, None)))(-Y0S, 1.0)
    return float(jnp.max(radii(ends + Y0S @ turn)))


@pytest.mark.parametrize("manifold", [None, pytest.param(RADIUS, marks=pytest.mark.slow)])
def test_it_learns_where_it_was_never_told_to_look(manifold, tmp_path):
    """On the other side of the circle, from samples on this one: no solution is given."""
    pool = dfc.learned.Pool(near_east, manifold=manifold)
    network, log = fitted(small_network(), pool, epochs=200)
    assert error_opposite(network) < 0.02
    assert log.skipped == 0
    dfc.save(tmp_path / "pool.network", network)
    taylor = dfc.learned.Taylor(oscillator)
    domain = dfc.load(tmp_path / "pool.network", taylor=taylor).domain
    assert float(jnp.mean(jax.vmap(domain.contains)(-Y0S))) > 0.9


def test_without_a_pool_it_does_not():
    network, _ = fitted(small_network(), near_east, epochs=200)
    assert error_opposite(network) > 0.2
    assert not np.any(jax.vmap(network.domain.contains)(-Y0S))


def test_a_network_that_is_wrong_in_the_beginning_leads_nowhere():
    """Its states would be where y' = y³ explodes: none of its steps is taken."""
    pool = dfc.learned.Pool(near_east)
    wild = jax.tree.map(lambda x: 30 * x if eqx.is_inexact_array(x) else x, small_network().core)
    wild = eqx.tree_at(lambda m: m.core, small_network(), wild)
    ends = jax.jit(jax.vmap(wild, (0, None)))(Y0S, 1.0)
    assert float(jnp.median(radii(ends))) > 10
    recipe = dfc.learned.Recipe(points=COUNT, refresh=1)

    @eqx.filter_jit
    def next_states(model):
        problem = Problem(lambda t, y, args: y**3, None, pool, None, recipe)
        objective, carry = start(problem, model, KEY)
        return carry.points.y0s, fresh_points(objective, carry, jnp.asarray(1)).y0s

    before, after = next_states(wild)
    assert not np.any(np.asarray(before == after))
    assert float(jnp.max(radii(after))) <= 2


# ---- What is refused ----


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        (dict(manifold=lambda t, y, args: y), TypeError, "FirstIntegral"),
        (dict(manifold=()), ValueError, "nothing to conserve"),
        (dict(mean_steps=0.5), ValueError, "`mean_steps` is 0.5, but it must be at least 1"),
        (dict(mean_steps=float("nan")), ValueError, "`mean_steps`"),
        (dict(max_defect=0), ValueError, "`max_defect` is 0, but it must be positive"),
    ],
)
def test_a_pool_that_cannot_be(options, error, match):
    with pytest.raises(error, match=match):
        dfc.learned.Pool(**(dict(sample=near_east) | options))


@pytest.fixture
def as_users_see_it():
    """Without the run-time type checker of the suite, which would answer first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def test_a_pool_draws_from_given_states():
    drawn = jax.vmap(dfc.learned.Pool(Y0S))(jr.split(KEY, 20))
    assert bool(jnp.all(jnp.any(jnp.all(drawn[:, None] == Y0S, axis=2), axis=1)))


@pytest.mark.parametrize("refresh", [None, 40, 100])
def test_a_pool_that_would_never_grow(refresh):
    with pytest.raises(ValueError, match="that is never"):
        train(refresh=refresh)


def test_a_pool_for_something_else(as_users_see_it):
    pinn = dfc.PINN(EAST, 0.0, 1.0, key=KEY, **SMALL)
    with pytest.raises(ValueError, match="leave `sample` out"):
        dfc.fit(pinn, oscillator, key=KEY, sample=dfc.learned.Pool(near_east))
    with pytest.raises(ValueError, match="for states of 2 numbers, but was given one of 3"):
        train(small_network(), dfc.learned.Pool(LORENZ.sample))
    with pytest.raises(ValueError, match="`model` returns the structure"):
        train(Own(lambda y0, h: (y0, h)))
    many = dfc.FirstIntegral(lambda t, y, args: jnp.ones(3) * jnp.sum(y))
    with pytest.raises(ValueError, match="3 scalar constraints, but the state has only 2"):
        train(pool=dfc.learned.Pool(near_east, manifold=many))
    with pytest.raises(TypeError, match="a `Pool` needs real floating-point states"):
        train(pool=dfc.learned.Pool(lambda key: jr.randint(key, (2,), 1, 5)))
