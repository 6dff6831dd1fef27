"""Exact solutions, against numerical ones and against published numbers."""

import itertools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffrax_conserve import systems

from ..problems import solve

TS = np.linspace(0.0, 8.0, 5)


@pytest.mark.slow
def test_rigid_body_with_its_moments_in_any_order_or_some_equal():
    y0, controller = jnp.array([0.7, -1.1, 0.4]), dfx.PIDController(rtol=1e-13, atol=1e-13)
    # Dense output is less accurate than steps.
    controller = dfx.ClipStepSizeController(controller, step_ts=TS)
    options = dict(saveat=dfx.SaveAt(ts=TS), stepsize_controller=controller, max_steps=20_000)

    @jax.jit
    @jax.vmap
    def both(inertia):
        """By the formula, and by a solver."""
        system = systems.RigidBody(inertia)
        numerical = solve(system.vector_field, dfx.Dopri8(), y0, t1=8.0, dt0=1e-3, **options)
        return system.solution(jnp.array(TS), y0), numerical.ys

    orders = [*itertools.permutations((0.1, 0.2, 0.3)), (0.2, 0.2, 0.3), (0.1, 0.3, 0.3)]
    np.testing.assert_allclose(*both(jnp.array([*orders, (0.2, 0.5, 0.2)])), rtol=0, atol=1e-12)


@pytest.mark.parametrize("e", [0.0, 0.3, 0.9, 0.99])
def test_half_a_kepler_period_leads_from_perihelion_to_aphelion(e):
    system = systems.Kepler(mu=2.0)
    p = np.sqrt(2 * (1 + e) / (1 - e))
    y0 = (jnp.array([1 - e, 0.0]), jnp.array([0.0, p]))
    q, p1 = system.reference([float(system.period(y0)) / 2], y0)
    np.testing.assert_allclose(q[0], [-1 - e, 0.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(p1[0], [0.0, -p * (1 - e) / (1 + e)], rtol=0, atol=1e-12)


def test_an_unbound_kepler_orbit_is_refused(errors_raise):
    y0 = (jnp.array([1.0, 0.0]), jnp.array([0.0, 3.0]))
    with pytest.raises(eqx.EquinoxRuntimeError, match="bound orbits"):
        systems.Kepler().reference([1.0], y0)
