"""Correction sweeps: a flow map predicts, the vector field corrects."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from ..learned import DRIVEN0, LORENZ, SWEEPS, Still, driven, flow_map, states, unchecked

TERM = dfx.ODETerm(LORENZ.vector_field)
DRIVEN = dfx.ODETerm(driven)
SHIPPED = dfc.load_pretrained("conservative-lorenz-standard")
BOTH = pytest.mark.parametrize("sweep", SWEEPS)


@eqx.filter_jit
def step(solver, y0, h=0.25, *, term=TERM, t0=0.0, args=None):
    """The state after one step, and the error estimate."""
    t0, t1 = jnp.asarray(t0), jnp.asarray(t0 + h)
    state = solver.init(term, t0, t1, y0, args)
    y1, error, *_ = solver.step(term, t0, t1, y0, args, state, False)
    return y1, error


def solve(solver, y0=LORENZ.y0, *, t0=0.0, t1=1.0, dt0=0.25, **kwargs):
    """Compiled once for all times."""
    return compiled(solver, y0, *map(jnp.asarray, (t0, t1, dt0)), **kwargs)


@eqx.filter_jit
def compiled(solver, y0, t0, t1, dt0, *, term=TERM, args=None, **kwargs):
    return dfx.diffeqsolve(term, solver, t0, t1, dt0, y0, args, **kwargs)


@pytest.fixture(scope="module")
def exact():
    """Twenty states and the exact ones a step later."""
    y0s = states(20)
    controller = dfx.PIDController(rtol=1e-13, atol=1e-13)

    @jax.jit
    @jax.vmap
    def after(y0):
        sol = dfx.diffeqsolve(
            TERM, dfx.Dopri8(), 0.0, 0.25, 1e-3, y0, stepsize_controller=controller
        )
        return sol.ys[-1]

    return y0s, after(y0s)


def errors(solver, exact):
    y0s, y1s = exact
    ys, _ = jax.vmap(lambda y0: step(solver, y0))(y0s)
    return jnp.median(jnp.linalg.norm(ys - y1s, axis=1))


# ---- Accuracy ----


def test_each_picard_sweep_gains_a_digit(exact):
    found = [errors(unchecked(SHIPPED, corrections=k), exact) for k in (0, 1, 4, 8)]
    assert found[0] > 5 * found[1] > 5e3 * found[2] > 5e7 * found[3]
    assert found[3] < 1e-12


def test_newton_squares_the_error(exact):
    found = [
        errors(unchecked(SHIPPED, corrections=k, sweep=dfc.learned.NewtonSweep()), exact)
        for k in (0, 1, 2)
    ]
    assert found[0] > 1e-4
    assert found[1] < found[0] ** 2
    assert found[2] < 1e-13


@pytest.mark.parametrize(
    ("sweep", "corrections", "order"),
    [("picard", 3, 3), ("newton", 1, 2)]
    + [pytest.param("picard", sweeps, sweeps, marks=pytest.mark.slow) for sweeps in (1, 2, 4, 6)]
    + [pytest.param("newton", 2, 6, marks=pytest.mark.slow)],
)
def test_sweeps_of_a_flow_map_that_knows_nothing_have_their_order(sweep, corrections, order):
    solver = unchecked(Still(), corrections=corrections, sweep=SWEEPS[sweep])
    assert solver.order(DRIVEN) == order
    dct.assert_order(solver, DRIVEN, DRIVEN0, t0=0.2, t1=1.8, dt0=0.2, args=2.0)
    if (sweep, corrections) == ("newton", 2):
        return  # the error of this one falls faster than claimed, before it is lost in roundoff
    with pytest.raises(AssertionError, match="measured order"):
        dct.assert_order(
            solver, DRIVEN, DRIVEN0, t0=0.2, t1=1.8, dt0=0.2, args=2.0, order=order + 0.7
        )


def test_the_order_is_that_of_the_flow_map_and_the_sweeps_up_to_the_nodes():
    class Fourth(Still):
        order: int = 4

    assert unchecked(Still()).order(TERM) is None
    assert unchecked(Fourth()).order(TERM) == 4
    assert unchecked(Fourth(), corrections=3).order(TERM) == 7
    assert unchecked(Fourth(), corrections=9, nodes=6).order(TERM) == 6
    assert unchecked(Fourth(), corrections=1, sweep=dfc.learned.NewtonSweep()).order(TERM) == 10


def test_both_sweeps_solve_the_same_equations():
    """Whatever the flow map."""

    def end(flow_map, corrections, sweep):
        solver = unchecked(flow_map, nodes=6, corrections=corrections, sweep=SWEEPS[sweep])
        return step(solver, LORENZ.y0, 0.1)[0]

    many = end(flow_map(), 13, "picard")
    np.testing.assert_allclose(many, end(flow_map(), 4, "newton"), rtol=0, atol=1e-13)
    np.testing.assert_allclose(many, end(Still(), 4, "newton"), rtol=0, atol=1e-13)


@BOTH
def test_the_error_estimate_is_the_change_by_the_last_sweep(sweep):
    found = [
        step(unchecked(SHIPPED, corrections=k, sweep=SWEEPS[sweep]), LORENZ.y0) for k in (1, 2)
    ]
    np.testing.assert_allclose(found[1][1], found[1][0] - found[0][0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        found[0][1], found[0][0] - SHIPPED(LORENZ.y0, 0.25), rtol=0, atol=1e-15
    )


class Linear(eqx.Module):
    matrix: jax.Array
    max_step: float = 1.0

    def __call__(self, y0, h):
        return y0 + jnp.sin(5 * h) * self.matrix @ y0


@jax.jit
def newton_on_a_linear_system(f, wrong, y0):
    term = dfx.ODETerm(lambda t, y, args: f @ y + jnp.cos(t))
    one, two = (
        unchecked(Linear(wrong), corrections=k, sweep=dfc.learned.NewtonSweep(), nodes=10)
        for k in (1, 2)
    )
    return step(one, y0, 0.5, term=term)[0], step(two, y0, 0.5, term=term)[0]


@given(st.integers(0, 10**6), st.floats(0.1, 5))
def test_one_newton_sweep_solves_a_linear_system(seed, size):
    keys = jr.split(jr.key(seed), 3)
    f, wrong = size * jr.normal(keys[0], (3, 3)), size * jr.normal(keys[1], (3, 3))
    y0 = jr.normal(keys[2], (3,))
    once, twice = newton_on_a_linear_system(f, wrong, y0)
    scale = 1 + np.max(np.abs(once)) * (1 + size) ** 2
    np.testing.assert_allclose(once, twice, rtol=0, atol=1e-11 * scale)


# ---- As a solver ----


def test_dense_output_goes_through_the_corrected_path():
    ts = jnp.array([0.07, 0.4, 0.93])
    reference = LORENZ.reference(ts)
    solver = unchecked(SHIPPED, corrections=2, sweep=dfc.learned.NewtonSweep())
    sol = solve(solver, saveat=dfx.SaveAt(ts=ts, dense=True))
    np.testing.assert_allclose(sol.ys, reference, rtol=0, atol=1e-9)
    np.testing.assert_allclose(sol.evaluate(ts[1]), sol.ys[1], rtol=0, atol=1e-14)
    assert jnp.max(jnp.abs(SHIPPED(LORENZ.y0, ts[0]) - reference[0])) > 1e-6


def test_the_vector_field_sees_time_and_args():
    term = dfx.ODETerm(lambda t, y, args: args * jnp.cos(t))
    sol = solve(unchecked(Still(), corrections=1), 0.5, term=term, t0=2.0, t1=5.0, args=1.5)
    np.testing.assert_allclose(sol.ys[-1], 0.5 + 1.5 * (np.sin(5) - np.sin(2)), rtol=1e-14)


class Wrong(eqx.Module):
    weights: jax.Array
    max_step: float = 1.0

    def __call__(self, y0, h):
        return y0 + jnp.sin(h * self.weights * y0)


@pytest.mark.parametrize(
    ("sweep", "whole"),
    [("newton", False)]
    + [
        pytest.param(*case, marks=pytest.mark.slow)
        for case in [("picard", False), ("picard", True), ("newton", True)]
    ],
)
def test_derivatives(sweep, whole):
    """With respect to the weights, the initial state and `args`, of a step and of a solve."""
    term = dfx.ODETerm(lambda t, y, args: args * LORENZ.vector_field(t, y, None))

    def f(weights, y0, args):
        solver = unchecked(Wrong(weights), nodes=4, corrections=1, sweep=SWEEPS[sweep])
        if not whole:
            return step(solver, y0, term=term, args=args)[0]
        saveat = dfx.SaveAt(ts=jnp.array([0.1, 0.5]))
        return solve(solver, y0, term=term, t1=0.5, args=args, saveat=saveat, max_steps=2).ys

    weights = jnp.array([0.3, -1.0, 0.5])
    point = weights, LORENZ.y0, jnp.array(0.9)
    dct.assert_gradients(f, *point, rtol=1e-6, forward=not whole)


def test_on_the_manifold():
    solver = unchecked(SHIPPED, corrections=1)
    projected = dfc.ManifoldProjection(solver, LORENZ.manifold)
    ts = jnp.linspace(0, 5, 41)
    sol = solve(projected, t1=5.0, max_steps=20, saveat=dfx.SaveAt(ts=ts))
    dct.assert_conserved(sol, LORENZ.manifold)


def test_a_complex_state():
    term = dfx.ODETerm(lambda t, y, args: 1j * y)
    y0 = jnp.array([1.0 + 0.5j])
    y1, _ = step(unchecked(Still(), corrections=14), y0, 0.5, term=term)
    np.testing.assert_allclose(y1, y0 * np.exp(0.5j), rtol=1e-14)
    with pytest.raises(TypeError, match="`NewtonSweep` needs a real state"):
        step(
            unchecked(Still(), corrections=1, sweep=dfc.learned.NewtonSweep()),
            y0,
            0.5,
            term=term,
        )


# ---- What is refused ----


def test_a_negative_number_of_sweeps():
    with pytest.raises(ValueError, match="`corrections` is -1, but it must be"):
        unchecked(Still(), corrections=-1)


def test_an_unknown_sweep():
    with pytest.raises(TypeError):
        unchecked(Still(), corrections=1, sweep="gauss")
