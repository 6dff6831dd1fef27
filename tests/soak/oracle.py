"""What is right, told by numpy's long doubles alone: this file knows nothing of the package.

The functions of a manifold are written for `xp = jax.numpy` and `xp = numpy` at once, with states
indexed by component: `fn(xp, y, a)` is a list of integrals, where `y[k]` is one number for JAX and
one number per lane here. Their gradients are complex steps.
"""

import collections
import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

ULPS = 64  # the promise: units of roundoff of the scale at the returned state
Function = Callable[[Any, Any, Any], list[Any]]


@dataclasses.dataclass
class Tally:
    """What a program of an attack found: `wrong` and `notes` count lanes under a few words."""

    tried: int = 0
    success: int = 0
    wrong: collections.Counter = dataclasses.field(default_factory=collections.Counter)
    notes: collections.Counter = dataclasses.field(default_factory=collections.Counter)
    examples: list[str] = dataclasses.field(default_factory=list)

    def blame(self, why: str, lanes: Any, show: Callable[[int], str] = str) -> None:
        """Counts the lanes (a mask, or one truth), and shows the first."""
        found = np.flatnonzero(lanes)
        if found.size:
            self.wrong[why] += int(found.size)
            self.examples.append(f"{why}: lane {found[0]}: {show(int(found[0]))}")


def long(x: Any) -> np.ndarray:
    return np.asarray(x).astype(np.longdouble)


def derivative(fn: Callable[[np.ndarray], list[Any]], y: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Of each component of an analytic `fn` at `y` along `v`."""
    tiny = np.longdouble("1e-1000")
    moved = y + np.clongdouble(1j) * tiny * v
    return np.stack([np.imag(f + 0 * moved[0]) / tiny for f in fn(moved)])


def scales(fn: Function, y: np.ndarray, a: np.ndarray, value: Any = 0, change: Any = 0) -> Any:
    """`|value| + sum_k (|y_k| + change_k) |dI/dy_k|` of each integral."""
    sizes = np.abs(y) + change
    total = np.abs(long(value)) + np.zeros((len(fn(np, y, a)), *y.shape[1:]), np.longdouble)
    for k in range(len(y)):
        unit = np.zeros_like(y)
        unit[k] = 1
        total = total + sizes[k] * np.abs(derivative(lambda z: fn(np, z, a), y, unit))
    return total


def values(fn: Function, y: Any, a: Any) -> np.ndarray:
    y, a = long(y), long(a)
    with np.errstate(all="ignore"):
        return np.stack([f + 0 * y[0] for f in fn(np, y, a)])


def ratio(
    fn: Function, y: Any, a: Any, value: Any, start: Any = None, change: Any = 0
) -> np.ndarray:
    """The largest residual of each lane over what is allowed; infinite where anything is NaN.

    `y` has shape `(n, lanes)` and the dtype that the roundoff is of. Where the conserved value is
    that of a state `start`, it has the roundoff of its own evaluation; components that have changed
    by `change` in a step have the roundoff of that.
    """
    eps = np.finfo(np.asarray(y).dtype).eps
    y, a, value = long(y), long(a), long(value)
    with np.errstate(all="ignore"):
        residual = np.abs(values(fn, y, a) - value)
        allowed = ULPS * eps * scales(fn, y, a, value, change)
        if start is not None:
            allowed = allowed + 8 * eps * scales(fn, long(start), a)
        result = np.where(residual == 0, 0, residual / allowed).max(axis=0)
    return np.where(np.isnan(result) | ~np.isfinite(y).all(axis=0), np.inf, result)


def reachable(fn: Function, y: Any, a: Any, value: Any, frozen: bool = False) -> np.ndarray:
    """Which lanes a damped Gauss-Newton iteration brings to the manifold, in long double; with
    `frozen` along the gradients at the candidate.

    A lane counts if one Newton step halves the residual at least, so that the functions are nearly
    linear at this distance, and if the squares of their gradients are in the range of the dtype.
    """
    # Below float64 the package scales the gradients.
    largest = np.finfo(y.dtype).max ** (0.5 if y.dtype == np.float64 else 1.0)
    y, a, value = long(y), long(a), long(value)
    m, counts, before = len(value), np.ones(y.shape[1], bool), np.inf
    reached = np.zeros(y.shape[1], bool)
    with np.errstate(all="ignore"):
        for step in range(60):
            g = values(fn, y, a) - value
            size = scales(fn, y, a, value)
            off = (np.abs(g) / size).max(axis=0)
            # `1 - cos(q)` has roundoff above that of long double.
            reached |= off <= 1e-10
            if step == 0:
                counts &= (size < 1e-3 * largest).all(axis=0)
            if step == 1:
                counts &= reached | (off <= 0.5 * before)
            before = off
            units = np.eye(len(y), dtype=y.dtype)[:, :, None] + 0 * y
            rows = [derivative(lambda z: fn(np, z, a), y, unit) for unit in units]
            rows, g = np.stack(rows, axis=1) / size[:, None], g / size
            damping = np.minimum(1e-2, (g * g).sum(axis=0))
            along = rows if step == 0 or not frozen else along
            slopes = np.einsum("ikl,jkl->ijl", rows, along)
            gram = np.einsum("kil,kjl->ijl", slopes, slopes) if frozen else slopes
            right = np.einsum("kil,kl->il", slopes, g) if frozen else g
            for i in range(m):
                gram[i, i] = gram[i, i] * (1 + damping) + np.longdouble("1e-4000")
            y = y - np.einsum("ikl,il->kl", along, _solved(gram, right))
    return counts & reached & np.isfinite(y).all(axis=0)


def _solved(gram: np.ndarray, b: np.ndarray) -> np.ndarray:
    gram, b, m = gram.copy(), b.copy(), len(b)
    for k in range(m):
        for i in range(k + 1, m):
            share = gram[i, k] / gram[k, k]
            gram[i], b[i] = gram[i] - share * gram[k], b[i] - share * b[k]
    for k in reversed(range(m)):
        b[k] = (b[k] - sum(gram[k, j] * b[j] for j in range(k + 1, m))) / gram[k, k]
    return b


def log_uniform(rng: np.random.Generator, low: float, high: float, size: Any) -> np.ndarray:
    return np.exp(rng.uniform(np.log(low), np.log(high), size))
