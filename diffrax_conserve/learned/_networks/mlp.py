"""Fully connected networks."""

import itertools
from collections.abc import Callable
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

Activation = Callable[[Array], Array]

# By name, so that a file can say which one a network uses.
ACTIVATIONS: dict[str, Activation] = {
    "tanh": jnp.tanh,
    "sin": jnp.sin,
    "gelu": jax.nn.gelu,
    "silu": jax.nn.silu,
    "softplus": jax.nn.softplus,
    "sigmoid": jax.nn.sigmoid,
}


def find_activation(activation: str | Activation) -> Activation:
    """The function itself, or the one that has this name."""
    if callable(activation):
        return activation
    if activation not in ACTIVATIONS:
        raise ValueError(
            f"`activation` is {activation!r}, which is neither a function nor one of the names "
            f"{', '.join(map(repr, ACTIVATIONS))}."
        )
    return ACTIVATIONS[activation]


def activation_name(activation: Activation) -> str | None:
    """The name of a known activation function, else `None`."""
    names = [name for name, known in ACTIVATIONS.items() if known is activation]
    return names[0] if names else None


@final
class MLP(eqx.Module):
    """`depth` hidden layers of `width` units between `in_size` inputs and `out_size` outputs.

    `equinox.nn.MLP` multiplies its weights from the left. On a CPU that makes one evaluation of a
    network of 40 by 4 take 34 instead of 23 us, and a gradient of the loss 1.5 instead of 1.1 ms.
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
        slope: float | None = None,
    ):
        sizes = [in_size, *([width] * depth), out_size]
        keys = jr.split(key, len(sizes) - 1)
        # Glorot and Bengio's initialisation, the usual one for tanh.
        initialise = jax.nn.initializers.glorot_normal()
        shapes = itertools.pairwise(sizes)
        self.weights = tuple(initialise(k, s, dtype) for k, s in zip(keys, shapes, strict=True))
        self.biases = tuple(jnp.zeros(size, dtype) for size in sizes[1:])
        if slope is not None:
            weight, bias = _spread(slope, in_size, width, dtype, keys[0])
            self.weights = (weight, *self.weights[1:])
            self.biases = (bias, *self.biases[1:])
        self.activation = find_activation(activation)

    def __call__(self, x: Float[Array, "*batch in"]) -> Float[Array, "*batch out"]:
        *hidden, last = zip(self.weights, self.biases, strict=True)
        for weight, bias in hidden:
            x = self.activation(x @ weight + bias)
        weight, bias = last
        return x @ weight + bias


def initial_slope(net: MLP) -> float | None:
    """The `slope` that a network was made with, as far as its weights tell."""
    if not any(bool(jnp.any(bias != 0)) for bias in net.biases):
        return None
    return float(jnp.sqrt(jnp.mean(jnp.square(net.weights[0]))))


@eqx.filter_jit
def fresh(net: MLP, slope: float | None, key: PRNGKeyArray) -> MLP:
    """A network of the shape of `net`, with other random weights."""
    first, last = net.weights[0], net.weights[-1]
    (in_size, width), out_size, depth = first.shape, last.shape[1], len(net.weights) - 1
    return MLP(in_size, out_size, width, depth, net.activation, first.dtype, key=key, slope=slope)


def _spread(
    slope: float, in_size: int, width: int, dtype: jnp.dtype, key: PRNGKeyArray
) -> tuple[Float[Array, "in width"], Float[Array, " width"]]:
    """A first layer whose units are centred everywhere in [-1, 1], with random slopes."""
    slope_key, centre_key = jr.split(key)
    weight = slope * jr.normal(slope_key, (in_size, width), dtype)
    centres = jr.uniform(centre_key, (in_size, width), dtype, minval=-1, maxval=1)
    return weight, -jnp.sum(weight * centres, axis=0)


def check_sizes(**sizes: int) -> None:
    """Raises unless every size is a positive integer."""
    for name, size in sizes.items():
        if not isinstance(size, int) or size < 1:
            raise ValueError(f"`{name}` must be a positive integer, but is {size!r}.")
