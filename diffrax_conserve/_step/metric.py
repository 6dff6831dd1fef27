"""The metric `M` of a projection, in the form of a factor `S` of its inverse, `M⁻¹ = S Sᵀ`.

Projections never use `M` itself. For weights, `S` is the diagonal matrix of the units `1/√M_k` of
the components. For parts of the state that have a matrix, it is made from a Cholesky factor.
"""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.lax as lax
import jax.numpy as jnp
import jax.scipy as jsp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._custom_types import Args, RealScalarLike, Y
from .._options import check_function, check_number
from .._tree import ravel, real_view


class MatrixUnits(eqx.Module):
    """A factor `S` of `M⁻¹ = S Sᵀ`, where the metric `M` is a matrix in some parts of the state. In
    such a part `M = L Lᵀ` is the Cholesky factorisation, and `S = L⁻ᵀ`; elsewhere `S` is diagonal.

    - `diagonal`: the units of the components, ones in the parts with a matrix.
    - `lower`: the factor `L` of each part with a matrix.
    - `starts`: the first component of each of these parts.
    """

    diagonal: Float[Array, " n"]
    lower: tuple[Float[Array, "k k"], ...]
    starts: tuple[int, ...] = eqx.field(static=True)

    def of_rows(self, rows: Float[Array, "*m n"]) -> Float[Array, "*m n"]:
        """`rows S`."""
        solve = lambda lower, x: jsp.linalg.solve_triangular(lower, x.T, lower=True).T  # noqa: E731
        return self._in_parts(solve, rows * self.diagonal)

    def of_change(self, change: Float[Array, " n"]) -> Float[Array, " n"]:
        """`S change`."""
        solve = lambda lower, x: jsp.linalg.solve_triangular(lower, x, 1, lower=True)  # noqa: E731
        return self._in_parts(solve, change * self.diagonal)

    def measured(self, change: Float[Array, " n"]) -> Float[Array, " n"]:
        """`S⁻¹ change` in the parts with a matrix, and `change` elsewhere."""
        product = lambda lower, x: jnp.matmul(x, lower, precision=lax.Precision.HIGHEST)  # noqa: E731
        return self._in_parts(product, change)

    @property
    def sizes(self) -> Float[Array, " n"]:
        """A unit of each component, `1/√M_kk`, as if the others did not move. The diagonal element
        `M_kk` is the square of the length of row `k` of `L`."""
        return self._in_parts(lambda lower, x: x / jnp.linalg.norm(lower, axis=1), self.diagonal)

    def _in_parts(self, fn: Callable[[Array, Array], Array], x: Array) -> Array:
        """`x` with `fn(L, part)` in the place of each part with a matrix."""
        for start, lower in zip(self.starts, self.lower, strict=True):
            part = slice(start, start + len(lower))
            x = x.at[..., part].set(fn(lower, x[..., part]))
        return x


# The metric as it is used: a unit for each component, or a factor with matrices, or `None` if all
# units are one.
Units = Float[Array, " n"] | MatrixUnits | None


def positive_weights(metric: PyTree[ArrayLike | Callable] | None) -> PyTree[Any] | None:
    """`metric`, checked now as far as its values are known. The weights of a tracer are checked at
    run time, and functions where they are called."""

    def check(weight: Any) -> Any:
        if callable(weight):
            check_function("`metric`", weight, "metric(t, y, args)", "a positive definite matrix")
            return weight
        check_number("metric", weight)
        is_square = jnp.ndim(weight) == 2 and len({*jnp.shape(weight)}) == 1
        if isinstance(weight, jax.core.Tracer):
            if is_square:
                # It may be a matrix. If that is not positive definite, its Cholesky factor is NaN,
                # and the projection fails.
                return weight
            message = "`metric` has a weight that is not positive."
            return eqx.error_if(weight, ~jnp.all(weight > 0), message)
        known = np.asarray(weight)
        if not (np.all(known > 0) or (is_square and _is_positive_definite(known))):
            raise ValueError(
                "`metric` has a weight that is not positive, or a matrix that is not symmetric and "
                "positive definite."
            )
        return weight

    return jtu.tree_map(check, metric, is_leaf=callable)


def _is_positive_definite(matrix: np.ndarray) -> bool:
    # A matrix may have been computed in float32, from terms that cancel.
    symmetric = np.allclose(matrix, matrix.T, rtol=np.finfo(np.float32).eps ** 0.5, atol=0)
    return bool(symmetric and np.all(np.linalg.eigvalsh((matrix + matrix.T) / 2) > 0))


def units_of(metric: PyTree[Any], t: RealScalarLike, y: Y, args: Args) -> Units:
    """The units `M^(-1/2)` of a metric at a state. The unit of an infinite weight is zero, so that
    its component is never moved."""
    values = jtu.tree_map(lambda x: x(t, y, args) if callable(x) else x, metric, is_leaf=callable)
    like, matrices, start = jax.eval_shape(lambda: y), {}, 0

    def weights(given: Any, part: Any) -> Any:
        """The weights of a part of the state, or ones if it has a matrix."""
        nonlocal start
        size = jax.eval_shape(ravel, part).size
        if jnp.shape(given) == (size, size) and size > 1:
            matrices[start] = given
            given = 1.0
        start += size
        return given

    _check_prefix("metric", values, like)
    diagonal = 1 / jnp.sqrt(spread("metric", jtu.tree_map(weights, values, like), like))
    if not matrices:
        return diagonal
    factors = (jnp.linalg.cholesky(jnp.asarray(x, diagonal.dtype)) for x in matrices.values())
    return MatrixUnits(diagonal, tuple(factors), tuple(matrices))


def spread(name: str, option: PyTree[ArrayLike], like: Any) -> Float[Array, " n"]:
    """An option of numbers or arrays for the parts of a state, as a vector like the state."""

    def spread_leaf(given: ArrayLike, leaf: Any) -> Any:
        shape = jnp.shape(given)
        try:
            fits = np.broadcast_shapes(shape, leaf.shape) == leaf.shape
        except ValueError:
            fits = False
        if not fits:
            raise ValueError(
                f"`{name}` has a leaf of shape {shape} for one of shape {leaf.shape} of the state. "
                f"Give a number or an array that broadcasts against it{_or_matrix(name, leaf)}."
            )
        # The real and the imaginary part of a complex component have the same option.
        view = jax.eval_shape(real_view, leaf)
        return jnp.broadcast_to(jnp.asarray(given, view.dtype), view.shape)

    def spread_part(given: ArrayLike, part: Any) -> Any:
        return jtu.tree_map(lambda leaf: spread_leaf(given, leaf), part)

    _check_prefix(name, option, like)
    return ravel(jtu.tree_map(spread_part, option, like))


def _or_matrix(name: str, leaf: Any) -> str:
    size = math.prod(jax.eval_shape(real_view, leaf).shape)
    return f", or a matrix of shape {(size, size)}" if name == "metric" else ""


def _check_prefix(name: str, option: Any, like: Any) -> None:
    try:
        jtu.tree_map(lambda given, part: None, option, like)
    except ValueError as error:
        raise ValueError(
            f"`{name}` has the structure {jtu.tree_structure(option)}, but the state has "
            f"{jtu.tree_structure(like)}. Give one number, or one number or array for each part of "
            "the state."
        ) from error
