"""A state up to the symmetries of a system."""

from typing import NamedTuple

from jaxtyping import Array, Float


class Reduced(NamedTuple):
    """A state up to symmetries: the three parts of a `diffrax_conserve.learned.Frame`."""

    inputs: Float[Array, " k"]  # invariants of the symmetries
    basis: Float[Array, "n m"]  # directions that turn with the state
    clock: Float[Array, ""]  # units of its own time in one unit of time
