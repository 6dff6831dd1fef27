"""The solver state of a `ManifoldProjection`, how it starts, and the verdict on a step: whether its
projection failed, why, and whether it can be saved."""

import dataclasses
from typing import Any, final

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._manifold import Constraint, is_entry
from .._options import found_in
from .._printing import is_traced, printed
from .._projection.base import ProjectionInfo
from .._projection.roundoff import hidden_scale
from .._tree import ravel, tree_size
from .diffrax_private import register

_SMALLER = (
    "Take smaller steps, or pass `projection=diffrax_conserve.Newton()`, which copes with "
    "far candidates. Check by `check_invariance` that the quantity is conserved at all. "
)
_ENTRY = (
    "`diffrax_conserve.statistics(sol).worst`, with `SaveAt(solver_state=True)`, tells the entry."
)
FIRST = register(
    "the solve cannot start: the initial state violates a `Constraint`, or a function of the "
    "manifold is not finite there. Start on the manifold: "
    "`y0, info = diffrax_conserve.project(manifold, y0, t=t0, args=args)`. " + _ENTRY,
    "the projection of a step failed: the state that the wrapped solver proposed is not finite, or "
    "a function of the manifold there, or the iteration diverged. Check the vector field and `fn`. "
    + _SMALLER
    + _ENTRY,
    "the projection of a step failed: the correction moved the state further than `max_correction` "
    "allows. Perhaps the quantity is not conserved at all, which `check_invariance` tells, or the "
    "state jumped to another part of the manifold. Take smaller steps, or pass another "
    "`max_correction`.",
    "the projection of a step failed: the manifold was not reached. " + _SMALLER + "If it is, the "
    "constraints may contradict each other or the bounds, or terms that cancel inside `fn` have "
    "grown since the start of the solve: pass `atol`, or start again from here. " + _ENTRY,
)
# The causes of a failure, in the order of their messages.
_START, _NOT_FINITE, _TOO_FAR, _NOT_REACHED = 1, 2, 3, 4


@final
class ProjectionStatistics(eqx.Module):
    """Totals over the accepted steps of a solve, and of earlier solves that it continues.

    **Attributes:**

    - `num_projections`: the number of projected steps.
    - `num_iterations`, `max_iterations`: the number of iterations of all, and the largest of one.
    - `residual_before`, `residual_after`, `correction`, `roundoff`: the largest of each, as in
        [`diffrax_conserve.ProjectionInfo`][].
    - `worst`: the position of the entry of the manifold that failed last, as
        [`diffrax_conserve.entry_name`][] takes it; -1 if none failed.
    """

    num_projections: Int[Array, "..."]
    num_iterations: Int[Array, "..."]
    max_iterations: Int[Array, "..."]
    residual_before: Float[Array, "..."]
    residual_after: Float[Array, "..."]
    correction: Float[Array, "..."]
    roundoff: Float[Array, "..."]
    worst: Int[Array, "..."]

    @classmethod
    def zero(cls, dtype: jnp.dtype) -> "ProjectionStatistics":
        count, size = jnp.asarray(0), jnp.zeros((), dtype)
        return cls(count, count, count, size, size, size, size, jnp.asarray(-1))

    def __str__(self) -> str:
        if is_traced(self):
            return repr(self)
        rows = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        if np.all(np.asarray(self.worst) < 0):
            del rows["worst"]
        return printed("projections of the accepted steps", rows)

    def add(self, info: ProjectionInfo, due: Array | None) -> "ProjectionStatistics":
        return ProjectionStatistics(
            self.num_projections + (1 if due is None else due.astype(int)),
            self.num_iterations + info.num_steps,
            jnp.maximum(self.max_iterations, info.num_steps),
            jnp.maximum(self.residual_before, info.residual_before),
            jnp.maximum(self.residual_after, info.residual_after),
            jnp.maximum(self.correction, info.correction),
            jnp.maximum(self.roundoff, info.roundoff),
            jnp.where(info.ok, self.worst, info.worst),
        )


def statistics(sol: dfx.Solution) -> ProjectionStatistics:
    """The statistics of the projections of a solve.

    They are part of the state of a `ManifoldProjection`, which `diffeqsolve` returns by
    `SaveAt(solver_state=True)`; otherwise they are not computed. Rejected steps appear only in
    `sol.stats["num_rejected_steps"]`. A failed step that ends a solve is kept:
    `entry_name(manifold, int(statistics(sol).worst))` is the name of the entry that failed.

    **Arguments:**

    - `sol`: the solution from `diffrax.diffeqsolve`, or a batch of them from `jax.vmap`.

    **Returns:**

    A [`diffrax_conserve.ProjectionStatistics`][].

    **Raises:**

    `ValueError` if `sol` holds no state of a `ManifoldProjection`, `TypeError` if no solution.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        square = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
        term = diffrax.ODETerm(lambda t, y, args: jnp.array([-y[1], y[0]]))
        solver = dfc.ManifoldProjection(diffrax.Tsit5(), square)
        saveat = diffrax.SaveAt(t1=True, solver_state=True)
        sol = diffrax.diffeqsolve(term, solver, 0, 9, 1.0, jnp.array([1.0, 0.0]), saveat=saveat)
        longest = dfc.statistics(sol).max_iterations
        ```
    """
    return found_in(sol, ProjectionStatistics, "statistics", "a `ManifoldProjection`")


class State(eqx.Module):
    """What later steps need.

    - `values`, `hidden`, `gained`: as in a `Target`; a value is NaN if the solve cannot start.
    - `num_steps`: counted only if not every step is projected.
    - `is_first`: whether no step was made yet, if the first one may have to reach a given `value`.
    """

    inner: Any
    values: Float[Array, " m"]
    hidden: Float[Array, " m"]
    gained: Float[Array, "2 m"] | None
    num_steps: Int[Array, ""] | None
    is_first: Bool[Array, ""] | None
    statistics: ProjectionStatistics

    def next(self, info: ProjectionInfo, due: Array | None, **fields: Any) -> "State":
        num_steps = None if self.num_steps is None else self.num_steps + 1
        idle = False if due is None else ~due
        is_first = None if self.is_first is None else self.is_first & idle
        fields |= dict(num_steps=num_steps, is_first=is_first)
        return dataclasses.replace(self, statistics=self.statistics.add(info, due), **fields)


def started(
    manifold: Manifold, values: Values, t: RealScalarLike, y: Y, args: Args
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """The conserved values, NaN for a `Constraint` that the initial state violates, and the part of
    their scales that the gradients do not show."""
    g, jacobian, hidden = hidden_scale(manifold, t, y, args)
    numbers = ravel(values).astype(g.dtype)
    entries, treedef = jtu.tree_flatten(manifold, is_leaf=is_entry)
    sizes = [tree_size(part) for part in treedef.flatten_up_to(values)]
    must_hold = np.repeat([isinstance(entry, Constraint) for entry in entries], sizes)
    if must_hold.any():
        # A constraint on a component that is zero up to roundoff has a scale too.
        terms = jnp.sum(jnp.abs(jacobian), axis=1) * jnp.max(jnp.abs(ravel(y)), initial=0)
        limit = float(jnp.finfo(g.dtype).eps) ** 0.5 * (hidden + terms)
        numbers = jnp.where(must_hold & ~(jnp.abs(g) <= limit), jnp.nan, numbers)
    return numbers, hidden


def verdict(
    ok: Bool[Array, ""],
    state: State,
    times: tuple[RealScalarLike, RealScalarLike],
    states: tuple[Y, Y, Y],
    error: Y | None,
    max_correction: RealScalarLike | None,
) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """The cause of the failure of a step, 0 if it succeeded, and whether a failure is final. The
    `states` are the last one, the candidate, of which there may be an estimate of its `error`, and
    the result."""
    last, candidate, result = (ravel(y) for y in states)
    info = jnp.finfo(candidate.dtype)
    moved, correction = jnp.abs(candidate - last), jnp.abs(result - candidate)
    size = jnp.abs(candidate)
    # A little less, so that a correction of exactly this share is too long, whatever is rounded.
    share = 0 if max_correction is None else jnp.asarray(0.999 * max_correction, info.dtype)
    share = jnp.minimum(share, float(info.max))  # infinity times zero is NaN
    # One sum is one kernel. In any step a component may change by the root of roundoff, as roundoff
    # alone moves the state where gradients are nearly parallel.
    excess = jnp.sum(correction - jnp.maximum(share * moved, float(info.eps) ** 0.5 * size))
    cause = jnp.where(ok, 0, jnp.where(excess < jnp.inf, _NOT_REACHED, _NOT_FINITE))
    if max_correction is not None:
        too_far = ok & ~(excess <= 0)
        too_far = too_far if state.is_first is None else too_far & ~state.is_first
        cause = jnp.where(too_far, _TOO_FAR, cause)
    lost = jnp.any(jnp.isnan(state.values))
    cause = jnp.where(lost, _START, cause)
    t0, t1 = times
    instant = jnp.abs(t1 - t0) <= 8 * jnp.finfo(jnp.result_type(t1)).eps * jnp.abs(t1)
    # A shorter step is not better where this one is short, and accurate in each component.
    errors = jnp.zeros_like(moved) if error is None else jnp.abs(ravel(error))
    allowed = jnp.where(256 * errors <= moved, 1e-2 * size, -jnp.inf)
    short = jnp.where(cause == _TOO_FAR, jnp.sum(moved - allowed) <= 0, jnp.all(moved <= allowed))
    roundoff = jnp.sum(moved - 64 * float(info.eps) * size) <= 0
    return cause, short | roundoff | instant | lost
