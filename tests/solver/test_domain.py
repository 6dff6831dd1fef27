"""What becomes of a step that starts outside the domain of its flow map."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from ..learned import DRIVEN0, EAST, RADIUS, Still, Within, oscillator, states, unchecked

TERM = dfx.ODETerm(oscillator)
STATE = dfx.SaveAt(steps=True, solver_state=True)


class Rotation(eqx.Module):
    """The exact flow map of the oscillator, but for an error in proportion to the step."""

    error: float = 0.0
    max_step: float = 0.5

    def __call__(self, y0, h):
        c, s = jnp.cos(h), jnp.sin(h)
        return jnp.stack([c * y0[0] + s * y0[1], c * y0[1] - s * y0[0]]) + self.error * h


# The rotation from (1, 0) leaves it between the third and the fourth step of length 0.5.
EASTERN = dfc.learned.Box(jnp.array([0.0, -2.0]), jnp.array([2.0, 2.0]))
BARE = Rotation(jnp.array(1e-3))
KNOWS = Within(BARE, EASTERN)


def solve(solver, y0=EAST, *, t0=0.0, t1=5.0, dt0=0.5, **options):
    # Arrays: for other numbers nothing is compiled anew.
    return compiled(solver, y0, *map(jnp.asarray, (t0, t1, dt0)), **options)


@eqx.filter_jit
def compiled(solver, y0, t0, t1, dt0, max_steps=200, **options):
    return dfx.diffeqsolve(TERM, solver, t0, t1, dt0, y0, max_steps=max_steps, **options)


def message(sol):
    return dfx.RESULTS[sol.result]


# ---- The box ----


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


@given(st.integers(0, 10**6))
def test_an_extended_box_is_the_one_around_all(seed):
    rng = np.random.default_rng(seed)
    points = {"q": rng.normal(size=(7, 2)), "p": (rng.normal(size=7),)}
    first, others = (jax.tree.map(lambda x, s=s: x[s], points) for s in (np.s_[:3], np.s_[3:]))
    assert eqx.tree_equal(
        dfc.learned.Box.around(first).extended(others), dfc.learned.Box.around(points)
    )


def test_wrong_boxes_are_refused():
    with pytest.raises(ValueError, match="Both must be those of a state"):
        dfc.learned.Box(jnp.zeros(2), jnp.ones(3))
    with pytest.raises(ValueError, match="stacked along a leading axis"):
        dfc.learned.Box.around({"q": jnp.array(1.0)})
    with pytest.raises(ValueError, match="The box is for states of the structure"):
        dfc.learned.Box.around(states()).contains(DRIVEN0)
    with pytest.raises(TypeError, match="real"):
        dfc.learned.Box.around(1j * jnp.ones((3, 2)))


# ---- Ignore and report ----


@pytest.mark.parametrize("t0", [0.0, pytest.param(-3.0, marks=pytest.mark.slow)])
def test_the_report_counts_steps_and_knows_the_first_time(t0):
    sol = solve(unchecked(KNOWS, outside=dfc.learned.Report()), t0=t0, t1=t0 + 5.0, saveat=STATE)
    starts = jnp.concatenate([EAST[None], sol.ys[:9]])
    outside = ~jax.vmap(EASTERN.contains)(starts)
    found = dfc.learned.domain_statistics(sol)
    assert 0 < found.num_outside == outside.sum() < found.num_steps == 10
    np.testing.assert_allclose(found.fraction_outside, outside.sum() / 10)
    np.testing.assert_allclose(found.first_outside, t0 + 0.5 * jnp.argmax(outside))
    bare = solve(unchecked(BARE), saveat=STATE).ys
    np.testing.assert_allclose(sol.ys, bare, rtol=0, atol=1e-14)


def test_a_solve_that_stays_inside_has_no_first_time():
    found = dfc.learned.domain_statistics(
        solve(unchecked(KNOWS, outside=dfc.learned.Report()), t1=1.0, saveat=STATE)
    )
    assert found.fraction_outside == 0
    assert found.first_outside == jnp.inf


def test_the_report_is_seen_through_projection_and_in_a_batch():
    solver = dfc.ManifoldProjection(unchecked(KNOWS, outside=dfc.learned.Report()), RADIUS)

    def lane(y0):
        return solve(solver, y0, saveat=STATE)

    sols = jax.vmap(lane)(jnp.stack([EAST, -EAST, 3 * EAST]))
    found, domain = dfc.statistics(sols), dfc.learned.domain_statistics(sols)
    np.testing.assert_array_equal(found.num_projections, [10, 10, 10])
    np.testing.assert_array_equal(domain.first_outside, [2.0, 0.0, 0.0])
    assert domain.num_outside[0] < domain.num_outside[2]
    assert jnp.all(found.residual_after < 4e-15)


def limited(max_error, error=1e-3):
    network = Rotation(jnp.array(error))
    return unchecked(network, outside=dfc.learned.Report(), max_error=jnp.array(max_error))


def test_a_large_error_counts_as_outside():
    """The error of a step is 1e-3 √2 h up to higher orders."""

    def outside(max_error, h):
        return dfc.learned.domain_statistics(
            solve(limited(max_error), dt0=h, saveat=STATE)
        ).num_outside

    assert outside(6e-4, 0.5) == 0
    assert outside(3e-4, 0.5) == 10
    assert outside(3e-4, 0.25) == 0
    assert outside(1.0, 0.5) == 0
    with_nan = limited(1.0, error=jnp.nan)
    sol = solve(with_nan, saveat=STATE, throw=False)
    assert dfc.learned.domain_statistics(sol).num_outside == 1
    assert "is not finite" in message(sol)


def test_rejected_steps_do_not_count():
    solver = unchecked(KNOWS, outside=dfc.learned.Report(), corrections=1)
    controller = dfx.PIDController(rtol=1e-4, atol=1e-4)
    sol = solve(solver, stepsize_controller=controller, saveat=STATE)
    assert sol.stats["num_rejected_steps"] > 0
    assert dfc.learned.domain_statistics(sol).num_steps == sol.stats["num_accepted_steps"]


# ---- Fail ----


@pytest.mark.parametrize(
    ("y0", "t0", "time"),
    [(EAST, -20.0, -18.0), pytest.param(-EAST, 0.0, 0.0, marks=pytest.mark.slow)],
)
def test_leaving_the_domain_fails_at_a_time(y0, t0, time, errors_raise):
    solver = unchecked(KNOWS, outside=dfc.learned.Refuse())
    sol = solve(solver, y0, t0=t0, t1=t0 + 5.0, throw=False, saveat=STATE)
    assert "a step starts outside the domain" in message(sol)
    assert dfc.learned.domain_statistics(sol).first_outside == time
    with pytest.raises(eqx.EquinoxRuntimeError, match=r"outside=diffrax\.Tsit5"):
        jax.block_until_ready(solve(solver, y0, t0=t0, t1=t0 + 5.0).ys)
    assert solve(solver, t1=2.0).result == dfx.RESULTS.successful


def test_one_lane_may_fail():
    solver = unchecked(KNOWS, outside=dfc.learned.Refuse())
    sols = jax.vmap(lambda y0: solve(solver, y0, t1=1.5, throw=False))(jnp.stack([EAST, -EAST]))
    okay = sols.result == dfx.RESULTS.successful
    np.testing.assert_array_equal(okay, [True, False])


def test_too_large_an_error_fails_with_fixed_steps_and_is_rejected_with_adaptive_ones():
    solver = unchecked(BARE, outside=dfc.learned.Refuse(), max_error=3e-4)
    assert "is above `max_error`" in message(solve(solver, throw=False))
    loose = dfx.PIDController(rtol=1.0, atol=1.0)
    sol = solve(solver, stepsize_controller=loose, saveat=STATE)
    assert sol.result == dfx.RESULTS.successful
    assert sol.stats["num_rejected_steps"] > 0
    assert sol.stats["num_accepted_steps"] > 14  # each at most 0.3 long
    found = dfc.learned.domain_statistics(sol)
    assert found.num_outside == 0


# ---- Another solver ----


@pytest.mark.parametrize(
    "solver",
    [dfx.Dopri5()]
    + [
        pytest.param(solver, marks=pytest.mark.slow)
        for solver in (dfc.RK4(), dfc.ManifoldProjection(dfx.Heun(), RADIUS))
    ],
)
def test_another_solver_takes_all_steps_outside_and_none_inside(solver):
    sol = solve(unchecked(KNOWS, outside=solver), saveat=STATE)
    y, taken = EAST, 0
    for i in range(10):
        if EASTERN.contains(y):
            y = KNOWS(y, 0.5)
        else:
            y, taken = solve(solver, y, t1=0.5).ys[-1], taken + 1
        np.testing.assert_allclose(sol.ys[i], y, rtol=0, atol=1e-14)
    assert 0 < taken == dfc.learned.domain_statistics(sol).num_outside


def test_a_solver_without_an_error_estimate_is_not_believed_by_a_controller():
    solver = unchecked(KNOWS, outside=dfc.RK4())
    controller = dfx.PIDController(rtol=1e-2, atol=1e-2)
    sol = solve(solver, -EAST, stepsize_controller=controller, throw=False)
    assert sol.result == dfx.RESULTS.max_steps_reached


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_derivatives(whole):
    """Of steps of either kind; and of a solve that is partly here, partly there, and nowhere near
    the boundary."""

    def f(error, y0):
        solver = unchecked(Within(Rotation(error), EASTERN), outside=dfx.Bosh3())
        if whole:
            return solve(solver, y0, t1=2.5, max_steps=8).ys
        times = jnp.array(0.0), jnp.array(0.5)
        states = [solver.init(TERM, *times, y, None) for y in (y0, -y0)]
        return [
            solver.step(TERM, *times, y, None, state, False)[0]
            for y, state in zip((y0, -y0), states, strict=True)
        ]

    point = jnp.array(0.1), jnp.array([0.9, 0.2])
    dct.assert_gradients(f, *point, rtol=1e-6, forward=False)


# ---- What is refused ----


@pytest.mark.parametrize(
    "outside",
    [dfc.learned.Report(), dfc.learned.Refuse(), dfx.Tsit5()],
)
def test_a_policy_needs_a_domain_or_an_error(outside):
    with pytest.raises(ValueError, match=r"it has no `domain`.*Box.around.*or pass `max_error`"):
        unchecked(Still(), outside=outside)
    unchecked(Still(), outside=outside, max_error=1e-3)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (dict(max_error=1e-3), "but these are ignored"),
        (
            dict(outside=dfc.learned.Report(), max_error=0.0),
            "`max_error` is 0.0, but it must be positive",
        ),
        (dict(outside=dfx.SemiImplicitEuler()), "which needs several terms"),
        (dict(outside=dfx.Kvaerno5()), "whose root finder takes its tolerances from"),
    ],
)
def test_wrong_options(options, text):
    with pytest.raises(ValueError, match=text):
        unchecked(KNOWS, **options)


def test_what_is_no_policy():
    """As users see it: the run-time type checker of the suite would answer first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        with pytest.raises(TypeError, match="`outside` is 'report', but it must be"):
            unchecked(KNOWS, outside="report")
        with pytest.raises(TypeError, match="`sweep` is 'newton', but it must be"):
            unchecked(KNOWS, sweep="newton")
        with pytest.raises(TypeError, match="`core` is 'gated', but it must be"):
            dfc.DeepONet(states(), 0.25, core="gated", key=jax.random.key(0))
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


def test_a_domain_without_contains():
    with pytest.raises(TypeError, match="no method `contains"):
        unchecked(Within(Still(), (0.0, 1.0)), outside=dfc.learned.Report())
