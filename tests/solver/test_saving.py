"""Every way to save, to stop, and to choose steps that diffrax has."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..problems import (
    OMEGA0,
    RIGID_BODY,
    drift_of,
    largest,
    rigid_body,
    rotational_energy,
    solve,
)

SOLVER = dfc.ManifoldProjection(dfx.Tsit5(), RIGID_BODY)
ENERGY = rotational_energy(0.0, OMEGA0, None)


def run(saveat, **kwargs):
    return solve(rigid_body, SOLVER, OMEGA0, saveat=saveat, **kwargs)


@jax.jit
def energies(ys):
    return jax.vmap(lambda y: rotational_energy(0.0, y, None))(ys)


def test_subs_and_functions_of_the_state():
    ts = jnp.linspace(0, 1, 6)
    saveat = dfx.SaveAt(
        subs={
            "end": dfx.SubSaveAt(t0=True, t1=True),
            "energy": dfx.SubSaveAt(ts=ts, fn=rotational_energy),
            "steps": dfx.SubSaveAt(steps=2),
        }
    )
    sol = run(saveat, max_steps=16)
    np.testing.assert_allclose(sol.ys["energy"], ENERGY, rtol=4e-16)
    np.testing.assert_allclose(energies(sol.ys["end"]), ENERGY, rtol=4e-16)
    finite = jnp.isfinite(sol.ts["steps"])
    np.testing.assert_allclose(energies(sol.ys["steps"][finite]), ENERGY, rtol=4e-16)


ADAPTIVE = dfx.PIDController(rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("controller", "times"),
    [
        (dfx.StepTo(ts=jnp.array([0.0, 0.13, 0.5, 1.0])), [0.13, 0.5]),
        (
            dfx.ClipStepSizeController(
                ADAPTIVE,
                step_ts=jnp.array([0.3]),
                jump_ts=jnp.array([0.51]),
                store_rejected_steps=5,
            ),
            [0.3, 0.51],
        ),
    ],
    ids=["step-to", "clip"],
)
def test_every_controller_hits_its_times_on_the_manifold(controller, times):
    sol = run(
        dfx.SaveAt(t0=True, steps=True),
        stepsize_controller=controller,
        dt0=None if isinstance(controller, dfx.StepTo) else 0.1,
        max_steps=64,
    )
    assert largest(drift_of(sol, RIGID_BODY)) <= 4e-16
    for t in times:
        assert np.min(np.abs(np.asarray(sol.ts) - t)) <= 1e-6


def test_a_steady_state_by_the_implicit_adjoint():
    """A damped flow on a sphere ends at the point in the direction of `args`, which is
    differentiated by the implicit function theorem."""

    def towards(t, y, args):
        return args - jnp.sum(args * y) * y

    sphere = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)

    def end(args):
        sol = solve(
            towards,
            dfc.ManifoldProjection(dfx.Tsit5(), sphere),
            jnp.array([1.0, 0.0, 0.0]),
            args=args,
            t1=jnp.inf,
            dt0=0.1,
            adjoint=dfx.ImplicitAdjoint(),
            event=dfx.Event(dfx.steady_state_event(rtol=1e-9, atol=1e-9)),
            # At the limit of stability the steps keep an error of some ten tolerances.
            stepsize_controller=dfx.PIDController(rtol=1e-11, atol=1e-11),
            max_steps=4096,
        )
        return sol.ys[-1]

    args = jnp.array([1.0, 2.0, 2.0])
    np.testing.assert_allclose(end(args), args / 3, rtol=0, atol=1e-8)
