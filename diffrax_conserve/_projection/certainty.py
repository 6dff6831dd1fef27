"""Whether the derivative of a projection is well determined.

Where gradients of constraints are nearly parallel, multipliers are large and cancel, so that
roundoff dominates their derivatives. Gradients that are parallel everywhere do no harm: such a
constraint is redundant.
"""

import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._custom_types import Y
from .._tree import tree_add, tree_max, tree_norm, tree_scale, tree_sub, working_dtype
from .equations import Equations
from .jacobian import AbstractJacobian
from .linearise import linearise

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


def _beside(y: Y) -> Y:
    """A state near `y` in a generic direction."""
    largest = tree_max(y)

    def offset(x: Array) -> Array:
        phases = jnp.arange(1, x.size + 1, dtype=x.dtype).reshape(x.shape)
        return (jnp.abs(x) + 0.1 * largest.astype(x.dtype)) * jnp.sin(phases * phases)

    return tree_add(y, tree_scale(_OFFSET, jtu.tree_map(offset, y)))
