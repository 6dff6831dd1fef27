"""Vector fields made tangent to a manifold, and the forces of constraints."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._balance import rates
from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._fast.scalars import scalarised_result
from .._manifold import (
    LieDerivative,
    check_manifold,
    check_vector_field,
    conserved_values,
    evaluate,
    has_value,
    named_entries,
    slope_of,
)
from .._numerics.metric import factor_of, positive_weights
from .._numerics.problem import problem_of
from .._options import check_number
from .._tree import ravel, tree_add, unflatten, unravel
from .options import check_state


def tangent(
    vector_field: Callable[[RealScalarLike, Any, Args], Any],
    manifold: Manifold,
    *,
    metric: PyTree[Any] | None = None,
    gain: float | Array = 0.0,
) -> "TangentField":
    r"""The vector field minus its normal component, so that it is tangent to a manifold.

    For $f$, the residual $g$ of the manifold with $G = \partial g/\partial y$, and the metric $M$,

    $$y' = f + M^{-1} G^\top \lambda, \qquad
    G M^{-1} G^\top \lambda = -(\partial_t g + G f + \text{gain} \cdot g),$$

    so that along a solution $g' = -\text{gain} \cdot g$: the residual is constant, or with a `gain`
    decays (Baumgarte's stabilisation; the stabilised neural equations of White et al.). The field
    is the nearest to $f$ in the metric with this property.

    **Mechanisms.** For positions $q$ and velocities $v$ with masses $m$ and forces $F$ let
    $f = (v, F/m)$, with the velocity constraint from [`diffrax_conserve.Constraint.derivative`][]
    and the metric $(\infty, m)$: then $m v' = F + G^\top \lambda$, the equations of motion, whose
    `multipliers` are the forces of the constraints. Projecting the solution of $f$ does not solve
    these equations. See [Constraints and mechanics][constraints-and-mechanics].

    **Arguments:**

    - `vector_field`: $f$, called as `vector_field(t, y, args)`.
    - `manifold`: a PyTree of `FirstIntegral`s, which change at their `rate`, and `Constraint`s.
    - `metric`: as of a [`diffrax_conserve.SimplifiedNewton`][], but Euclidean by default; an
        infinite weight leaves its component of the field unchanged. A `Constraint.derivative`
        needs one, because the Euclidean metric is not that of a mechanism.
    - `gain`: the decay rate, in one over time; negative for a solve backward in time.

    **Returns:**

    A `TangentField`.

    **Raises:**

    `TypeError` or `ValueError` if an argument does not fit, if a `gain` is given for a
    `FirstIntegral` without a `value` or with a `rate`, if there is no `metric` for a
    `Constraint.derivative`, or, when it is called, if the value of the field is not shaped like the
    state.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        def free_fall(t, y, args):
            return y[1], jnp.array([0.0, -9.81])

        rod = dfc.Constraint(lambda t, y, args: jnp.sum(y[0] ** 2) - 1)
        pendulum = dfc.tangent(free_fall, rod.derivative(free_fall), metric=(jnp.inf, 1.0))
        print(pendulum(0.0, (jnp.array([1.0, 0.0]), jnp.array([0.0, 2.0])), None))
        ```

        ```text
        (Array([0., 2.], dtype=float32), Array([-4.  , -9.81], dtype=float32))
        ```

    ??? cite "Reference"

        Hairer, Lubich and Wanner, *Geometric Numerical Integration*, Springer 2006, IV.5 and VII.1;
        J. Baumgarte, "Stabilization of constraints and integrals of motion in dynamical systems",
        *Comput. Methods Appl. Mech. Eng.* 1 (1972), 1-16; A. White et al., "Stabilized neural
        differential equations for learning dynamics with explicit constraints", NeurIPS 2023.
    """
    check_vector_field(vector_field)
    check_manifold(manifold)
    check_number("gain", gain, least=-math.inf, optional=False)
    damped = not (isinstance(gain, float | int) and gain == 0)
    for name, entry in named_entries(manifold):
        if metric is None and isinstance(entry.fn, LieDerivative):
            raise ValueError(
                f"`{name}` is the derivative of a constraint, but `tangent` has no `metric`, which "
                "decides the forces. Pass `metric=(jnp.inf, masses)` for a state of positions and "
                "velocities, or `metric=1.0` if the Euclidean one is meant, which moves positions "
                "too."
            )
        why = "" if has_value(entry) else "has no value that it could return to"
        why = why if entry.rate is None else "changes at its `rate`"
        if damped and why:
            raise ValueError(
                f"`gain` is {gain}, but `{name}` {why}. Write `FirstIntegral(fn, value=...)` "
                "without a `rate`, or leave `gain` out."
            )
    return TangentField(vector_field, manifold, positive_weights(metric), gain)


@final
class TangentField(eqx.Module):
    """What [`diffrax_conserve.tangent`][] returns: a vector field, called `field(t, y, args)`."""

    vector_field: Callable[[RealScalarLike, Any, Args], Any]
    manifold: Manifold
    metric: PyTree[Any] | None
    gain: float | Array

    def __call__(self, t: RealScalarLike, y: Y, args: Args) -> Y:
        slope, correction, _ = self._solve(t, y, args)
        return tree_add(slope, correction)

    def multipliers(self, t: RealScalarLike, y: Y, args: Args = None) -> Values:
        r"""The multipliers $\lambda$, shaped like the values of the functions of the manifold; in a
        mechanism they are the forces of the constraints. For many states use `jax.vmap`."""
        return self._solve(t, y, args)[2]

    def _solve(self, t: RealScalarLike, y: Y, args: Args) -> tuple[Y, Y, Values]:
        """The given field, its correction, and the multipliers.

        Let `ġ` be the derivative of the functions along the given field, `∂_t g + G f`. It should
        be `rate - gain · g`, so the correction must change it by the difference of both,
        `to_correct`.
        """
        y = jtu.tree_map(jnp.asarray, y)
        check_state(y, "`tangent`", jnp.inexact)
        values = conserved_values(self.manifold, t, y, args)
        slope = slope_of(self.vector_field, t, y, args)
        vector = ravel(y)
        numbers = ravel(values).astype(vector.dtype)
        problem = problem_of(self.manifold, numbers, t, y, args)
        if self.metric is not None:
            problem = dataclasses.replace(problem, factor=factor_of(self.metric, t, y, args))
        evaluated = lambda t, y: ravel(evaluate(self.manifold, t, y, args))  # noqa: E731
        t = jnp.asarray(t, jnp.result_type(float, t))
        value, along = jax.jvp(evaluated, (t, y), (jnp.ones_like(t), slope))
        wanted = ravel(rates(self.manifold, t, y, args)) - self.gain * (value - numbers)
        to_correct = (wanted - along).astype(vector.dtype)

        def solved(given: tuple[Array, Array]) -> tuple[Array, Array]:
            """`M⁻¹ Gᵀ λ` and `λ`, where `G M⁻¹ Gᵀ λ = to_correct`. The rows of `G` are divided by
            their scales, and so is the right side."""
            vector, to_correct = given
            _, jacobian = problem.linearise(vector)
            row_scales, rows = problem.factor.scaled_rows(jacobian).equilibrated()
            gram, right = rows.gram(rows), to_correct / row_scales
            change = problem.factor.to_state(gram.row_space_correction(rows, right))
            return change, gram.solve(right) / row_scales

        correction, multiplier = scalarised_result(solved, (vector, to_correct))
        return slope, unravel(correction, y), unflatten(multiplier, values)
