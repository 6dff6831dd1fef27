"""What a `ManifoldProjection` carries from step to step."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._custom_types import Values
from .._projection import ProjectionInfo
from .initial import Initial
from .statistics import ProjectionStatistics


class State(eqx.Module):
    """The state of the wrapped solver, and the bookkeeping of the projections."""

    inner: Any
    values: Values
    # What their rates have added to them, by itself: of each step it is little beside the value.
    gained: Values | None
    num_steps: Array | None  # counted only if not every step is projected
    statistics: ProjectionStatistics
    initial: Initial

    def next(self, inner: Any, gained: Values | None, info: ProjectionInfo) -> "State":
        num_steps = None if self.num_steps is None else self.num_steps + 1
        offset = jnp.where(info.num_steps > 0, 0, self.initial.offset)
        initial = Initial(self.initial.cause, self.initial.position, offset)
        return State(inner, self.values, gained, num_steps, self.statistics.add(info), initial)
