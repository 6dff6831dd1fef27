"""The solver state of a `ManifoldProjection`, and how a step fails: why, and whether a shorter step
could be better.

diffrax forgets the solver state of a step that it rejects. So no rule here can count attempts or
compare a step with the last one that failed: each must tell from the step alone.
"""

import dataclasses
from typing import Any, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._constants import ROUNDOFF
from .._custom_types import Args, BoolScalarLike, Manifold, RealScalarLike, Values, Y
from .._manifold import Constraint, is_entry, named_entries
from .._options import found_in
from .._printing import is_traced, names_at, printed
from .._projection.base import ProjectionInfo
from .._step.equations import Equations
from .._step.roundoff import hidden_scale
from .._tree import ravel, real_view, unflatten
from .diffrax_private import register

_ENTRY = (
    "`print(diffrax_conserve.statistics(sol))`, with `SaveAt(solver_state=True)`, names the entry."
)
FIRST = register(
    "a step cannot start: its state is off the manifold. At the start of a solve it must satisfy "
    "each `Constraint`: `y0, info = diffrax_conserve.project(manifold, y0, t=t0, args=args)`, of a "
    "`DAE` `y0 = dae.consistent(x, z, t=t0, args=args)`; a quantity that keeps the "
    "value that it has at the start is a `FirstIntegral`. A solve that continues from a "
    "`solver_state` keeps the values of that one: leave it out if you have changed the state, "
    "`args` or the manifold. After a jump of the vector field end the solve there, `project`, and "
    "go on. " + _ENTRY,
    "the projection of a step failed: a state is not finite, or a function of the manifold there, "
    "or the iteration diverged. At the first step look for NaN in `y0` and `args`, for "
    "derivatives of roots and norms at zero, which are infinite or NaN, and for overflow, in "
    "float32 of squares of 2e19: use other units, or float64. Later check the vector "
    "field and `fn`, and take smaller steps. " + _ENTRY,
    "the projection of a step failed: the correction is a larger share of the step than "
    "`max_correction` allows. Check by `check_invariance` that the quantity is conserved at all, "
    "take smaller steps, or pass another `max_correction`.",
    "the projection of a step failed: the manifold was not reached. Take smaller steps, as "
    "`diffrax.PIDController` does, or pass `projection=diffrax_conserve.Newton()` to a "
    "`ManifoldProjection`, which copes with far candidates. Check by `check_invariance` that the "
    "quantity is conserved at all. If terms that cancel inside `fn` have grown since the start, "
    "pass `atol`. " + _ENTRY,
    "the projection of a step failed: the manifold was not reached, by the first step or however "
    "short a step. What is asked for may contradict itself: a `value` that no state has, `lower` "
    "or `upper` that exclude the manifold, or entries that exclude each other, such as all "
    "integrals of a single wave on a coarse grid, for which `SimplifiedNewton(metric=1.0)` may do: "
    "change or leave out one of them. Or the quantity is not conserved, as `check_invariance` "
    "tells, or a first step of fixed length is too long. " + _ENTRY,
)
# The causes of a failure, in the order of their messages above, of which `FIRST` is the first. Zero
# is no failure.
_START, _NOT_FINITE, _TOO_FAR, _NOT_REACHED, _NO_STATE = range(1, 6)
# Corrections are usually shorter than the error estimate of their step, because that is the
# estimate for a method of lower order. If one is longer by this factor, the quantity is probably
# not conserved. The number is a choice.
_SUSPICIOUS = 10


@final
class ProjectionStatistics(eqx.Module):
    """Totals over the accepted steps of a solve, and of earlier solves that it continues.

    **Attributes:**

    - `num_projections`: the number of projected steps.
    - `num_iterations`, `max_iterations`: the number of iterations of all, and the largest of one.
    - `residual_before`, `residual_after`, `correction`, `roundoff`: the largest of each, as in a
        `ProjectionInfo`.
    - `error`: the largest error estimate of the wrapped solver, in the metric of `correction`; NaN
        if it has none. Corrections that are much longer tell that a quantity is not conserved.
    - `worst`: the position in `names` of the entry of the manifold that failed last; -1 if none
        failed. `print` shows the name.
    - `names`: the names of the entries of the manifold, such as `manifold['energy']`.
    - `bounded`: whether the projection has bounds, where corrections may be long.
    """

    num_projections: Int[Array, "..."]
    num_iterations: Int[Array, "..."]
    max_iterations: Int[Array, "..."]
    residual_before: Float[Array, "..."]
    residual_after: Float[Array, "..."]
    correction: Float[Array, "..."]
    roundoff: Float[Array, "..."]
    error: Float[Array, "..."]
    worst: Int[Array, "..."]
    names: tuple[str, ...] = eqx.field(static=True)
    bounded: bool = eqx.field(static=True)

    @classmethod
    def zero(
        cls, manifold: Manifold, dtype: jnp.dtype, bounded: bool = False
    ) -> "ProjectionStatistics":
        count, size, worst = jnp.asarray(0), jnp.zeros((), dtype), jnp.asarray(-1)
        names = tuple(name for name, _ in named_entries(manifold))
        sizes = size, size, size, size, size * jnp.nan
        return cls(count, count, count, *sizes, worst=worst, names=names, bounded=bounded)

    def __str__(self) -> str:
        if is_traced(self):
            return repr(self)
        rows = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        rows["worst"] = names_at(self.worst, rows.pop("names"))
        bounded = rows.pop("bounded")
        if not rows["worst"]:
            del rows["worst"]
        if np.all(np.isnan(self.error)):
            del rows["error"]
        text = printed("projections of the accepted steps", rows)
        suspicious = np.asarray(self.correction) > _SUSPICIOUS * np.asarray(self.error)
        if not bounded and np.any(suspicious):
            text += (
                "\nCorrections are far longer than the error estimates of the steps explain:"
                "\ncheck by `check_invariance` that the quantities are conserved."
            )
        return text

    def add(
        self, info: ProjectionInfo, due: Array | None, error: Array | None
    ) -> "ProjectionStatistics":
        """The statistics after one more step, with the report on its projection, whether one was
        due, and the length of the error estimate."""
        return ProjectionStatistics(
            self.num_projections + (1 if due is None else due.astype(int)),
            self.num_iterations + info.num_steps,
            jnp.maximum(self.max_iterations, info.num_steps),
            jnp.maximum(self.residual_before, info.residual_before),
            jnp.maximum(self.residual_after, info.residual_after),
            jnp.maximum(self.correction, info.correction),
            jnp.maximum(self.roundoff, info.roundoff),
            self.error if error is None else jnp.fmax(self.error, error),
            jnp.where(info.ok, self.worst, info.worst),
            self.names,
            self.bounded,
        )


def statistics(sol: dfx.Solution) -> ProjectionStatistics:
    """The statistics of the projections of a solve.

    They are part of the state of a `ManifoldProjection`, which `diffeqsolve` returns by
    `SaveAt(solver_state=True)`; otherwise they are not computed. Rejected steps appear only in
    `sol.stats["num_rejected_steps"]`. A failed step that ends a solve is kept: `print` then names
    the entry of the manifold that failed.

    **Arguments:**

    - `sol`: the solution from `diffrax.diffeqsolve`, or a batch of them from `jax.vmap`.

    **Returns:**

    A `ProjectionStatistics`.

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

    - `inner`: the state of the wrapped solver.
    - `values`, `hidden`, `gained`: as in a `Target`.
    - `motion`: the unit of each component, see `motion_after`, the largest of all steps so far;
      zero before the first step.
    - `end`: the numbers of the state at which the last step ended; infinite before the first.
    - `first_step`: the length of the first step that was tried, a scale of the times of the solve.
    - `num_steps`: counted only if not every step is projected.
    - `preferred`: the changes of the state in the last two steps, if linear invariants are kept.
    """

    inner: Any
    values: Float[Array, " m"]
    hidden: Float[Array, " m"]
    gained: Float[Array, "2 m"] | None
    motion: Float[Array, " n"]
    end: Float[Array, " n"]
    first_step: RealScalarLike
    num_steps: Int[Array, ""] | None
    statistics: ProjectionStatistics
    preferred: Float[Array, "k n"] | None = None

    def motion_after(self, change: Float[Array, " n"], end: Y) -> Float[Array, " n"]:
        """`motion` after a step to `end` that changed the components by `change`.

        The unit of a quantity in a step is the geometric mean of its size and its change. Each
        alone misleads: a quantity may be large only because its origin is far away, and it may
        hardly change for a while, at a turning point, or along the axis of a rotation. Where
        squares are exchanged, as by the components of a vector of constant length, or between a
        place and a velocity by an energy, `|y Δy|` is the same on both sides.

        A quantity that hardly changes counts as changing by `ε` of itself. This floor is inside the
        root, so that the derivative stays finite, and the root is that of a ratio, so that nothing
        is squared and a power of two as a unit changes no bit.
        """
        size = largest_of_vector(jnp.maximum(jnp.abs(ravel(end)), change), end)
        change = largest_of_vector(change, end)
        share = change / jnp.where(size > 0, size, 1)
        share = jnp.maximum(share, float(jnp.finfo(change.dtype).eps))
        return jnp.maximum(self.motion, size * jnp.sqrt(share))

    def next(self, **fields: Any) -> "State":
        """The state after a step, with these fields."""
        num_steps = None if self.num_steps is None else self.num_steps + 1
        return dataclasses.replace(self, num_steps=num_steps, **fields)


def largest_of_vector(x: Float[Array, " n"], like: Y) -> Float[Array, " n"]:
    """Each component of `x` replaced by the largest of its quantity, where `x` is the `ravel` of a
    state like `like`.

    Each component of a state is a quantity, with a unit of its own: here, and wherever this package
    judges errors or drifts. There is one exception. A correction in unlike units would turn a
    vector, such as the place of a body. So in a state of several leaves, in which unlike quantities
    can be kept apart, each vector along the last axis of a leaf is corrected in one unit. A single
    array may hold unlike quantities.
    """
    if len(jtu.tree_leaves(like)) == 1:
        return x

    def largest(part: Array) -> Array:
        axis = -1 if part.ndim else None
        most = jnp.max(part, axis=axis, keepdims=True, initial=0)
        return jnp.broadcast_to(most, part.shape)

    return ravel(jtu.tree_map(largest, unflatten(x, jax.eval_shape(real_view, like))))


def distances(start: Y, end: Y) -> Float[Array, " n"]:
    """How far each component moves from one state to another."""
    return jnp.abs(ravel(end) - ravel(start))


def started(
    values: Values, manifold: Manifold, t: RealScalarLike, y: Y, args: Args
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """The conserved values, and the part of their scales that the gradients do not show."""
    _, _, hidden = hidden_scale(manifold, t, y, args)
    return ravel(values).astype(hidden.dtype), hidden


def violated(equations: Equations, manifold: Manifold, y: Float[Array, " n"]) -> Bool[Array, ""]:
    """Whether a state is off the manifold by more than its tolerance, and than `√ε`, relative to
    the sizes of the terms and of their changes in a step. An integral with a `value` of its own
    does not count: a solve may start elsewhere. Nor does one whose gradient is not finite, as that
    of the speed is at rest. `√ε` is usually much larger than the tolerance of a projection,
    because initial states are often given with a few digits less. The changes count because all
    terms may be roundoff at one state, such as those of `q · v = 0` where a component of a pendulum
    passes zero.
    """
    g, jacobian = equations.linearise(y)
    scale = equations.scale(jacobian, y)
    limit = jnp.maximum(float(jnp.finfo(y.dtype).eps) ** 0.5 * scale, equations.tolerance(scale))
    entries = jtu.tree_leaves(manifold, is_leaf=is_entry)
    counts = [eqx.filter_eval_shape(part, y).size for part in equations.parts]
    of_entries = lambda fn: np.repeat([fn(entry) for entry in entries], counts)  # noqa: E731
    unknown = jnp.isnan(limit) & ~of_entries(lambda entry: isinstance(entry, Constraint))
    return jnp.any(of_entries(must_start_on) & ~unknown & ~(jnp.abs(g) <= limit))


def must_start_on(entry: Any) -> bool:
    """Whether the first state of a solve must be on an entry of the manifold."""
    return isinstance(entry, Constraint) or entry.value is None


def cause_of_failure(
    ok: Bool[Array, ""],
    cannot_start: Bool[Array, ""],
    values: Float[Array, " m"],
    found: Float[Array, " n"],
    too_far: BoolScalarLike = False,
    hopeless: BoolScalarLike = False,
) -> Int[Array, ""]:
    """Why a step failed, 0 if it did not. What it has `found` must be finite. It is `hopeless` if a
    shorter one would hardly help."""
    # A sum is finite only if all its terms are. It is one kernel, a test of each component is two.
    finite, known = jnp.abs(jnp.sum(found)) < jnp.inf, jnp.all(jnp.isfinite(values))
    cause = jnp.where(ok, 0, jnp.where(hopeless, _NO_STATE, _NOT_REACHED))
    cause = jnp.where(ok & too_far, _TOO_FAR, cause)
    cause = jnp.where(cannot_start, _START, cause)
    return jnp.where(known & (finite | (cause == 0)), cause, _NOT_FINITE)


def is_final(
    state: State, t0: RealScalarLike, t1: RealScalarLike, change: Array, candidate: Y
) -> Bool[Array, ""]:
    """Whether a step that failed is so short that no shorter one is better.

    A controller answers a failed step by a shorter one. That ends when a step moves each component
    by no more than roundoff, or when no time passes. Time is compared with the length of the first
    step too, because many solves start at zero, beside which every step is long.
    """
    size, eps = jnp.abs(ravel(candidate)), lambda x: float(jnp.finfo(jnp.result_type(x)).eps)
    still = jnp.all(change <= ROUNDOFF * eps(size) * size)
    time = jnp.maximum(jnp.abs(t1), state.first_step)
    return still | (jnp.abs(t1 - t0) <= ROUNDOFF * eps(t1) * time)
