"""Where the derivatives of equations can have elements."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool

from .._large.detection import NotSparse, jacobian_places
from .._large.klu import SparseJacobian

Numbers = list[Array | np.ndarray | np.generic]


class FindPlaces:
    """Finds where derivatives have elements, whatever the unknown numbers, the time and the state
    are. So it is remembered for the next search of the same equations."""

    def __init__(
        self, memory: dict[Any, Any], numbers: Numbers, unknown: tuple[int, ...], t: Array, y: Array
    ):
        self.memory, self.numbers, self.unknown = memory, numbers, unknown
        self.time, self.zeros = np.zeros_like(t), np.zeros_like(y)

    def of(self, fn: Any, argument: int) -> SparseJacobian:
        """Of `fn(numbers, t, y, slopes)` by `y` or by `slopes`; raises `NotSparse`."""
        key = fn, argument
        if key not in self.memory:
            try:
                self.memory[key] = self._found(fn, argument)
            except NotSparse:
                self.memory[key] = None
        if self.memory[key] is None:
            raise NotSparse
        return self.memory[key]

    def _found(self, fn: Any, argument: int) -> SparseJacobian:

        def of_one(x: Array, t: Array, other: Array, *others: Array) -> Array:
            numbers = [*self.numbers]
            for i, value in zip(self.unknown, others, strict=True):
                numbers[i] = value
            pair = (x, other) if argument == 1 else (other, x)
            return fn(numbers, t, *pair)

        others = [np.asarray(self.numbers[i]) for i in self.unknown]
        closed = jax.make_jaxpr(of_one)(self.zeros, self.time, self.zeros, *others)
        shape = closed.out_avals[0].shape[0], self.zeros.size
        return SparseJacobian(*jacobian_places(closed), shape)

    def dense(self, fn: Any, argument: int, number: int) -> Bool[np.ndarray, "m n"]:
        """As `of` a `number` of equations of a small system; all places if these are nearly all."""
        shape = number, self.zeros.size
        try:
            found = self.of(fn, argument)
        except NotSparse:
            return np.full(shape, True)
        out = np.zeros(shape, bool)
        out[found.rows, found.columns] = True
        return out
