"""The solver state of a `ManifoldProjection`, and how each solver that keeps a manifold starts."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float

from .._constants import TOLERANCE_IN_EPS
from .._custom_types import Args, Manifold, RealScalarLike, Y
from .._hashable import hash_of
from .._manifold import conserved_values
from .._numerics.roundoff import cancellation_scale
from .._options import dtype_of
from .._tree import eps_of, irregular_weights, ravel, real_view, unflatten
from .statistics import ProjectionStatistics


class State(eqx.Module):
    """What later steps need.

    - `inner`: the state of the wrapped solver.
    - `packed_constants`: `values` and `cancellation` as in a `TargetManifold`, and
      `first_step_size`, the length of the first step that was tried, a scale of the times of the
      solve. They are one array, because in a gradient each array of the state is saved and
      restored.
    - `rate_integrals`: as in a `TargetManifold`.
    - `units`: the unit of each component in the metric of motion, see `updated_units`, the largest
      of all steps so far; zero before the first step.
    - `last_fingerprint`: the end of the last step.
    - `displacements`: those in the last two steps, as in a `TargetManifold`; `None` unless linear
      invariants are kept.
    """

    inner: Any
    packed_constants: Float[Array, " constants"]
    rate_integrals: Float[Array, "2 m"] | None
    units: Float[Array, " n"]
    last_fingerprint: "StepFingerprint"
    statistics: ProjectionStatistics
    displacements: Float[Array, "k n"] | None

    @property
    def values(self) -> Float[Array, " m"]:
        return self.packed_constants[: len(self.packed_constants) // 2]

    @property
    def cancellation(self) -> Float[Array, " m"]:
        return self.packed_constants[len(self.packed_constants) // 2 : -1]

    @property
    def first_step_size(self) -> Float[Array, ""]:
        return self.packed_constants[-1]


class StepFingerprint(eqx.Module):
    """The end of a step. A step that starts there, with the same `args` and manifold, needs no test
    of its start. The first step of a solve has such a test, also of a solve that goes on from a
    solver state with other values.

    - `checksums`: the checksums of the state and of all numbers in `args` and in the manifold, and
      the time; infinite before the first step. They are one array, as `packed_constants` are.
    - `manifold_hash`: by which the functions of the manifold are recognised.
    """

    checksums: Float[Array, "3"]
    manifold_hash: int = eqx.field(static=True)

    @classmethod
    def before_first(cls, manifold: Manifold, dtype: Any) -> "StepFingerprint":
        return cls(jnp.full(3, jnp.inf, dtype), hash_of(manifold))

    def at(
        self, t: RealScalarLike, y: Float[Array, " n"], args: Args, manifold: Manifold
    ) -> "StepFingerprint":
        sums, _ = self.checksums_of(t, y, args, manifold)
        return dataclasses.replace(self, checksums=sums)

    def differs(
        self, sums: Float[Array, "3"], sizes: Float[Array, "3"], manifold: Manifold
    ) -> Bool[Array, ""]:
        """Whether these results of `checksums_of` are those of another state, time, `args` or
        manifold. XLA may add in another order, so sums are compared up to roundoff. For a state
        that is NaN the comparison is false, and its projection fails."""
        if self.manifold_hash != hash_of(manifold):
            return jnp.asarray(True)
        return jnp.any(jnp.abs(sums - self.checksums) > TOLERANCE_IN_EPS * eps_of(sums) * sizes)

    def checksums_of(
        self, t: RealScalarLike, y: Float[Array, " n"], args: Args, manifold: Manifold
    ) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Weighted sums of numbers, and the sums of the absolute terms, to which their roundoff is
        proportional.

        The numbers in `args` may have any units, such as a constant of 1e-11 and a mass of 1e24, so
        that what is added is the logarithm of each. There may be many, so their weights are no
        array in the program.
        """
        dtype = self.checksums.dtype
        kinds, leaves = (np.number, np.bool_), jtu.tree_leaves((args, manifold))
        numbers = [x for x in leaves if any(jnp.issubdtype(dtype_of(x), kind) for kind in kinds)]
        each = [
            ravel(x) if jnp.iscomplexobj(x) else jnp.ravel(jnp.asarray(x, dtype)) for x in numbers
        ]
        x = jnp.concatenate([jnp.zeros(1, dtype), *(x.astype(dtype) for x in each)])
        tiny = float(jnp.finfo(dtype).tiny)
        logarithms = jnp.sign(x) * (jnp.log(jnp.maximum(jnp.abs(x), tiny)) - math.log(tiny))
        terms = (
            irregular_weights(y.size, dtype) * y,
            jnp.arange(1, x.size + 1, dtype=dtype) * logarithms,
            jnp.asarray(t, dtype)[None],
        )
        terms = lax.stop_gradient(terms)
        sums = jnp.stack([jnp.sum(x) for x in terms])
        return sums, jnp.stack([jnp.sum(jnp.abs(x)) for x in terms])


def initial_values(
    manifold: Manifold, t: RealScalarLike, y: Y, args: Args
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """The values that a solve from here conserves, and the `cancellation` of their scales."""
    values = conserved_values(manifold, t, y, args)
    _, _, cancellation = cancellation_scale(manifold, t, y, args)
    return ravel(values).astype(cancellation.dtype), cancellation


def updated_units(
    units: Float[Array, " n"], change: Float[Array, " n"], end: Float[Array, " n"], like: Any
) -> Float[Array, " n"]:
    """The units of the metric of motion after a step to `end` that changed the components by
    `change`, for states like `like`.

    The unit of a quantity in a step is the geometric mean of its size and its change. Each alone
    misleads: a quantity may be large only because its origin is far away, and it may hardly change
    for a while, at a turning point, or along the axis of a rotation. To first order `|y Δy|` is the
    same for two components with a constant sum of squares, as `q` and `p` of an oscillator.

    A quantity that hardly changes counts as changing by `ε` of itself. This floor is inside the
    root, so that the derivative stays finite, and the root is that of a ratio, so that nothing is
    squared and a power of two as a unit changes no bit.
    """
    size = largest_of_quantity(jnp.maximum(jnp.abs(end), change), like)
    change = largest_of_quantity(change, like)
    # Without the constant the derivative of the quotient would divide by a square, which may
    # underflow, as ahead of a front.
    constant = lax.stop_gradient(jnp.where(size > 0, size, 1))
    ratio = (change / constant) / jnp.where(size > 0, size / constant, 1)
    ratio = jnp.maximum(ratio, eps_of(change))
    return with_least_units(jnp.maximum(units, size * jnp.sqrt(ratio)), like)


def with_least_units(units: Float[Array, " n"], like: Any) -> Float[Array, " n"]:
    """The units, of which none is below `ε` times the largest of its leaf, if a leaf of a state of
    several leaves holds many vectors.

    If the last link of a chain at rest is pushed, the others begin to move with high powers of
    time, by 1e-70 for example. Such a unit is far below the roundoff of the tangents of residuals,
    which the derivative of a projection would then correct in components with larger units, where
    it is not small.
    """
    leaves = jtu.tree_leaves(like)
    if len(leaves) == 1 or all(x.ndim < 2 for x in leaves):
        return units
    return jnp.maximum(units, eps_of(units) * _largest(units, like, None))


def largest_of_quantity(x: Float[Array, " n"], like: Any) -> Float[Array, " n"]:
    """Each component of `x` replaced by the largest of its quantity, where `x` is the `ravel` of a
    state like `like`.

    A single array may hold unlike quantities, so that each of its components is one, as wherever
    this package judges errors or drifts. In a state of several leaves each vector along the last
    axis of a leaf, such as the position of a body, is one quantity, because with different units
    for its components corrections would turn it.
    """
    return _largest(x, like, -1)


def _largest(x: Float[Array, " n"], like: Any, axis: int | None) -> Array:
    if len(jtu.tree_leaves(like)) == 1:
        return x

    def largest(part: Array) -> Array:
        along = axis if part.ndim else None
        most = jnp.max(part, axis=along, keepdims=True, initial=0)
        return jnp.broadcast_to(most, part.shape)

    return ravel(jtu.tree_map(largest, unflatten(x, jax.eval_shape(real_view, like))))
