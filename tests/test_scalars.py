"""What `print` shows, and functions that are written out in scalars."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_conserve as dfc

from .thinned import some_of

MATRIX = np.arange(6.0).reshape(2, 3) / 7


@jax.custom_jvp
def own_derivative(x):
    return x


own_derivative.defjvp(lambda primals, tangents: (primals[0], 7 * tangents[0]))

FUNCTIONS = {
    "sum": lambda y: jnp.sum(y * MATRIX),
    "sums along axes": lambda y: (jnp.sum(y**2, 0), jnp.sum(y, 1), jnp.max(y), jnp.prod(y)),
    "matrix product": lambda y: y @ MATRIX.T,
    "product of three axes": lambda y: jnp.tensordot(jnp.stack([y, 2 * y]), y, axes=([2], [1])),
    "batched product": lambda y: jnp.einsum("ij,ij->i", y, y),
    "outer product": lambda y: jnp.tensordot(y, y, axes=0),
    "slices": lambda y: (y[1:, ::2], y[:, -1], y[0, 1], y[::-1]),
    "pairs": lambda y: y[:, None, 0] - y[None, :, 1] + jnp.eye(2, dtype=y.dtype),
    "stacks": lambda y: jnp.concatenate([jnp.stack([y[0], y[1]]), y.T.reshape(2, 3)], axis=1),
    "elementary functions": lambda y: jnp.exp(jnp.sin(y)) / jnp.hypot(y, 2.0) ** 3 + jnp.log1p(y),
    "comparisons": lambda y: jnp.where(y > 0.5, jnp.sqrt(jnp.abs(y)), jnp.clip(y, -0.5, 0.5)),
    "matrices of constants": lambda y: (
        y @ (jnp.tril(jnp.ones((3, 3), y.dtype)) - 2 * jnp.eye(3, dtype=y.dtype)),
        y * (1 - (jnp.arange(6) + 1).reshape(2, 3) ** 3) / jnp.sqrt(jnp.full(3, 2.0, y.dtype)),
    ),
    "an inner jit": lambda y: jax.jit(jnp.linalg.norm)(y),
    "a derivative of one's own": lambda y: own_derivative(y) * 2,
    "control flow": lambda y: jax.lax.fori_loop(0, 3, lambda _, x: x * y, y),
    "too many operations": lambda y: jnp.tile(y, (20, 20)) ** 2 + 1,
    "a random key": lambda y: y + jr.normal(jr.key(0), y.shape, y.dtype),
}


@some_of("name", FUNCTIONS, ids=FUNCTIONS, period=4)
def test_a_batch_keeps_the_function(name):
    """All outputs of it, in one integral with different weights."""

    def integral(t, y, args):
        flat = jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(FUNCTIONS[name](y))])
        return jnp.sum(jnp.cos(jnp.arange(flat.size)) * flat) + jnp.sum(y**2)

    ys = 1 + 0.3 * jr.uniform(jr.key(1), (4, 2, 3))
    values = jax.vmap(lambda y: integral(0.0, y, None))(ys)
    candidates = ys + 1e-4 * jr.normal(jr.key(2), ys.shape)

    def project(y, value):
        found, info = dfc.project(dfc.FirstIntegral(integral, value=value), y)
        return found, info.ok

    found, ok = jax.jit(jax.vmap(project))(candidates, values)
    assert np.all(ok)
    np.testing.assert_allclose(
        jax.vmap(lambda y: integral(0.0, y, None))(found), values, rtol=1e-13, atol=1e-13
    )
    alone, _ = jax.jit(project)(candidates[2], values[2])
    np.testing.assert_allclose(found[2], alone, rtol=1e-12)


def test_zero_times_nan_is_nan_in_a_batch_too():
    """So that no lane conserves a function that has no value."""
    integral = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2) + 0 * jnp.sqrt(y[0]), value=1.0)
    project = lambda y: dfc.project(integral, y, projection=dfc.SimplifiedNewton())[1].ok  # noqa: E731
    np.testing.assert_array_equal(
        jax.jit(jax.vmap(project))(jnp.array([[0.6, 0.8], [-0.6, 0.8], [-0.6, 0.79]])),
        [True, False, False],
    )


# ---- What `print` shows of the records of the package ----


SPHERE = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)


def test_the_report_is_printed_as_success_or_failure_or_by_its_ranges():
    on_two = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 2)
    _, info = dfc.project((SPHERE, on_two), jnp.array([1.0, 2.0, 2.0]))
    assert str(info).startswith("NOT PROJECTED: ")
    assert f"worst            {int(info.worst)}" in str(info)
    lines = str(dfc.project(SPHERE, jnp.array([1.0, 2.0, 2.0]))[1]).splitlines()
    assert lines[0] == "projected"
    assert "  correction       2.0e+00" in lines
    project = jax.jit(jax.vmap(lambda y: dfc.project(SPHERE, y)))
    ys = jnp.array([[2.0, 0.0], [5.0, 0.0], [jnp.nan, 0.0]])
    assert str(project(ys)[1]).startswith("2 of 3 projections succeeded")
    _, info = project(ys.at[2, 0].set(3.0))
    assert "correction       1.0e+00 to 4.0e+00" in str(info)
