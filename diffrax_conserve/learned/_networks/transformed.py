"""A flow map in other coordinates: logarithms, powers, units."""

import abc
import math
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float

from ..._custom_types import RealScalarLike, Y
from ..._tree import unflatten
from .flat import flatten, stacked_vectors
from .flow_map import AbstractFlowMap, args_domain_of, as_flow_map
from .trainable import LayerSchedule


class AbstractTransformation(eqx.Module):
    """Other coordinates for a state."""

    @abc.abstractmethod
    def __call__(self, y: Y) -> Y:
        """The coordinates of the state `y`."""

    @abc.abstractmethod
    def inverse(self, z: Y) -> Y:
        """The state of the coordinates `z`."""


@final
class BoxCox(AbstractTransformation):
    r"""$z = (y^\lambda - 1) / \lambda$ in every component, for states that are not negative.

    Its inverse is never negative. Small exponents spread magnitudes like a logarithm, but the image
    of zero is finite. With an exponent of 0 it is the logarithm, for positive states. Exponents
    such as 1/4 or 1/8 are computed by square roots, at a tenth of the cost of other powers.
    """

    exponent: float = eqx.field(static=True, default=0.1)

    def __check_init__(self):
        if not 0 <= self.exponent <= 1:
            raise ValueError(f"`exponent` must be from 0 to 1, but is {self.exponent}.")

    def __call__(self, y: Y) -> Y:
        p = self.exponent
        return jtu.tree_map(lambda x: (_root(x, p) - 1) / p if p else jnp.log(x), y)

    def inverse(self, z: Y) -> Y:
        p = self.exponent
        if p == 0:
            return jtu.tree_map(jnp.exp, z)
        # An integer power is a product of a few factors.
        power = round(1 / p) if 1 / p == round(1 / p) else 1 / p
        return jtu.tree_map(lambda x: jnp.maximum(p * x + 1, 0) ** power, z)


def _root(x: Array, exponent: float) -> Array:
    """`x` to a positive power, by square roots if the exponent is a power of 1/2."""
    halvings = -math.log2(exponent)
    if halvings != round(halvings):
        return x**exponent
    for _ in range(round(halvings)):
        x = jnp.sqrt(x)
    return x


BoxCox.__init__.__doc__ = r"""**Arguments:**

- `exponent`: $\lambda$, from 0 to 1.

**Raises:**

`ValueError` if `exponent` is outside this range.
"""


@final
class Scale(AbstractTransformation):
    """$z = y / s$, with a scale for each component or leaf."""

    scale: Y

    def __call__(self, y: Y) -> Y:
        return jtu.tree_map(lambda x, s: x / s, y, self.scale)

    def inverse(self, z: Y) -> Y:
        return jtu.tree_map(lambda x, s: x * s, z, self.scale)


Scale.__init__.__doc__ = """**Arguments:**

- `scale`: positive numbers, a PyTree like the state.
"""


@final
class Transformed(AbstractFlowMap):
    r"""A flow map in other coordinates, $u(h) = T^{-1}(\Phi(T(u_0), h))$.

    Chemical concentrations that span ten orders of magnitude are learned as powers or logarithms,
    so that small ones count and none is negative. The initial state is exact. Both data losses and
    defects are measured in these coordinates.

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
    transformation: AbstractTransformation

    def __init__(
        self,
        flow_map: AbstractFlowMap | Callable[..., Any],
        transformation: AbstractTransformation,
    ):
        self.flow_map = as_flow_map(flow_map)
        self.transformation = transformation

    def __call__(self, y0: Y, *step: Any, schedule: LayerSchedule | None = None) -> Y:
        """The state a time `h` after the state `y0`, with `step` = `h`, or `args, h`."""
        y0 = jtu.tree_map(jnp.asarray, y0)
        z0 = self.transformation(y0)
        z1 = self.flow_map(z0, *step, schedule=schedule)
        there = self.transformation.inverse(z1)

        def component(y0: Array, y: Array, z0: Array, z1: Array) -> Array:
            # Where the step changes nothing, the roundoff of the transformation and its inverse is
            # removed. The derivatives are those of `y`.
            exact = lax.stop_gradient(y0) + (y - lax.stop_gradient(y))
            return jnp.where(z0 == z1, exact, y).astype(y0.dtype)

        return jtu.tree_map(component, y0, there, z0, z1)

    @property
    def max_step(self) -> RealScalarLike:
        """The longest step."""
        return self.flow_map.max_step

    @property
    def order(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The order of the inner flow map."""
        return self.flow_map.order

    @property
    def domain(self) -> Any:
        """The states whose coordinates are in the domain of the inner flow map, or `None`."""
        inner = self.flow_map.domain
        return None if inner is None else TransformedDomain(inner, self.transformation)

    @property
    def args_domain(self) -> Any:
        """The `args_domain` of the inner flow map, or `None`. `args` are not transformed."""
        return args_domain_of(self.flow_map)

    @property
    def layer(self) -> None:
        """`None`, because the manifold of an inner layer is in other coordinates."""

    def inside(self, y0: Y, *step: Any) -> Bool[Array, ""]:
        return self.flow_map.inside(self.transformation(y0), *step)

    def measure(self, y0: Y, rate: Float[Array, " n"]) -> Float[Array, " n"]:
        return flatten(jax.jvp(self.transformation, (y0,), (unflatten(rate, y0),))[1])

    def compared(self, ys: Any, others: Any) -> Float[Array, "points n"]:
        z, other = (jax.vmap(self.transformation)(y) for y in (ys, others))
        return stacked_vectors(jtu.tree_map(lambda a, b: a - b, z, other))

    def weights(self) -> Any:
        return self.flow_map.weights()

    def linear_weights(self) -> tuple[()]:
        return ()


Transformed.__init__.__doc__ = """**Arguments:**

- `flow_map`: the flow map of the coordinates.
- `transformation`: [`diffrax_conserve.learned.BoxCox`][], [`diffrax_conserve.learned.Scale`][], or
    your own Module.
"""


@final
class TransformedDomain(eqx.Module):
    """The states whose coordinates are in the `inner` domain."""

    inner: Any
    transformation: AbstractTransformation

    def contains(self, y: Y) -> Bool[Array, ""]:
        """Whether the coordinates of `y` are in the inner domain."""
        return self.inner.contains(self.transformation(y))
