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
    r"""A state as seen from a frame that moves with it.

    Translations, rotations, permutations or changes of scale may map solutions to solutions. Then a
    flow map need not be learned for all states that they map to each other. A *frame* is a function
    of one state that returns

    - `inputs`: a vector of $k$ numbers that the symmetries do not change, and that tell two states
        apart unless a symmetry maps one to the other;
    - `basis`: a matrix $B$ of as many rows as the state has numbers, whose $m$ columns turn with
        the state: they span all directions that a solution can leave it in;
    - `clock`: how many of its own units of time pass in one unit of time. One, unless a change of
        scale is among the symmetries.

    A [`diffrax_conserve.DeepONet`][] with it learns $m$ functions of $k + 1$ numbers instead of $n$
    of $n + 1$, the inputs and the own time $\tau$ = `clock` $h$:

    $$u(h) = T_q(u_0, h) + (\tau / \tau_{\max})^{q+1} B(u_0) N(\text{inputs}, \tau),$$

    and commutes with the symmetries whatever its weights. States that only differ by their scale
    are the same to it, seen for a longer time; $\tau_{\max}$ is the longest among the states that
    it was made with.

    [`diffrax_conserve.systems.PointVortices`][] and [`diffrax_conserve.systems.Kepler`][] have
    one, their method `frame`, which returns the three in a tuple.

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
        """A change of the state in a unit of time, as the coefficients of the columns of `basis`
        in a unit of the frame's own time."""
        gram = self.basis.T @ self.basis
        return jnp.linalg.solve(gram, self.basis.T @ rate) / self.clock


Frame.__init__.__doc__ = r"""**Arguments:**

- `inputs`, `basis`, `clock`: as above.
"""

# A state to its `Frame`, or to the tuple `(inputs, basis, clock)`.
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
            f"`frame` returns a {type(made).__name__}. It must return a "
            "`diffrax_conserve.learned.Frame`, or a tuple of the same: the invariants of the "
            "state, a basis that turns with it, and a clock."
        )
    inputs, basis = (made.inputs, made.basis) if isinstance(made, Frame) else made[:2]
    n = eqx.filter_eval_shape(flatten, y).size
    shapes = inputs.shape, basis.shape
    if len(shapes[0]) != 1 or len(shapes[1]) != 2 or shapes[1][0] != n:
        raise ValueError(
            f"`frame` returns inputs of shape {shapes[0]} and a basis of shape {shapes[1]}, but "
            f"for states of {n} numbers they must have the shapes `(k,)` and `({n}, m)`."
        )
