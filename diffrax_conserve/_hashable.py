"""Modules that can be keys and static arguments of `jax.jit`, whatever they hold."""

from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.tree_util as jtu
import numpy as np


class Hashable(eqx.Module):
    """A module that is hashable although it holds dictionaries, lists or arrays.

    Two are equal if their structures and leaves are. Arrays are compared by their values, which
    tracers do not have: these are compared by identity. The comparison is that of numpy, so that
    it has a truth value while JAX traces a function too. As for any key, what is held must not be
    changed in place afterwards.
    """

    def __hash__(self) -> int:
        return hash_of(self)

    def __eq__(self, other: object) -> bool:  # pyright: ignore[reportIncompatibleMethodOverride]
        if type(self) is not type(other):
            return False
        (ours, structure), (others, other_structure) = map(jtu.tree_flatten, (self, other))
        return structure == other_structure and all(map(_same_leaf, ours, others))


def hash_of(tree: Any) -> int:
    """A hash of a tree, the same for arrays of the same shape and dtype."""
    leaves, structure = jtu.tree_flatten(tree)
    return hash((structure, *map(_hash_of_leaf, leaves)))


def is_array(x: Any) -> bool:
    """Whether `x` is an array of JAX or of numpy, and not a number of Python."""
    return isinstance(x, jax.Array | np.ndarray | np.generic)


def _hash_of_leaf(leaf: Any) -> int:
    if is_array(leaf):
        return hash((leaf.shape, np.dtype(leaf.dtype)))
    try:
        return hash(leaf)
    except TypeError:
        return id(leaf)


def _same_leaf(a: Any, b: Any) -> bool:
    if a is b:
        return True
    if isinstance(a, jax.core.Tracer) or isinstance(b, jax.core.Tracer):
        return False
    arrays = [is_array(x) for x in (a, b)]
    if any(arrays):
        return all(arrays) and a.dtype == b.dtype and np.array_equal(a, b)
    return bool(a == b)
