"""First integrals of a vector field, found as combinations of basis functions.

The derivatives of the functions along the field, at many states, are the columns of a matrix. A
combination is conserved if its coefficients are in the null space. The rest of this file makes that
reliable: rows and columns are scaled, roundoff is compared with the sizes of terms, the null space
is brought into a simple form, and each result is verified at other states.
"""

import itertools
import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from typing import Any, final

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray, Real

from .._custom_types import Args, RealScalarLike
from .._manifold import FirstIntegral, check_vector_field, slope_of
from .._options import check_counts, check_function, one_of
from .._tree import eps_of, ravel, real_view, tree_size, unravel
from .check_invariance import LATER, batch

try:
    from jax import enable_x64 as _enable_x64
except ImportError:  # before version 0.8
    from jax.experimental import enable_x64 as _enable_x64  # pyright: ignore

# A combination counts as conserved if its derivative is at most this many units of roundoff of the
# terms that cancel in it. True integrals have 0.1 to 0.7 of them.
_ROUNDOFF = 16
# The next singular value must be larger by this factor. The inverse of the ratio is the error of
# the coefficients: with a thousand they have three digits, of which the simplification finds the
# rest.
_GAP = 1e3
# The errors of coefficients that are tried, as shares of the largest term. With each the
# coefficients are rounded to simple numbers, and the combination must then still be conserved.
_SHARES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)
# A simple number is a decimal of at most so many digits, or a fraction with at most this
# denominator.
_DIGITS, _DENOMINATOR = 6, 12
# If a function varies by less than this share of its terms, it counts as constant. This and the
# next two are choices between roundoff, 1e-16, and the smallest effects that matter.
_ZERO = 1e-9
# An element smaller than this is no pivot of the reduced echelon form.
_PIVOT = 1e-8
# A combination counts as a polynomial of others if at most this share of it is left over.
_DEPENDENT = 1e-7
# The scales of rows and of columns depend on each other. They settle after three rounds.
_ROUNDS = 3
# A sampler is called for this many states at least, and for four for each function.
_LEAST_STATES = 100
# To find components that rest at all states but not elsewhere, each is moved by its largest value
# divided by this number.
_BESIDE = 10


def find_invariants(
    vector_field: Callable[[RealScalarLike, Any, Args], Any],
    states: Any,
    *,
    basis: int | Mapping[str, Callable[[Any], Any]] = 2,
    t: Real[ArrayLike, "*states"] = 0.0,
    args: Args = None,
    key: PRNGKeyArray | None = None,
    num_states: int | None = None,
) -> dict[str, FirstIntegral]:
    r"""Finds the first integrals $I = \sum_j c_j \varphi_j$ of a vector field in a basis.

    $I$ is conserved if $\sum_j c_j\, (\nabla \varphi_j \cdot f)(t_i, y_i) = 0$ at every state
    $y_i$, so the coefficients are a null space. It is computed by singular values from one half of
    the states. Each singular value is the size of a derivative $\nabla I \cdot f$ relative to its
    terms $\partial_k I\, f_k$, which does not depend on the units of states, time and functions. A
    null space needs a gap: singular values at roundoff, and the next one a thousand times as large.
    Each integral is then verified on the other half.

    Left out are constants, and what is a polynomial of the others, such as the square of an energy.
    What depends on the others in another way stays: of Kepler's problem in its plane both
    components of the Laplace-Runge-Lenz vector are found, though energy, angular momentum and one
    component determine the other up to its sign. A projection may keep them all.

    **Arguments:**

    - `vector_field`: $f$, called as `vector_field(t, y, args)`, or a `diffrax.ODETerm` of it.
    - `states`: a sampler `key -> y` such as `system.sample`, or a PyTree like `y` with a leading
        axis over the states, at least two for each function of the basis. They must be in general
        position, and not of one trajectory. If all are on a manifold, such as that of a constraint,
        what is conserved there is found, without what has the same value at all states.
    - `basis`: a dictionary from names to functions `fn(y)` that return a real number, or a degree:
        all products of so many components of the state, or fewer.
    - `t`: the time, or one for each state, as a field that depends on time needs it.
    - `args`: passed to `vector_field`.
    - `key`, `num_states`: the seed (default: `jax.random.key(0)`) and the number of sampled states.
        Default: four for each function of the basis, and at least 100.

    **Returns:**

    A dictionary from formulas to [`diffrax_conserve.FirstIntegral`][]s, scaled so that the largest
    coefficient is one. It is a manifold for [`diffrax_conserve.ManifoldProjection`][], empty if
    nothing in the basis is conserved. Everything is computed in float64, also if JAX has it
    disabled.

    **Raises:**

    `ValueError` if there are too few states, all with the same values of what is conserved, or one
    time for a field that depends on it; if the field or a function is not finite at a state, or a
    function does not return a real number. `TypeError` if `basis` is neither a degree nor a
    dictionary.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import jax.numpy as jnp

        basis = {"v^2": lambda y: y["v"] ** 2, "cos(q)": lambda y: jnp.cos(y["q"])}
        pendulum = lambda t, y, args: {"q": y["v"], "v": -jnp.sin(y["q"])}
        states = {"q": jnp.linspace(-2.0, 3.0, 20), "v": jnp.linspace(-1.0, 1.0, 20) ** 3}
        print(list(dfc.find_invariants(pendulum, states, basis=basis)))
        ```

        ```text
        ['0.5 v^2 - cos(q)']
        ```

    ??? cite "Reference"

        Kaiser, Kutz and Brunton, "Discovering conservation laws from data for control", *IEEE
        Conference on Decision and Control* (2018), 6415-6421, for the null space.
    """
    if isinstance(vector_field, dfx.ODETerm):
        vector_field = vector_field.vector_field
    check_vector_field(vector_field)
    _check_basis(basis)
    with _enable_x64(True):
        if callable(states):
            like = eqx.filter_eval_shape(states, jr.key(0))
            size = len(_names(basis, like))
            num_states = max(_LEAST_STATES, 4 * size) if num_states is None else num_states
            check_counts(num_states=num_states)
        key = jr.key(0) if key is None else key
        ts, ys = batch(t, states, key, 0 if num_states is None else num_states)
        ts, ys = jtu.tree_map(lambda x: x.astype(jnp.promote_types(x.dtype, jnp.float64)), (ts, ys))
        like = _one(ys)
        names, functions = _names(basis, like), _functions(basis, like)
        if ts.size < 2 * len(names):
            raise ValueError(
                f"`states` holds {ts.size} states, but a basis of {len(names)} functions needs at "
                f"least {2 * len(names)}: one half to find combinations, one to verify them. Give "
                "more states, or a smaller `basis`."
            )
        with one_of(ys):
            samples = _sampled(functions, vector_field, ts, ys, args, names)
    _check_position(samples, names)
    found = _independent(samples, _combinations(samples))
    return {_formula(c, names): FirstIntegral(_combination(c, functions)) for c in found}


def _one(ys: Any) -> Any:
    return jtu.tree_map(lambda y: y[0], ys)


class _Products(eqx.Module):
    """Products of components of the state, each given by the indices of its factors. All have the
    same number of factors: the index past the end of the state, which means 1, fills them up."""

    factors: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    def __call__(self, y: Any) -> Float[Array, " functions"]:
        x = ravel(y)
        columns = jnp.append(x, jnp.ones((), x.dtype))[np.array(self.factors).T]
        value = columns[0]
        for column in columns[1:]:
            value = value * column
        return value

    def part(self, kept: np.ndarray) -> "_Products":
        return _Products(tuple(self.factors[j] for j in kept))


class _Given(eqx.Module):
    """The functions of the user."""

    functions: tuple[Callable[[Any], Any], ...]

    def __call__(self, y: Any) -> Float[Array, " functions"]:
        return jnp.stack([jnp.asarray(fn(y)) for fn in self.functions])

    def part(self, kept: np.ndarray) -> "_Given":
        return _Given(tuple(self.functions[j] for j in kept))


@final
class _Combination(eqx.Module):
    """A sum of functions times coefficients."""

    coefficients: tuple[float, ...] = eqx.field(static=True)
    functions: _Products | _Given

    def __call__(self, t: RealScalarLike, y: Any, args: Args) -> Float[Array, ""]:
        del t, args
        values = self.functions(y)
        return jnp.sum(jnp.asarray(self.coefficients, values.dtype) * values)


def _combination(c: np.ndarray, functions: _Products | _Given) -> _Combination:
    kept = np.flatnonzero(c)
    return _Combination(tuple(c[kept].tolist()), functions.part(kept))


def _check_basis(basis: Any) -> None:
    if not isinstance(basis, Mapping):
        if not isinstance(basis, int | np.integer) or isinstance(basis, bool):
            raise TypeError(
                f"`basis` is {basis!r}. Give the degree of polynomials, such as `basis=3`, or a "
                "dictionary of functions, such as `{'cos(q)': lambda y: jnp.cos(y[0])}`."
            )
        check_counts(basis=basis)
    elif not basis:
        raise ValueError("`basis` is empty: there is nothing to combine.")
    else:
        for name, fn in basis.items():
            check_function(f"`{name}` of `basis`", fn, "fn(y)", "a real number")


def _names(basis: Any, like: Any) -> list[str]:
    if isinstance(basis, Mapping):
        return [str(name) for name in basis]
    components = _components(like)
    return [_product([components[i] for i in x]) for x in _factors(basis, len(components))]


def _functions(basis: Any, like: Any) -> _Products | _Given:
    if not isinstance(basis, Mapping):
        size = tree_size(jax.eval_shape(real_view, like))
        padded = [x + (size,) * (basis - len(x)) for x in _factors(basis, size)]
        return _Products(tuple(padded))
    for name, fn in basis.items():
        value = eqx.filter_eval_shape(lambda y, fn=fn: jnp.asarray(fn(y)), like)
        if value.shape != () or not jnp.issubdtype(value.dtype, jnp.floating):
            raise ValueError(
                f"`{name}` of `basis` returns {value.dtype}{list(value.shape)}, but it must "
                "return one real floating-point number."
            )
    return _Given(tuple(basis.values()))


def _factors(degree: int, size: int) -> list[tuple[int, ...]]:
    choose = itertools.combinations_with_replacement
    return [x for d in range(1, degree + 1) for x in choose(range(size), d)]


def _components(like: Any) -> list[str]:
    """The names of the components in the order of `ravel`, such as `q[0]` or `y[1]`."""
    names = []
    for path, leaf in jtu.tree_flatten_with_path(like)[0]:
        named = path and not isinstance(path[0], jtu.SequenceKey)
        root = str(getattr(path[0], "key", getattr(path[0], "name", ""))) if named else "y"
        root += jtu.keystr(path[1:] if named else path)
        places = [f"{list(i)}".replace(" ", "") if i else "" for i in np.ndindex(leaf.shape)]
        parts = ("Re ", "Im ") if jnp.issubdtype(leaf.dtype, jnp.complexfloating) else ("",)
        names += [part + root + place for part in parts for place in places]
    return names


def _product(components: list[str]) -> str:
    counts = {name: components.count(name) for name in dict.fromkeys(components)}
    return " ".join(name + (f"^{n}" if n > 1 else "") for name, n in counts.items())


def _formula(c: np.ndarray, names: list[str]) -> str:
    """Such as `0.5 v^2 - cos(q)`."""
    parts = []
    for j in np.flatnonzero(c):
        number = f"{abs(c[j]):.6g} ".removeprefix("1 ")
        parts.append(f"{'-' if c[j] < 0 else '+'} {number}{names[j]}")
    return " ".join(parts).removeprefix("+ ")


class _Samples:
    """What is known of the functions at the states.

    The rows, one for each state, and the columns, one for each function, are scaled such that the
    largest terms are one. So the units of states, time and functions do not matter.

    - `values`, of shape `(states, functions)`: their values.
    - `gradients`, `terms`, of shape `(states, components, functions)`: their derivatives, and the
      terms of the `derivatives` along the field, of shape `(states, functions)`.
    - `size`: the scale of each function by which it was divided.
    - `eps`: the unit of roundoff of the field.
    """

    def __init__(self, values: np.ndarray, gradients: np.ndarray, slopes: np.ndarray, eps: float):
        terms = gradients * slopes[:, :, None]
        total = np.abs(terms).sum(axis=1)
        rows, still = np.ones(len(total)), total.max(axis=0) == 0
        size = np.abs(values).max(axis=0)
        for _ in range(_ROUNDS):
            size = np.where(still, size, (total / rows[:, None]).max(axis=0))
            size = np.where(size > 0, size, 1.0)
            rows = (total / size).max(axis=1)
            rows = np.where(rows > 0, rows, 1.0)
        self.size, self.eps = size, eps
        self.values, self.gradients = values / size, gradients / size
        self.terms = terms / size / rows[:, None, None]
        self.derivatives, self.totals = self.terms.sum(axis=1), total / size / rows[:, None]

    def resolution(self, sizes: np.ndarray) -> float:
        """The singular value below which there is only roundoff."""
        return float(np.max(sizes) * self.terms.size**0.5 * np.finfo(float).eps)

    def has_gradient(self, c: np.ndarray) -> bool:
        """Whether the gradient of a combination is not zero at some state."""
        size = np.abs(self.gradients) @ np.abs(c)
        return bool(np.any(np.abs(self.gradients @ c) > _ZERO * size.max()))

    def defect(self, c: np.ndarray, states: slice) -> float:
        """The derivative of a combination, in units of roundoff of its terms."""
        terms = self.eps * float(np.linalg.norm(self.totals[states] @ np.abs(c)))
        return float(np.linalg.norm(self.derivatives[states] @ c)) / (terms or 1.0)

    def refined(self, c: np.ndarray) -> np.ndarray:
        """The conserved combination of the same functions that is nearest, if there is one.

        Where another combination is nearly conserved, a share of it in this one is not seen in the
        derivative. So what is left without the terms of the other has coefficients with errors.
        """
        kept = np.flatnonzero(c)
        derivatives, totals = (x[_FIRST][:, kept] for x in (self.derivatives, self.totals))
        _, sizes, basis = np.linalg.svd(derivatives, full_matrices=False)
        roundoff = np.linalg.norm(totals @ np.abs(basis.T), axis=0) * self.eps
        conserved = basis[sizes <= _ROUNDOFF * roundoff]
        if not len(conserved):
            return c
        out = np.zeros_like(c)
        out[kept] = conserved.T @ (conserved @ c[kept])
        return out


# The halves of the states, interleaved because they may be in some order.
_FIRST, _SECOND, _ALL = slice(0, None, 2), slice(1, None, 2), slice(None)


def _sampled(
    functions: Any, vector_field: Callable, ts: Array, ys: Any, args: Args, names: list[str]
) -> _Samples:
    @eqx.filter_jit
    @jax.vmap
    def residuals_and_scales(t: Array, y: Any) -> tuple[Array, Array, Array]:
        at = lambda x: functions(unravel(x, y))  # noqa: E731
        slope = ravel(slope_of(vector_field, t, y, args))
        return at(ravel(y)), jax.jacfwd(at)(ravel(y)).T, slope

    values, gradients, slopes = map(np.asarray, residuals_and_scales(ts, ys))
    measured = {name: (values[:, j], gradients[:, :, j]) for j, name in enumerate(names)}
    for name, xs in {"vector_field": (slopes,), **measured}.items():
        finite = np.all([np.isfinite(x).reshape(len(ts), -1).all(axis=1) for x in xs], axis=0)
        if not finite.all():
            raise ValueError(
                f"`{name}`, or its derivative, is not finite at state {np.argmin(finite)} of "
                "`states`. Give states inside its domain."
            )
    if np.all(ts == ts[0]) and np.any(
        np.asarray(residuals_and_scales(ts + LATER, ys)[2]) != slopes
    ):
        raise ValueError(
            "`vector_field` depends on time, but `t` is one time, at which something may be "
            "conserved that is not at others. Give one time for each state, such as "
            "`t=jnp.linspace(0, 10, num_states)`."
        )
    x = np.asarray(jax.vmap(ravel)(ys))
    largest = np.abs(x).max(axis=0)
    apart = np.where(largest > 0, largest, largest.max()) / _BESIDE
    beside = x + apart * np.sin(np.arange(x.size)).reshape(x.shape)
    moved = np.asarray(residuals_and_scales(ts, jax.vmap(unravel)(beside, ys))[2])
    idle = (slopes == 0).all(axis=0) & (np.isfinite(moved) & (moved != 0)).any(axis=0)
    if idle.any():
        raise ValueError(
            f"The component `{_components(_one(ys))[np.argmax(idle)]}` of the state moves, but at "
            "none of `states`, so they are not in general position. Let every component vary."
        )
    slope = eqx.filter_eval_shape(vector_field, ts[0], _one(ys), args)
    eps = max(eps_of(jnp.result_type(float, x)) for x in jtu.tree_leaves(slope))
    return _Samples(values, gradients, slopes, eps)


def _combinations(samples: _Samples) -> list[np.ndarray]:
    """The conserved combinations of the scaled functions, with few terms and simple numbers."""
    terms = samples.terms[_FIRST]
    terms = terms.reshape(-1, terms.shape[2])
    _, sizes, basis = np.linalg.svd(terms, full_matrices=False)
    moves = sizes > samples.resolution(sizes)
    # The first singular value decomposition is that of the terms. Combinations of which no term is
    # left, such as of components that do not move, are conserved. The others are scaled such that
    # their terms have size one. So the singular values of their derivatives tell what cancels.
    still, moving = basis[~moves], basis[moves] / sizes[moves, None]
    _, sizes, turn = np.linalg.svd(samples.derivatives[_FIRST] @ moving.T, full_matrices=False)
    sizes, moving = sizes[::-1], (turn @ moving)[::-1]
    roundoff = np.linalg.norm(samples.totals[_FIRST] @ np.abs(moving.T), axis=0) * samples.eps
    # In ascending order, the first singular values that are roundoff belong to conserved
    # combinations. If there is no gap to the next one, fewer do: we go back to the last gap.
    count = int(np.sum(np.cumprod(sizes <= _ROUNDOFF * roundoff)))
    largest = np.maximum.accumulate(np.maximum(sizes, roundoff))
    first = count
    while 0 < count < len(sizes) and sizes[count] < _GAP * largest[count - 1]:
        count -= 1
    if count < first:
        warnings.warn(
            f"{first - count} combinations seem to be conserved, but cannot be told from others of "
            f"which the derivatives are {sizes[first] / largest[first - 1]:.0f} times as large as "
            "roundoff. They are left out. Give states of which the components vary more, such as "
            "over several powers of ten.",
            stacklevel=3,
        )
    orthogonal = np.linalg.qr(np.concatenate([still, moving[:count]]).T)[0].T
    found = _simplified(samples, _reduced(orthogonal))
    # The first pivots were chosen among elements with errors. Now that the coefficients are exact,
    # the echelon form is made once more.
    exact = np.array([c * samples.size for c in found]).reshape(-1, len(samples.size))
    return _simplified(samples, _reduced(exact, np.abs(exact).max(axis=0, initial=0)))


def _check_position(samples: _Samples, names: list[str]) -> None:
    """Raises if the states are on a manifold that the flow leaves."""
    values = samples.values - samples.values.mean(axis=0)
    largest = np.abs(values).max(axis=0)
    scale = np.where(largest > _ZERO * np.abs(samples.values).max(axis=0), largest, 1.0)
    _, sizes, basis = np.linalg.svd(values / scale, full_matrices=False)
    for c in _reduced(basis[sizes <= samples.resolution(sizes)]) / scale:
        if samples.defect(c, _ALL) > _ZERO / samples.eps:
            c = np.where(np.abs(c) <= _ZERO**0.5, 0, c) / samples.size
            raise ValueError(
                f"The function `{_formula(c / np.abs(c).max(), names)}` has the same value at all "
                "`states`, but changes along the flow, so they are not in general position. Let "
                "every component vary."
            )


def _reduced(rows: np.ndarray, size: np.ndarray | None = None) -> np.ndarray:
    """The reduced echelon form, in which each row alone has its last function. So what needs only
    the first functions, such as those of low degree, has no others."""
    rows, k = rows.copy(), 0
    least = _PIVOT * (np.ones(rows.shape[1]) if size is None else size)
    for column in reversed(range(rows.shape[1])):
        if k < len(rows):
            pivot = k + int(np.argmax(np.abs(rows[k:, column])))
            if abs(rows[pivot, column]) > least[column]:
                rows[[k, pivot]] = rows[[pivot, k]]
                rows[k] /= rows[k, column]
                others = np.arange(len(rows)) != k
                rows[others] -= np.outer(rows[others, column], rows[k])
                k += 1
    return rows[::-1]


def _simplified(samples: _Samples, rows: np.ndarray) -> list[np.ndarray]:
    """The simplest form of each combination that is conserved at all states, if it has one."""

    def forms(c: np.ndarray) -> Iterator[np.ndarray]:
        for share in _SHARES:
            short = np.where(np.abs(c) <= share * np.abs(c).max(), 0, c)
            short = samples.refined(short) / samples.size
            short /= np.abs(short).max() * np.sign(short[np.flatnonzero(short)[0]])
            yield np.array([_number(x, share) for x in short])
            yield short

    def is_conserved(c: np.ndarray) -> bool:
        halves = (_FIRST, _SECOND)
        return all(samples.defect(c * samples.size, half) <= _ROUNDOFF for half in halves)

    found = [next(filter(is_conserved, forms(row)), None) for row in rows]
    return [c for c in found if c is not None]


def _number(x: float, share: float) -> float:
    """`x` as a decimal number or a fraction, if it is one up to a share of it."""
    # Two digits fewer than the error leaves, so that a decimal is not found by chance.
    digits = min(_DIGITS, -round(math.log10(share)) - 2)
    simple = float(f"{x:.{digits}g}"), float(Fraction(x).limit_denominator(_DENOMINATOR))
    return next((number for number in simple if abs(x - number) <= share * abs(x)), x)


def _independent(samples: _Samples, found: list[np.ndarray]) -> list[np.ndarray]:
    """Those of the combinations that vary from state to state, and are no polynomials of others
    that are simpler. The polynomials in question are those of which the values are in the span of
    the basis."""
    scaled = [c * samples.size for c in found]
    sizes = [np.abs(samples.values) @ np.abs(c) for c in scaled]
    values = [samples.values @ c for c in scaled]
    varying = [np.ptp(x) > _ZERO * size.max() for x, size in zip(values, sizes, strict=True)]
    if not any(varying) and any(map(samples.has_gradient, scaled)):
        raise ValueError(
            "What is conserved has the same value at all `states`, as on one trajectory, where "
            "much is constant that is not elsewhere. Give states of several, or move each a bit."
        )
    one = np.ones((len(samples.values), 1))
    basis, sizes, _ = np.linalg.svd(np.append(one, samples.values, axis=1), full_matrices=False)
    basis = basis[:, sizes > samples.resolution(sizes)]

    def outside(space: np.ndarray, x: np.ndarray) -> bool:
        left = x - space @ (space.T @ x)
        return bool(np.linalg.norm(left) > _DEPENDENT * np.linalg.norm(x))

    kept, known = [], [one[:, 0]]
    span = lambda: np.linalg.qr(np.stack(known, axis=1))[0]  # noqa: E731
    simplest = sorted(np.flatnonzero(varying), key=lambda i: np.count_nonzero(found[i]))
    for i in simplest:
        x = (values[i] - values[i].mean()) / np.std(values[i])
        if outside(span(), x):
            kept.append(found[i])
            new = [x]
            while new:  # all products that the basis contains
                known.append(x := new.pop())
                for y in known[1:]:
                    if not outside(basis, x * y) and outside(span(), x * y):
                        new.append(x * y)
    return kept
