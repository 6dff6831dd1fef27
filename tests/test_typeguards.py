"""The annotations of the package are checked at every call, those of each leaf included.

`conftest.py` puts a faster check in the place of jaxtyping's own.
"""

import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from jaxtyping import Array, ArrayLike, Float, PyTree, Shaped

from diffrax_conserve._tree import tree_add

VECTOR, MATRIX = np.ones(3), np.ones((3, 3))


def test_shapes_of_leaves_must_agree():
    tree = {"a": VECTOR, "b": MATRIX}
    assert np.array_equal(tree_add(tree, tree)["b"], MATRIX + MATRIX)
    with pytest.raises(jaxtyping.TypeCheckError):
        tree_add(tree, {"a": VECTOR, "b": VECTOR})


def test_structures_must_agree():
    with pytest.raises(jaxtyping.TypeCheckError):
        tree_add((VECTOR, VECTOR), [VECTOR, VECTOR])


@pytest.mark.parametrize("leaf", ["a string", object()])
def test_leaves_must_be_arrays(leaf):
    with pytest.raises(jaxtyping.TypeCheckError):
        tree_add({"a": leaf}, {"a": leaf})


@pytest.mark.parametrize(
    ("tree", "hint", "accepted"),
    [
        ((VECTOR, 1.0), PyTree[Shaped[ArrayLike, "..."]], True),
        ((VECTOR, "word"), PyTree[Shaped[ArrayLike, "..."]], False),
        ({"a": (jnp.ones(2),)}, PyTree[Array], True),
        ({"a": (np.ones(2),)}, PyTree[Array], False),
        ([MATRIX], PyTree[Float[np.ndarray, "n n"]], True),
        ([MATRIX, VECTOR], PyTree[Float[np.ndarray, "n n"]], False),
        ([MATRIX[:2]], PyTree[Float[np.ndarray, "n n"]], False),
        ([(1, 2), (3, 4)], PyTree[tuple[int, int]], True),
        ([(1, 2), (3, "four")], PyTree[tuple[int, int]], False),
        (None, PyTree[Array], True),
    ],
)
def test_a_tree_is_judged_by_every_leaf(tree, hint, accepted):
    assert isinstance(tree, hint) is accepted
