"""The type aliases of the package: jaxtyping shapes under the names that diffrax uses."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

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
# A PyTree of `FirstIntegral`s and `Constraint`s. (Not spelled as a `PyTree[...]`: those are
# themselves PyTrees with leaves of any kind.)
Manifold = Any
ConstraintFn = Callable[[RealScalarLike, Any, Any], Values]
