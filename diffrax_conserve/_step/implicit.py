"""The derivative of what an iteration finds, by the implicit function theorem.

Whatever solves the equations `F(x, p) = 0` for the unknowns `x`, its derivative by the parameters
`p` is `ẋ = -(∂F/∂x)⁻¹ ∂F/∂p ṗ`. It holds for the unknowns that were computed, whatever the number
of steps, and no step is unrolled. That is one rule, `solution`. A system of equations says how it
is solved, what `F` is, and how a linear system with its derivative is solved. The parameters are
the arrays of which it consists: the candidate, the values that are conserved, the units, parameters
of the user's functions.
"""

import abc
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float

from .._constants import ROUNDOFF, WRITTEN_OUT
from .._tree import tree_tangents, unflatten, without_pattern
from .equations import Equations, Jacobian
from .iterate import Solved, nearby
from .linear import combined, corrected, eliminated, gram_matrix, scaled_rows, solve, times
from .metric import measured


class AbstractSystem(eqx.Module):
    """Equations for unknowns. What is not an array, such as an option, must be static."""

    @abc.abstractmethod
    def found(self) -> Solved:
        """The unknowns that solve the equations, as far as the iteration gets."""

    @abc.abstractmethod
    def unknowns(self, solved: Solved) -> Any:
        """All unknowns `x`, of which an iteration may return only some."""

    @abc.abstractmethod
    def defect(self, unknowns: Any) -> Any:
        """`F` at these unknowns. It is only differentiated, by the arrays of the system."""

    @abc.abstractmethod
    def linear_solution(self, solved: Solved, right: Any) -> Any:
        """`(∂F/∂x)⁻¹ right`, for the unknowns that the iteration returns."""


@eqx.filter_custom_jvp
def solution(system: AbstractSystem) -> Solved:
    """What `system.found()` returns, with the derivative of the unknowns."""
    return system.found()


@solution.def_jvp
def _solution_jvp(primals: Any, tangents: Any) -> Any:
    (system,), (t_system,) = primals, tangents
    solved = solution(system)
    x = system.unknowns(solved)
    defect, t_defect = eqx.filter_jvp(lambda system: system.defect(x), (system,), (t_system,))
    right = tree_tangents(defect, t_defect)
    tangent = system.linear_solution(solved, jtu.tree_map(jnp.negative, right))
    none = jtu.tree_map(lambda _: None, solved)
    return solved, none._replace(y=tangent)


@final
class Along(AbstractSystem):
    """The projection along directions: the state `y = ŷ + S Uᵀ λ` with `g(y) = 0`, where the rows
    of `U` are the `directions`, or the gradients at the candidate `ŷ`.

    The unknowns are `y` and `λ`, and the equations `ŷ + S Uᵀ λ - y = 0` and `g(y) = 0`.

    The result of a failed projection is discarded. In reverse mode its cotangent is zero, but zero
    times a tangent that is not finite would be NaN. So where nothing was found we differentiate at
    the `fallback`, by default the candidate, where the functions should be finite.
    """

    equations: Equations
    candidate: Float[Array, " n"]
    directions: Jacobian | None = None
    fallback: Float[Array, " n"] | None = eqx.field(default=None, kw_only=True)
    iteration: Callable[..., Solved] = eqx.field(default=nearby, static=True, kw_only=True)
    max_steps: int = eqx.field(static=True, kw_only=True)

    def found(self) -> Solved:
        given = self.equations, self.candidate, self.directions
        return self.iteration(*given, max_steps=self.max_steps)

    def _start(self, ok: Array) -> Float[Array, " n"]:
        """The candidate, or the fallback if nothing was found."""
        if self.fallback is None:
            return self.candidate
        return jnp.where(ok, self.candidate, self.fallback)

    def _along(self, start: Array) -> Jacobian:
        """The rows of `U`."""
        if self.directions is not None:
            return self.directions
        return self.equations.in_units(self.equations.linearise(start)[1])

    def unknowns(self, solved: Solved) -> tuple[Array, Array]:
        """Whether a state was found, and the multipliers `λ`, by `U S⁻¹ (y - ŷ) = U Uᵀ λ`, from
        which the state follows."""
        start = self._start(solved.ok)
        sizes, rows = scaled_rows(self._along(start))
        change = measured(jnp.where(solved.ok, solved.y, start) - start, self.equations.units)
        return solved.ok, solve(gram_matrix(rows, rows), times(rows, change)) / sizes

    def defect(self, unknowns: tuple[Array, Array]) -> tuple[Array, Array]:
        ok, multiplier = unknowns
        start = self._start(ok)
        if self.directions is not None:
            change = combined(multiplier, self.directions)
        else:  # `G(ŷ)ᵀ λ` by one reverse pass, instead of one for each row of `G`
            _, vjp = jax.vjp(self.equations.residual, start)
            change = self.equations.in_units(vjp(multiplier)[0])
        end = start + self.equations.change(change)
        # The second equation at the end of the correction, so that its tangent contains the first.
        return end, self.equations.residual(end)

    def linear_solution(self, solved: Solved, right: tuple[Array, Array]) -> Array:
        """With `ẏ` and `ġ` for the tangents of both equations at constant `λ`, `G(y) S Uᵀ λ̇ = -ġ`,
        and the tangent of the state is `ẏ + S Uᵀ λ̇`."""
        t_y, t_g = (-x for x in right)
        equations, start = self.equations, self._start(solved.ok)
        y = jnp.where(solved.ok, solved.y, start)
        heights, rows = scaled_rows(equations.in_units(equations.linearise(y)[1]))
        along = scaled_rows(self._along(start))[1]
        t_y = t_y - equations.change(corrected(rows, along, t_g / heights))
        # `more` tells whether the state is of the form above.
        is_known = solved.more & well_conditioned(equations, y, rows, along)
        return known_if(is_known | ~solved.ok, t_y)


def well_conditioned(
    equations: Equations, y: Float[Array, " n"], rows: Jacobian, along: Jacobian
) -> Bool[Array, ""]:
    """Whether a derivative at the state `y` that is solved for with `rows alongᵀ` has digits.

    The error of the derivative is one unit of roundoff over the pivot of a constraint. So half of
    its digits are right if no pivot is below the root of roundoff. A constraint that depends on
    others everywhere does no harm. To tell it from one whose gradient is nearly parallel only here,
    we look at another state, each component of which has the same sign and another size. More than
    four constraints are not tested.
    """
    if len(rows) > WRITTEN_OUT:
        return jnp.asarray(True)
    eps = float(jnp.finfo(y.dtype).eps)
    determined = _pivots(rows, along) >= eps**0.5
    if len(rows) == 1:
        return jnp.all(determined)
    elsewhere = y * (1 + without_pattern(y.size, y.dtype) / 2)
    beside = scaled_rows(equations.in_units(equations.linearise(elsewhere)[1]))[1]
    return jnp.all(determined | (_pivots(beside, beside) <= ROUNDOFF * eps))


def _pivots(rows: Any, along: Any) -> Float[Array, " m"]:
    lengths = jnp.linalg.norm(rows, axis=1) * jnp.linalg.norm(along, axis=1)
    pivots = eliminated(gram_matrix(rows, along), lengths, rows)[2]
    return jnp.where(lengths > 0, jnp.abs(pivots) / jnp.where(lengths > 0, lengths, 1), 1)


def known_if(is_known: Any, tangent: Array) -> Array:
    """A tangent, or NaN where it is not known."""
    return lax.stop_gradient(jnp.where(is_known, 1, jnp.nan)).astype(tangent.dtype) * tangent


@jax.custom_jvp
def certain(y: Array, is_known: Any, like: Array) -> Array:
    """`y`, with the derivative of `like` where it is known, and NaN elsewhere."""
    del is_known, like
    return y


@certain.defjvp
def _certain_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    y, is_known, _ = primals
    return y, known_if(is_known, tangents[2])


@final
class SquareSystem(AbstractSystem):
    """Any equations, `residual(x) = 0`, with as many numbers as unknowns, and a function that
    solves them from a guess. The linear systems have their dense Jacobian."""

    residual: Callable[[Any], Any]
    iterate: Callable[[Any], Solved]
    guess: Any
    solve: Callable[[Float[Array, "n n"], Float[Array, " n"]], Float[Array, " n"]] = eqx.field(
        static=True
    )

    def found(self) -> Solved:
        return self.iterate(self.guess)

    def unknowns(self, solved: Solved) -> Any:
        return solved.y

    def defect(self, unknowns: Any) -> Any:
        return self.residual(unknowns)

    def linear_solution(self, solved: Solved, right: Any) -> Any:
        matrix = jax.jacfwd(lambda x: _flat(self.residual(unflatten(x, solved.y))))
        return unflatten(self.solve(matrix(_flat(solved.y)), _flat(right)), solved.y)


def root(
    residual: Callable[[Any], Any],
    iterate: Callable[[Any], Solved],
    guess: Any,
    solve: Callable[[Float[Array, "n n"], Float[Array, " n"]], Float[Array, " n"]],
) -> Solved:
    """The root of `residual` that `iterate(guess)` finds, for unknowns that are an array or a
    PyTree of them. Its derivative is by the theorem, with `solve(matrix, vector)` for linear
    systems. The arrays over which the functions close, such as parameters, have their derivatives
    too."""
    residual, iterate = (eqx.filter_closure_convert(fn, guess) for fn in (residual, iterate))
    return solution(SquareSystem(residual, iterate, guess, solve))


def _flat(tree: Any) -> Float[Array, " n"]:
    return jnp.concatenate([jnp.ravel(x) for x in jtu.tree_leaves(tree)])
