"""The simplified Newton iteration of Hairer, Lubich and Wanner, IV.4: one Jacobian, few
iterations. For candidates that are as close as an integrator's local error."""

from typing import final

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Int, PyTree

from .._custom_types import BoolScalarLike, Y
from .._tree import tree_add, tree_all_finite, tree_mul, tree_scale
from ._base import (
    AbstractProjection,
    ProjectionInfo,
    largest_relative,
    positive_weights,
    report,
    tolerances,
    within,
)
from ._jacobian import AbstractJacobian, Residual, Vector, linearise

# Iterations that are written out before the loop: enough for nearly every step of an integrator,
# so that in a batch no lane waits for a loop that it does not need.
INLINE_STEPS = 2

_Iterate = tuple[Y, Vector, Vector, Int[Array, ""]]


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

    def solve(
        self, residual: Residual, magnitude: Vector, candidate: Y, weights: Y
    ) -> tuple[Y, ProjectionInfo]:
        y, _, info = _solve(
            residual, candidate, weights, magnitude, self.rtol, self.atol, max_steps=self.max_steps
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


@eqx.filter_custom_jvp
def _solve(
    residual: Residual,
    candidate: Y,
    weights: Y,
    magnitude: Vector,
    rtol: float | Array | None,
    atol: float | Array | None,
    *,
    max_steps: int,
) -> tuple[Y, Vector, ProjectionInfo]:
    before, jacobian = linearise(residual, candidate)
    gram_solve = jacobian.gram_solver(weights)

    def scales(y: Y) -> tuple[Vector, Vector]:
        return tolerances(jacobian, y, candidate, weights, magnitude, rtol, atol)

    def iterate(carry: _Iterate) -> _Iterate:
        # The state is updated by increments, which shrink, rather than from the multipliers, which
        # can be large and cancel: so its roundoff is relative to its own size in the end.
        y, multiplier, g, count = carry
        change = jtu.tree_map(jnp.negative, gram_solve(g))
        y = _displaced(jacobian, change, y, weights)
        return y, jtu.tree_map(jnp.add, multiplier, change), residual(y), count + 1

    # A loop in a batch evaluates its condition in two places, where it may be rounded in two ways,
    # and then never ends: so the condition is evaluated once, and carried.
    def judged(carry: _Iterate, stalled: BoolScalarLike) -> tuple[Array, Array, _Iterate]:
        y, _, g, count = carry
        _, tolerance = scales(y)
        success = within(g, tolerance)
        done = success & (within(g, tree_scale(0.25, tolerance)) | stalled)
        return ~done & (count < max_steps) & tree_all_finite(g), success, carry

    def body(state: tuple[Array, Array, _Iterate]) -> tuple[Array, Array, _Iterate]:
        _, _, carry = state
        new = iterate(carry)
        scale, _ = scales(new[0])
        stalled = largest_relative(new[2], scale) > 0.5 * largest_relative(carry[2], scale)
        return judged(new, stalled)

    carry = (candidate, jtu.tree_map(jnp.zeros_like, before), before, jnp.asarray(0))
    for _ in range(min(INLINE_STEPS, max_steps)):
        carry = iterate(carry)
    _, success, (y, multiplier, after, count) = lax.while_loop(
        lambda state: state[0], body, judged(carry, stalled=False)
    )
    scale, _ = scales(y)
    return y, multiplier, report(success, count, candidate, y, before, after, scale)


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

    out, t_out = eqx.filter_jvp(displaced, primals[:3], tangents[:3])
    t_y, t_g = jtu.tree_map(
        lambda x, t: jnp.zeros_like(x) if t is None else t, out, t_out, is_leaf=lambda t: t is None
    )
    _, at_candidate = linearise(residual, candidate)
    _, at_y = linearise(residual, y)
    t_multiplier = at_y.gram_solver(weights, at_candidate)(jtu.tree_map(jnp.negative, t_g))
    t_y = _displaced(at_candidate, t_multiplier, t_y, weights)
    t_info = jtu.tree_map(lambda _: None, info)
    return (y, multiplier, info), (t_y, t_multiplier, t_info)
