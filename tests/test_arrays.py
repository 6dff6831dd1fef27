"""A folded program is its function: the same values and derivatives, by fewer operations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffrax_conserve._fast.arrays import folded
from diffrax_conserve._fast.jaxprs import num_equations

N = 12
ORDER = np.random.default_rng(0).permutation(N)


def pieces(y):
    a, b, c = jnp.split(y, [4, 7])
    return jnp.concatenate([b, jnp.zeros(4), a * 2, c[1:]]) * y[1:].sum() + jnp.arange(15.0)


def rows(y):
    q = y.reshape(6, 2)
    links = q - jnp.concatenate([jnp.zeros((1, 2)), q[:-1]])
    lengths = jnp.sum(jnp.pad(links, ((1, 2), (0, 1))) ** 2, axis=1)
    return lengths, jnp.stack([q[1], -q[0]]), jnp.ravel(links, order="F")


def by_indices(y):
    moved = jnp.zeros(N).at[np.arange(3, 9)].set(y[2:8]).at[ORDER[:5]].add(1.0)
    return moved[ORDER], y[np.r_[0:3, 7:11]], moved.at[np.array([2, 2, 5])].add(y[:3]), y[::2]


def strided(y):
    """As the two nodes of each cell of a ladder."""
    a, b = y[0::2], y[1::2]
    return jnp.stack([a - b[::-1], b], 1).ravel()[1:], b[:-1] - a[1:], y[::3][1:][::2], a[2:4]


def chosen(y):
    known = np.arange(N) % 3 == 0
    return (
        jnp.where(known, y, 0.0) / jnp.where(y > 0, y, 1.0) - (0 - y),
        jnp.negative(-y),
        0 * y,
        y / 1,
    )


def spread(y):
    """Of a size of one that is spread, as in the lanes of a batch."""
    return jax.vmap(lambda k: jnp.ones(1) * (y + k))(jnp.arange(3.0)), jax.lax.mul(y[None], y[None])


def further(y):
    loop = jax.lax.fori_loop(0, 3, lambda _, x: jnp.sin(x), y)
    loop = loop * jax.random.normal(jax.random.key(0), y.shape)
    return loop + jax.nn.relu(y), jax.lax.cond(y[0] > 0, jnp.cos, jnp.exp, y), y @ jnp.ones((N, 2))


@pytest.mark.parametrize("fn", [pieces, rows, by_indices, strided, chosen, spread, further])
def test_values_and_derivatives_are_those_of_the_function(fn):
    y, direction = (jnp.sin(jnp.arange(1.0, N + 1) ** k) for k in (2, 3))
    same = folded(fn, y)
    for one, other in ((same, fn), (folded(same, y), fn)):
        values = [jax.jvp(f, (y,), (direction,)) for f in (one, other)]
        for a, b in zip(*map(jax.tree.leaves, values), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-15, atol=1e-15)
    total = lambda f: lambda y: sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(f(y)))  # noqa: E731
    np.testing.assert_allclose(jax.grad(total(same))(y), jax.grad(total(fn))(y), atol=1e-14)
    assert num_equations(jax.make_jaxpr(same)(y)) <= num_equations(jax.make_jaxpr(fn)(y))


def test_what_nobody_asks_for_is_left_out():
    """Of three parts the second, in which the first state and the slopes of the third vanish."""

    def equations(y, slopes):
        parts = jnp.sin(y[:4]), y[4:8] ** 2, jnp.cos(y[8:]) * slopes[8:]
        return jnp.concatenate(parts) - jnp.zeros(N).at[np.arange(4)].set(slopes[:4])

    y = jnp.ones(N)
    left = folded(lambda y: equations(y, jnp.zeros(N))[np.arange(4, 8)], y)
    names = [eqn.primitive.name for eqn in jax.make_jaxpr(left)(y).eqns]
    assert names == ["slice", "integer_pow"] or names == ["slice", "square"]


def test_a_derivative_of_a_derivative_does_not_double():
    """Of the lengths of a chain that moves along its velocities, four times."""

    def lengths(y):
        q = y[: N // 2].reshape(-1, 2)
        return jnp.sum((q - jnp.concatenate([jnp.zeros((1, 2)), q[:-1]])) ** 2, axis=1)

    def slopes(y):
        return jnp.zeros(N).at[np.arange(N // 2)].set(y[N // 2 :])

    y = jnp.cos(jnp.arange(1.0 * N))
    fn, plain, sizes = lengths, lengths, []
    for _ in range(4):
        fn = folded(lambda y, fn=fn: jax.jvp(fn, (y,), (slopes(y),))[1], y)
        plain = lambda y, fn=plain: jax.jvp(fn, (y,), (slopes(y),))[1]  # noqa: E731
        np.testing.assert_allclose(fn(y), plain(y), rtol=1e-14, atol=1e-14)
        sizes.append(num_equations(jax.make_jaxpr(fn)(y)))
    assert max(sizes) <= 16
    assert num_equations(jax.make_jaxpr(plain)(y)) > 100


def test_functions_that_close_over_tracers_and_those_with_effects():
    def scaled(y, k):
        return folded(lambda y: k * y[:3] - 0 * y[3:6], y)(y)

    y = jnp.arange(1.0, N + 1)
    np.testing.assert_array_equal(jax.vmap(scaled, (None, 0))(y, y[:2]), y[:2, None] * y[:3])
    assert jax.grad(lambda k: scaled(y, k).sum())(2.0) == 6

    def printing(y):
        jax.debug.print("{}", y[0], ordered=True)
        return y

    assert folded(printing, y) is printing


def test_numbers_that_are_none():
    mixed = np.array([0.0, -0.0, 0.0])
    fn = folded(lambda y: (jnp.full(3, jnp.nan) + y, mixed + 0 * y, 1 / y), jnp.ones(3))
    none, zeros, infinite = fn(jnp.zeros(3))
    assert np.isnan(none).all()
    assert np.isposinf(infinite).all()
    assert not zeros.any()


# Of a vector a vector.
OPERATIONS = (
    *(lambda x: x[::2], lambda x: x[1::3], lambda x: x[::-1], lambda x: x[1:]),
    *(lambda x: jnp.roll(x, 2), jnp.cumsum, lambda x: jnp.pad(x, (1, 2)), lambda x: jnp.tile(x, 2)),
    *(lambda x: jnp.repeat(x, 2), lambda x: x * jnp.arange(1.0, x.size + 1), jnp.sort),
    *(lambda x: jnp.concatenate([x, jnp.zeros(3), x[:1]]), lambda x: jnp.hstack([x[0], x])),
    *(lambda x: x.at[::2].set(0.0), lambda x: x.at[1:].add(x[:-1]), lambda x: jnp.sin(x) * 0.0),
    *(lambda x: jnp.stack([x, -x]).ravel(), lambda x: jnp.stack([x, 0 * x], 1).ravel()),
    *(lambda x: jnp.outer(x, x[:2]).sum(1), lambda x: x[np.array([0, -1, x.size // 2])]),
    *(lambda x: jnp.where(np.arange(x.size) % 2, x, 0.0), lambda x: jnp.convolve(x, jnp.ones(3))),
    *(lambda x: jnp.split(x, [x.size // 2])[1], lambda x: jax.lax.pad(x, 0.0, ((0, 0, 1),))),
    *(lambda x: jax.lax.scan(lambda c, v: (c + v, c * v), 0.0, x)[1], lambda x: x / (1 + x**2)),
    lambda x: jnp.ravel(jnp.stack([x, 2 * x]), order="F"),
)


@pytest.mark.slow
@pytest.mark.parametrize("first", range(len(OPERATIONS)))
def test_any_two_operations(first):
    y = jnp.sin(jnp.arange(1.0, N + 1) ** 2)
    for second in OPERATIONS:
        fn = lambda y, second=second: second(OPERATIONS[first](y))  # noqa: E731
        np.testing.assert_allclose(folded(fn, y)(y), fn(y), rtol=1e-12, atol=1e-12)
