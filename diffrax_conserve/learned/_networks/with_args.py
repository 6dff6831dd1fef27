"""A flow map of a family of equations, as a single flow map."""

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, Float, PRNGKeyArray

from ..._custom_types import RealScalarLike, Y
from .domain import Box
from .flat import flatten
from .flow_map import AbstractFlowMap
from .trainable import LayerSchedule, Sampler


@final
class OfPairs(AbstractFlowMap):
    """A family of flow maps as a single flow map of the pairs `(y, args)`, with constant `args`.

    For `fit`, `args` are then a part of the state.
    """

    flow_map: AbstractFlowMap

    # Written out for the same reason as in `FlowMap`.
    def __init__(self, flow_map: AbstractFlowMap):
        self.flow_map = flow_map

    @property
    def max_step(self) -> RealScalarLike:
        """The longest step."""
        return self.flow_map.max_step

    @property
    def order(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The order of the family."""
        return self.flow_map.order

    @property
    def layer(self) -> Any:
        """The layer of the family."""
        return self.flow_map.layer

    def weights(self) -> Any:
        return self.flow_map.weights()

    def linear_weights(self) -> Any:
        return self.flow_map.linear_weights()

    def __call__(self, y0: Y, *step: Any, schedule: LayerSchedule | None = None) -> Y:
        """The pair a time `h` after the pair `y0`, with `step` = `h`."""
        y0, args = y0
        return self.flow_map(y0, args, *step, schedule=schedule), args

    @property
    def domain(self) -> None:
        """`None`, because `fit` does not extend the domain of a family."""

    def measure(self, y0: Y, rate: Float[Array, " n"]) -> Float[Array, " m"]:
        # The last part is the rate of `args`, which is zero.
        return self.flow_map.measure(y0[0], rate[: flatten(y0[0]).size])

    def compared(self, ys: Any, others: Any) -> Float[Array, "points n"]:
        return self.flow_map.compared(ys[0], others[0])


@final
class PairField(eqx.Module):
    """The vector field of the pairs."""

    vector_field: Callable[..., Any]

    def __call__(self, t: RealScalarLike, y: Any, args: None) -> Any:
        del args
        y, args = y
        return self.vector_field(t, y, args), jtu.tree_map(jnp.zeros_like, args)


@final
class PairSampler(eqx.Module):
    """Draws a state, and `args` from their domain."""

    sample: Sampler
    domain: Box

    def __call__(self, key: PRNGKeyArray) -> tuple[Any, Any]:
        state_key, args_key = jr.split(key)
        return self.sample(state_key), self.domain.sample(args_key)
