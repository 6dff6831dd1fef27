"""Strategies for numbers, times and states, and for the systems of the catalogue."""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import ArrayLike, DTypeLike, Float, PyTree

from .. import systems as catalogue
from .._custom_types import RealScalarLike
from ..systems import AbstractSystem

_TABLE_SIZE = 256


def rounded(magnitude: RealScalarLike) -> st.SearchStrategy[float]:
    """Multiples of a millionth of `magnitude`, at most as large: they do not underflow in products,
    and are readable."""
    return st.integers(-(10**6), 10**6).map(lambda k: float(magnitude) * (k / 10**6))


def step_sizes(
    largest: RealScalarLike, *, smallest: RealScalarLike | None = None
) -> st.SearchStrategy[Any]:
    r"""Step sizes for `dt0`, spread evenly on a logarithmic scale.

    **Arguments:**

    - `largest`: the largest step size, in the units of time.
    - `smallest`: the smallest; a `ValueError` unless `0 < smallest <= largest`. Default: a
        hundredth of `largest`.

    **Returns:**

    A strategy of positive NumPy `float64`s, because [`equinox.filter_jit`][] compiles again for
    each Python float. It shrinks to `largest`, with which counterexamples have the fewest steps.

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
    return st.sampled_from(list(np.geomspace(largest, smallest, 1001)))


def times(
    t0: RealScalarLike, t1: RealScalarLike, *, size: int = 5
) -> st.SearchStrategy[Float[np.ndarray, " size"]]:
    """Times between `t0` and `t1`, in the order in which a solve from `t0` to `t1` meets them.

    **Arguments:**

    - `t0`, `t1`: the ends, which must be finite; `t1` may be smaller than `t0`.
    - `size`: the number of times, at least 1, which is fixed so that a solve is compiled once.

    **Returns:**

    A strategy of float64 arrays of shape `(size,)`, multiples of a thousandth of the interval, both
    ends and repeated times included. It shrinks to `t0`. Other arguments raise a `ValueError`.

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
    grid = np.linspace(t0, t1, 1001)
    places = st.lists(st.integers(0, 1000), min_size=size, max_size=size)
    return places.map(lambda k: grid[np.sort(k)])


def states(like: PyTree[ArrayLike], *, magnitude: RealScalarLike = 1.0) -> st.SearchStrategy[Any]:
    """States shaped like a given one, with bounded components.

    **Arguments:**

    - `like`: a PyTree of floating-point arrays (otherwise a `TypeError`), which defines structure,
        shapes and dtypes.
    - `magnitude`: the largest absolute value of a component, positive; otherwise a `ValueError`.

    **Returns:**

    A strategy of PyTrees like `like`, of NumPy arrays. No component is infinite or NaN, or so small
    that its square underflows in float32. It shrinks to zero.

    !!! example

        ```python
        import diffrax_conserve.testing as dct
        import numpy as np
        from hypothesis import given

        @given(y=dct.states({"q": np.zeros(2), "p": np.zeros(2)}, magnitude=3.0))
        def test(y):
            assert np.all(np.abs(y["q"]) <= 3)

        test()
        ```
    """
    if not 0 < magnitude < float("inf"):
        raise ValueError(f"`magnitude` must be positive and finite, but it is {magnitude}.")
    leaves, treedef = jtu.tree_flatten(like)
    for dtype in map(jnp.result_type, leaves):
        if not jnp.issubdtype(dtype, jnp.floating):
            raise TypeError(
                f"`like` has a leaf of dtype {dtype}. States are floating-point: write for example "
                "`np.zeros(3)`."
            )

    def array(leaf: ArrayLike) -> st.SearchStrategy[Any]:
        # Drawn in float64 and then rounded, so that float32 is at most the rounded bound.
        drawn = hnp.arrays(np.float64, jnp.shape(leaf), elements=rounded(magnitude))
        return drawn.map(lambda a: a.astype(jnp.result_type(leaf)))

    return st.tuples(*map(array, leaves)).map(lambda drawn: jtu.tree_unflatten(treedef, drawn))


def system_states(
    system: AbstractSystem, *, dtype: DTypeLike | None = None
) -> st.SearchStrategy[Any]:
    """Initial states of a system of the catalogue: its `y0` and 255 from its sampling domain.

    **Arguments:**

    - `system`: an [`diffrax_conserve.systems.AbstractSystem`][]. Its `sample` is called once for
        all states.
    - `dtype`: the dtype of the states. Default: that of `system.y0`.

    **Returns:**

    A strategy of PyTrees like `system.y0`, of NumPy arrays, on all constraints of the system's
    manifold (to the precision of `dtype`). It shrinks to `system.y0`.

    !!! example

        ```python
        import diffrax_conserve as dfc
        import diffrax_conserve.testing as dct
        import numpy as np
        from hypothesis import given

        @given(y0=dct.system_states(dfc.systems.Kepler()))
        def test(y0):
            q, p = y0
            assert np.linalg.norm(q) > 0

        test()
        ```
    """
    samples = eqx.filter_jit(eqx.filter_vmap(system.sample))(jr.split(jr.key(0), _TABLE_SIZE - 1))
    table = jtu.tree_map(lambda x, xs: np.concatenate([x[None], xs]), system.y0, samples)
    # `astype` copies, so that a test that modifies its input does not affect other draws.
    return st.integers(0, _TABLE_SIZE - 1).map(
        lambda index: jtu.tree_map(lambda x: x[index].astype(dtype or x.dtype), table)
    )


def catalogue_systems(names: Sequence[str] | None = None) -> st.SearchStrategy[AbstractSystem]:
    """Systems of the catalogue, with their default parameters.

    **Arguments:**

    - `names`: the names to draw from, at least one. Default: all of
        `diffrax_conserve.systems.names()`.

    **Returns:**

    A strategy of [`diffrax_conserve.systems.AbstractSystem`][]s. It shrinks to the first name.

    **Raises:**

    `ValueError` if `names` is empty or has a name that is not in the catalogue.

    Solves are compiled again for every system: prefer `pytest.mark.parametrize` for them.

    !!! example

        ```python
        import diffrax_conserve.testing as dct
        from hypothesis import given

        @given(system=dct.catalogue_systems())
        def test(system):
            assert len(system.manifold) > 0

        test()
        ```
    """
    names = catalogue.names() if names is None else names
    if not names:
        raise ValueError(
            "`names` of `catalogue_systems` is empty. Give at least one name, such as "
            '("kepler",), or leave `names` out to draw from the whole catalogue.'
        )
    return st.sampled_from([catalogue.get(name) for name in names])
