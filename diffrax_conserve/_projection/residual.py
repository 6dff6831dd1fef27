"""The residuals of a manifold, and the scales to which their roundoff is proportional.

For a first integral `g = I(t, y, args) - I₀`, for a constraint `g` itself. The scale of a scalar
constraint at a state `y` is `|I₀| + Σ_k |y_k ∂g/∂y_k|`: the conserved value, and the terms that
cancel in the residual. Success is judged relative to the scale at the returned state.
"""

import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, PyTree, Real

from .._custom_types import Args, Manifold, RealScalarLike, Values, Y
from .._manifold import evaluate
from .._tree import from_view, real_view, unflatten, working_dtype
from .elimination import Vector
from .linearise import Joined, linearise

# The accepted residual, in units of roundoff of the scale. Rounding the state and evaluating the
# residual contribute about one unit each, so nearly every projection ends well below this; where
# gradients are almost parallel, only just below.
ROUNDOFF_MULTIPLE = 16


def residual_of(
    manifold: Manifold, values: Values, t: RealScalarLike, y: Y, args: Args
) -> tuple[Joined, Real[Array, " m"]]:
    """The residual as a function of the state (of its `real_view` if it is complex), and the
    absolute conserved values, both as vectors."""
    dtype = working_dtype(y)

    def parts(view: Y) -> list[Array]:
        out = evaluate(manifold, t, from_view(view, y), args)
        residuals = jtu.tree_map(lambda a, b: a - jnp.asarray(b, a.dtype), out, values)
        return [x.astype(dtype) for x in jtu.tree_leaves(residuals)]

    # Arrays over which `fn` closes become part of `residual`'s PyTree, and can be differentiated.
    residual = Joined(eqx.filter_closure_convert(parts, real_view(y)))
    outputs = jax.eval_shape(lambda y: evaluate(manifold, t, y, args), y)
    magnitudes = jtu.tree_map(lambda a, b: jnp.abs(jnp.asarray(b, a.dtype)), outputs, values)
    return residual, jnp.concatenate(
        [x.astype(dtype).reshape(-1) for x in jtu.tree_leaves(magnitudes)]
    )


def measure(
    manifold: Manifold, values: Values, t: RealScalarLike, y: Y, args: Args
) -> tuple[Values, Values]:
    """The residuals at `y` and their scales there, both shaped like `values`."""
    residual, magnitude = residual_of(manifold, values, t, y, args)
    view = real_view(y)
    g, jacobian = linearise(residual, view)
    like = jax.eval_shape(lambda: evaluate(manifold, t, y, args))
    return unflatten(g, like), unflatten(magnitude + jacobian.scale(view), like)


def relative(residual: PyTree[Array], scale: PyTree[Array]) -> PyTree[Array]:
    """Residuals relative to their scales; a scale of zero counts as one."""
    return jtu.tree_map(lambda g, s: g / jnp.where(s > 0, s, jnp.ones_like(s)), residual, scale)


def largest(ratios: PyTree[Array]) -> Float[Array, ""]:
    """The largest modulus, or NaN if any element is NaN."""
    return ft.reduce(jnp.maximum, [jnp.max(jnp.abs(x), initial=0) for x in jtu.tree_leaves(ratios)])


def within(residual: Vector, tolerance: Vector) -> Bool[Array, ""]:
    """Whether every residual is within its tolerance. NaN and infinity never are."""
    satisfied = jtu.tree_map(
        lambda g, tol: jnp.all((jnp.abs(g) <= tol) & (tol < jnp.inf)), residual, tolerance
    )
    return ft.reduce(jnp.logical_and, jtu.tree_leaves(satisfied))


class Tolerance(eqx.Module):
    """The largest residual that counts as zero, `atol + rtol * scale`. The default of `rtol` is
    `ROUNDOFF_MULTIPLE` units of roundoff. It is NaN, which no residual satisfies, where the scale
    is so small that a residual of this size underflows."""

    rtol: float | Array | None
    atol: float | Array | None

    def __call__(self, scale: Vector) -> Vector:
        def combine(x: Array) -> Array:
            roundoff = ROUNDOFF_MULTIPLE * jnp.finfo(x.dtype).eps
            rtol = roundoff if self.rtol is None else self.rtol
            atol = 0.0 if self.atol is None else self.atol
            tolerance = jnp.asarray(rtol, x.dtype) * x + jnp.asarray(atol, x.dtype)
            underflows = (x > 0) & (tolerance < jnp.finfo(x.dtype).tiny)
            return jnp.where(underflows, jnp.nan, tolerance)

        return jtu.tree_map(combine, scale)
