"""A flow map predicts, the vector field corrects and tells the error."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from ..learned import DRIVEN0, LORENZ, Still, driven, unchecked
from ..thinned import some_of

TERM, DRIVEN = dfx.ODETerm(LORENZ.vector_field), dfx.ODETerm(driven)
SHIPPED = dfc.load_pretrained("conservative-lorenz-standard")


@eqx.filter_jit
def step(solver, y0, h=0.25, *, term=TERM, t0=0.0, args=None):
    """The state after one step, and the error estimate."""
    t0, t1 = jnp.asarray(t0), jnp.asarray(t0 + h)
    state = solver.init(term, t0, t1, y0, args)
    y1, error, *_ = solver.step(term, t0, t1, y0, args, state, False)
    return y1, error


@eqx.filter_jit
def exact(term, y0, h=0.25, t0=0.0, args=None):
    controller = dfx.PIDController(rtol=1e-13, atol=1e-13)
    ys = dfx.diffeqsolve(
        term, dfx.Dopri8(), t0, t0 + h, h / 100, y0, args, stepsize_controller=controller
    ).ys
    return jax.tree.map(lambda x: x[-1], ys)


def test_sweeps_of_a_flow_map_that_knows_nothing_have_their_order():
    solver = unchecked(Still(), corrections=3)
    assert solver.order(DRIVEN) == 3
    options = dict(t0=0.2, t1=1.8, dt0=0.2, args=2.0)
    dct.assert_order(solver, DRIVEN, DRIVEN0, **options)
    with pytest.raises(AssertionError, match="measured order"):
        dct.assert_order(solver, DRIVEN, DRIVEN0, **options, order=3.7)


def test_the_order_is_that_of_the_flow_map_and_the_sweeps_up_to_the_nodes():
    class Fourth(Still):
        order: int = 4

    assert unchecked(Still()).order(TERM) is None
    assert unchecked(Fourth()).order(TERM) == 4
    assert unchecked(Fourth(), corrections=3).order(TERM) == 7
    assert unchecked(Fourth(), corrections=9).order(TERM) == 12


@pytest.mark.slow
def test_dense_output_goes_through_the_corrected_path():
    ts = jnp.array([0.07, 0.4, 0.93])
    reference = LORENZ.reference(ts)
    solver = unchecked(SHIPPED, corrections=8)
    saveat = dfx.SaveAt(ts=ts, dense=True)
    sol = eqx.filter_jit(dfx.diffeqsolve)(TERM, solver, 0.0, 1.0, 0.25, LORENZ.y0, saveat=saveat)
    np.testing.assert_allclose(sol.ys, reference, rtol=0, atol=1e-9)
    np.testing.assert_allclose(sol.evaluate(ts[1]), sol.ys[1], rtol=0, atol=1e-14)
    assert jnp.max(jnp.abs(SHIPPED(LORENZ.y0, ts[0]) - reference[0])) > 1e-6


class Sine(eqx.Module):
    weights: jax.Array
    max_step: float = 1.0

    def __call__(self, y0, h):
        return y0 + jnp.sin(h * self.weights * y0)


def test_derivatives():
    """Of a step by the weights, the initial state and `args`."""
    term = dfx.ODETerm(lambda t, y, args: args * LORENZ.vector_field(t, y, None))

    def f(weights, y0, args):
        solver = unchecked(Sine(weights), corrections=2)
        return step(solver, y0, term=term, args=args)[0]

    dct.assert_gradients(f, jnp.array([0.3, -1.0, 0.5]), LORENZ.y0, jnp.array(0.9), rtol=1e-6)


@pytest.mark.slow
def test_a_complex_state():
    term = dfx.ODETerm(lambda t, y, args: 1j * y)
    y0 = jnp.array([1.0 + 0.5j])
    y1, _ = step(unchecked(Still(), corrections=14), y0, 0.5, term=term)
    np.testing.assert_allclose(y1, y0 * np.exp(0.5j), rtol=1e-14)


def test_it_is_the_change_by_the_last_sweep():
    (y1, first), (y2, second) = (step(unchecked(SHIPPED, corrections=k), LORENZ.y0) for k in (1, 2))
    np.testing.assert_allclose(second, y2 - y1, rtol=0, atol=1e-15)
    np.testing.assert_allclose(first, y1 - SHIPPED(LORENZ.y0, 0.25), rtol=0, atol=1e-15)


class Wrong(eqx.Module):
    """The exact flow of `y' = rate y`, but for a multiple of `h^(order + 1)`."""

    rate: float
    order: int = 0
    size: float = 1e-3
    max_step: float = 1.0

    def __call__(self, y0, h):
        return y0 * jnp.exp(self.rate * h) + self.size * h ** (self.order + 1) * jnp.cos(3 * h)


LINEAR = dfx.ODETerm(lambda t, y, args: args * y)


@some_of("rate", [-6.0, 3.0], period=2)
def test_it_knows_how_the_vector_field_passes_an_error_on(rate):
    """Where `h ‖∂f‖` is not small the integral of the defect, a Picard sweep, is far off."""
    network = Wrong(jnp.array(rate))

    def run(corrections):
        solver = unchecked(network, corrections=corrections)
        return step(solver, jnp.array(1.0), 1.0, term=LINEAR, args=jnp.array(rate))

    y1, estimate = run(0)
    error = jnp.exp(rate) - y1
    np.testing.assert_allclose(estimate, error, rtol=0.05)
    by_sweep = (run(1)[0] - y1) / error
    assert by_sweep <= 0.6 or by_sweep >= 1.6


@some_of("order, corrections", [(2, 0), (0, 2)], period=2)
def test_it_falls_with_the_step_as_claimed(order, corrections):
    network, options = Wrong(-1.0, order, 0.5), dict(term=LINEAR, args=jnp.array(-1.0))
    solver = unchecked(network, corrections=corrections)
    steps = jnp.array([0.02, 0.04])
    small, large = jax.vmap(lambda h: step(solver, jnp.array(1.0), h, **options)[1])(steps)
    slope = jnp.log2(jnp.abs(large / small))
    np.testing.assert_allclose(slope, solver.error_order(LINEAR), atol=0.25)


def test_it_has_a_sign_and_sees_time_and_args():
    y1, estimate = step(unchecked(Still()), DRIVEN0, 0.3, term=DRIVEN, t0=1.3, args=2.0)
    expected = exact(DRIVEN, DRIVEN0, 0.3, jnp.array(1.3), 2.0)
    for name in expected:
        np.testing.assert_allclose(estimate[name], expected[name] - y1[name], rtol=1e-3)


def test_it_is_never_small_where_something_is_not_finite():
    """In the flow map or in the vector field."""

    class Broken(Still):
        def __call__(self, y0, h):
            return jnp.where(h > 0.1, jnp.nan, y0)

    _, estimate = step(unchecked(Broken()), LORENZ.y0, 0.2)
    assert not jnp.any(jnp.isfinite(estimate))
    term = dfx.ODETerm(lambda t, y, args: jnp.where(t > 0.1, jnp.nan, y))
    _, estimate = step(unchecked(Still()), LORENZ.y0, 0.2, term=term)
    assert jnp.all(jnp.isnan(estimate))


@eqx.filter_jit
def adaptive(solver, tol):
    return dfx.diffeqsolve(
        TERM, solver, 0.0, 2.0, None, LORENZ.y0, max_steps=2000, saveat=dfx.SaveAt(steps=True),
        stepsize_controller=dfx.PIDController(rtol=tol, atol=tol),
    )  # fmt: skip


def test_steps_longer_than_the_longest_are_rejected():
    """Not an error: the controller tries a smaller one."""
    sol = adaptive(unchecked(SHIPPED), jnp.asarray(1e-1))
    assert sol.stats["num_rejected_steps"] > 0
    lengths = np.diff(sol.ts[: int(sol.stats["num_accepted_steps"])], prepend=0.0)
    assert 0.04 < np.max(lengths) <= 0.25 + 1e-6
