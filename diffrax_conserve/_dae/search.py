"""The numbers from which the structure of equations is found.

The structure belongs to the equations, so it must not depend on the state or on the arguments at
which somebody asks first. All arrays, the time and the state are replaced by numbers in general
position, at which almost all equations have the rank that they have elsewhere. Python numbers are
part of the equations, as they are for `jax.jit`, and so is what the functions close over.
"""

import concurrent.futures
from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array

from .._constants import MIN_KLU
from .._hashable import is_array
from .._large.klu import available, why_not
from .._tree import irregular_weights
from .elimination import NotFound
from .large_search import find_large_structure
from .places import Numbers
from .reduction import Implicit, Singular, Structure, find_structure

# General numbers of these sizes are tried in turn, until the equations are finite and regular:
# exponentials of large numbers are infinite, and roots and logarithms need some signs.
# Up to this many equations dense matrices do where sparse ones do not: they take half a minute.
MOST_DENSE = 1000
_SIZES = (1.0, 0.1, 10.0, 100.0, -1.0)


class Search:
    """The structure of equations as a function of the numbers in them.

    - `equations`: of a PyTree, of which all arrays are numbers, and Python's floats if `floats`.
    - `mass`: `∂F/∂y'`, if it is given as a matrix.
    """

    def __init__(
        self,
        equations: Callable[[Any], Implicit],
        tree: Any,
        y: Array,
        mass: sp.csr_array | None,
        *,
        floats: bool,
    ):
        self._is_number = lambda x: is_array(x) or (floats and isinstance(x, float | complex))
        numbers, others = eqx.partition(tree, self._is_number)
        leaves, treedef = jtu.tree_flatten(numbers)

        def flat(leaves: Numbers, t: Array, y: Array, slopes: Array) -> Array:
            numbers = jtu.tree_unflatten(treedef, leaves)
            return equations(eqx.combine(numbers, others))(t, y, slopes)

        time, state = jax.ShapeDtypeStruct((), jnp.result_type(float)), _shape(y)
        kinds = [_shape(x) for x in leaves]
        closed = jax.make_jaxpr(flat)(kinds, time, state, state)
        jaxpr, count = closed.jaxpr, len(closed.consts)
        consts = [None if _is_traced(x) else x for x in closed.consts]
        self._kinds = [_shape(x) for x in closed.consts], kinds, time, state
        self._consts, self._mass, self._memory = consts, mass, {}
        unknown = [i for i, x in enumerate(consts) if x is None]
        self._unknown = *unknown, *range(count, count + len(kinds))
        self.is_traced = any(x is None for x in consts)  # what the functions close over

        def given(numbers: Numbers, t: Array, y: Array, slopes: Array) -> Array:
            closed, given = numbers[:count], numbers[count:]
            return jax.core.eval_jaxpr(jaxpr, closed, *given, t, y, slopes)[0]

        self._given = given

    def at(self, tree: Any, t: Array, y: Array, known: Structure | None = None) -> Structure:
        """The structure with these numbers, near a state; the known one, where that fits."""
        closed, kinds, time, _ = self._kinds
        leaves = [x for x in jtu.tree_leaves(tree) if self._is_number(x)]

        def found() -> Structure:
            numbers = _either(self._consts, closed), _either(leaves, kinds)
            return self._found(*numbers, jnp.asarray(t, time.dtype), y, known)

        return _computed(found)

    def general(self, tree: Any) -> Structure:
        """The structure with numbers in general position, except for Python's floats."""
        leaves = [x for x in jtu.tree_leaves(tree) if self._is_number(x)]
        leaves = [None if is_array(x) else x for x in leaves]

        def found() -> Structure:
            first = None
            for size in _SIZES:
                consts, numbers, t, y = general_numbers(self._kinds, size)
                consts, numbers = _either(self._consts, consts), _either(leaves, numbers)
                try:
                    return self._found(consts, numbers, t, y)
                except (Singular, FloatingPointError) as error:
                    first = first or error
            assert first is not None
            raise first

        return _computed(found)

    def _found(
        self, consts: Any, leaves: Any, t: Array, y: Array, known: Structure | None = None
    ) -> Structure:
        numbers = [*consts, *leaves]
        others = [_another(x) for x in numbers]
        given, mass = (self._given, numbers, others, t, y), self._mass
        try:
            return _large_structure(*given, mass, self._unknown, self._memory, known)
        except NotFound:
            if y.size > MOST_DENSE:
                raise
        dense = None if mass is None else mass.toarray()
        return find_structure(*given, dense, self._unknown, self._memory, known)


def _large_structure(equations: Any, numbers: Any, others: Any, t: Any, y: Any, *more: Any) -> Any:
    if y.size < MIN_KLU:
        raise NotFound("they are few")
    if not available(y.dtype):
        raise NotFound(why_not() or "that needs float64 on a CPU")
    return find_large_structure(equations, numbers, others, t, y, *more)


def _is_traced(x: Any) -> bool:
    return isinstance(x, jax.core.Tracer)


def any_traced(tree: Any) -> bool:
    return any(map(_is_traced, jtu.tree_leaves(tree)))


def _shape(x: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x))


def _computed(numbers: Callable[[], Structure]) -> Structure:
    """A result of numbers. JAX traces in one thread, so that another one computes with numbers."""
    with concurrent.futures.ThreadPoolExecutor(1) as thread:
        return thread.submit(numbers).result()


def general_numbers(kinds: Any, size: float) -> Any:
    """Numbers in general position for all leaves together, the same in every call; integers are
    one."""
    leaves, treedef = jtu.tree_flatten(kinds)
    ends = np.cumsum([np.prod(x.shape, dtype=int) for x in leaves])
    pattern = size * (1 + np.asarray(irregular_weights(max(int(ends[-1]), 1), float)) / 2)

    def of(kind: Any, end: int) -> Array:
        if not jnp.issubdtype(kind.dtype, jnp.inexact):
            return jnp.asarray(np.ones(kind.shape, kind.dtype))
        values = pattern[end - np.prod(kind.shape, dtype=int) : end].reshape(kind.shape)
        is_complex = jnp.issubdtype(kind.dtype, jnp.complexfloating)
        return jnp.asarray(values * (1 + 0.5j) if is_complex else values, kind.dtype)

    return treedef.unflatten(map(of, leaves, ends.tolist()))


def _another(x: Any) -> Any:
    x = np.asarray(x)  # for which nothing is compiled
    if jnp.issubdtype(x.dtype, jnp.inexact):
        return np.asarray(1.5 * x + 1, x.dtype)
    return ~x if x.dtype == bool else x + 1


def _either(known: Iterable[Any], general: Iterable[Any]) -> Numbers:
    pairs = zip(known, general, strict=True)
    return [b if a is None else jnp.asarray(a, b.dtype) for a, b in pairs]


def tree_key(tree: Any) -> Any:
    """What tells two trees apart when they are traced: their structure, what is not an array, and
    the shapes of arrays."""
    leaves, treedef = jtu.tree_flatten(tree)
    return treedef, tuple(
        (x.shape, x.dtype) if eqx.is_array_like(x) and hasattr(x, "shape") else x for x in leaves
    )


def lifted(tree: Any) -> Any:
    """The tree with arrays in the place of Python's floats."""

    def lift(x: Any) -> Any:
        is_float = isinstance(x, float | complex) and not is_array(x)
        return np.asarray(x, jnp.result_type(type(x))) if is_float else x

    return jtu.tree_map(lift, tree)
