"""The derivative of what an iteration finds, by the implicit function theorem.

Whatever solves the equations `F(x, p) = 0` for the unknowns `x`, its derivative by the parameters
`p` is `ẋ = -(∂F/∂x)⁻¹ ∂F/∂p ṗ`. It holds for the unknowns that were computed, whatever the number
of steps, and no step is unrolled. That is one rule, `implicit_solution`. A system of equations
tells how it is solved, what `F` is, and how a linear system with its derivative is solved. The
parameters are the arrays of which it consists: the candidate, the values that are conserved, the
metric, and the parameters of the user's functions.
"""

import abc
import functools as ft
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._constants import MAX_ELIMINATION
from .._tree import tree_tangents, unflatten
from .closures import ClosureConverted
from .iterate import Solved, simplified_newton
from .linear import computed_after
from .problem import Problem
from .rows import AbstractRows


class AbstractSystem(eqx.Module):
    """Equations for unknowns."""

    @abc.abstractmethod
    def solved(self) -> Solved:
        """The unknowns that solve the equations, as far as the iteration gets."""

    @abc.abstractmethod
    def linearisation_point(self, solved: Solved) -> Any:
        """The unknowns `x` at which `F` is linearised. An iteration may return others, such as the
        state in the place of the multipliers."""

    @abc.abstractmethod
    def equations(self, unknowns: Any) -> Any:
        """`F` at these unknowns. Only its tangent by the arrays of the system is used."""

    @abc.abstractmethod
    def solve_linearised(self, solved: Solved, unknowns: Any, t_equations: Any) -> Any:
        """The tangent of what the iteration returns: that of `x` is `-(∂F/∂x)⁻¹ t_equations`."""


@eqx.filter_custom_jvp
def implicit_solution(system: AbstractSystem) -> Solved:
    """What `system.solved()` returns, with the derivative of the unknowns."""
    return system.solved()


@implicit_solution.def_jvp
def _solution_jvp(primals: Any, tangents: Any) -> Any:
    (system,), (t_system,) = primals, tangents
    solved = implicit_solution(system)
    x = system.linearisation_point(solved)
    values, t_values = eqx.filter_jvp(lambda system: system.equations(x), (system,), (t_system,))
    tangent = system.solve_linearised(solved, x, tree_tangents(values, t_values))
    none = jtu.tree_map(lambda _: None, solved)
    return solved, none._replace(y=tangent)


@final
class MultiplierSystem(AbstractSystem):
    """The projection along directions: the state `y = ŷ + S Uᵀ λ` with `g(y) = 0`, where the rows
    of `U` are the `directions`, or the gradients at the candidate `ŷ`.

    The unknowns are the multipliers `λ`, but the iteration returns the state, whose tangent is
    wanted. So `equations` returns the state `ŷ + S Uᵀ λ` beside `g` there.

    Where the gradients of constraints are nearly parallel, as on an almost circular orbit, a
    derivative would divide the error of the candidate's derivative by the sine of their angle. In
    the step of a solve it is of no use there: the candidate moves nearly along the manifold by
    itself. So a constraint whose gradient has an angle to the span of the others with a squared
    sine of at most `√ε` takes no part in the derivative, or little if there are more than four; see
    `rows`. The derivative then has the accuracy of the wrapped solver in that direction. After more
    than `FROZEN_STEPS` iterations the corrections were along the gradients at several states. The
    derivative uses the gradients at the candidate all the same, which differ from them by terms of
    the size of the correction.

    Within bounds only some components are `corrected` in a derivative; see `Bounds.corrected`.

    The result of a failed projection is discarded. In reverse mode its cotangent is zero, but zero
    times a tangent that is not finite would be NaN. So where nothing was found we differentiate at
    the `fallback`, by default the candidate, where the functions should be finite.
    """

    problem: Problem
    candidate: Float[Array, " n"]
    directions: AbstractRows | None = None
    corrected: Callable[[Array, AbstractRows], Array] | None = eqx.field(default=None, kw_only=True)
    fallback: Float[Array, " n"] | None = eqx.field(default=None, kw_only=True)
    iteration: Callable[..., Solved] = eqx.field(
        default=simplified_newton, static=True, kw_only=True
    )
    max_steps: int = eqx.field(static=True, kw_only=True)

    def solved(self) -> Solved:
        given = self.problem, self.candidate, self.directions
        return self.iteration(*given, max_steps=self.max_steps)

    def _start(self, ok: Array) -> Float[Array, " n"]:
        """The candidate, or the fallback if nothing was found."""
        if self.fallback is None:
            return self.candidate
        return jnp.where(ok, self.candidate, self.fallback)

    def _ordered(self, x: Array, known: Array) -> Array:
        """`x`, computed after other numbers if LAPACK solves for the multipliers."""
        return computed_after(x, known) if self.problem.num_residuals > MAX_ELIMINATION else x

    def _directions_at(self, start: Array) -> AbstractRows:
        """The rows of `U`."""
        if self.directions is not None:
            return self.directions
        return self.problem.gradients(start)

    def linearisation_point(self, solved: Solved) -> tuple[Array, Array]:
        """The multipliers `λ`, by `U S⁻¹ (y - ŷ) = U Uᵀ λ`, after the flag that tells `equations`
        where to differentiate: whether a state was found."""
        start = self._ordered(self._start(solved.ok), solved.y)
        y = jnp.where(solved.ok, solved.y, start)
        change = self.problem.factor.to_euclidean(y - start)
        if self.corrected is None:
            norms, directions = self._directions_at(start).normalised()
            rows = directions
        else:  # of components that are not corrected the derivative is not that of `ŷ + S Uᵀ λ`
            _, rows, norms, directions, _ = self._linearised(y, start)
        return solved.ok, rows.multiplier(change, directions) / norms

    def _linearised(
        self, y: Array, start: Array
    ) -> tuple[Array, AbstractRows, Array, AbstractRows, Array | bool]:
        """The norms of the rows `G(y) S`, and the rows divided by them; likewise the directions;
        and which components of the state are corrected. Others are zero in the rows. In directions
        they are too unless the metric is a matrix, so that norms are of what is corrected."""
        factor, corrected = self.problem.factor, True
        jacobian, directions = self.problem.linearise(y)[1], self._directions_at(start)
        if self.corrected is not None:
            corrected = self.corrected(y, jacobian)
            jacobian = jacobian.scale_columns(corrected.astype(y.dtype))
            if not factor.is_dense:
                directions = directions.scale_columns(corrected.astype(y.dtype))
        rows = factor.scaled_rows(jacobian)
        return *rows.normalised(), *directions.normalised(), corrected

    def equations(self, unknowns: tuple[Array, Array]) -> tuple[Array, Array]:
        ok, multiplier = unknowns
        start = self._start(ok)
        if self.directions is not None:
            change = self.directions.rmatvec(multiplier)
        else:  # `G(ŷ)ᵀ λ` by one reverse pass, instead of one for each row of `G`
            _, vjp = jax.vjp(self.problem.residual, start)
            change = self.problem.factor.scaled_gradient(vjp(multiplier)[0])
        end = start + self.problem.factor.to_state(change)
        # Both are evaluated at the state, so that the tangent of `g` contains that of the state.
        return end, self.problem.residual(end)

    def solve_linearised(
        self, solved: Solved, unknowns: tuple[Array, Array], t_equations: tuple[Array, Array]
    ) -> Array:
        """With `ẏ` and `ġ` for the tangents of both equations at constant `λ`, `G(y) S Uᵀ λ̇ = -ġ`,
        and the tangent of the state is `ẏ + S Uᵀ λ̇`."""
        t_y, t_g = t_equations
        problem, start = self.problem, self._start(solved.ok)
        y = self._ordered(jnp.where(solved.ok, solved.y, start), unknowns[1])
        row_norms, rows, _, directions, corrected = self._linearised(y, start)
        change = rows.gram(directions).row_space_correction(
            directions,
            t_g / row_norms,
            pivot_tolerance=rows.derivative_pivot_tolerance(),
        )
        return t_y - jnp.where(corrected, problem.factor.to_state(change), 0)


@jax.custom_jvp
def nan_tangent_unless(y: Array, is_known: Any) -> Array:
    """`y`, whose derivative is NaN unless it is known."""
    del is_known
    return y


@nan_tangent_unless.defjvp
def _nan_tangent_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    y, is_known = primals
    one_or_nan = lax.stop_gradient(jnp.where(is_known, 1, jnp.nan)).astype(y.dtype)
    return y, one_or_nan * tangents[0]


@final
class SquareSystem(AbstractSystem):
    """Any equations, `residual(x) = 0`, with as many numbers as unknowns, and a function that
    solves them from a guess. `solve` takes the Jacobian as `jacobian(residual)` returns it. Where
    nothing was found it differentiates at the `fallback`, as `MultiplierSystem` does."""

    residual: Callable[[Any], Any]
    iterate: Callable[[Any], Solved]
    guess: Any
    fallback: Any
    solve: Callable[[Array, Float[Array, " n"]], Float[Array, " n"]] = eqx.field(static=True)
    jacobian: Callable[[Any], Callable[[Array], Array]] = eqx.field(static=True)

    def solved(self) -> Solved:
        return self.iterate(self.guess)

    def linearisation_point(self, solved: Solved) -> Any:
        return jtu.tree_map(ft.partial(jnp.where, solved.ok), solved.y, self.fallback)

    def equations(self, unknowns: Any) -> Any:
        return self.residual(unknowns)

    def solve_linearised(self, solved: Solved, unknowns: Any, t_equations: Any) -> Any:
        flat = _flat(unknowns)
        matrix = self.jacobian(lambda x: _flat(self.residual(unflatten(x, unknowns))))(flat)
        matrix = computed_after(matrix, unknowns)  # that of linear equations does not need them
        return unflatten(self.solve(matrix, -_flat(t_equations)), unknowns)


def root(
    residual: Callable[[Any], Any],
    iterate: Callable[[Any], Solved],
    guess: Any,
    solve: Callable[[Array, Float[Array, " n"]], Float[Array, " n"]],
    jacobian: Callable[[Any], Callable[[Array], Array]] = jax.jacfwd,
    *,
    fallback: Any = None,
) -> Solved:
    """The root of `residual` that `iterate(guess)` finds, for unknowns that are an array or a
    PyTree of them. Its derivative is by the theorem, with `solve(matrix, vector)` for linear
    systems, where the matrix is `jacobian(residual)(unknowns)` with flat unknowns. The arrays over
    which the functions close, such as parameters, have their derivatives too. If nothing is found
    the derivative is that at the `fallback`, by default the guess."""
    residual, iterate = (ClosureConverted(fn, guess) for fn in (residual, iterate))
    fallback = guess if fallback is None else fallback
    return implicit_solution(SquareSystem(residual, iterate, guess, fallback, solve, jacobian))


def _flat(tree: Any) -> Float[Array, " n"]:
    return jnp.concatenate([jnp.ravel(x) for x in jtu.tree_leaves(tree)])
