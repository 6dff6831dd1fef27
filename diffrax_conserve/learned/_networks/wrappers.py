"""Flow maps that hold another one: in shorter steps, other coordinates, with `args` as states."""

import math
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ..._custom_types import Args, RealScalarLike, Y
from ..._options import check_counts
from ..._tree import unflatten
from .domain import Box
from .flat import flatten
from .flow_map import AbstractFlowMap, args_domain_of, as_flow_map
from .trainable import LayerSchedule, Sampler


class AbstractWrapper(AbstractFlowMap):
    """A flow map of another one, which has what a subclass does not define."""

    flow_map: eqx.AbstractVar[AbstractFlowMap]

    max_step = property(lambda self: self.flow_map.max_step)
    order = property(lambda self: self.flow_map.order)  # pyright: ignore
    domain = property(lambda self: self.flow_map.domain)
    args_domain = property(lambda self: args_domain_of(self.flow_map))
    layer = property(lambda self: None)  # an inner layer is applied inside

    def seen(self, y: Any) -> Any:
        """A state as the inner flow map sees it."""
        return y

    def inside(self, y0: Y, *step: Any) -> Bool[Array, ""]:
        return self.flow_map.inside(self.seen(y0), *step)

    def measure(self, y0: Y, rate: Float[Array, " n"]) -> Float[Array, " m"]:
        seen, rates = jax.jvp(self.seen, (y0,), (unflatten(rate, y0),))
        return self.flow_map.measure(seen, flatten(rates))

    def compared(self, ys: Any, others: Any) -> Float[Array, "points n"]:
        return self.flow_map.compared(*(jax.vmap(self.seen)(y) for y in (ys, others)))

    def weights(self) -> Any:
        return self.flow_map.weights()


@final
class Repeated(AbstractWrapper):
    r"""The flow map of steps that are `count` times as long: $u(h) = \Phi_{h/k} \circ \dots \circ
    \Phi_{h/k}(u_0)$.

    A flow is easier to learn over shorter steps. Train the inner flow map: the repeated one has no
    weights of its own.

    !!! example

        ```python
        import diffrax_conserve as dfc

        half = dfc.load_pretrained("conservative-lorenz-standard")
        flow_map = dfc.learned.Repeated(half, 2)
        assert flow_map.max_step == 2 * half.max_step
        ```
    """

    flow_map: AbstractFlowMap
    count: int = eqx.field(static=True)

    def __init__(self, flow_map: AbstractFlowMap | Callable[..., Any], count: int):
        self.flow_map, self.count = as_flow_map(flow_map), count

    def __check_init__(self):
        check_counts(count=self.count)

    def __call__(self, y0: Y, *step: Any, schedule: LayerSchedule | None = None) -> Y:
        """The state a time `h` after the state `y0`, with `step` = `h`, or `args, h`."""
        return self._scan(lambda y, *each: self.flow_map(y, *each, schedule=schedule), y0, step)

    def inside(self, y0: Y, *step: Any) -> Bool[Array, ""]:

        def once(carry: tuple[Y, Array], *each: Any) -> tuple[Y, Array]:
            y, inside = carry
            return self.flow_map(y, *each), inside & self.flow_map.inside(y, *each)

        return self._scan(once, (y0, True), step)[1]

    def _scan(self, once: Callable[..., Any], start: Any, step: Any) -> Any:
        each = (*step[:-1], jnp.asarray(step[-1]) / self.count)
        start = jtu.tree_map(jnp.asarray, start)
        return lax.scan(lambda y, _: (once(y, *each), None), start, length=self.count)[0]

    def slope(self, y0: Y, *args: Args) -> Y:
        return self.flow_map.slope(y0, *args)

    @property
    def max_step(self) -> RealScalarLike:
        return self.count * self.flow_map.max_step

    def weights(self) -> tuple[()]:
        return ()


Repeated.__init__.__doc__ = r"""**Arguments:**

- `flow_map`: any that [`diffrax_conserve.DeepONetSolver`][] takes.
- `count`: the number of inner steps in one step, a positive integer; otherwise a `ValueError`.
"""


@final
class BoxCox(eqx.Module):
    r"""$z = (y^\lambda - 1) / \lambda$ in every component, for states that are not negative.

    Its inverse is never negative. Small exponents spread magnitudes like a logarithm, but the image
    of zero is finite; 0 is the logarithm. At zero, where its derivative is infinite, that of this
    class is zero, so that states with exact zeros can be learned. Powers of 1/2 are ten times as
    fast as others.
    """

    exponent: float = eqx.field(static=True, default=0.1)

    def __check_init__(self):
        if not 0 <= self.exponent <= 1:
            raise ValueError(f"`exponent` must be from 0 to 1, but is {self.exponent}.")

    def __call__(self, y: Y) -> Y:
        p = self.exponent
        if p == 0:
            return jtu.tree_map(jnp.log, y)
        return jtu.tree_map(lambda x: (_of_positive(lambda x: _root(x, p), x) - 1) / p, y)

    def inverse(self, z: Y) -> Y:
        p = self.exponent
        if p == 0:
            return jtu.tree_map(jnp.exp, z)
        # An integer power is a product of a few factors.
        power = round(1 / p) if 1 / p == round(1 / p) else 1 / p
        return jtu.tree_map(lambda x: _of_positive(lambda x: x**power, p * x + 1), z)


def _of_positive(function: Callable[[Array], Array], x: Array) -> Array:
    """`function(x)` where `x` is positive, elsewhere zero with a derivative of zero: the derivative
    of a root at zero is infinite, which times zero would be NaN."""
    positive = x > 0
    return jnp.where(positive, function(jnp.where(positive, x, 1)), 0)


def _root(x: Array, exponent: float) -> Array:
    """`x` to a positive power, by square roots if the exponent is a power of 1/2."""
    halvings = -math.log2(exponent)
    if halvings != round(halvings):
        return x**exponent
    for _ in range(round(halvings)):
        x = jnp.sqrt(x)
    return x


BoxCox.__init__.__doc__ = "**Arguments:**\n\n- `exponent`: from 0 to 1; otherwise a `ValueError`."


@final
class Transformed(AbstractWrapper):
    r"""A flow map in other coordinates, $u(h) = T^{-1}(\Phi(T(u_0), h))$.

    Concentrations that span ten orders of magnitude are learned as powers or logarithms, so that
    small ones count and none is negative. The loss is measured in these coordinates.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax

        system = dfc.systems.get("pollu")
        states = jax.vmap(system.sample)(jax.random.split(jax.random.key(0), 100))
        boxcox = dfc.learned.BoxCox(0.1)
        inner = dfc.DeepONet(boxcox(states), 2.0, width=8, depth=1, key=jax.random.key(1))
        flow_map = dfc.learned.Transformed(inner, boxcox)
        assert (flow_map(states[0], 1.0) >= 0).all()
        ```
    """

    flow_map: AbstractFlowMap
    transformation: Any

    def __init__(self, flow_map: AbstractFlowMap | Callable[..., Any], transformation: Any):
        self.flow_map, self.transformation = as_flow_map(flow_map), transformation

    def __call__(self, y0: Y, *step: Any, schedule: LayerSchedule | None = None) -> Y:
        """The state a time `h` after the state `y0`, with `step` = `h`, or `args, h`."""
        y0 = jtu.tree_map(jnp.asarray, y0)
        z0 = self.transformation(y0)
        z1 = self.flow_map(z0, *step, schedule=schedule)
        there = self.transformation.inverse(z1)

        def component(y0: Array, y: Array, z0: Array, z1: Array) -> Array:
            # Where the step changes nothing there is no roundoff. The derivatives are those of `y`.
            exact = lax.stop_gradient(y0) + (y - lax.stop_gradient(y))
            return jnp.where(z0 == z1, exact, y).astype(y0.dtype)

        return jtu.tree_map(component, y0, there, z0, z1)

    @property
    def domain(self) -> Any:
        """The states whose coordinates are in the domain of the inner flow map, or `None`."""
        return None if self.flow_map.domain is None else self

    def contains(self, y: Y) -> Bool[Array, ""]:
        return self.flow_map.domain.contains(self.transformation(y))

    def seen(self, y: Y) -> Any:
        return self.transformation(y)


Transformed.__init__.__doc__ = """**Arguments:**

- `flow_map`: the flow map of the coordinates.
- `transformation`: [`diffrax_conserve.learned.BoxCox`][], or your own Module, called as `(y) -> z`,
    with a method `inverse(z)`.
"""


@final
class OfPairs(AbstractWrapper):
    """A family of flow maps as one of the pairs `(y, args)`, with constant `args`, for `fit`."""

    flow_map: AbstractFlowMap

    def __init__(self, flow_map: AbstractFlowMap):
        self.flow_map = flow_map

    def __call__(self, y0: Y, *step: Any, schedule: LayerSchedule | None = None) -> Y:
        y0, args = y0
        return self.flow_map(y0, args, *step, schedule=schedule), args

    def seen(self, y: tuple[Any, Args]) -> Any:
        return y[0]

    def linear_weights(self) -> Any:
        return self.flow_map.linear_weights()

    domain = property(lambda self: None)  # `fit` does not extend the domain of a family
    args_domain = property(lambda self: None)  # they are part of the state


def field_of_pairs(vector_field: Callable[..., Any], t: RealScalarLike, y: Any, args: None) -> Any:
    y, args = y
    return vector_field(t, y, args), jtu.tree_map(jnp.zeros_like, args)


def pair(sample: Sampler, domain: Box, key: PRNGKeyArray) -> tuple[Any, Any]:
    """A random state, and random `args` from their domain."""
    state_key, args_key = jr.split(key)
    return sample(state_key), domain.sample(args_key)
