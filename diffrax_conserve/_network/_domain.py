"""The states that a flow map was trained for."""

from collections.abc import Callable
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Bool, PyTree, Real, Shaped

from .._custom_types import Y
from ._flat import as_state
from ._frame import MakeFrame


@final
class Box(eqx.Module):
    r"""The states between two corners, $l \le y \le u$ in every component.

    A flow map that has it as an attribute `domain` can be told apart, by the option `outside` of
    [`diffrax_conserve.DeepONetSolver`][], from one that is asked for more than it has learned. Any
    Module with a method `contains(y)`, which returns a boolean scalar, can take its place.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax

        system = dfc.systems.get("conservative-lorenz")
        states = jax.vmap(system.sample)(jax.random.split(jax.random.key(0), 100))
        box = dfc.Box.around(states)
        assert box.contains(states[0])
        assert not box.contains(100 * states[0])
        ```
    """

    lower: PyTree[Real[Array, "..."]]
    upper: PyTree[Real[Array, "..."]]

    def __init__(
        self, lower: PyTree[Shaped[ArrayLike, "..."]], upper: PyTree[Shaped[ArrayLike, "..."]]
    ):
        self.lower = as_state(lower)
        self.upper = as_state(upper)

    def __check_init__(self):
        lower, upper = jtu.tree_structure(self.lower), jtu.tree_structure(self.upper)
        shapes = [[jnp.shape(x) for x in jtu.tree_leaves(t)] for t in (self.lower, self.upper)]
        if lower != upper or shapes[0] != shapes[1]:
            raise ValueError(
                f"`lower` has the structure {lower} with shapes {shapes[0]}, but `upper` has "
                f"{upper} with {shapes[1]}. Both must be those of a state."
            )

    @classmethod
    def around(cls, states: Y) -> "Box":
        """The smallest box around `states`, which are stacked along a leading axis."""
        states = as_state(states)
        if any(jnp.ndim(x) == 0 or jnp.shape(x)[0] == 0 for x in jtu.tree_leaves(states)):
            raise ValueError(
                "`states` must be at least one state, stacked along a leading axis. For a single "
                "state write `jax.tree.map(lambda x: x[None], y0)`."
            )
        lower = jtu.tree_map(lambda x: jnp.min(x, axis=0), states)
        return cls(lower, jtu.tree_map(lambda x: jnp.max(x, axis=0), states))

    def extended(self, states: Y) -> "Box":
        """The smallest box around this one and `states`, which are stacked along a leading axis."""
        other = Box.around(states)

        def joined(choose: Callable[..., Array], a: Y, b: Y) -> Y:
            return jtu.tree_map(lambda x, y: choose(x, y.astype(x.dtype)), a, b)

        lower = joined(jnp.minimum, self.lower, other.lower)
        return Box(lower, joined(jnp.maximum, self.upper, other.upper))

    def contains(self, y: Y) -> Bool[Array, ""]:
        """Whether `y` is in the box, its boundary included. NaN is not."""
        if jtu.tree_structure(y) != jtu.tree_structure(self.lower):
            raise ValueError(
                f"The box is for states of the structure {jtu.tree_structure(self.lower)}, but was "
                f"given one of {jtu.tree_structure(y)}."
            )
        inside = jtu.tree_map(
            lambda x, a, b: jnp.all((a <= x) & (x <= b)), y, self.lower, self.upper
        )
        return jnp.all(jnp.stack(jtu.tree_leaves(inside)))


Box.__init__.__doc__ = """**Arguments:**

- `lower`, `upper`: the corners, two PyTrees like a state.

**Raises:**

`ValueError` or `TypeError` if they are not alike, or not real.
"""


@final
class FramedBox(eqx.Module):
    """The states that look, from their frames, like those that a flow map was made with.

    Their inputs are in a box, and their clocks are not faster: of slower ones only the beginning of
    a step is seen.
    """

    frame: MakeFrame
    box: Box  # of pairs of the inputs and the clock
    example: Y  # one of the states, for their structure

    @classmethod
    def around(cls, frame: MakeFrame, states: Y) -> "FramedBox":
        frames = jax.vmap(frame)(states)
        clocks = jnp.broadcast_to(frames.clock, frames.inputs.shape[:1])
        box = Box.around((frames.inputs, clocks))
        # The same state, moved by a symmetry, looks the same only up to roundoff.
        slack = jtu.tree_map(lambda a, b: _SLACK * (b - a), box.lower, box.upper)
        lower = (box.lower[0] - slack[0], jnp.zeros_like(box.lower[1]))
        upper = (box.upper[0] + slack[0], box.upper[1] + slack[1])
        example = jtu.tree_map(lambda x: x[0], as_state(states))
        return cls(frame, Box(lower, upper), example)

    def extended(self, states: Y) -> "FramedBox":
        """The same with the inputs of `states`, too.

        The largest clock stays: the network measures its time by it.
        """
        seen = FramedBox.around(self.frame, states).box
        inputs = self.box.lower[0], self.box.upper[0]
        around = Box(*inputs).extended(jnp.stack([seen.lower[0], seen.upper[0]]))
        box = Box((around.lower, self.box.lower[1]), (around.upper, self.box.upper[1]))
        return FramedBox(self.frame, box, self.example)

    @property
    def fastest(self) -> Array:
        """The largest clock."""
        return self.box.upper[1]

    def contains(self, y: Y) -> Bool[Array, ""]:
        """Whether `y` is one of these states, up to symmetries."""
        frame = self.frame(y)
        return self.box.contains((frame.inputs, jnp.asarray(frame.clock)))


_SLACK = 1e-6
