"""Vector fields from what they conserve."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from diffrax_conserve import systems
from diffrax_conserve.systems import hamiltonian_vector_field, nambu_vector_field

CANONICAL = (
    "harmonic-oscillator",
    "double-pendulum",
    "kepler",
    "henon-heiles",
    "toda-lattice",
)


@pytest.mark.parametrize("name", CANONICAL)
def test_hamiltons_equations_agree_with_those_written_by_hand(name):
    system = systems.get(name)
    f = hamiltonian_vector_field(system.energy)
    y = system.sample(jr.key(0))
    written, derived = (g(0.0, y, None) for g in (system.vector_field, f))
    assert jax.tree.structure(written) == jax.tree.structure(derived)
    np.testing.assert_allclose(ravel_pytree(derived)[0], ravel_pytree(written)[0], atol=1e-14)


def test_nambus_equations_are_those_of_lorenz():
    system = systems.ConservativeLorenz(sigma=1.3, rho=0.7)
    y = system.sample(jr.key(0))
    f = nambu_vector_field(system.casimir, system.energy)
    np.testing.assert_allclose(f(0.0, y, None), system.vector_field(0.0, y, None), atol=1e-15)


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
