"""What a flow map's network does with its two inputs, the initial state and the step.

Each core maps the normalised initial state, a vector of `n` numbers, and the normalised step to a
vector of `m` numbers.
"""

from typing import final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from ._mlp import MLP, Activation


@final
class Product(eqx.Module):
    r"""`Σ_l b_jl(u) τ_jl(h) / √L`: a branch network times a trunk network, as in a DeepONet."""

    branch: MLP
    trunk: MLP
    size: int = eqx.field(static=True)

    def __init__(
        self,
        n: int,
        m: int,
        width: int,
        depth: int,
        latent: int,
        activation: str | Activation,
        dtype: jnp.dtype,
        *,
        key: PRNGKeyArray,
    ):
        branch_key, trunk_key = jr.split(key)
        self.branch = MLP(n, m * latent, width, depth, activation, dtype, key=branch_key)
        self.trunk = MLP(1, m * latent, width, depth, activation, dtype, key=trunk_key)
        self.size = m

    def __call__(self, state: Float[Array, " n"], step: Float[Array, ""]) -> Float[Array, " m"]:
        b = self.branch(state).reshape(self.size, -1)
        tau = self.trunk(step[None]).reshape(b.shape)
        return jnp.sum(b * tau, axis=1) / b.shape[1] ** 0.5


@final
class Concatenated(eqx.Module):
    """One fully connected network of the state and the step together."""

    net: MLP

    def __init__(
        self,
        n: int,
        m: int,
        width: int,
        depth: int,
        activation: str | Activation,
        dtype: jnp.dtype,
        *,
        key: PRNGKeyArray,
    ):
        self.net = MLP(n + 1, m, width, depth, activation, dtype, key=key)

    def __call__(self, state: Float[Array, " n"], step: Float[Array, ""]) -> Float[Array, " m"]:
        return self.net(jnp.append(state, step))


@final
class Gated(eqx.Module):
    """The same, whose hidden layers interpolate between two encodings of the input.

    `z ← a * z̃ + b * (1 - z̃)` with `z̃` what the layer makes of `z`, so that the input takes part in
    every layer by a product (S. Wang, Y. Teng and P. Perdikaris, SIAM J. Sci. Comput. 43 (2021)).
    """

    encoders: tuple[MLP, MLP]
    hidden: tuple[MLP, ...]
    last: MLP

    def __init__(
        self,
        n: int,
        m: int,
        width: int,
        depth: int,
        activation: str | Activation,
        dtype: jnp.dtype,
        *,
        key: PRNGKeyArray,
    ):
        keys = jr.split(key, depth + 3)

        def layer(in_size: int, out_size: int, key: PRNGKeyArray) -> MLP:
            return MLP(in_size, out_size, width, 0, activation, dtype, key=key)

        self.encoders = (layer(n + 1, width, keys[0]), layer(n + 1, width, keys[1]))
        sizes = [n + 1, *([width] * (depth - 1))]
        self.hidden = tuple(layer(s, width, k) for s, k in zip(sizes, keys[3:], strict=True))
        self.last = layer(width, m, keys[2])

    def __call__(self, state: Float[Array, " n"], step: Float[Array, ""]) -> Float[Array, " m"]:
        activation = self.last.activation
        z = jnp.append(state, step)
        a, b = (activation(encoder(z)) for encoder in self.encoders)
        for layer in self.hidden:
            gate = activation(layer(z))
            z = gate * a + (1 - gate) * b
        return self.last(z)


Core = Product | Concatenated | Gated


def output_layer(core: Core) -> MLP:
    """The network whose last layer the output is linear in, whatever the weights before it."""
    match core:
        case Product():
            return core.branch
        case Concatenated():
            return core.net
        case Gated():
            return core.last
