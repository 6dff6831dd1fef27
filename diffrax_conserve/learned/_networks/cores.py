"""Architectures for the network of a flow map.

A core maps the normalised initial state, a vector of `n` numbers, and the normalised step to a
vector of `m` numbers.
"""

import abc
from typing import NamedTuple, final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .mlp import MLP, Activation


class Sizes(NamedTuple):
    """The sizes and the activation function of a network."""

    width: int
    depth: int
    latent: int
    activation: Activation


class AbstractCore(eqx.Module):
    """The network of a [`diffrax_conserve.DeepONet`][]."""

    @classmethod
    @abc.abstractmethod
    def create(
        cls, n: int, m: int, sizes: Sizes, dtype: jnp.dtype, key: PRNGKeyArray
    ) -> "AbstractCore":
        """A core with random weights, which maps `n` numbers and a step to `m` numbers."""

    @abc.abstractmethod
    def __call__(self, state: Float[Array, " n"], step: Float[Array, ""]) -> Float[Array, " m"]:
        """The `m` numbers."""

    @abc.abstractmethod
    def output_layer(self) -> MLP:
        """The network in whose last layer the output is linear, for all values of the other
        weights."""


@final
class Product(AbstractCore):
    r"""`Σ_l b_jl(u) τ_jl(h) / √L`: a branch network times a trunk network, as in the literature."""

    branch: MLP
    trunk: MLP
    size: int = eqx.field(static=True)

    @classmethod
    def create(cls, n: int, m: int, sizes: Sizes, dtype: jnp.dtype, key: PRNGKeyArray) -> "Product":
        width, depth, latent, activation = sizes
        branch, trunk = (
            MLP(k, m * latent, width, depth, activation, dtype, key=one)
            for k, one in zip((n, 1), jr.split(key), strict=True)
        )
        return cls(branch, trunk, m)

    def __call__(self, state: Float[Array, " n"], step: Float[Array, ""]) -> Float[Array, " m"]:
        b = self.branch(state).reshape(self.size, -1)
        tau = self.trunk(step[None]).reshape(b.shape)
        return jnp.sum(b * tau, axis=1) / b.shape[1] ** 0.5

    def output_layer(self) -> MLP:
        return self.branch


@final
class Concatenated(AbstractCore):
    """One fully connected network of the state and the step together."""

    net: MLP

    @classmethod
    def create(
        cls, n: int, m: int, sizes: Sizes, dtype: jnp.dtype, key: PRNGKeyArray
    ) -> "Concatenated":
        width, depth, _, activation = sizes
        return cls(MLP(n + 1, m, width, depth, activation, dtype, key=key))

    def __call__(self, state: Float[Array, " n"], step: Float[Array, ""]) -> Float[Array, " m"]:
        return self.net(jnp.append(state, step))

    def output_layer(self) -> MLP:
        return self.net


@final
class Gated(AbstractCore):
    """A network of both inputs, whose hidden layers interpolate between two encodings of them.

    `z ← a * z̃ + b * (1 - z̃)` with the output `z̃` of the layer for `z`. The input thus enters
    every layer multiplicatively.

    ??? cite "Reference"

        S. Wang, Y. Teng and P. Perdikaris, SIAM J. Sci. Comput. 43 (2021).
    """

    encoders: tuple[MLP, MLP]
    hidden: tuple[MLP, ...]
    last: MLP

    @classmethod
    def create(cls, n: int, m: int, sizes: Sizes, dtype: jnp.dtype, key: PRNGKeyArray) -> "Gated":
        width, depth, _, activation = sizes
        # Two encoders, the last layer, and the hidden ones.
        ins = [n + 1, n + 1, width, n + 1, *([width] * (depth - 1))]
        outs = [width, width, m, *([width] * depth)]
        one, two, last, *hidden = (
            MLP(i, o, width, 0, activation, dtype, key=k)
            for i, o, k in zip(ins, outs, jr.split(key, depth + 3), strict=True)
        )
        return cls((one, two), tuple(hidden), last)

    def __call__(self, state: Float[Array, " n"], step: Float[Array, ""]) -> Float[Array, " m"]:
        activation = self.last.activation
        z = jnp.append(state, step)
        a, b = (activation(encoder(z)) for encoder in self.encoders)
        for layer in self.hidden:
            gate = activation(layer(z))
            z = gate * a + (1 - gate) * b
        return self.last(z)

    def output_layer(self) -> MLP:
        return self.last
