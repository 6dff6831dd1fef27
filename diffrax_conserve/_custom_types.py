"""The type aliases of the package: jaxtyping shapes under the names that diffrax uses."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Protocol, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Int, PyTree, Real, Shaped

if TYPE_CHECKING:
    BoolScalarLike = bool | Array | np.ndarray
    IntScalarLike = int | Array | np.ndarray
    RealScalarLike = int | float | Array | np.ndarray
else:
    BoolScalarLike = Bool[ArrayLike, ""]
    IntScalarLike = Int[ArrayLike, ""]
    RealScalarLike = Real[ArrayLike, ""]

Y = PyTree[Shaped[ArrayLike, "?*y"], "Y"]
VF = PyTree[Shaped[ArrayLike, "?*vf"], "VF"]
Args = PyTree[Any]
DenseInfo = dict[str, PyTree[Array]]

# The value of a constraint function, or a conserved value: any PyTree of real arrays.
Values = PyTree[Real[ArrayLike, "..."]]
ConstraintFn = Callable[[RealScalarLike, Any, Any], Values]

# A PyTree of `FirstIntegral`s and `Constraint`s, which are PyTrees themselves: so no `PyTree[...]`.
# The type rejects a bare function, as `check_manifold` does.
if TYPE_CHECKING:

    class _Entry(Protocol):
        @property
        def fn(self) -> Callable[..., Any]: ...

    Manifold: TypeAlias = "_Entry | Sequence[Manifold] | Mapping[Any, Manifold]"
    # A function that takes a state returns one of the same type.
    State = TypeVar("State")
else:
    Manifold = Annotated[Any, "FirstIntegral, Constraint, or a PyTree of them"]
    State = Y
