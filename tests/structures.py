"""A strategy for PyTree structures that repack one state in many ways."""

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jaxtyping import ArrayLike, PyTree

from .._custom_types import Args, ConstraintFn, Manifold, RealScalarLike
from .._manifold import Constraint, FirstIntegral, is_entry, rate_of
from .._tree import unflatten


@final
class Restructuring(eqx.Module):
    """The components of a state in another PyTree, with other nesting and shapes.

    Code that handles any PyTree must give the same numbers for both.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import diffrax_conserve.testing as dct
        from hypothesis import given, settings

        kepler = dfc.systems.Kepler()

        @settings(deadline=None, max_examples=5)
        @given(packing=dct.restructurings(kepler.y0))
        def test(packing):
            z = packing.pack(kepler.y0)
            energy = packing.manifold(kepler.manifold["energy"])
            assert energy.fn(0.0, z, None) == kepler.energy(0.0, kepler.y0, None)

        test()
        ```
    """

    # PyTrees of `jax.ShapeDtypeStruct`.
    shapes: Any = eqx.field(static=True)
    like: Any = eqx.field(static=True)

    def pack(self, y: Any) -> Any:
        """`y` in the new structure."""
        return unflatten(ravel_pytree(y)[0], self.shapes)

    def unpack(self, z: Any) -> Any:
        """The state whose packed form is `z`."""
        return unflatten(ravel_pytree(z)[0], self.like)

    def vector_field(self, vector_field: Callable[..., Any]) -> Callable[..., Any]:
        """The vector field `f(t, z, args)` of the packed state."""

        def packed(t: RealScalarLike, z: Any, args: Args) -> Any:
            return self.pack(vector_field(t, self.unpack(z), args))

        return packed

    def manifold(self, manifold: Manifold) -> Manifold:
        """The manifold of the packed state, with the same names and conserved values."""

        def repack(entry: FirstIntegral | Constraint) -> FirstIntegral | Constraint:
            def packed(fn: ConstraintFn) -> ConstraintFn:
                return lambda t, z, args: fn(t, self.unpack(z), args)

            entry = eqx.tree_at(lambda e: e.fn, entry, packed(entry.fn))
            rate = rate_of(entry)
            return entry if rate is None else eqx.tree_at(lambda e: e.rate, entry, packed(rate))

        return jtu.tree_map(repack, manifold, is_leaf=is_entry)

    def __repr__(self) -> str:
        return f"Restructuring({eqx.tree_pformat(self.shapes, struct_as_array=True)})"


def restructurings(
    like: PyTree[ArrayLike], *, max_depth: int = 2
) -> st.SearchStrategy[Restructuring]:
    """Repackings of a state as another PyTree.

    Each structure triggers a compilation, so draw few: `@settings(max_examples=5)`.

    **Arguments:**

    - `like`: a PyTree of floating-point arrays, all of one dtype, or a `ValueError`: a repacked
        leaf could contain several of them.
    - `max_depth`: the largest nesting depth of tuples, lists and dictionaries.

    **Returns:**

    A strategy of [`diffrax_conserve.testing.Restructuring`][]s. It shrinks to a single vector.
    """
    dtypes = {jnp.result_type(x) for x in jtu.tree_leaves(like)}
    if len(dtypes) != 1:
        raise ValueError(
            f"`like` has leaves of the dtypes {sorted(map(str, dtypes))}. `restructurings` repacks "
            "states of one dtype."
        )
    (dtype,) = dtypes
    shapes = jtu.tree_map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x), dtype), like)
    size = sum(jnp.size(x) for x in jtu.tree_leaves(like))
    return _trees(size, max_depth, dtype).map(lambda tree: Restructuring(tree, shapes))


def _trees(size: int, depth: int, dtype: Any) -> st.SearchStrategy[Any]:
    leaf = st.sampled_from(_shapes(size)).map(lambda shape: jax.ShapeDtypeStruct(shape, dtype))
    if depth == 0:
        return leaf
    first = st.integers(1, size - 1) if size > 1 else st.just(1)

    def container(first: int) -> st.SearchStrategy[Any]:
        sizes = [n for n in (first, size - first) if n]
        children = st.tuples(*(_trees(n, depth - 1, dtype) for n in sizes))
        kinds = [tuple, list, lambda x: dict(zip("ab", x, strict=False))]
        return st.tuples(st.sampled_from(kinds), children).map(lambda drawn: drawn[0](drawn[1]))

    return st.one_of(leaf, first.flatmap(container))


def _shapes(size: int) -> list[Any]:
    """Shapes of `size` scalars, the simplest first."""
    matrices = [(n, size // n) for n in range(1, size + 1) if size % n == 0]
    return [*([()] if size == 1 else []), (size,), *matrices]
