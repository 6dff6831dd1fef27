"""When to save, and what the projections did."""

import dataclasses

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..problems import OMEGA0, RIGID_BODY, drift_of, largest, rigid_body, solve
from ..thinned import some_of

STEPS = dfx.SaveAt(t0=True, steps=True, solver_state=True, dense=True)


def run():
    """By one program for all, to the nearest point."""
    nearest = dfc.SimplifiedNewton(metric=1.0)
    solver = dfc.ManifoldProjection(dfc.RK4(), RIGID_BODY, projection=nearest)
    return solve(rigid_body, solver, OMEGA0, t1=2.0, saveat=STEPS, max_steps=64)


def test_statistics_are_those_of_the_projections():
    sol = run()
    statistics = dfc.statistics(sol)
    assert statistics.worst == -1
    assert "nan" not in str(statistics)  # this solver estimates no error
    steps = int(sol.stats["num_steps"])
    assert statistics.num_projections == steps
    assert steps <= statistics.num_iterations <= steps * statistics.max_iterations
    assert statistics.residual_after <= 4e-15
    # Against steps made by hand.
    values = {name: f.fn(0.0, OMEGA0, None) for name, f in RIGID_BODY.items()}

    @jax.jit
    def step(y):
        candidate = solve(rigid_body, dfc.RK4(), y, t1=0.1).ys[-1]
        return dfc.project(RIGID_BODY, candidate, value=values, projection=dfc.SimplifiedNewton())

    infos, y = [], OMEGA0
    for _ in range(steps):
        y, info = step(y)
        infos.append(info)
    # To the scale of a solve all terms inside `fn` count.
    ratio = statistics.residual_before / np.max([i.residual_before for i in infos])
    assert 0.3 < ratio < 1 + 1e-6
    np.testing.assert_allclose(
        statistics.correction, np.max([i.correction for i in infos]), rtol=1e-6
    )
    assert abs(int(statistics.num_iterations) - sum(int(i.num_steps) for i in infos)) <= steps


def test_statistics_need_the_solver_state():
    sol = run()
    for state, text in ((None, "solver_state=True"), ((), "ManifoldProjection")):
        with pytest.raises(ValueError, match=text):
            dfc.statistics(dataclasses.replace(sol, solver_state=state))


# ---- Every way to save, to stop, and to choose steps that diffrax has ----


ADAPTIVE = dfx.PIDController(rtol=1e-6, atol=1e-6)


@some_of(
    "controller, times",
    [
        (dfx.StepTo(ts=jnp.array([0.0, 0.13, 0.5, 1.0])), [0.13, 0.5]),
        (dfx.ClipStepSizeController(ADAPTIVE, [0.3], [0.51], store_rejected_steps=5), [0.3, 0.51]),
    ],
    ids=["step-to", "clip"],
    period=2,
)
def test_every_controller_hits_its_times_on_the_manifold(controller, times):
    dt0 = None if isinstance(controller, dfx.StepTo) else 0.1
    options = dict(stepsize_controller=controller, dt0=dt0, max_steps=64)
    solver, saveat = (
        dfc.ManifoldProjection(dfx.Tsit5(), RIGID_BODY),
        dfx.SaveAt(t0=True, steps=True),
    )
    sol = solve(rigid_body, solver, OMEGA0, saveat=saveat, **options)
    assert largest(drift_of(sol, RIGID_BODY)) <= 4e-16
    for t in times:
        assert np.min(np.abs(np.asarray(sol.ts) - t)) <= 1e-6


@pytest.mark.slow
def test_a_steady_state_by_the_implicit_adjoint():
    """A damped flow on a sphere ends at the point in the direction of `args`, which is
    differentiated by the implicit function theorem."""

    def towards(t, y, args):
        return args - jnp.sum(args * y) * y

    sphere = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)

    def end(args):
        options = dict(
            adjoint=dfx.ImplicitAdjoint(),
            event=dfx.Event(dfx.steady_state_event(rtol=1e-9, atol=1e-9)),
            # At the limit of stability the steps keep an error of some ten tolerances.
            stepsize_controller=dfx.PIDController(rtol=1e-11, atol=1e-11),
            max_steps=4096,
        )
        solver = dfc.ManifoldProjection(dfx.Tsit5(), sphere)
        return solve(towards, solver, jnp.eye(3)[0], args=args, t1=jnp.inf, **options).ys[-1]

    args = jnp.array([1.0, 2.0, 2.0])
    np.testing.assert_allclose(end(args), args / 3, rtol=0, atol=1e-8)
