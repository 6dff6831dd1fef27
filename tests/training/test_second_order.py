"""Second-order training, windows, and states along solutions."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve.learned._training.data import as_sampler
from diffrax_conserve.learned._training.recipe import mean
from diffrax_conserve.learned._training.second_order import LeastSquares
from diffrax_conserve.learned.paper import _bounded

from ..learned import EAST, LORENZ, RADIUS, oscillator

KEY = jr.key(5)
NOTHING = jnp.zeros(5, bool)


def turns(t1, seed=0, **options):
    """A PINN for the rotation, of the shape that Levenberg-Marquardt is made for."""
    sizes = dict(width=30, depth=1, slope=2.0)
    return dfc.PINN(EAST, 0.0, t1, key=jr.key(seed), **(sizes | options))


def error(pinn):
    ts = jnp.linspace(0, pinn.t1, 50)
    exact = jnp.stack([jnp.cos(ts), -jnp.sin(ts)], axis=1)
    return float(jnp.max(jnp.abs(jax.jit(jax.vmap(pinn))(ts) - exact)))


# ---- One update, against what it is defined to be ----


def linear_problem(seed=0, points=7, n=2, weights=5, loss=mean):
    matrix, b = (
        jr.normal(key, shape)
        for key, shape in zip(
            jr.split(jr.key(seed)), [(points, n, weights), (points, n)], strict=True
        )
    )
    problem = LeastSquares(
        defects=lambda w: matrix @ w - b,
        jacobian=lambda w: matrix,
        loss=loss,
        typical=jnp.asarray(1.0),
    )
    return problem, matrix.reshape(-1, weights) / points**0.5, b.reshape(-1) / points**0.5


def test_levenberg_marquardt_solves_the_damped_problem():
    problem, matrix, b = linear_problem()
    linear = jnp.array([False, True, False, True, False])
    method, weights = dfc.learned.LevenbergMarquardt(), jnp.arange(5.0)
    damping = jnp.asarray(0.3)
    after, _, loss = method.update(problem, weights, damping, jnp.asarray(0.0), linear)
    r = matrix @ weights - b
    np.testing.assert_allclose(loss, r @ r, rtol=1e-14)
    diagonal = np.where(linear, 0.3e-12, 0.3)
    expected = np.linalg.solve(matrix.T @ matrix + np.diag(diagonal), -matrix.T @ r)
    np.testing.assert_allclose(after - weights, expected, rtol=1e-8)


def test_levenberg_marquardt_refuses_an_update_that_is_worse():
    problem, _, _ = linear_problem()
    # The Jacobian has the wrong sign: every step goes uphill.
    wrong = problem._replace(jacobian=lambda w: -problem.jacobian(w))
    weights, method = jnp.arange(5.0), dfc.learned.LevenbergMarquardt()
    damping = method.init(weights)
    after, raised, _ = method.update(wrong, weights, damping, jnp.asarray(0.0), NOTHING)
    np.testing.assert_array_equal(after, weights)
    assert raised > damping


def test_spring_solves_the_damped_problem_around_its_last_update():
    problem, matrix, b = linear_problem(points=2)
    method, weights, last = (
        dfc.learned.SPRING(momentum=0.5, damping=0.1),
        jnp.arange(5.0),
        jnp.ones(5),
    )
    state = method.init(weights)._replace(update=last)
    after, state, loss = method.update(problem, weights, state, jnp.asarray(0.0), NOTHING)
    r, damping = matrix @ weights - b, 0.1 * loss
    expected = np.linalg.solve(
        matrix.T @ matrix + damping * np.eye(5), -matrix.T @ r + damping * 0.5 * last
    )
    np.testing.assert_allclose(after - weights, expected, rtol=1e-10)
    np.testing.assert_allclose(state.update, expected, rtol=1e-10)


def test_spring_ends_with_steps_of_length_zero():
    problem, _, _ = linear_problem()
    method, weights = dfc.learned.SPRING(), jnp.arange(5.0)
    after, _, _ = method.update(problem, weights, method.init(weights), jnp.asarray(1.0), NOTHING)
    np.testing.assert_array_equal(after, weights)


def test_the_gradient_is_that_of_any_loss():
    problem, _, _ = linear_problem(loss=_bounded)
    weights = jnp.arange(5.0)
    r, jacobian, loss = problem.rows(weights)
    gradient = jax.grad(lambda w: problem.value(problem.defects(w)))(weights)
    np.testing.assert_allclose(2 * jacobian.T @ r, gradient, rtol=1e-12)
    np.testing.assert_allclose(loss, problem.value(problem.defects(weights)), rtol=1e-15)


# ---- Trainings ----


def test_a_window_is_learned_to_ten_digits():
    pinn, log = dfc.fit(turns(3.0), oscillator, key=KEY)
    assert error(pinn) < 1e-8
    assert log.best < 1e-15
    assert log.skipped == 0


@pytest.mark.slow
def test_windows_follow_each_other():
    pinn = turns(9.0, windows=3)
    recipe = dfc.learned.second_order(pinn, epochs=15)
    seen = []
    trained, log = dfc.fit(
        pinn, oscillator, key=KEY, recipe=recipe, manifold=RADIUS,
        progress=lambda *numbers: seen.append(numbers),
    )  # fmt: skip
    assert error(trained) < 1e-7
    assert (len(log.losses), log.checked[-1]) == (45, 45)
    assert seen[-1][:2] == (45, 45)
    # The path is continuous but for the move of each joint onto the manifold.
    np.testing.assert_allclose(jnp.sum(trained.y0s**2, axis=1), 1, rtol=4e-16)
    before = jax.vmap(lambda k: trained.window(k)(3.0 * (k + 1)))(jnp.arange(2))
    np.testing.assert_allclose(before, trained.y0s[1:], atol=1e-8)
    np.testing.assert_array_equal(trained.y0, EAST)


def flow_map(core=dfc.learned.Concatenated, order=1):
    states = jax.vmap(LORENZ.sample)(jr.split(jr.key(7), 200))
    taylor = dfc.learned.Taylor(LORENZ.vector_field, order)
    return states, dfc.DeepONet(states, 0.25, width=12, depth=1, core=core, taylor=taylor, key=KEY)


def test_spring_trains_a_flow_map():
    states, network = flow_map()
    recipe = dfc.learned.second_order(network, epochs=60)
    recipe = dataclasses.replace(recipe, points=60)
    options = dict(key=KEY, sample=states, recipe=recipe)
    trained, log = dfc.fit(network, LORENZ.vector_field, **options)
    assert log.best < 1e-4 * log.criteria[0]
    again, _ = dfc.fit(network, LORENZ.vector_field, **options)
    assert eqx.tree_equal(trained, again)


def test_updates_that_are_never_finite_are_an_error():
    states, network = flow_map()
    recipe = dataclasses.replace(dfc.learned.second_order(network, epochs=4), points=10)

    def field(t, y, args):
        # Finite at the initial states, and nowhere near some of them.
        lost = (jnp.abs(y[0]) > 50) & (y[0] != 99)
        return jnp.where(lost, jnp.nan, LORENZ.vector_field(t, y, args))

    sample = states.at[::4].set(99.0)
    with pytest.raises(FloatingPointError, match="None of the 4 updates was finite"):
        dfc.fit(network, field, key=KEY, sample=sample, recipe=recipe)


# ---- Recipes ----


def test_the_recipe_goes_by_size():
    small = dfc.learned.second_order(turns(3.0, windows=5))
    assert isinstance(small.optimiser, dfc.learned.LevenbergMarquardt)
    large = dfc.learned.second_order(turns(3.0, width=40, depth=4))
    assert isinstance(large.optimiser, dfc.learned.SPRING)
    assert large.refresh == 1
    assert isinstance(dfc.learned.second_order(flow_map()[1]).optimiser, dfc.learned.SPRING)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: dfc.learned.SPRING(momentum=1.0), "momentum"),
        (lambda: dfc.learned.SPRING(damping=0.0), "damping"),
        (lambda: dfc.learned.LevenbergMarquardt(damping=-1.0), "damping"),
    ],
)
def test_a_wrong_setting_is_named(make, name):
    with pytest.raises(ValueError, match=f"`{name}` .*must be"):
        make()


def test_a_manifold_of_a_flow_map_is_refused():
    states, network = flow_map()
    with pytest.raises(ValueError, match="ManifoldProjection"):
        dfc.fit(network, oscillator, key=KEY, sample=states, manifold=RADIUS)


# ---- States along solutions ----


def test_reachable_states_are_on_the_solutions():
    angles = jr.uniform(jr.key(1), (30,)) * 6
    y0s = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1) * 2
    states = dfc.learned.reachable_states(oscillator, y0s, 10.0, key=KEY)
    assert states.shape == (30, 2)
    np.testing.assert_allclose(jnp.sum(states**2, axis=1), 4, rtol=1e-4)
    assert float(jnp.max(jnp.abs(states - y0s))) > 1
    kept = dfc.learned.reachable_states(oscillator, y0s, 10.0, key=KEY, keep=lambda y: y[0] > 0)
    np.testing.assert_array_equal(kept, states[states[:, 0] > 0])


@pytest.mark.slow
def test_states_that_explode_are_left_out():
    """y' = y² from 1 has no solution beyond t = 1, from -1 it has."""
    y0s = jnp.where(jnp.arange(10) < 5, 1.0, -1.0)
    states = dfc.learned.reachable_states(lambda t, y, args: y**2, y0s, 1e3, key=KEY)
    assert 5 <= states.size < 10
    assert bool(jnp.all(states[-5:] < 0))
    with pytest.raises(ValueError, match="No state is left"):
        dfc.learned.reachable_states(
            lambda t, y, args: y, y0s, 1.0, key=KEY, keep=lambda y: y > 1e9
        )


def test_a_sampler_draws_every_state():
    states = {"a": jnp.arange(5.0), "b": jnp.arange(10.0).reshape(5, 2)}
    drawn = jax.vmap(as_sampler(states))(jr.split(KEY, 200))
    assert set(drawn["a"].tolist()) == {0.0, 1.0, 2.0, 3.0, 4.0}
    np.testing.assert_array_equal(drawn["b"][:, 0], 2 * drawn["a"])
