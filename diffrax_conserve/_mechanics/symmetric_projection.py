"""Symmetric projection: a symmetric method stays symmetric on the manifold."""

import functools as ft
from typing import Any, NamedTuple, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._balance import refuse_rates
from .._constants import MAX_STEPS, NOISE_IN_EPS, TOLERANCE_IN_EPS
from .._custom_types import Args, BoolScalarLike, DenseInfo, Manifold, RealScalarLike, Y
from .._interpolation import AsArrays
from .._manifold import check_manifold
from .._numerics.implicit import root
from .._numerics.iterate import Solved, iterate, remaining_after_test
from .._numerics.lanes import any_lane, where_active
from .._numerics.problem import (
    ABOVE_TOLERANCE,
    AT_ROUNDOFF,
    NOT_FINITE,
    WITHIN_TOLERANCE,
    Problem,
    problem_of,
)
from .._numerics.rows import AbstractRows, solve_kkt
from .._projection.base import with_options
from .._projection.options import check_state
from .._projection.simplified_newton import SimplifiedNewton
from .._solver.failure import failure_cause, nan_if_failed, starts_off_manifold
from .._solver.state import initial_values
from .._solver.statistics import ProjectionStatistics
from .._solver.terms import check_root_finder, in_field_time, innermost, refuse_backsolve
from .._solver.wrapper import ForwardingSolver
from .._time import traced_once
from .._tree import eps_of, ravel, unravel
from .shorter_step import ShorterStep, StepOf

# Methods of even order without coefficients to judge by: two that undo their steps only with their
# memory, which a projection at both ends discards, and those for Langevin's equation.
_NOT_SYMMETRIC = dfx.LeapfrogMidpoint, dfx.ReversibleHeun, dfx.AbstractFosterLangevinSRK


class _State(eqx.Module):
    """What the next step needs: the state of the wrapped solver, the conserved values, the part of
    the scales that the gradients do not show, the last multiplier as a guess, and statistics."""

    inner: Any
    values: Float[Array, " m"]
    cancellation: Float[Array, " m"]
    multiplier: Float[Array, " m"]
    statistics: ProjectionStatistics


class _Unknowns(NamedTuple):
    """The unknowns of a step, the state `y_{n+1}` and the multiplier `μ`; and what the inner step
    with this multiplier gives, the candidate `ỹ_{n+1}` and a result."""

    y: Float[Array, " n"]
    multiplier: Float[Array, " m"]
    candidate: Float[Array, " n"]
    result: dfx.RESULTS


@final
class SymmetricProjection(ForwardingSolver):
    r"""Projects a symmetric method so that the projected method is symmetric too.

    A step $\Phi_h$ of the wrapped solver is projected at both of its ends, with one multiplier
    $\mu$:

    $$\tilde y_n = y_n + M^{-1} G(y_n)^\top \mu, \quad \tilde y_{n+1} = \Phi_h(\tilde y_n), \quad
    y_{n+1} = \tilde y_{n+1} + M^{-1} G(y_{n+1})^\top \mu, \quad g(y_{n+1}) = 0,$$

    with the residuals $g$ of `manifold`, $G = \partial g/\partial y$ and the metric $M$. If a step
    of $\Phi_{-h}$ undoes one of $\Phi_h$, then this holds for the projected step: solve forwards,
    then backwards in time, and you are where you began. [`diffrax_conserve.ManifoldProjection`][]
    projects at one end only, which destroys the symmetry. For long orbits of reversible systems.

    A state at a saved time comes from a shorter step. Derivatives follow from the implicit function
    theorem. A step that fails is NaN, and the `diffrax.RESULTS` tells why, as with
    `ManifoldProjection`. [`diffrax_conserve.statistics`][] has the number of iterations, each of
    which is one step of the wrapped solver: about four. Steps are fixed, because a step size that
    follows an error estimate is not symmetric.

    The multipliers are the same at both ends of a step, so quantities with nearly parallel
    gradients, such as energy and angular momentum on an almost circular orbit, may not be met
    together, however short the steps are. Keep one of them, or use `ManifoldProjection`.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        energy = dfc.FirstIntegral(lambda t, y, args: y[1] ** 2 / 2 - jnp.cos(y[0]))
        term = diffrax.ODETerm(lambda t, y, args: jnp.array([y[1], -jnp.sin(y[0])]))
        solver = dfc.SymmetricProjection(dfc.ImplicitMidpoint(), energy)
        y0 = jnp.array([1.0, 0.0])
        there = diffrax.diffeqsolve(term, solver, 0.0, 10.0, 0.1, y0).ys[-1]
        back = diffrax.diffeqsolve(term, solver, 10.0, 0.0, -0.1, there).ys[-1]
        assert jnp.max(jnp.abs(back - y0)) < 1e-4  # float32
        ```

    ??? cite "Reference"

        E. Hairer, "Symmetric projection methods for differential equations on manifolds", *BIT* 40
        (2000), 726-734; Hairer, Lubich and Wanner, *Geometric Numerical Integration*, Springer
        2006, V.4.1.
    """

    solver: dfx.AbstractSolver[Any]  # pyright: ignore[reportIncompatibleVariableOverride]
    manifold: Manifold
    projection: SimplifiedNewton
    interpolation_cls = ShorterStep

    def __init__(
        self,
        solver: dfx.AbstractSolver[Any],
        manifold: Manifold,
        *,
        metric: PyTree[ArrayLike] = 1.0,
        rtol: float | Array | None = None,
        atol: float | Array | None = None,
        max_steps: int = MAX_STEPS,
    ):
        self.solver = solver  # pyright: ignore[reportIncompatibleVariableOverride]
        self.manifold = manifold
        self.projection = SimplifiedNewton(metric=metric, rtol=rtol, atol=atol, max_steps=max_steps)
        _check_symmetric(solver)
        check_root_finder(self)
        check_manifold(manifold)
        refuse_rates(manifold, "a `SymmetricProjection`")

    def init(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> _State:
        refuse_backsolve(terms, "SymmetricProjection")
        check_state(y0, kind=jnp.inexact)
        _, t = in_field_time(terms, t0)
        values, cancellation = initial_values(self.manifold, t, y0, args)
        statistics = ProjectionStatistics.zero(self.manifold, values.dtype)
        inner = self.solver.init(terms, t0, t1, y0, args)
        return _State(inner, values, cancellation, jnp.zeros_like(values), statistics)

    @traced_once
    def step(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: _State,
        made_jump: BoolScalarLike,
    ) -> tuple[Y, None, DenseInfo, _State, dfx.RESULTS]:
        del made_jump
        state, vector = solver_state, ravel(y0)
        _, *times = in_field_time(terms, t0, t1)
        start, end = (self._problem(t, y0, args, state).with_dense_jacobian() for t in times)

        def inner(y: Array) -> tuple[Array, dfx.RESULTS]:
            # A symmetric method has no memory, so we discard the state of the wrapped solver. The
            # last argument tells it not to use what it kept.
            given = terms, t0, t1, unravel(y, y0), args, state.inner, True
            y1, _, _, _, result = self.solver.step(*given)
            return ravel(y1), result

        def residual(unknowns: tuple[Array, Array]) -> tuple[Array, Array]:
            y, multiplier = unknowns
            candidate, _ = inner(vector + _along(start, vector, multiplier))
            return y - candidate - _along(end, y, multiplier), end.residual(y)

        (y1, multiplier), ok, num_iterations, (candidate, result) = root(
            residual,
            ft.partial(_solved, start, end, inner, vector, self.projection.max_steps),
            (vector, state.multiplier),
            ft.partial(solve_kkt, vector.size),
        )
        info = end.report(candidate, y1, num_iterations, ok=ok)
        off = starts_off_manifold(start, self.manifold, vector)
        cause = failure_cause(info.ok, off, state.values, y1 - candidate)
        y1 = jnp.where(result == dfx.RESULTS.successful, y1, jnp.nan)
        y1, result = nan_if_failed(cause, y1, result)
        dense_info = dict(y0=y0, step=AsArrays(StepOf(self, terms, args, state)))
        statistics = state.statistics.add(info, jnp.nan)
        state = _State(state.inner, state.values, state.cancellation, multiplier, statistics)
        return unravel(y1, y0), None, dense_info, state, result

    def _problem(self, t: RealScalarLike, y0: Y, args: Args, state: _State) -> Problem:
        """The problem at a time of the vector field, with the metric at the start of the step."""
        problem = problem_of(self.manifold, state.values, t, y0, args, state.cancellation)
        return with_options(problem, self.projection, ravel(y0))


SymmetricProjection.__init__.__doc__ = r"""**Arguments:**

- `solver`: a symmetric one-step method with fixed steps, such as
    [`diffrax_conserve.ImplicitMidpoint`][]; `diffrax.HalfSolver` of one, or a method of your own,
    such as the trapezoidal rule. Composed symmetrically from symmetric steps it has a higher order.
    No solver of diffrax is one: explicit Runge-Kutta methods and `SemiImplicitEuler` have another
    adjoint, `LeapfrogMidpoint` and `ReversibleHeun` are reversible only with their memory.
- `manifold`: a PyTree of `FirstIntegral`s without `rate` and of `Constraint`s, on which the solve
    starts.
- `metric`: positive weights $M$, as of a [`diffrax_conserve.SimplifiedNewton`][], which do not
    change. Default: Euclidean.
- `rtol`, `atol`, `max_steps`: as of a `SimplifiedNewton`.

**Raises:**

`ValueError` if `solver` is known not to be symmetric: by its `tableau`, if it is a Runge-Kutta
method with one, by its order, if that is odd, because it has a memory, or because it is a
projection. Of other methods it cannot be told: try a solve forwards and backwards. `TypeError` or
`ValueError` if another argument does not fit.
"""


def _along(problem: Problem, y: Float[Array, " n"], multiplier: Array) -> Float[Array, " n"]:
    """`M⁻¹ G(y)ᵀ μ`, by one reverse pass."""
    _, vjp = jax.vjp(problem.residual, y)
    return problem.factor.to_state(problem.factor.scaled_gradient(vjp(multiplier)[0]))


def _solved(
    start: Problem, end: Problem, inner: Any, y0: Array, max_steps: int, guess: Any
) -> Solved:
    """Simplified Newton's method for `μ`, with the matrix `G₁ M⁻¹ G₁ᵀ + G₀ M⁻¹ G₀ᵀ`, where `G₀` and
    `G₁` are the gradients at both ends of the step.

    The exact matrix has `G₁ Φ' M⁻¹ G₀ᵀ` for the second term, with the derivative `Φ'` of the inner
    step. But the exact flow keeps integrals not only on the manifold but everywhere, `G₁ Φ' = G₀`.
    So both agree up to the error of the step, and no step needs to be differentiated.
    """
    row_scales, first = start.gradients(y0).equilibrated()
    gram0, eps = first.gram(first), eps_of(y0)

    def stepped(multiplier: Array, rows: AbstractRows | None = None) -> _Unknowns:
        """The unknowns with this multiplier. The gradients at the end of the step are needed to
        compute that end, so they are those of the last unknowns, or at the candidate."""
        change = start.factor.to_state(first.rmatvec(multiplier * row_scales))
        candidate, result = inner(y0 + change)
        rows = end.gradients(candidate) if rows is None else rows
        y = candidate + end.factor.to_state(rows.rmatvec(multiplier))
        return _Unknowns(y, multiplier, candidate, result)

    def advance(now: _Unknowns, tests_left: Array) -> tuple[_Unknowns, Array]:
        g, jacobian = end.linearise(now.y)
        rows = end.factor.scaled_rows(jacobian)
        status, residual_to_correct = end.status(g, end.scale(jacobian, now.y))
        # The residual of the equation for the state, with the gradients at that state.
        defect = now.candidate + end.factor.to_state(rows.rmatvec(now.multiplier)) - now.y
        off = end.factor.norm(defect) / (eps * end.factor.norm(jnp.abs(y0) + jnp.abs(now.y)))
        off = jnp.where(jnp.all(defect == 0), 0, off)
        solved = jnp.where(
            off <= NOISE_IN_EPS,
            AT_ROUNDOFF,
            jnp.where(off <= TOLERANCE_IN_EPS, WITHIN_TOLERANCE, ABOVE_TOLERANCE),
        )
        solved = jnp.where(off < jnp.inf, solved, NOT_FINITE)
        tests_left = remaining_after_test(jnp.minimum(status, solved), tests_left)
        # Where the inner step has failed, there is nothing to go on with.
        tests_left = jnp.where(now.result == dfx.RESULTS.successful, tests_left, -1)

        def move() -> _Unknowns:
            scaled = rows.divide_rows(row_scales)
            gram = jtu.tree_map(jnp.add, gram0, scaled.gram(scaled))
            change = (
                gram.solve((residual_to_correct + jacobian.matvec(defect)) / row_scales)
                / row_scales
            )
            return stepped(now.multiplier - change, rows)

        moved = lax.cond(any_lane(tests_left > 0), move, lambda: now)
        return where_active(tests_left, moved, now), tests_left

    solved = iterate(advance, stepped(guess[1]), max_steps=max_steps)
    y, multiplier, candidate, result = solved.y
    return Solved((y, multiplier), solved.ok, solved.num_iterations + 1, (candidate, result))


def _check_symmetric(solver: Any) -> None:
    """Raises if a solver is known not to be symmetric."""
    name = getattr(solver, "__name__", type(solver).__name__)
    remedy = "Pass a symmetric one-step method, such as `diffrax_conserve.ImplicitMidpoint()`"
    if not isinstance(solver, dfx.AbstractSolver):
        raise TypeError(f"`solver` is `{name}`, which is not a diffrax solver. {remedy}.")
    projects = issubclass(type(solver), ForwardingSolver)  # which `isinstance` would not tell
    if projects or _is_known_unsymmetric(innermost(solver)):
        raise ValueError(
            f"`solver` is {name}, which is not symmetric: a step backwards does not undo a step, "
            f"and no projection changes that. {remedy}, or use `ManifoldProjection`."
        )


def _is_known_unsymmetric(solver: dfx.AbstractSolver) -> bool:
    """By the coefficients of a Runge-Kutta method, and of any method by its order, which is even if
    it is symmetric (Hairer, Lubich and Wanner, II.3)."""
    if isinstance(solver, _NOT_SYMMETRIC):
        return True
    tableau = getattr(solver, "tableau", None)
    if tableau is not None:
        tableaus = getattr(tableau, "tableaus", (tableau,))
        return not all(map(_is_symmetric, tableaus))
    order = solver.order(dfx.ODETerm(lambda t, y, args: y))
    return order is not None and order % 2 == 1


def _is_symmetric(tableau: Any) -> bool:
    """Whether `a_{s+1-i,s+1-j} + a_{ij} = b_j` for the stages that the step uses (Hairer, Lubich
    and Wanner, V.2.1). No explicit method satisfies it."""
    if not isinstance(tableau, dfx.ButcherTableau):
        return False  # those of diffrax for noise are explicit
    b = tableau.b_sol
    a = np.zeros((b.size, b.size)) if tableau.a_diagonal is None else np.diag(tableau.a_diagonal)
    for i, row in enumerate(tableau.a_lower, 1):
        a[i, :i] = row
    used = b != 0
    for _ in range(b.size):
        used = used | np.any(a[used] != 0, axis=0)
    a, b = a[used][:, used], b[used]
    return np.allclose(a[::-1, ::-1] + a, b, rtol=0, atol=1e-12)
