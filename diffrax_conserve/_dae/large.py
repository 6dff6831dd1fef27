"""What the reduction of large equations needs beside the `Structure`: the places of derivatives."""

import dataclasses

from .._large.klu import SparseJacobian
from .elimination import SparseMatrix


@dataclasses.dataclass(frozen=True, eq=False)
class Large:
    """Where the derivatives of large equations have elements.

    - `by_y`, `by_slope`: the places of `∂F/∂y` and `∂F/∂y'`.
    - `combinations`: the equations that are left first, as these combinations of the equations at
        no slopes; `None` if they contain no slopes.
    - `along`: the directions in which a state moves without what the equations differentiate, with
        a column for each unknown for whose slope they are not solved; `None` if it is not known.
    - `by_free`: with index 1 the places of the derivative of what is left by a movement along them.
    - `for_slopes`: the places of the derivative by slopes of the equations after the last
        differentiation, which determine all slopes.
    """

    by_y: SparseJacobian
    by_slope: SparseJacobian
    combinations: SparseMatrix | None = None
    along: SparseMatrix | None = None
    by_free: SparseJacobian | None = None
    for_slopes: SparseJacobian | None = None
