"""Strategies for states, free or from the catalogue, and for the systems of the catalogue."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import ArrayLike, DTypeLike, PyTree

from .. import systems as catalogue
from .._custom_types import RealScalarLike
from ..systems import AbstractSystem
from ._numbers import rounded

_TABLE_SIZE = 256


def states(like: PyTree[ArrayLike], *, magnitude: RealScalarLike = 1.0) -> st.SearchStrategy[Any]:
    """States shaped like a given one, with bounded components.

    **Arguments:**

    - `like`: a PyTree of floating-point arrays, which defines structure, shapes and dtypes.
    - `magnitude`: the largest absolute value of a component.

    **Returns:**

    A strategy of PyTrees like `like`, of NumPy arrays. No component is infinite or NaN, or so small
    that its square underflows in float32. It shrinks to zero.

    **Raises:**

    `TypeError` if a leaf is not floating-point; `ValueError` unless `magnitude` is positive.

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
    for leaf in leaves:
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise TypeError(
                f"`like` has a leaf of dtype {jnp.result_type(leaf)}. States are floating-point: "
                "write for example `np.zeros(3)`."
            )
    elements = rounded(magnitude)
    # Drawn in float64 and then rounded, so that a float32 component is at most the rounded bound.
    arrays = [
        hnp.arrays(np.float64, jnp.shape(x), elements=elements).map(
            lambda a, dtype=jnp.result_type(x): a.astype(dtype)
        )
        for x in leaves
    ]
    return st.tuples(*arrays).map(lambda drawn: jtu.tree_unflatten(treedef, drawn))


def system_states(
    system: AbstractSystem, *, dtype: DTypeLike | None = None
) -> st.SearchStrategy[Any]:
    """Initial states of a system of the catalogue: its `y0` and 255 from its sampling domain.

    **Arguments:**

    - `system`: an [`diffrax_conserve.systems.AbstractSystem`][]. Its `sample` is called once for
        all states, so that nothing is compiled while a test draws.
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

    table = jtu.tree_map(
        lambda x: np.asarray(x, x.dtype if dtype is None else dtype), _table(system)
    )
    # Copies, so that a test that modifies its input does not affect other draws.
    return st.integers(0, _TABLE_SIZE - 1).map(
        lambda index: jtu.tree_map(lambda x: x[index].copy(), table)
    )


@eqx.filter_jit
def _table(system: AbstractSystem) -> Any:
    samples = jax.vmap(system.sample)(jr.split(jr.key(0), _TABLE_SIZE - 1))
    return jtu.tree_map(lambda x, xs: jnp.concatenate([x[None], xs]), system.y0, samples)


def catalogue_systems(names: Sequence[str] | None = None) -> st.SearchStrategy[AbstractSystem]:
    """Systems of the catalogue, with their default parameters.

    **Arguments:**

    - `names`: the names to draw from. Default: all of `diffrax_conserve.systems.names()`.

    **Returns:**

    A strategy of [`diffrax_conserve.systems.AbstractSystem`][]s. It shrinks to the first name.

    Solves are compiled again for every system: for a test with compiled solves prefer
    `pytest.mark.parametrize`, which also names the system in the report.

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
    return st.sampled_from([catalogue.get(name) for name in names])
