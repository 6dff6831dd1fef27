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

from .._custom_types import Args, RealScalarLike, Values, Y
from .._tree import tree_all_finite, tree_dot, tree_sub, working_dtype
from ._elimination import Vector
from ._jacobian import AbstractJacobian, Joined


class Failure(eqx.Module):
    """The constraint with the largest relative residual after a projection that failed, and why.

    All in one number, so that a solver carries no more than that from step to step.

    **Attributes:**

    - `code`: 0 if the projection succeeded.
    - `index`: the position of the constraint among the scalar ones, in the order in which the
        manifold is flattened; 0 if the projection succeeded.
    - `decade`: the order of magnitude of its residual relative to its scale, `⌊log10⌋`, from -16
        to 3, beyond which it is cut off; -17 if the projection succeeded.
    - `nonfinite`: whether the candidate or its residual was not finite.
    - `result`: an `optimistix.RESULTS`.
    """

    code: Int[Array, ""]

    @classmethod
    def none(cls) -> "Failure":
        return cls(jnp.asarray(0, jnp.int32))

    @classmethod
    def of(
        cls, before: Vector, scale_before: Vector, after: Vector, scale_after: Vector
    ) -> "Failure":
        """Of the residuals before and after, which can be larger, the smaller ones count."""
        relative = [_relative(before, scale_before), _relative(after, scale_after)]
        relative = [jnp.where(jnp.isnan(x), jnp.inf, x) for x in relative]
        smaller = jnp.minimum(*relative)
        index = jnp.argmax(smaller)
        bounded = jnp.clip(smaller[index], 10.0 ** DECADES[0], 10.0 ** DECADES[-1])
        decade = jnp.floor(jnp.log10(bounded)).astype(int) - DECADES[0]
        unsatisfied = jnp.where(tree_all_finite(after), _UNSATISFIED, _DIVERGED)
        reason = jnp.where(tree_all_finite(before), unsatisfied, _NONFINITE)
        code = reason | decade << _REASON_BITS | index << _REASON_BITS + _DECADE_BITS
        return cls(code.astype(jnp.int32))

    def unless(self, success: Bool[Array, ""]) -> "Failure":
        return Failure(jnp.where(success, 0, self.code))

    @property
    def index(self) -> Int[Array, ""]:
        return self.code >> _REASON_BITS + _DECADE_BITS

    @property
    def decade(self) -> Int[Array, ""]:
        decade = self.code >> _REASON_BITS & (1 << _DECADE_BITS) - 1
        return jnp.where(self.code == 0, -1, decade) + DECADES[0]

    @property
    def nonfinite(self) -> Bool[Array, ""]:
        return self._reason == _NONFINITE

    @property
    def result(self) -> optx.RESULTS:
        kinds = optx.RESULTS
        result = kinds.where(self.code == 0, kinds.successful, kinds.nonlinear_max_steps_reached)
        result = kinds.where(self._reason == _DIVERGED, kinds.nonlinear_divergence, result)
        return kinds.where(self.nonfinite, kinds.nonfinite, result)

    @property
    def _reason(self) -> Int[Array, ""]:
        return self.code & (1 << _REASON_BITS) - 1


DECADES = range(-16, 4)
_UNSATISFIED, _DIVERGED, _NONFINITE = 1, 2, 3
_REASON_BITS, _DECADE_BITS = 2, 5


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
    - `rank`: the numerical rank of the Gram matrix of the constraints at the candidate. With more
        than 128 constraints, where it is not formed, their number.
    - `failure`: what was left of the worst constraint, if the projection failed.
    """

    result: optx.RESULTS
    num_steps: Int[Array, ""]
    residual_before: Float[Array, ""]
    residual_after: Float[Array, ""]
    correction: Float[Array, ""]
    rank: Int[Array, ""]
    failure: "Failure"


class Problem(eqx.Module):
    """What a projection solves.

    **Attributes:**

    - `residual`: `y ↦ g(y)`, of shape `(m,)`, whose closed-over arrays are part of its PyTree.
    - `magnitude`: the absolute conserved values, as `residual` returns them.
    - `weights`: `M⁻¹`, the inverse of the metric, shaped like the state.
    - `t`, `args`, `values`: the time, the parameters, and the conserved values, shaped like the
        manifold, from which `residual` was made.
    """

    residual: Joined
    magnitude: Vector
    weights: Y
    t: RealScalarLike
    args: Args
    values: Values


class AbstractProjection(eqx.Module):
    """A way to return from a candidate to the manifold."""

    metric: eqx.AbstractVar[PyTree[ArrayLike] | None]

    @abc.abstractmethod
    def solve(self, problem: Problem, candidate: Y) -> tuple[Y, ProjectionInfo]:
        """The state on the manifold that belongs to `candidate`, shaped like it.

        Never raises at run time; `info.result` is successful only if every residual is small.
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

    return scale, tolerance(scale, rtol, atol)


def tolerance(scale: Vector, rtol: float | Array | None, atol: float | Array | None) -> Vector:
    """The residual at which each constraint counts as satisfied."""

    def combine(x: Array) -> Array:
        relative = ROUNDOFF_MULTIPLE * jnp.finfo(x.dtype).eps if rtol is None else rtol
        absolute = 0 if atol is None else atol
        return jnp.asarray(relative, x.dtype) * x + jnp.asarray(absolute, x.dtype)

    return jtu.tree_map(combine, scale)


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
    num_steps: Int[Array, ""],
    candidate: Y,
    y: Y,
    before: Vector,
    after: Vector,
    scale: Vector,
    rank: Int[Array, ""],
    failure: Failure,
) -> ProjectionInfo:
    """The `ProjectionInfo` of a projection from `candidate` to `y`."""
    correction = tree_sub(y, candidate)
    return ProjectionInfo(
        result=failure.result,
        num_steps=num_steps,
        residual_before=largest_relative(before, scale),
        residual_after=largest_relative(after, scale),
        correction=jnp.sqrt(tree_dot(correction, correction, working_dtype(y))),
        rank=rank,
        failure=failure,
    )


def largest_relative(residual: Vector, scale: Vector) -> Float[Array, ""]:
    """The largest residual relative to its scale."""
    return jnp.max(_relative(residual, scale))


def _relative(residual: Vector, scale: Vector) -> Float[Array, " m"]:
    def relative(g: Array, s: Array) -> Array:
        tiny = jnp.finfo(s.dtype).tiny
        return jnp.atleast_1d(jnp.abs(g) / jnp.maximum(s, tiny))

    return jnp.concatenate(jtu.tree_leaves(jtu.tree_map(relative, residual, scale)))
