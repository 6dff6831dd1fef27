"""The linear systems of projections, by themselves, against numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffrax_conserve._numerics import problem
from diffrax_conserve._numerics.rows import DenseRows, RegularisedGram

from ..problems import EPS


@jax.jit
def correction(rows, others, b):
    """`othersᵀ (rows othersᵀ)⁻¹ b`, and the multipliers."""
    rows, others = DenseRows(rows), DenseRows(others)
    gram = rows.gram(others)
    return gram.row_space_correction(others, b), gram.solve(b)


@pytest.mark.parametrize("m", [1, 2, 4, 5, 12])
def test_independent_rows_agree_with_numpy(m):
    rng = np.random.default_rng(m)
    for _ in range(20):
        rows, b = rng.normal(size=(m, 15)), rng.normal(size=m)
        others = rows + 0.1 * rng.normal(size=rows.shape)  # the gradients at two states
        gram = rows @ others.T
        multiplier = np.linalg.solve(gram, b)
        along, found = correction(rows, others, b)
        tol = 100 * m * EPS * np.linalg.cond(gram)
        np.testing.assert_allclose(found, multiplier, 0, tol * np.max(np.abs(multiplier)))
        np.testing.assert_allclose(rows @ along, b, 0, tol * np.max(np.abs(b)))


@pytest.mark.parametrize("m", [2, 3, 4, 7, 13])
def test_dependent_rows_are_corrected_if_they_are_consistent(m):
    """They may outnumber the unknowns, or be zero. Of few rows those that depend on the ones before
    them have the multiplier zero."""
    rng = np.random.default_rng(m)
    independent = rng.normal(size=(max(1, m // 2), 12))
    mixed = np.concatenate([np.eye(len(independent)), rng.normal(size=(m, len(independent)))])[:m]
    mixed[-1] *= m % 2  # a zero row
    rows = mixed @ independent
    b = mixed @ rng.normal(size=len(independent))
    along, multiplier = correction(rows, rows, b)
    assert np.all(np.isfinite(multiplier))
    assert m > 4 or not np.any(multiplier[len(independent) :])
    np.testing.assert_allclose(rows @ along, b, rtol=0, atol=1e-10 * np.max(np.abs(b)))
    shortest = np.linalg.lstsq(rows, b, rcond=1e-10)[0]
    np.testing.assert_allclose(along, shortest, rtol=0, atol=1e-9 * np.max(np.abs(shortest)))


@pytest.mark.parametrize("m", [2, 6])
def test_columns_in_other_units_change_no_bit(m):
    """What a power of two does to a column and to its unit cancels."""
    rng = np.random.default_rng(m)
    rows, units, b = rng.normal(size=(m, 9)), rng.uniform(1, 2, 9), rng.normal(size=m)
    factors = 2.0 ** rng.integers(-40, 40, 9)
    change, _ = correction(rows * units, rows * units, b)
    again, _ = correction(rows / factors * (units * factors), rows * units, b)
    np.testing.assert_array_equal(change, again)


def test_a_factor_is_the_inverse_and_exists_for_dependent_rows():
    rng, solved = (
        np.random.default_rng(0),
        jax.jit(lambda gram, b: RegularisedGram(gram).factorise()(b)),
    )
    rows, b = rng.normal(size=(8, 10)), rng.normal(size=8)
    np.testing.assert_allclose(rows @ rows.T @ solved(rows @ rows.T, b), b, rtol=0, atol=1e-9)
    rows[3] = rows[1]
    assert np.all(np.isfinite(solved(rows @ rows.T, b)))


def test_the_scale_of_a_residual_is_the_size_of_its_terms():
    y = np.array([3.0, -4.0])
    jacobian = DenseRows(jnp.array([[2.0, 0.5], [0.0, 0.0]]))
    np.testing.assert_array_equal(jacobian.absolute_matvec(abs(y)), [8.0, 0.0])
    assert problem.relative_to_scale(jnp.array(2.0), jnp.array(0.0)) == 2.0
