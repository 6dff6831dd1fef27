"""Whether the derivative of a projection means anything.

Where gradients of constraints are nearly parallel, multipliers are large and cancel, so that
roundoff and the smallest correction decide on their derivatives. Gradients that are parallel
everywhere do no harm: such a constraint only says again what others say.
"""

import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._custom_types import Y
from .._tree import tree_add, tree_max, tree_norm, tree_scale, tree_sub, working_dtype
from .iteration import Equations
from .jacobian import AbstractJacobian
from .linearise import linearise

# How far, relative to the state, to go to see whether gradients are parallel there too.
_OFFSET = 1e-3
# Gradients at a smaller angle than the cube root of roundoff are not told apart, and at a smaller
# one than this only if the correction, divided by the angle, is a smaller part of the state.
_SMALL_ANGLE, _SHORT_CORRECTION = 1e-2, 1e-5


def certain(equations: Equations, y: Y, jacobian: AbstractJacobian) -> Float[Array, ""]:
    """One if the derivative of the projected state `y` is well determined, otherwise NaN."""
    dtype = working_dtype(y)
    if equations.magnitude.size == 1:  # parallel to nothing
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
    """A state near `y`, in no special direction."""
    largest = tree_max(y)

    def offset(x: Array) -> Array:
        phases = jnp.arange(1, x.size + 1, dtype=x.dtype).reshape(x.shape)
        return (jnp.abs(x) + 0.1 * largest.astype(x.dtype)) * jnp.sin(phases * phases)

    return tree_add(y, tree_scale(_OFFSET, jtu.tree_map(offset, y)))
