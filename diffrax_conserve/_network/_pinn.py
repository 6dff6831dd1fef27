"""A physics-informed network: one solution, as a function of time."""

from typing import final

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PRNGKeyArray

from .._custom_types import RealScalarLike, Y
from .._tree import working_dtype
from ._flat import as_state, flatten, unflatten
from ._layer import ConservativeLayer
from ._mlp import MLP, Activation, check_sizes


@final
class PINN(eqx.Module):
    r"""A network for the solution through one initial state, on one interval of time.

    $$u(t) = u_0 + \frac{t - t_0}{t_1 - t_0} S N(t)$$

    with a fully connected network $N$, so that $u(t_0) = u_0$ whatever the weights. With a `layer`,
    the output is moved to the manifold of the values at $(t_0, u_0)$.

    Train it by [`diffrax_conserve.fit`][], and step it by [`diffrax_conserve.PINNSolver`][].

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax
        import jax.numpy as jnp

        y0 = {"position": jnp.array([1.0, 0.0]), "charge": jnp.array(2.0)}
        pinn = dfc.PINN(y0, 0.0, 3.0, key=jax.random.key(0))
        pinn(1.5)  # a dictionary like y0
        ```

    ??? cite "Reference"

        M. Raissi, P. Perdikaris and G. E. Karniadakis, J. Comput. Phys. 378 (2019); the ansatz is
        that of I. E. Lagaris, A. Likas and D. I. Fotiadis, IEEE Trans. Neural Networks 9 (1998).
    """

    net: MLP
    layer: ConservativeLayer | None
    y0: Y
    t0: float = eqx.field(static=True)
    t1: float = eqx.field(static=True)
    scale: Float[Array, " n"]
    normalise: bool = eqx.field(static=True)

    def __init__(
        self,
        y0: Y,
        t0: RealScalarLike,
        t1: RealScalarLike,
        *,
        key: PRNGKeyArray,
        width: int = 40,
        depth: int = 4,
        activation: str | Activation = "tanh",
        normalise: bool = True,
        layer: ConservativeLayer | None = None,
    ):
        check_sizes(width=width, depth=depth)
        if not t0 < t1:
            raise ValueError(f"`t0` must be less than `t1`, but they are {t0} and {t1}.")
        self.y0 = as_state(y0)
        dtype = working_dtype(self.y0)
        self.t0, self.t1 = float(t0), float(t1)
        n = flatten(self.y0).size
        self.net = MLP(1, n, width, depth, activation, dtype, key=key)
        self.layer = layer
        self.normalise = normalise
        self.scale = flatten(jtu.tree_map(_magnitude, self.y0)) if normalise else jnp.ones(n, dtype)

    def __call__(self, t: RealScalarLike) -> Y:
        """The state at time `t`."""
        candidate = self.candidate(t)
        if self.layer is None:
            return candidate
        return self.layer(candidate, self.layer.values(self.t0, self.y0), t, self.radius())

    def candidate(self, t: RealScalarLike) -> Y:
        """The state at time `t` before the conservative layer."""
        t = jnp.asarray(t).astype(self.scale.dtype)
        fraction = (t - self.t0) / (self.t1 - self.t0)
        out = self.net((2 * fraction - 1 if self.normalise else t)[None])
        return unflatten(flatten(self.y0) + fraction * self.scale * out, self.y0)

    def radius(self) -> Float[Array, ""]:
        """How far the conservative layer may move a state in one iteration."""
        return jnp.sqrt(jnp.sum(jnp.square(self.scale)))


PINN.__init__.__doc__ = r"""**Arguments:**

- `y0`: the initial state $u_0$, any PyTree of real arrays.
- `t0`, `t1`: the interval of time.
- `key`: a random key, for the initial weights.
- `width`, `depth`: units in each hidden layer, and hidden layers.
- `activation`: `"tanh"`, `"sin"`, `"gelu"`, `"silu"`, `"softplus"`, `"sigmoid"`, or a function
    (which [`diffrax_conserve.save`][] cannot write).
- `normalise`: whether $N$ sees time scaled to $[-1, 1]$ and $S$ holds the largest component of each
    leaf of $u_0$. Otherwise $N$ sees $t$, and $S = 1$.
- `layer`: a [`diffrax_conserve.ConservativeLayer`][].

**Raises:**

`ValueError` or `TypeError` if a size or the interval is not what it must be.
"""


def _magnitude(leaf: Array) -> Array:
    largest = jnp.max(jnp.abs(leaf)) if leaf.size else jnp.ones((), leaf.dtype)
    return jnp.broadcast_to(jnp.where(largest > 0, largest, 1), leaf.shape)
