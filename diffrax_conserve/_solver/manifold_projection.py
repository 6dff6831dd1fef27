"""The wrapper that makes any diffrax solver keep its solution on a manifold."""

import functools as ft
from collections.abc import Callable
from typing import Any, final

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._balance import has_rates
from .._custom_types import (
    VF,
    Args,
    BoolScalarLike,
    DenseInfo,
    Manifold,
    RealScalarLike,
    Y,
)
from .._interpolation import MakeManifoldInterpolation, PackedTarget
from .._manifold import check_manifold, check_outputs, check_values, conserved_values
from .._options import check_count, check_number
from .._projection.base import AbstractProjection, check_projection, option
from .._projection.certainty import if_certain
from .._projection.project import check_metric, check_state, tangential
from .._projection.simplified_newton import SimplifiedNewton
from .._projection.target import Target
from .._tree import tree_norm, tree_sub, working_dtype
from .checks import check_direction, check_nested, innermost
from .count_rejections import FAILED_PROJECTION
from .failure import failure
from .initial import FINE, Initial, judge
from .state import State
from .statistics import ProjectionStatistics
from .terms import is_backsolve, is_ode, slope_of, time_direction


@final
class ManifoldProjection(dfx.AbstractWrappedSolver[Any]):
    r"""Projects every step of another solver to a manifold.

    The wrapped solver proposes a candidate $\hat y$ at $t_{n+1}$; $y_{n+1}$ is its projection to

    $$\{y : I(t_{n+1}, y, args) = I(t_0, y_0, args), \quad g(t_{n+1}, y, args) = 0\}$$

    for the first integrals $I$ and the constraints $g$ of `manifold`. Dense output, saved times and
    events are projected in the same way. The conserved values are computed once, at the start of
    the solve, and carried in the solver state, so that the drift does not grow with the number of
    steps; a solve that continues from a `solver_state` keeps the original values.

    The projected method has the order of the wrapped one. A wrapped solver that reuses its last
    stage in the next step (Tsit5, Dopri5, Bosh3: "first same as last") reuses the stage at the
    candidate. Evaluating it again at the projected state costs one more evaluation per step without
    a clear gain: on five systems the errors were the same to within 20 % at tolerance 1e-8, and to
    within a factor of 2.3 at 1e-5, some larger, some smaller
    (`benchmarks/studies/first_same_as_last.py`).

    A solve fails at its first step if the initial state violates a `Constraint` by more than the
    square root of roundoff, relative to the size of its terms (find a consistent state by
    [`diffrax_conserve.project`][]), if a function is not finite there, or if the projection to a
    `value` fails there.

    If a projection fails (no convergence, NaN, a correction larger than `max_correction` allows),
    an adaptive solve rejects the step and tries a smaller one, until the candidate is very close to
    the last state; then the solve ends. A solve with fixed steps ends at once. The message of the
    `diffrax.RESULTS` gives the position of the entry with the largest residual;
    [`diffrax_conserve.entry_name`][] returns its name. [`diffrax_conserve.statistics`][] summarises
    the projections.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        def vector_field(t, y, args):
            q, p = y
            return p, -q

        def energy(t, y, args):
            q, p = y
            return 0.5 * (q**2 + p**2)

        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(vector_field),
            dfc.ManifoldProjection(diffrax.Tsit5(), dfc.FirstIntegral(energy)),
            t0=0.0,
            t1=10.0,
            dt0=0.1,
            y0=(jnp.array(1.0), jnp.array(0.0)),
        )
        ```

    !!! warning

        Conserving one integral is not always better than conserving none: see "Choosing a
        projection".

    ??? cite "Reference"

        E. Hairer, C. Lubich and G. Wanner, *Geometric Numerical Integration*, 2nd ed., Springer
        2006, Section IV.4.
    """

    solver: dfx.AbstractSolver[Any]  # pyright: ignore[reportIncompatibleVariableOverride]
    manifold: Manifold
    projection: AbstractProjection = option(SimplifiedNewton())
    max_correction: RealScalarLike | None = option(None)
    threshold: RealScalarLike | None = option(None)
    every: int = option(1, static=True)
    project_error: bool = option(False, static=True)

    def __check_init__(self):
        if not isinstance(self.solver, dfx.AbstractSolver):
            raise TypeError(
                f"`solver` is {self.solver!r}, which is not a diffrax solver. Pass an instance, "
                "for example `ManifoldProjection(diffrax.Tsit5(), manifold)`."
            )
        check_nested(self.solver)
        check_manifold(self.manifold)
        check_projection(self.projection)
        check_direction(self.solver, self.projection)
        check_number("max_correction", self.max_correction, above=0.0)
        check_number("threshold", self.threshold, above=0.0)
        check_count("every", self.every)
        bounds = [getattr(self.projection, name, None) for name in ("lower", "upper")]
        if bounds != [None, None] and (self.threshold is not None or self.every > 1):
            raise ValueError(
                "`projection` has bounds, which a step that is not projected does not keep. Leave "
                "out `threshold` and `every`, or `lower` and `upper`."
            )

    # diffrax forwards `isinstance` through a wrapped solver to the innermost one, then reads these
    # attributes from the wrapper. They are `Any` because `equinox.tree_at` replaces values by
    # placeholders.

    @property
    def term_structure(self) -> Any:  # pyright: ignore
        return self.solver.term_structure

    @property
    def term_compatible_contr_kwargs(self) -> Any:  # pyright: ignore
        return self.solver.term_compatible_contr_kwargs

    @property
    def root_finder(self) -> Any:
        return innermost(self.solver).root_finder  # pyright: ignore

    @property
    def root_find_max_steps(self) -> Any:
        return innermost(self.solver).root_find_max_steps  # pyright: ignore

    @property
    def scan_kind(self) -> Any:
        return innermost(self.solver).scan_kind  # pyright: ignore

    @property
    def interpolation_cls(self) -> MakeManifoldInterpolation:  # pyright: ignore
        return MakeManifoldInterpolation(self.solver.interpolation_cls)

    def order(self, terms: PyTree[dfx.AbstractTerm]) -> int | None:
        return self.solver.order(terms)

    def strong_order(self, terms: PyTree[dfx.AbstractTerm]) -> RealScalarLike | None:
        return self.solver.strong_order(terms)

    def error_order(self, terms: PyTree[dfx.AbstractTerm]) -> RealScalarLike | None:
        return self.solver.error_order(terms)

    def func(self, terms: PyTree[dfx.AbstractTerm], t0: RealScalarLike, y0: Y, args: Args) -> VF:
        return self.solver.func(terms, t0, y0, args)

    def init(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> State:
        if is_backsolve(terms):
            raise ValueError(
                "`ManifoldProjection` cannot solve the adjoint equations of "
                "`diffrax.BacksolveAdjoint`: their state is not on the manifold. Name another "
                "solver for them, `BacksolveAdjoint(solver=inner)` with the wrapped solver, or use "
                "`diffrax.RecursiveCheckpointAdjoint()`."
            )
        direction = time_direction(terms, t0)
        t = t0 * direction
        check_state(y0, kind=jnp.inexact)
        check_metric(self.projection.metric, y0)
        check_outputs(self.manifold, t, y0, args)
        values = conserved_values(self.manifold, t, y0, args)
        check_values(self.manifold, values, t, y0, args)
        num_constraints = sum(jnp.size(value) for value in jtu.tree_leaves(values))
        return State(
            self.solver.init(terms, t0, t1, y0, args),
            if_certain(values, self.manifold, values, t, y0, args),
            jtu.tree_map(jnp.zeros_like, values) if has_rates(self.manifold) else None,
            None if self.every == 1 else jnp.asarray(0),
            ProjectionStatistics.zero(working_dtype(y0), num_constraints),
            judge(
                self.projection,
                self.manifold,
                values,
                t,
                y0,
                args,
                self._vector_field(terms, y0, args, direction),
                (t1 - t0) * direction,
            ),
        )

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
        candidate, error, dense_info, inner, result = self.solver.step(
            terms, t0, t1, y0, args, solver_state.inner, made_jump
        )
        start = self._target(terms, t1, y0, candidate, args, solver_state)
        # Evaluated only where it is needed.
        path = ft.partial(self.solver.interpolation_cls, t0=t0, t1=t1, **dense_info)
        target = start.advanced(t0, t1, lambda t: path().evaluate(t))
        step = target.step(t0, t1, y0, error, path)
        y1, info = target.project(t1, candidate, step=step)
        too_far = target.too_far(info)
        success = info.ok & ~too_far & (solver_state.initial.cause == FINE)
        shown = None if step is None else error
        error = self._error(error, target, t1, y1)
        hopeless = _is_hopeless(solver_state.initial, t0, t1, y0, candidate)
        error = _judged(error, success, hopeless)
        failed = failure(info, too_far, solver_state.initial, self.manifold, solver_state.values)
        result = dfx.RESULTS.where(success | (result != dfx.RESULTS.successful), result, failed)
        dense_info = dict(inner=dense_info, ends=(y0, y1), error=shown, target=PackedTarget(start))
        return y1, error, dense_info, solver_state.next(inner, target.gained, info), result

    def _target(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t1: RealScalarLike,
        y0: Y,
        candidate: Y,
        args: Args,
        state: State,
    ) -> Target:
        return Target(
            self.projection,
            self.manifold,
            state.values,
            args,
            time_direction(terms, t1),
            gained=state.gained,
            limit=self._limit(y0, candidate, state.initial.offset) if is_ode(terms) else None,
            threshold=self.threshold,
            due=None if state.num_steps is None else (state.num_steps + 1) % self.every == 0,
        )

    def _limit(self, y0: Y, candidate: Y, offset: Array) -> Array | None:
        """The largest allowed correction in a step from `y0` to `candidate`."""
        if self.max_correction is None:
            return None
        dtype = working_dtype(candidate)
        moved, size = tree_norm(tree_sub(candidate, y0)), tree_norm(candidate)
        # A correction this small is allowed however short the step.
        harmless = jnp.finfo(dtype).eps ** 0.5 * size
        allowed = jnp.asarray(self.max_correction, dtype) * self.every
        return jnp.where(jnp.isinf(allowed), jnp.inf, allowed * moved + harmless + 2 * offset)

    def _vector_field(
        self, terms: PyTree[dfx.AbstractTerm], y0: Y, args: Args, direction: Array
    ) -> Callable[[RealScalarLike, Y], Y] | None:
        """The vector field `(t, y) -> f`, along which first integrals must not change."""
        # A learned solver does not evaluate the vector field, which may be expensive.
        evaluated = getattr(innermost(self.solver), "evaluates_vector_field", True)
        exact = jnp.finfo(working_dtype(y0)).bits >= 32
        if self.max_correction is not None or not (is_ode(terms) and evaluated and exact):
            return None

        return ft.partial(slope_of, self.solver, terms, args, direction)

    def _error(self, error: Y | None, target: Target, t1: RealScalarLike, y1: Y) -> Y | None:
        if error is None or not self.project_error:
            return error
        t1 = t1 * target.direction
        return tangential(self.projection, self.manifold, target.now, t1, y1, target.args, error)


def _is_hopeless(
    initial: Initial, t0: RealScalarLike, t1: RealScalarLike, y0: Y, candidate: Y
) -> Array:
    """Whether a failed projection cannot succeed with smaller steps, because the candidate is
    already very close to `y0`, the step is a roundoff of time, or the initial state is invalid."""
    little = max(5e-4, 16 * float(jnp.finfo(working_dtype(candidate)).eps))
    moved = tree_norm(tree_sub(candidate, y0))
    near = moved <= little * tree_norm(candidate)
    instant = jnp.abs(t1 - t0) <= 8 * jnp.finfo(jnp.result_type(t1)).eps * jnp.abs(t1)
    return near | instant | (initial.cause != FINE)


def _judged(error: Y | None, success: BoolScalarLike, hopeless: BoolScalarLike) -> Y | None:
    """The error estimate of a step. If the projection failed it is infinite, so that an adaptive
    solve tries a smaller step; if that is hopeless it is zero, so that the step is accepted and its
    result ends the solve."""
    failed = jnp.where(hopeless, 0.0, FAILED_PROJECTION)
    return jtu.tree_map(lambda e: jnp.where(success, e, failed.astype(e.dtype)), error)


ManifoldProjection.__init__.__doc__ = r"""**Arguments:**

- `solver`: the solver to wrap, any `diffrax.AbstractSolver`.
- `manifold`: a PyTree (one, a tuple, a list, a dictionary) of `FirstIntegral`s and `Constraint`s.
- `projection`: the projection to the manifold: a `SimplifiedNewton`, a `Newton`, a `ClosedForm`, a
    `Directional`, a `Staged`, or your own.
- `max_correction`: a projection fails if it moves the candidate by more than this times the
    distance covered by the step, $\|\hat y - y_n\|$ (plus $\sqrt\varepsilon \|\hat y\|$), in the
    Euclidean norm. It protects against a jump to another component of the manifold, and against
    quantities that are not conserved. 0.5 is a sensible value, because corrections are of the size
    of the local error of the wrapped solver. Default: no limit, but a solve does not start if a
    first integral changes along a short trajectory from the initial state, by more than 1e-4 of the
    terms that should cancel. `jax.numpy.inf` allows that, for a vector field that conserves
    nothing, for example a network before its training. The first projection may also move
    the state to a `value` that is not that of the initial state. With `every`, the limit is
    multiplied by it. Stochastic equations have no limit, because noise may move the state off the
    manifold as fast as it moves the state.
- `threshold`: do not project a step whose largest residual, relative to the scale of its
    constraint, is at most this. Dense output is treated in the same way. Default: project every
    step.
- `every`: project only every `every`-th step. In the other steps neither the state nor dense output
    is projected, so the final state may be off the manifold.
- `project_error`: project the error estimate to the tangent space of the manifold, so that the
    step size is not limited by errors that the projection removes. With Tsit5 on the systems of
    the catalogue it saved at most a fifth of the steps, at up to 70 times the error
    (`benchmarks/studies/project_error.py`); it costs one more evaluation of the gradients.

**Raises:**

`TypeError` or `ValueError`, before compilation, if an argument is invalid, if the manifold is empty
or has more scalar constraints than the state has unknowns, or if the metric or a conserved value
does not fit.
"""
