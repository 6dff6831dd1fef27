"""The target of the projections of a solver, shared by the end of a step and its inside."""

import dataclasses
from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Real

from .._balance import integrated_rates
from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._tree import real_view, tree_add, tree_all_finite, tree_stop_gradient, working_dtype
from .base import AbstractProjection
from .equations import Outcome, ProjectionInfo
from .project import apply
from .residual import largest, measure, relative
from .step import Step

# diffrax traces a step three times; a jitted function is traced only once.
_apply = eqx.filter_jit(apply)


class Target(eqx.Module):
    """Everything that a projection needs except the time and the candidate.

    **Attributes:**

    - `direction`: -1 if the solver's time is the negative of the manifold's, otherwise 1.
    - `gained`: the integrals of the rates of the manifold since the start of the solve.
    - `limit`: a larger correction is a failure.
    - `threshold`: a candidate whose relative residual is at most this is not projected.
    - `due`: if false, no finite candidate is projected.
    """

    projection: AbstractProjection
    manifold: Manifold
    values: Values
    args: Args
    direction: Real[Array, ""]
    gained: Values | None = None
    limit: Real[Array, ""] | None = None
    threshold: RealScalarLike | None = None
    due: Bool[Array, ""] | None = None

    @property
    def now(self) -> Values:
        """The current conserved values."""
        return self.values if self.gained is None else tree_add(self.values, self.gained)

    def advanced(
        self, start: RealScalarLike, end: RealScalarLike, path: Callable[[RealScalarLike], Y]
    ) -> "Target":
        """The target at `end`, at the end of a step or inside it, given the `path` of the solution
        from `start`."""
        if self.gained is None:
            return self
        gained = integrated_rates(self.manifold, start, end, path, self.args, self.direction)
        return dataclasses.replace(self, gained=tree_add(self.gained, gained))

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
        return Step(start, end, real_view(y0), real_view(error), path(), self.direction)

    def project(
        self,
        t: RealScalarLike,
        candidate: Y,
        anchor: Y | None = None,
        step: Step | None = None,
    ) -> tuple[Y, ProjectionInfo]:
        t, now = t * self.direction, self.now

        def projected() -> tuple[Y, ProjectionInfo]:
            return _apply(
                self.projection, self.manifold, now, t, candidate, self.args, anchor, step
            )

        if self.threshold is None and self.due is None:
            return projected()
        given = tree_stop_gradient((self.manifold, now, t, candidate, self.args))
        residual = largest(relative(*measure(*given)))
        needed = jnp.asarray(True) if self.due is None else self.due
        if self.threshold is not None:
            needed = needed & ~(residual <= self.threshold)
        needed = needed | ~tree_all_finite(candidate)
        return lax.cond(needed, projected, lambda: (candidate, _untouched(candidate, residual)))

    def too_far(self, info: ProjectionInfo) -> Bool[Array, ""]:
        """Whether a successful projection moved the state by more than `limit`."""
        if self.limit is None:
            return jnp.asarray(False)
        return info.ok & ~(info.correction <= self.limit)


def _untouched(candidate: Y, residual: Real[Array, ""]) -> ProjectionInfo:
    zero, outcome = jnp.asarray(0), Outcome.success()
    residual = residual.astype(working_dtype(candidate))
    return ProjectionInfo(
        outcome.result,
        zero,
        residual,
        residual,
        jnp.zeros_like(residual),
        zero,
        outcome.worst,
    )
