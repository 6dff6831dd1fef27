"""What the reduction of large equations needs beside the `Structure`: the places of derivatives,
and how slopes are eliminated such that each constraint stays a function of a few unknowns.
"""

# The types of scipy's sparse arrays are incomplete.
# pyright: reportOptionalSubscript=false, reportAttributeAccessIssue=false, reportGeneralTypeIssues=false
# pyright: reportArgumentType=false, reportCallIssue=false, reportReturnType=false, reportOptionalIterable=false

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from .._large.klu import SparseJacobian


class SparseMatrix:
    """A constant sparse matrix that is known while JAX traces, with its product."""

    def __init__(self, matrix: sp.csr_array):
        self.matrix = sp.csr_array(matrix)
        self.matrix.sum_duplicates()
        self.matrix.eliminate_zeros()
        at = sp.coo_array(self.matrix)
        self.values, (self.rows, self.columns) = (
            at.data,
            (np.asarray(x, np.int32) for x in at.coords),
        )
        self._key = at.shape, *(x.tobytes() for x in (self.rows, self.columns, self.values))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SparseMatrix) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @property
    def shape(self) -> tuple[int, int]:
        return self.matrix.shape

    def dense(self, dtype: Any) -> Array:
        # With the barrier XLA does not keep all zeros as a constant.
        zeros = lax.optimization_barrier(jnp.zeros(self.shape, dtype))
        return zeros.at[self.rows, self.columns].set(jnp.asarray(self.values, dtype))

    def __matmul__(self, x: Array) -> Array:
        """By gather and scatter, of which the cost is that of the elements."""
        products = jnp.asarray(self.values, x.dtype) * x[self.columns]
        return jnp.zeros(self.shape[0], x.dtype).at[self.rows].add(products)


@dataclasses.dataclass(frozen=True, eq=False)
class Elimination:
    """How the slopes are found that the next constraints need.

    - `constant`: where `∂F/∂y'` is constant, slopes are this matrix times the equations at no
      slopes; `None` if there are none of these.
    - `levels`: for the others, rows and columns of equations with one slope that is not yet known.
    """

    constant: SparseMatrix | None = None
    levels: tuple[tuple[np.ndarray, np.ndarray], ...] = ()

    def slopes(
        self, equations: Callable[[Array], Array], like: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        slopes = jnp.zeros_like(like)
        if self.constant is not None:
            slopes = self.constant @ equations(slopes)
        for rows, columns in self.levels:
            one = jnp.zeros_like(like).at[columns].set(1)
            left, by_slope = jax.jvp(equations, (slopes,), (one,))
            slopes = slopes.at[columns].set(-left[rows] / by_slope[rows])
        return slopes


@dataclasses.dataclass(frozen=True, eq=False)
class Large:
    """Where the derivatives of large equations have elements, and the eliminations.

    - `by_y`, `by_slope`: the places of `∂F/∂y` and `∂F/∂y'`.
    - `combinations`: the equations that are left first, as these combinations of the equations at
        no slopes; `None` if they contain no slopes.
    - `along`: the directions in which a state moves without what the equations differentiate, with
        a column for each unknown for whose slope they are not solved; `None` if it is not known.
    - `by_free`: with index 1 the places of the derivative of what is left by a movement along them.
    - `eliminations`: for each differentiation but the first.
    - `for_slopes`: the places of the derivative by slopes of the equations after the last
        differentiation, which determine all slopes.
    """

    by_y: SparseJacobian
    by_slope: SparseJacobian
    combinations: SparseMatrix | None = None
    along: SparseMatrix | None = None
    by_free: SparseJacobian | None = None
    eliminations: tuple[Elimination, ...] = ()
    for_slopes: SparseJacobian | None = None
