"""Flow maps: the interface that solvers, sweeps, policies and `fit` use."""

import abc
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from ..._custom_types import Args, RealScalarLike, Y
from ..._tree import tree_shapes, tree_sub
from .domain import Box
from .flat import stacked_vectors, working_dtype
from .trainable import AbstractTrainable, LayerSchedule, Points, Sampler, Times, checked_part


class AbstractFlowMap(AbstractTrainable):
    r"""A map from an initial state and a step to the state after the step, $(u_0, h) \mapsto u(h)$.

    Solvers and [`diffrax_conserve.fit`][] also take a Module `(y0, h) -> y` with an attribute
    `max_step`, and optionally `order`, `domain` and `args_domain`.

    **Attributes:**

    - `max_step`: the longest step.
    - `order`: the error of one step is $O(h^{q+1})$ with $q$ = `order`, for all weights.
    - `domain`: the states that the flow map has learned, with a method `contains(y)`; or `None`.
    - `layer`: the conservative layer of the network, or `None`.
    - `args_domain`: for a family of equations, called as `(y0, args, h)`, the `args` that it has
        learned, a [`diffrax_conserve.learned.Box`][]. Otherwise `None`, or missing.
    """

    # `Any`, so that a subclass may use a more precise type or a property.
    max_step: eqx.AbstractVar[Any]
    order: eqx.AbstractVar[int]
    domain: eqx.AbstractVar[Any]

    @abc.abstractmethod
    def __call__(self, y0: Y, *step: Any, schedule: LayerSchedule | None = None) -> Y:
        """The state a time `h` after the state `y0`, with `step` = `h`, or `args, h`. `fit` passes
        the `schedule` of the conservative layer."""

    def measure(self, y0: Y, rate: Float[Array, " n"]) -> Float[Array, " m"]:
        """A rate of change of the solution through `y0`, in the units of the loss."""
        del y0
        return rate

    def linear_weights(self) -> tuple[Any, ...]:
        return ()

    def inside(self, y0: Y, *step: Any) -> Bool[Array, ""]:
        """Whether the step from `y0` is within the domain. Here: whether it starts there."""
        del step
        return jnp.asarray(True if self.domain is None else self.domain.contains(y0))

    def slope(self, y0: Y, *args: Args) -> Y:
        """The time derivative for `h = 0`."""
        zero = jnp.zeros((), working_dtype(y0))
        return jax.jvp(lambda h: self(y0, *args, h), (zero,), (jnp.ones_like(zero),))[1]

    def compared(self, ys: Any, others: Any) -> Float[Array, "points n"]:
        """The differences of states, in the units in which states are compared with data."""
        return stacked_vectors(tree_sub(ys, others))

    def draw(self, times: Times, sample: Sampler | None, count: int, key: PRNGKeyArray) -> Points:
        times_key, states_key = jr.split(key)
        assert sample is not None
        y0s = jax.vmap(sample)(jr.split(states_key, count))
        return Points(times(times_key, count, 0.0, float(self.max_step)), y0s)

    def states(
        self, points: Points, ts: Float[Array, " points"], schedule: LayerSchedule | None
    ) -> PyTree[Array]:
        # The schedule is not batched, so that iterations beyond it are not computed.
        return jax.vmap(lambda y0, t: self(y0, t, schedule=schedule))(points.y0s, ts)

    def starts(self, points: Points) -> Points:
        return Points(jnp.zeros_like(points.ts), points.y0s)

    def measured(self, points: Points, rates: Y) -> Float[Array, "points n"]:
        return jax.vmap(self.measure)(points.y0s, stacked_vectors(rates))


@final
class FlowMap(AbstractFlowMap):
    """A function `(y0, h) -> y` with an attribute `max_step`, and perhaps others of a flow map."""

    function: Callable[..., Any]
    max_step: RealScalarLike
    order: int = eqx.field(static=True)
    domain: Any
    args_domain: Box | None

    def __init__(self, function: Any):
        self.function, self.max_step = function, function.max_step
        self.order, self.domain = getattr(function, "order", 0), getattr(function, "domain", None)
        self.args_domain = checked_part("args_domain", args_domain_of(function), Box)
        if self.domain is not None and not callable(getattr(self.domain, "contains", None)):
            raise TypeError(
                f"The `domain` of the flow map is {self.domain!r}, which has no method "
                "`contains(y)`, as `diffrax_conserve.learned.Box` has."
            )

    def __call__(self, y0: Y, *step: Any, schedule: LayerSchedule | None = None) -> Y:
        del schedule
        return self.function(y0, *step)

    @property
    def layer(self) -> None:
        """A function has no separate conservative layer."""

    def weights(self) -> Any:
        return self.function


def as_flow_map(model: AbstractFlowMap | Callable[..., Any]) -> AbstractFlowMap:
    """`model` as a flow map, also for a function with an attribute `max_step`."""
    if isinstance(model, AbstractFlowMap):
        return model
    if not (callable(model) and hasattr(model, "max_step")):
        raise TypeError(
            f"`flow_map` is of type `{type(model).__name__}`, which is no flow map. Pass a "
            "`DeepONet`, or a Module that is called as `(y0, h) -> y` and has an attribute "
            "`max_step`, the longest step."
        )
    return FlowMap(model)


def args_domain_of(model: Any) -> Box | None:
    """The `args` that a flow map takes as inputs, or `None`."""
    return getattr(model, "args_domain", None)


def known_args(flow_map: AbstractFlowMap, args: Args) -> tuple[Args, ...]:
    """What the flow map is called with between the state and the step: `(args,)`, or nothing."""
    domain = args_domain_of(flow_map)
    return () if domain is None else (checked_args(domain, args),)


def checked_args(domain: Box, args: Args) -> Args:
    """`args` as arrays; raises unless they have the structure and shapes of those of the domain."""
    expected, got = (tree_shapes(x) for x in (domain.lower, args))
    if got != expected:
        raise ValueError(
            f"This flow map takes `args` of the structure {expected}, but was given {got}."
        )
    return jtu.tree_map(lambda x, a: jnp.asarray(x, a.dtype), args, domain.lower)
