"""The solver state of a `ManifoldProjection`."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._custom_types import Values
from .._projection.base import ProjectionInfo
from .initial import Initial
from .statistics import ProjectionStatistics


class State(eqx.Module):
    """The state of the wrapped solver, and the bookkeeping of the projections."""

    inner: Any
    values: Values
    # The integrals of the rates. They are kept apart from the values, because the increment of one
    # step is small and would lose digits.
    gained: Values | None
    num_steps: Array | None  # counted only if not every step is projected
    statistics: ProjectionStatistics
    initial: Initial

    def next(self, inner: Any, gained: Values | None, info: ProjectionInfo) -> "State":
        num_steps = None if self.num_steps is None else self.num_steps + 1
        offset = jnp.where(info.num_steps > 0, 0, self.initial.offset)
        initial = Initial(self.initial.cause, self.initial.position, offset)
        return State(inner, self.values, gained, num_steps, self.statistics.add(info), initial)
