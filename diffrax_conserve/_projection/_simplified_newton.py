"""The simplified Newton iteration of Hairer, Lubich and Wanner, IV.4: one Jacobian, few
iterations. For candidates that are as close as an integrator's local error."""

import dataclasses
import functools as ft
from collections.abc import Callable
from typing import final

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Bool, Int, PyTree

from .._custom_types import Y
from .._tree import tree_add, tree_all_finite, tree_mul, tree_scale, tree_tangents
from ._any_lane import continue_if_any
from ._base import (
    AbstractProjection,
    Failure,
    Problem,
    ProjectionInfo,
    largest_relative,
    positive_weights,
    report,
    tolerance,
    tolerances,
    within,
)
from ._elimination import GramSolver, Vector
from ._jacobian import (
    AbstractJacobian,
    Elements,
    Joined,
    Residual,
    as_array,
    linearise,
    written_out,
)

_Iterate = tuple[Y, Vector, Int[Array, ""]]


@final
class SimplifiedNewton(AbstractProjection):
    r"""Projects along the gradients at the candidate, with the constraint Jacobian frozen there.

    For the candidate $\hat y$, with $G = \partial g/\partial y\,(\hat y)$ and the metric $M$,
    solves $g(\hat y + M^{-1} G^\top \lambda) = 0$ for the multipliers $\lambda \in \mathbb{R}^m$ by

    $$\lambda \leftarrow \lambda - (G M^{-1} G^\top)^{-1} g(\hat y + M^{-1} G^\top \lambda).$$

    It converges linearly, with a rate proportional to the distance of the candidate, which for a
    step of an integrator is the local error: each iteration gains as many digits as the step has.
    For candidates far away use [`diffrax_conserve.Newton`][].

    The result is differentiated by the implicit function theorem applied to $\lambda$: exactly for
    the state that is returned, however many iterations were made.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        energy = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
        projection = dfc.SimplifiedNewton(max_steps=10)
        solver = dfc.ManifoldProjection(diffrax.Tsit5(), energy, projection=projection)
        ```

    ??? cite "Reference"

        E. Hairer, C. Lubich and G. Wanner, *Geometric Numerical Integration*, 2nd ed., Springer
        2006, Section IV.4, equations (4.4) to (4.6).
    """

    rtol: float | Array | None
    atol: float | Array | None
    max_steps: int = eqx.field(static=True)
    metric: PyTree[ArrayLike] | None

    def __init__(
        self,
        *,
        rtol: float | Array | None = None,
        atol: float | Array | None = None,
        max_steps: int = 20,
        metric: PyTree[ArrayLike] | None = None,
    ):
        self.rtol = rtol
        self.atol = atol
        self.max_steps = max_steps
        self.metric = positive_weights(metric)

    def solve(self, problem: Problem, candidate: Y) -> tuple[Y, ProjectionInfo]:
        y, _, info = _solve(
            problem.residual,
            candidate,
            problem.weights,
            problem.magnitude,
            self.rtol,
            self.atol,
            max_steps=self.max_steps,
        )
        return y, info


SimplifiedNewton.__init__.__doc__ = r"""**Arguments:**

- `rtol`: how large a residual may remain, relative to the scale of its constraint, which is what
    roundoff is relative to. Default: 16 units of roundoff of the dtype.
    Nearly every projection ends well below it.
- `atol`: the same, absolute. Default: 0. Set it where the functions of the manifold are themselves
    less accurate than roundoff.
- `max_steps`: the largest number of iterations; after that the projection has failed.
- `metric`: a PyTree like the state of positive weights (masses, or $1/\text{scale}^2$), scalars or
    arrays shaped like the leaves: distances are $\sum_k M_k (y_k - \hat y_k)^2$. An infinite weight
    freezes its component. Default: Euclidean.

**Raises:**

`ValueError` if a weight is not positive.
"""


def _displaced(jacobian: AbstractJacobian, multiplier: Vector, y: Y, weights: Y) -> Y:
    """`y + M⁻¹ Gᵀ λ`."""
    return tree_add(y, tree_mul(jacobian.pullback(multiplier), weights))


class _Iteration(eqx.Module):
    """The iteration from one candidate, with its frozen Jacobian."""

    residual: Joined | Elements
    candidate: Y
    weights: Y
    magnitude: Vector
    rtol: float | Array | None
    atol: float | Array | None

    def written_out(self) -> tuple["_Iteration", Callable[[Y], Y], Callable[[Y], Y]]:
        """The same with scalars in the place of vectors, if there are few, and of states, if they
        are small, and the maps to its states and back."""
        assert isinstance(self.residual, Joined)
        residual, magnitude, split, join = written_out(
            self.residual, self.magnitude, self.candidate
        )
        inline = dataclasses.replace(
            self,
            residual=residual,
            candidate=split(self.candidate),
            weights=split(self.weights),
            magnitude=magnitude,
        )
        return inline, split, join

    def stepper(self) -> tuple[Vector, AbstractJacobian, GramSolver]:
        g, jacobian = linearise(self.residual, self.candidate)
        return g, jacobian, jacobian.gram_solver(self.weights)

    def step(
        self, jacobian: AbstractJacobian, gram_solver: GramSolver, g: Vector, iterate: _Iterate
    ) -> _Iterate:
        # The state is updated by increments, which shrink, rather than from the multipliers, which
        # can be large and cancel: so its roundoff is relative to its own size in the end.
        y, multiplier, count = iterate
        change = jtu.tree_map(jnp.negative, gram_solver.solve(g))
        y = _displaced(jacobian, change, y, self.weights)
        return y, jtu.tree_map(jnp.add, multiplier, change), count + 1

    def scales(self, jacobian: AbstractJacobian, y: Y) -> tuple[Vector, Vector]:
        """The scales of the constraints at `y`, and their tolerances."""
        return tolerances(
            jacobian, y, self.candidate, self.weights, self.magnitude, self.rtol, self.atol
        )

    def obviously_done(self, jacobian: AbstractJacobian, g: Vector, y: Y) -> Bool[Array, ""]:
        """Implies that it is done, by scales that are smaller and cheaper than the full ones."""
        scale = jtu.tree_map(jnp.add, self.magnitude, jacobian.scale(y))
        return within(g, tree_scale(_SAFELY, tolerance(scale, self.rtol, self.atol)))


# Iterations end at this part of the tolerance, or where they no longer halve the residual.
_SAFELY = 0.25


@eqx.filter_custom_jvp
def _solve(
    residual: Joined,
    candidate: Y,
    weights: Y,
    magnitude: Vector,
    rtol: float | Array | None,
    atol: float | Array | None,
    *,
    max_steps: int,
) -> tuple[Y, Vector, ProjectionInfo]:
    iteration = _Iteration(residual, candidate, weights, magnitude, rtol, atol)
    inline, split, join = iteration.written_out()
    before, jacobian, gram_solver = inline.stepper()
    g = before
    iterate = (inline.candidate, jtu.tree_map(jnp.zeros_like, g), jnp.asarray(0))
    for _ in range(min(jacobian.inline_steps, max_steps)):
        iterate = inline.step(jacobian, gram_solver, g, iterate)
        g = inline.residual(iterate[0])
    y, multiplier, count = iterate
    done = inline.obviously_done(jacobian, g, y)
    # Few steps need more, so the loop recomputes what it needs: if it shared the Jacobian, that
    # would be written to memory at every step of the solve.
    state = ((y, as_array(multiplier), count), Failure.none())
    (y, multiplier, count), failure = continue_if_any(
        ft.partial(_loop, max_steps, split, join), ~done, state, iteration
    )
    y = join(y)
    # What follows is computed only where somebody asks for it.
    scale, _ = iteration.scales(linearise(residual, candidate)[1], y)
    before, after, rank = as_array(before), residual(y), gram_solver.rank
    return y, multiplier, report(count, candidate, y, before, after, scale, rank, failure)


_State = tuple[_Iterate, Failure]
_Carry = tuple[Bool[Array, ""], _Iterate, Vector, Vector, Array, Bool[Array, ""]]


def _loop(
    max_steps: int,
    split: Callable[[Y], Y],
    join: Callable[[Y], Y],
    unfinished: Bool[Array, ""],
    state: _State,
    iteration: _Iteration,
) -> _State:
    """Iterates until `state` is finished, or hopeless; not at all unless `unfinished`."""
    before, jacobian, gram_solver = iteration.stepper()

    # A loop in a batch evaluates its condition in two places, where it may be rounded in two ways,
    # and then never ends: so the condition is evaluated once, and carried.
    def body(carry: _Carry) -> _Carry:
        _, iterate, _, _, last, _ = carry
        y, _, count = iterate
        g = iteration.residual(y)
        scale, allowed = iteration.scales(jacobian, y)
        largest = largest_relative(g, scale)
        success = within(g, allowed)
        done = success & (within(g, tree_scale(_SAFELY, allowed)) | (largest > 0.5 * last))
        unfinished = ~done & tree_all_finite(g) & (count < max_steps)
        new = iteration.step(jacobian, gram_solver, g, iterate)
        iterate = jtu.tree_map(lambda a, b: jnp.where(unfinished, b, a), iterate, new)
        return unfinished, iterate, g, scale, largest, success

    (y, multiplier, count), _ = state
    last = jnp.asarray(jnp.inf, before.dtype)
    start = (unfinished, (join(y), multiplier, count), before, before, last, ~unfinished)
    _, iterate, after, scale, _, success = lax.while_loop(lambda carry: carry[0], body, start)
    scale_before, _ = iteration.scales(jacobian, iteration.candidate)
    y, multiplier, count = iterate
    failure = Failure.of(before, scale_before, after, scale).unless(success)
    return (split(y), multiplier, count), failure


@_solve.def_jvp
def _solve_jvp(primals, tangents, *, max_steps):
    """The implicit function theorem for `λ` in `g(ŷ + M⁻¹ G(ŷ)ᵀ λ) = 0`.

    With `λ` held, let `ẏ` and `ġ` be the tangents of the displaced state and of its residual. Then
    `λ̇ = -(G(y) M⁻¹ G(ŷ)ᵀ)⁻¹ ġ`, and the tangent of the state is `ẏ + M⁻¹ G(ŷ)ᵀ λ̇`.
    """
    y, multiplier, info = _solve(*primals, max_steps=max_steps)
    residual, candidate, weights, *_ = primals

    def displaced(residual: Residual, candidate: Y, weights: Y) -> tuple[Y, Vector]:
        # `Gᵀ λ` by one reverse pass, not row by row.
        _, vjp = eqx.filter_vjp(residual, candidate)
        (direction,) = vjp(multiplier)
        y = tree_add(candidate, tree_mul(direction, weights))
        return y, residual(y)

    t_y, t_g = tree_tangents(*eqx.filter_jvp(displaced, primals[:3], tangents[:3]))
    _, at_candidate = linearise(residual, candidate)
    _, at_y = linearise(residual, y)
    gram_solver = at_y.gram_solver(weights, at_candidate)
    t_multiplier = gram_solver.solve(jtu.tree_map(jnp.negative, t_g))
    t_y = _displaced(at_candidate, t_multiplier, t_y, weights)
    t_info = jtu.tree_map(lambda _: None, info)
    return (y, multiplier, info), (t_y, t_multiplier, t_info)
