"""The nearest state on the constraints, where some unknowns are free.

The equations `F(t, y, y') = 0` do not differentiate the directions `N` with `∂F/∂y' N = 0`, such as
forces and currents. A state moves along them as far as the constraints ask for, and in all other
directions as little as possible. So a change of the state is `δ = S e + N z`, with the units `S` of
the unknowns that are not free, and for a residual `r`

    min |e|²/2  subject to  A e + B z = r,    A = G S,  B = G N,

where `G` is the constraint Jacobian. The result is `e = Aᵀ μ`, with

    [A Aᵀ  B] [μ]   [r]
    [Bᵀ    0] [z] = [0].

Elsewhere free unknowns are those with large units. That does not do where they are in more
constraints than they can meet: where cells in parallel have one voltage, the differences of its
constraints are a relation of their charges, and large units would hide it by roundoff.
"""

from typing import Any

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._numerics.implicit import root
from .._numerics.iterate import Solved, iterate, remaining_after_test
from .._numerics.lanes import where_active
from .._numerics.problem import Problem
from .._numerics.rows import DenseRows
from .newton import solve_equilibrated


def nearest_with_free(
    problem: Problem,
    candidate: Float[Array, " n"],
    units: Float[Array, " n"],
    along: Float[Array, "n f"],
    moves: Bool[Array, "*m f"] | bool = True,
    *,
    max_steps: int,
) -> Solved:
    """The state on the manifold that is nearest to a candidate, by Newton's method.

    The directions of the corrections are those at the candidate, and have no derivative.

    - `units`: of the unknowns that are not free, zero for all others and for what does not move.
    - `along`: the columns of `N`.
    - `moves`: along which of them the state may move, or may do so for which constraint.
    """

    problem = problem.with_dense_jacobian()

    def linearised(y: Float[Array, " n"]) -> tuple[Float[Array, " m"], DenseRows]:
        g, rows = problem.linearise(y)
        assert isinstance(rows, DenseRows)
        return g, rows

    jacobian = linearised(candidate)[1].matrix
    directions = lax.stop_gradient(_directions(jacobian, units, along, moves))
    # What no unknown that moves can correct must hold as it is.
    uncorrectable = jnp.diag(jnp.all(directions == 0, axis=0).astype(directions.dtype))

    def state(multiplier: Float[Array, " m"]) -> Float[Array, " n"]:
        return candidate + directions @ multiplier

    def residual(multiplier: Float[Array, " m"]) -> Float[Array, " m"]:
        return problem.residual(state(multiplier))

    def newton(begin: Float[Array, " m"]) -> Solved:
        """The multipliers, and the state, to which corrections are added: computed from the
        candidate, a component that vanishes would keep its roundoff."""

        def advance(now: tuple[Array, Array], tests_left: Array) -> tuple[Any, Array]:
            multiplier, y = now
            g, rows = linearised(y)
            status, to_correct = problem.status(g, problem.scale(rows, y))
            tests_left = remaining_after_test(status, tests_left)
            change = solve_equilibrated(rows.matrix @ directions + uncorrectable, to_correct)
            moved = multiplier - change, y - directions @ change
            return where_active(tests_left, moved, now), tests_left

        found = iterate(advance, (begin, state(begin)), max_steps=max_steps)
        multiplier, y = found.y
        return found._replace(y=multiplier, aux=y)

    none = jnp.zeros(problem.num_residuals, candidate.dtype)
    found = root(residual, newton, none, solve_equilibrated)
    y = state(found.y)
    return found._replace(y=y + lax.stop_gradient(found.aux - y), aux=None)


def _directions(
    jacobian: Float[Array, "m n"],
    units: Float[Array, " n"],
    along: Float[Array, "n f"],
    moves: Bool[Array, "*m f"] | bool,
) -> Float[Array, "n m"]:
    """The changes of the state, one for each constraint, that change its residual alone, by one.

    The linear system is equilibrated: each column of `B` is divided by its largest element, as a
    share of the largest in the row, and then each row of `A` and `B` by its largest element.
    """
    m, f = len(jacobian), along.shape[1]
    scaled, by_free = jacobian * units, jnp.where(moves, jacobian @ along, 0)
    columns = _largest(by_free / _largest(by_free, 1), 0)
    both = jnp.concatenate([scaled, by_free / columns], 1)
    rows = _largest(both, 1)
    scaled, by_free = jnp.split(both / rows, [len(units)], axis=1)
    matrix = jnp.block([[scaled @ scaled.T, by_free], [by_free.T, jnp.zeros((f, f), units.dtype)]])
    # Empty rows, of what cannot be corrected or does not move, have the solution zero.
    matrix = matrix + jnp.diag(jnp.all(matrix == 0, axis=1).astype(units.dtype))
    solution = solve_equilibrated(matrix, jnp.eye(m + f, m, dtype=units.dtype))
    change = units[:, None] * (scaled.T @ solution[:m]) + along @ (solution[m:] / columns.T)
    return change / rows.T


def _largest(matrix: Float[Array, "m n"], axis: int) -> Array:
    """The largest elements of the rows or columns, one where all are zero."""
    largest = jnp.max(jnp.abs(matrix), axis=axis, keepdims=True, initial=0)
    return jnp.where(largest > 0, largest, 1)
