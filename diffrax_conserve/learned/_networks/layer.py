"""The conservative layer: a few iterations towards the manifold, as the last layer of a network."""

from typing import final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int, PyTree

from ..._balance import refuse_rates
from ..._custom_types import Args, Manifold, RealScalarLike, Values, Y
from ..._manifold import check_manifold, conserved_values
from ..._projection.elimination import Vector
from ..._projection.linearise import Elements, Residual, linearise, written_out
from ..._projection.residual import residual_of
from ..._tree import (
    tree_add,
    tree_dot,
    tree_scale,
    tree_stop_gradient,
    tree_sub,
    tree_tangents,
    working_dtype,
)
from .mlp import check_sizes


@final
class ConservativeLayer(eqx.Module):
    r"""Moves the output of a network towards the manifold, by `steps` iterations.

    For the output $\hat y$, with the constraint Jacobian $G$ and the residual $g$, the result is
    $y = \hat y + G(\hat y)^\top \lambda$, where the multipliers start at zero and are updated by

    $$\lambda \leftarrow \lambda - (G(y) G(\hat y)^\top + \mu I)^{-1} g(y).$$

    This is Newton's method in $\lambda$, with rows scaled to norm one and a damping
    $\mu = \min(10^{-2}, |g|^2)$ that vanishes with the residual relative to its scale. An iteration
    moves a state by at most `radius`; otherwise the step would be arbitrarily long near a point
    where $G$ vanishes.

    The layer is part of the network: derivatives of the network with respect to time and weights
    include the layer. They follow from the implicit function theorem for $g(y) = r$, where $r$ is
    the remaining residual; no iteration is unrolled.

    With few iterations, the output is near the manifold, and on it to roundoff only if the output
    of the network is already close. For a state exactly on the manifold, wrap the solver in
    [`diffrax_conserve.ManifoldProjection`][].

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax
        import jax.numpy as jnp

        energy = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
        layer = dfc.learned.ConservativeLayer(energy, steps=5)
        pinn = dfc.PINN(jnp.array([1.0, 0.0]), 0.0, 3.0, layer=layer, key=jax.random.key(0))
        pinn(2.0)
        ```

    ??? cite "Reference"

        E. Cardoso-Bihlo and A. Bihlo, arXiv:2311.14131, Algorithm 1, which also freezes $G(y)$ at
        $\hat y$ and does not damp, and therefore needs an output that is already close.
    """

    manifold: Manifold
    steps: int = eqx.field(static=True, kw_only=True, default=3)
    args: Args = eqx.field(kw_only=True, default=None)

    def __check_init__(self):
        check_manifold(self.manifold)
        refuse_rates(self.manifold, "a `ConservativeLayer`")
        check_sizes(steps=self.steps)

    def values(self, t0: RealScalarLike, y0: Y) -> Values:
        """The conserved values of the solution through `y0`."""
        return conserved_values(self.manifold, t0, y0, self.args)

    def __call__(
        self,
        candidate: Y,
        values: Values,
        t: RealScalarLike,
        radius: Float[Array, ""],
        schedule: tuple[Int[Array, ""], Float[Array, ""]] | None = None,
    ) -> Y:
        """The state after all iterations; or `(1 - s) P_{p-1} y + s P_p y` for `schedule = (p, s)`,
        where `P_k y` is the state after `k` iterations.

        The numbers `p` and `s` may be traced, so that a training with any schedule compiles once.
        Iterations beyond the `p`-th are not computed.
        """
        dtype = working_dtype(candidate)

        residual, magnitude = residual_of(self.manifold, values, t, candidate, self.args)
        function, split, join = written_out(residual, candidate)
        magnitude = tuple(magnitude) if isinstance(function, Elements) else magnitude
        if schedule is None:
            schedule = (jnp.asarray(self.steps), jnp.ones((), dtype))
        p, s = schedule
        start = _stored(split(candidate), p)
        # Arrays over which the functions close become part of `residual`'s PyTree.
        residual = eqx.filter_closure_convert(lambda y: function(_stored(y, p)), start)
        fixed = lax.stop_gradient((magnitude, radius.astype(dtype), p, s.astype(dtype)))
        y, _ = _conserve(residual, start, fixed, steps=self.steps)
        return join(y)


ConservativeLayer.__init__.__doc__ = r"""**Arguments:**

- `manifold`: a PyTree of `FirstIntegral`s and `Constraint`s.
- `steps`: the number $P$ of iterations.
- `args`: passed to the functions of the manifold.

**Raises:**

`TypeError` or `ValueError` if `manifold` or `steps` is invalid.
"""

# The magnitude of the conserved values, the radius, p and s.
_Fixed = tuple[Vector, Array, Array, Array]


@eqx.filter_custom_jvp
def _conserve(residual: Residual, candidate: Y, fixed: _Fixed, *, steps: int) -> tuple[Y, Vector]:
    """`ŷ + G(ŷ)ᵀ λ` with `λ = (1 - s) λ_{p-1} + s λ_p`, and `λ`."""
    magnitude, radius, p, s = fixed
    before, at_candidate = linearise(residual, candidate)
    weights = jtu.tree_map(jnp.ones_like, candidate)
    dtype = working_dtype(candidate)

    def improve(multipliers: Vector) -> Vector:
        y = tree_add(candidate, at_candidate.pullback(multipliers))
        g, at_y = linearise(residual, y)
        scale = jtu.tree_map(jnp.add, magnitude, at_y.scale(y))
        damping = jnp.minimum(1e-2, _relative_square(g, scale)).astype(dtype)
        change = at_y.gram_solver(weights, at_candidate, damping).solve(g)
        step = at_candidate.pullback(change)
        shortening = lax.rsqrt(1 + tree_dot(step, step, dtype) / jnp.square(radius))
        return tree_sub(multipliers, tree_scale(shortening, change))

    def iterate(carry: tuple[Vector, Vector], i: Array) -> tuple[tuple[Vector, Vector], None]:
        return lax.cond(i < p, lambda c: (c[1], improve(c[1])), lambda c: c, carry), None

    zeros = jtu.tree_map(jnp.zeros_like, before)
    (previous, last), _ = lax.scan(iterate, (zeros, zeros), jnp.arange(steps))
    multipliers = jtu.tree_map(lambda a, b: a + s * (b - a), previous, last)
    return tree_add(candidate, at_candidate.pullback(multipliers)), multipliers


@_conserve.def_jvp
def _conserve_jvp(primals, tangents, *, steps):
    """The implicit function theorem for `g(ŷ + G(ŷ)ᵀ λ) = r` with the remaining residual `r`.

    Let `ẏ` and `ġ` be the tangents of the displaced state and of its residual at constant `λ`. Then
    `λ̇ = -(G(y) G(ŷ)ᵀ)⁻¹ ġ`. Where the first iteration is not complete (`p = 0`, or `p = 1` with `s
    < 1`) the multipliers are `s` times those of a complete one, and so is their tangent.

    The linear solve is differentiated implicitly too. Second derivatives, which every loss with a
    time derivative needs, then cost products with `G` instead of derivatives of its rows.
    """
    residual, candidate, fixed = primals
    t_residual, t_candidate, _ = tangents
    y, multipliers = _conserve(residual, candidate, fixed, steps=steps)

    def displaced(residual: Residual, candidate: Y) -> tuple[Y, Vector]:
        # `Gᵀ λ` by one reverse pass for all constraints.
        _, vjp = eqx.filter_vjp(residual, candidate)
        (direction,) = vjp(multipliers)
        state = tree_add(candidate, direction)
        return state, residual(state)

    t_y, t_g = tree_tangents(
        *eqx.filter_jvp(displaced, (residual, candidate), (t_residual, t_candidate))
    )
    _, at_candidate = linearise(*tree_stop_gradient((residual, candidate)))
    _, at_y = linearise(*tree_stop_gradient((residual, y)))
    weights = jtu.tree_map(jnp.ones_like, candidate)
    _, vjp = eqx.filter_vjp(residual, candidate)

    def product(multipliers: Vector) -> Vector:
        return jax.jvp(residual, (y,), vjp(multipliers))[1]

    t_multipliers = lax.custom_linear_solve(
        product,
        t_g,
        solve=lambda _, b: at_y.gram_solver(weights, at_candidate).solve(b),
        transpose_solve=lambda _, b: at_candidate.gram_solver(weights, at_y).solve(b),
    )
    _, _, p, s = fixed
    share = jnp.where(p == 0, 0, jnp.where(p == 1, s, 1))
    t_multipliers = jtu.tree_map(lambda x: -share * x, t_multipliers)
    (direction,) = vjp(t_multipliers)
    return (y, multipliers), (tree_add(t_y, direction), t_multipliers)


def _stored(tree: PyTree[Array], p: Int[Array, ""]) -> PyTree[Array]:
    """`tree`, passed through a `cond` that makes XLA store it and its cotangent.

    Otherwise XLA repeats their computation in each loop that uses them, and for each element where
    scalars are stacked to an array.
    """
    return lax.cond(p >= 0, lambda x: x, lambda x: jtu.tree_map(jnp.zeros_like, x), tree)


def _relative_square(g: Vector, scale: Vector) -> Array:
    def square(a: Array, b: Array) -> Array:
        positive = b > 0
        return jnp.sum(jnp.square(jnp.where(positive, a / jnp.where(positive, b, 1), a)))

    return sum(jtu.tree_leaves(jtu.tree_map(square, g, scale)))  # pyright: ignore
