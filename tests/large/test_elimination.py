"""The rank of sparse matrices, by that of dense ones and by what is known of graphs."""

import hypothesis as hp
import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.sparse as sp

from diffrax_conserve._large import elimination
from diffrax_conserve._large.elimination import combinations, extended

NONE = np.zeros(0, int), np.zeros(0, int)


def incidence(k):
    """Of the edges and nodes of a square grid."""
    one = sp.diags_array([np.ones(k - 1), -np.ones(k)], offsets=[1, 0], shape=(k - 1, k))
    eye = sp.eye_array(k)
    return sp.csr_array(sp.vstack([sp.kron(one, eye), sp.kron(eye, one)]))


@pytest.mark.parametrize("dense", [256, 4])
@hp.given(seed=st.integers(0, 10**6))
@hp.settings(max_examples=60)
def test_rank_is_that_of_a_dense_matrix(dense, seed):
    """Large parts by SuperLU too, of a matrix of integers, whose rank is exact."""
    rng = np.random.default_rng(seed)
    m, n, k = rng.integers(1, 30, 3)
    digits = lambda size: rng.integers(1, 9, size)  # noqa: E731
    factors = [
        sp.random_array(shape, density=0.15, rng=rng, data_sampler=digits)
        for shape in ((m, k), (k, n))
    ]
    matrix = sp.csr_array(factors[0] @ factors[1], dtype=float)
    before, elimination._DENSE = elimination._DENSE, dense
    try:
        rows, columns = extended(matrix, NONE)
        half = rows[: len(rows) // 2], columns[: len(rows) // 2]
        again = extended(matrix, half)
    finally:
        elimination._DENSE = before
    rank = np.linalg.matrix_rank(matrix.toarray())
    assert len(set(rows)) == len(set(columns)) == len(rows) == rank
    assert np.linalg.matrix_rank(matrix[rows][:, columns].toarray()) == rank
    # What was chosen before is kept.
    assert len(again[0]) == rank
    np.testing.assert_array_equal(again[0][: len(half[0])], half[0])


@pytest.mark.parametrize("k", [3, 40])
def test_rank_of_a_grid_of_condensers_is_that_of_a_connected_graph(k):
    matrix = sp.csr_array(incidence(k).T @ incidence(k))
    assert len(extended(matrix, NONE)[0]) == k * k - 1
    both = sp.csr_array(sp.block_diag([matrix, matrix]))
    assert len(extended(both, NONE)[0]) == 2 * k * k - 2


def test_combinations_are_those_of_dense_matrices():
    rng = np.random.default_rng(0)
    matrix = sp.csr_array(sp.block_diag([np.diag([2.0, -3.0]), rng.normal(size=(4, 4))]))
    matrix = matrix[rng.permutation(6)]
    rows = sp.random_array((5, 6), density=0.4, rng=rng)
    expected = rows.toarray() @ np.linalg.inv(matrix.toarray())
    np.testing.assert_allclose(combinations(rows, matrix).toarray(), expected, atol=1e-13)
