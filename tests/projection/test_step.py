"""What a projection of a user sees of the step, with relaxation in Ketcheson's sense."""

from typing import ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..problems import EXPONENTIAL, EXPONENTIAL0, drift_of, evaluated, exponential

ENERGY, TERM = EXPONENTIAL, dfx.ODETerm(exponential)


class Relaxation(dfc.AbstractProjection):
    metric: None = None

    def solve(self, problem, candidate):
        y0 = problem.step.y0
        gamma = jnp.ones(())
        for _ in range(5):
            g, slope = jax.jvp(
                lambda x: problem.residual(y0 + x * (candidate - y0))[0], (gamma,), (1.0,)
            )
            gamma = gamma - jnp.where(slope == 0, 0, g / jnp.where(slope == 0, 1, slope))
        y = y0 + gamma * (candidate - y0)
        return y, problem.judge(candidate, y, num_steps=5)


RELAXED = dfc.ManifoldProjection(dfx.Heun(), ENERGY, projection=Relaxation())


@eqx.filter_jit
def solve(solver, y0=EXPONENTIAL0, t1=2.0, dt0=0.1, **options):
    return dfx.diffeqsolve(TERM, solver, 0.0, t1, dt0, y0, **options)


def test_relaxation_keeps_the_energy_at_every_saved_time():
    saveat = dfx.SaveAt(ts=jnp.linspace(0, 2, 57), dense=True)
    sol = solve(RELAXED, saveat=saveat)
    assert jnp.max(jnp.abs(drift_of(sol, ENERGY))) < 4e-15
    kept = jax.vmap(ENERGY.fn, (None, 0, None))(0, evaluated(sol, jnp.linspace(0, 2, 91)), None)
    np.testing.assert_allclose(kept, ENERGY.fn(0, EXPONENTIAL0, None), rtol=4e-15)


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
        return y, problem.judge(candidate, y)


def test_a_projection_sees_the_step_of_every_candidate():
    t1 = -1.0
    solver = dfc.ManifoldProjection(dfx.Bosh3(), ENERGY, projection=Seen())
    saveat = dfx.SaveAt(ts=jnp.linspace(0, t1, 23), dense=True)
    times = {"t1": t1, "dt0": -0.1, "saveat": saveat}
    sol, plain = solve(solver, **times), solve(dfx.Bosh3(), **times)
    assert sol.result == dfx.RESULTS.successful
    np.testing.assert_allclose(sol.ys, plain.ys, atol=1e-14)
    between = jnp.array([0.33 * t1])
    np.testing.assert_allclose(evaluated(sol, between), evaluated(plain, between), atol=1e-14)


class Unseeing(Seen):
    sees_step: ClassVar[bool] = False

    def solve(self, problem, candidate):
        assert problem.step is None
        return candidate, problem.judge(candidate, candidate)


def test_what_asks_for_no_step_gets_none_and_saves_none():
    solver = dfc.ManifoldProjection(dfx.Bosh3(), ENERGY, projection=Unseeing())
    sol = solve(solver, saveat=dfx.SaveAt(dense=True))
    assert sol.interpolation.infos["error"] is None


def test_what_is_no_solution_is_a_failure():
    lazy = Unseeing(atol=0.0)
    solver = dfc.ManifoldProjection(dfc.RK4(), ENERGY, projection=lazy)
    assert solve(solver, dt0=0.3, throw=False).result != dfx.RESULTS.successful
    # Outside a solve there is no step.
    with pytest.raises(AttributeError, match="y0"):
        dfc.project(ENERGY, EXPONENTIAL0, value=0.0, projection=Relaxation())
