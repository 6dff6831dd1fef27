"""The target of the projections of a solver, shared by the end of a step and its inside."""

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree, Real

from .._balance import integrated_rates
from .._custom_types import Args, Manifold, RealScalarLike, Y
from .._manifold import evaluate, is_entry
from .._tree import ravel, real_view, tree_all_finite, unflatten, unravel
from .base import AbstractProjection, Problem, ProjectionInfo
from .equations import equations_of
from .step import Step


class Target(eqx.Module):
    """Everything that a projection needs except the time and the candidate.

    **Attributes:**

    - `values`: the conserved values at the start of the solve.
    - `sampled`: the measured part of the scales.
    - `direction`: -1 if the solver's time is the negative of the manifold's, otherwise 1.
    - `gained`: the integrals of the rates of the manifold since the start of the solve.
    """

    projection: AbstractProjection
    manifold: Manifold
    values: Float[Array, " m"]
    sampled: Float[Array, " m"]
    args: Args
    direction: Real[Array, ""]
    gained: Float[Array, " m"] | None = None

    def advanced(
        self, start: RealScalarLike, end: RealScalarLike, path: Callable[[RealScalarLike], Y]
    ) -> "Target":
        """The target at `end`, at the end of a step or inside it, given the `path` of the solution
        from `start`."""
        if self.gained is None:
            return self
        gained = integrated_rates(self.manifold, start, end, path, self.args, self.direction)
        gained = self.gained + ravel(gained).astype(self.gained.dtype)
        return dataclasses.replace(self, gained=gained)

    def step(
        self,
        start: RealScalarLike,
        end: RealScalarLike,
        y0: Y,
        error: Y | None,
        path: Callable[[], dfx.AbstractLocalInterpolation],
    ) -> Step | None:
        """The `Step` for a projection whose `sees_step` is true, otherwise `None`."""
        if not self.projection.sees_step:
            return None
        start, end = start * self.direction, end * self.direction
        error = None if error is None else ravel(error)
        return Step(start, end, ravel(y0), error, path(), self.direction)

    def project(
        self, t: RealScalarLike, candidate: Y, step: Step | None = None
    ) -> tuple[Y, ProjectionInfo]:
        return _project(self, t * self.direction, candidate, step)

    def project_if(
        self, due: Bool[Array, ""] | None, t: RealScalarLike, candidate: Y, step: Step | None = None
    ) -> tuple[Y, ProjectionInfo]:
        """As `project` where a projection is `due`; otherwise the candidate, if it is finite."""
        if due is None:
            return self.project(t, candidate, step)
        needed = due | ~tree_all_finite(candidate)
        like = eqx.filter_eval_shape(self.project, t, candidate, step)[1]
        idle = jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), like)
        idle = dataclasses.replace(idle, ok=jnp.asarray(True))
        return lax.cond(needed, lambda: self.project(t, candidate, step), lambda: (candidate, idle))


@eqx.filter_jit  # diffrax traces a step three times; a jitted function is traced only once
def _project(
    target: Target, t: RealScalarLike, candidate: Y, step: Step | None
) -> tuple[Y, ProjectionInfo]:
    values = target.values if target.gained is None else target.values + target.gained
    problem = problem_of(
        target.projection, target.manifold, values, target.sampled, t, candidate, target.args, step
    )
    y, info = target.projection.solve(problem, ravel(candidate))
    return unravel(y, problem.like), info


def problem_of(
    projection: AbstractProjection,
    manifold: Manifold,
    values: Float[Array, " m"],
    sampled: Float[Array, " m"],
    t: RealScalarLike,
    like: Any,
    args: Args,
    step: Step | None = None,
) -> Problem:
    """The problem of a projection at a time, for states like `like`."""
    like = jax.eval_shape(lambda: like)
    equations = equations_of(manifold, values, t, like, args, sampled)
    weights = inverse_metric(projection.metric, like)
    flat, _ = jtu.tree_flatten_with_path(manifold, is_leaf=is_entry)
    keys = tuple(_key(path[0]) if path else None for path, _ in flat)
    shaped = unflatten(values, jax.eval_shape(lambda y: evaluate(manifold, t, y, args), like))
    equations = dataclasses.replace(equations, weights=weights)
    return Problem(equations, t, args, shaped, like, keys, step)


def _key(entry: Any) -> Any:
    return getattr(entry, "key", getattr(entry, "idx", getattr(entry, "name", None)))


def inverse_metric(metric: PyTree[ArrayLike] | None, like: Any) -> Float[Array, " n"] | None:
    """`M⁻¹` as a vector; an infinite weight freezes its component."""
    if metric is None:
        return None
    view = jax.eval_shape(real_view, like)
    return ravel(
        jtu.tree_map(
            lambda weight, x: jnp.broadcast_to(1 / jnp.asarray(weight, x.dtype), x.shape),
            metric,
            view,
        )
    )
