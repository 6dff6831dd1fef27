"""The places of a Jacobian, beside those that differ from zero at numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffrax_conserve._large.detection import NotSparse, coloured, jacobian_places

N = 12
RNG = np.random.default_rng(0)
MATRIX = RNG.normal(size=(N, N)) * (RNG.random((N, N)) < 0.2)
ORDER, EVEN, THIRDS = RNG.permutation(N), np.arange(N) % 2, np.arange(N) // 3
STENCIL = np.array([1.0, -2.0, 1.0])


def square(y):
    return y.reshape(3, 4)


def scanned(y):
    return jax.lax.scan(lambda sum, x: (sum + x[0], sum * x[1]), 0.0, square(y).T[:, :2])[1]


def summed_up(y):
    return jax.lax.fori_loop(0, 5, lambda i, x: x.at[i + 1].add(x[i] ** 2), y)


def slices(y):
    return jax.vmap(lambda i: jax.lax.dynamic_slice(y, (i,), (2,)))(np.arange(5))


@jax.custom_jvp
def rounded(y):
    return jnp.round(y)


rounded.defjvp(lambda primals, tangents: (rounded(*primals), tangents[0][::-1]))


# Of these exactly the places are found that have a derivative.
EXACT = {
    "shifted": lambda y: jnp.roll(y, 2) * y,
    "differences": lambda y: jnp.diff(y, 2),
    "a constant matrix": lambda y: MATRIX @ jnp.sin(y),
    "products of rows": lambda y: square(y) @ square(y).T,
    "products in lanes": lambda y: jnp.einsum(
        "bij,bj->bi", y.reshape(3, 2, 2), y.reshape(2, 6).T[:3]
    ),
    "in another order": lambda y: y[ORDER] + y[::-1],
    "an order under jit": lambda y: jax.jit(lambda y: y[ORDER])(y),
    "from the end": lambda y: y[-3:] * y[-1],
    "filled": lambda y: y.at[np.array([1, 40])].get(mode="fill", fill_value=0),
    "set": lambda y: y.at[ORDER[:3]].set(2 * y[:3]),
    "added": lambda y: y.at[ORDER[:3]].add(y[:3] ** 2),
    "multiplied": lambda y: y.at[ORDER[:3]].multiply(y[:3] ** 2, unique_indices=True),
    "put into": lambda y: jax.lax.dynamic_update_slice(y, y[:2] ** 2, (5,)),
    "sums": lambda y: jnp.sum(square(y) ** 2, axis=1),
    "groups": lambda y: jax.ops.segment_sum(y, THIRDS, 4),
    "running sums": lambda y: jnp.cumsum(y),
    "running sums from the end": lambda y: jax.lax.cumsum(y, reverse=True),
    "norms": lambda y: jnp.linalg.norm(square(y), axis=1),
    "products": lambda y: jnp.prod(square(y), axis=0),
    "known choice": lambda y: jnp.where(EVEN == 0, y, y[0]),
    "known zeros": lambda y: y * EVEN + y[0],
    "edges": lambda y: jnp.pad(square(y), 1, mode="edge"),
    "parts": lambda y: jnp.concatenate([y[:2], jnp.zeros(3), y[5:]]),
    "tiles": lambda y: jnp.tile(y, 2),
    "constant": lambda y: jnp.ones(3),
    "steps": lambda y: jnp.floor(y) + jnp.sign(y),
    "not differentiated": lambda y: jax.lax.stop_gradient(y) * y[0],
    "a scan": scanned,
    "a loop of known length": summed_up,
    "slices at known places": slices,
    "branches": lambda y: jax.lax.cond(y[0] > 0, lambda y: y[::-1], lambda y: y, y),
    "a stencil": lambda y: jnp.convolve(y, STENCIL, mode="same"),
    "a stencil in two dimensions": lambda y: jax.scipy.signal.convolve2d(
        square(y), np.ones((3, 3)), mode="same"
    ),
    "a tangent": lambda y: jax.jvp(lambda y: jnp.roll(y, 1) * jnp.sin(y), (y,), (y,))[1],
    "a derivative rule of its own": rounded,
    "columns first": lambda y: jnp.ravel(square(y), order="F"),
    "random numbers": lambda y: y * jax.random.normal(jax.random.key(0), (N,)),
    "a gradient": jax.grad(lambda y: jnp.sum(y[1:] ** 2 * y[:-1])),
}
# Of these at least those.
MORE = {
    "largest": lambda y: jnp.max(square(y), axis=0),
    "largest of groups": lambda y: jax.ops.segment_max(y, THIRDS, 4),
    "sorted": lambda y: jnp.sort(square(y), axis=1),
    "a loop": lambda y: jax.lax.while_loop(
        lambda now: now[0] < 3, lambda now: (now[0] + 1, now[1] * jnp.roll(now[1], 1)), (0, y)
    )[1],
    "an inverse": lambda y: jnp.linalg.inv(y[:9].reshape(3, 3)),
    "a transform": lambda y: jnp.fft.fft(y).real,
    "places by roundoff": lambda y: y[(jnp.arange(N) * 0.7 + 0.1).astype(int)],
    "places out of range": lambda y: y.at[(jnp.arange(N) * 1e9).astype("int32")].get(mode="clip"),
    "unknown places": lambda y: y[jnp.argsort(y)],
}


@pytest.fixture(scope="module")
def jacobians():
    """Of all functions, in one program, at several states."""
    states = jnp.asarray(np.random.default_rng(1).normal(size=(5, N)))
    of = lambda y: {name: fn(y).ravel() for name, fn in (EXACT | MORE).items()}  # noqa: E731
    return jax.jit(jax.vmap(jax.jacfwd(of)))(states)


@pytest.mark.parametrize("name", [*EXACT, *MORE])
def test_no_place_is_missing_and_few_are_in_vain(name, jacobians):
    found = np.any(np.asarray(jacobians[name]) != 0, axis=0)
    places, fn = np.zeros_like(found), (EXACT | MORE)[name]
    places[jacobian_places(jax.make_jaxpr(lambda y: fn(y).ravel())(jnp.ones(N)))] = True
    assert not np.any(found & ~places)
    if name in EXACT:
        np.testing.assert_array_equal(places, found)


@jax.custom_vjp
def turned(y):
    return jnp.floor(y)


turned.defvjp(lambda y: (turned(y), y), lambda y, cotangent: (cotangent[::-1] * y,))


def test_a_derivative_rule_in_reverse_mode_alone_counts_as_dense():
    fn, y = lambda y: y[1:] * turned(y)[:-1], jnp.linspace(1.5, 3.0, N)
    places = np.zeros((N - 1, N), bool)
    places[jacobian_places(jax.make_jaxpr(fn)(y))] = True
    assert np.all(places | (jax.jacrev(fn)(y) == 0))


def test_numbers_that_are_arguments_may_have_any_values():
    pick = jax.make_jaxpr(lambda y, order: y[order])(jnp.ones(N), ORDER[:3])
    assert len(jacobian_places(pick)[0]) == 3 * N


def mean_width(y):
    """A kernel whose width is the mean distance."""
    distances = y[:, None] - y[None, :]
    return jnp.sum(jnp.exp(-(distances**2) / jnp.mean(distances**2)), axis=1)


def long_loops(y):
    """Sparse, but with a million equations."""
    loop = lambda fn: lambda _, y: jax.lax.fori_loop(0, 1000, fn, y)  # noqa: E731
    return loop(loop(lambda _, y: y + 0.1 * jnp.sin(y)))(0, y)


@pytest.mark.parametrize("fn", [lambda y: jnp.outer(y, y) @ y, mean_width, long_loops])
def test_what_would_take_much_memory_or_time_is_refused(fn):
    closed = jax.make_jaxpr(fn)(jax.ShapeDtypeStruct((10_000,), float))
    with pytest.raises(NotSparse):
        jacobian_places(closed)


def test_lines_of_one_colour_share_no_element():
    lines, across = np.nonzero(RNG.random((60, 40)) < 0.1)
    colours, number = coloured(lines, across, 60)
    pairs = {*zip(colours[lines].tolist(), across.tolist(), strict=True)}
    assert len(pairs) == len(lines)
    assert colours.max() + 1 == number <= 15


def test_lines_without_elements_need_no_colour():
    assert coloured(np.zeros(0, int), np.zeros(0, int), 3)[1] == 0
    assert coloured(np.array([1]), np.array([0]), 3)[1] == 1


def test_a_band_has_as_many_colours_as_elements_in_a_row():
    rows, columns = np.nonzero(np.tri(300, k=2) * np.tri(300, k=2).T)
    assert coloured(columns, rows, 300)[1] == 5
