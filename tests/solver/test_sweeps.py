"""Correction sweeps: a flow map predicts, the vector field corrects."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

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
    [("picard", 3, 3), ("newton", 1, 2)],
)
def test_sweeps_of_a_flow_map_that_knows_nothing_have_their_order(sweep, corrections, order):
    solver = unchecked(Still(), corrections=corrections, sweep=SWEEPS[sweep])
    assert solver.order(DRIVEN) == order
    dct.assert_order(solver, DRIVEN, DRIVEN0, t0=0.2, t1=1.8, dt0=0.2, args=2.0)
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


# ---- As a solver ----


def test_dense_output_goes_through_the_corrected_path():
    ts = jnp.array([0.07, 0.4, 0.93])
    reference = LORENZ.reference(ts)
    solver = unchecked(SHIPPED, corrections=2, sweep=dfc.learned.NewtonSweep())
    saveat = dfx.SaveAt(ts=ts, dense=True)
    sol = eqx.filter_jit(dfx.diffeqsolve)(TERM, solver, 0.0, 1.0, 0.25, LORENZ.y0, saveat=saveat)
    np.testing.assert_allclose(sol.ys, reference, rtol=0, atol=1e-9)
    np.testing.assert_allclose(sol.evaluate(ts[1]), sol.ys[1], rtol=0, atol=1e-14)
    assert jnp.max(jnp.abs(SHIPPED(LORENZ.y0, ts[0]) - reference[0])) > 1e-6


class Wrong(eqx.Module):
    weights: jax.Array
    max_step: float = 1.0

    def __call__(self, y0, h):
        return y0 + jnp.sin(h * self.weights * y0)


def test_derivatives():
    """Of a step by the weights, the initial state and `args`."""
    term = dfx.ODETerm(lambda t, y, args: args * LORENZ.vector_field(t, y, None))

    def f(weights, y0, args):
        sweep = dfc.learned.NewtonSweep()
        solver = unchecked(Wrong(weights), nodes=4, corrections=1, sweep=sweep)
        return step(solver, y0, term=term, args=args)[0]

    dct.assert_gradients(f, jnp.array([0.3, -1.0, 0.5]), LORENZ.y0, jnp.array(0.9), rtol=1e-6)


def test_a_complex_state():
    term = dfx.ODETerm(lambda t, y, args: 1j * y)
    y0 = jnp.array([1.0 + 0.5j])
    y1, _ = step(unchecked(Still(), corrections=14), y0, 0.5, term=term)
    np.testing.assert_allclose(y1, y0 * np.exp(0.5j), rtol=1e-14)
    newton = unchecked(Still(), corrections=1, sweep=dfc.learned.NewtonSweep())
    with pytest.raises(TypeError, match="`NewtonSweep` needs a real state"):
        step(newton, y0, 0.5, term=term)
