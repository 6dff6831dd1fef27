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


def scales(fn: Function, y: np.ndarray, a: np.ndarray, value: Any = 0) -> np.ndarray:
    """`|value| + sum_k |y_k dI/dy_k|` of each integral."""
    total = np.abs(long(value)) + np.zeros((len(fn(np, y, a)), *y.shape[1:]), np.longdouble)
    for k in range(len(y)):
        unit = np.zeros_like(y)
        unit[k] = 1
        total = total + np.abs(y[k] * derivative(lambda z: fn(np, z, a), y, unit))
    return total


def values(fn: Function, y: Any, a: Any) -> np.ndarray:
    y, a = long(y), long(a)
    with np.errstate(all="ignore"):
        return np.stack([f + 0 * y[0] for f in fn(np, y, a)])


def ratio(fn: Function, y: Any, a: Any, value: Any, start: Any = None) -> np.ndarray:
    """The largest residual of each lane over what is allowed; infinite where anything is NaN.

    `y` has shape `(n, lanes)` and the dtype that the roundoff is of. Where the conserved value is
    that of a state `start`, it has the roundoff of its own evaluation.
    """
    eps = np.finfo(np.asarray(y).dtype).eps
    y, a, value = long(y), long(a), long(value)
    with np.errstate(all="ignore"):
        residual = np.abs(values(fn, y, a) - value)
        allowed = ULPS * eps * scales(fn, y, a, value)
        if start is not None:
            allowed = allowed + 8 * eps * scales(fn, long(start), a)
        result = np.where(residual == 0, 0, residual / allowed).max(axis=0)
    return np.where(np.isnan(result) | ~np.isfinite(y).all(axis=0), np.inf, result)


def log_uniform(rng: np.random.Generator, low: float, high: float, size: Any) -> np.ndarray:
    return np.exp(rng.uniform(np.log(low), np.log(high), size))


def is_told(message: str) -> bool:
    """Whether the message of a failed solve gives a reason of the package."""
    return "diffrax_conserve: " in message
