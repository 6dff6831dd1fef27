"""The linear systems of projections, by themselves, against numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve._numerics import problem
from diffrax_conserve._numerics.linear import (
    diagonal_shift,
    gram_matrix,
    ldu_factors,
    ldu_solution,
)
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


@pytest.mark.parametrize("n", [9, 70])
def test_the_inverse_of_many_lanes_is_that_of_each(n):
    """Also if a lane is NaN, and if its rows depend on each other."""
    rows, b = np.random.default_rng(0).normal(size=(4, 7, n)), np.linspace(-1, 1, 7)
    rows[2, 3], rows[3, 6] = np.nan, 2 * rows[3, 0]
    consistent = np.where(np.arange(7) == 6, 2 * b[0], b)

    def solve(rows, b):
        rows = jnp.moveaxis(rows, 0, -1)
        factors = ldu_factors(
            gram_matrix(rows, rows), relative_shift=diagonal_shift(len(rows), rows.dtype)
        )
        return ldu_solution(*factors, jnp.broadcast_to(b[:, None], (7, 4)))

    found = np.asarray(jax.jit(solve)(rows, consistent)).T
    for k in (0, 1):
        gram = rows[k] @ rows[k].T
        tol = 10 * EPS**0.75 * np.linalg.cond(gram)
        np.testing.assert_allclose(gram @ found[k], consistent, 0, tol)
    assert np.all(np.isnan(found[2]))
    np.testing.assert_allclose(rows[3] @ (rows[3].T @ found[3]), consistent, 0, 1e-3)


def quadratics(t, y, args):
    return jnp.einsum("kij,i,j->k", np.random.default_rng(0).normal(size=(6, 9, 9)), y, y)


def test_a_lane_with_six_constraints_is_projected_as_alone():
    """In a batch of batches too, beside a lane that is NaN; and its derivative is that of the state
    alone."""
    rng = np.random.default_rng(1)
    ys = rng.normal(size=(2, 3, 9))
    values = np.stack([[quadratics(0.0, y, None) for y in row] for row in ys])
    ys = ys + 1e-3 * rng.normal(size=ys.shape)
    ys[1, 1, 4] = np.nan

    def projected(y, value):
        integral, projection = dfc.FirstIntegral(quadratics), dfc.SimplifiedNewton()
        y, info = dfc.project(integral, y, value=value, projection=projection)
        return y, info.ok, info.num_iterations

    def with_tangent(y, value):
        return *projected(y, value), jax.jvp(lambda y: projected(y, value)[0], (y,), (y,))[1]

    both = jax.jit(jax.vmap(jax.vmap(with_tangent)))
    assert "lapack" not in both.lower(ys, values).as_text()
    together, alone = both(ys, values), jax.jit(with_tangent)
    for i, j in np.ndindex(2, 3):
        one = alone(ys[i, j], values[i, j])
        assert bool(one[1]) == bool(together[1][i, j]) == ((i, j) != (1, 1))
        if one[1]:
            assert int(one[2]) == int(together[2][i, j])
            np.testing.assert_allclose(together[0][i, j], one[0], 0, 1e-13)
            np.testing.assert_allclose(together[3][i, j], one[3], 0, 1e-10)
