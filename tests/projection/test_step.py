"""What a projection sees of the step: relaxation, a line along the error estimate, and projections
of a user; and projection part by part."""

from typing import ClassVar

import diffrax as dfx
import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from ..problems import EXPONENTIAL, EXPONENTIAL0, exponential, exponential_solution, refused
from ..thinned import some_of

ENERGY, TERM = EXPONENTIAL, dfx.ODETerm(exponential)
STEP, ALONG_ERROR = (dfc.AlongLine(direction=direction) for direction in ("step", "error"))
RELAXED = dfc.ManifoldProjection(dfx.Heun(), ENERGY, projection=STEP)


@eqx.filter_jit
def solve(solver, y0=EXPONENTIAL0, t1=2.0, dt0=0.1, **options):
    return dfx.diffeqsolve(TERM, solver, 0.0, t1, dt0, y0, **options)


def test_relaxation_keeps_the_energy_at_every_saved_time():
    ys = solve(RELAXED, saveat=dfx.SaveAt(ts=jnp.linspace(0, 2, 57))).ys
    kept = np.sum(np.exp(ys), axis=1)
    np.testing.assert_allclose(kept, np.sum(np.exp(EXPONENTIAL0)), rtol=4e-15)


@some_of("inner, order", [(dfx.Heun(), 2), (dfc.RK4(), 4)], ids=["2", "4"], period=2)
def test_the_order_of_relaxation_is_one_less_unless_the_state_carries_the_time(inner, order):
    kept = dfc.FirstIntegral(lambda t, y, args: ENERGY.fn(t, y["y"], args))
    field = lambda t, y, args: {"y": exponential(t, y["y"], args), "time": jnp.ones(())}  # noqa: E731
    solver = dfc.ManifoldProjection(inner, kept, projection=STEP)
    y0 = {"y": EXPONENTIAL0, "time": jnp.zeros(())}

    @jax.jit
    def errors(h):
        ys = dfx.diffeqsolve(dfx.ODETerm(field), solver, 0.0, 2.0, h, y0).ys
        y, time = ys["y"][-1], ys["time"][-1]
        exact = exponential_solution(2.0), exponential_solution(time)
        return jnp.stack([jnp.max(jnp.abs(y - other)) for other in exact])

    coarse, fine = errors(0.05), errors(0.025)
    np.testing.assert_allclose(np.log2(coarse / fine), [order - 1, order], rtol=0, atol=0.15)


@pytest.mark.parametrize("direction", ["error", "step"])
def test_derivatives_by_a_component_that_rests_agree_with_differences(direction):
    """Its component of the line is zero, but has a derivative. Whatever its unit is."""
    square = dfc.FirstIntegral(lambda t, y, unit: jnp.sum((y / unit) ** 2))
    solver = dfc.ManifoldProjection(
        dfx.Bosh3(), square, projection=dfc.AlongLine(direction=direction)
    )

    def field(t, y, unit):
        x = y / unit
        rate = 1 + 0.3 * x[0] ** 2 + x[2]
        return unit * rate * jnp.array([x[1], -x[0], x[3], -x[2]])

    def end(start, unit):
        unit = jnp.array([1.0, 1.0, unit, 1.0])
        y0 = unit * jnp.array([1.0, 0.0, 0.0, 0.0]).at[2].set(start)
        options = dict(args=unit, max_steps=1, adjoint=dfx.ForwardMode())
        return (
            dfx.diffeqsolve(dfx.ODETerm(field), solver, 0.0, 0.4, 0.4, y0, **options).ys[-1] / unit
        )

    @jax.jit
    def with_derivative(start, unit):
        return jax.jvp(lambda start: end(start, unit), (start,), (jnp.ones(()),))

    (plus, _), (minus, _) = (with_derivative(h, 1.0) for h in (1e-5, -1e-5))
    for unit in (1.0, 1e-20, 1e20):
        _, derivative = with_derivative(0.0, unit)
        np.testing.assert_allclose(derivative, (plus - minus) / 2e-5, rtol=0, atol=1e-9)


@some_of(
    "inner, friction",
    [(dfx.Euler(), 0.0), (dfx.Heun(), 0.3)],
    ids=["tangent", "not conserved"],
    period=2,
)
def test_relaxation_never_returns_to_the_start_of_a_step(inner, friction):
    """There all is conserved, but time stands still."""
    square = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
    solver = dfc.ManifoldProjection(inner, square, projection=STEP)
    term = dfx.ODETerm(lambda t, y, args: jnp.stack([y[1], -y[0] - friction * y[1]]))
    y0 = jnp.array([0.3, 0.7])
    sol = dfx.diffeqsolve(term, solver, 0.0, 2.0, 0.1, y0, throw=False)
    assert "was not reached" in dfx.RESULTS[sol.result]


def test_it_lies_on_the_line_along_the_embedded_difference():
    """One step against Bosh3 by hand."""
    inner, along = dfx.Bosh3(), dfc.ManifoldProjection(dfx.Bosh3(), ENERGY, projection=ALONG_ERROR)

    @jax.jit
    def found(y0):
        given = TERM, 0.0, 0.2, y0, None
        plain, error, *_ = inner.step(*given, inner.init(*given), False)
        return solve(along, y0, t1=0.2, dt0=0.2).ys[-1] - plain, error

    moved, w = map(np.asarray, found(EXPONENTIAL0))
    np.testing.assert_allclose(moved, w * (moved @ w) / (w @ w), rtol=0, atol=1e-15)
    assert np.linalg.norm(moved) > 1e-6


def test_a_tangent_direction_is_a_failure():
    """On a circle whose field is constant speed, the error estimate is made tangent by hand."""

    class Tangent(dfx.Euler):
        def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
            y1, _, *rest = super().step(terms, t0, t1, y0, args, solver_state, made_jump)
            return y1, 1e-3 * jnp.array([-y1[1], y1[0]]), *rest

    circle = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
    solver = dfc.ManifoldProjection(Tangent(), circle, projection=ALONG_ERROR)
    field = dfx.ODETerm(lambda t, y, args: jnp.array([-y[1], y[0]]))
    sol = dfx.diffeqsolve(field, solver, 0, 1, 0.1, jnp.array([1.0, 0.0]), throw=False)
    assert sol.result != dfx.RESULTS.successful


def alone(projection):
    return lambda: dfc.project(ENERGY, EXPONENTIAL0, value=0.0, projection=projection)


def solved(inner, manifold=ENERGY, projection=ALONG_ERROR):
    return lambda: solve(dfc.ManifoldProjection(inner, manifold, projection=projection))


test_what_cannot_be_is_refused_before_compilation = refused(
    (alone(STEP), ValueError, "no step outside a solve"),
    (alone(ALONG_ERROR), ValueError, r"outside a solve. Pass `projection=Newton\(\)`"),
    (solved(dfx.Heun(), (ENERGY, ENERGY), STEP), ValueError, "one unknown, but `manifold` has 2"),
    (solved(dfx.HalfSolver(dfc.RK4())), ValueError, "without its sign"),
    (solved(dfc.RK4()), ValueError, "embedded method"),
)


class Seen(dfc.AbstractProjection):
    """Moves nothing, and checks what it sees against what the solver knows."""

    metric: None = None
    atol: float = 1.0

    def solve(self, problem, candidate):
        step = problem.step
        inside = jnp.abs(problem.t - step.t0) <= jnp.abs(step.t1 - step.t0)
        start = (problem.t != step.t0) | (jnp.max(jnp.abs(step.y0 - candidate)) < 1e-14)
        right = inside & start & (step.t1 != step.t0)
        y = jnp.where(right, candidate, jnp.nan)
        return y, problem.report(candidate, y)


def test_a_projection_sees_the_step_of_every_candidate():
    t1 = -1.0
    solver = dfc.ManifoldProjection(dfx.Bosh3(), ENERGY, projection=Seen())
    saveat = dfx.SaveAt(ts=jnp.linspace(0, t1, 23), dense=True)
    times = {"t1": t1, "dt0": -0.1, "saveat": saveat}
    states = jax.jit(lambda: (sol := solve(solver, **times), sol.evaluate(0.33 * t1)))
    sol, between = states()
    assert sol.result == dfx.RESULTS.successful
    assert jnp.all(jnp.isfinite(sol.ys))
    assert jnp.all(jnp.isfinite(between))


class Unseeing(Seen):
    sees_step: ClassVar[bool] = False
    follows_gradients: ClassVar[bool] = True  # with `max_steps` of the base class

    def solve(self, problem, candidate):
        assert problem.step is None
        return candidate, problem.report(candidate, candidate)


def test_what_asks_for_no_step_gets_none_and_saves_none_and_its_result_is_checked():
    for atol, right in ((1.0, True), (0.0, False)):
        projection = Unseeing(atol=jnp.asarray(atol))
        solver = dfc.ManifoldProjection(dfx.Bosh3(), ENERGY, projection=projection)
        sol = solve(solver, saveat=dfx.SaveAt(dense=True), throw=False)
        assert sol.interpolation.infos["error"] is None
        assert (sol.result == dfx.RESULTS.successful) == right


# ---- Part by part ----

MANIFOLD = {
    "tangent": dfc.Constraint(lambda t, y, args: jnp.sum(y[0] * y[1])),
    "circle": dfc.Constraint(lambda t, y, args: jnp.sum(y[0] ** 2) - 1),
}
FIRST, SECOND = (
    dfc.SimplifiedNewton(metric=(1.0, jnp.inf), atol=1e-15),
    dfc.SimplifiedNewton(metric=(jnp.inf, 1.0), atol=1e-15),
)
STAGED = dfc.Staged(("circle", FIRST), ("tangent", SECOND))
Y0 = jnp.array([1.0, 0.0]), jnp.zeros(2)


@eqx.filter_jit
def projected(y):
    return dfc.project(MANIFOLD, y, projection=STAGED)


vector = st.tuples(st.floats(-1, 1), st.floats(-1, 1)).map(np.array)


@settings(max_examples=20)
@given(st.floats(0, 6.3), vector, vector, vector)
def test_it_is_the_two_projections_by_hand(angle, velocity, dq, dv):
    """Radially to the circle, then the velocity along it: CVODE's `proj`."""
    q = np.array([np.cos(angle), np.sin(angle)]) + 1e-2 * dq
    v, unit = velocity + 1e-2 * dv, q / np.linalg.norm(q)
    (found_q, found_v), info = projected((q, v))
    assert info.ok
    np.testing.assert_allclose(found_q, unit, rtol=0, atol=4e-15)
    np.testing.assert_allclose(found_v, v - unit * (unit @ v), rtol=0, atol=4e-15)


def test_what_an_earlier_stage_reached_is_held():
    """Even where a later one may move everything."""
    radius = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
    total = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**3))
    y = jnp.array([1.0, 0.5, -0.2])
    staged = dfc.Staged((0, dfc.SimplifiedNewton()), (1, dfc.SimplifiedNewton()))
    found, info = dfc.project((radius, total), 1.01 * y, value=(1.29, 1.117), projection=staged)
    assert info.ok
    np.testing.assert_allclose([found @ found, jnp.sum(found**3)], [1.29, 1.117], rtol=4e-15)


@pytest.mark.slow
def test_derivatives_in_both_modes_agree_with_finite_differences():
    y = jnp.array([0.9, 0.5]), jnp.array([-0.4, 0.8])
    dct.assert_gradients(lambda *y: projected(y)[0], *y, rtol=1e-6)


def test_a_stage_that_cannot_hold_is_a_failure():
    """Positions on the circle cannot be reached by moving velocities."""
    wrong = dfc.Staged(("circle", SECOND), ("tangent", SECOND))
    _, info = dfc.project(MANIFOLD, (jnp.array([1.1, 0.0]), jnp.ones(2)), projection=wrong)
    assert not info.ok


def of(*stages):
    return lambda: dfc.project(MANIFOLD, Y0, projection=dfc.Staged(*stages))


test_mistakes_with_stages_are_named = refused(
    (of(("circle", FIRST)), ValueError, "Give each entry one stage"),
    (of(("circle", FIRST), ("circle", SECOND)), ValueError, "Give each entry one stage"),
    (of(("no", FIRST)), ValueError, "Give each entry one stage"),
    (of(FIRST), TypeError, "must be a pair"),
    (of(("circle", ALONG_ERROR)), TypeError, "a projection with `sees_step = False`"),
)
