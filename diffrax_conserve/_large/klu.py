"""Linear systems with a sparse matrix, by KLU, and the Jacobians that give their values.

KLU (T. A. Davis and E. Palamadai Natarajan, *Algorithm 907: KLU, a direct sparse solver for circuit
simulation problems*, ACM Trans. Math. Softw. 37, 2010) orders the places of a matrix once, which is
done while a solve is traced. A solve inside of `jit` then factors the values, and keeps no factor:
nothing has to be freed, and lanes and threads do not disturb each other. Where several systems have
the same matrix, as in a step of `Radau`, a `Factor` is kept from the first to the last of them.

KLU works on a CPU, with float64 and complex128. A pivot that is exactly zero raises an error that
ends the program, so a matrix is tested before; see `Places.is_regular`.
"""

import functools as ft
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array, Bool, Float, Shaped

from .._constants import DENSE_ROW_RATIO, TOLERANCE_IN_EPS
from .._memory import Memory
from .._tree import eps_of, irregular_weights
from .detection import NotSparse, coloured, constants_of, content_key, jacobian_places

# A perturbation in the imaginary part of a real matrix. Its square is below the roundoff of any
# element, so that it changes no real part.
_TINY = 1e-20


_LOCK = threading.Lock()


@ft.cache
def klujax() -> Any:
    """The package. Whatever its import raises is raised.

    The import changes two settings of JAX for the whole process, which are put back.
    """
    names = "jax_enable_x64", "jax_platform_name"
    with _LOCK:
        before = {name: jax.config.read(name) for name in names}
        try:
            import klujax
        finally:
            for name, value in before.items():
                jax.config.update(name, value)
    return klujax


def available(dtype: Any) -> bool:
    """Whether numbers of this dtype are solved for by KLU here."""
    on_cpu = jnp.dtype(dtype) == jnp.float64 and jax.default_backend() == "cpu"
    return on_cpu and not why_not()


@ft.cache
def why_not() -> str:
    """Why the package cannot be imported, and what to do; empty if it can be."""
    try:
        klujax()
    except Exception as error:  # missing, or made for another version of jax
        return (
            f"the package for sparse ones cannot be imported ({type(error).__name__}: {error}): "
            "`pip install 'diffrax-conserve[sparse]'`."
        )
    return ""


class Places:
    """The places in which a square matrix has elements, in the order of its columns, and of rows
    within a column. The values of a matrix are an array in this order."""

    def __init__(self, rows: Any, columns: Any, size: int):
        numbers = np.asarray(columns, np.int64) * size + np.asarray(rows, np.int64)
        numbers = np.sort(numbers)  # `numpy.unique` can take fifty times as long
        self.size, self.numbers = size, numbers[np.diff(numbers, prepend=-1) > 0]
        self.rows = (self.numbers % size).astype(np.int32)
        self.columns = (self.numbers // size).astype(np.int32)
        self._key = size, self.numbers.tobytes()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Places) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def index(self, rows: Any, columns: Any) -> np.ndarray:
        """The positions of elements among the values; past the end for those without a place."""
        wanted = np.asarray(columns, np.int64) * self.size + np.asarray(rows, np.int64)
        found = np.minimum(np.searchsorted(self.numbers, wanted), len(self.numbers) - 1)
        return np.where(self.numbers[found] == wanted, found, len(self.numbers))

    def matvec(self, values: Shaped[Array, " k"], x: Shaped[Array, " n"]) -> Shaped[Array, " n"]:
        return jax.ops.segment_sum(values * x[self.columns], self.rows, self.size)

    def solve(self, values: Shaped[Array, " k"], b: Shaped[Array, " n"]) -> Shaped[Array, " n"]:
        """`A⁻¹ b`; NaN if the matrix is singular to roundoff, or not finite."""
        values = jnp.where(self.is_regular(values), values, jnp.nan)
        return self.solve_regular(values, b)

    def solve_regular(
        self, values: Shaped[Array, " k"], b: Shaped[Array, " n"]
    ) -> Shaped[Array, " n"]:
        """`A⁻¹ b`, of a matrix that is known to be regular, or has values that are NaN."""
        dtype = jnp.result_type(values, b)
        if self.permutation is None:
            return jnp.full(b.shape, jnp.nan, dtype)
        values, b = values.astype(dtype), b.astype(dtype)
        return lax.custom_linear_solve(
            lambda x: self.matvec(values, x),
            b,
            lambda _, b: self._klu("solve_with_symbol", values, b),
            lambda _, b: self._klu("tsolve_with_symbol", values, b),
        )

    def is_regular(self, values: Shaped[Array, " k"]) -> Bool[Array, ""]:
        """Whether a matrix is regular, to roundoff, in units of its rows and columns in which the
        largest elements are one.

        A vector in general position is solved for. To see exact zeros among the pivots, each
        element has a tiny imaginary part in general position: where real parts cancel exactly, the
        imaginary parts do not, and the pivot is tiny, but not zero. The real parts are the same.
        """
        if self.permutation is None:
            return jnp.asarray(False)
        values = lax.stop_gradient(values)
        if jnp.iscomplexobj(values):
            real, imag = values.real, values.imag
            parts = jnp.concatenate([real, -imag, imag, real])
            return self._real_form[0].is_regular(parts[self._real_form[1]])
        scaled, _, _, b = self.in_general_position(values)
        return is_bounded(self._klu("solve_with_symbol", scaled, b))

    def in_general_position(self, values: Float[Array, " k"]) -> tuple[Array, ...]:
        """A real matrix with the tiny imaginary parts, in the units of its rows and columns; the
        units; and the vector in general position."""
        sizes = jnp.abs(values)
        heights = jax.ops.segment_max(sizes, self.rows, self.size)
        heights = jnp.where(heights == 0, 1, heights)
        scaled = values / heights[self.rows]
        widths = jax.ops.segment_max(jnp.abs(scaled), self.columns, self.size)
        widths = jnp.where(widths == 0, 1, widths)
        pattern = irregular_weights(len(self.numbers) + self.size, values.dtype)
        shift, b = jnp.split(jnp.asarray(pattern), [len(self.numbers)])
        scaled = scaled / widths[self.columns] + _TINY * 1j * shift
        return scaled, heights, widths, b.astype(scaled.dtype)

    def finite(self, values: Array) -> tuple[Array, Bool[Array, ""]]:
        """The values, and whether all are finite. With a matrix that is not finite KLU may find no
        pivot, so it gets a permutation instead."""
        finite = jnp.all(jnp.isfinite(values))
        return jnp.where(finite, values, jnp.asarray(self.permutation, values.dtype)), finite

    def _klu(self, name: str, values: Array, b: Array) -> Array:
        """Calls KLU; `b` may have several columns. The primitives are bound themselves, because the
        functions of klujax sort the places in each program anew."""
        values, finite = self.finite(values)
        kind = "c128" if jnp.iscomplexobj(values) else "f64"
        call = getattr(klujax(), f"{name}_{kind}").bind
        where = jnp.asarray(self.rows), jnp.asarray(self.columns)
        columns = b.reshape(1, self.size, -1)
        x = call(*where, values[None], columns, self.symbol).reshape(b.shape)
        return jnp.where(finite, x, jnp.nan)

    @property
    def symbol(self) -> Array:
        return jnp.asarray(_analyzed(self).raw, jnp.uint64)

    @ft.cached_property
    def permutation(self) -> np.ndarray | None:
        """The values of a matrix that is a permutation; `None` if every matrix with these places is
        singular."""
        ones = np.ones(len(self.numbers), np.int8)
        matrix = sp.csr_matrix((ones, (self.rows, self.columns)), (self.size, self.size))
        columns = sp.csgraph.maximum_bipartite_matching(matrix, perm_type="column")
        if np.any(columns < 0):
            return None
        return (columns[self.rows] == self.columns).astype(float)

    @ft.cached_property
    def _real_form(self) -> tuple["Places", np.ndarray]:
        """The places of a complex matrix as a real one of twice the size, and the order of its
        values."""
        n, rows, columns = self.size, self.rows, self.columns
        rows = np.concatenate([rows, rows, rows + n, rows + n])
        columns = np.concatenate([columns, columns + n, columns, columns + n])
        return Places(rows, columns, 2 * n), np.lexsort((rows, columns))


# The orders in which KLU eliminates. Compiled programs contain their addresses, so all are kept.
_ANALYZED: dict[Places, Any] = {}


def _analyzed(places: Places) -> Any:
    package = klujax()
    with _LOCK:  # another thread must not replace what a program contains
        if places not in _ANALYZED:
            with jax.ensure_compile_time_eval():
                found = package.analyze(places.rows, places.columns, places.size)
            _ANALYZED[places] = found
        return _ANALYZED[places]


def is_bounded(x: Array) -> Bool[Array, ""]:
    """Whether a solution shows that a matrix is regular to roundoff."""
    return jnp.all(jnp.abs(x) < 1 / (TOLERANCE_IN_EPS * eps_of(x)))


# ---- Factors that are kept ----


class Factor:
    """The factor of a complex matrix, kept until it is `freed`.

    What a program holds is the address of the factor, of which JAX and XLA know nothing. So these
    rules must hold:

    - For XLA the calls that factor and free have side effects, so that it neither moves them out of
      a loop nor merges two that are equal. For JAX they are pure, so that a reverse pass may
      compute them again. What `freed` returns depends on all of them, so it computes all.
    - A factor has one work space, so that two solves must not overlap: each right-hand side depends
      on the solution before it.
    - An address that the lanes of a batch share is freed once.
    - No loop carries an address, and nothing that contains one is differentiated: it stays inside
      of an iteration whose derivative is by the implicit function theorem.
    """

    def __init__(self, places: Places, values: Shaped[Array, " k"]):
        values, self._finite = places.finite(values.astype(complex))
        where = jnp.asarray(places.rows), jnp.asarray(places.columns)
        self._places = places
        self._address = _kept().factor.bind(*where, values[None], places.symbol)

    def solve(self, b: Shaped[Array, " n"], after: Any = None) -> Shaped[Array, " n"]:
        """`A⁻¹ b`; NaN if the matrix is not finite. If `b` need not depend on the solution before
        it, that, or a flag that depends on it, is passed as `after`: the result is NaN if `after`
        is false or not finite."""
        if after is not None:
            flag = after if after.dtype == bool else jnp.all(jnp.isfinite(after))
            b = jnp.where(flag, b, jnp.nan)
        call = klujax().solve_with_numeric_c128.bind
        x = call(self._places.symbol, self._address, b.astype(complex)[None, :, None])
        return jnp.where(self._finite, x.reshape(b.shape), jnp.nan)

    def freed(self, last: Array, *results: Array) -> tuple[Array, ...]:
        """The results, after the factor is freed, which is after the `last` solution is known."""
        # No number is larger than infinity, but XLA does not use that.
        never = jnp.any(last > jnp.inf).astype(jnp.uint64)
        done = _kept().free.bind(self._address, never) == 1
        return tuple(jnp.where(done, x, jnp.nan) for x in results)


class RealFactor:
    """The factor of a real matrix with the tiny imaginary parts, in units of its rows and columns,
    which tells whether the matrix is regular too. Solutions are NaN if it is not."""

    def __init__(self, places: Places, values: Float[Array, " k"]):
        self._factor, self.is_regular = None, jnp.asarray(False)
        if places.permutation is not None:
            scaled, self._heights, self._widths, b = places.in_general_position(values)
            self._factor = Factor(places, scaled)
            self.is_regular = is_bounded(self._factor.solve(b))

    def solve(self, b: Float[Array, " n"], after: Any = None) -> Float[Array, " n"]:
        if self._factor is None:
            return jnp.full_like(b, jnp.nan)
        after = self.is_regular if after is None else after
        return self._factor.solve(b / self._heights, after).real / self._widths

    def freed(self, last: Array, *results: Array) -> tuple[Array, ...]:
        return results if self._factor is None else self._factor.freed(last, *results)


class _Calls(NamedTuple):
    factor: Primitive
    free: Primitive


_FREE = "conserve_klu_free"
_KEPT: list[_Calls] = []


def _kept() -> _Calls:
    klujax()  # which takes the lock too
    with _LOCK:
        if not _KEPT:
            _KEPT.append(_calls())
        return _KEPT[0]


def _calls() -> _Calls:
    """The calls that factor and free, alone and in lanes."""
    free_numeric = klujax().klujax_cpp.free_numeric()  # there is no public call inside of `jit`
    jax.ffi.register_ffi_target(_FREE, free_numeric, platform="cpu")
    factor, free = Primitive("conserve_klu_factor"), Primitive(_FREE)

    def free_late(address: Array, never: Array) -> Array:
        done = jax.ShapeDtypeStruct((), jnp.int32)
        return jax.ffi.ffi_call(_FREE, done, has_side_effect=True)(address + never)

    def factor_lanes(given: Any, axes: Any) -> tuple[Array, int]:
        rows, columns, values, symbol = given
        values = jnp.moveaxis(values, axes[2], 0)
        found = factor.bind(rows, columns, values.reshape(-1, values.shape[-1]), symbol)
        return found.reshape(values.shape[:2]), 0

    def free_lanes(given: Any, axes: Any) -> tuple[Array, None]:
        address, never = given
        return free.bind(address.reshape(-1), never if axes[1] is None else jnp.max(never)), None

    factor.def_abstract_eval(lambda *given: ShapedArray(given[2].shape[:1], jnp.uint64))
    free.def_abstract_eval(lambda *given: ShapedArray((), jnp.int32))
    batching.primitive_batchers[factor] = factor_lanes
    batching.primitive_batchers[free] = free_lanes
    lowering = jax.ffi.ffi_lowering("factor_c128", has_side_effect=True)
    mlir.register_lowering(factor, lowering, platform="cpu")
    mlir.register_lowering(free, mlir.lower_fun(free_late, multiple_results=False), platform="cpu")
    for one in (factor, free):
        one.def_impl(jax.jit(one.bind))
    return _Calls(factor, free)


class SparseJacobian:
    """The places of the elements of a Jacobian that can differ from zero, in the order of `Places`,
    and how they are computed.

    Columns of the same colour share no row, so that one forward pass with the sum of their seeds
    computes all of them (Curtis, Powell and Reid, 1974). A few dense rows would leave no two
    columns with the same colour. So each of them is computed by a reverse pass.

    - `rows`, `columns`: the places.
    - `num_passes`: the numbers of forward and of reverse passes.
    """

    def __init__(self, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]):
        self.shape, order = shape, np.lexsort((rows, columns))
        self.rows, self.columns = rows[order].astype(np.int64), columns[order].astype(np.int64)

    @property
    def num_passes(self) -> tuple[int, int]:
        return self._passes[1], len(self.dense_rows)

    @property
    def dense_rows(self) -> np.ndarray:
        return self._passes[2]

    @ft.cached_property
    def _passes(self) -> tuple[np.ndarray, int, np.ndarray, np.ndarray]:
        """The colours of the columns, and their number; the dense rows; and where each element is
        among the results of all passes. Not all places that are found are differentiated."""
        rows, columns, shape = self.rows, self.columns, self.shape
        counts = np.bincount(rows, minlength=shape[0])
        # There are at least as many colours as elements in a row, and few rows take fewer passes.
        widest = np.max(counts, initial=0)
        dense = (counts > DENSE_ROW_RATIO * max(1, np.median(counts))) | (widest > shape[0])
        few = ~dense[rows]
        colours, number = coloured(columns[few], rows[few], shape[1])
        by_colour = colours[columns] * shape[0] + rows
        by_row = number * shape[0] + (np.cumsum(dense) - 1)[rows] * shape[1] + columns
        return colours, number, np.flatnonzero(dense), np.where(few, by_colour, by_row)

    def values(self, fn: Callable[[Array], Array], x: Float[Array, " n"]) -> Float[Array, " k"]:
        """The values of the elements, in the order of the places."""
        colours, number, dense_rows, taken = self._passes
        seeds, dense = jnp.asarray(np.arange(number)[:, None] == colours, x.dtype), len(dense_rows)
        passes = [jax.vmap(lambda seed: jax.jvp(fn, (x,), (seed,))[1])(seeds).reshape(-1)]
        if dense:
            vjp = jax.vjp(fn, x)[1]
            rows = jnp.zeros((dense, jax.eval_shape(fn, x).size), x.dtype)
            rows = rows.at[np.arange(dense), dense_rows].set(1)
            passes.append(jax.vmap(lambda row: vjp(row)[0])(rows).reshape(-1))
        return jnp.concatenate(passes)[taken]


def sparse_jacobian(fn: Callable[[Array], Array], x: Any) -> SparseJacobian | None:
    """The places of the Jacobian of a function of a vector like `x`; `None` if they cannot be
    found. Constants of the function that JAX traces may have any values."""
    traced = jax.make_jaxpr(fn)(jax.ShapeDtypeStruct(x.shape, x.dtype))

    def found() -> SparseJacobian | None:
        with jax.ensure_compile_time_eval():
            try:
                rows, columns = jacobian_places(traced)
            except NotSparse:
                return None
        return SparseJacobian(rows, columns, (traced.out_avals[0].shape[0], x.shape[0]))

    return _KNOWN((str(traced.jaxpr), *map(content_key, constants_of(traced))), found)


# The Jacobians that were found, by their functions.
_KNOWN = Memory()
