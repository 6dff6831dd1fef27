"""Newton's method for the nearest point: fresh Jacobians, damped. For candidates far away."""

from typing import final

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import optimistix as optx
from jaxtyping import Array, ArrayLike, PyTree, Real

from .._custom_types import Y
from .._tree import (
    tree_add,
    tree_mul,
    tree_scale,
    tree_size,
    tree_stop_gradient,
    tree_sub,
    working_dtype,
)
from ._base import (
    ROUNDOFF_MULTIPLE,
    AbstractProjection,
    Failure,
    Problem,
    ProjectionInfo,
    positive_weights,
    report,
    tolerances,
    within,
)
from ._elimination import Vector
from ._jacobian import Residual, linearise

# Above this many unknowns the optimality system is solved iteratively, matrix-free.
_DENSE_MAX = 256


@final
class Newton(AbstractProjection):
    r"""Projects to the nearest point of the manifold, with a fresh Jacobian in each iteration.

    Finds the stationary point of the distance, $(y, \lambda)$ with

    $$y = \hat y + M^{-1} G(y)^\top \lambda, \qquad g(y) = 0,$$

    in two phases. First a damped Gauss-Newton iteration reaches the manifold, with step halving
    and a damping $\min(10^{-2}, |g|^2)$ of the row-scaled Gram matrix, which vanishes with the
    (relative) residual: it passes near points where gradients become parallel, and converges
    quadratically elsewhere. Then Newton's method on both equations moves along the manifold to
    the point nearest to the candidate. That costs second derivatives of the constraint functions
    and linear solves with all unknowns, so for the candidates of an integrator, which are close,
    use [`diffrax_conserve.SimplifiedNewton`][].

    The result is differentiated by the implicit function theorem on both equations.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        circle = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)
        y, info = dfc.project(circle, jnp.array([3.0, 4.0]), projection=dfc.Newton())
        ```

    ??? cite "Reference"

        E. Hairer, C. Lubich and G. Wanner, *Geometric Numerical Integration*, 2nd ed., Springer
        2006, Section IV.4, equations (4.3).
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
        max_steps: int = 50,
        metric: PyTree[ArrayLike] | None = None,
    ):
        self.rtol = rtol
        self.atol = atol
        self.max_steps = max_steps
        self.metric = positive_weights(metric)

    def solve(self, problem: Problem, candidate: Y) -> tuple[Y, ProjectionInfo]:
        residual, magnitude, weights = problem.residual, problem.magnitude, problem.weights
        # The iterations are not differentiated: the optimality system is.
        fixed = tree_stop_gradient((residual, magnitude, candidate, weights))
        start, count = _reach(*fixed, projection=self)
        y, nearest = _nearest(residual, candidate, weights, start, self.max_steps)

        after, at_y = linearise(residual, y)

        def scales(y: Y) -> tuple[Vector, Vector]:
            return tolerances(at_y, y, candidate, weights, magnitude, self.rtol, self.atol)

        scale, tolerance = scales(y)
        success = within(after, tolerance) & (nearest.result == optx.RESULTS.successful)
        count = count + nearest.stats["num_steps"]
        rank = at_y.gram_solver(weights).rank
        before = residual(candidate)
        failure = Failure.of(before, scales(candidate)[0], after, scale).unless(success)
        info = report(count, candidate, y, before, after, scale, rank, failure)
        return y, tree_stop_gradient(info)


Newton.__init__.__doc__ = r"""**Arguments:**

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


def _reach(
    residual: Residual,
    magnitude: Vector,
    candidate: Y,
    weights: Y,
    *,
    projection: Newton,
) -> tuple[Y, Array]:
    """A damped Gauss-Newton iteration from the candidate to some point of the manifold, and the
    number of its steps."""

    def squared(g: Vector, scale: Vector) -> Real[Array, ""]:
        return jnp.square(jnp.linalg.norm(jnp.stack(_relative(g, scale)).astype(dtype)))

    dtype = working_dtype(candidate)

    def iterate(carry: tuple[Array, Y, Array]) -> tuple[Array, Y, Array]:
        _, y, count = carry
        g, jacobian = linearise(residual, y)
        scale, tolerance = tolerances(
            jacobian, y, candidate, weights, magnitude, projection.rtol, projection.atol
        )
        merit = squared(g, scale)
        gram_solver = jacobian.gram_solver(weights, damping=jnp.minimum(1e-2, merit))
        step = tree_mul(jacobian.pullback(gram_solver.solve(g)), weights)

        def attempt(fraction: Array) -> tuple[Array, Array, Y]:
            trial = tree_sub(y, tree_scale(fraction, step))
            worse = ~(squared(residual(trial), scale) <= merit)
            return worse & (fraction > 1e-3), fraction, trial

        # A loop in a batch evaluates its condition in two places, where it may be rounded in two
        # ways, and then never ends: so conditions are evaluated once, and carried.
        _, _, trial = lax.while_loop(
            lambda carry: carry[0],
            lambda carry: attempt(carry[1] / 2),
            attempt(jnp.ones((), dtype)),
        )
        done = within(g, tolerance)
        y = jtu.tree_map(lambda a, b: jnp.where(done, a, b), y, trial)
        count = count + jnp.where(done, 0, 1)
        unfinished = ~done & jnp.isfinite(merit) & (count < projection.max_steps)
        return unfinished, y, count

    start = (jnp.asarray(projection.max_steps > 0), candidate, jnp.asarray(0))
    _, y, count = lax.while_loop(lambda carry: carry[0], iterate, start)
    return y, count


def _state_norm(unknowns: tuple[Y, Vector]) -> Array:
    # Where gradients are nearly parallel the state is well determined, the multipliers are not.
    y, _ = unknowns
    return optx.max_norm(y)


def _relative(g: Vector, scale: Vector) -> list[Array]:
    ratios = jtu.tree_map(lambda a, s: jnp.where(s > 0, a / jnp.where(s > 0, s, 1), a), g, scale)
    return [jnp.linalg.norm(jnp.atleast_1d(x)) for x in jtu.tree_leaves(ratios)]


def _nearest(
    residual: Residual, candidate: Y, weights: Y, start: Y, max_steps: int
) -> tuple[Y, optx.Solution]:
    """Newton's method on `y = ŷ + M⁻¹ G(y)ᵀ λ`, `g(y) = 0`, from a point of the manifold and the
    multipliers that suit the candidate best there."""
    fixed = tree_stop_gradient((residual, candidate, weights))
    _, jacobian = linearise(fixed[0], start)
    offset = jacobian.pushforward(tree_sub(start, fixed[1]))
    multiplier = jacobian.gram_solver(fixed[2]).solve(offset)
    # Gradients of norm one, so that a linear solver sees the rank of the system.
    norms = jtu.tree_map(
        lambda x: jnp.sqrt(jnp.where(x > 0, x, 1)), jacobian.squared_norms(fixed[2])
    )
    multiplier = jtu.tree_map(jnp.multiply, multiplier, norms)

    def optimality(unknowns: tuple[Y, Vector], args) -> tuple[Y, Vector]:
        y, multiplier = unknowns
        residual, candidate, weights, norms = args

        def unit(y: Y) -> Vector:
            return jtu.tree_map(jnp.divide, residual(y), norms)

        g, vjp = eqx.filter_vjp(unit, y)
        (direction,) = vjp(multiplier)
        return tree_sub(y, tree_add(candidate, tree_mul(direction, weights))), g

    size = tree_size((candidate, multiplier))
    eps = float(jnp.finfo(working_dtype(candidate)).eps)
    tolerance = eps ** (2 / 3)
    # The multipliers of nearly parallel gradients are large and cancel, up to their roundoff.
    largest = lax.stop_gradient(optx.max_norm(multiplier))
    atol = tolerance + ROUNDOFF_MULTIPLE * eps * largest
    if size <= _DENSE_MAX:
        # Dependent constraints make the system singular but consistent.
        linear_solver = lx.AutoLinearSolver(well_posed=False)
    else:
        linear_solver = lx.GMRES(rtol=tolerance, atol=tolerance)
    solution = optx.root_find(
        optimality,
        optx.Newton(rtol=tolerance, atol=atol, norm=_state_norm, linear_solver=linear_solver),
        (start, multiplier),
        (residual, candidate, weights, norms),
        adjoint=optx.ImplicitAdjoint(linear_solver=linear_solver),
        max_steps=max_steps,
        throw=False,
    )
    return solution.value[0], solution
