"""The solver state of a `ManifoldProjection`, and how it starts."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._manifold import Constraint, is_entry
from .._projection.base import ProjectionInfo
from .._projection.equations import equations_of, hidden_scale
from .._tree import ravel, tree_stop_gradient
from .statistics import ProjectionStatistics


class State(eqx.Module):
    """What later steps need.

    - `inner`: the state of the wrapped solver.
    - `values`, `sampled`: the conserved values, and the measured part of their scales. A value that
      is NaN tells that the solve cannot start.
    - `gained`: the integrals of the rates, if there are any. They are kept apart from the values,
      because the increment of one step is small and would lose digits.
    - `num_steps`: counted only if not every step is projected.
    - `is_first`: whether no step was made yet, if the first one may have to reach a given `value`.
    """

    inner: Any
    values: Float[Array, " m"]
    sampled: Float[Array, " m"]
    gained: Float[Array, " m"] | None
    num_steps: Int[Array, ""] | None
    is_first: Bool[Array, ""] | None
    statistics: ProjectionStatistics

    def next(
        self, inner: Any, gained: Array | None, info: ProjectionInfo, due: Array | None
    ) -> "State":
        num_steps = None if self.num_steps is None else self.num_steps + 1
        is_first = self.is_first
        if is_first is not None:
            is_first = jnp.zeros_like(is_first) if due is None else is_first & ~due
        statistics = self.statistics.add(info, due)
        return State(inner, self.values, self.sampled, gained, num_steps, is_first, statistics)


def started(
    manifold: Manifold, values: Values, t: RealScalarLike, y: Y, args: Args
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """The conserved values and the measured part of their scales. The value of a `Constraint` that
    the initial state violates by more than the square root of roundoff, relative to the size of its
    terms, is NaN."""
    vector = ravel(y)
    numbers = ravel(values).astype(vector.dtype)
    equations = equations_of(manifold, numbers, jnp.zeros_like(numbers), t, y, args)
    equations, vector = tree_stop_gradient((equations, vector))
    sampled = hidden_scale(equations, vector)
    entries, treedef = jtu.tree_flatten(manifold, is_leaf=is_entry)
    sizes = [
        sum(jnp.size(x) for x in jtu.tree_leaves(part)) for part in treedef.flatten_up_to(values)
    ]
    must_hold = np.repeat([isinstance(entry, Constraint) for entry in entries], sizes)
    if must_hold.any():
        g, jacobian = equations.linearise(vector)
        # A constraint on a component that is zero up to roundoff has a scale too.
        terms = jnp.sum(jnp.abs(jacobian), axis=1) * jnp.max(jnp.abs(vector), initial=0)
        limit = float(jnp.finfo(g.dtype).eps) ** 0.5 * (equations.magnitude + sampled + terms)
        numbers = jnp.where(must_hold & ~(jnp.abs(g) <= limit), jnp.nan, numbers)
    return numbers, sampled
