r"""The error of a network's solution, computed from its defect.

The exact solution is $u + e$ with the network $u$ and

$$e' = f(t, u + e) - u', \qquad e(t_0) = e_0.$$

This equation is exact, so the truncation error of an RK4 solve for $e$ is relative to $e$: the
estimate has two correct digits both for an accurate solution and for a wrong one. The steps
evaluate the defect at four times as many points as the training, and so between them.
"""

import warnings
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..._custom_types import Y
from ..._tree import unflatten
from .._networks.flat import flatten, stacked_vectors
from .._networks.flow_map import AbstractFlowMap
from .._networks.pinn import Window
from .._networks.trainable import AbstractTrainable, Points
from .._solvers.collocation import rk4_errors
from .objective import Problem


class PathErrors(NamedTuple):
    largest: Float[Array, "paths n"]  # the largest modulus of the error
    end: Float[Array, "paths n"]  # the error at the end
    size: Float[Array, "paths n"]  # the largest modulus of the state


@eqx.filter_jit
def path_errors(
    model: AbstractTrainable,
    problem: Problem,
    paths: Points,
    lengths: Float[Array, " paths"],
    initial: Float[Array, "paths n"],
    substeps: int,
) -> PathErrors:
    """The errors of the paths that start at the times and states of `paths`, with the errors
    `initial`."""
    grid = jnp.linspace(0, 1, 2 * substeps + 1, dtype=lengths.dtype)
    ts = paths.ts[:, None] + lengths[:, None] * grid
    repeated = jtu.tree_map(lambda x: jnp.repeat(x, grid.size, axis=0), paths.y0s)

    def states(ts: Array) -> Y:
        return model.states(Points(ts, repeated), ts, None)

    flat = ts.reshape(-1)
    ys, rates = jax.jvp(states, (flat,), (jnp.ones_like(flat),))
    example = jtu.tree_map(lambda x: x[0], ys)

    def by_time(ys: Y) -> Float[Array, "times paths n"]:
        vectors = stacked_vectors(ys).astype(initial.dtype)
        return jnp.swapaxes(vectors.reshape(*ts.shape, -1), 0, 1)

    us, rates, ts = by_time(ys), by_time(rates), ts.T

    def slope(i: Array, e: Array) -> Array:
        def one(t: Array, y: Array) -> Array:
            return flatten(problem.field(t, unflatten(y, example))).astype(e.dtype)

        return jax.vmap(one)(ts[i], us[i] + e) - rates[i]

    end, history = rk4_errors(slope, initial, (lengths / substeps)[:, None], substeps)
    largest = jnp.maximum(jnp.max(jnp.abs(history), axis=0), jnp.abs(initial))
    return PathErrors(largest, end, jnp.max(jnp.abs(us), axis=0))


def window_errors(window: Window, problem: Problem, initial: Float[Array, " n"]) -> PathErrors:
    """The errors of a window, as a single path, that starts with the error `initial`."""
    paths, lengths = Points(window.start[None], None), window.length[None]
    return path_errors(window, problem, paths, lengths, initial[None], 2 * problem.recipe.points)


@eqx.filter_jit
def roundoff(window: Window, count: int) -> Float[Array, " n"]:
    """The largest roundoff in the states, which is not in the defect: the derivative is computed
    by itself. It is what distinguishes two states at nearly the same time, but for that."""
    ts = window.start + window.length * jnp.linspace(0, 1, count, dtype=window.start.dtype)
    short = jnp.finfo(ts.dtype).eps ** (2 / 3) * window.length
    later = ts + jnp.maximum(short, 2 * jnp.spacing(jnp.abs(ts)))

    def states(ts: Array) -> Array:
        return stacked_vectors(jax.vmap(window)(ts))

    ys, changes = jax.jvp(states, (ts,), (later - ts,))
    return jnp.max(jnp.abs(states(later) - ys - changes), axis=0)


def flow_map_error(flow_map: AbstractFlowMap, problem: Problem, key: PRNGKeyArray) -> float:
    """The root mean square of the error of the longest step, or without a vector field at pairs of
    the data, relative as in `relative`."""
    if problem.vector_field is None:
        assert problem.data is not None
        pairs = problem.data.draw(16 * _STATES, key)
        ends = _ends(flow_map, pairs.y0s, pairs.hs)
        y0s, sizes = pairs.y0s, jnp.abs(stacked_vectors(pairs.y1s))
        errors = stacked_vectors(ends) - stacked_vectors(pairs.y1s)
    else:
        assert problem.sample is not None
        y0s = jax.vmap(problem.sample)(jr.split(key, _STATES))
        start = stacked_vectors(y0s)
        dtype = jnp.result_type(start, np.float16)
        paths = Points(jnp.zeros(_STATES, dtype), y0s)
        lengths = jnp.full(_STATES, flow_map.max_step, dtype)
        found = path_errors(flow_map, problem, paths, lengths, jnp.zeros_like(start), _SUBSTEPS)
        errors, sizes = found.end, found.size
    example = jtu.tree_map(lambda x: x[0], y0s)
    squares = jnp.mean(jnp.square(errors), axis=0)
    return relative(jnp.sqrt(squares), jnp.max(sizes, axis=0), example)


@eqx.filter_jit
def _ends(flow_map: AbstractFlowMap, y0s: Y, hs: Array) -> Y:
    return jax.vmap(flow_map)(y0s, hs)


@eqx.filter_jit
def _off_manifold(model: AbstractTrainable, points: Points) -> Float[Array, ""]:
    starts, ts = model.starts(points), points.ts
    starts = jtu.tree_map(lambda x: jnp.broadcast_to(x, (ts.size, *x.shape[1:])), starts)

    def off(y: Y, t: Array, t0: Array, y0: Y) -> Array:
        equations, vector = model.layer.problem(y, t, (t0, y0))
        return ~equations.is_on_manifold(vector)

    ys = model.states(points, ts, None)
    return jnp.mean(jax.vmap(off)(ys, ts, starts.ts, starts.y0s))


def warn_off_manifold(model: AbstractTrainable, points: Points) -> None:
    """Warns if the layer finds no state on the manifold at some of the points."""
    if model.layer is None or model.layer.steps is not None:
        return
    if (share := float(_off_manifold(model, points))) > 0:
        warnings.warn(
            f"At {share:.2g} of the collocation points the conservative layer finds no state on "
            "the manifold near the output of the network, which it then leaves as it is. Train "
            "longer, or a shorter step or interval.",
            stacklevel=4,
        )


# For a flow map: the number of initial states, and of RK4 steps for the error of each.
_STATES, _SUBSTEPS = 64, 32


def relative(errors: Any, sizes: Any, example: Y) -> float:
    """The largest of `errors`, each relative to the largest component of its leaf; infinity if any
    is not finite."""
    errors, sizes = (unflatten(jnp.asarray(x), example) for x in (errors, sizes))

    def of_leaf(error: Array, size: Array) -> float:
        scale = float(np.max(np.asarray(size, float), initial=0))
        return float(np.max(np.asarray(error, float), initial=0)) / (scale if scale > 0 else 1)

    largest = max(jtu.tree_leaves(jtu.tree_map(of_leaf, errors, sizes)))
    return largest if np.isfinite(largest) else float("inf")
