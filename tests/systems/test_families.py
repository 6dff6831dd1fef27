"""The catalogue by name, vector fields from what they conserve, exact solutions, and facts from
the sources."""

import itertools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import diffrax_conserve as dfc
from diffrax_conserve import systems
from diffrax_conserve.systems import hamiltonian_vector_field, nambu_vector_field

from ..problems import solve


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


@pytest.mark.slow
def test_the_body_axis_turns_by_the_angular_velocity():
    system = systems.RigidBodyAttitude(inertia=(1.0, 1.0, 1.0))
    y0 = (jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 0.0, 0.0]))
    ts = np.linspace(0.0, 4.0, 5)
    axis = system.trajectories(system.reference(ts, y0))["third axis of the body"]
    expected = np.stack([0 * ts, -np.sin(0.5 * ts), np.cos(0.5 * ts)], axis=1)
    np.testing.assert_allclose(axis, expected, rtol=0, atol=1e-13)


@pytest.mark.slow
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


def test_every_exported_system_is_listed_and_found_by_its_own_name():
    classes = [x for name, x in vars(systems).items() if not name.startswith(("_", "Abstract"))]
    exported = {
        x.name for x in classes if isinstance(x, type) and issubclass(x, systems.AbstractSystem)
    }
    assert exported == {*systems.names(), *systems.names(stiff=True)}
    assert len(exported) == 15
    assert all(systems.get(name).name == name for name in exported)


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ("keplar", "Did you mean .*'kepler'"),
        ("Rigid_Body", "Did you mean .*'rigid-body'"),
        ("zzz", "The catalogue holds: harmonic-oscillator, rigid-body"),
    ],
)
def test_an_unknown_name_is_answered_with_the_close_ones(wrong, right):
    with pytest.raises(ValueError, match=right):
        systems.get(wrong)


CANONICAL = ("harmonic-oscillator", "double-pendulum", "kepler", "henon-heiles", "toda-lattice")


@pytest.mark.parametrize("name", CANONICAL)
def test_hamiltons_equations_agree_with_those_written_by_hand(name):
    system = systems.get(name)
    f = hamiltonian_vector_field(system.energy)
    y = system.sample(jr.key(0))
    written, derived = (g(0.0, y, None) for g in (system.vector_field, f))
    assert jax.tree.structure(written) == jax.tree.structure(derived)
    np.testing.assert_allclose(ravel_pytree(derived)[0], ravel_pytree(written)[0], 0, 1e-14)


def test_nambus_equations_are_those_of_lorenz():
    system = systems.ConservativeLorenz(sigma=1.3, rho=0.7)
    y = system.sample(jr.key(0))
    f = nambu_vector_field(system.casimir, system.energy)
    np.testing.assert_allclose(f(0.0, y, None), system.vector_field(0.0, y, None), 0, 1e-15)


@pytest.mark.parametrize("as_pair", [tuple, list])
def test_pairs_and_stacked_arrays_give_the_same(as_pair):
    def energy(t, y, args):
        q, p = y
        return args * (jnp.sum(p**4) / 4 + jnp.sum(q[..., 0] ** 2 * q[..., 1])) * t

    y = jr.normal(jr.key(0), (2, 3, 2))
    f = hamiltonian_vector_field(energy)
    pair = f(2.0, as_pair(y), 3.0)
    assert type(pair) is as_pair
    np.testing.assert_array_equal(jnp.stack(pair), f(2.0, y, 3.0))


@pytest.mark.parametrize("y", [jnp.ones(3), jnp.array(1.0), (jnp.ones(2),), {"q": jnp.ones(2)}])
def test_a_state_of_the_wrong_form_is_refused(y):
    f = hamiltonian_vector_field(lambda t, y, args: 0.0)
    with pytest.raises(TypeError, match=r"must be a pair `\(q, p\)`"):
        f(0.0, y, None)
    f = nambu_vector_field(lambda t, y, args: 0.0, lambda t, y, args: 0.0)
    with pytest.raises(TypeError, match=r"shape \(3,\)"):
        f(0.0, jnp.ones(4), None)


# ---- Exact solutions, against numerical ones and against published numbers ----

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
