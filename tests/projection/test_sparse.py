"""Many constraints: their sparse Jacobian against a dense one, in each order of blocks."""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from jaxtyping import Array

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct
from diffrax_conserve._large import sparse
from diffrax_conserve._numerics.metric import Diagonal
from diffrax_conserve._numerics.problem import Problem, problem_of
from diffrax_conserve._numerics.roundoff import _sampled, cancellation_terms

from ..problems import difference, largest, solve
from ..thinned import some_of

# So many that the row of a momentum counts as dense beside the rows of bonds.
NUM = 100


def _bonds(pairs: np.ndarray) -> dfc.Constraint:
    i, j = pairs.T
    return dfc.Constraint(lambda t, y, args: jnp.sum((y[i] - y[j]) ** 2, axis=1) - 1)


def _lattice(side: int) -> np.ndarray:
    """The bonds of a square lattice, too wide for blocks, and too many for a dense matrix."""
    of = np.arange(side**2).reshape(side, side)
    across = np.stack([of[:, :-1].ravel(), of[:, 1:].ravel()], 1)
    down = np.stack([of[:-1].ravel(), of[1:].ravel()], 1)
    return np.concatenate([across, down])


_CHAIN = np.stack([np.arange(NUM), np.arange(1, NUM + 1)], 1)
_TRIANGLES = (3 * np.arange(NUM)[:, None, None] + np.array([[0, 1], [0, 2], [1, 2]])).reshape(-1, 2)
# The name of a manifold, its entries, and the number of points.
MANIFOLDS: dict[str, tuple[Any, int]] = {
    "spins": (dfc.Constraint(lambda t, y, args: jnp.sum(y**2, axis=1) - 1), NUM),
    "triangles": (_bonds(_TRIANGLES), 3 * NUM),
    "chain": (_bonds(_CHAIN), NUM + 1),
    "shuffled chain": (_bonds(np.random.default_rng(0).permutation(_CHAIN)), NUM + 1),
    "ring": (_bonds(np.stack([np.arange(NUM), (np.arange(NUM) + 1) % NUM], 1)), NUM),
    "lattice": (_bonds(_lattice(12)), 144),
}
ENERGY = dfc.FirstIntegral(lambda t, y, args: jnp.sum(jnp.cos(y)) + jnp.sum(y[1:] * y[:-1]))
MOMENTUM = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y, axis=0))


CASES = [*((name, jnp.float64) for name in MANIFOLDS), ("triangles", jnp.float32)]


@some_of("name, dtype", CASES, period=7)
def test_products_and_solutions_are_those_of_the_dense_matrix(name: str, dtype: Any):
    """With an energy and a momentum beside the sparse rows, and in units of its own for each
    component, for a symmetric matrix and for one that is not."""
    entry, points = MANIFOLDS[name]
    manifold = {"a": ENERGY, "many": entry, "z": MOMENTUM}
    key = jr.split(jr.key(0), 5)
    y = jr.normal(key[0], (points, 3), dtype)
    beside = y + 0.01 * jr.normal(key[1], y.shape, dtype)
    values = jnp.zeros(jax.eval_shape(entry.fn, 0.0, y, None).size + 4, dtype)
    problem = problem_of(manifold, values, 0.0, y, None)
    problem = dataclasses.replace(
        problem, factor=Diagonal(jnp.exp(jr.normal(key[2], (y.size,), dtype)))
    )
    assert problem.pattern is not None
    x, multiplier = jr.normal(key[3], (y.size,), dtype), jr.normal(key[4], values.shape, dtype)

    def rows(problem: Problem, y: Array) -> Any:
        return problem.factor.scaled_rows(problem.linearise(y.reshape(-1))[1])

    @jax.jit
    def found() -> Any:
        a, b = rows(problem, y), rows(problem, beside)
        solved = (a.gram(other).solve(multiplier) for other in (a, b))
        return a.matvec(x), a.rmatvec(multiplier), *solved

    dense = dataclasses.replace(problem, pattern=None)
    a, b = (np.asarray(rows(dense, state).matrix, np.float64) for state in (y, beside))
    ahead, back, same, other = (np.asarray(z, np.float64) for z in found())
    eps = float(jnp.finfo(dtype).eps)

    def check(matrix: np.ndarray, solution: np.ndarray, right: Array, multiple: float) -> None:
        sizes = np.abs(matrix) @ np.abs(solution)
        assert np.max(np.abs(matrix @ solution - right)) <= multiple * eps * np.max(sizes)

    check(a, np.asarray(x), jnp.asarray(ahead), 16)
    check(a.T, np.asarray(multiplier), jnp.asarray(back), 16)
    # Roundoff is added to the diagonal, no pivots are sought, and iterations end at eps ** (3 / 4).
    multiple = eps ** (-1 / 4) if name == "lattice" else 4096
    check(a @ a.T, same, multiplier, multiple)
    check(a @ b.T, other, multiplier, multiple)


def test_units_of_any_ratio_in_a_wide_matrix():
    """Along a grid some underflow when they are squared. One point stays in its place."""
    entry, points = MANIFOLDS["lattice"]
    y = jr.normal(jr.key(2), (points, 3))
    count = jax.eval_shape(entry.fn, 0.0, y, None).size
    problem = problem_of({"many": entry}, jnp.zeros(count), 0.0, y, None)
    fine = jnp.where(jnp.arange(y.size) >= y.size // 2, 1e-180, 1.0)
    right = jr.normal(jr.key(3), (count,))

    def change(units: Array) -> Array:
        one = dataclasses.replace(problem, factor=Diagonal(units))
        scales, rows = one.gradients(y.reshape(-1)).equilibrated()
        multiplier = rows.gram(rows).solve(right / scales)
        return one.factor.to_state(rows.rmatvec(multiplier))

    jacobian = problem.linearise(y.reshape(-1))[1]
    # Bonds with an end in the coarse half are met by that end alone, so that the result solves.
    np.testing.assert_allclose(jacobian.matvec(change(fine)), right, rtol=1e-6)


@pytest.mark.parametrize(
    ("shift", "size", "dtype"),
    [(0.0, 40, jnp.float64), (1.0, 40, jnp.float64), (0.0, 20_000, jnp.float32)],
)
def test_the_roundoff_of_many_residuals_is_that_of_each_alone(shift: float, size: int, dtype: Any):
    """Sampled for all, within a factor of 2.5 of the sum of squares by a reverse pass for each; of
    many in single precision for a few of them."""
    y = jnp.linspace(0.5, 1.5, size, dtype=dtype) + shift
    some = np.arange(0, size, max(1, size // 40))

    def fn(y: Array) -> Array:
        return jnp.cos(y) * 1e3 - 1e3 * jnp.cos(y[::-1]) + jnp.cumsum(y**2) - jnp.roll(y, 1) * y

    each = cancellation_terms(lambda y: fn(y)[some], y)[2]
    ratio = _sampled(fn, y)[some] / each
    assert jnp.all((ratio > 0.4) & (ratio < 2.5)), ratio


def test_the_roundoff_of_the_steps_of_a_scan_is_independent():
    y = jnp.linspace(0.5, 1.5, 400)

    def fn(y: Array) -> Array:
        add = lambda total, x: (total + 1e3 * jnp.cos(x) - 1e3, None)  # noqa: E731
        return jax.lax.scan(add, jnp.zeros(()), y)[0][None]

    ratio = _sampled(fn, y) / cancellation_terms(fn, y)[2]
    assert 0.4 < ratio[0] < 2.5


@pytest.mark.slow
@some_of("name", ["spins", "lattice", "ring"], period=3)
def test_derivatives_are_those_by_differences(name: str):
    """Of a projection, in both modes: blocks, coupled blocks, and an iteration."""
    entry, points = MANIFOLDS[name]
    y, change = jr.normal(jr.key(1), (2, points, 3))
    at = lambda fn: dfc.FirstIntegral(fn, value=fn(0.0, y, None))  # noqa: E731
    manifold = {"many": at(entry.fn), "z": at(ENERGY.fn)}

    def projected(y: Array) -> Array:
        end, info = dfc.project(manifold, y, projection=dfc.SimplifiedNewton())
        return jnp.where(info.ok, end, jnp.nan)

    dct.assert_gradients(projected, y + 1e-3 * change, rtol=1e-6)


def test_constraints_given_twice_change_no_state_no_derivative_and_no_force():
    """Each block is singular."""
    y = jr.normal(jr.key(0), (40, 3))
    y = y / jnp.linalg.norm(y, axis=1, keepdims=True)
    lengths = dfc.Constraint(lambda t, y, args: jnp.sum(y**2, axis=1) - 1)
    weights = jnp.cos(jnp.arange(120.0)).reshape(40, 3)

    def found(manifold):
        projection = dfc.SimplifiedNewton()

        def total(y):
            end, info = dfc.project(manifold, y, projection=projection)
            return jnp.sum(weights * end), jnp.where(info.ok, end, jnp.nan)

        field = dfc.tangent(lambda t, y, args: weights, manifold)
        return jax.grad(total, has_aux=True)(1.01 * y), field(0.0, y, None)

    once, twice = eqx.filter_jit(found)(lengths), eqx.filter_jit(found)([lengths, lengths])
    assert difference(once, twice) < 1e-11


def test_functions_that_differ_in_an_inner_constant_have_their_own_pattern():
    """The text of both is the same."""

    def bonds(order: np.ndarray) -> dfc.Constraint:
        chosen = jax.jit(lambda y: y[order])
        return dfc.Constraint(lambda t, y, args: chosen(y) * jnp.roll(chosen(y), 1) - 0.5)

    for seed in range(2):
        order = np.random.default_rng(seed).permutation(NUM)
        problem = problem_of(bonds(order), jnp.zeros(NUM), 0.0, jnp.ones(NUM), None)
        dense = dataclasses.replace(problem, pattern=None)
        x, y = np.arange(NUM) * 1.0, np.linspace(1, 2, NUM)
        found, expected = (
            jax.jit(lambda x, y, e=e: e.linearise(y)[1].matvec(x))(x, y) for e in (problem, dense)
        )
        assert problem.pattern is not None
        np.testing.assert_allclose(found, expected)


def test_what_is_not_sparse_is_told(monkeypatch: pytest.MonkeyPatch):
    """Indices that are not known when the solve is traced could be any."""
    monkeypatch.setattr(sparse, "_LARGE", 0)
    pick = dfc.Constraint(lambda t, y, args: y[args] ** 2 - 1)
    chosen = lambda args: dfc.project(pick, jnp.full(50, 1.1), args=args)  # noqa: E731
    with pytest.warns(UserWarning, match=r"GiB\. A function that selects .* close over it"):
        jax.eval_shape(chosen, jnp.arange(NUM))


@pytest.mark.slow
def test_an_operation_of_which_no_pattern_is_known_has_a_dense_jacobian():
    inverses = dfc.Constraint(lambda t, y, args: jnp.trace(jnp.linalg.inv(y), axis1=1, axis2=2) - 2)
    y = jnp.eye(2) + 0.1 * jr.normal(jr.key(0), (NUM, 2, 2))
    projected, info = dfc.project(inverses, y, projection=dfc.SimplifiedNewton())
    assert info.ok
    assert jnp.max(jnp.abs(inverses.fn(0.0, projected, None))) < 1e-14


def test_a_solve_keeps_spins_and_their_energy():
    spins = MANIFOLDS["spins"][0]
    energy = dfc.FirstIntegral(lambda t, y, args: -jnp.sum(y[1:] * y[:-1]) - jnp.sum(y[:, 2] ** 2))

    def field(t: Any, y: Array, args: Any) -> Array:
        return jnp.cross(y, -jax.grad(lambda y: energy.fn(t, y, args))(y))

    y0 = jr.normal(jr.key(3), (NUM, 3))
    y0 = y0 / jnp.linalg.norm(y0, axis=1, keepdims=True)
    manifold = {"spins": spins, "energy": energy}
    solver = dfc.ManifoldProjection(diffrax.Heun(), manifold)
    saveat = diffrax.SaveAt(ts=jnp.linspace(0, 5, 30))

    @jax.jit
    def drift_and_off(y0: Array) -> Any:
        sol = solve(field, solver, y0, t1=5.0, dt0=0.05, saveat=saveat)
        return dfc.drift(sol, manifold), dfc.off_manifold(sol, manifold)

    drift, off = drift_and_off(y0)
    assert largest(drift) < 1e-14
    assert not jnp.any(off)
