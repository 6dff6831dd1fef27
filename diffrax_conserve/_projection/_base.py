"""What every projection takes and returns, and when it may call itself successful."""

import abc
import functools as ft

import equinox as eqx
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from .._custom_types import Y
from .._tree import tree_all_finite, tree_dot, tree_sub, working_dtype
from ._jacobian import AbstractJacobian, Residual, Vector


class ProjectionInfo(eqx.Module):
    """How a projection went.

    **Attributes:**

    - `result`: an `optimistix.RESULTS`; `optimistix.RESULTS.successful` if and only if every
        residual is within its tolerance.
    - `num_steps`: how many iterations were made.
    - `residual_before`, `residual_after`: the largest residual of the candidate and of the
        projected state, each relative to the scale of its own constraint,
        $|\\text{conserved value}| + \\sum_k |y_k \\, \\partial g/\\partial y_k|$ plus
        $|\\partial g/\\partial y| \\, |y - \\hat y|$.
    - `correction`: the Euclidean norm of the projected state minus the candidate.
    """

    result: optx.RESULTS
    num_steps: Int[Array, ""]
    residual_before: Float[Array, ""]
    residual_after: Float[Array, ""]
    correction: Float[Array, ""]


class AbstractProjection(eqx.Module):
    """A way to return from a candidate to the manifold."""

    metric: eqx.AbstractVar[PyTree[ArrayLike] | None]

    @abc.abstractmethod
    def solve(
        self, residual: Residual, magnitude: Vector, candidate: Y, weights: Y
    ) -> tuple[Y, ProjectionInfo]:
        """The state on the manifold that belongs to `candidate`.

        **Arguments:**

        - `residual`: `y ↦ g(y)`, whose closed-over arrays are part of its PyTree.
        - `magnitude`: the absolute conserved values, as `residual` returns them.
        - `candidate`: the state to be projected.
        - `weights`: `M⁻¹`, the inverse of the metric, shaped like the candidate.
        """


def positive_weights(metric: PyTree[ArrayLike] | None) -> PyTree[ArrayLike] | None:
    """`metric`, checked at once where its values are known, and otherwise when they are."""
    message = "`metric` has a weight that is not positive. Every weight must be greater than 0."

    def check(weight: ArrayLike) -> ArrayLike:
        if isinstance(weight, jax.core.Tracer):
            return eqx.error_if(weight, ~jnp.all(weight > 0), message)
        if not np.all(np.asarray(weight) > 0):
            raise ValueError(message)
        return weight

    return jtu.tree_map(check, metric)


def tolerances(
    jacobian: AbstractJacobian,
    y: Y,
    candidate: Y,
    weights: Y,
    magnitude: Vector,
    rtol: float | Array | None,
    atol: float | Array | None,
) -> tuple[Vector, Vector]:
    """The scale of each constraint at `y`, and the residual at which it counts as satisfied.

    The scale is what roundoff is relative to: the conserved value, the terms `y_k ∂g/∂y_k` that
    cancel in the residual, and what the correction can contribute to it, `|∂g| |y - ŷ|` in the
    norms of the metric.
    """
    correction = tree_sub(y, candidate)
    squares = jtu.tree_map(
        lambda c, w: jnp.where(w > 0, c / jnp.where(w > 0, w, 1), 0) * c, correction, weights
    )
    dtype = working_dtype(y)
    distance = jnp.sqrt(
        ft.reduce(jnp.add, [jnp.sum(x).astype(dtype) for x in jtu.tree_leaves(squares)])
    )

    def combine(value: Array, terms: Array, squared_norm: Array) -> Array:
        return value + terms + jnp.sqrt(squared_norm) * distance

    scale = jtu.tree_map(combine, magnitude, jacobian.scale(y), jacobian.squared_norms(weights))

    def tolerance(x: Array) -> Array:
        relative = ROUNDOFF_MULTIPLE * jnp.finfo(x.dtype).eps if rtol is None else rtol
        absolute = 0 if atol is None else atol
        return jnp.asarray(relative, x.dtype) * x + jnp.asarray(absolute, x.dtype)

    return scale, jtu.tree_map(tolerance, scale)


# What is accepted. Rounding the state and evaluating the residual cost about one unit of roundoff
# each, so nearly every projection ends well below; where gradients are almost parallel, not much.
ROUNDOFF_MULTIPLE = 16


def within(residual: Vector, tolerance: Vector) -> Bool[Array, ""]:
    """Whether every residual is within its tolerance, which NaN and infinity never are."""
    satisfied = jtu.tree_map(
        lambda g, tol: jnp.all((jnp.abs(g) <= tol) & (tol < jnp.inf)), residual, tolerance
    )
    flags = jtu.tree_leaves(satisfied)
    out = flags[0]
    for flag in flags[1:]:
        out = out & flag
    return out


def report(
    success: Bool[Array, ""],
    num_steps: Int[Array, ""],
    candidate: Y,
    y: Y,
    before: Vector,
    after: Vector,
    scale: Vector,
) -> ProjectionInfo:
    """The `ProjectionInfo` of a projection from `candidate` to `y`."""
    failure = optx.RESULTS.where(
        tree_all_finite(after), optx.RESULTS.nonlinear_max_steps_reached, optx.RESULTS.nonfinite
    )
    correction = tree_sub(y, candidate)
    return ProjectionInfo(
        result=optx.RESULTS.where(success, optx.RESULTS.successful, failure),
        num_steps=num_steps,
        residual_before=largest_relative(before, scale),
        residual_after=largest_relative(after, scale),
        correction=jnp.sqrt(tree_dot(correction, correction, working_dtype(y))),
    )


def largest_relative(residual: Vector, scale: Vector) -> Float[Array, ""]:
    """The largest residual relative to its scale."""

    def relative(g: Array, s: Array) -> Array:
        tiny = jnp.finfo(s.dtype).tiny
        return jnp.max(jnp.abs(g) / jnp.maximum(s, tiny))

    return jnp.max(jnp.stack(jtu.tree_leaves(jtu.tree_map(relative, residual, scale))))
