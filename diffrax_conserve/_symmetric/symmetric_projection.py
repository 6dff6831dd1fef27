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
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from .._custom_types import Args, BoolScalarLike, DenseInfo, Manifold, RealScalarLike, Y
from .._interpolation import PackedTarget
from .._manifold import check_manifold, conserved_values, named_entries, rate_of
from .._projection.base import Target
from .._projection.chord import after_test, counter
from .._projection.elimination import combined, gram_matrix, gram_solve, scaled_rows, times
from .._projection.equations import NOT_FINITE, OFF, ON, SETTLED, Equations, any_lane, length
from .._projection.implicit import certain
from .._projection.options import MAX_STEPS, check_state
from .._projection.simplified_newton import SimplifiedNewton
from .._solver.diffrax_private import member
from .._solver.state import FIRST, ProjectionStatistics, cause_of_failure, started, violated
from .._solver.terms import check_nested, innermost, is_backsolve, time_direction
from .._solver.wrapper import ForwardingSolver
from .._tree import ravel, unravel
from .shorter_step import ShorterStep, StepOf, root

# The equation for the end of the step counts as nearly solved if its defect is at most this many
# units of roundoff of the state. From there one more iteration is enough, because each reduces the
# defect by much more than this factor.
_NEARLY_SOLVED = 64
# At this many units of roundoff the defect is only the rounding of the state and of the sum.
_SOLVED = 2
# Where a coefficient of a tableau should be zero, the sum of two others may be this, because they
# are given with 16 digits. Elsewhere the relative tolerance of numpy applies.
_ZERO_COEFFICIENT = 1e-14


class _State(eqx.Module):
    """What the next step needs: the state of the wrapped solver, the conserved values, the part of
    the scales that the gradients do not show, the last multiplier as a guess, and statistics."""

    inner: Any
    values: Float[Array, " m"]
    hidden: Float[Array, " m"]
    multiplier: Float[Array, " m"]
    statistics: ProjectionStatistics


class _Iterate(NamedTuple):
    """One iterate of the two equations of a step.

    - `y`, `multiplier`: the unknowns, the state `y_{n+1}` and `μ`.
    - `candidate`: the end of the inner step with this multiplier, `ỹ_{n+1}`.
    - `wrong`: what the next change of the multiplier must correct, the residual of the constraints
      and what the defect of the equation for the state will change in it.
    - `noise`: that of the residuals.
    - `rows`: the gradients at `y`, in the units.
    - `left`, `num_steps`: the tests that are left, see `chord.counter`, and the inner steps made.
    - `result`: that of the inner step.
    """

    y: Float[Array, " n"]
    multiplier: Float[Array, " m"]
    candidate: Float[Array, " n"]
    wrong: Float[Array, " m"]
    noise: Float[Array, " m"]
    rows: Float[Array, "m n"]
    left: Int[Array, ""]
    num_steps: Int[Array, ""]
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

    The conserved values are those at the start of the solve. A state at a saved time comes from a
    shorter step. Derivatives follow from the implicit function theorem. A step that fails is NaN,
    and the `diffrax.RESULTS` tells why, as with `ManifoldProjection`, and
    [`diffrax_conserve.statistics`][] has the number of iterations, each of which is one step of the
    wrapped solver: about four. Steps are fixed, because a step size that follows an error estimate
    is not symmetric. By default the metric is Euclidean: that of motion depends on the past.

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
        check_nested(self)
        check_manifold(manifold)
        for name, entry in named_entries(manifold):
            if rate_of(entry) is not None:
                raise ValueError(
                    f"`{name}` has a `rate`: what gains or loses is not reversible. Keep balances "
                    "by `ManifoldProjection`."
                )

    def init(
        self,
        terms: PyTree[dfx.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> _State:
        if is_backsolve(terms):
            raise ValueError(
                "`SymmetricProjection` cannot solve the adjoint equations of `BacksolveAdjoint`, "
                "whose state is not on the manifold. Use `diffrax.RecursiveCheckpointAdjoint()`."
            )
        check_state(y0, kind=jnp.inexact)
        t = t0 * time_direction(terms, t0)
        values = conserved_values(self.manifold, t, y0, args)
        values, hidden = started(values, self.manifold, t, y0, args)
        statistics = ProjectionStatistics.zero(self.manifold, values.dtype)
        inner = self.solver.init(terms, t0, t1, y0, args)
        return _State(inner, values, hidden, jnp.zeros_like(values), statistics)

    @eqx.filter_jit  # traced once; diffrax alone traces a step three times
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
        direction = time_direction(terms, t0)
        target = Target(
            self.projection, self.manifold, state.values, state.hidden, None, args, direction
        )
        start, end = (target.equations(t, y0).dense() for t in (t0, t1))

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

        def iterate(guess: tuple[Array, Array]) -> tuple[tuple[Array, Array], _Iterate]:
            found = _iterated(start, end, inner, vector, guess[1], self.projection.max_steps)
            return (found.y, found.multiplier), found

        (y1, multiplier), found = root(
            residual, (vector, state.multiplier), iterate, ft.partial(_tangent, vector.size)
        )
        y1 = _differentiable(y1, certain(end, found.candidate, y1, end.linearise(y1)[1]))
        problem = target.problem(t1, y0)
        info = problem.report(found.candidate, y1, found.num_steps, ok=found.left != -1)
        off = violated(start, self.manifold, vector) | ~jnp.all(jnp.isfinite(state.values))
        failed = cause_of_failure(info.ok, off, (vector, found.candidate, y1), None, None)
        inner_failed = found.result != dfx.RESULTS.successful
        y1 = unravel(jnp.where((failed > 0) | inner_failed, jnp.nan, y1), y0)
        result = dfx.RESULTS.where(
            (failed == 0) | (inner_failed & ~off), found.result, member(FIRST - 1 + failed)
        )
        dense_info = dict(y0=y0, step=PackedTarget(StepOf(self, terms, args, state)))
        statistics = state.statistics.add(info, None, None)
        state = _State(state.inner, state.values, state.hidden, multiplier, statistics)
        return y1, None, dense_info, state, result


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

`ValueError` if `solver` is known not to be symmetric: a solver of diffrax, a Runge-Kutta method
whose coefficients tell, or a projection. Of other methods it cannot be told: try a solve forwards
and backwards. `TypeError` or `ValueError` if another argument does not fit.
"""


def _along(equations: Equations, y: Float[Array, " n"], multiplier: Array) -> Float[Array, " n"]:
    """`M⁻¹ G(y)ᵀ μ`, by one reverse pass."""
    _, vjp = jax.vjp(equations.residual, y)
    return equations.moved(equations.scaled(vjp(multiplier)[0]))


def _iterated(
    start: Equations, end: Equations, inner: Any, y0: Array, multiplier: Array, max_steps: int
) -> _Iterate:
    """Simplified Newton's method for `μ`, with the matrix `G₁ M⁻¹ G₁ᵀ + G₀ M⁻¹ G₀ᵀ`, where `G₀` and
    `G₁` are the gradients at both ends of the step.

    The exact matrix has `G₁ Φ' M⁻¹ G₀ᵀ` for the second term, with the derivative `Φ'` of the inner
    step. But the exact flow keeps integrals not only on the manifold but everywhere, `G₁ Φ' = G₀`.
    So both agree up to the error of the step, and no step needs to be differentiated.
    """
    sizes, first = scaled_rows(start.scaled(start.linearise(y0)[1]))
    gram0, eps = gram_matrix(first, first), float(jnp.finfo(y0.dtype).eps)

    def tested(multiplier: Array, near: Array | None, left: Array, count: Array) -> _Iterate:
        """The iterate with this multiplier. The gradients at its end are needed to compute the end
        itself, so they are first taken from `near`, those of the last iterate, or at the candidate.
        By those at the end we measure the defect that this leaves."""
        candidate, result = inner(y0 + start.moved(combined(multiplier * sizes, first)))
        rows = end.scaled(end.linearise(candidate)[1]) if near is None else near
        y = candidate + end.moved(combined(multiplier, rows))
        g, jacobian = end.linearise(y)
        rows = end.scaled(jacobian)
        defect = candidate + end.moved(combined(multiplier, rows)) - y
        level, noise = end.level(g, end.scale(jacobian, y))
        off = length(defect, end.units) / length(jnp.abs(y0) + jnp.abs(y), end.units)
        solved = jnp.where(
            off <= _SOLVED * eps, SETTLED, jnp.where(off <= _NEARLY_SOLVED * eps, ON, OFF)
        )
        solved = jnp.where(
            off < jnp.inf, solved, jnp.where(jnp.all(defect == 0), SETTLED, NOT_FINITE)
        )
        failed = result != dfx.RESULTS.successful
        level = jnp.where(failed, NOT_FINITE, jnp.minimum(level, solved))
        left = jnp.where(failed, -1, after_test(level, left, extra=1, gives_up=left > 0))
        wrong = g + times(jacobian, defect)
        return _Iterate(y, multiplier, candidate, wrong, noise, rows, left, count, result)

    def body(last: _Iterate) -> _Iterate:
        rows = last.rows / sizes[:, None]
        gram = gram0 + gram_matrix(rows, rows)
        change = gram_solve(gram, last.wrong / sizes, last.noise / sizes) / sizes
        found = tested(last.multiplier - change, last.rows, last.left, last.num_steps + 1)
        # In a batch a lane that is done stays as it is while others go on.
        return jtu.tree_map(lambda a, b: jnp.where(last.left > 0, a, b), found, last)

    first_iterate = tested(multiplier, None, counter(max_steps), jnp.asarray(1))
    return lax.while_loop(lambda x: any_lane(x.left > 0), body, first_iterate)


def _tangent(size: int, matrix: Float[Array, "N N"], right: Float[Array, " N"]) -> Array:
    """Solves the linear system for the tangents of the state, of the given size, and of the
    multiplier, by eliminating the state. Only the rest, the Schur complement, may be singular, if
    constraints depend on each other."""
    (a, b), (c, d) = (jnp.split(rows, [size], axis=1) for rows in jnp.split(matrix, [size]))
    above, below = jnp.split(right, [size])
    along, at = jnp.linalg.solve(a, b), jnp.linalg.solve(a, above)
    multiplier = gram_solve(d - c @ along, below - c @ at)
    return jnp.concatenate([at - along @ multiplier, multiplier])


@jax.custom_jvp
def _differentiable(y: Float[Array, " n"], factor: Float[Array, ""]) -> Float[Array, " n"]:
    """`y`, whose tangent is multiplied by a factor: one, or NaN if the tangent is not
    determined."""
    del factor
    return y


@_differentiable.defjvp
def _differentiable_jvp(primals: Any, tangents: Any) -> Any:
    return primals[0], lax.stop_gradient(primals[1]) * tangents[0]


def _check_symmetric(solver: Any) -> None:
    """Raises if a solver is known not to be symmetric."""
    name = getattr(solver, "__name__", type(solver).__name__)
    remedy = "Pass a symmetric one-step method, such as `diffrax_conserve.ImplicitMidpoint()`"
    if not isinstance(solver, dfx.AbstractSolver):
        raise TypeError(f"`solver` is `{name}`, which is not a diffrax solver. {remedy}.")
    inner = innermost(solver)
    tableau = getattr(inner, "tableau", None)
    if isinstance(tableau, dfx.ButcherTableau):
        symmetric = _is_symmetric(tableau)
    else:
        symmetric = not type(inner).__module__.startswith("diffrax.")
    projects = issubclass(type(solver), ForwardingSolver)  # which `isinstance` would not tell
    if projects or not symmetric:
        raise ValueError(
            f"`solver` is {name}, which is not symmetric: a step backwards does not undo a step, "
            f"and no projection changes that. {remedy}, or use `ManifoldProjection`."
        )


def _is_symmetric(tableau: dfx.ButcherTableau) -> bool:
    """Whether a Runge-Kutta method is symmetric, `a[s+1-i, s+1-j] + a[i, j] = b[j]` (Hairer, Lubich
    and Wanner, V.2)."""
    b = np.asarray(tableau.b_sol)
    a = np.zeros((b.size, b.size))
    for i, row in enumerate(tableau.a_lower):
        a[i + 1, : i + 1] = row
    if tableau.a_diagonal is not None:
        a += np.diag(tableau.a_diagonal)
    return bool(np.allclose(a + a[::-1, ::-1], b, atol=_ZERO_COEFFICIENT))
