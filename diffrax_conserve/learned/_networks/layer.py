"""The conservative layer: a projection to the manifold, as the last layer of a network."""

from typing import Any, final

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from ..._balance import refuse_rates
from ..._constants import MAX_STEPS
from ..._custom_types import Args, Manifold, RealScalarLike, Values, Y
from ..._manifold import check_manifold, conserved_values
from ..._numerics.implicit import MultiplierSystem, implicit_solution
from ..._numerics.iterate import Solved, damped_newton
from ..._numerics.problem import Problem, problem_of, relative_to_scale
from ..._options import check_counts
from ..._tree import ravel, unravel
from .trainable import LayerSchedule


@final
class ConservativeLayer(eqx.Module):
    r"""Projects the output of a network to the manifold of the conserved values.

    For the output $\hat y$ with the constraint Jacobian $G(\hat y)$ it solves $g(y) = 0$,
    $y = \hat y + G(\hat y)^\top \lambda$, for the multipliers $\lambda$, by the damped Newton
    iteration of the projections of a solver, to their tolerance. Derivatives are those of the
    result, by the implicit function theorem. Where no such state is found, as early in a training,
    the result is $\hat y$ itself; `fit` warns if any such state is left at the end.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax
        import jax.numpy as jnp

        energy = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
        layer = dfc.learned.ConservativeLayer(energy)
        pinn = dfc.PINN(jnp.array([1.0, 0.0]), 0.0, 3.0, layer=layer, key=jax.random.key(0))
        pinn(2.0)  # of length one, with any weights
        ```

    ??? cite "Reference"

        E. Cardoso-Bihlo and A. Bihlo, arXiv:2311.14131.
    """

    manifold: Manifold
    steps: int | None = eqx.field(static=True, kw_only=True, default=None)
    args: Args = eqx.field(kw_only=True, default=None)
    as_printed: bool = eqx.field(static=True, kw_only=True, default=False)

    def __check_init__(self):
        check_manifold(self.manifold)
        refuse_rates(self.manifold, "a `ConservativeLayer`")
        if self.steps is not None:
            check_counts(steps=self.steps)
        elif self.as_printed:
            raise ValueError("`as_printed` needs the number of iterations: `steps=5`.")

    def __call__(
        self,
        candidate: Y,
        t: RealScalarLike,
        start: tuple[RealScalarLike, Y],
        scale: Float[Array, "..."],
        schedule: LayerSchedule | None = None,
    ) -> Y:
        """The state at time `t` on the manifold through the time and state of `start`. With
        `steps` the move of an iteration is at most the norm of `scale`."""
        problem, vector = self.problem(candidate, t, start)
        if self.steps is None:
            # The start is on the manifold, so the functions are finite there.
            known = ravel(start[1]).astype(vector.dtype)
            options: Any = dict(iteration=_damped_along, max_steps=MAX_STEPS)
            projected = implicit_solution(
                MultiplierSystem(problem, vector, fallback=known, **options)
            )
            y = jnp.where(projected.ok, projected.y, vector)
        else:
            radius = None if self.as_printed else jnp.linalg.norm(scale)
            y = _iterated(problem, vector, radius, self.steps, schedule)
        return unravel(y, candidate)

    def values(self, t0: RealScalarLike, y0: Y) -> Values:
        """The conserved values of the solution through `y0`."""
        try:
            return conserved_values(self.manifold, t0, y0, self.args)
        except Exception as error:
            if self.args is None:
                error.add_note("The layer has no `args`: `ConservativeLayer(manifold, args=args)`.")
            raise

    def problem(
        self, candidate: Y, t: RealScalarLike, start: tuple[RealScalarLike, Y]
    ) -> tuple[Problem, Float[Array, " n"]]:
        """Those of the manifold through `start`, and the candidate as a vector."""
        vector = ravel(candidate)
        values = ravel(self.values(*start)).astype(vector.dtype)
        problem = problem_of(self.manifold, values, t, candidate, self.args)
        return problem.with_dense_jacobian(), vector


def _damped_along(
    problem: Problem, candidate: Float[Array, " n"], directions: None, *, max_steps: int
) -> Solved:
    """The damped iteration along the gradients at the candidate."""
    del directions
    return damped_newton(problem, candidate, problem.gradients(candidate), max_steps=max_steps)


def _iterated(
    problem: Problem,
    candidate: Float[Array, " n"],
    radius: Float[Array, ""] | None,
    steps: int,
    schedule: LayerSchedule | None,
) -> Float[Array, " n"]:
    r"""`ŷ + G(ŷ)ᵀ λ` with `λ = (1 - s) λ_{p-1} + s λ_p`, where `schedule` is `(p, s)`; by default
    `λ` after all `steps`. Iterations beyond the `p`-th are not computed.

    Newton's method in `λ`, with rows scaled to norm one, a damping `μ = min(1e-2, |g|²)` that
    vanishes with the residual relative to its scale, and moves of at most `radius`. Without one it
    is the algorithm as printed: `G(y)` is `G(ŷ)`, and nothing is damped. Derivatives are those of
    what is computed, iteration by iteration, also far from the manifold.
    """
    dtype = candidate.dtype
    p, s = (jnp.asarray(steps), jnp.ones(())) if schedule is None else schedule
    before, rows = problem.linearise(candidate)

    def improve(multipliers: Array) -> Array:
        y = candidate + rows.rmatvec(multipliers)
        g, jacobian = problem.linearise(y)
        if radius is None:
            return multipliers - rows.gram(rows).solve(g)
        ratio = relative_to_scale(g, problem.scale(jacobian, y))
        damping = jnp.minimum(1e-2, jnp.sum(ratio * ratio))
        damped = 1 + damping * jnp.eye(g.size, dtype=dtype)
        gram = jtu.tree_map(lambda matrix: matrix * damped, jacobian.gram(rows))
        change = gram.solve(g)
        step = rows.rmatvec(change)
        return multipliers - lax.rsqrt(1 + jnp.sum(step * step) / radius**2) * change

    def iterate(carry: tuple[Array, Array], i: Array) -> tuple[tuple[Array, Array], None]:
        return lax.cond(i < p, lambda c: (c[1], improve(c[1])), lambda c: c, carry), None

    zeros = jnp.zeros_like(before)
    (previous, last), _ = lax.scan(iterate, (zeros, zeros), jnp.arange(steps))
    return candidate + rows.rmatvec(previous + s.astype(dtype) * (last - previous))


ConservativeLayer.__init__.__doc__ = r"""**Arguments:**

- `manifold`: a PyTree of `FirstIntegral`s and `Constraint`s.
- `steps`: for the recipe of the paper, the number $P$ of iterations, exactly; the result is then
    near the manifold, not on it. Default: as many as the tolerance takes.
- `args`: passed to the functions of the manifold.
- `as_printed`: with `steps`, whether these are the simplified Newton iteration that the paper
    prints, with $G(\hat y)$ frozen and without damping, which converges only nearby.

An invalid `manifold` or number raises a `TypeError` or `ValueError`.
"""
