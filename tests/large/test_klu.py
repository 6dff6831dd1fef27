"""Sparse linear systems against dense ones of numpy, and sparse Jacobians against dense ones."""

import functools as ft
import os
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffrax_conserve._large.klu import Factor, Places, sparse_jacobian

pytest.importorskip("klujax")


def _matrix(n, dtype, seed=0):
    """A sparse matrix whose rows and columns have units of very different sizes."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n)).astype(dtype)
    if np.iscomplexobj(a):
        a = a + 1j * rng.normal(size=(n, n))
    taken = (rng.random((n, n)) < 2 / n) | np.eye(n, dtype=bool)
    units = 10.0 ** rng.integers(-6, 6, n)
    return np.where(taken, a + 3 * np.eye(n), 0) * units[:, None] * units[::-1]


def _places(a):
    rows, columns = np.nonzero(a)
    places = Places(rows, columns, len(a))
    return places, jnp.asarray(a[places.rows, places.columns])


@pytest.mark.parametrize("dtype", [np.float64, np.complex128])
def test_solve_is_that_of_a_dense_matrix(dtype):
    a = _matrix(60, dtype)
    places, values = _places(a)
    b = np.random.default_rng(1).normal(size=60)
    want = np.linalg.solve(a, b)
    x = np.random.default_rng(2).normal(size=60)
    batch = np.stack([b, 2 * b, b[::-1]])

    @jax.jit
    def found(values, b, x, batch):
        lanes = jax.vmap(places.solve, (None, 0))
        many = jax.vmap(lambda v: lanes(v, batch))(jnp.stack([values, 3 * values]))
        return places.solve(values, b), places.matvec(values, x), lanes(values, batch), many

    one, product, several, many = found(values, b, x, batch)
    np.testing.assert_allclose(one, want, rtol=1e-8)
    np.testing.assert_allclose(product, a @ x, rtol=1e-12)
    np.testing.assert_allclose(several, np.linalg.solve(a, batch.T).T, rtol=1e-8)
    np.testing.assert_allclose(many[1], np.linalg.solve(3 * a, batch.T).T, rtol=1e-8)


@pytest.mark.parametrize("dtype", [np.float64, np.complex128])
def test_derivatives_are_those_of_a_dense_solve(dtype):
    places, values = _places(_matrix(12, dtype, 3))
    b = jnp.asarray(np.random.default_rng(2).normal(size=12), dtype)

    def dense(values, b):
        a = jnp.zeros((12, 12), dtype).at[places.rows, places.columns].set(values)
        return jnp.linalg.solve(a, b)

    orders = [jax.jacrev]
    if not np.iscomplexobj(b):
        orders += [jax.jacfwd, lambda f, n: jax.jacfwd(jax.grad(f, 0), n)]

    @jax.jit
    def derivatives(values, b):
        def of(solve):
            size = lambda values, b: jnp.sum(jnp.abs(solve(values * values, b)) ** 2)  # noqa: E731
            return [order(size, argument)(values, b) for order in orders for argument in (0, 1)]

        return of(places.solve), of(dense)

    for found, want in zip(*derivatives(values, b), strict=True):
        scale = np.max(np.abs(want))
        np.testing.assert_allclose(found / scale, want / scale, atol=1e-8)


def _singular(case, n=8):
    a = 3 * np.eye(n) + np.eye(n, k=1) + np.eye(n, k=-1)
    if case == "zero column":
        a[:, 2] = 0
    if case == "zero row":
        a[5] = 0
    if case == "zero":
        a[:] = 0
    if case == "equal rows":
        a[3] = a[4]
    if case == "sums to zero":
        a = a - np.diag(a.sum(1))
    if case == "three rows in two columns":
        a[:3, 2:] = 0
    if case == "rank one":
        a = np.ones((n, n))
    if case in ("nan", "inf"):
        a[3, 3] = float(case)
    return a


CASES = "zero column|zero row|zero|equal rows|sums to zero|three rows in two columns|rank one"


@pytest.mark.parametrize("factor", [1.0, 0.1, 0.1 + 0.7j])
def test_a_singular_matrix_gives_nan(factor):
    """Also where its zeros have places, and without harm to a lane that is regular."""
    names = [*CASES.split("|"), "nan", "inf", "regular"]
    matrices = np.stack([factor * _singular(name) for name in names])
    places = Places(*np.nonzero(np.ones_like(matrices[0])), len(matrices[0]))
    values = jnp.asarray(matrices[:, places.rows, places.columns])
    b = np.ones(len(matrices[0]))
    found = jax.jit(jax.vmap(places.solve, (0, None)))(values, b)
    assert np.all(np.isnan(found[:-1]))
    np.testing.assert_allclose(found[-1], np.linalg.solve(matrices[-1], b), rtol=1e-12)


@pytest.mark.parametrize("case", ["zero row", "equal rows", "three rows in two columns"])
def test_a_singular_matrix_without_places_for_its_zeros_gives_nan(case):
    places, values = _places(_singular(case))
    assert np.all(np.isnan(jax.jit(places.solve)(values, np.ones(places.size))))


def test_a_matrix_that_is_not_finite_gives_nan():
    n, rng = 400, np.random.default_rng(0)
    a = np.eye(n) * 4 - np.eye(n, k=1) - np.eye(n, k=20) - np.eye(n, k=-1) - np.eye(n, k=-20)
    places, values = _places(a)
    solve = jax.jit(places.solve)
    for bad in (np.nan, np.inf):
        some = np.where(rng.random(len(values)) < 0.3, bad, values)
        for one in (some, some.astype(complex), np.full(len(values), bad)):
            assert np.all(np.isnan(solve(one, np.ones(n))))


def test_an_ill_conditioned_matrix_is_regular():
    n = 40
    a = np.eye(n) - 0.4 * np.eye(n, k=1)
    a[-1, 0] = 1e-11
    places, values = _places(a * 10.0 ** np.linspace(-40, 40, n)[:, None])
    assert jax.jit(places.is_regular)(values)


def test_threads_and_loops():
    a = _matrix(200, np.float64, 5)
    places, values = _places(a)
    b = np.random.default_rng(3).normal(size=200)

    @jax.jit
    def looped(values, b):
        def body(i, x):
            return places.solve_regular(values, b + 0 * x)

        return jax.lax.fori_loop(0, 20, body, b)

    want, wrong = np.linalg.solve(a, b), []

    def run(k):
        for i in range(5):
            found = looped(np.asarray(values) * (1 + k + i), b)
            wrong.append(float(np.max(np.abs(found * (1 + k + i) / want - 1))))

    threads = [threading.Thread(target=run, args=(k,)) for k in range(4)]
    [t.start() for t in threads], [t.join() for t in threads]
    assert len(wrong) == 20
    assert max(wrong) < 1e-5


def _resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _solved_twice(places, values, b):
    """By one factor, also in a loop: `A⁻² b`."""
    factor = Factor(places, values)
    first = factor.solve(b)
    again = lambda i, x: factor.solve(jnp.where(i < 4, b, first) + 0 * x)  # noqa: E731
    second = jax.lax.fori_loop(0, 5, again, first)
    return factor.freed(second, second)[0]


@pytest.mark.parametrize("dtype", [np.float64, np.complex128])
def test_a_factor_that_is_kept_solves_alone_and_in_lanes(dtype):
    n = 40
    a = (
        np.eye(n)
        - 0.4 * np.eye(n, k=1)
        + 0.3 * np.eye(n, k=-3) * (1j if np.issubdtype(dtype, np.complexfloating) else 1)
    )
    places, values = _places(a.astype(dtype))
    solve = ft.partial(_solved_twice, places)
    bs = np.random.default_rng(1).normal(size=(2, 3, n)).astype(complex)
    want = np.linalg.solve(a @ a, bs.reshape(6, n).T).T.reshape(2, 3, n)
    np.testing.assert_allclose(solve(values, bs[0, 0]), want[0, 0], rtol=1e-12)
    np.testing.assert_allclose(jax.jit(solve)(values, bs[0, 0]), want[0, 0], rtol=1e-12)
    many = jnp.stack([values, 2 * values, values / 2])
    one = jax.jit(jax.vmap(jax.vmap(solve, (None, 0)), (None, 0)))
    np.testing.assert_allclose(one(values, bs), want, rtol=1e-12)
    two = jax.jit(jax.vmap(jax.vmap(solve, (0, 0)), (None, 0)))
    np.testing.assert_allclose(two(many, bs), want / np.array([1, 4, 0.25])[:, None], rtol=1e-12)
    three = jax.jit(jax.vmap(solve, (0, None)))
    np.testing.assert_allclose(three(many, bs[0, 0])[1], want[0, 0] / 4, rtol=1e-12)


@pytest.mark.parametrize("axes", [None, (None, 0), (0, 0)])
def test_each_factor_is_freed_once(axes):
    """Of a matrix that does not change in the loop too, and if two are equal."""
    n = 2000
    rows = np.concatenate([np.arange(n), np.arange(n - 1), np.arange(1, n)])
    places = Places(rows, np.concatenate([np.arange(n), np.arange(1, n), np.arange(n - 1)]), n)
    values = jnp.asarray(np.where(places.rows == places.columns, 4.0, 1.0))
    solve = ft.partial(_solved_twice, places)
    x = jnp.ones(n, complex)
    if axes is not None:
        solve, x = jax.vmap(solve, axes), jnp.ones((2, n), complex)
        values = values if axes[0] is None else jnp.stack([values, values])

    @jax.jit
    def looped(values, x):
        body = lambda i, x: 2.5 * (solve(values, x) + 0 * i) + solve(values, x)  # noqa: E731
        return jax.lax.fori_loop(0, 200, body, x)

    found = looped(values, x)
    assert np.all(np.isfinite(found))
    before = _resident()
    for _ in range(3):
        looped(values, x).block_until_ready()
    assert _resident() - before < 2e7  # of the 250 MB that 1,200 factors take


def test_a_factor_of_a_matrix_that_is_not_finite_gives_nan():
    places, values = _places(_matrix(30, np.float64))
    assert np.all(np.isnan(_solved_twice(places, values.at[3].set(jnp.nan), jnp.ones(30) + 0j)))


def test_kept_factors_in_threads():
    a = np.eye(300) * 4 - np.eye(300, k=1) - np.eye(300, k=-1) + 0.3 * np.eye(300, k=17)
    places, values = _places(a)
    b = np.random.default_rng(3).normal(size=300) + 0j
    want, wrong = np.linalg.solve(a @ a, b), []
    looped = jax.jit(
        lambda values, b: jax.lax.fori_loop(
            0, 50, lambda i, x: _solved_twice(places, values, b + 0 * x), b
        )
    )

    def run(k):
        for i in range(1, 6):
            found = looped(values * (k + i), b) * (k + i) ** 2
            wrong.append(float(np.max(np.abs(found / want - 1))))

    threads = [threading.Thread(target=run, args=(k,)) for k in range(4)]
    [t.start() for t in threads], [t.join() for t in threads]
    assert len(wrong) == 20
    assert max(wrong) < 1e-9


def test_the_import_leaves_the_settings_of_jax():
    code = (
        "import jax; jax.config.update('jax_enable_x64', False)\n"
        "read = lambda: [jax.config.read(n) for n in ('jax_enable_x64', 'jax_platform_name')]\n"
        "before = read()\n"
        "import diffrax_conserve, sys; assert 'klujax' not in sys.modules\n"
        "from diffrax_conserve._large.klu import available, klujax\n"
        "import jax.numpy as jnp; assert not available(jnp.float32)\n"
        "assert 'klujax' not in sys.modules; klujax(); assert read() == before, read()"
    )
    # klujax switches to double precision.
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_sparse_jacobian_is_the_dense_one():
    n = 100

    def fn(scale):
        def fn(x):
            y = scale * x**2 + jnp.roll(x, 1) * jnp.sin(jnp.roll(x, -2))
            return y.at[4].set(jnp.sum(x**3)).at[7].set(x @ jnp.arange(1.0, n + 1)).at[9].set(1.0)

        return fn

    x = jnp.linspace(0.3, 2.0, n)
    found = sparse_jacobian(fn(1.0), x)
    assert found.num_passes[0] <= 9
    assert found.num_passes[1] == 2
    assert list(found.dense_rows) == [4, 7]

    @jax.jit
    def dense(scale):
        places = sparse_jacobian(fn(scale), x)  # with a constant that is traced
        values = places.values(fn(scale), x)
        return jnp.zeros((n, n)).at[places.rows, places.columns].set(values)

    np.testing.assert_allclose(dense(2.0), jax.jacfwd(fn(2.0))(x), rtol=1e-14)
    places = Places(found.rows, found.columns, n)
    np.testing.assert_array_equal(places.rows, found.rows)
    np.testing.assert_array_equal(places.index(found.rows, found.columns), range(len(found.rows)))
