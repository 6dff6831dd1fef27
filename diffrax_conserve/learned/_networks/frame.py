"""Moving frames: flow maps that commute with the symmetries of their equations."""

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._custom_types import RealScalarLike, Y
from .flat import flatten


@final
class Frame(eqx.Module):
    r"""The representation of a state in a moving frame.

    Symmetries such as rotations, permutations or changes of scale map solutions to solutions. A
    *frame* is a function of one state that returns

    - `inputs`: a vector of $k$ invariants of the symmetries, which differ for two states unless a
        symmetry maps one to the other;
    - `basis`: a matrix $B$ with a row for each component of the state, whose $m$ columns are
        transformed like the state and span all directions in which a solution can leave it;
    - `clock`: the number of the frame's own units of time per unit of time; 1 unless the symmetries
        include a change of scale.

    With a frame, a [`diffrax_conserve.DeepONet`][] learns $m$ functions of $k + 1$ numbers, the
    inputs and the own time $\tau$ = `clock` $h$, instead of $n$ functions of $n + 1$ numbers:

    $$u(h) = T_q(u_0, h) + (\tau / \tau_{\max})^{q+1} B(u_0) N(\text{inputs}, \tau),$$

    and commutes with the symmetries for all weights. $\tau_{\max}$ is the largest own time of
    `max_step` among the states with which it was built.

    Examples are the methods `frame` of [`diffrax_conserve.systems.PointVortices`][] and of
    [`diffrax_conserve.systems.Kepler`][], which return the three as a tuple.

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

- `inputs`, `basis`, `clock`: as above.
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
