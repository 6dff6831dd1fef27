"""A flow map is for states of its domain, and for its own equation."""

import dataclasses
import functools as ft

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import diffrax_conserve as dfc

from .. import problems
from ..learned import DRIVEN0, EAST, LORENZ, Rotation, Still, Within, flow_map, states, unchecked
from ..problems import oscillator, refused
from ..thinned import some_of

TERM = dfx.ODETerm(oscillator)
STATE = dfx.SaveAt(steps=True, solver_state=True)


# The rotation from (1, 0) leaves it between the third and the fourth step of length 0.5.
EASTERN = dfc.learned.Box(np.array([0.0, -2.0]), np.array([2.0, 2.0]))
BARE = Rotation(np.array(1e-3))
KNOWS = Within(BARE, EASTERN)


def solve(solver, y0=EAST, *, t1=5.0, dt0=0.5, **options):
    return problems.solve(oscillator, solver, y0, t1=t1, dt0=dt0, max_steps=200, **options)


def message(sol):
    return dfx.RESULTS[sol.result]


@given(st.integers(0, 10**6))
def test_a_box_contains_what_it_was_built_around_and_nothing_beyond(seed):
    rng = np.random.default_rng(seed)
    points = {"q": rng.normal(size=(7, 2)), "p": (rng.normal(size=7),)}
    box = dfc.learned.Box.around(points)
    inside = jax.vmap(box.contains)(jax.tree.map(jnp.asarray, points))
    assert jnp.all(inside)
    highest = jax.tree.map(lambda x: jnp.asarray(x).max(axis=0), points)
    assert box.contains(highest)
    q = highest["q"].at[seed % 2].add(1e-9)
    assert not box.contains({**highest, "q": q})
    assert not box.contains({**highest, "p": (jnp.array(jnp.nan),)})


def test_by_default_steps_outside_are_counted_and_the_first_time_is_known():
    solver, t0 = unchecked(KNOWS), -3.0
    sol = solve(solver, t0=t0, t1=t0 + 5.0, saveat=STATE)
    starts = jnp.concatenate([EAST[None], sol.ys[:9]])
    outside = ~jax.vmap(EASTERN.contains)(starts)
    found = dfc.learned.steps_outside(sol)
    assert 0 < found.number == outside.sum() < sol.stats["num_accepted_steps"] == 10
    np.testing.assert_allclose(found.first_time, t0 + 0.5 * jnp.argmax(outside))
    bare = solve(unchecked(BARE), saveat=STATE)
    np.testing.assert_allclose(sol.ys, bare.ys, rtol=0, atol=1e-14)
    with pytest.raises(ValueError, match="holds no `StepsOutside`"):
        dfc.learned.steps_outside(bare)
    assert dfc.learned.steps_outside(solve(solver, t1=1.0, saveat=STATE)).first_time == jnp.inf


def test_a_step_by_hand_keeps_its_time_and_fails_backwards():
    """From times that are numbers, which have no dtype of their own."""
    solver = unchecked(KNOWS)

    @jax.jit
    def stepped(end):
        state = solver.init(TERM, 1e6, 1e6 + 0.5, -EAST, None)
        return solver.step(TERM, 1e6, end, -EAST, None, state, False)[-2:]

    for h, word in ((0.5, ""), (-0.5, "backwards")):
        (_, counted), result = stepped(1e6 + h)
        assert (counted.number, counted.first_time) == (1, 1e6)
        assert word in dfx.RESULTS[result]
        assert bool(result == dfx.RESULTS.successful) is (h > 0)


@pytest.mark.slow
def test_rejected_steps_do_not_count():
    solver = unchecked(KNOWS, corrections=1)
    controller = dfx.PIDController(rtol=1e-4, atol=1e-4)
    sol = solve(solver, stepsize_controller=controller, saveat=STATE)
    assert sol.stats["num_rejected_steps"] > 0
    starts = jnp.concatenate([EAST[None], sol.ys[: int(sol.stats["num_accepted_steps"]) - 1]])
    outside = jnp.sum(~jax.vmap(EASTERN.contains)(starts))
    assert 0 < dfc.learned.steps_outside(sol).number == outside


def test_leaving_the_domain_fails_at_a_time(errors_raise):
    solver = unchecked(KNOWS, outside="fail")
    sol = solve(solver, t0=-20.0, t1=-15.0, throw=False, saveat=STATE)
    assert "a step starts outside the domain" in message(sol)
    assert dfc.learned.steps_outside(sol).first_time == -18.0
    with pytest.raises(eqx.EquinoxRuntimeError, match=r"outside=diffrax\.Tsit5"):
        jax.block_until_ready(solve(solver, t0=-20.0, t1=-15.0).ys)
    assert solve(solver, t1=2.0).result == dfx.RESULTS.successful


@pytest.mark.slow
def test_another_solver_takes_all_steps_outside_and_none_inside():
    solver = dfx.Dopri5()
    sol = solve(unchecked(KNOWS, outside=solver), saveat=STATE)
    y, taken = EAST, 0
    for i in range(10):
        if EASTERN.contains(y):
            y = KNOWS(y, 0.5)
        else:
            y, taken = solve(solver, y, t1=0.5).ys[-1], taken + 1
        np.testing.assert_allclose(sol.ys[i], y, rtol=0, atol=1e-14)
    assert 0 < taken == dfc.learned.steps_outside(sol).number


@pytest.mark.slow
def test_a_solver_without_an_error_estimate_is_not_believed_by_a_controller():
    solver = unchecked(KNOWS, outside=dfc.RK4())
    controller = dfx.PIDController(rtol=1e-2, atol=1e-2)
    sol = solve(solver, -EAST, stepsize_controller=controller, throw=False)
    assert sol.result == dfx.RESULTS.max_steps_reached


Box = dfc.learned.Box
NO_DOMAIN = "it has no `domain`.*Box.around"


test_mistakes_are_named = refused(
    (lambda: Box(jnp.zeros(2), jnp.ones(3)), ValueError, "but `upper` has"),
    (lambda: Box.around({"q": jnp.array(1.0)}), ValueError, "stacked along a leading axis"),
    (lambda: Box.around(states()).contains(DRIVEN0), ValueError, "for states of the structure"),
    (lambda: Box.around(1j * jnp.ones((3, 2))), TypeError, "real"),
    (lambda: unchecked(Still(), outside="fail"), ValueError, NO_DOMAIN),
    (lambda: unchecked(Still(), outside=dfx.Tsit5()), ValueError, NO_DOMAIN),
    (lambda: unchecked(KNOWS, outside=dfx.SemiImplicitEuler()), ValueError, "several terms"),
    (lambda: unchecked(KNOWS, outside=dfx.Kvaerno5()), ValueError, "takes its tolerances from"),
    (lambda: unchecked(KNOWS, outside="refuse"), TypeError, "`outside` is 'refuse', but"),
    (lambda: unchecked(KNOWS, outside=None), TypeError, "must be 'count', 'fail', or a solver"),
    (lambda: unchecked(Within(Still(), 1.0)), TypeError, "no method `contains"),
)


# ---- A flow map is refused for an equation that it was not trained for ----


@ft.cache
def taylor(**options):
    network = flow_map(core="concatenated", taylor=dfc.learned.Taylor(LORENZ.vector_field))
    return dfc.DeepONetSolver(network, **options)


MESSAGE = "not trained for this vector field"


@eqx.filter_jit
def end(solver, system, y0):
    term = dfx.ODETerm(system.vector_field)
    return dfx.diffeqsolve(term, solver, 0.0, 0.5, 0.25, y0).ys[-1]


OTHER = dfc.systems.ConservativeLorenz(sigma=1.01)


def test_one_lane_of_a_batch_is_refused_alone():
    @eqx.filter_jit
    def result(y0, sigma):
        system = dataclasses.replace(LORENZ, sigma=sigma)
        term = dfx.ODETerm(system.vector_field)
        return dfx.diffeqsolve(term, taylor(), 0.0, 0.5, 0.25, y0, throw=False).result

    taylor()  # made outside of what is compiled
    found = jax.vmap(result)(states(4), jnp.array([1.0, 1.0, 1.5, 1.0]))
    okay = found == dfx.RESULTS.successful
    np.testing.assert_array_equal(okay, [True, True, False, True])
    assert MESSAGE in dfx.RESULTS[jax.tree.map(lambda x: x[2], found)]


@pytest.mark.slow
def test_it_is_not_differentiated():
    off = taylor(check_field=False)
    slope = jax.vmap(jax.grad(lambda solver, y0: jnp.sum(end(solver, LORENZ, y0)), 1), (None, 0))
    on, without = (eqx.filter_jit(slope)(solver, states(3)) for solver in (taylor(), off))
    np.testing.assert_allclose(on, without, rtol=1e-12)


def test_a_state_at_rest_is_not_refused():
    rest = jnp.zeros(3)
    np.testing.assert_array_equal(LORENZ.vector_field(0.0, rest, None), rest)
    end(taylor(), OTHER, rest)


def refused(name, system, y0s):
    """How many of the states are refused."""
    solver, term = dfc.DeepONetSolver(dfc.load_pretrained(name)), dfx.ODETerm(system.vector_field)
    init = lambda y0: solver.init(term, 0.0, 0.1, y0, None).refused  # noqa: E731
    return int(jnp.sum(eqx.filter_jit(jax.vmap(init))(y0s) > 0))


NAMES = [
    *(name + kind for name in dfc.systems.names()[2:5] for kind in ("", "-standard")),
    *("kepler", "pollu", "robertson"),
]


@some_of("name", NAMES, ids=NAMES, period=9)
def test_a_shipped_flow_map_is_for_its_own_system(name):
    """At every state of its domain, also those whose slope is learned."""
    system = dfc.systems.get(name.removesuffix("-standard"))
    assert refused(name, system, states(1000, system, seed=5)) == 0


@pytest.mark.slow
def test_a_stiff_field_is_not_compared_where_it_changes_within_a_step():
    """States within a factor of three of those of POLLU six minutes after the emission."""
    pollu = dfc.systems.get("pollu")
    y0 = pollu.reference(jnp.array([6.0]))[0]
    factors = 3.0 ** np.random.default_rng(0).uniform(-1, 1, (1000, 20))
    factors[0] = 1
    assert refused("pollu", pollu, y0 * factors) == 0


@pytest.mark.slow
def test_a_learned_slope_is_refused_where_it_is_nothing_like_the_field(errors_raise):
    solver = dfc.DeepONetSolver(dfc.load_pretrained("double-pendulum-standard"))
    end(solver, dfc.systems.DoublePendulum(), dfc.systems.DoublePendulum().y0)
    with pytest.raises(RuntimeError, match="not trained for this vector field"):
        end(solver, dfc.systems.DoublePendulum(gravity=1.0), dfc.systems.DoublePendulum().y0)
