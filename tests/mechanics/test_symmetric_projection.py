"""Symmetric projection and the implicit midpoint rule: steps back undo steps."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.integrate import solve_ivp

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from .. import problems
from ..problems import (
    EXPONENTIAL,
    EXPONENTIAL0,
    INERTIA,
    KEPLER,
    KEPLER0,
    RIGID_BODY,
    TO_THE_END,
    assert_lanes,
    difference,
    exponential,
    final,
    kepler,
    largest,
    rigid_body,
)

# Of the eccentricity 0.6.
Y0, E0, H = KEPLER0, EXPONENTIAL0, 2 * np.pi / 200
SYMMETRIC = dfc.SymmetricProjection(dfc.ImplicitMidpoint(), KEPLER)
BODY = dfc.SymmetricProjection(dfc.ImplicitMidpoint(), RIGID_BODY)
EXP = dfc.SymmetricProjection(dfc.ImplicitMidpoint(), EXPONENTIAL)
W0 = jnp.array([1.0, 0.7, -0.4])


def solve(field, solver, y0, t0, t1, dt0, args=None):
    options = dict(saveat=dfx.SaveAt(t1=True, solver_state=True), args=args) | TO_THE_END
    return problems.solve(field, solver, y0, t0=t0, t1=t1, dt0=dt0, **options)


def drift(y, y0):
    """The largest, in units of roundoff of the terms of the energy at the perihelion, about 7."""
    off = [entry.fn(0.0, y, None) - entry.fn(0.0, y0, None) for entry in KEPLER.values()]
    return largest(jnp.stack(off)) / 7 / 2.2e-16


@pytest.mark.parametrize("periods", [20, pytest.param(1000, marks=pytest.mark.slow)])
def test_there_and_back_on_the_manifold(periods):
    there = solve(kepler, SYMMETRIC, Y0, 0.0, periods * 200 * H, H)
    back = solve(kepler, SYMMETRIC, final(there), periods * 200 * H, 0.0, -H)
    assert dfx.is_okay(there.result)
    assert dfx.is_okay(back.result)
    assert drift(final(there), Y0) <= 4
    assert drift(final(back), Y0) <= 4
    assert difference(final(back), Y0) < 1e-10
    assert dfc.statistics(there).num_iterations < 4 * periods * 200


def test_one_step_solves_the_equations():
    """The step in the book, solved by another method for state and multiplier together. The
    integral is not quadratic, because the midpoint rule keeps those by itself."""
    y0 = E0

    def residual(unknowns, _):
        y1, mu = unknowns[:2], unknowns[2]
        fn = lambda y: EXPONENTIAL.fn(0.0, y, None)  # noqa: E731
        start, end = y0 + mu * jax.grad(fn)(y0), y1 - mu * jax.grad(fn)(y1)
        inner = end - start - 0.1 * exponential(0.0, (start + end) / 2, None)
        return jnp.append(inner, fn(y1) - fn(y0))

    guess = jnp.append(y0, 0.0)
    exact = optx.root_find(residual, optx.Newton(1e-14, 1e-14), guess, max_steps=100).value
    assert abs(exact[2]) > 1e-5
    assert difference(final(solve(exponential, EXP, y0, 0.0, 0.1, 0.1)), exact[:2]) < 1e-15


def body(t, w, args):
    """A rigid body in a unit, which breaks at some time."""
    unit, end = args
    return jnp.where(t > end, jnp.nan, unit) * rigid_body(t, w / unit, None)


def turned(solver, y0, *times, unit=1.0, end=jnp.inf):
    """By one program for each solver."""
    return solve(body, solver, y0, *times, args=jnp.array([unit, end]))


def test_second_order_against_another_solver():
    torque = lambda t, w: np.cross(INERTIA * w, w) / INERTIA  # noqa: E731
    exact = solve_ivp(torque, (0.0, 2.0), W0, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    for solver in (dfc.ImplicitMidpoint(), BODY):
        ends = [final(turned(solver, W0, 0.0, 2.0, h)) for h in (0.05, 0.025)]
        coarse, fine = (difference(y, exact) for y in ends)
        assert 3.7 < coarse / fine < 4.3


def test_saved_times_lie_on_the_manifold_and_dense_output_ends_at_the_states():
    """Backwards in time."""

    @jax.jit
    def found(y0):
        subs = dfx.SubSaveAt(ts=jnp.linspace(1.0, 0.0, 38)), dfx.SubSaveAt(steps=True)
        options = dict(saveat=dfx.SaveAt(subs=subs, dense=True), max_steps=16)
        options |= dict(adjoint=dfx.ForwardMode())
        sol = dfx.diffeqsolve(dfx.ODETerm(exponential), EXP, 1.0, 0.0, -0.1, y0, **options)
        (_, ts), (saved, ys) = sol.ts, sol.ys
        times = jnp.concatenate([jnp.array([0.55 - 1e-4, 0.55 + 1e-4, 1.0]), ts[:10]])
        return saved, ys[:10], jax.vmap(sol.evaluate)(times)

    saved, ys, (before, after, start, *at_steps) = map(np.asarray, found(E0))
    values = np.sum(np.exp(saved), axis=1)
    assert largest(values / np.sum(np.exp(E0)) - 1) < 4e-15
    assert difference(np.stack([start, *at_steps]), np.stack([E0, *ys])) < 1e-14
    (u, v), slope = (before + after) / 2, (after - before) / 2e-4
    assert difference(slope, np.stack([-np.exp(v), np.exp(u)])) < 0.05


@pytest.mark.slow
def test_derivatives_in_both_modes_against_finite_differences():
    def end(y0, scale):
        field = dfx.ODETerm(lambda t, y, args: args * exponential(t, y, None))
        options = dict(max_steps=8, adjoint=dfx.DirectAdjoint())
        return dfx.diffeqsolve(field, EXP, 0.0, 0.5, 0.1, y0, scale, **options).ys[-1]

    dct.assert_gradients(end, E0, jnp.ones(()), rtol=1e-7)


def test_derivatives_in_any_metric():
    """A number as a metric changes none, and in another metric they are those of differences."""

    @jax.jit
    def run(metric, scale):
        """The end of a solve, and its derivative by the scale of the field."""

        def end(scale):
            solver = dfc.SymmetricProjection(dfc.ImplicitMidpoint(), EXPONENTIAL, metric=metric)
            field = dfx.ODETerm(lambda t, y, args: args * exponential(t, y, None))
            y0, adjoint = E0, dfx.ForwardMode()
            return dfx.diffeqsolve(field, solver, 0.0, 0.5, 0.1, y0, scale, adjoint=adjoint).ys[-1]

        return jax.jvp(end, (scale,), (1.0,))

    one, e = jnp.ones(2), 1e-5
    for number in (1e-14, 1e14):
        assert difference(run(number * one, 1.0)[1], run(one, 1.0)[1]) < 1e-11
    metric = jnp.array([1.0, 4.0])
    numeric = (run(metric, 1 + e)[0] - run(metric, 1 - e)[0]) / (2 * e)
    assert difference(run(metric, 1.0)[1], numeric) < 1e-8


@pytest.mark.slow
def test_a_lane_is_that_lane_alone_and_float32_works():
    def run(y0):
        return solve(rigid_body, BODY, y0, 0.0, 1.0, 0.1).ys[-1]

    assert_lanes(run, jnp.stack([W0, 2 * W0, W0[::-1]]), 1e-14)
    sol = solve(rigid_body, BODY, W0.astype(jnp.float32), 0.0, 1.0, 0.1)
    assert dfx.is_okay(sol.result)
    assert sol.ys.dtype == jnp.float32
    assert difference(sol.ys[-1], run(W0)) < 1e-5


@pytest.mark.slow
def test_time_dependent_constraint_and_a_repeated_one_backwards_in_time():
    """`|y| = 1 + t / 2` along `y' = y / (2 + t)`, turned."""

    def field(t, y, args):
        return y / (2 + t) + jnp.array([-y[1], y[0]])

    radius = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - (1 + t / 2) ** 2)
    y0 = jnp.array([0.6, 0.8])
    once, twice = (
        dfc.SymmetricProjection(dfc.ImplicitMidpoint(), m) for m in (radius, [radius] * 2)
    )
    there = solve(field, once, y0, 0.0, 2.0, 0.1)
    assert largest(radius.fn(2.0, final(there), None)) < 8e-15
    assert difference(final(solve(field, twice, y0, 0.0, 2.0, 0.1)), final(there)) < 1e-13
    assert difference(final(solve(field, once, final(there), 2.0, 0.0, -0.1)), y0) < 1e-13


def test_failures_are_results():
    def impossible(t, y, at_once):
        """From the start, or because it changes along every solution."""
        later = jnp.exp(-(y[0] ** 2) - 5 * t) - jnp.exp(-(W0[0] ** 2))
        return jnp.where(at_once, jnp.sum(y**2) - 1, later)

    wrong = dfc.SymmetricProjection(dfc.ImplicitMidpoint(), dfc.Constraint(impossible))
    for sol, message in (
        (solve(rigid_body, wrong, W0, 0.0, 1.0, 0.1, args=jnp.array(True)), "cannot start"),
        (solve(rigid_body, wrong, W0, 0.0, 1.0, 0.1, args=jnp.array(False)), "not reached"),
        (turned(BODY, W0, 0.0, 1.0, 0.1, end=0.5), ""),
    ):
        assert not dfx.is_okay(sol.result), message
        assert message in dfx.RESULTS[sol.result]
        assert not np.isfinite(final(sol)).any()


class Trapezoidal(dfx.AbstractESDIRK):
    tableau = dfx.ButcherTableau(
        c=np.array([1.0]), b_sol=np.array([0.5, 0.5]), b_error=np.array([0.5, -0.5]),
        a_lower=(np.array([0.5]),), a_diagonal=np.array([0.0, 0.5]),
        a_predictor=(np.array([1.0]),),
    )  # fmt: skip
    interpolation_cls = dfx.ThirdOrderHermitePolynomialInterpolation.from_k
    root_finder: optx.AbstractRootFinder = optx.Newton(rtol=1e-14, atol=1e-15)
    root_find_max_steps: int = 20

    def order(self, terms):
        return 2


class MyHeun(dfx.AbstractERK):
    """A user's own explicit method, with the weights of the trapezoidal rule."""

    tableau = dfx.ButcherTableau(
        c=np.array([1.0]), b_sol=np.array([0.5, 0.5]), b_error=np.array([0.5, -0.5]),
        a_lower=(np.array([1.0]),),
    )  # fmt: skip
    interpolation_cls = dfx.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms):
        return 2


class TwoMidpoints(dfx.AbstractDIRK):
    """Two half steps of the implicit midpoint rule, and a stage that only estimates the error."""

    tableau = dfx.ButcherTableau(
        c=np.array([0.75, 1.0]), b_sol=np.array([0.5, 0.5, 0.0]),
        b_error=np.array([0.5, 0.0, -0.5]), a_lower=(np.array([0.5]), np.array([0.5, 0.5])),
        a_diagonal=np.array([0.25, 0.25, 0.0]), c1=0.25,
        a_predictor=(np.array([1.0]), np.array([0.0, 1.0])),
    )  # fmt: skip
    interpolation_cls = dfx.ThirdOrderHermitePolynomialInterpolation.from_k
    root_finder: optx.AbstractRootFinder = optx.Newton(rtol=1e-14, atol=1e-15)
    root_find_max_steps: int = 20

    def order(self, terms):
        return 2


ASYMMETRIC = dfx.Kvaerno3(root_finder=dfx.VeryChord(rtol=1e-13, atol=1e-14))


@pytest.mark.parametrize(
    "solver", [dfc.ImplicitMidpoint(), Trapezoidal(), TwoMidpoints(), MyHeun(), ASYMMETRIC]
)
def test_the_coefficients_say_what_a_step_back_does(solver):
    """Symmetric is what undoes its step, whether a class is diffrax's, ours or a user's."""
    term = dfx.ODETerm(rigid_body)

    def step(t0, t1, y0):
        state = solver.init(term, t0, t1, y0, None)
        return solver.step(term, t0, t1, y0, None, state, made_jump=True)[0]

    start, end = jnp.array(0.0), jnp.array(0.1)
    undone = bool(difference(step(end, start, step(start, end, W0)), W0) < 1e-13)
    if undone:
        dfc.SymmetricProjection(solver, KEPLER)
    else:
        with pytest.raises(ValueError, match="not symmetric"):
            dfc.SymmetricProjection(solver, KEPLER)
    assert undone is not isinstance(solver, (MyHeun, dfx.Kvaerno3))


def test_what_is_admissible():
    for solver in (
        dfx.Tsit5(), dfx.Euler(), dfx.Kvaerno3(), dfx.SemiImplicitEuler(), dfx.LeapfrogMidpoint(),
        dfx.ReversibleHeun(), dfx.ImplicitEuler(), dfx.HalfSolver(dfx.Heun()), dfc.RK4(),
        dfc.Unrolled(dfx.Tsit5()), dfc.Radau(), dfx.KenCarp3(),
        dfc.ManifoldProjection(dfc.ImplicitMidpoint(), KEPLER),
    ):  # fmt: skip
        with pytest.raises(ValueError, match="not symmetric"):
            dfc.SymmetricProjection(solver, KEPLER)
    with pytest.raises(TypeError, match="not a diffrax solver"):
        dfc.SymmetricProjection(dfc.ImplicitMidpoint, KEPLER)
    gains = dfc.FirstIntegral(lambda t, y, args: y[0], rate=lambda t, y, args: 0 * y[0])
    with pytest.raises(ValueError, match="rate"):
        dfc.SymmetricProjection(dfc.ImplicitMidpoint(), gains)


@pytest.mark.slow
def test_there_and_back_by_the_trapezoidal_rule():
    trapezoidal = dfc.SymmetricProjection(Trapezoidal(), RIGID_BODY)
    there = turned(trapezoidal, W0, 0.0, 2.0, 0.1)
    assert dfx.is_okay(there.result)
    back = turned(trapezoidal, final(there), 2.0, 0.0, -0.1)
    assert difference(final(back), W0) < 1e-13


def test_the_midpoint_rule_keeps_quadratic_integrals_in_any_units():
    def momentum(w):
        return np.sum((INERTIA * np.asarray(w)) ** 2)

    for unit in (1.0, 1e-12, 1e12):
        end = final(turned(dfc.ImplicitMidpoint(), W0 * unit, 0.0, 20.0, 0.1, unit=unit))
        assert abs(momentum(end / unit) / momentum(W0) - 1) < 1e-13
