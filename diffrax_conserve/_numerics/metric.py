"""The metric `M` of a projection, in the form of a factor `S` of its inverse, `M⁻¹ = S Sᵀ`.

Projections never use `M` itself. For weights `S` is a diagonal matrix. For parts of the state that
have a matrix it is made from a Cholesky factor. And a metric may prefer corrections in the span of
the last changes of the state, so that linear functions that these do not change are conserved.
"""

import abc
import functools as ft
import math
from collections.abc import Callable
from typing import Any, ClassVar, final

import equinox as eqx
import jax
import jax.core
import jax.lax as lax
import jax.numpy as jnp
import jax.scipy as jsp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._constants import REGULARISATION_POWER
from .._custom_types import Args, RealScalarLike, Y
from .._options import check_function, check_number
from .._tree import eps_of, ravel, real_view
from .rows import AbstractRows, DenseRows


class AbstractFactor(eqx.Module):
    """A factor `S` of `M⁻¹ = S Sᵀ`, as products with it and with its inverse.

    All linear algebra works with `G S`, whose columns do not have the units of the state. So
    nothing is squared before it is scaled, which could overflow, and a change of units by powers of
    two changes no bit of the result.
    """

    # Whether the product of a sparse row with `S` is dense.
    is_dense: ClassVar[bool] = False

    @abc.abstractmethod
    def scaled_gradient(self, gradient: Float[Array, "*m n"]) -> Float[Array, "*m n"]:
        """`Sᵀ gradient`, for one gradient or for each row of a matrix."""

    def scaled_rows(self, rows: Any) -> AbstractRows:
        """`rows S`, for the rows of a Jacobian."""
        return DenseRows(self.scaled_gradient(rows.matrix))

    @abc.abstractmethod
    def to_state(self, change: Float[Array, " n"]) -> Float[Array, " n"]:
        """`S change`, for a change in the coordinates in which the metric is Euclidean."""

    @abc.abstractmethod
    def to_euclidean(self, change: Float[Array, " n"]) -> Float[Array, " n"]:
        """`S⁻¹ change`."""

    def norm(self, change: Float[Array, " n"]) -> Float[Array, ""]:
        """The length of a change of the state in the metric."""
        return jnp.linalg.norm(self.to_euclidean(change))


@final
class Identity(AbstractFactor):
    """`S = 1`, which costs no product."""

    def scaled_gradient(self, gradient: Float[Array, "*m n"]) -> Float[Array, "*m n"]:
        return gradient

    def scaled_rows(self, rows: Any) -> AbstractRows:
        return rows

    def to_state(self, change: Float[Array, " n"]) -> Float[Array, " n"]:
        return change

    def to_euclidean(self, change: Float[Array, " n"]) -> Float[Array, " n"]:
        return change


@final
class Diagonal(AbstractFactor):
    """`S = diag(s)`. The number `s_k = 1/√M_k` is the unit in which a correction of the component
    is measured. A component whose unit is zero is never moved, and its `S⁻¹ change` is zero."""

    diagonal: Float[Array, " n"]

    def scaled_gradient(self, gradient: Float[Array, "*m n"]) -> Float[Array, "*m n"]:
        return gradient * jnp.broadcast_to(self.diagonal, gradient.shape)

    def scaled_rows(self, rows: Any) -> AbstractRows:
        return rows.scale_columns(self.diagonal)

    def to_state(self, change: Float[Array, " n"]) -> Float[Array, " n"]:
        return change * self.diagonal

    def to_euclidean(self, change: Float[Array, " n"]) -> Float[Array, " n"]:
        moves = self.diagonal != 0
        return jnp.where(moves, change / jnp.where(moves, self.diagonal, 1), 0)


@final
class BlockCholesky(AbstractFactor):
    """The factor of a metric that is a matrix in some parts of the state. In such a part
    `M = L Lᵀ` is the Cholesky factorisation, and `S = L⁻ᵀ`; elsewhere `S` is diagonal.

    - `diagonal_elsewhere`: the diagonal, ones in the parts with a matrix.
    - `lower`: the factor `L` of each part with a matrix.
    - `starts`: the first component of each of these parts.
    """

    diagonal_elsewhere: Diagonal
    lower: tuple[Float[Array, "k k"], ...]
    starts: tuple[int, ...] = eqx.field(static=True)
    is_dense: ClassVar[bool] = True

    def scaled_gradient(self, gradient: Float[Array, "*m n"]) -> Float[Array, "*m n"]:
        solve = lambda lower, x: jsp.linalg.solve_triangular(lower, x.T, lower=True).T  # noqa: E731
        return self._on_blocks(solve, self.diagonal_elsewhere.scaled_gradient(gradient))

    def to_state(self, change: Float[Array, " n"]) -> Float[Array, " n"]:
        solve = lambda lower, x: jsp.linalg.solve_triangular(lower, x, 1, lower=True)  # noqa: E731
        return self._on_blocks(solve, self.diagonal_elsewhere.to_state(change))

    def to_euclidean(self, change: Float[Array, " n"]) -> Float[Array, " n"]:
        product = lambda lower, x: jnp.matmul(x, lower, precision=lax.Precision.HIGHEST)  # noqa: E731
        return self._on_blocks(product, self.diagonal_elsewhere.to_euclidean(change))

    def _on_blocks(self, fn: Callable[[Array, Array], Array], x: Array) -> Array:
        """`x` with `fn(L, part)` in the place of each part with a matrix."""
        for start, lower in zip(self.starts, self.lower, strict=True):
            part = slice(start, start + len(lower))
            x = x.at[..., part].set(fn(lower, x[..., part]))
        return x


@final
class PreferredSubspace(AbstractFactor):
    """The factor `S (P + δ (1 - P))`, where `S` is the `base_factor`, that of another metric, and
    `P = Qᵀ Q` projects onto the span of the orthonormal rows of `basis`, as measured by `S`.

    In this metric a correction leaves the span only where none within it reaches the manifold,
    because lengths outside of the span are multiplied by `1/δ`. The weight of the complement in
    `M⁻¹`, `δ²`, is the shift that a large Gram matrix gets on its diagonal, because the Gram matrix
    of the span alone may be singular.
    """

    base_factor: AbstractFactor
    basis: Float[Array, "k n"]
    is_dense: ClassVar[bool] = True

    @classmethod
    def spanned_by(
        cls, base_factor: AbstractFactor, changes: Float[Array, "k n"]
    ) -> "PreferredSubspace":
        """Prefers the span of given changes of the state, by the Gram-Schmidt process. Each change
        is made orthogonal to those before it twice, because the roundoff that is left after the
        first time grows with the ratio of its lengths before and after. If at most a share `δ` of
        the change is new, it is left out: the new part has too few digits to conserve what the
        other changes conserve."""
        changes = jax.vmap(base_factor.to_euclidean)(changes)
        sizes = jnp.max(jnp.abs(changes), axis=1, keepdims=True)
        changes = changes / jnp.where(sizes > 0, sizes, 1)
        least = _complement_damping(changes.dtype) ** 2

        def add(basis: Array, k: Array) -> tuple[Array, None]:
            new = changes[k]
            for _ in range(2):
                new = new - (basis @ new) @ basis
            square = jnp.sum(new**2)
            is_new = square > least * jnp.sum(changes[k] ** 2)
            new = jnp.where(is_new, new * lax.rsqrt(jnp.where(is_new, square, 1)), 0)
            return basis.at[k].set(new), None

        return cls(base_factor, lax.scan(add, jnp.zeros_like(changes), jnp.arange(len(changes)))[0])

    def scaled_gradient(self, gradient: Float[Array, "*m n"]) -> Float[Array, "*m n"]:
        return self._damped_complement(
            self.base_factor.scaled_gradient(gradient), _complement_damping(gradient.dtype)
        )

    def to_state(self, change: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.base_factor.to_state(
            self._damped_complement(change, _complement_damping(change.dtype))
        )

    def to_euclidean(self, change: Float[Array, " n"]) -> Float[Array, " n"]:
        return self._damped_complement(
            self.base_factor.to_euclidean(change), 1 / _complement_damping(change.dtype)
        )

    def norm(self, change: Float[Array, " n"]) -> Float[Array, ""]:
        """In the own metric: a preference says where a correction leads, and not how long it is."""
        return self.base_factor.norm(change)

    def _damped_complement(self, x: Float[Array, "*m n"], outside: float) -> Float[Array, "*m n"]:
        """`x (P + outside (1 - P))`."""
        product = ft.partial(jnp.matmul, precision=lax.Precision.HIGHEST)
        projected = product(product(x, self.basis.T), self.basis)
        return projected + outside * (x - projected)


def _complement_damping(dtype: Any) -> float:
    """`δ` of `PreferredSubspace`."""
    return eps_of(dtype) ** (REGULARISATION_POWER / 2)


def positive_weights(metric: PyTree[ArrayLike | Callable] | None) -> PyTree[Any] | None:
    """`metric`, checked now as far as its values are known. Weights that are tracers are checked at
    run time. Of the values of functions only the shape is checked, where they are called."""

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


def factor_of(metric: PyTree[Any], t: RealScalarLike, y: Y, args: Args) -> AbstractFactor:
    """The factor of a metric at a state. The unit of an infinite weight is zero, so that its
    component is never moved."""
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
    units = 1 / jnp.sqrt(broadcast_option("metric", jtu.tree_map(weights, values, like), like))
    if not matrices:
        return Diagonal(units)
    lower = (jnp.linalg.cholesky(jnp.asarray(x, units.dtype)) for x in matrices.values())
    return BlockCholesky(Diagonal(units), tuple(lower), tuple(matrices))


def broadcast_option(name: str, option: PyTree[ArrayLike], like: Any) -> Float[Array, " n"]:
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
