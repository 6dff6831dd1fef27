"""Linear combinations of the state that a vector field conserves, and that no manifold declares.

Every Runge-Kutta method keeps them to roundoff. A projection on something else may not.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Args
from .._manifold import slope_of
from .._numerics.metric import broadcast_option
from .._tree import ravel, tree_size, unravel

# With more components than these none is searched for.
_COMPONENTS = 300
# Slopes are taken at so many states for each component, and moved by this share of the size of the
# component: states of one trajectory may lie in a plane that the field leaves elsewhere.
_STATES, _BESIDE = 3, 1e-2
# What is smaller than this, relative to the largest, counts as roundoff: of singular values of the
# slopes, and of differences between gradients at several states.
_ZERO = 1e-9


def linear_invariants(
    vector_field: Callable, ts: Array, ys: Any, sizes: Any, args: Args, entries: dict[str, Any]
) -> np.ndarray:
    """Orthonormal rows `c` with `c · (f / sizes) = 0` at states near `ys`, which are not in the
    span of the gradients of those entries that are linear.

    `ys` has leading axes over lanes and times. Rows are combinations of components in units of
    their `sizes`.
    """
    if tree_size(sizes) > _COMPONENTS:
        return np.zeros((0, 0))
    like = jtu.tree_map(lambda y: y[0, 0], ys)
    units = np.asarray(broadcast_option("sizes", sizes, like))
    times, states = _states(ts, ys, units)
    found = _measured(vector_field, entries, times, states, like, jnp.asarray(units), args)
    slopes, gradients = map(np.asarray, found)
    finite = np.isfinite(slopes).all(axis=1) & np.isfinite(gradients).all(axis=(1, 2))
    if not finite.any():
        return np.zeros((0, units.size))
    declared = _constant(gradients[finite])
    return _without(_null_space(slopes[finite]), declared)


@eqx.filter_jit
def _measured(
    vector_field: Callable,
    entries: dict[str, Any],
    ts: Array,
    states: Array,
    like: Any,
    units: Array,
    args: Args,
) -> tuple[Array, Array]:
    """The slopes at the states and the gradients of the entries, in units of the components."""

    @jax.vmap
    def measured(t: Array, x: Array) -> tuple[Array, Array]:
        def values(x: Array) -> Array:
            return ravel([entry.fn(t, unravel(x, like), args) for entry in entries.values()])

        slope = ravel(slope_of(vector_field, t, unravel(x, like), args))
        return slope / units, jax.jacrev(values)(x) * units

    return measured(ts, states)


def changes(
    invariants: Float[np.ndarray, "k n"], ys: Any, sizes: Any
) -> Float[np.ndarray, " lanes"]:
    """The largest change of the combinations in each lane, relative to the sizes of components."""
    leaves = jtu.tree_leaves(ys)
    if not len(invariants):
        return np.zeros(len(leaves[0]))
    units = np.asarray(broadcast_option("sizes", sizes, jtu.tree_map(lambda y: y[0, 0], ys)))
    x = np.asarray(jax.vmap(jax.vmap(ravel))(jtu.tree_map(jnp.asarray, ys))) / units
    moved = np.linalg.norm((x - x[:, :1]) @ invariants.T, axis=2)
    return moved.max(axis=1)


def _states(ts: Array, ys: Any, units: np.ndarray) -> tuple[Array, Array]:
    """States near those of the trajectories, with their times."""
    x = np.asarray(jax.vmap(jax.vmap(ravel))(jtu.tree_map(jnp.asarray, ys)))
    lanes, times, size = x.shape
    count = _STATES * size + 20
    rng = np.random.default_rng(0)
    lane, time = rng.integers(lanes, size=count), rng.integers(times, size=count)
    moved = x[lane, time] + _BESIDE * units * rng.normal(size=(count, size))
    return jnp.asarray(ts)[time], jnp.asarray(moved)


def _null_space(slopes: np.ndarray) -> np.ndarray:
    largest = np.abs(slopes).max(axis=1, keepdims=True)
    _, sizes, rows = np.linalg.svd(
        slopes / np.where(largest > 0, largest, 1.0), full_matrices=False
    )
    return rows[sizes <= _ZERO * sizes.max(initial=0)]


def _constant(gradients: np.ndarray) -> np.ndarray:
    """The gradients that are the same at all states, as rows of length one."""
    apart = np.abs(gradients - gradients[:1]).max(axis=(0, 2))
    length = np.linalg.norm(gradients[0], axis=1)
    rows = gradients[0][(apart <= _ZERO * length) & (length > 0)]
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def _without(space: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The part of a space, given by orthonormal rows, that is orthogonal to other rows."""
    if not len(space) or not len(rows):
        return space
    _, sizes, basis = np.linalg.svd(rows @ space.T)
    rank = int(np.sum(sizes > _ZERO**0.5))
    return basis[rank:] @ space
