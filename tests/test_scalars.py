"""A function written out in scalars is the same function, or it is not written out at all."""

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve._manifold import conserved_values
from diffrax_conserve._projection import scalars as _scalars
from diffrax_conserve._projection.equations import equations_of
from diffrax_conserve._projection.scalars import components, in_scalars, joined, written_out
from diffrax_conserve._tree import ravel

from .problems import RIGID_BODY
from .thinned import some_of

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


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_and_shapes_are_the_same(name, dtype):
    y = jr.normal(jr.key(0), (2, 3), dtype)
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


TOO_LARGE = {"toda-lattice"}


@some_of("name", dfc.systems.names(), ids=dfc.systems.names(), period=5)
def test_the_manifolds_of_the_catalogue_and_their_gradients(name):
    system = dfc.systems.get(name)
    y0 = ravel(system.y0)
    values = ravel(conserved_values(system.manifold, 0.0, system.y0, None))
    equations = equations_of(system.manifold, values, 0.0, system.y0, None)
    converted = in_scalars(equations.linearise, y0)
    if y0.size > _scalars.MAX_SCALARS or name in TOO_LARGE:
        assert converted is None
        return
    assert converted is not None
    residual, jacobian = equations.linearise(y0)
    size = float(jnp.max(jnp.abs(values))) + 1
    out = jtu.tree_map(joined, (residual, jacobian), converted(components(y0)))
    np.testing.assert_allclose(out[0], residual, rtol=1e-14, atol=1e-15 * size)
    np.testing.assert_allclose(out[1], jacobian, rtol=1e-13, atol=1e-14 * size)


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


def test_what_would_be_computed_again_for_every_element_stays_as_it_is():
    """36 elements of one product each, where at most 512 // 36 operations are written out."""
    found = primitives(lambda y: written_out(FUNCTIONS["outer product"], y), jnp.ones((2, 3)))
    assert "dot_general" in found


def test_side_effects_happen_once(capsys):
    def fn(y):
        jax.debug.print("seen")
        return 2 * y

    np.testing.assert_array_equal(jax.jit(lambda y: written_out(fn, y))(jnp.ones(2)), [2, 2])
    jax.effects_barrier()
    assert capsys.readouterr().out == "seen\n"


def test_what_it_closes_over_is_differentiated():
    def fn(inertia, y):
        return written_out(lambda y: jnp.sum(inertia * y**2), y)

    inertia, y = jnp.array([1.0, 2.0, 3.0]), jnp.array([4.0, 5.0, 6.0])
    np.testing.assert_allclose(jax.jit(jax.grad(fn))(inertia, y), y**2, rtol=1e-15)


def test_a_batch_is_projected_the_same_without(monkeypatch):
    """Where nothing can be written out, the algorithm is the same, so the result is."""
    states = jnp.array([[1.0, 1.01, 0.99], [1.0, 1.0, 1.02]])
    value = {"energy": 0.3, "momentum": 0.14}

    def projected():
        project = lambda y: dfc.project(  # noqa: E731
            RIGID_BODY, y, value=value, projection=dfc.SimplifiedNewton()
        )
        return jax.jit(lambda: jax.vmap(project)(states)[0])()

    expected = projected()
    monkeypatch.setattr(_scalars, "MAX_SCALARS", 0)
    np.testing.assert_allclose(projected(), expected, rtol=1e-14)


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


EVERYDAY = {
    "dot": lambda y: jnp.dot(y[0], y[1])[None],
    "sum": lambda y: jnp.sum(y)[None],
    "stack": lambda y: jnp.stack([y[0, 0], y[1, 2]]),
    "norm": lambda y: jnp.linalg.norm(y)[None],
    "where": lambda y: jnp.where(y[0] > 1, y[0], 0.0),
    "einsum": lambda y: jnp.einsum("ij,kj->ik", y, y).reshape(-1),
    "matrix product": lambda y: (y @ y.T).reshape(-1),
    "indexing": lambda y: y[1, ::2],
}


@pytest.mark.parametrize("name", EVERYDAY)
def test_everyday_functions_are_written_out(name):
    assert in_scalars(EVERYDAY[name], Y) is not None, (
        f"`{name}` is no longer written out in scalars with this version of jax, so that small "
        "projections that use it are several times slower: look which primitive or parameter in "
        f"{jax.make_jaxpr(EVERYDAY[name])(Y)} is new to `_projection/scalars.py`."
    )
