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
from ..._projection.within_bounds import check_bounds
from ..._tree import tree_shapes
from .flat import as_state, as_states, flatten


@final
class Box(eqx.Module):
    r"""The states between two corners, $l \le y \le u$ in every component.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        box = dfc.learned.Box(jnp.array([-1.0, 0.0]), jnp.array([1.0, 2.0]))
        assert not box.contains(jnp.array([0.0, 3.0]))
        ```
    """

    lower: PyTree[Real[Array, "..."]] = eqx.field(converter=as_state)
    upper: PyTree[Real[Array, "..."]] = eqx.field(converter=as_state)

    def __check_init__(self):
        lower, upper = tree_shapes(self.lower), tree_shapes(self.upper)
        if lower != upper:
            raise ValueError(f"`lower` has the structure {lower}, but `upper` has {upper}.")
        check_bounds(self.lower, self.upper)

    @classmethod
    def around(cls, states: Y) -> "Box":
        """The smallest box around `states`, which are stacked along a leading axis."""
        states = as_states(states)
        lower = jtu.tree_map(lambda x: jnp.min(x, axis=0), states)
        return cls(lower, jtu.tree_map(lambda x: jnp.max(x, axis=0), states))

    def contains(self, y: Y) -> Bool[Array, ""]:
        """Whether `y` is in the box, its boundary included. NaN is not."""
        wanted, got = jtu.tree_structure(self.lower), jtu.tree_structure(y)
        if got != wanted:
            raise ValueError(f"The box is for states of the structure {wanted}, not {got}.")
        within = lambda x, a, b: jnp.all((a <= x) & (x <= b))  # noqa: E731
        inside = jtu.tree_map(within, y, self.lower, self.upper)
        return jnp.all(jnp.stack(jtu.tree_leaves(inside)))

    def sample(self, key: PRNGKeyArray) -> Y:
        """A point of the box, drawn from the uniform distribution."""
        lower, treedef = jtu.tree_flatten(self.lower)
        corners = zip(jr.split(key, len(lower)), lower, jtu.tree_leaves(self.upper), strict=True)
        return treedef.unflatten([jr.uniform(k, a.shape, a.dtype, a, b) for k, a, b in corners])

    def centred(self, y: Y) -> Y:
        """`y`, shifted and scaled such that the box is [-1, 1] in every component."""
        unit = lambda x, a, b: (2 * x - a - b) / jnp.where(b > a, b - a, 1)  # noqa: E731
        return jtu.tree_map(unit, y, self.lower, self.upper)


Box.__init__.__doc__ = """**Arguments:**

- `lower`, `upper`: the corners, two real PyTrees of the structure and shapes of a state; others
    raise a `ValueError` or `TypeError`, as does a lower corner above the upper one.
"""


@final
class Frame(eqx.Module):
    r"""The representation of a state in a moving frame.

    Symmetries such as rotations, permutations or changes of scale map solutions to solutions. With
    a function from a state to its frame, a [`diffrax_conserve.DeepONet`][] learns $m$ functions of
    the $k$ `inputs` and the own time $\tau$ = `clock` $h$, instead of $n$ functions of $n + 1$
    numbers:

    $$u(h) = T_q(u_0, h) + (\tau / \tau_{\max})^{q+1} B(u_0) N(\text{inputs}, \tau),$$

    and commutes with the symmetries for all weights. $\tau_{\max}$ is the largest own time of
    `max_step`. See `frame` of [`diffrax_conserve.systems.PointVortices`][] and of
    [`diffrax_conserve.systems.Kepler`][], which return the three as a tuple.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax
        import jax.numpy as jnp


        def polar(y):  # of a planar system that commutes with rotations
            basis = jnp.array([[y[0], -y[1]], [y[1], y[0]]])
            return dfc.learned.Frame(jnp.linalg.norm(y)[None], basis)


        states = jnp.array([[1.0, 0.0], [0.0, 1.5], [2.0, 0.0]])
        flow_map = dfc.DeepONet(states, 0.25, frame=polar, key=jax.random.key(0))
        ```

    ??? cite "Reference"

        M. Fels and P. J. Olver, "Moving coframes: II", Acta Appl. Math. 55 (1999), for frames.
    """

    inputs: Float[Array, " k"]
    basis: Float[Array, "n m"]
    clock: RealScalarLike = 1.0

    def measure(self, rate: Float[Array, " n"]) -> Float[Array, " m"]:
        """A rate of change of the state in the columns of `basis`, per unit of the own time."""
        gram = self.basis.T @ self.basis
        return jnp.linalg.solve(gram, self.basis.T @ rate) / self.clock


Frame.__init__.__doc__ = r"""**Arguments:**

- `inputs`: a vector of $k$ invariants of the symmetries, which differ for two states unless a
    symmetry maps one to the other.
- `basis`: a matrix $B$ of shape $(n, m)$, whose columns are transformed like the state and span all
    directions in which a solution can leave it.
- `clock`: own time per unit of time; 1 unless the symmetries include a change of scale.
"""

# A function from a state to its `Frame`, or to the tuple `(inputs, basis, clock)`.
MakeFrame = Callable[[Any], Any]


def frame_at(make: MakeFrame, y: Y) -> Frame:
    made = make(y)
    if not isinstance(made, Frame | tuple):
        raise TypeError("`frame` must return a `diffrax_conserve.learned.Frame`.")
    return made if isinstance(made, Frame) else Frame(*made)


def check_frame(make: Any, y: Y) -> None:
    """Raises unless `make` is a function from states like `y` to a `Frame` of the right shapes."""
    frame, n = eqx.filter_eval_shape(frame_at, make, y), eqx.filter_eval_shape(flatten, y).size
    inputs, basis = frame.inputs.shape, frame.basis.shape
    if len(inputs) != 1 or len(basis) != 2 or basis[0] != n:
        raise ValueError(
            f"`frame` returns inputs of shape {inputs} and a basis of shape {basis}, but for "
            f"states of {n} numbers they must have the shapes `(k,)` and `({n}, m)`."
        )


@final
class FramedBox(eqx.Module):
    """The states whose frames have inputs in a box, and a clock of at most the largest one."""

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
        return self.box.upper[1]

    def frame(self, y: Y) -> Frame:
        return frame_at(self.make, y)

    def contains(self, y: Y) -> Bool[Array, ""]:
        frame = self.frame(y)
        return self.box.contains((frame.inputs, jnp.asarray(frame.clock)))


_SLACK = 1e-6
