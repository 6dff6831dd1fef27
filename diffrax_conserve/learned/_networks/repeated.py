"""A flow map whose steps consist of several shorter ones."""

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float

from ..._custom_types import Args, RealScalarLike, Y
from .flow_map import AbstractFlowMap, args_domain_of, as_flow_map
from .mlp import check_sizes
from .trainable import LayerSchedule


@final
class Repeated(AbstractFlowMap):
    r"""The flow map of steps that are `count` times as long: $u(h) = \Phi_{h/k} \circ \dots \circ
    \Phi_{h/k}(u_0)$.

    A flow is easier to learn over shorter steps. If the longest step is prescribed, learn a
    fraction of it and repeat that. Train the inner flow map: the repeated one has no weights of its
    own. It costs as much as `count` steps of the inner one.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax

        system = dfc.systems.get("conservative-lorenz")
        states = jax.vmap(system.sample)(jax.random.split(jax.random.key(0), 100))
        half = dfc.DeepONet(states, 0.125, key=jax.random.key(1))
        flow_map = dfc.learned.Repeated(half, 2)
        assert flow_map.max_step == 0.25
        ```
    """

    flow_map: AbstractFlowMap
    count: int = eqx.field(static=True)

    # Written out for the same reason as in `FlowMap`.
    def __init__(self, flow_map: AbstractFlowMap | Callable[..., Any], count: int):
        self.flow_map = as_flow_map(flow_map)
        self.count = count

    def __check_init__(self):
        check_sizes(count=self.count)

    def __call__(self, y0: Y, *step: Any, schedule: LayerSchedule | None = None) -> Y:
        """The state a time `h` after the state `y0`, with `step` = `h`, or `args, h`."""
        *args, h = step
        y0 = jtu.tree_map(jnp.asarray, y0)
        each = jnp.asarray(h) / self.count

        def once(y: Y, _: None) -> tuple[Y, None]:
            return self.flow_map(y, *args, each, schedule=schedule), None

        return lax.scan(once, y0, length=self.count)[0]

    def inside(self, y0: Y, *step: Any) -> Bool[Array, ""]:
        """Whether every inner step is within the domain."""
        *args, h = step
        each = jnp.asarray(h) / self.count

        def once(carry: tuple[Y, Array], _: None) -> tuple[tuple[Y, Array], None]:
            y, inside = carry
            inside = inside & self.flow_map.inside(y, *args, each)
            return (self.flow_map(y, *args, each), inside), None

        start = jtu.tree_map(jnp.asarray, y0), jnp.asarray(True)
        return lax.scan(once, start, length=self.count)[0][1]

    def slope(self, y0: Y, *args: Args) -> Y:
        return self.flow_map.slope(y0, *args)

    @property
    def max_step(self) -> RealScalarLike:
        """The longest step."""
        return self.count * self.flow_map.max_step

    @property
    def order(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The order of the inner flow map."""
        return self.flow_map.order

    @property
    def domain(self) -> Any:
        """The domain of the inner flow map, or `None`."""
        return self.flow_map.domain

    @property
    def args_domain(self) -> Any:
        """The `args_domain` of the inner flow map, or `None`."""
        return args_domain_of(self.flow_map)

    @property
    def layer(self) -> None:
        """`None`, because the inner flow map applies its own layer in each step."""

    def measure(self, y0: Y, rate: Float[Array, " n"]) -> Float[Array, " m"]:
        return self.flow_map.measure(y0, rate)

    def weights(self) -> tuple[()]:
        return ()

    def linear_weights(self) -> tuple[()]:
        return ()


Repeated.__init__.__doc__ = r"""**Arguments:**

- `flow_map`: a [`diffrax_conserve.DeepONet`][], or any Module that
    [`diffrax_conserve.DeepONetSolver`][] takes.
- `count`: the number of inner steps in one step.

**Raises:**

`ValueError` or `TypeError` if an argument is not of this kind.
"""
