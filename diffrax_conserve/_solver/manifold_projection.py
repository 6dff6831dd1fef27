"""The wrapper that makes any diffrax solver keep its solution on a manifold."""

import dataclasses
import functools as ft
from typing import Any, NamedTuple, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._balance import has_rates
from .._custom_types import Args, BoolScalarLike, DenseInfo, Manifold, RealScalarLike, Y
from .._interpolation import AsArrays, MakeManifoldInterpolation
from .._manifold import Constraint, check_manifold, entry_names, named_entries
from .._numerics.lanes import any_lane
from .._numerics.metric import Diagonal, Identity
from .._numerics.problem import Problem, Step, step_norm
from .._numerics.report import ProjectionInfo
from .._options import check_number
from .._projection.base import AbstractProjection, check_projection
from .._projection.options import check_state, option
from .._projection.simplified_newton import SimplifiedNewton
from .._time import FieldTime, traced_once
from .._tree import ravel, tree_add, unravel
from .failure import (
    error_for_controller,
    failure_cause,
    is_shortest_step,
    nan_if_failed,
    starts_off_manifold,
)
from .state import State, StepFingerprint, initial_values, updated_units
from .statistics import ProjectionStatistics
from .target import Interpolant, TargetManifold
from .terms import (
    check_direction,
    check_projects_nothing,
    check_root_finder,
    in_field_time,
    innermost,
    is_ode,
    refuse_backsolve,
    time_direction,
)
from .wrapper import ForwardingSolver

# The number of displacements `y(t) - y₀` that are taken from the dense output of a step. If it is a
# polynomial of at most this degree in time, as for most solvers, they span all of them.
_NUM_DISPLACEMENTS = 4


def _trivial(t: RealScalarLike, y: Y, args: Args) -> Array:
    """A constraint that every state satisfies."""
    return jnp.zeros(())


def or_trivial(manifold: Manifold) -> Manifold:
    """The manifold; if it is empty, because bounds alone are kept, that of all states."""
    return manifold if named_entries(manifold) else Constraint(_trivial)


@final
class ManifoldProjection(ForwardingSolver):
    r"""Projects every step of another solver to a manifold.

    The wrapped solver proposes a candidate $\hat y$ at $t_{n+1}$; $y_{n+1}$ is its projection to

    $$\{y : I(t_{n+1}, y, args) = I(t_0, y_0, args), \quad g(t_{n+1}, y, args) = 0\}$$

    for the first integrals $I$ and the constraints $g$ of `manifold`. Dense output, saved times and
    events are projected too. The conserved values are computed once, at the start of the solve, and
    carried in the solver state: the drift does not grow with the number of steps, and a solve that
    continues from a `solver_state` keeps the original values. If you have changed the state, as by
    an impact, leave the `solver_state` out: the old values do not fit.

    **The metric of motion.** A candidate is moved to the manifold along the gradients of the
    functions, and the metric shares out the correction among the components. By default it is
    $M = \mathrm{diag}(1/s^2)$ with a unit $s$ for each quantity of the state, the largest geometric
    mean so far of its size and of its change $\Delta = |\hat y - y_n|$ in a step,

    $$s = \max \sqrt{\max(|\hat y|, \Delta)\, \Delta}.$$

    If the state has several leaves, each vector along the last axis of a leaf is one quantity, such
    as the place of a body, and $|\cdot|$ is its largest component: put quantities with unlike units
    into leaves of their own. If the state is one array, each component is a quantity. So the result
    does not depend on the units of the leaves, or of the components of a single array. A quantity
    that never moves, such as a parameter, counts as changing by $\varepsilon$ of itself, so that it
    is hardly corrected if another can be; one that rests at zero is not corrected at all, but in a
    leaf of many vectors no $s$ is below $\varepsilon$ times the largest. For a field in a single
    array, all of whose components have one unit, pass `projection=SimplifiedNewton(metric=1.0)`,
    which is the Euclidean metric: a travelling wave with all of its integrals kept needs it.
    Stochastic equations have the Euclidean metric in the
    numbers of the state, because there the metric decides which equation is solved: for mixed units
    pass `projection=SimplifiedNewton(metric=(1 / metres**2, 1 / speed**2))`.

    Conserving one integral is not always better than none: see "Choosing a projection". The
    projected method has the order of the wrapped one. A stage that the wrapped solver keeps for
    the next step is evaluated again at the projected state; implicit methods keep it.

    Success means that each residual is within 16 units of roundoff of
    $|I_0| + \sum_k (|y_k| + |\hat y_k - y_{n, k}|)\, |\partial_k I|$ and the terms that cancel
    inside `fn`, such as the 1 of `1 - cos(q)`, unless the projection has other tolerances.

    A solve fails at its first step if a function is not finite at the initial state, or if that
    violates a `Constraint` by more than the square root of roundoff, relative to the size of its
    terms: find a consistent state by [`diffrax_conserve.project`][]. It fails likewise if it
    continues from the `solver_state` of a solve with other values, be it by another state, time,
    `args` or manifold, and after a jump that the step size controller declares, if the constraint
    jumps too: end the solve there, `project`, and go on. A balance does not fail there: it goes on
    with the value that the state has.

    If a projection fails (no convergence, NaN, a correction larger than `max_correction` allows),
    an adaptive solve tries smaller steps until one moves the state by no more than roundoff, or no
    time passes; then it ends. A solve with fixed steps ends at once. The last state is NaN; the
    `diffrax.RESULTS` tells the cause, [`diffrax_conserve.statistics`][] the entry of the manifold.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        energy = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2) / 2)
        term = diffrax.ODETerm(lambda t, y, args: jnp.array([y[1], -y[0]]))
        solver = dfc.ManifoldProjection(diffrax.Tsit5(), energy)
        solution = diffrax.diffeqsolve(term, solver, 0, 10, 0.1, jnp.array([1.0, 0.0]))
        ```

    ??? cite "Reference"

        Hairer, Lubich and Wanner, *Geometric Numerical Integration*, Springer 2006, Section IV.4.
    """

    solver: dfx.AbstractSolver[Any]  # pyright: ignore[reportIncompatibleVariableOverride]
    manifold: Manifold = eqx.field(converter=or_trivial)
    projection: AbstractProjection = option(SimplifiedNewton())
    max_correction: RealScalarLike | None = option(None)
    keep_linear: bool = option(False, static=True)

    def __check_init__(self):
        if not isinstance(self.solver, dfx.AbstractSolver):
            name = getattr(self.solver, "__name__", type(self.solver).__name__)
            raise TypeError(
                f"`solver` is `{name}`, which is not a diffrax solver. Pass an instance, such as "
                "`diffrax.Tsit5()`, or of a network its solver, such as `DeepONetSolver(network)`."
            )
        check_projects_nothing(self.solver)
        check_root_finder(self.solver)
        check_projection(self.projection)
        has_no_entries = isinstance(self.manifold, Constraint) and self.manifold.fn is _trivial
        check_manifold(() if has_no_entries and not self.projection.has_bounds else self.manifold)
        check_direction(self.solver, self.projection)
        check_number("max_correction", self.max_correction, above=0.0)

    @property
    def interpolation_cls(self) -> MakeManifoldInterpolation:  # pyright: ignore
        return MakeManifoldInterpolation(self.solver.interpolation_cls)

    def strong_order(self, terms: PyTree[dfx.AbstractTerm]) -> RealScalarLike | None:
        return self.solver.strong_order(terms)

    def error_order(self, terms: PyTree[dfx.AbstractTerm]) -> RealScalarLike | None:
        return self.solver.error_order(terms)

    def init(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> State:
        refuse_backsolve(
            terms,
            "ManifoldProjection",
            "Name the wrapped solver for them, `BacksolveAdjoint(solver=inner)`, or use",
        )
        check_state(y0, kind=jnp.inexact)
        _, t = in_field_time(terms, t0)
        values, cancellation = initial_values(self.manifold, t, y0, args)
        if self.keep_linear and values.size > 2 * _NUM_DISPLACEMENTS:
            raise ValueError(
                f"`keep_linear` has {2 * _NUM_DISPLACEMENTS} directions, but `manifold` has "
                f"{values.size} scalar constraints. Leave it out, and add the linear invariants to "
                "`manifold`: `diffrax_conserve.compare` tells which there are."
            )
        y = ravel(y0)
        first_step_size = jnp.abs(jnp.atleast_1d(t1 - t0))
        statistics = ProjectionStatistics.zero(
            self.manifold, values.dtype, self.projection.has_bounds
        )
        return State(
            inner=self.solver.init(terms, t0, t1, y0, args),
            packed_constants=jnp.concatenate(
                [values, cancellation, first_step_size.astype(values.dtype)]
            ),
            rate_integrals=jnp.zeros((2, values.size), values.dtype)
            if has_rates(self.manifold)
            else None,
            units=jnp.zeros_like(y),
            last_fingerprint=StepFingerprint.before_first(self.manifold, y.dtype),
            statistics=statistics,
            displacements=first_displacements(terms, t0, t1, y0, args)
            if self.keep_linear
            else None,
        )

    @traced_once
    def step(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: State,
        made_jump: BoolScalarLike,
    ) -> tuple[Y, Y | None, DenseInfo, State, dfx.RESULTS]:
        state = self._checked(solver_state)
        wrapped = self._wrapped_step(terms, t0, t1, y0, args, state.inner, made_jump)
        step, candidate, like = wrapped.step, wrapped.candidate, jax.eval_shape(lambda: y0)
        # Dense output stores the target at the start, and adds the integrals up to its own time.
        state, start_target = self._target(terms, state, wrapped, like, args)
        target = start_target.with_rates_integrated(step.t0, step.t1, wrapped.interpolant)
        problem = target.problem(step.t1, candidate, step)
        y1, info = self.projection.solve(problem, candidate)
        cause, is_final = self._failure(
            problem,
            state,
            wrapped,
            self._cannot_start(start_target, state, step, made_jump),
            y1,
            info,
        )
        y1, result = nan_if_failed(cause, y1, wrapped.result)
        dense_info = dict(
            inner=wrapped.dense_info,
            field_time=wrapped.field_time,
            step_correction=y1 - candidate,
            step_norm=step_norm(jnp.abs(y1 - step.y0), y1, problem.factor),
            error=step.error if self.projection.sees_step else None,
            target=AsArrays(start_target),
        )
        state = dataclasses.replace(
            state,
            inner=wrapped.inner,
            rate_integrals=target.rate_integrals,
            last_fingerprint=state.last_fingerprint.at(step.t1, y1, args, self.manifold),
            statistics=state.statistics.add(
                info, -1.0 if step.error is None else problem.factor.norm(step.error)
            ),
        )
        error = error_for_controller(cause, is_final, wrapped.error)
        return unravel(y1, like), error, dense_info, state, result

    def _wrapped_step(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        inner: Any,
        made_jump: BoolScalarLike,
    ) -> "_WrappedStep":
        """The step of the wrapped solver: `step` and `candidate` as vectors, in the time of the
        vector field, the rest as that solver returns it."""
        inner_made_jump = made_jump if self._forwards_made_jump else True
        y1, error, dense_info, inner, result = self.solver.step(
            terms, t0, t1, y0, args, inner, inner_made_jump
        )
        field_time = FieldTime(time_direction(terms, t0))
        error_vector = None if error is None else ravel(error)
        step = Step(field_time(t0), field_time(t1), ravel(y0), error_vector)
        # The dense output of the step is rarely needed, so it is made when it is called.
        interpolation = ft.partial(self.solver.interpolation_cls, t0=t0, t1=t1, **dense_info)
        interpolant = lambda t: ravel(interpolation().evaluate(field_time(t)))  # noqa: E731
        # A projection evaluates functions at the candidate at several places. Without a barrier XLA
        # would evaluate the step once for each of them.
        candidate = lax.optimization_barrier(ravel(y1))
        return _WrappedStep(
            step, candidate, interpolant, error, dense_info, inner, result, field_time
        )

    @property
    def _forwards_made_jump(self) -> bool:
        """Whether the wrapped solver gets the `made_jump` of diffrax; otherwise it gets `True` in
        every step.

        A solver with the property "first same as last" keeps the slope at the candidate for the
        next step, which starts at the projected state. With `made_jump=True` it evaluates the slope
        there anew. The flag is set in every step, because while one lane of a batch is in its first
        step, diffrax evaluates the slope of all lanes anew, so that otherwise a lane would depend
        on the others. The flag of diffrax is passed on in two cases. In an implicit method the kept
        slope fits the last stage, which its root finder has solved; a slope at the projected state
        would amplify the error of the root finder. `QUICSORT` refuses `made_jump=True`.
        """
        return isinstance(innermost(self.solver), dfx.AbstractImplicitSolver | dfx.QUICSORT)

    def _checked(self, state: Any) -> State:
        names = entry_names(self.manifold)
        if isinstance(state, State) and state.statistics.names == names:
            return state
        given = "not the state of a solve by this solver"
        if isinstance(state, State):
            kept = ", ".join(state.statistics.names)
            given = f"the state of a solve with the entries {kept}, not {', '.join(names)}"
        raise ValueError(
            f"`solver_state` is {given}. Pass what `solver.init(terms, t0, t1, y0, args)` or the "
            "last `solver.step` returned, or to `diffeqsolve` none: then the conserved values are "
            "those of `y0`."
        )

    def _target(
        self,
        terms: PyTree[dfx.AbstractTerm],
        state: State,
        wrapped: "_WrappedStep",
        like: Any,
        args: Args,
    ) -> tuple[State, TargetManifold]:
        """The solver state with the units and displacements of this step, and the target at the
        start of the step.

        Stochastic equations have no metric of motion: there the metric decides which equation is
        solved, and that must not depend on the path.
        """
        step, candidate, displacements = wrapped.step, wrapped.candidate, state.displacements
        changes = jnp.abs(candidate - step.y0)
        units = updated_units(state.units, changes, candidate, like)
        if displacements is not None:
            new = displacements_along(wrapped.interpolant, step)
            displacements = jnp.concatenate([new, displacements[:_NUM_DISPLACEMENTS]])
        target = TargetManifold(
            self.projection,
            self.manifold,
            like,
            state.values,
            state.cancellation,
            args,
            changes=changes,
            factor=Diagonal(units) if is_ode(terms) else Identity(),
            rate_integrals=state.rate_integrals,
            displacements=displacements,
        )
        state = dataclasses.replace(state, units=units, displacements=displacements)
        if target.rate_integrals is not None:
            target = target.with_balances_met(step.t0, step.y0)
        return state, target

    def _failure(
        self,
        problem: Problem,
        state: State,
        wrapped: "_WrappedStep",
        cannot_start: Bool[Array, ""],
        y1: Float[Array, " n"],
        info: ProjectionInfo,
    ) -> tuple[Int[Array, ""], Bool[Array, ""]]:
        """Why the step failed, 0 if it did not, and whether no shorter step would be better."""
        t1, changes, candidate = problem.t, problem.changes, wrapped.candidate
        assert changes is not None  # in the step of a solve
        time = jnp.maximum(jnp.abs(t1), state.first_step_size.astype(jnp.result_type(t1)))
        # An implicit method that finds no step returns the state at its start, which is no rest.
        was_solved = wrapped.result == dfx.RESULTS.successful
        moved = jnp.where(was_solved, changes, jnp.inf)
        length = t1 - wrapped.step.t0
        is_final = cannot_start | is_shortest_step(length, time, moved, candidate)
        correction, too_far = y1 - candidate, False
        if self.max_correction is not None:
            limit = jnp.asarray(self.max_correction, correction.dtype)
            limit = limit * step_norm(changes, candidate, problem.factor)
            too_far = problem.factor.norm(correction) > limit
        is_first_step = jnp.isinf(state.last_fingerprint.checksums[0])
        return failure_cause(
            info.ok,
            cannot_start,
            state.values,
            must_be_finite=correction,
            too_far=too_far,
            unreachable=is_first_step | is_final,
        ), is_final

    def _cannot_start(
        self, target: TargetManifold, state: State, step: Step, made_jump: BoolScalarLike
    ) -> Bool[Array, ""]:
        """Whether a conserved value is not finite, or a step starts off the manifold. The second is
        tested in the first step of a solve, unless that continues from a `solver_state` with the
        same state, time, `args` and manifold, and after a jump of the vector field, because a
        constraint may jump with it."""
        invalid_values = ~jnp.all(jnp.isfinite(state.values))
        if all(entry.value is not None for _, entry in named_entries(self.manifold)):
            return invalid_values
        last = state.last_fingerprint
        sums, sizes = last.checksums_of(step.t0, step.y0, target.args, self.manifold)
        changed = last.differs(sums, sizes, self.manifold) | made_jump
        off = lax.cond(
            any_lane(changed),
            lambda: starts_off_manifold(target.problem(step.t0, step.y0), self.manifold, step.y0),
            lambda: jnp.asarray(False),
        )
        return invalid_values | (changed & off)


def first_displacements(
    terms: PyTree[dfx.AbstractTerm], t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
) -> Float[Array, "k n"]:
    """The displacements of two steps of Euler's method, because no step comes before the first. In
    its first step a method of one stage has a single slope, along which integrals hardly change. A
    correction in the span of it would undo the step."""
    y = ravel(y0)
    changes = jnp.zeros((2 * _NUM_DISPLACEMENTS, y.size), y.dtype)
    if not (is_ode(terms) and isinstance(terms, dfx.AbstractTerm)):
        return changes
    control = terms.contr(t0, t1)
    first = terms.vf_prod(t0, y0, args, control)
    second = terms.vf_prod(t1, tree_add(y0, first), args, control)
    displacements = jnp.stack([ravel(first), ravel(second)])
    return changes.at[:2].set(jnp.where(jnp.isfinite(displacements), displacements, 0))


class _WrappedStep(NamedTuple):
    """What the wrapped solver proposes.

    - `step`: the step, as a projection sees it.
    - `candidate`: the state at its end.
    - `interpolant`: its dense output, as a function from times to states.
    - `error`, `dense_info`, `inner`, `result`: the error estimate, dense output, solver state and
      result, as the wrapped solver returns them.
    - `field_time`: the time of the vector field as a function of that of the solver, and back.
    """

    step: Step
    candidate: Float[Array, " n"]
    interpolant: Interpolant
    error: Y | None
    dense_info: DenseInfo
    inner: Any
    result: dfx.RESULTS
    field_time: FieldTime


def displacements_along(interpolant: Interpolant, step: Step) -> Float[Array, "k n"]:
    """The changes of the state from the start of a step, in the dense output of the wrapped solver,
    after equal parts of the step. Of a Runge-Kutta method they are combinations of its slopes, so
    that they are orthogonal to each `c` with `c · f = 0`."""
    shares = (k / _NUM_DISPLACEMENTS for k in range(1, _NUM_DISPLACEMENTS + 1))
    times = (step.t0 + share * (step.t1 - step.t0) for share in shares)
    return jnp.stack([interpolant(t) - step.y0 for t in times])


ManifoldProjection.__init__.__doc__ = r"""**Arguments:**

- `solver`: the solver to wrap, any `diffrax.AbstractSolver`.
- `manifold`: a PyTree (one, a tuple, a list, a dictionary) of `FirstIntegral`s and `Constraint`s;
    `()` if only the bounds of the projection are kept.
- `projection`: a `SimplifiedNewton`, `Newton`, `AlongLine`, `ClosedForm`, `Staged`, or your own.
- `max_correction`: a projection fails if its correction is longer than this share of its step, both
    in the metric of the projection at the candidate. For projections without a metric,
    such as `Staged`, that is the metric of motion, or with noise the Euclidean one. A component
    that hardly moves counts as moving by $\sqrt\varepsilon$ of itself. A limit keeps a state from
    jumping to another part of the manifold; whether a quantity is conserved at all is told by
    [`diffrax_conserve.check_invariance`][]. Default: no limit.
- `keep_linear`: whether linear functions of the state that the wrapped solver keeps, such as the
    momentum, the mass or the charge, stay conserved although `manifold` does not contain them.
    Every Runge-Kutta method keeps $c \cdot y$ for each $c$ with $c \cdot f = 0$, because its steps
    are combinations of slopes. With this option corrections are combinations of slopes too, in the
    span of the changes of the state in the dense output of this step and of the one before. They
    leave this span only where no correction within it reaches the manifold. Linear entries of
    `manifold` are kept in any case. The span has up to eight dimensions, so more than eight
    constraints are refused. The option costs eight vectors of the size of the state in memory, in
    dense output for each step, and their products in time; a sparse Jacobian is treated as dense.
    Active bounds, `AlongLine`, a `ClosedForm` and the stages of `Staged` that have a metric of
    their own ignore it.

**Raises:**

`TypeError` or `ValueError`, before compilation, if an argument is invalid, or if the manifold, the
metric or a conserved value does not fit the state.
"""
