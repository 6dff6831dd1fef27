"""A deep operator network: the flow map of an autonomous system, for steps up to a given length."""

import dataclasses
from typing import Any, Literal, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PRNGKeyArray

from ..._custom_types import Args, RealScalarLike, Y
from ..._options import check_counts
from ..._tree import unflatten
from .cores import CORES, AbstractCore, Activation, Sizes, find_activation
from .domain import Box, FramedBox, MakeFrame, check_frame, frame_at
from .flat import (
    as_states,
    check_key,
    check_one,
    check_scalars,
    check_within,
    flatten,
    stacked_vectors,
    working_dtype,
)
from .flow_map import AbstractFlowMap, checked_args
from .layer import ConservativeLayer
from .taylor import Taylor
from .trainable import LayerSchedule, checked_part


@final
class DeepONet(AbstractFlowMap):
    r"""A network for the flow map of an autonomous system, $(u_0, h) \mapsto u(h)$.

    $$u(h) = u_0 + \frac{h}{\Delta} S N(u_0, h)$$

    with steps $h$ up to $\Delta$ = `max_step`; $u(0) = u_0$ for all weights. With `taylor`, which
    [`diffrax_conserve.fit`][] adds by default, it is $u(h) = T_q(u_0, h) + (h/\Delta)^{q+1} S N$.
    With a `layer` the output is projected to the manifold of the conserved values at $u_0$. With a
    `frame` it commutes with the symmetries of the equations.

    Train it by [`diffrax_conserve.fit`][], and step it by [`diffrax_conserve.DeepONetSolver`][].

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax

        system = dfc.systems.get("conservative-lorenz")
        states = jax.vmap(system.sample)(jax.random.split(jax.random.key(0), 100))
        deeponet = dfc.DeepONet(states, 0.25, key=jax.random.key(1))
        deeponet(system.y0, 0.1)
        ```

    ??? cite "Reference"

        L. Lu, P. Jin, G. Pang, Z. Zhang and G. E. Karniadakis, Nature Machine Intelligence 3
        (2021); S. Wang and P. Perdikaris, J. Comput. Phys. 475 (2023) for the flow map; S. Wang, Y.
        Teng and P. Perdikaris, SIAM J. Sci. Comput. 43 (2021) for the gates.
    """

    core: AbstractCore
    layer: ConservativeLayer | None
    max_step: float = eqx.field(static=True)
    shift: Float[Array, " k"]
    scale: Float[Array, " k"]
    taylor: Taylor | None
    domain: Box | FramedBox
    args_domain: Box | None

    def __init__(
        self,
        states: Y,
        max_step: RealScalarLike,
        *,
        key: PRNGKeyArray,
        width: int = 20,
        depth: int = 3,
        latent: int = 20,
        core: Literal["gated", "concatenated", "product"] = "gated",
        activation: str | Activation = "tanh",
        taylor: Taylor | None = None,
        frame: MakeFrame | None = None,
        layer: ConservativeLayer | None = None,
        args_domain: Box | None = None,
    ):
        check_counts(width=width, depth=depth, latent=latent)
        check_key(key)
        checked_part("layer", layer, ConservativeLayer)
        checked_part("taylor", taylor, Taylor)
        checked_part("args_domain", args_domain, Box)
        if layer is not None and (frame is not None or args_domain is not None):
            raise ValueError(
                "A flow map with a `frame` or an `args_domain` cannot have a `layer`. Wrap its "
                "solver in `diffrax_conserve.ManifoldProjection` instead."
            )
        if args_domain is not None and taylor is not None and taylor.args is not None:
            raise ValueError(
                "`taylor` has `args` of its own, but this flow map takes them as inputs: write "
                "`Taylor(vector_field, order)`."
            )
        if core not in CORES:
            raise ValueError(
                f"`core` is {core!r}, but it must be one of {', '.join(map(repr, CORES))}."
            )
        check_scalars(max_step=max_step, above=0.0, optional=False)
        if max_step == jnp.inf:
            raise ValueError("`max_step` is infinite: give the longest step that is learned.")
        states = as_states(states)
        dtype = working_dtype(states)
        # What the network sees of all states, and the number of functions to be learned.
        seen = stacked_vectors(jtu.tree_map(lambda x: x.astype(dtype), states))
        self.domain, m = Box.around(states), seen.shape[1]
        if frame is not None:
            check_frame(frame, jtu.tree_map(lambda x: x[0], states))
            frames = jax.vmap(lambda y: frame_at(frame, y))(states)
            self.domain = FramedBox.around(frame, states)
            seen, m = frames.inputs, frames.basis.shape[-1]
        sizes = Sizes(width, depth, latent, find_activation(activation))
        known = 0 if args_domain is None else flatten(args_domain.lower).size
        self.core = CORES[core](seen.shape[1] + known, m, sizes, dtype, key)
        self.args_domain, self.layer, self.taylor = args_domain, layer, taylor
        self.max_step, deviation = float(max_step), jnp.std(seen, axis=0)
        self.shift, self.scale = jnp.mean(seen, axis=0), jnp.where(deviation > 0, deviation, 1)

    def __call__(
        self, y0: Y, *step: Any, args: Args = None, schedule: LayerSchedule | None = None
    ) -> Y:
        """The state a time `h` after the state `y0`, with `step` = `h`. A family is called as
        `(y0, args, h)`, or `(y0, h, args=args)`."""
        step = step if args is None else (args, *step)
        expected = "(y0, h)" if self.args_domain is None else "(y0, args, h)"
        if len(step) != expected.count(","):
            raise TypeError(f"This `DeepONet` is called as `{expected}`.")
        check_one("h", step[-1], "lambda h: deeponet(y0, h)")
        check_within("h", step[-1], 0.0, self.max_step)
        candidate = self.candidate(y0, *step)
        if self.layer is None:
            return candidate
        start = 0.0, jtu.tree_map(jnp.asarray, y0)
        return self.layer(candidate, step[-1], start, self.scale, schedule)

    def candidate(self, y0: Y, *step: Any) -> Y:
        *args, h = step
        start, size = flatten(y0).astype(self.scale.dtype), flatten(self.state).size
        if start.size != size:
            raise ValueError(
                f"This `DeepONet` is for states of {size} numbers, not {start.size}. Pass "
                "states of its own system, also as `sample`, `data` or `y0`. Apply it to several "
                "by `jax.vmap(deeponet, (0, None))(states, h)`."
            )
        h = jnp.asarray(h).astype(start.dtype)
        known = self._known(args)
        if isinstance(self.domain, Box):
            fraction = h / self.max_step
            learned = self.scale * self._network(start, known, fraction)
        else:
            frame = self.domain.frame(y0)
            own = (h * frame.clock).astype(start.dtype)
            fraction = own / (self.max_step * self.domain.fastest).astype(start.dtype)
            inputs, basis = (x.astype(start.dtype) for x in (frame.inputs, frame.basis))
            part = self._network(inputs, known, fraction)
            learned = jnp.matmul(basis, part, precision="highest")
        if self.taylor is not None:
            taylor = dataclasses.replace(self.taylor, args=args[0]) if args else self.taylor
            start = flatten(taylor(y0, h)).astype(start.dtype)
        return unflatten(start + fraction ** (self.order + 1) * learned, y0)

    def _known(self, args: list[Args]) -> Float[Array, " p"]:
        """The `args` as inputs of the network."""
        if self.args_domain is None:
            return jnp.zeros(0, self.scale.dtype)
        found = self.args_domain.centred(checked_args(self.args_domain, args[0]))
        return flatten(found).astype(self.scale.dtype)

    def _network(self, inputs: Array, known: Array, fraction: Array) -> Array:
        inputs = jnp.concatenate([(inputs - self.shift) / self.scale, known])
        time = 2 * fraction - 1
        output = self.core(inputs.astype(self.precision), time.astype(self.precision))
        return output.astype(inputs.dtype)

    @property
    def order(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return 0 if self.taylor is None else self.taylor.order

    @property
    def precision(self) -> jnp.dtype:
        """The dtype in which the network is evaluated."""
        return self.core.output_layer().biases[-1].dtype

    @property
    def state(self) -> Y:
        """A state such as the network expects."""
        return self.domain.lower if isinstance(self.domain, Box) else self.domain.example

    def measure(self, y0: Y, rate: Float[Array, " n"]) -> Float[Array, " m"]:
        if isinstance(self.domain, Box):
            return rate / self.scale
        return self.domain.frame(y0).measure(rate)

    def weights(self) -> AbstractCore:
        return self.core

    def linear_weights(self) -> tuple[Any, ...]:
        net = self.core.output_layer()
        return net.weights[-1], net.biases[-1]


DeepONet.__init__.__doc__ = r"""**Arguments:**

- `states`: initial states, stacked along a leading axis: any PyTree of real arrays. One array of
    two numbers is two states of one number; for one state `y` write `y[None]`. $N$ gets
    $(u_0 - m)/S$, with their mean $m$ and standard deviation $S$, the unit of the loss, and $h$
    scaled to $[-1, 1]$. The box around them is the `domain` of the flow map.
- `max_step`: the longest step $\Delta$.
- `key`: a random key, for the initial weights.
- `width`, `depth`: the number of units in each hidden layer, and of hidden layers.
- `core`: the kind of network. `"gated"`: the state and the step go into every hidden layer, which
    interpolates between two encodings of them, $z \leftarrow a \tilde z + b (1 - \tilde z)$ with
    the output $\tilde z$ of the layer for $z$. `"concatenated"`: both go only into the first
    layer, which is less accurate and faster. `"product"`: $\sum_l b_{jl}(u_0) \tau_{jl}(h) /
    \sqrt L$, a branch network times a trunk network, as in the literature, and least accurate at
    the same size.
- `latent`: only of a `"product"`, the number $L$ of products in each component.
- `activation`: `"tanh"`, `"sin"`, `"gelu"`, `"silu"`, `"softplus"`, `"sigmoid"`, or a function
    (which [`diffrax_conserve.save`][] cannot write).
- `taylor`: a [`diffrax_conserve.learned.Taylor`][].
- `frame`: a function from a state to its [`diffrax_conserve.learned.Frame`][], whose inputs $N$
    then gets. The domain is all states with inputs in the box around those of `states` and a clock
    that is not faster than theirs.
- `layer`: a [`diffrax_conserve.learned.ConservativeLayer`][].
- `args_domain`: a [`diffrax_conserve.learned.Box`][] of the `args` of the vector field, which the
    network and its polynomial then take as inputs.

**Raises:**

`ValueError` or `TypeError` if a size, the step, the states, the frame or `args_domain` is invalid,
or if a layer is combined with a frame or an `args_domain`.
"""
