"""The implicit function theorem, for the state and the multipliers of a projection."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
from jaxtyping import Array, PyTree

from .._custom_types import Y
from .._tree import tree_add, tree_mul, tree_scale, tree_sub, tree_tangents
from .certainty import certain
from .elimination import Vector
from .jacobian import AbstractJacobian
from .linearise import linearise

# Systems with more unknowns are solved iteratively, without forming the matrix.
SYSTEM_DENSE_MAX = 256


def units(jacobian: AbstractJacobian, weights: Y) -> tuple[Y, Vector]:
    """Units for the components of the state and for the residuals that make the condition number of
    a system independent of the user's units: the square roots of the weights, and the norms of the
    rows of `G` in that metric."""
    roots = jtu.tree_map(jnp.sqrt, weights)
    return jtu.tree_map(lambda x: jnp.where(x > 0, x, 1), (roots, jacobian.scale(roots)))


def solve_linearised(
    fn: Callable[[Any], Any],
    unknowns: tuple[Y, Vector],
    right: tuple[Y, Vector],
    measured_in: tuple[Y, Vector],
) -> tuple[Y, Vector]:
    """The minimum-norm solution of `F' x = right`, where `F'` is the Jacobian of `fn` at
    `unknowns`. The unknowns are a state and multipliers; `fn` returns a state and residuals of the
    same shapes."""
    rows = lax.stop_gradient(measured_in)
    columns = rows[0], jtu.tree_map(lambda x: 1 / x, rows[1])

    def divided(a: PyTree[Array], b: PyTree[Array]) -> PyTree[Array]:
        return jtu.tree_map(jnp.divide, a, b)

    def scaled(x: tuple[Y, Vector]) -> tuple[Y, Vector]:
        return divided(fn(jtu.tree_map(jnp.multiply, x, columns)), rows)

    x, unravel = jfu.ravel_pytree(divided(unknowns, columns))
    b, _ = jfu.ravel_pytree(divided(right, rows))

    def flat(x: Array) -> Array:
        return jfu.ravel_pytree(scaled(unravel(x)))[0]

    if x.size > SYSTEM_DENSE_MAX:

        def product(v: Array) -> Array:
            return jax.jvp(flat, (x,), (v,))[1]

        solution = lax.custom_linear_solve(product, b, _iteratively, _iteratively)
    else:
        rcond = 64 * float(jnp.finfo(x.dtype).eps)
        solution = _shortest(jax.jacfwd(flat)(x), b, rcond)
    return jtu.tree_map(jnp.multiply, unravel(solution), columns)


def _iteratively(product: Callable[[Array], Array], b: Array) -> Array:
    """The solution of `product(x) = b`, NaN where it is not found."""
    eps = float(jnp.finfo(b.dtype).eps)
    largest = jnp.max(jnp.abs(b))
    size = jnp.where(largest > 0, largest, 1)  # because tolerances are absolute
    operator = lx.FunctionLinearOperator(product, jax.eval_shape(lambda: b))
    solver = lx.GMRES(rtol=eps ** (2 / 3), atol=eps ** (2 / 3))
    x = lx.linear_solve(operator, b / size, solver, throw=False).value
    found = jnp.max(jnp.abs(product(x) - b / size)) <= jnp.sqrt(eps)
    return jnp.where(found, x, jnp.nan) * size


def _shortest(matrix: Array, b: Array, rcond: float) -> Array:
    """By singular values, because dependent constraints make the system singular but consistent. If
    `matrix` is not finite the solution is NaN, in forward and in reverse mode."""
    u, s, vt = jnp.linalg.svd(lax.stop_gradient(finite_or_nan(matrix)))
    inverse = jnp.where(s > rcond * s[0], 1 / s, 0)

    def solve(_: Any, b: Array) -> Array:
        return vt.T @ (inverse * (u.T @ b))

    def transposed(_: Any, b: Array) -> Array:
        return u @ (inverse * (vt @ b))

    return lax.custom_linear_solve(lambda x: matrix @ x, b, solve, transposed)


def finite_or_nan(matrix: Array) -> Array:
    """Without infinities: LAPACK's singular value decomposition never returns from one."""
    return jnp.where(jnp.isfinite(matrix), matrix, jnp.nan)


def optimality(unknowns: tuple[Y, Vector], parameters: Any) -> tuple[Y, Vector]:
    """`y - clip(ŷ + M⁻¹ G(y)ᵀ λ)` and `g(y)`."""
    g, _, x = _displaced(*unknowns, parameters)
    return tree_sub(unknowns[0], x), g


def _displaced(base: Y, multiplier: Vector, parameters: Any) -> tuple[Vector, Y, Y]:
    """`g(base)`, `ŷ + M⁻¹ G(base)ᵀ λ`, and this clipped to the box, if there is one."""
    residual, candidate, weights, box = parameters
    g, vjp = eqx.filter_vjp(residual, base)  # by one reverse pass, not row by row
    (direction,) = vjp(multiplier)
    z = tree_add(candidate, tree_mul(direction, weights))
    return g, z, z if box is None else box.clip(z)


def differentiated(
    solution: tuple[Y, Vector, Any], primals: Any, tangents: Any, *, frozen: bool
) -> tuple[Any, Any]:
    """A projection's `solution` (the state, the multipliers and the report) and its tangents, where
    `primals` are the equations and the box or `None`. Components at a bound are constant.

    With `frozen`, let `ẏ` and `ġ` be the tangents of the displaced state and of its residual at
    constant `λ`. Then `λ̇ = -(G(y) M⁻¹ G(ŷ)ᵀ)⁻¹ ġ`, and the tangent of the state is
    `ẏ + M⁻¹ G(ŷ)ᵀ λ̇`. Otherwise the unknowns of the optimality system are `y` and `λ`.
    """
    (y, multiplier, info), (equations, box) = solution, primals
    given, t_given = ((x.residual, x.candidate, x.weights, b) for x, b in (primals, tangents))
    _, at_y = linearise(equations.residual, y)
    active = equations.weights
    if box is not None:
        _, z, _ = _displaced(equations.candidate if frozen else y, multiplier, given)
        active = tree_mul(active, box.inside(z))
    if frozen:

        def displaced(given: Any) -> tuple[Y, Vector]:
            _, _, x = _displaced(given[1], multiplier, given)
            return x, given[0](x)

        _, at_candidate = linearise(equations.residual, equations.candidate)
        t_y, t_g = tree_tangents(*eqx.filter_jvp(displaced, (given,), (t_given,)))
        gram_solver = at_y.derivative_solver(active, at_candidate)
        t_multiplier = gram_solver.solve(jtu.tree_map(jnp.negative, t_g))
        t_y = tree_add(t_y, tree_mul(at_candidate.pullback(t_multiplier), active))
    else:
        unknowns = y, multiplier
        _, right = eqx.filter_jvp(lambda p: optimality(unknowns, p), (given,), (t_given,))
        right = jtu.tree_map(jnp.negative, tree_tangents(unknowns, right))
        t_y, t_multiplier = solve_linearised(
            lambda x: optimality(x, given), unknowns, right, units(at_y, equations.weights)
        )
    # The derivative of a failed projection is not used: its step is rejected, or ends the solve.
    inside = dataclasses.replace(equations, weights=active)
    factor = jnp.where(info.ok, certain(inside, y, at_y), 1)
    t_y = tree_scale(lax.stop_gradient(factor), t_y)
    return solution, (t_y, t_multiplier, jtu.tree_map(lambda _: None, info))
