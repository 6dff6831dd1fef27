"""What a system knows of its symmetries."""

from typing import NamedTuple

from jaxtyping import Array, Float


class Reduced(NamedTuple):
    """A state up to symmetries: a `diffrax_conserve.learned.Frame` is made of these three."""

    inputs: Float[Array, " k"]  # what the symmetries do not change
    basis: Float[Array, "n m"]  # directions that turn with the state
    clock: Float[Array, ""]  # units of its own time in one unit of time
