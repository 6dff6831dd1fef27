"""Facts about single systems, from their sources."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve import check_invariance, systems


def test_laplace_runge_lenz_vector_is_conserved_but_redundant():
    system = systems.Kepler(mu=1.7)
    vector = dfc.FirstIntegral(system.laplace_runge_lenz)
    assert check_invariance(system.vector_field, vector, system.sample).ok
    y = system.sample(jr.key(5))
    length = jnp.sum(system.laplace_runge_lenz(0.0, y, None) ** 2)
    h, l = system.energy(0.0, y, None), system.angular_momentum(0.0, y, None)
    np.testing.assert_allclose(length, 1.7**2 + 2 * h * l**2)


def test_solar_system_has_the_positions_of_its_source():
    q, v = systems.OuterSolarSystem().y0
    np.testing.assert_allclose(q[1] - q[0], [-3.5023653, -3.8169847, -1.5507963])
    np.testing.assert_allclose(v[5] - v[0], [0.00276725, -0.00170702, -0.00136504])


def test_toda_traces_begin_with_henons_integral():
    system = systems.TodaLattice(a=1.4, b=0.8, particles=4)
    q, p = y = system.sample(jr.key(0))
    d2 = 1.4 / 0.8 * np.exp(0.8 * (q - np.roll(q, -1)))
    henon = np.sum(p**3) / 3 + np.sum((p + np.roll(p, -1)) * d2)
    traces = system.higher_traces(0.0, y, None)
    assert traces.shape == (2,)
    np.testing.assert_allclose(traces[0], henon)


def test_predators_and_prey_rest_at_their_equilibrium():
    system = systems.LotkaVolterra(alpha=2.0, beta=3.0, gamma=4.0, delta=5.0)
    rest = jnp.array([4 / 5, 2 / 3])
    np.testing.assert_allclose(system.vector_field(0.0, rest, None), 0.0, atol=1e-15)
    np.testing.assert_allclose(jax.grad(system.first_integral, 1)(0.0, rest, None), 0.0, atol=1e-15)


def test_pendulum_energy_is_conserved_only_on_the_constraints():
    system = systems.CartesianPendulum()
    y = (jnp.array([1.0, 0.5]), jnp.array([0.3, 0.2]))  # q · v is not zero
    f = system.vector_field(0.0, y, None)
    _, rate = jax.jvp(lambda y: system.energy(0.0, y, None), (y,), (f,))
    assert abs(rate) > 1e-2


def test_the_body_axis_turns_by_the_angular_velocity():
    system = systems.RigidBodyAttitude(inertia=(1.0, 1.0, 1.0))
    y0 = (jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 0.0, 0.0]))
    ts = np.linspace(0.0, 4.0, 5)
    axis = system.trajectories(system.reference(ts, y0))["third axis of the body"]
    expected = np.stack([0 * ts, -np.sin(0.5 * ts), np.cos(0.5 * ts)], axis=1)
    np.testing.assert_allclose(axis, expected, atol=1e-13)


def test_the_waves_conserve_at_every_state_also_with_modes_that_are_left_out():
    for points in (5, 64):
        wave = systems.KortewegDeVries(points=points)
        states = jr.normal(jr.key(0), (20, points))
        assert dfc.check_invariance(wave.vector_field, wave.manifold, states).ok


def test_what_is_too_small_is_refused():
    with pytest.raises(ValueError, match="at least 3 particles"):
        systems.TodaLattice(particles=2)
    with pytest.raises(ValueError, match="at least 4 points"):
        systems.KortewegDeVries(points=3)
