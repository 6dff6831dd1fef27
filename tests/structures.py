"""A strategy for PyTree structures that repack one state in many ways."""

from typing import Any, NamedTuple

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree


class Packing(NamedTuple):
    """The components of a state in another PyTree, with other nesting and shapes."""

    packed: Any  # both are PyTrees of `jax.ShapeDtypeStruct`
    like: Any

    def pack(self, y):
        return filled(self.packed, y)

    def unpack(self, z):
        return filled(self.like, z)

    def vector_field(self, field):
        return lambda t, z, args: self.pack(field(t, self.unpack(z), args))

    def manifold(self, integrals):
        """With the same names and conserved values."""

        def repacked(entry):
            return lambda t, z, args: entry.fn(t, self.unpack(z), args)

        return {
            name: eqx.tree_at(lambda e: e.fn, entry, repacked(entry))
            for name, entry in integrals.items()
        }


def filled(shapes, y):
    """The numbers of `y`, in order, as arrays of these shapes."""
    return ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes))[1](
        ravel_pytree(y)[0]
    )


def packings(like, max_depth=2):
    """Each triggers a compilation, so draw few. It shrinks to a single vector."""
    shapes = jax.eval_shape(lambda: like)
    vector = jax.eval_shape(lambda: ravel_pytree(like)[0])
    return _trees(vector.size, max_depth, vector.dtype).map(lambda tree: Packing(tree, shapes))


def _trees(size, depth, dtype):
    shapes = [*([()] if size == 1 else []), (size,)]
    shapes += [(n, size // n) for n in range(1, size + 1) if size % n == 0]
    leaf = st.sampled_from(shapes).map(lambda shape: jax.ShapeDtypeStruct(shape, dtype))
    if depth == 0:
        return leaf

    def container(first):
        sizes = [n for n in (first, size - first) if n]
        children = st.tuples(*(_trees(n, depth - 1, dtype) for n in sizes))
        kinds = st.sampled_from([tuple, list, lambda x: dict(zip("ab", x, strict=False))])
        return st.tuples(kinds, children).map(lambda drawn: drawn[0](drawn[1]))

    first = st.integers(1, size - 1) if size > 1 else st.just(1)
    return st.one_of(leaf, first.flatmap(container))
