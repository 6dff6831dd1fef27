"""The conservative layer: a few iterations towards the manifold, as the last layer of a network."""

from collections.abc import Callable
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
from ..._options import check_counts
from ..._projection.elimination import combined, gram_matrix, gram_solve
from ..._projection.equations import equations_of, relative
from ..._projection.scalars import written_out
from ..._tree import ravel, tree_stop_gradient, tree_tangents, unravel


@final
class ConservativeLayer(eqx.Module):
    r"""Moves the output of a network towards the manifold, by `steps` iterations.

    For the output $\hat y$, with the constraint Jacobian $G$ and the residual $g$, the result is
    $y = \hat y + G(\hat y)^\top \lambda$, where the multipliers start at zero and are updated by

    $$\lambda \leftarrow \lambda - (G(y) G(\hat y)^\top + \mu I)^{-1} g(y).$$

    This is Newton's method in $\lambda$, with rows scaled to norm one and a damping
    $\mu = \min(10^{-2}, |g|^2)$ that vanishes with the residual relative to its scale. An iteration
    moves a state by at most the size of a state. Derivatives include the layer, by the implicit
    function theorem for $g(y) = r$ with the remaining residual $r$. For a state on the manifold to
    roundoff, wrap the solver in [`diffrax_conserve.ManifoldProjection`][].

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
        check_counts(steps=self.steps)

    def values(self, t0: RealScalarLike, y0: Y) -> Values:
        """The conserved values of the solution through `y0`."""
        return conserved_values(self.manifold, t0, y0, self.args)

    def __call__(
        self,
        candidate: Y,
        values: Values,
        t: RealScalarLike,
        scale: Float[Array, "..."],
        schedule: tuple[Int[Array, ""], Float[Array, ""]] | None = None,
    ) -> Y:
        """The state after all iterations; or `(1 - s) P_{p-1} y + s P_p y` for `schedule = (p, s)`,
        where `P_k y` is the state after `k` iterations, and those beyond the `p`-th are not
        computed. An iteration moves the state by at most the norm of `scale`."""
        start, dtype = ravel(candidate), ravel(candidate).dtype
        numbers = ravel(values).astype(dtype)
        equations = equations_of(self.manifold, numbers, t, candidate, self.args)
        p, s = (jnp.asarray(self.steps), jnp.ones((), dtype)) if schedule is None else schedule
        start = _stored(start, p)

        def residual(y: Float[Array, " n"]) -> Float[Array, " m"]:
            return written_out(equations.residual, _stored(y, p))

        # Arrays over which the functions close become part of `residual`'s PyTree.
        converted = eqx.filter_closure_convert(residual, start)
        radius = jnp.sqrt(jnp.sum(jnp.square(scale))).astype(dtype)
        fixed = lax.stop_gradient((equations.magnitude, radius, p, s.astype(dtype)))
        y, _ = _conserve(converted, start, fixed, steps=self.steps)
        return unravel(y, candidate)


ConservativeLayer.__init__.__doc__ = r"""**Arguments:**

- `manifold`: a PyTree of `FirstIntegral`s and `Constraint`s.
- `steps`: the number $P$ of iterations.
- `args`: passed to the functions of the manifold.

An invalid `manifold` or number raises a `TypeError` or `ValueError`.
"""

# The magnitude of the conserved values, the radius, p and s.
_Fixed = tuple[Float[Array, " m"], Array, Array, Array]
_Residual = Callable[[Float[Array, " n"]], Float[Array, " m"]]


def _linearise(residual: _Residual, y: Float[Array, " n"]) -> tuple[Array, Array]:
    g, vjp = jax.vjp(residual, y)
    return g, jax.vmap(vjp)(jnp.eye(g.size, dtype=g.dtype))[0]


@eqx.filter_custom_jvp
def _conserve(
    residual: _Residual, candidate: Float[Array, " n"], fixed: _Fixed, *, steps: int
) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """`ŷ + G(ŷ)ᵀ λ` with `λ = (1 - s) λ_{p-1} + s λ_p`, and `λ`."""
    magnitude, radius, p, s = fixed
    before, rows = _linearise(residual, candidate)

    def improve(multipliers: Array) -> Array:
        y = candidate + combined(multipliers, rows)
        g, jacobian = _linearise(residual, y)
        ratio = relative(g, magnitude + jnp.sum(jnp.abs(jacobian * y), axis=1))
        damping = jnp.minimum(1e-2, jnp.sum(ratio * ratio))
        gram = gram_matrix(jacobian, rows)
        change = gram_solve(gram * (1 + damping * jnp.eye(g.size, dtype=g.dtype)), g)
        step = combined(change, rows)
        shortening = lax.rsqrt(1 + jnp.sum(step * step) / jnp.square(radius))
        return multipliers - shortening * change

    def iterate(carry: tuple[Array, Array], i: Array) -> tuple[tuple[Array, Array], None]:
        return lax.cond(i < p, lambda c: (c[1], improve(c[1])), lambda c: c, carry), None

    zeros = jnp.zeros_like(before)
    (previous, last), _ = lax.scan(iterate, (zeros, zeros), jnp.arange(steps))
    multipliers = previous + s * (last - previous)
    return candidate + combined(multipliers, rows), multipliers


@_conserve.def_jvp
def _conserve_jvp(primals, tangents, *, steps):
    """`λ̇ = -(G(y) G(ŷ)ᵀ)⁻¹ ġ`, where `ġ` is the tangent of the residual at constant `λ`. Where
    the first iteration is not complete (`p = 0`, or `p = 1` with `s < 1`) the multipliers are `s`
    times those of a complete one, and so is their tangent.

    The linear solve is differentiated implicitly too. Second derivatives, which every loss with a
    time derivative needs, then cost products with `G` instead of derivatives of its rows.
    """
    residual, candidate, fixed = primals
    t_residual, t_candidate, _ = tangents
    y, multipliers = _conserve(residual, candidate, fixed, steps=steps)

    def displaced(residual: _Residual, candidate: Array) -> tuple[Array, Array]:
        # `Gᵀ λ` by one reverse pass for all constraints.
        _, vjp = eqx.filter_vjp(residual, candidate)
        state = candidate + vjp(multipliers)[0]
        return state, residual(state)

    t_y, t_g = tree_tangents(
        *eqx.filter_jvp(displaced, (residual, candidate), (t_residual, t_candidate))
    )
    fixed_residual, fixed_candidate, fixed_y = tree_stop_gradient((residual, candidate, y))
    _, rows = _linearise(fixed_residual, fixed_candidate)
    _, jacobian = _linearise(fixed_residual, fixed_y)
    gram = gram_matrix(jacobian, rows)
    _, vjp = eqx.filter_vjp(residual, candidate)

    def product(multipliers: Array) -> Array:
        return jax.jvp(residual, (y,), vjp(multipliers))[1]

    t_multipliers = lax.custom_linear_solve(
        product,
        t_g,
        solve=lambda _, b: gram_solve(gram, b),
        transpose_solve=lambda _, b: gram_solve(gram.T, b),
    )
    _, _, p, s = fixed
    t_multipliers = -jnp.where(p == 0, 0, jnp.where(p == 1, s, 1)) * t_multipliers
    return (y, multipliers), (t_y + vjp(t_multipliers)[0], t_multipliers)


def _stored(tree: PyTree[Array], p: Int[Array, ""]) -> PyTree[Array]:
    """`tree`, through a `cond`, because otherwise XLA computes it and its cotangent again in each
    loop that uses them, and for each element where scalars are stacked to an array."""
    return lax.cond(p >= 0, lambda x: x, lambda x: jtu.tree_map(jnp.zeros_like, x), tree)
