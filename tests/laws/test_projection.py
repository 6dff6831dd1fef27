"""Laws of one projection: what must not change it, and where it must lead."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import diffrax_conserve as dfc

from .common import displaced, every_law_on_every_system, project, within


def plain(system, y, displacement):
    candidate = displaced(y, displacement)
    return candidate, *project(system.manifold, candidate, y)


def idempotent(system, y, displacement):
    _, once, ok1 = plain(system, y, displacement)
    twice, ok2 = project(system.manifold, once, y)
    return ok1 & ok2, twice, once


@within(1e-13)
def a_state_on_the_manifold_is_untouched(system, y, displacement):
    del displacement
    projected, ok = project(system.manifold, y, y)
    return ok, projected, jax.tree.map(jnp.asarray, y)


def linear_combinations_of_the_integrals_change_nothing(system, y, displacement):
    candidate, expected, ok1 = plain(system, y, displacement)

    def fn(*a):
        """All residuals as one vector, kept at its value: `Constraint`s are zero there anyway."""
        return jnp.concatenate([jnp.ravel(entry.fn(*a)) for entry in system.manifold.values()])

    count = fn(0.0, y, None).size
    matrix = jnp.asarray(np.random.default_rng(0).normal(size=(count, count)) + 2 * np.eye(count))
    gradients = jax.jacobian(lambda y: fn(0.0, y, None))(jax.tree.map(jnp.asarray, y))
    terms = jax.tree.map(lambda g, x: jnp.sum(jnp.abs(g * x).reshape(count, -1), 1), gradients, y)
    scale = jnp.abs(fn(0.0, y, None)) + sum(jax.tree.leaves(terms))
    got, ok2 = project(dfc.FirstIntegral(lambda *a: matrix @ (fn(*a) / scale)), candidate, y)
    return ok1 & ok2, got, expected


def rotations_of_the_coordinates_commute(system, y, displacement):
    """The Euclidean projection is geometric."""
    candidate, expected, ok1 = plain(system, y, displacement)
    flat, unravel = ravel_pytree(y)
    shape = flat.size, flat.size
    rotation = jnp.asarray(np.linalg.qr(np.random.default_rng(1).normal(size=shape))[0])

    def there(y):
        return rotation @ ravel_pytree(y)[0]

    def back(z):
        return unravel(rotation.T @ z)

    manifold = {
        name: type(entry)(lambda t, z, args, fn=entry.fn: fn(t, back(z), args))
        for name, entry in system.manifold.items()
    }
    got, ok2 = project(manifold, there(candidate), there(y))
    return ok1 & ok2, back(got), expected


@within(0.0)
def frozen_components_stay(system, y, displacement):
    candidate = displaced(y, displacement)
    weights, unravel = ravel_pytree(jax.tree.map(jnp.ones_like, candidate))
    metric = unravel(weights.at[0].set(jnp.inf))
    got, ok = project(system.manifold, candidate, y, dfc.SimplifiedNewton(metric=metric))
    return ok, ravel_pytree(got)[0][:1], ravel_pytree(candidate)[0][:1]


def the_correction_is_orthogonal_to_the_flow(system, y, displacement):
    """Since `∇I · f = 0`, and the correction is a combination of gradients at the candidate."""
    candidate, got, ok = plain(system, y, displacement)
    correction = ravel_pytree(got)[0] - ravel_pytree(candidate)[0]
    flow = ravel_pytree(system.vector_field(0.0, candidate, None))[0]
    size = jnp.linalg.norm(ravel_pytree(y)[0])
    return ok, 1 + correction @ flow / (size * jnp.linalg.norm(flow)), jnp.ones(())


@within(2e-4)
def single_precision_agrees_with_double(system, y, displacement):
    _, expected, ok1 = plain(system, y, displacement)
    single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (system, y, displacement))
    _, got, ok2 = plain(*single)
    got = jax.tree.map(lambda x: x.astype(jnp.float64), got)
    return ok1 & ok2, got, expected


LAWS = [
    idempotent,
    a_state_on_the_manifold_is_untouched,
    linear_combinations_of_the_integrals_change_nothing,
    rotations_of_the_coordinates_commute,
    frozen_components_stay,
    the_correction_is_orthogonal_to_the_flow,
    single_precision_agrees_with_double,
]
# Its energy is conserved only where its constraints hold, which the candidate does not.
SKIP = {("the_correction_is_orthogonal_to_the_flow", "cartesian-pendulum")}


test_law = every_law_on_every_system(LAWS, SKIP, max_examples=8)
