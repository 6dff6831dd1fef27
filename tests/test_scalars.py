"""A function written out in scalars is the same function, or it is not written out at all."""

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
import pytest

from diffrax_conserve._projection import scalars as _scalars
from diffrax_conserve._projection.scalars import components, in_scalars, written_out

MATRIX = np.arange(6.0).reshape(2, 3) / 7
Y = jnp.asarray(MATRIX)


def primitives(fn, y):
    """The names of all primitives, with the largest number of axes of their outputs."""
    eqns = jax.make_jaxpr(fn)(y).eqns
    return {e.primitive.name: max(len(v.aval.shape) for v in e.outvars) for e in eqns}


FUNCTIONS = {
    "sum": lambda y: jnp.sum(y * MATRIX),
    "sums along axes": lambda y: (jnp.sum(y, axis=0), jnp.sum(y, axis=1), jnp.max(y), jnp.prod(y)),
    "matrix product": lambda y: y @ MATRIX.T,
    "product of three axes": lambda y: jnp.tensordot(jnp.stack([y, 2 * y]), y, axes=([2], [1])),
    "batched product": lambda y: jnp.einsum("ij,ij->i", y, y),
    "outer product": lambda y: jnp.tensordot(y, y, axes=0),
    "slices": lambda y: (y[1:, ::2], y[:, -1], y[0, 1], y[::-1]),
    "pairs": lambda y: y[:, None, 0] - y[None, :, 1] + jnp.eye(2, dtype=y.dtype),
    "stacks": lambda y: jnp.concatenate([jnp.stack([y[0], y[1]]), y.T.reshape(2, 3)], axis=1),
    "elementary functions": lambda y: (
        jnp.exp(jnp.sin(y)) / jnp.hypot(y, 2.0) ** 3 + jnp.log1p(y**2)
    ),
    "comparisons": lambda y: jnp.where(y > 0, jnp.sqrt(jnp.abs(y)), jnp.clip(y, -0.5, 0.5)),
    "matrices of constants": lambda y: (
        y @ (jnp.tril(jnp.ones((3, 3), y.dtype)) - 2 * jnp.eye(3, dtype=y.dtype)),
        y * (1 - (jnp.arange(6) + 1).reshape(2, 3) ** 3) / jnp.sqrt(jnp.full(3, 2.0, y.dtype)),
    ),
    "a constant": lambda y: (y, jnp.ones(2, y.dtype)),
    "an inner jit": lambda y: jax.jit(jnp.linalg.norm)(y),
    "another dtype": lambda y: jnp.sum(y.astype(jnp.float16)),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_and_shapes_are_the_same(name):
    y = jr.normal(jr.key(0), (2, 3), np.float32)
    fn = FUNCTIONS[name]
    out, expected = jax.jit(lambda y: written_out(fn, y))(y), fn(y)
    assert jtu.tree_structure(out) == jtu.tree_structure(expected)
    for a, b in zip(jtu.tree_leaves(out), jtu.tree_leaves(expected), strict=True):
        assert a.shape == b.shape
        assert a.dtype == b.dtype
        tolerance = 8 * float(jnp.finfo(b.dtype).eps)
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("name", sorted(FUNCTIONS.keys() - {"a constant"}))
def test_all_of_it_is_in_scalars(name):
    y = jnp.ones((2, 3))
    written = in_scalars(FUNCTIONS[name], y, limit=10_000)
    found = primitives(lambda y: jtu.tree_leaves(written(components(y))), y)
    arrays = {name for name, rank in found.items() if rank > 0}
    assert arrays <= {"reshape", "slice", "unstack", "squeeze"}, arrays


@jax.custom_jvp
def own_derivative(x):
    return x


own_derivative.defjvp(lambda primals, tangents: (primals[0], 7 * tangents[0]))


NOT_WRITTEN_OUT = {
    "a derivative of one's own": lambda y: own_derivative(y) * 2,
    "control flow": lambda y: jax.lax.fori_loop(0, 3, lambda _, x: x * y, y),
    "too many operations": lambda y: jnp.tile(y, (20, 20)) ** 2 + 1,
    "a random key": lambda y: y + jr.normal(jr.key(0), y.shape, y.dtype),
}


@pytest.mark.parametrize("name", NOT_WRITTEN_OUT)
def test_what_is_not_known_stays_as_it_is(name):
    fn = NOT_WRITTEN_OUT[name]
    y = jr.normal(jr.key(0), (2, 3))
    assert in_scalars(fn, y) is None
    np.testing.assert_array_equal(written_out(fn, y), fn(y))
    # What was begun before the unknown primitive was met is dead code.
    assert primitives(lambda y: written_out(fn, y), y).keys() >= primitives(fn, y).keys()


def test_what_it_closes_over_is_differentiated():
    def fn(inertia, y):
        return written_out(lambda y: jnp.sum(inertia * y**2), y)

    inertia, y = jnp.array([1.0, 2.0, 3.0]), jnp.array([4.0, 5.0, 6.0])
    np.testing.assert_allclose(jax.jit(jax.grad(fn))(inertia, y), y**2, rtol=1e-15)


# ---- What jax may change ----


def test_an_invented_primitive_is_not_written_out():
    invented = jex.Primitive("invented")
    invented.def_impl(lambda x: x)
    invented.def_abstract_eval(lambda x: x)
    assert in_scalars(invented.bind, Y) is None


@pytest.mark.parametrize("name", ["reduce_sum", "broadcast_in_dim", "dot_general", "transpose"])
def test_an_invented_parameter_is_not_written_out(name, monkeypatch):
    """A new jax may give a primitive a parameter that changes what it means."""
    original = _scalars._WriteOut._equation

    def with_parameter(self, eqn, inputs):
        if eqn.primitive.name == name:
            eqn = eqn.replace(params=eqn.params | {"invented": 1})
        return original(self, eqn, inputs)

    def fn(y):
        return jnp.sum((y @ MATRIX.T).T + jnp.ones(2), axis=0)

    assert in_scalars(fn, Y) is not None
    monkeypatch.setattr(_scalars._WriteOut, "_equation", with_parameter)
    assert in_scalars(fn, Y) is None
