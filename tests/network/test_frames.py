"""Frames: a flow map commutes with the symmetries of its equations, whatever its weights."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..learned import CORES, LORENZ, SMALL, flow_map, states
from ..problems import difference, largest, refused
from ..thinned import some_of

VORTICES = dfc.systems.PointVortices()
STEP = 0.125


def framed(order=0, system=VORTICES, **options):
    taylor = dfc.learned.Taylor(system.vector_field, order) if order else None
    options = SMALL | dict(taylor=taylor, frame=system.frame, key=jr.key(0)) | options
    return dfc.DeepONet(states(system=system), STEP, **options)


def transformed(y, order=(1, 2, 0), angle=0.7, scale=1.3, shift=(0.3, -2.0)):
    """The same vortices under other names, turned, shifted and scaled."""
    turn = jnp.array([[jnp.cos(angle), -jnp.sin(angle)], [jnp.sin(angle), jnp.cos(angle)]])
    return scale * (y[jnp.array(order)] @ turn.T + jnp.array(shift))


def reflected(y, angle=0.7, scale=1.3, mirror=-1.0):
    """The same orbit turned, seen in a mirror, and larger."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    matrix = jnp.array([[c, -s], [s, c]]) @ jnp.diag(jnp.array([mirror, 1.0]))
    q, p = y
    return scale * q @ matrix.T, p @ matrix.T / jnp.sqrt(scale)


# What does not change the equations, how much slower it then is, and the roundoff.
SYMMETRIES = {
    "vortices": (VORTICES, transformed, 1.3**2, 1e-12),
    "kepler": (dfc.systems.Kepler(mu=1.7), reflected, 1.3**1.5, 1e-13),
}


@some_of("core, order", [("product", 0), ("concatenated", 1), ("gated", 2)], ids=CORES, period=3)
@pytest.mark.parametrize("name", [pytest.param("vortices", marks=pytest.mark.slow), "kepler"])
def test_untrained_it_commutes_with_the_symmetries(name, core, order):
    system, moved, slower, tolerance = SYMMETRIES[name]
    network, y0s = framed(order, system, core=core), states(system=system, seed=3)
    step = jax.jit(jax.vmap(lambda y, h: network(y, h), in_axes=(0, None)))
    found, expected = step(jax.vmap(moved)(y0s), 0.05 * slower), jax.vmap(moved)(step(y0s, 0.05))
    assert difference(found, expected) < tolerance * (1 + largest(expected))


def test_it_starts_at_its_state_and_keeps_the_centre():
    network = framed(1)
    y0s = states(system=VORTICES, seed=3)
    step = jax.jit(jax.vmap(lambda y, h: network(y, h), in_axes=(0, None)))
    np.testing.assert_array_equal(step(y0s, 0.0), y0s)
    slope = jax.jit(jax.jacfwd(lambda h: network(VORTICES.y0, h)))(0.0)
    np.testing.assert_allclose(
        slope, VORTICES.vector_field(0.0, VORTICES.y0, None), rtol=1e-13, atol=1e-14
    )
    ys = step(y0s, STEP)
    assert jnp.max(jnp.abs(ys - y0s)) > 1e-3
    np.testing.assert_allclose(jnp.mean(ys, axis=1), jnp.mean(y0s, axis=1), rtol=0, atol=1e-14)


def test_its_domain_is_one_of_shapes():
    network = framed()
    y0s = states(system=VORTICES)
    contains = jax.jit(jax.vmap(lambda y: network.domain.contains(y)))
    np.testing.assert_array_equal(contains(y0s), True)
    moved = jax.vmap(lambda y: transformed(y, scale=1 + 1e-9))(y0s)
    np.testing.assert_array_equal(contains(moved), True)
    # Larger is slower, which is a part of what is known; smaller is faster.
    np.testing.assert_array_equal(contains(10 * y0s), True)
    np.testing.assert_array_equal(contains(0.01 * y0s), False)


def test_a_repeated_flow_map_is_its_steps_one_after_the_other():
    inner = flow_map(taylor=dfc.learned.Taylor(LORENZ.vector_field))
    repeated = dfc.learned.Repeated(inner, 3)
    inner = eqx.filter_jit(inner)
    assert (repeated.max_step, repeated.order) == (0.75, 1)
    assert repeated.domain is repeated.flow_map.domain
    expected = LORENZ.y0
    for _ in range(3):
        expected = inner(expected, 0.2)
    np.testing.assert_allclose(repeated(LORENZ.y0, 0.6), expected, rtol=1e-13)
    gradient = jax.jit(jax.grad(lambda y: jnp.sum(repeated(y, 0.6))))(LORENZ.y0)
    chain = jax.grad(lambda y: jnp.sum(inner(inner(inner(y, 0.2), 0.2), 0.2)))
    chained = jax.jit(chain)(LORENZ.y0)
    np.testing.assert_allclose(gradient, chained, rtol=1e-12)


Frame, OTHERS = dfc.learned.Frame, dfc.systems.PointVortices((1.0, 1.0))
LAYER = dfc.learned.ConservativeLayer(VORTICES.manifold)


test_mistakes_are_named = refused(
    (lambda: OTHERS.frame(OTHERS.y0), ValueError, "three vortices of equal strengths"),
    (lambda: framed(frame=1.0), TypeError, None),
    (lambda: framed(frame=lambda y: y), TypeError, r"must return a .*learned\.Frame`"),
    (lambda: framed(frame=lambda y: Frame(y[0], jnp.ones((3, 2)))), ValueError, r"`\(6, m\)`"),
    (lambda: framed(layer=LAYER), ValueError, "cannot have a `layer`"),
    (lambda: framed()(jnp.ones(4), 0.1), ValueError, "for states of 6 numbers"),
    (lambda: dfc.learned.Repeated(flow_map(), 0), ValueError, "`count` .*must be a positive"),
    (lambda: dfc.learned.Repeated(lambda y0, h: y0, 2), TypeError, "which is no flow map"),
)


# ---- The flow map of the zoo that has the frame of Kepler's problem ----


SYSTEM, ZOO = dfc.systems.Kepler(), dfc.load_pretrained("kepler")


@jax.jit
@jax.vmap
def longest_step(y):
    """Its error, whether its start is in the domain, and whether all of it is."""
    exact = jax.tree.map(lambda x: x[0], SYSTEM.solution(jnp.array([0.5]), y))
    differences = jax.tree.map(jnp.subtract, ZOO(y, 0.5), exact)
    error = jnp.linalg.norm(jnp.concatenate(differences))
    return error, ZOO.domain.contains(y), ZOO.inside(y, 0.5)


def orbits(sizes):
    """Random states on orbits with these major semi-axes."""
    q, p = states(sizes.size, SYSTEM)
    energy = jax.vmap(SYSTEM.energy, (None, 0, None))(0.0, (q, p), None)
    factor = (-2 * energy * sizes)[:, None]
    return q * factor, p / jnp.sqrt(factor)


def test_its_step_against_keplers_equation():
    """For all that are not too eccentric."""
    error, starts, stays = map(np.asarray, longest_step(orbits(np.linspace(0.8, 1.2, 1000))))
    np.testing.assert_array_equal(starts, stays)
    assert starts.sum() > 500
    error = error[starts]
    assert 0 < np.sqrt(np.mean(error**2)) < 1e-6
    assert np.max(error) < 2e-5


@pytest.mark.slow
def test_a_step_is_outside_if_it_leaves_the_domain_between_its_quarters():
    """Small orbits can start inside and be too fast a quarter later."""
    size = np.geomspace(0.05, 20, 8000)
    y0s = orbits(size)
    error, starts, stays = longest_step(y0s)
    error, left = error / np.maximum(size, 1), np.asarray(starts & ~stays)
    assert left.sum() > 100
    assert np.max(error[left]) > 1  # and without that it would be wrong
    assert np.max(error[np.asarray(stays)]) < 1e-4

    y0 = jax.tree.map(lambda x: x[np.argmax(np.where(left, error, 0))], y0s)
    solver = dfc.DeepONetSolver(ZOO, outside="fail")
    sol = dfx.diffeqsolve(
        dfx.ODETerm(SYSTEM.vector_field), solver, 0.0, 0.5, 0.5, y0,
        saveat=dfx.SaveAt(t1=True, solver_state=True), throw=False,
    )  # fmt: skip
    assert sol.result != dfx.RESULTS.successful
    assert dfc.learned.steps_outside(sol).number == 1
