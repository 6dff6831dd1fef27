"""The equations of a projection, and the report on a state that should solve them."""

import functools as ft

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Y
from .._printing import is_traced, printed
from .._tree import tree_all_finite, tree_mul, tree_norm, tree_scale, tree_sub
from .elimination import GramSolver, Vector
from .jacobian import AbstractJacobian, lineax_solver
from .linearise import Elements, Joined, linearise
from .residual import ROUNDOFF_MULTIPLE, Tolerance, largest, relative, within

# An iteration ends at this fraction of the tolerance, or where it no longer halves the residual.
SAFELY = 0.25


class ProjectionInfo(eqx.Module):
    """The report on a projection.

    **Attributes:**

    - `result`: an `optimistix.RESULTS`; `optimistix.RESULTS.successful` if and only if every
        residual is within its tolerance at the state that is returned.
    - `num_steps`: the number of iterations (of `Newton`: of both phases).
    - `residual_before`, `residual_after`: the largest residual of the candidate and of the
        projected state, each relative to the scale of its own constraint at the projected state,
        $|\\text{conserved value}| + \\sum_k |y_k \\, \\partial g/\\partial y_k|$. With more than
        128 constraints the sum is estimated, mostly from below, so that residuals may be reported
        too large.
    - `correction`: the Euclidean norm of the projected state minus the candidate.
    - `rank`: the numerical rank of the Gram matrix of the constraints at the candidate (for
        `Newton`: at the result). With more than 128 constraints the matrix is not formed, and this
        is their number.
    - `worst`: if the projection failed, the position of the scalar constraint with the largest
        relative residual (the smaller of its residuals before and after), in the order in which the
        manifold is flattened; otherwise 0.
    """

    result: optx.RESULTS
    num_steps: Int[Array, ""]
    residual_before: Float[Array, ""]
    residual_after: Float[Array, ""]
    correction: Float[Array, ""]
    rank: Int[Array, ""]
    worst: Int[Array, ""]

    @property
    def ok(self) -> Bool[Array, "..."]:
        """Whether the projection succeeded."""
        return self.result == optx.RESULTS.successful

    def __str__(self) -> str:
        if is_traced(self):
            return repr(self)
        ok = np.asarray(self.ok)
        if ok.ndim > 0:
            title = f"{ok.sum()} of {ok.size} projections succeeded"
        else:
            title = "projected" if ok else f"NOT PROJECTED: {optx.RESULTS[self.result]}"
        names = ("num_steps", "residual_before", "residual_after", "correction", "rank")
        rows = {name: getattr(self, name) for name in names}
        return printed(title, rows if ok.all() else rows | {"worst": self.worst})


class Outcome(eqx.Module):
    """The verdict on the state that a projection returns: the result and the worst constraint.

    It consists of two integers, to keep the state that a solve carries small.
    """

    result: optx.RESULTS
    worst: Int[Array, ""]

    @classmethod
    def success(cls) -> "Outcome":
        # With an array as its value, as `RESULTS.where` returns it.
        ok = optx.RESULTS.successful
        return cls(optx.RESULTS.where(jnp.asarray(True), ok, ok), jnp.asarray(0, jnp.int32))

    @classmethod
    def of(cls, before: Vector, after: Vector, scale: Vector, tolerance: Tolerance) -> "Outcome":
        """The verdict on a state with residuals `after` and their scales `scale`, from a candidate
        with residuals `before`: `nonfinite` if `before` is not finite, divergence if only `after`
        is not."""
        kinds = optx.RESULTS
        success = within(after, tolerance(scale))
        result = kinds.where(
            tree_all_finite((after, scale)),
            kinds.nonlinear_max_steps_reached,
            kinds.nonlinear_divergence,
        )
        result = kinds.where(tree_all_finite(before), result, kinds.nonfinite)
        result = kinds.where(success, kinds.successful, result)

        def sizes(residual: Vector) -> Array:
            ratios = jtu.tree_leaves(relative(residual, scale))
            size = jnp.abs(jnp.concatenate([jnp.atleast_1d(x) for x in ratios]))
            return jnp.where(jnp.isnan(size), jnp.inf, size)

        # The smaller of both, so that none is blamed for an iteration that diverged.
        worst = jnp.argmax(jnp.minimum(sizes(before), sizes(after))).astype(jnp.int32)
        return cls(result, jnp.where(success, 0, worst))


class Equations(eqx.Module):
    """`g(y) = 0` for `y = ŷ + M⁻¹ Gᵀ λ`, from the candidate `ŷ`."""

    residual: Joined | Elements
    candidate: Y
    weights: Y
    magnitude: Vector
    tolerance: Tolerance
    linear_solver: lx.AbstractLinearSolver | None = eqx.field(static=True)

    def gram_solver(
        self,
        jacobian: AbstractJacobian,
        other: AbstractJacobian | None = None,
        damping: Array | float = 0.0,
        weights: Y | None = None,
    ) -> GramSolver:
        """Solves with `G M⁻¹ Hᵀ`; see `AbstractJacobian.gram_solver`. With a `linear_solver` these
        are approximate, which the next iteration corrects."""
        weights = self.weights if weights is None else weights
        if self.linear_solver is None:
            return jacobian.gram_solver(weights, other, damping)
        return lineax_solver(self.linear_solver, jacobian, weights, other, damping)

    def correction(self, jacobian: AbstractJacobian, multiplier: Vector) -> Y:
        """`M⁻¹ Gᵀ λ`."""
        return tree_mul(jacobian.pullback(multiplier), self.weights)

    def as_vector(self, x: Array) -> Vector:
        """`x` in the form of the residual, one array or a tuple of scalars."""
        return tuple(x) if isinstance(self.residual, Elements) else x

    def scale(self, jacobian: AbstractJacobian, y: Y) -> Vector:
        """The scale of the residual at `y`, to which its roundoff is proportional; `jacobian` is
        that at `y`."""
        return jtu.tree_map(jnp.add, self.magnitude, jacobian.scale(y))

    def merit(self, g: Vector, scale: Vector) -> Array:
        """The sum of squares of the residuals, relative to their scales, which are enlarged to
        allow for `atol`."""
        atol = 0.0 if self.tolerance.atol is None else self.tolerance.atol

        def square(g: Array, scale: Array) -> Array:
            roundoff = ROUNDOFF_MULTIPLE * jnp.finfo(scale.dtype).eps
            size = scale + jnp.asarray(atol, scale.dtype) / roundoff
            return jnp.sum(jnp.square(relative(g, size)))

        return ft.reduce(jnp.add, jtu.tree_leaves(jtu.tree_map(square, g, scale)))

    def safely_satisfied(self, g: Vector, scale: Vector) -> Bool[Array, ""]:
        return within(g, tree_scale(SAFELY, self.tolerance(scale)))

    def measure(self, y: Y) -> tuple[Vector, Vector]:
        """The residual at `y`, and its scale there."""
        g, jacobian = linearise(self.residual, y)
        return g, self.scale(jacobian, y)

    def report(
        self,
        y: Y,
        before: Vector,
        measured: tuple[Vector, Vector],
        count: Array,
        rank: Array,
        outcome: Outcome | None = None,
    ) -> ProjectionInfo:
        """The report on a projection to `y`, from a candidate with the residual `before`;
        `measured` is the residual at `y` and its scale."""
        after, scale = measured
        outcome = Outcome.of(before, after, scale, self.tolerance) if outcome is None else outcome
        return ProjectionInfo(
            result=outcome.result,
            num_steps=count,
            residual_before=largest(relative(before, scale)),
            residual_after=largest(relative(after, scale)),
            correction=tree_norm(tree_sub(y, self.candidate)),
            rank=rank,
            worst=outcome.worst,
        )
