"""What a solver projects to, and on which terms: the same at the end of a step and inside it."""

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Real

from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._tree import tree_all_finite, working_dtype
from .base import AbstractProjection, Outcome, ProjectionInfo
from .project import apply, relative_residual

# diffrax traces a step three times, but what is compiled on its own is traced once.
_apply = eqx.filter_jit(apply)


class Target(eqx.Module):
    """Everything that a projection needs but the time and the candidate.

    **Attributes:**

    - `direction`: -1 where the solver's time is the negative of the manifold's.
    - `limit`: a larger correction is a failure.
    - `threshold`: a candidate whose relative residual is not larger is left as it is.
    - `due`: if not set, any finite candidate is left as it is.
    """

    projection: AbstractProjection
    manifold: Manifold
    values: Values
    args: Args
    direction: Real[Array, ""]
    limit: Real[Array, ""] | None = None
    threshold: RealScalarLike | None = None
    due: Bool[Array, ""] | None = None

    def project(
        self, t: RealScalarLike, candidate: Y, anchor: Y | None = None
    ) -> tuple[Y, ProjectionInfo]:
        t = t * self.direction
        if self.threshold is None and self.due is None:
            return self._project(t, candidate, anchor)
        residual = relative_residual(self.manifold, self.values, t, candidate, self.args)
        needed = jnp.asarray(True) if self.due is None else self.due
        if self.threshold is not None:
            needed = needed & ~(residual <= self.threshold)
        needed = needed | ~tree_all_finite(candidate)
        return lax.cond(
            needed,
            lambda: self._project(t, candidate, anchor),
            lambda: (candidate, _untouched(candidate, residual)),
        )

    def _project(
        self, t: RealScalarLike, candidate: Y, anchor: Y | None
    ) -> tuple[Y, ProjectionInfo]:
        return _apply(self.projection, self.manifold, self.values, t, candidate, self.args, anchor)

    def too_far(self, info: ProjectionInfo) -> Bool[Array, ""]:
        """Whether a projection that succeeded moved the state further than it may."""
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
