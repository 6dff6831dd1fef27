"""Whether the derivative of a projection is well determined.

Where gradients of constraints are nearly parallel, multipliers are large and cancel, so that
roundoff dominates their derivatives. Gradients that are parallel everywhere do no harm: such a
constraint is redundant. A gradient that is zero up to roundoff, for example at an equilibrium, has
no direction either; one that is exactly zero takes no part.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, PyTree

from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._tree import (
    real_view,
    tree_add,
    tree_max,
    tree_norm,
    tree_scale,
    tree_stop_gradient,
    tree_sub,
    tree_tangents,
    tree_uniform,
    working_dtype,
)
from .equations import Equations
from .jacobian import AbstractJacobian
from .linearise import Joined, linearise
from .residual import residual_of

# The relative distance to the state at which it is tested whether gradients are parallel
# everywhere.
_OFFSET = 1e-3
# Gradients count as nearly parallel if the sine of their angle is below the cube root of roundoff,
# or if it is below `_SMALL_ANGLE` and the correction, relative to the state and divided by the
# sine, is above `_SHORT_CORRECTION`.
_SMALL_ANGLE, _SHORT_CORRECTION = 1e-2, 1e-5


def certain(equations: Equations, y: Y, jacobian: AbstractJacobian) -> Float[Array, ""]:
    """One if the derivative of the projected state `y` is well determined, otherwise NaN."""
    dtype = working_dtype(y)
    if equations.magnitude.size == 1:  # a single gradient
        return jnp.ones((), dtype)
    eps = float(jnp.finfo(dtype).eps)
    sines = jacobian.sines(equations.weights)
    if sines is None:
        return jnp.ones((), dtype)
    _, elsewhere = linearise(equations.residual, _beside(y))
    others = elsewhere.sines(equations.weights)
    dependent = others <= 64 * eps if others is not None else jnp.zeros_like(sines, bool)
    moved = tree_norm(tree_sub(y, equations.candidate))
    amplified = moved > _SHORT_CORRECTION * sines * tree_norm(y)
    doubtful = (sines <= eps ** (1 / 3)) | ((sines <= _SMALL_ANGLE) & amplified)
    return jnp.where(jnp.any(doubtful & ~dependent), jnp.nan, 1.0).astype(dtype)


def if_certain(
    x: PyTree[Array], manifold: Manifold, values: Values, t: RealScalarLike, y: Y, args: Args
) -> PyTree[Array]:
    """`x`, with a derivative that is NaN if a gradient at `y` vanishes up to roundoff: then no
    derivative of a projection to `y`, or of a solve from there, is well determined."""
    return _if_certain(x, *residual_of(manifold, values, t, y, args), real_view(y))


@eqx.filter_custom_jvp
def _if_certain(x: PyTree[Array], residual: Joined, magnitude: Array, y: Y) -> PyTree[Array]:
    return x


@_if_certain.def_jvp
def _if_certain_jvp(primals: Any, tangents: Any) -> tuple[PyTree[Array], PyTree[Array]]:
    x, *at = primals
    factor = jnp.where(_gradient_vanishes(*tree_stop_gradient(at)), jnp.nan, 1)
    return x, tree_scale(factor, tree_tangents(x, tangents[0]))


def _gradient_vanishes(residual: Joined, magnitude: Array, y: Y) -> Bool[Array, ""]:
    """Whether a gradient is zero at a state so close to `y` that the relative distance hardly
    exceeds the roundoff of `y`, or what the roundoff of the conserved value lets it move."""
    offset, uniform = tree_sub(_beside(y), y), tree_uniform(y)
    gradient = linearise(residual, y)[1].scale(uniform)
    _, change = linearise(lambda x: residual(tree_add(x, offset)) - residual(x), y)
    curvature = change.scale(uniform) / _OFFSET
    roundoff = float(jnp.finfo(gradient.dtype).eps) ** (2 / 3) * (magnitude + gradient)
    return jnp.any((gradient > 0) & (gradient**2 <= roundoff * curvature))


def _beside(y: Y) -> Y:
    """A state near `y` in a generic direction."""
    largest = tree_max(y)

    def offset(x: Array) -> Array:
        phases = jnp.arange(1, x.size + 1, dtype=x.dtype).reshape(x.shape)
        return (jnp.abs(x) + 0.1 * largest.astype(x.dtype)) * jnp.sin(phases * phases)

    return tree_add(y, tree_scale(_OFFSET, jtu.tree_map(offset, y)))
