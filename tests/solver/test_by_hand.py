"""A loop that calls `step` itself, with `args` that change at each tick."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..learned import LORENZ, flow_map, solution, unchecked
from ..problems import EPS, largest

TICK = 0.25
TERM = dfx.ODETerm(lambda t, y, torque: jnp.stack([y[1], torque - jnp.sin(y[0])]))
ENERGY = dfc.FirstIntegral(lambda t, y, torque: y[1] ** 2 / 2 - jnp.cos(y[0]) - torque * y[0])
SOLVER = dfc.ManifoldProjection(dfc.RK4(), ENERGY)


def ends(torques, y0):
    def tick(y, torque):
        state = SOLVER.init(TERM, 0.0, TICK, y, torque)
        y, _, _, _, result = SOLVER.step(TERM, 0.0, TICK, y, torque, state, made_jump=False)
        return y, (y, dfx.is_successful(result))

    return jax.lax.scan(tick, y0, torques)[1]


def test_the_work_of_a_torque_is_the_gain_in_energy_and_a_gradient_goes_through_all_ticks():
    """`init` at each tick takes the value of the new torque. In a batch, by a difference."""
    torques = jnp.array([[0.3, -0.2, 0.5, 0.1], [0.0, 0.4, -0.5, 0.2]])
    y0 = jnp.array([[0.5, 0.2], [-0.4, 0.6]])

    @jax.jit
    def both(torques, along):
        def last(torques):
            ys, success = jax.vmap(ends)(torques, y0)
            return jnp.sum(ys[:, -1] ** 2), (ys, success)

        slopes, found = jax.grad(last, has_aux=True)(torques)
        step = 1e-5
        apart = last(torques + step * along)[0] - last(torques - step * along)[0]
        return found, jnp.sum(slopes * along), apart / (2 * step)

    along = jnp.array([[1.0, -2.0, 0.5, 1.5], [0.7, 0.3, -1.0, 2.0]])
    (ys, success), slope, difference = both(torques, along)
    assert success.all()
    ys = np.concatenate([y0[:, None], ys], axis=1)
    energy = ys[..., 1] ** 2 / 2 - np.cos(ys[..., 0])
    assert largest(np.diff(energy) - torques * np.diff(ys[..., 0])) < 16 * EPS
    assert abs(slope - difference) < 1e-8


@pytest.mark.parametrize(
    ("solver", "reason"),
    [(unchecked(flow_map()), "max_step"), (dfc.PINNSolver(solution()), "outside the interval")],
    ids=["flow map", "PINN"],
)
def test_a_step_that_is_too_long_is_told_by_its_result(solver, reason):
    """Outside of `jit` too, where its length is known."""
    term, y0 = dfx.ODETerm(LORENZ.vector_field), LORENZ.y0
    state = solver.init(term, 0.0, 0.2, y0, None)
    for end, succeeds in ((0.2, True), (3.0, False)):
        result = solver.step(term, 0.0, end, y0, None, state, made_jump=False)[4]
        assert bool(dfx.is_successful(result)) == succeeds
    assert reason in str(result)


def both_ways(change):
    return dfx.ODETerm(lambda t, v, args: v), dfx.ODETerm(change)


@pytest.mark.parametrize(
    ("make", "terms", "y"),
    [
        (lambda: SOLVER, dfx.ODETerm, jnp.array([1.0, 0.0])),
        (
            lambda: dfc.SymmetricProjection(dfc.ImplicitMidpoint(), ENERGY),
            dfx.ODETerm,
            jnp.array([1.0, 0.0]),
        ),
        (
            lambda: dfc.RATTLE(dfc.Constraint(lambda t, q, args: q @ q - 1), masses=1.0),
            both_ways,
            (jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])),
        ),
        (lambda: unchecked(flow_map()), dfx.ODETerm, LORENZ.y0),
    ],
    ids=["projection", "symmetric", "RATTLE", "flow map"],
)
def test_a_loop_at_times_of_python_compiles_once(make, terms, y):
    """Also of integers, and at times of which none comes twice."""
    traces = []

    def change(t, y, args):
        traces.append(t)
        return -y if args is None else jnp.stack([y[1], args - jnp.sin(y[0])])

    solver, args = make(), 0.1 if terms is dfx.ODETerm and len(y) == 2 else None
    terms, counts = terms(change), []
    state = solver.init(terms, 0, TICK, y, args)
    for k in range(4):
        start, end = (k * TICK, (k + 1) * TICK) if k != 3 else (1, 1.2)
        y, _, _, state, result = solver.step(terms, start, end, y, args, state, made_jump=False)
        assert dfx.is_successful(result)
        counts.append(len(traces))
    assert counts[1] == counts[3]


def test_numbers_of_python_have_the_precision_of_the_state():
    y, args = jnp.array([1.0, 0.0], jnp.float32), jnp.float32(0.1)
    state = SOLVER.init(TERM, 0.0, TICK, y, args)
    for start, end in ((0, TICK), (TICK, 0.5), (np.float64(0.5), 1)):
        y, _, _, state, result = SOLVER.step(TERM, start, end, y, args, state, made_jump=False)
        assert dfx.is_successful(result)
    assert y.dtype == jnp.float32
