"""What every system of the catalogue must satisfy."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
import pytest
import scipy.integrate
from jax.flatten_util import ravel_pytree

from diffrax_conserve import check_invariance, systems

from ..thinned import some_of

SYSTEMS = {name: systems.get(name) for name in systems.names()}
every_system = pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS.keys())
some_systems = some_of("system", SYSTEMS.values(), ids=SYSTEMS, period=7)
periodic = [s for s in SYSTEMS.values() if eqx.filter_eval_shape(s.period) is not None]


@eqx.filter_jit
def draw(system, key):
    return jax.vmap(lambda key: system.sample(key))(jr.split(key, 32))


@functools.cache
def samples(name):
    return draw(SYSTEMS[name], jr.key(1))


def changed(system):
    """With other parameters."""
    noise = jr.uniform(jr.key(2), (100,), minval=0.7, maxval=1.3)
    leaves, treedef = jtu.tree_flatten(system)
    leaves = [x * noise[i : i + x.size].reshape(x.shape) for i, x in enumerate(leaves)]
    return jtu.tree_unflatten(treedef, leaves)


def flat_states(ys):
    return np.concatenate([np.reshape(x, (x.shape[0], -1)) for x in jtu.tree_leaves(ys)], axis=1)


def values(manifold, y):
    return {name: entry.fn(0.0, y, None) for name, entry in manifold.items()}


@some_systems
def test_invariants_are_conserved_by_the_equations(system):
    """Also for other parameters."""
    other = changed(system)
    for one, ys in ((system, samples(system.name)), (other, draw(other, jr.key(3)))):
        report = check_invariance(one.vector_field, one.manifold, ys)
        assert report.ok, str(report)
        assert all(entry.defect < 1e-13 for entry in report.entries)


@some_systems
def test_the_manifold_is_functionally_independent(system):
    def flat(y):
        return ravel_pytree(values(system.manifold, y))[0]

    @eqx.filter_jit
    @jax.vmap
    def jacobian(y):
        rows = jax.jacrev(flat)(y)
        rows = jnp.concatenate([x.reshape(x.shape[0], -1) for x in jtu.tree_leaves(rows)], axis=1)
        return rows / jnp.linalg.norm(rows, axis=1, keepdims=True)

    rows = jacobian(samples(system.name))
    assert rows.shape[1] < rows.shape[2]
    assert np.linalg.svd(rows, compute_uv=False).min() > 1e-4


@some_systems
def test_samples_differ_and_are_like_y0(system):
    ys = samples(system.name)
    for x, x0 in zip(jtu.tree_leaves(ys), jtu.tree_leaves(system.y0), strict=True):
        assert x.shape[1:] == x0.shape
        assert x.dtype == x0.dtype == jnp.float64
        assert np.isfinite(x).all()
    assert jtu.tree_structure(ys) == jtu.tree_structure(system.y0)
    assert len(np.unique(flat_states(ys), axis=0)) == 32


@every_system
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_everything_keeps_the_precision_of_the_state_without_implicit_promotion(system, dtype):
    y0 = jtu.tree_map(lambda x: x.astype(dtype), system.y0)
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        out = jax.eval_shape(lambda y: system.vector_field(0.0, y, None), y0)
        kept = jax.eval_shape(lambda y: values(system.manifold, y), y0)
        eqx.filter_eval_shape(system.sample, jr.key(0))
    assert jtu.tree_structure(out) == jtu.tree_structure(y0)
    assert {x.dtype for x in jtu.tree_leaves((out, kept))} == {jnp.dtype(dtype)}


@every_system
def test_the_parameters_inside_the_manifold_can_be_differentiated(system):
    parameters = jtu.tree_leaves(eqx.filter(system, eqx.is_inexact_array))
    for entry in system.manifold.values():
        inside = jtu.tree_leaves(eqx.filter(entry, eqx.is_inexact_array))
        assert len(inside) == len(parameters) > 0


@some_systems
def test_the_reference_agrees_with_an_independent_solver(system):
    system = changed(system)
    ts = np.linspace(0, min(20 * system.dt, system.t1 / 2), 5)
    start = system.sample(jr.key(5))
    y0, unravel = ravel_pytree(start)
    f = jax.jit(lambda y: ravel_pytree(system.vector_field(0.0, unravel(y), None))[0])
    scale = np.abs(y0).max()
    other = scipy.integrate.solve_ivp(
        lambda _, y: f(y), (0, ts[-1]), y0, method="DOP853", rtol=1e-13, atol=1e-15 * scale
    )
    difference = flat_states(system.reference(ts, start))[-1] - other.y[:, -1]
    assert np.abs(difference).max() < 1e-10 * scale


@some_systems
def test_the_reference_starts_at_the_given_state_and_time(system):
    y = jtu.tree_map(lambda x: x[0], samples(system.name))
    ts = 3.0 + system.dt * np.array([0.0, 0.0, 1.0, 2.0, 2.0])
    ys = flat_states(system.reference(ts, y, t0=3.0))
    np.testing.assert_allclose(ys[:2], np.stack([ravel_pytree(y)[0]] * 2), rtol=1e-13, atol=1e-14)
    np.testing.assert_array_equal(ys[3], ys[4])


@some_of("system", periodic, ids=[system.name for system in periodic], period=3)
def test_the_solution_returns_after_a_period(system):
    y0 = jtu.tree_map(lambda x: x[0], samples(system.name))
    for y in (system.y0, y0):
        ys = flat_states(system.reference(np.arange(5.0) * system.period(y), y))
        np.testing.assert_allclose(ys, np.stack([ravel_pytree(y)[0]] * 5), atol=1e-12)


@some_systems
def test_what_is_drawn_and_said_of_a_system(system):
    curves = system.trajectories(samples(system.name))
    assert curves
    assert len(system.axes) in (2, 3)
    for curve in curves.values():
        assert curve.shape == (32, len(system.axes))
    if system.metric is not None:
        shapes = jtu.tree_map(jnp.shape, system.metric)
        assert shapes == jtu.tree_map(jnp.shape, system.y0)
        assert all(np.all(x > 0) for x in jtu.tree_leaves(system.metric))
    # The main job takes a whole number of steps.
    steps = system.t1 / system.dt
    assert abs(steps - round(steps)) < 1e-9
    assert 10 <= steps <= 2000
    assert system.title
    assert system.citation.endswith(".")
    assert system.args is None
    for heading in ("**Manifold**", "**Reference**", "**Samples**", "Source: "):
        assert heading in type(system).__doc__


def test_states_follow_the_default_precision_and_a_reference_needs_double():
    with jax.enable_x64(False):
        for name in systems.names():
            system = systems.get(name)
            sample = eqx.filter_eval_shape(system.sample, jr.key(0))
            leaves = jtu.tree_leaves((system, system.y0, sample))
            assert {x.dtype for x in leaves} == {jnp.dtype(jnp.float32)}
        with pytest.raises(RuntimeError, match="JAX_ENABLE_X64"):
            systems.Kepler().reference([0.0, 1.0])


def test_times_of_a_reference_are_a_list_and_do_not_decrease(errors_raise):
    for ts in (1.0, [], [[0.0, 1.0]]):
        with pytest.raises(ValueError, match="`ts` must be a one-dimensional array"):
            systems.HarmonicOscillator().reference(jnp.asarray(ts))
    with pytest.raises(eqx.EquinoxRuntimeError, match="non-decreasing"):
        systems.HarmonicOscillator().reference(jnp.array([1.0, 0.5]))
