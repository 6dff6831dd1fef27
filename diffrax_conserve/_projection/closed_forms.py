"""Formulas for the nearest density matrix, rotation matrix and unit vector.

Each formula has a derivative of its own: that of an eigendecomposition or of a singular value
decomposition does not exist where eigenvalues or singular values coincide, that of the nearest
matrix does.
"""

import functools as ft
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, Inexact

from .._custom_types import Args, RealScalarLike, Values
from .._numerics.lanes import any_lane
from .._options import check_function, noting_call
from .._tree import eps_of
from .closed_form import ClosedForm

Matrices = Inexact[Array, "*batch n n"]


def density_matrix(where: Callable[[Any], Any] = lambda y: y) -> ClosedForm:
    r"""The projection to the nearest density matrix: Hermitian, of trace one, not negative.

    Of the Hermitian part $V \operatorname{diag}(w) V^\dagger$ the eigenvalues become
    $\max(w_i - \mu, 2 n \varepsilon)$, with the $\mu$ for which their sum is one. The bound of
    $2 n$ units of roundoff $\varepsilon$ keeps rounded entries from having a negative eigenvalue.
    In the Frobenius norm no density matrix is nearer, up to roundoff. The result is Hermitian
    exactly.

    **Arguments:**

    - `where`: a function from the state to its part that is projected, an array of shape
        `(..., n, n)` or a PyTree of such arrays. Default: the whole state.

    **Returns:**

    A [`diffrax_conserve.ClosedForm`][], for a manifold such as that of the trace.

    **Raises:**

    `TypeError` if `where` is not a function; `ValueError`, in use, if a part is no square matrix.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        trace = dfc.Constraint(lambda t, rho, args: jnp.trace(rho).real - 1)
        projection = dfc.closed_forms.density_matrix()
        solver = dfc.ManifoldProjection(diffrax.Tsit5(), trace, projection=projection)
        ```

    Source: J. A. Smolin, J. M. Gambetta and G. Smith, "Efficient method for computing the maximum-
    likelihood quantum state from measurements with additive Gaussian noise", Phys. Rev. Lett. 108
    (2012); derivatives as in N. J. Higham, "Functions of Matrices" (2008), 3.2.
    """
    return _closed_form(where, _density_matrix)


def rotation_matrix(where: Callable[[Any], Any] = lambda y: y) -> ClosedForm:
    r"""The projection to the nearest rotation matrix, the polar factor of determinant one.

    For $A = U \operatorname{diag}(s) V^\top$ it is $U \operatorname{diag}(1, \dots, \pm 1) V^\top$,
    nearest in the Frobenius norm. It has a derivative unless the two smallest singular values
    cancel, which is far from any rotation.

    **Arguments:**

    - `where`: a function from the state to its part that is projected, a real array of shape
        `(..., n, n)` or a PyTree of such arrays. Default: the whole state.

    **Returns:**

    A [`diffrax_conserve.ClosedForm`][].

    **Raises:**

    `TypeError` if `where` is not a function or a part is complex; `ValueError`, in use, if a part
    is not a square matrix.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        rotation = dfc.Constraint(lambda t, y, args: y["R"].T @ y["R"] - jnp.eye(3))
        projection = dfc.closed_forms.rotation_matrix(lambda y: y["R"])
        solver = dfc.ManifoldProjection(diffrax.Tsit5(), rotation, projection=projection)
        ```

    Source: N. J. Higham, "Functions of Matrices" (2008), 8.1 and 8.2.
    """
    return _closed_form(where, _rotation_matrix)


def unit_vector(where: Callable[[Any], Any] = lambda y: y, *, axis: int = -1) -> ClosedForm:
    r"""The projection to unit vectors, $x / |x|$ along an axis, real or complex.

    **Arguments:**

    - `where`: a function from the state to its part that is projected, an array or a PyTree of
        arrays. Default: the whole state.
    - `axis`: the axis of the components of a vector; along others there are several vectors.

    **Returns:**

    A [`diffrax_conserve.ClosedForm`][]. The zero vector has no nearest one, and fails.

    **Raises:**

    `TypeError` if `where` is not a function.

    !!! example

        ```python
        import diffrax
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        spins = dfc.Constraint(lambda t, y, args: jnp.sum(y**2, axis=-1) - 1)
        projection = dfc.closed_forms.unit_vector()
        solver = dfc.ManifoldProjection(diffrax.Tsit5(), spins, projection=projection)
        ```
    """

    return _closed_form(where, eqx.Partial(_normalised, axis=axis))


@final
class _OfPart(eqx.Module):
    """A formula for a part of the state."""

    where: Callable[[Any], Any]
    formula: Callable[[Array], Array]

    def __call__(self, t: RealScalarLike, y: Any, args: Args, values: Values) -> Any:
        del t, args, values
        part = lambda y: tuple(jtu.tree_leaves(self.where(y)))  # noqa: E731
        with noting_call("`where`", "where(y)", y):
            part(y)
        return eqx.tree_at(part, y, tuple(map(self.formula, part(y))))


def _closed_form(where: Any, formula: Callable[[Array], Array]) -> ClosedForm:
    check_function("`where`", where, "where(y)", "a part of the state")
    # The nearest state in the Euclidean metric.
    return ClosedForm(_OfPart(where, formula), metric=1.0)


def _check_square(x: Array) -> None:
    if x.ndim < 2 or x.shape[-1] != x.shape[-2]:
        raise ValueError(
            f"An array of shape {x.shape} is no square matrix. Name the part of the state that is "
            "one by `where`, such as `where=lambda y: y[0]`."
        )


def _normalised(x: Array, axis: int) -> Array:
    return x / jnp.sqrt(jnp.sum((x * jnp.conj(x)).real, axis=axis, keepdims=True))


def _dagger(x: Array) -> Array:
    return jnp.conj(jnp.swapaxes(x, -1, -2))


def _trace(x: Array) -> Array:
    return jnp.trace(x, axis1=-2, axis2=-1).real[..., None, None]


def _hermitian(x: Array) -> Array:
    return (x + _dagger(x)) / 2


_product = ft.partial(jnp.matmul, precision="highest")


@jax.custom_jvp
def _density_matrix(x: Matrices) -> Matrices:
    shifted, is_positive = _of_trace_one(x)
    return _where_positive(is_positive, shifted, lambda: _spectral(x)[0])


@_density_matrix.defjvp
def _density_matrix_jvp(primals: Any, tangents: Any) -> Any:
    (x,), (change,) = primals, tangents
    shifted, is_positive = _of_trace_one(x)
    change = _hermitian(change)
    # The trace stays one, by the same change of all eigenvalues.
    quick = shifted, change - _trace(change) / x.shape[-1] * jnp.eye(x.shape[-1], dtype=x.dtype)
    return _where_positive(is_positive, quick, lambda: _spectral_jvp(x, change))


def _of_trace_one(x: Matrices) -> tuple[Matrices, Bool[Array, "*batch"]]:
    """The Hermitian part, shifted by a multiple of one to the trace one, and whether all of its
    eigenvalues are above the bound. Then it is the nearest density matrix. An eigendecomposition
    takes many times as long as the test, a Cholesky decomposition."""
    _check_square(x)
    one = jnp.eye(x.shape[-1], dtype=x.dtype)
    x = _hermitian(x)
    x = x - (_trace(x) - 1) / x.shape[-1] * one
    above = jnp.linalg.cholesky(x - 2 * _least(x) * one, symmetrize_input=False)
    is_positive = jnp.all(jnp.isfinite(above), axis=(-2, -1))
    return _exactly(x), lax.stop_gradient(is_positive)


def _where_positive(is_positive: Bool[Array, "*batch"], quick: Any, slow: Callable[[], Any]) -> Any:
    """What is `quick`, and for the matrices with an eigenvalue below the bound what `slow()`
    returns, which is skipped if no matrix needs it."""

    def chosen() -> Any:
        where = lambda a, b: jnp.where(is_positive[..., None, None], a, b)  # noqa: E731
        return jtu.tree_map(where, quick, slow())

    return lax.cond(any_lane(~jnp.all(is_positive)), chosen, lambda: quick)


def _spectral_jvp(x: Matrices, t_x: Matrices) -> tuple[Array, Array]:
    """The derivative of a function of a Hermitian matrix (the theorem of Daleckii and Krein;
    Higham, Theorem 3.11): in the basis of its eigenvectors each element of the tangent is
    multiplied by the divided difference `(p_i - p_j) / (w_i - w_j)` of the eigenvalues before (`w`)
    and after (`p`).

    Here `p = max(w - μ, least)`. So the divided difference is one where both eigenvalues are above
    the bound, also where they coincide, and zero where neither is. At last `μ` changes such that
    the trace stays one, by the same amount for all eigenvalues above the bound.
    """
    y, v, w, p, positive = _spectral(x)
    change = _product(_dagger(v), _product(t_x, v))
    both = positive[..., :, None] & positive[..., None, :]
    mixed = positive[..., :, None] != positive[..., None, :]
    gap = jnp.where(mixed, w[..., :, None] - w[..., None, :], 1)
    gap = jnp.where(gap == 0, 1, gap)
    quotient = jnp.where(mixed, (p[..., :, None] - p[..., None, :]) / gap, both.astype(p.dtype))
    change = quotient * change
    share = positive / jnp.sum(positive, axis=-1, keepdims=True)
    change = change - _trace(change) * share[..., None, :] * jnp.eye(p.shape[-1], dtype=p.dtype)
    return y, _product(v, _product(change, _dagger(v)))


def _spectral(x: Matrices) -> tuple[Array, Array, Array, Array, Array]:
    """The density matrix; the eigenvectors; the eigenvalues before and after; and which of them are
    above the bound."""
    w, v = jnp.linalg.eigh(_hermitian(x), symmetrize_input=False)
    p, positive = _onto_simplex(w, _least(x))
    root = v * jnp.sqrt(p)[..., None, :]
    return _exactly(_product(root, _dagger(root))), v, w, p, positive


def _least(x: Matrices) -> float:
    """The least eigenvalue."""
    return 2 * x.shape[-1] * eps_of(x)


def _exactly(y: Matrices) -> Matrices:
    """The matrix, Hermitian and of trace one to roundoff, without that roundoff."""
    # The upper triangle is made from the lower one. Half the sum of the matrix and its adjoint
    # would be Hermitian too, but a compiler may round the two sums for a pair of elements
    # differently.
    lower = jnp.tril(y, -1)
    diagonal = jnp.diagonal(y, axis1=-2, axis2=-1).real
    # What rounding added to the trace is taken from the largest element of the diagonal, of which
    # it is the smallest share.
    largest = jnp.arange(y.shape[-1]) == jnp.argmax(diagonal, axis=-1)[..., None]
    excess = jnp.sum(diagonal, axis=-1, keepdims=True) - 1
    diagonal = diagonal - jnp.where(largest, excess, 0)
    return lower + _dagger(lower) + diagonal[..., None] * jnp.eye(y.shape[-1], dtype=y.dtype)


def _onto_simplex(w: Float[Array, "*batch n"], least: float) -> tuple[Array, Array]:
    """`max(w - μ, least)` with the sum one, for ascending `w`, and where it is above `least`.

    If the `k` largest are above the bound, `Σ_k w - k μ + (n - k) least = 1` determines `μ`. We
    compute it for every `k`, and take the largest `k` for which the `k`-th one is above the bound
    (Smolin, Gambetta and Smith).

    A shift of all eigenvalues shifts `μ` alike. So we measure them from the largest: those that
    stay above the bound are then between -1 and 0, and their sum is one to roundoff, however large
    the matrix was.
    """
    n = w.shape[-1]
    w = w - w[..., -1:]
    descending = w[..., ::-1]
    counts = jnp.arange(1, n + 1, dtype=w.dtype)
    mu = (jnp.cumsum(descending, axis=-1) - 1 + (n - counts) * least) / counts
    count = jnp.sum(descending - mu > least, axis=-1, keepdims=True)
    mu = jnp.take_along_axis(mu, jnp.maximum(count, 1) - 1, axis=-1)
    p = jnp.maximum(w - mu, least)
    return p, w - mu > least


@jax.custom_jvp
def _rotation_matrix(x: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    return _polar(x)[0]


@_rotation_matrix.defjvp
def _rotation_matrix_jvp(primals: Any, tangents: Any) -> Any:
    """`U ((W - Wᵀ) / (s_i + s_j)) Vᵀ` with `W = Uᵀ ẋ V`.

    This follows from the polar decomposition `x = R P`, where `P` is symmetric and `Rᵀ Ṙ`
    antisymmetric: the antisymmetric part of `Rᵀ ẋ = Rᵀ Ṙ P + Ṗ` has no `Ṗ`, and is solved for
    `Rᵀ Ṙ` in the basis of the eigenvectors of `P`.
    """
    y, u, s, vt = _polar(primals[0])
    w = _product(_dagger(u), _product(tangents[0], _dagger(vt)))
    sums = s[..., :, None] + s[..., None, :]
    # On the diagonal the difference is zero, whatever it is divided by.
    sums = jnp.where(jnp.eye(s.shape[-1], dtype=bool), 1, sums)
    return y, _product(u, _product((w - _dagger(w)) / sums, vt))


def _polar(x: Float[Array, "*batch n n"]) -> tuple[Array, Array, Array, Array]:
    """The rotation `U Vᵀ`, and the singular value decomposition `x = U diag(s) Vᵀ`. The last
    singular value and the last left vector have a sign, such that the determinant of `U Vᵀ` is
    one."""
    _check_square(x)
    if jnp.issubdtype(x.dtype, jnp.complexfloating):
        raise TypeError("A rotation matrix is real, but that of the state is complex.")
    u, s, vt = jnp.linalg.svd(x)
    sign = jnp.sign(jnp.linalg.det(_product(u, vt)))[..., None]
    signs = jnp.concatenate([jnp.ones_like(s[..., 1:]), sign], axis=-1)
    u, s = u * signs[..., None, :], s * signs
    y = _product(u, vt)
    # One step of the iteration of Newton and Schulz (Higham, 8.3) removes most of the roundoff of
    # the decomposition.
    y = y + _product(y, jnp.eye(s.shape[-1], dtype=s.dtype) - _product(_dagger(y), y)) / 2
    return y, u, s, vt
