"""Laws of small programs: the same function, the same derivatives, and no operation twice."""

import diffrax as dfx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

import diffrax_conserve as dfc
from diffrax_conserve._constants import MAX_SCALAR_OPERATIONS
from diffrax_conserve._dae.dae import _Constraints, _structure
from diffrax_conserve._fast.arrays import folded
from diffrax_conserve._fast.jaxprs import jaxprs_inside
from diffrax_conserve._fast.scalars import scalarised, small, written_out

from .test_scalars import equations_in, names_of_arrays

Y = jnp.array([0.7, 1.3, 0.4])
# What a drawn function may do to two vectors. None makes numbers much larger.
STEPS = {
    "sum": lambda a, b: a + b,
    "difference": lambda a, b: a - b,
    "negative": lambda a, b: -a,
    "product": lambda a, b: a * b / (1 + b**2),
    "sine": lambda a, b: jnp.sin(a) * jnp.cos(b),
    "exponential": lambda a, b: jnp.exp(-(a**2)) - b,
    "order": lambda a, b: jnp.roll(a, 1) - b[jnp.array([2, 0, 0])],
    "matrix": lambda a, b: jnp.array([[0, 1, 0], [0.5, 0, -1], [0, 0, 0]]) @ a + b,
    "zeros": lambda a, b: jnp.zeros_like(a).at[1].set(a[0]) + b * jnp.array([0, 1, -1]),
    "set": lambda a, b: a.at[jnp.array([0, 2])].set(b[1:]),
    "add": lambda a, b: a.at[jnp.array([1, 1])].add(b[:2]),
    "where": lambda a, b: jnp.where(jnp.array([True, False, True]), a, b),
    "choice": lambda a, b: jnp.where(a > b, a, 2 * b),
    "norm": lambda a, b: a / jnp.sqrt(1 + jnp.sum(a * b) ** 2),
    "sort": lambda a, b: jnp.sort(a) + b,
    "loop": lambda a, b: lax.fori_loop(0, 2, lambda _, x: x / 2 + b, a),
    "solve": lambda a, b: jnp.linalg.solve(jnp.diag(1 + a**2) + 0.1, b),
    "derivative": lambda a, b: jax.jvp(lambda x: x**3 / (1 + x**2), (a,), (b,))[1],
    "again": lambda a, b: jax.jacfwd(jnp.sin)(a) @ b + jax.grad(lambda x: jnp.sum(x * b))(a),
}
STEP = st.tuples(st.sampled_from(sorted(STEPS)), st.integers(0, 9), st.integers(0, 9))


def in_full(fn, *like):
    """`small`, also where the function is smaller in arrays."""
    limit = lambda *_: MAX_SCALAR_OPERATIONS  # noqa: E731
    program = written_out(fn, like, limit, differentiated=True, zeros=True)
    assert program is not None
    return program


def function(steps):
    """Each step has two of the vectors before it as operands."""

    def fn(y):
        vectors = [y, y**2, 1 - y]
        for name, i, j in steps:
            vectors.append(STEPS[name](vectors[i % len(vectors)], vectors[j % len(vectors)]))
        return vectors[-1], jnp.sum(vectors[-2])

    return fn


def assert_near(got, expected):
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


@settings(max_examples=10)
@given(st.lists(STEP, min_size=1, max_size=5), st.sampled_from([in_full, folded]))
def test_a_small_program_is_the_function_with_its_derivatives(steps, in_full):
    """In both modes, of second order, in a batch, and once more written out."""
    fn = function(steps)

    @jax.jit
    def both(y):
        def of(fn):
            ways = [fn(y), jax.jacfwd(fn)(y), jax.jacrev(fn)(y)]
            along = lambda y: jax.jvp(fn, (y,), (jnp.ones_like(y),))[1]  # noqa: E731
            return [*ways, along(y), jax.jacfwd(along)(y)], along

        program = in_full(fn, y)
        (expected, along), (got, _) = of(fn), of(program)
        twice = in_full(lambda y: jax.jvp(program, (y,), (jnp.ones_like(y),))[1], y)
        lanes = jax.vmap(program)(jnp.stack([y, 2 * y, -y]))
        alone = jax.vmap(fn)(jnp.stack([y, 2 * y, -y]))
        return (got, twice(y), lanes), (expected, along(y), alone)

    assert_near(*both(Y))


INDICES = st.lists(st.integers(-9, 9), min_size=2, max_size=2)


@settings(max_examples=30)
@given(INDICES, INDICES, st.sampled_from(["clip", "fill"]), st.integers(0, 2))
def test_indices_move_the_elements_that_jax_moves(rows, columns, mode, kind):
    """Also outside, where they are clipped, filled or dropped, and under `vmap`."""
    i, j = np.array(rows), np.array(columns)
    x = jnp.arange(1.0, 25.0).reshape(2, 3, 4)
    into = "clip" if mode == "clip" else "drop"

    def fn(x):
        if kind == 0:
            taken = x.at[:, i, j].get(mode=mode), x.at[0, i].get(mode=mode, fill_value=7.0)
            return *taken, jnp.take(x, i, axis=1, mode=mode)
        if kind == 1:
            one = x.at[:, i, 1].set(-1.0, mode=into), x.at[0, i, j].add(x[1, 0, :2], mode=into)
            return *one, lax.dynamic_slice(x, (0, rows[0], rows[1]), (1, 2, 3))
        lanes = jax.vmap(lambda x, i: (x.at[i].get(mode=mode), x.at[i].add(x[0], mode=into)))
        return lanes(x, i), jax.vmap(lambda i: x[0].at[i].get(mode=mode), 0, 1)(i)

    program, results = in_full(fn, x), jax.tree.leaves(fn(x))
    for one in (program, folded(fn, x)):
        for got, expected in zip(jax.tree.leaves(one(x)), results, strict=True):
            np.testing.assert_array_equal(got, expected)
    left = [eqn.primitive.name for eqn in equations_in(jax.make_jaxpr(program)(x).jaxpr)]
    assert not {"gather", "scatter", "scatter-add", "dynamic_slice"} & set(left)


def names(fn, *like):
    """The operations of a small program on scalars."""
    equations = equations_in(jax.make_jaxpr(in_full(fn, *like))(*like).jaxpr)
    scalar = lambda eqn: not any(var.aval.ndim for var in (*eqn.invars, *eqn.outvars))  # noqa: E731
    return sorted(eqn.primitive.name for eqn in equations if scalar(eqn))


def test_no_operation_stands_twice_and_none_is_idle():
    x = jnp.ones(())
    assert names(lambda x: jnp.sin(x) + jnp.sin(x) * jnp.sin(x), x) == ["add", "mul", "sin"]
    assert names(lambda x: (0 + 1 * x - 0, x - x * -1), x) == ["add"]
    assert names(lambda x: jnp.negative(-x) * (-x), x) == ["mul", "neg"]
    assert names(lambda x: jnp.zeros(3).at[1].set(x) @ jnp.arange(3.0), x) == []
    assert names(lambda x: jnp.where(jnp.arange(3) > 3, jnp.exp(x), x)[0], x) == []
    assert names(lambda x: [jnp.exp(x), 2 * x][1], x) == ["mul"]


def test_a_product_with_zero_is_nothing_only_in_a_small_program():
    """Where a function is conserved it keeps its NaN."""
    x, fn = jnp.array(-1.0), lambda x: 1 + 0 * jnp.sqrt(x)
    assert in_full(fn, x)(x) == 1
    assert jnp.isnan(scalarised(fn, x)(x))


def test_only_a_primitive_without_a_rule_stays_in_arrays():
    def fn(y):
        return jnp.cumsum(y * y[::-1]) @ jnp.sin(y)

    assert names_of_arrays(jax.make_jaxpr(in_full(fn, Y))(Y).jaxpr) == {"cumsum"}


def test_a_function_that_is_not_small_or_prints_stays_as_it_is():
    def prints(y):
        jax.debug.print("{}", y)
        return y

    large = jnp.ones(MAX_SCALAR_OPERATIONS)
    for fn, y in (
        (prints, Y),
        (jnp.sin, jnp.ones(MAX_SCALAR_OPERATIONS + 1)),
        (lambda y: y * y + 1, large),
    ):
        assert small(fn, y) is fn
    for fn in (jnp.sin, lambda y: y * y):  # smaller in arrays
        assert small(fn, Y) is fn
    # What is idle does not count.
    idle = lambda y: jax.jacfwd(lambda x: jnp.sum(x * x))(y)  # noqa: E731
    assert small(idle, Y) is not idle


def test_the_hidden_constraints_of_a_pendulum_are_as_by_hand():
    """`|q|² - 1`, `2 q·v` and `2 (v·v - force |q|² - g q₂)`: 30 operations, written out by hand."""

    def pendulum(t, y, dy, g):
        (q, v, force), (dq, dv, _) = y, dy
        return dq - v, dv + force * q + g * jnp.array([0.0, 1.0]), jnp.sum(q**2) - 1

    dae, y, g = dfc.DAE(residual=pendulum), (Y[:2], Y[1:], Y[0]), jnp.array(9.81)
    found = jax.make_jaxpr(lambda y: _Constraints(dae)(0.0, y, g))(y)
    scalar = [e for e in equations_in(found.jaxpr) if not any(v.aval.ndim for v in e.outvars)]
    assert len([e for e in scalar if e.invars]) <= 30 + 10  # and ten that take arrays apart
    (q, v, force), got = y, _Constraints(dae)(0.0, y, g)
    by_hand = q @ q - 1, 2 * q @ v, 2 * (v @ v - force * q @ q - g * q[1])
    np.testing.assert_allclose(np.concatenate(got), jnp.stack(by_hand), rtol=1e-14)


def test_whether_equations_contain_slopes_is_told_by_their_program():
    """Lagrange's equations of a top on a rod, whose mass matrix depends on the angles. Whether the
    structure fits a state would take several times as many operations as the constraints, so it is
    asked only where numbers decide."""

    def energy(q, v):
        return (v[0] ** 2 + (v[1] * jnp.sin(q[0])) ** 2 + (v[2] + v[1] * jnp.cos(q[0])) ** 2) / 2

    def top(t, y, dy, some=0.0):
        (q, v, force), (dq, dv, df) = y, dy
        momentum = jax.jvp(lambda q, v: jax.grad(energy, 1)(q, v), (q, v), (v, dv))[1]
        forces = jnp.array([0, 0, force])
        return dq - v, jax.grad(energy)(q, v) + forces - momentum, q[2] - q[1] + some * df

    y, some = (Y, Y[::-1], Y[0]), jnp.array(0.0)
    without = dfc.DAE(residual=lambda t, y, dy, args: top(t, y, dy))
    assert _structure(without, 0.0, y, None).always_fits
    perhaps = dfc.DAE(residual=top).at(y, args=some)
    assert not _structure(perhaps, 0.0, y, some).always_fits


def num_calls(name, closed):
    """How often a function under `jax.jit` stands in a program, loops and branches included."""
    own = sum(eqn.params.get("name") == name for eqn in closed.jaxpr.eqns)
    inside = (x for eqn in closed.jaxpr.eqns for x in jaxprs_inside(eqn))
    return own + sum(num_calls(name, x) for x in inside)


def test_many_constraints_are_linearised_once_where_a_state_is_the_same():
    """At the candidate, at the result, and in the test of the start: each was most of the time to
    compile where the functions are large."""
    squares = dfc.FirstIntegral(lambda t, y, args: y[:20] ** 2 + jnp.roll(y, 1)[:20])
    solver, term = dfc.ManifoldProjection(dfx.Euler(), squares), dfx.ODETerm(lambda t, y, args: -y)

    def step(y):
        state = solver.init(term, 0.0, 1.0, y, None)
        return solver.step(term, 0.0, 0.1, y, None, state, False)[0]

    assert num_calls("linearise", jax.make_jaxpr(step)(jnp.linspace(1.0, 2.0, 30))) == 3


def test_many_constraints_may_have_a_rule_for_reverse_mode_alone():
    square = jax.custom_vjp(lambda y: y**2)
    square.defvjp(lambda y: (y**2, y), lambda y, given: (2 * y * given,))
    squares = dfc.FirstIntegral(lambda t, y, args: square(y[:20]))
    y, info = dfc.project(squares, jnp.linspace(1.0, 2.0, 30), value=jnp.linspace(1.1, 4.0, 20))
    assert info.ok
    np.testing.assert_allclose(y[:20] ** 2, jnp.linspace(1.1, 4.0, 20), rtol=1e-15)
