"""Fully connected networks, and the architectures of a flow map that are made from them."""

import abc
import itertools
from collections.abc import Callable
from typing import NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

Activation = Callable[[Array], Array]
_HIGHEST = jax.lax.Precision.HIGHEST

# Names, by which a file refers to an activation function.
ACTIVATIONS: dict[str, Activation] = {
    "tanh": jnp.tanh,
    "sin": jnp.sin,
    "gelu": jax.nn.gelu,
    "silu": jax.nn.silu,
    "softplus": jax.nn.softplus,
    "sigmoid": jax.nn.sigmoid,
}


def find_activation(activation: str | Activation) -> Activation:
    if callable(activation):
        return activation
    if activation not in ACTIVATIONS:
        raise ValueError(
            f"`activation` is {activation!r}, which is neither a function nor one of the names "
            f"{', '.join(map(repr, ACTIVATIONS))}."
        )
    return ACTIVATIONS[activation]


@final
class MLP(eqx.Module):
    """`depth` hidden layers of `width` units.

    By hand, because with `equinox.nn.MLP` the gradient of the loss takes 6 to 26 % longer (width
    40, depth 4, 500 points), and products in float32 on a GPU have three digits.
    """

    weights: tuple[Float[Array, "..."], ...]
    biases: tuple[Float[Array, "..."], ...]
    activation: Activation = eqx.field(static=True)

    def __init__(
        self,
        in_size: int,
        out_size: int,
        width: int,
        depth: int,
        activation: str | Activation,
        dtype: jnp.dtype,
        *,
        key: PRNGKeyArray,
        slope: float | Float[Array, ""] | None = None,
    ):
        sizes = [in_size, *([width] * depth), out_size]
        keys = jr.split(key, len(sizes) - 1)
        # Glorot initialisation, the usual choice for tanh.
        initialise = jax.nn.initializers.glorot_normal()
        shapes = itertools.pairwise(sizes)
        self.weights = tuple(initialise(k, s, dtype) for k, s in zip(keys, shapes, strict=True))
        self.biases = tuple(jnp.zeros(size, dtype) for size in sizes[1:])
        if slope is not None:
            # The units have uniformly distributed centres in [-1, 1] and random slopes.
            slope_key, centre_key = jr.split(keys[0])
            weight = slope * jr.normal(slope_key, (in_size, width), dtype)
            centres = jr.uniform(centre_key, (in_size, width), dtype, minval=-1, maxval=1)
            self.weights = (weight, *self.weights[1:])
            self.biases = (-jnp.sum(weight * centres, axis=0), *self.biases[1:])
        self.activation = find_activation(activation)

    def __call__(self, x: Float[Array, "*batch in"]) -> Float[Array, "*batch out"]:
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            # By default GPUs round the factors of products in float32 to three digits.
            x = jnp.matmul(self.activation(x) if i else x, weight, precision=_HIGHEST) + bias
        return x


def initial_slope(net: MLP) -> Float[Array, ""] | None:
    """The `slope` with which a network was initialised, estimated from its weights."""
    if not any(bool(jnp.any(bias != 0)) for bias in net.biases):
        return None
    return jnp.sqrt(jnp.mean(jnp.square(net.weights[0])))


@eqx.filter_jit
def fresh(
    net: MLP, slope: Float[Array, ""] | None, size: Float[Array, ""], key: PRNGKeyArray
) -> MLP:
    """A network of the shape of `net`, with other random weights and outputs of about `size`."""
    first, last = net.weights[0], net.weights[-1]
    (in_size, width), out_size, depth = first.shape, last.shape[1], len(net.weights) - 1
    new = MLP(in_size, out_size, width, depth, net.activation, first.dtype, key=key, slope=slope)
    return eqx.tree_at(lambda net: net.weights[-1], new, size * new.weights[-1])


# ---- Architectures ----


class Sizes(NamedTuple):
    width: int
    depth: int
    latent: int
    activation: Activation


class AbstractCore(eqx.Module):
    """The network of a [`diffrax_conserve.DeepONet`][], at first with random weights."""

    @abc.abstractmethod
    def __init__(self, n: int, m: int, sizes: Sizes, dtype: jnp.dtype, key: PRNGKeyArray): ...

    @abc.abstractmethod
    def __call__(self, state: Float[Array, " n"], step: Float[Array, ""]) -> Float[Array, " m"]:
        """`m` numbers, from the normalised initial state, `n` numbers, and the normalised step."""

    @abc.abstractmethod
    def output_layer(self) -> MLP:
        """The network in whose last layer the output is linear."""


@final
class Product(AbstractCore):
    r"""`Σ_l b_jl(u) τ_jl(h) / √L`: a branch network times a trunk network, as in the literature."""

    branch: MLP
    trunk: MLP
    size: int = eqx.field(static=True)

    def __init__(self, n: int, m: int, sizes: Sizes, dtype: jnp.dtype, key: PRNGKeyArray):
        width, depth, latent, activation = sizes
        self.branch, self.trunk = (
            MLP(k, m * latent, width, depth, activation, dtype, key=one)
            for k, one in zip((n, 1), jr.split(key), strict=True)
        )
        self.size = m

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

    def __init__(self, n: int, m: int, sizes: Sizes, dtype: jnp.dtype, key: PRNGKeyArray):
        width, depth, _, activation = sizes
        self.net = MLP(n + 1, m, width, depth, activation, dtype, key=key)

    def __call__(self, state: Float[Array, " n"], step: Float[Array, ""]) -> Float[Array, " m"]:
        return self.net(jnp.append(state, step))

    def output_layer(self) -> MLP:
        return self.net


@final
class Gated(AbstractCore):
    """A network of both inputs, whose hidden layers interpolate between two encodings of them."""

    encoders: tuple[MLP, MLP]
    hidden: tuple[MLP, ...]
    last: MLP

    def __init__(self, n: int, m: int, sizes: Sizes, dtype: jnp.dtype, key: PRNGKeyArray):
        width, depth, _, activation = sizes
        # Two encoders, the last layer, and the hidden ones.
        ins = [n + 1, n + 1, width, n + 1, *([width] * (depth - 1))]
        outs = [width, width, m, *([width] * depth)]
        one, two, self.last, *hidden = (
            MLP(i, o, width, 0, activation, dtype, key=k)
            for i, o, k in zip(ins, outs, jr.split(key, depth + 3), strict=True)
        )
        self.encoders, self.hidden = (one, two), tuple(hidden)

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


# The words by which a flow map chooses its network.
CORES: dict[str, type[AbstractCore]] = {
    "gated": Gated,
    "concatenated": Concatenated,
    "product": Product,
}
