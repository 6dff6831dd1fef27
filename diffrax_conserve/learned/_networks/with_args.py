"""Flow maps of a family of equations: one member of the family, and the family as a single flow
map."""

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ..._custom_types import Args, RealScalarLike, Y
from .domain import Box
from .flat import flatten
from .flow_map import AbstractFlowMap, args_domain_of, checked_args
from .trainable import LayerSchedule, Sampler


def at_args(flow_map: AbstractFlowMap, args: Args) -> AbstractFlowMap:
    """The flow map `(y0, h) -> y` for these `args`; `flow_map` itself if it takes no `args`."""
    domain = args_domain_of(flow_map)
    return flow_map if domain is None else AtArgs(flow_map, checked_args(domain, args))


class _AbstractOfFamily(AbstractFlowMap):
    """A flow map that takes its properties from a family."""

    flow_map: eqx.AbstractVar[AbstractFlowMap]

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


@final
class AtArgs(_AbstractOfFamily):
    """One member of a family of flow maps."""

    flow_map: AbstractFlowMap
    args: Args

    # Written out for the same reason as in `FlowMap`.
    def __init__(self, flow_map: AbstractFlowMap, args: Args):
        self.flow_map = flow_map
        self.args = args

    def __call__(self, y0: Y, *step: Any, schedule: LayerSchedule | None = None) -> Y:
        """The state a time `h` after the state `y0`, with `step` = `h`."""
        return self.flow_map(y0, self.args, *step, schedule=schedule)

    def slope(self, y0: Y, *args: Args) -> Y:
        return self.flow_map.slope(y0, self.args, *args)

    def inside(self, y0: Y, *step: Any) -> Bool[Array, ""]:
        known = args_domain_of(self.flow_map)
        assert known is not None
        return known.contains(self.args) & self.flow_map.inside(y0, self.args, *step)

    @property
    def domain(self) -> "ArgsDomain":
        """The domain of the family, which contains no state if `args` are outside their domain."""
        known = args_domain_of(self.flow_map)
        assert known is not None
        return ArgsDomain(self.flow_map.domain, known, self.args)

    def measure(self, y0: Y, rate: Float[Array, " n"]) -> Float[Array, " m"]:
        return self.flow_map.measure(y0, rate)


@final
class ArgsDomain(eqx.Module):
    """The states of a domain if `args` are in their domain, otherwise no states."""

    states: Any  # a domain, or None
    known: Box
    args: Args

    def contains(self, y: Y) -> Bool[Array, ""]:
        """Whether `args` and `y` are in their domains."""
        inside = self.known.contains(self.args)
        return inside if self.states is None else inside & self.states.contains(y)


@final
class OfPairs(_AbstractOfFamily):
    """A family of flow maps as a single flow map of the pairs `(y, args)`, with constant `args`.

    For `fit`, `args` are then a part of the state.
    """

    flow_map: AbstractFlowMap

    def __init__(self, flow_map: AbstractFlowMap):
        self.flow_map = flow_map

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
