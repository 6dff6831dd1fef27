"""The states for which a flow map was trained, also up to the symmetries of its equation."""

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree, Real

from ..._custom_types import RealScalarLike, Y
from .flat import as_state, as_states, flatten


@final
class Box(eqx.Module):
    r"""The states between two corners, $l \le y \le u$ in every component.

    As the `domain` of a flow map it can be replaced by any Module with a method `contains(y)`. The
    option `outside` of [`diffrax_conserve.DeepONetSolver`][] determines what happens to a step that
    starts outside it.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax

        system = dfc.systems.get("conservative-lorenz")
        states = jax.vmap(system.sample)(jax.random.split(jax.random.key(0), 100))
        box = dfc.learned.Box.around(states)
        assert box.contains(states[0])
        assert not box.contains(100 * states[0])
        ```
    """

    lower: PyTree[Real[Array, "..."]] = eqx.field(converter=as_state)
    upper: PyTree[Real[Array, "..."]] = eqx.field(converter=as_state)

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
        states = as_states(states)
        lower = jtu.tree_map(lambda x: jnp.min(x, axis=0), states)
        return cls(lower, jtu.tree_map(lambda x: jnp.max(x, axis=0), states))

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

    def sample(self, key: PRNGKeyArray) -> Y:
        """A point of the box, drawn from the uniform distribution."""
        lower, treedef = jtu.tree_flatten(self.lower)
        corners = zip(jr.split(key, len(lower)), lower, jtu.tree_leaves(self.upper), strict=True)
        return treedef.unflatten([jr.uniform(k, a.shape, a.dtype, a, b) for k, a, b in corners])

    def centred(self, y: Y) -> Y:
        """`y`, shifted and scaled such that the box is [-1, 1] in every component."""

        def leaf(x: Array, a: Array, b: Array) -> Array:
            return (2 * x - a - b) / jnp.where(b > a, b - a, 1)

        return jtu.tree_map(leaf, y, self.lower, self.upper)


Box.__init__.__doc__ = """**Arguments:**

- `lower`, `upper`: the corners, two PyTrees like a state.

**Raises:**

`ValueError` or `TypeError` if their structures or shapes differ, or if they are not real.
"""


@final
class Frame(eqx.Module):
    r"""The representation of a state in a moving frame.

    Symmetries such as rotations, permutations or changes of scale map solutions to solutions. With
    a *frame*, a function of one state that returns `inputs`, `basis` and `clock`, a
    [`diffrax_conserve.DeepONet`][] learns $m$ functions of $k + 1$ numbers, the inputs and the own
    time $\tau$ = `clock` $h$, instead of $n$ functions of $n + 1$ numbers:

    $$u(h) = T_q(u_0, h) + (\tau / \tau_{\max})^{q+1} B(u_0) N(\text{inputs}, \tau),$$

    and commutes with the symmetries for all weights. $\tau_{\max}$ is the largest own time of
    `max_step` among the states with which it was built. Examples are the methods `frame` of
    [`diffrax_conserve.systems.PointVortices`][] and of [`diffrax_conserve.systems.Kepler`][], which
    return the three as a tuple.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax
        import jax.numpy as jnp


        # A planar system that commutes with rotations.
        def polar(y):
            radius = jnp.linalg.norm(y)
            across = jnp.array([-y[1], y[0]])
            return dfc.learned.Frame(radius[None], jnp.stack([y, across], axis=1))


        states = jnp.array([[1.0, 0.0], [0.0, 1.5], [2.0, 0.0]])
        flow_map = dfc.DeepONet(states, 0.25, frame=polar, key=jax.random.key(0))
        east, north = flow_map(jnp.array([1.0, 0.0]), 0.1), flow_map(jnp.array([0.0, 1.0]), 0.1)
        assert jnp.allclose(jnp.array([-east[1], east[0]]), north)
        ```

    ??? cite "Reference"

        M. Fels and P. J. Olver, "Moving coframes: II", Acta Appl. Math. 55 (1999), for frames.
    """

    inputs: Float[Array, " k"]
    basis: Float[Array, "n m"]
    clock: RealScalarLike = 1.0

    def measure(self, rate: Float[Array, " n"]) -> Float[Array, " m"]:
        """Converts a rate of change of the state to coefficients of the columns of `basis`, per
        unit of the frame's own time."""
        gram = self.basis.T @ self.basis
        return jnp.linalg.solve(gram, self.basis.T @ rate) / self.clock


Frame.__init__.__doc__ = r"""**Arguments:**

- `inputs`: a vector of $k$ invariants of the symmetries, which differ for two states unless a
    symmetry maps one to the other.
- `basis`: a matrix $B$ with a row for each component of the state, whose $m$ columns are
    transformed like the state and span all directions in which a solution can leave it.
- `clock`: the number of the frame's own units of time per unit of time; 1 unless the symmetries
    include a change of scale.
"""

# A function from a state to its `Frame`, or to the tuple `(inputs, basis, clock)`.
MakeFrame = Callable[[Any], Any]


def frame_at(make: MakeFrame, y: Y) -> Frame:
    """The frame of `y`."""
    made = make(y)
    return made if isinstance(made, Frame) else Frame(*made)


def check_frame(make: Any, y: Y) -> None:
    """Raises unless `make` is a function from states like `y` to a `Frame` of the right shapes."""
    if not callable(make):
        raise TypeError(f"`frame` is {make!r}, not a function from a state to a `Frame`.")
    made = eqx.filter_eval_shape(make, y)
    if not (isinstance(made, Frame) or (isinstance(made, tuple) and len(made) == 3)):
        raise TypeError(
            f"`frame` returns a {type(made).__name__}, but must return a "
            "`diffrax_conserve.learned.Frame`, or a tuple `(inputs, basis, clock)`."
        )
    inputs, basis = (made.inputs, made.basis) if isinstance(made, Frame) else made[:2]
    n = eqx.filter_eval_shape(flatten, y).size
    shapes = inputs.shape, basis.shape
    if len(shapes[0]) != 1 or len(shapes[1]) != 2 or shapes[1][0] != n:
        raise ValueError(
            f"`frame` returns inputs of shape {shapes[0]} and a basis of shape {shapes[1]}, but "
            f"for states of {n} numbers they must have the shapes `(k,)` and `({n}, m)`."
        )


@final
class FramedBox(eqx.Module):
    """The states whose frames resemble those of the states with which a flow map was built.

    The inputs of the frame are in a box, and its clock is at most the largest one.
    """

    make: MakeFrame
    box: Box  # of pairs of the inputs and the clock
    example: Y  # one of the states, for their structure

    @classmethod
    def around(cls, make: MakeFrame, states: Y) -> "FramedBox":
        """The smallest framed box around `states`, which are stacked along a leading axis."""
        frames = jax.vmap(lambda y: frame_at(make, y))(states)
        clocks = jnp.broadcast_to(frames.clock, frames.inputs.shape[:1])
        box = Box.around((frames.inputs, clocks))
        # A symmetry changes the inputs of a state by roundoff, so the box is slightly enlarged.
        slack = jtu.tree_map(lambda a, b: _SLACK * (b - a), box.lower, box.upper)
        lower = (box.lower[0] - slack[0], jnp.zeros_like(box.lower[1]))
        upper = (box.upper[0] + slack[0], box.upper[1] + slack[1])
        example = jtu.tree_map(lambda x: x[0], as_state(states))
        return cls(make, Box(lower, upper), example)

    @property
    def fastest(self) -> Array:
        """The largest clock."""
        return self.box.upper[1]

    def frame(self, y: Y) -> Frame:
        """The frame of `y`."""
        return frame_at(self.make, y)

    def contains(self, y: Y) -> Bool[Array, ""]:
        """Whether `y` is one of these states, up to symmetries."""
        frame = self.frame(y)
        return self.box.contains((frame.inputs, jnp.asarray(frame.clock)))


_SLACK = 1e-6
