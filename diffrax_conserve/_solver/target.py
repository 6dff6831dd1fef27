"""The manifold, the conserved values and the metric with which a step is projected."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._balance import integrated_rates
from .._constants import NOISE_IN_EPS, TOLERANCE_IN_EPS
from .._custom_types import Args, Manifold, RealScalarLike
from .._numerics.metric import AbstractFactor, PreferredSubspace, factor_of
from .._numerics.problem import Problem, Step, problem_of
from .._projection.base import AbstractProjection
from .._tree import ravel, tree_stop_gradient, unravel

# The solution in a step, as a function from times of the vector field to vectors.
Interpolant = Callable[[RealScalarLike], Float[Array, " n"]]


class TargetManifold(eqx.Module):
    """Everything that a projection needs except the time, the candidate and the step. Within a step
    only `rate_integrals` depends on the time, see `with_rates_integrated`, so that dense output has
    the same target. Times are those of the vector field, and states are vectors.

    - `like`: the shapes and dtypes of the state.
    - `values`: the conserved values at the start of the solve.
    - `cancellation`: the size of the terms that cancel inside the functions, as in `1 - cos(q)`,
      which is added to the scale of each residual; see `problem`.
    - `changes`: how far each component moves in the step.
    - `factor`: the factor of the metric where the projection has none of its own: of the metric of
      motion, or for a stochastic equation of the Euclidean one.
    - `rate_integrals`: in the first row the integrals of the rates since the start of the solve, in
      the second Kahan's compensation, which is subtracted from the next increment; `None` if no
      entry has a rate.
    - `displacements`: how the state has moved within this step and the last one, at a few times, if
      corrections are to stay in their span; see `PreferredSubspace`.
    """

    projection: AbstractProjection
    manifold: Manifold
    like: Any
    values: Float[Array, " m"]
    cancellation: Float[Array, " m"]
    args: Args
    changes: Float[Array, " n"]
    factor: AbstractFactor
    rate_integrals: Float[Array, "2 m"] | None
    displacements: Float[Array, "k n"] | None

    def with_rates_integrated(
        self, start: RealScalarLike, end: RealScalarLike, interpolant: Interpolant
    ) -> "TargetManifold":
        """The target at a time `end` in a step, given the solution from `start`.

        The integral over the step is added to the integrals so far by compensated summation (W.
        Kahan, "Further remarks on reducing truncation errors", *Comm. ACM* 8 (1965), 40). So their
        roundoff does not grow with the number of steps.
        """
        if self.rate_integrals is None:
            return self
        states = lambda t: unravel(interpolant(t), self.like)  # noqa: E731
        return self._plus(ravel(integrated_rates(self.manifold, start, end, states, self.args)))

    def _plus(self, increment: Float[Array, " m"]) -> "TargetManifold":
        assert self.rate_integrals is not None
        last, compensation = self.rate_integrals
        increment = increment.astype(last.dtype) - compensation
        total = last + increment
        return dataclasses.replace(
            self, rate_integrals=jnp.stack([total, (total - last) - increment])
        )

    def with_balances_met(self, t: RealScalarLike, y: Float[Array, " n"]) -> "TargetManifold":
        """The target with balances that hold at a state `y`, the start of a step, up to half of
        what counts as noise.

        The rate of a balance may vanish, for example when friction has stopped a pendulum. Its
        integral then keeps an error of roundoff, say an energy of -1e-17, which no state has: all
        later projections would fail. And a solve that goes on from an event inside of a step has
        the integrals up to the end of that step. In both cases a balance goes on from the state.
        """
        assert self.rate_integrals is not None
        problem, y = tree_stop_gradient((self.problem(t, y), y))
        residual, jacobian = problem.linearise(y)
        half_noise = (
            NOISE_IN_EPS / TOLERANCE_IN_EPS * problem.tolerance(problem.scale(jacobian, y)) / 2
        )
        follow = residual - jnp.clip(residual, -half_noise, half_noise)
        is_shifted = (self.rate_integrals[0] != 0) & jnp.isfinite(residual)
        return self._plus(jnp.where(is_shifted, follow, 0))

    def problem(
        self, t: RealScalarLike, y: Float[Array, " n"], step: Step | None = None
    ) -> Problem:
        """The problem at a time, with the metric at a state, and the step if the projection uses
        it."""
        values, cancellation = self.values, self.cancellation
        if self.rate_integrals is not None:
            # After dissipation a conserved value is a small difference of large numbers, and has
            # their roundoff. So its scale is at least that of the start.
            values = values + self.rate_integrals[0]
            decrease = jnp.maximum(jnp.abs(self.values) - jnp.abs(values), 0)
            cancellation = cancellation + decrease
        metric, factor = self.projection.metric, self.factor
        if metric is not None:
            factor = factor_of(metric, t, unravel(y, self.like), self.args)
        if self.displacements is not None:
            factor = PreferredSubspace.spanned_by(factor, self.displacements)
        return problem_of(
            self.manifold,
            values,
            t,
            self.like,
            self.args,
            cancellation,
            factor=factor,
            changes=self.changes,
            step=step if self.projection.sees_step else None,
            rtol=self.projection.rtol,
            atol=self.projection.atol,
        )
