"""A projection that the user writes down is used as it is, and checked."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..problems import solve

SPHERE = {"square": dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))}


def rescale(t, y, args, values):
    return y * jnp.sqrt(values["square"] / jnp.sum(y**2))


def rotation(t, y, args):
    return args * jnp.stack([y[1], -y[0]])


def run(projection, y0, args, **kwargs):
    solver = dfc.ManifoldProjection(dfc.RK4(), SPHERE, projection=projection)
    return solve(rotation, solver, y0, args=args, **kwargs)


def test_it_agrees_with_newton_and_so_do_its_derivatives():
    def total(y, value, projection):
        found, _ = dfc.project(SPHERE, y, value={"square": value}, projection=projection)
        return jnp.sum(found**3)

    gradient = jax.jit(jax.value_and_grad(total, (0, 1)), static_argnums=2)
    y, value = jnp.array([3.0, 4.1]), jnp.array(25.0)
    closed, newton = (gradient(y, value, p) for p in (dfc.ClosedForm(rescale), dfc.Newton()))
    for a, b in zip(jax.tree.leaves(closed), jax.tree.leaves(newton), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_a_wrong_formula_fails(errors_raise):
    with pytest.raises(eqx.EquinoxRuntimeError, match="was not reached"):
        run(dfc.ClosedForm(lambda t, y, args, values: 1.01 * y), jnp.array([3.0, 4.0]), 1.0)


def test_wrong_input_is_explained():
    for fn in (lambda t, y, args, values: (y,), lambda t, y, args, values: y[:1]):
        with pytest.raises(ValueError, match="`fn` of a `ClosedForm` returned"):
            run(dfc.ClosedForm(fn), jnp.array([3.0, 4.0]), 1.0)
