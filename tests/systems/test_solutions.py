"""Exact solutions, against numerical ones and against published numbers."""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
import scipy.special

from diffrax_conserve import systems
from diffrax_conserve.systems._base import integrate
from diffrax_conserve.systems._elliptic import (
    complete_elliptic,
    incomplete_elliptic,
    jacobi_elliptic,
)

TS = np.linspace(0.0, 8.0, 5)


@functools.cache
def many_solutions(method):
    """Over a batch of systems and states."""
    return eqx.filter_jit(eqx.filter_vmap(method, in_axes=(eqx.if_array(0), None, eqx.if_array(0))))


def exact(system, ts, y0):
    return system.solution(ts, y0)


def batch(system, num):
    """A batch of systems with parameters changed, and a random initial state of each."""

    def draw(key):
        parameter_key, state_key = jr.split(key)
        factor = jr.uniform(parameter_key, minval=0.5, maxval=2.0)
        changed = jax.tree.map(lambda x: x * factor, system)
        return changed, changed.sample(state_key)

    return eqx.filter_jit(eqx.filter_vmap(draw))(jr.split(jr.key(3), num))


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow) for n in ("harmonic-oscillator", "rigid-body")]
    + ["kepler"],
)
def test_exact_solutions_agree_with_a_numerical_one(name):
    many, y0s = batch(systems.get(name), 16)
    a = many_solutions(exact)(many, TS, y0s)
    b = many_solutions(integrate)(many, TS, y0s)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, atol=2e-11)


def test_rigid_body_with_its_moments_in_any_order():
    orders = np.array(list(itertools.permutations((0.1, 0.2, 0.3))))
    many = eqx.filter_vmap(systems.RigidBody)(jnp.asarray(orders))
    y0s = jnp.broadcast_to(jnp.array([0.7, -1.1, 0.4]), (6, 3))
    a, b = (many_solutions(method)(many, TS, y0s) for method in (exact, integrate))
    np.testing.assert_allclose(a, b, atol=1e-12)


@pytest.mark.parametrize("inertia", [(0.2, 0.2, 0.3), (0.1, 0.3, 0.3), (0.2, 0.5, 0.2)])
def test_symmetric_top(inertia):
    system, y0 = systems.RigidBody(inertia), jnp.array([0.7, -1.1, 0.4])
    ts = jnp.asarray(TS)
    numerical = eqx.filter_jit(integrate)(system, ts, y0)
    np.testing.assert_allclose(system.reference(ts, y0), numerical, atol=1e-12)


def test_keplers_problem_has_the_published_position():
    q, _ = systems.Kepler().reference([20.0])
    np.testing.assert_allclose(q[0], [-0.77007558, 0.78834482], atol=5e-9)


@pytest.mark.parametrize("e", [0.0, 0.3, 0.9, 0.99])
def test_half_a_kepler_period_leads_from_perihelion_to_aphelion(e):
    system = systems.Kepler(mu=2.0)
    p = np.sqrt(2 * (1 + e) / (1 - e))
    y0 = (jnp.array([1 - e, 0.0]), jnp.array([0.0, p]))
    q, p1 = system.reference([float(system.period(y0)) / 2], y0)
    np.testing.assert_allclose(q[0], [-1 - e, 0.0], atol=1e-12)
    np.testing.assert_allclose(p1[0], [0.0, -p * (1 - e) / (1 + e)], atol=1e-12)


def test_an_unbound_kepler_orbit_is_refused(errors_raise):
    y0 = (jnp.array([1.0, 0.0]), jnp.array([0.0, 3.0]))
    with pytest.raises(eqx.EquinoxRuntimeError, match="bound orbits"):
        systems.Kepler().reference([1.0], y0)


def test_small_swings_have_the_period_of_galileo():
    system = systems.CartesianPendulum(length=2.0, gravity=9.81)
    angle = 1e-5
    y0 = (2.0 * jnp.array([np.sin(angle), -np.cos(angle)]), jnp.zeros(2))
    np.testing.assert_allclose(system.period(y0), 2 * np.pi * np.sqrt(2.0 / 9.81), rtol=1e-10)


def test_equal_vortices_on_an_equilateral_triangle_rotate_rigidly():
    angles = 2 * np.pi * np.arange(3) / 3
    y0 = jnp.stack([np.cos(angles), np.sin(angles)], axis=1)
    # N equal vortices on a circle of radius r turn at the rate Γ (N - 1) / 4π r².
    turned = angles + TS[:, None] * 2 / (4 * np.pi)
    ys = systems.PointVortices().reference(TS, y0)
    np.testing.assert_allclose(ys, np.stack([np.cos(turned), np.sin(turned)], axis=2), atol=1e-12)


def test_elliptic_functions_agree_with_scipy():
    m = np.array([0.0, 1e-9, 0.1, 0.5, 0.9, 0.999, 1 - 1e-9, 1.0])[:, None]
    u = np.linspace(-9.0, 9.0, 41)
    ours = jacobi_elliptic(jnp.asarray(u), jnp.asarray(m))
    theirs = scipy.special.ellipj(u, m)[:3]
    np.testing.assert_allclose(ours, theirs, atol=1e-13)


def test_elliptic_integrals_agree_with_scipy():
    m = np.array([0.0, 1e-9, 0.1, 0.5, 0.9, 0.999, 1 - 1e-9])[:, None]
    np.testing.assert_allclose(complete_elliptic(jnp.asarray(m)), scipy.special.ellipk(m))
    assert complete_elliptic(jnp.array(1.0)) == np.inf
    phi, m = np.broadcast_arrays(np.linspace(-7.0, 7.0, 41), m)
    ours = incomplete_elliptic(jnp.asarray(phi), jnp.asarray(m))
    np.testing.assert_allclose(ours, scipy.special.ellipkinc(phi, m), rtol=1e-13)
