"""Strategies for numbers: components of states, step sizes, times."""

import math
from typing import Any

import hypothesis.strategies as st
import numpy as np
from jaxtyping import Float

from .._custom_types import RealScalarLike


def rounded(magnitude: RealScalarLike) -> st.SearchStrategy[float]:
    """Numbers in `[-magnitude, magnitude]` to six significant digits of `magnitude`.

    Rounding avoids underflow in products, and makes counterexamples readable.
    """
    magnitude = float(magnitude)
    digits = 6 - math.floor(math.log10(magnitude))
    return st.floats(-magnitude, magnitude).map(
        lambda x: min(max(round(x, digits), -magnitude), magnitude)
    )


def step_sizes(
    largest: RealScalarLike, *, smallest: RealScalarLike | None = None
) -> st.SearchStrategy[Any]:
    r"""Step sizes for `dt0`, spread evenly on a logarithmic scale.

    **Arguments:**

    - `largest`: the largest step size, in the units of time.
    - `smallest`: the smallest. Default: a hundredth of `largest`.

    **Returns:**

    A strategy of positive numbers with three significant digits. It shrinks to `largest`, because a
    counterexample with few steps is the easiest to follow. The numbers are NumPy `float64`, because
    [`equinox.filter_jit`][] compiles again for each Python float.

    **Raises:**

    `ValueError` unless `0 < smallest <= largest`.

    !!! example

        ```python
        import diffrax_conserve.testing as dct
        from hypothesis import given

        @given(step=dct.step_sizes(0.1))
        def test(step):
            assert 0.001 <= step <= 0.1

        test()
        ```
    """
    largest = float(largest)
    smallest = largest / 100 if smallest is None else float(smallest)
    if not 0 < smallest <= largest < math.inf:
        raise ValueError(
            f"`step_sizes` needs 0 < smallest <= largest, but got smallest={smallest} and "
            f"largest={largest}. Steps are positive also in a solve backwards in time."
        )
    ratio = smallest / largest

    def step(k: int) -> float:
        return min(max(float(f"{largest * ratio ** (k / 1000):.3g}"), smallest), largest)

    # Two maps, because hypothesis shows the call of a named function instead of its value.
    return st.integers(0, 1000).map(step).map(lambda h: np.asarray(h)[()])


def times(
    t0: RealScalarLike, t1: RealScalarLike, *, size: int = 5
) -> st.SearchStrategy[Float[np.ndarray, " size"]]:
    """Times between `t0` and `t1`, in the order in which a solve from `t0` to `t1` meets them.

    **Arguments:**

    - `t0`, `t1`: the ends; `t1` may be smaller than `t0`.
    - `size`: the number of times. It is fixed, so that a solve with `SaveAt(ts=...)` is compiled
        once.

    **Returns:**

    A strategy of float64 arrays of shape `(size,)`, multiples of a thousandth of the interval,
    both ends and repeated times included. It shrinks to `t0`.

    **Raises:**

    `ValueError` if an end is not finite, or `size` not positive.

    !!! example

        ```python
        import diffrax_conserve.testing as dct
        import numpy as np
        from hypothesis import given

        @given(ts=dct.times(2.0, 0.0))
        def test(ts):
            assert ts.shape == (5,) and np.all(np.diff(ts) <= 0)

        test()
        ```
    """
    t0, t1 = float(t0), float(t1)
    if not (math.isfinite(t0) and math.isfinite(t1) and size > 0):
        raise ValueError(
            f"`times` needs finite ends and a positive size, but got t0={t0}, t1={t1}, size={size}."
        )
    parts = st.lists(st.integers(0, 1000), min_size=size, max_size=size)
    # Clipped to the exact ends, because a solution is not defined beyond them.
    low, high = min(t0, t1), max(t0, t1)
    return parts.map(lambda k: np.clip(t0 + (t1 - t0) * np.sort(k) / 1000, low, high))
