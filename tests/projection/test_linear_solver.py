"""`linear_solver=`: solves by lineax lead to the projection that elimination leads to."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import lineax as lx
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..thinned import some_of

EPS = np.finfo(np.float64).eps
KEPLER = dfc.systems.get("kepler")
PROJECTIONS = [dfc.SimplifiedNewton, dfc.Newton]
# An absolute tolerance, too: it is relative to the right-hand side.
SOLVERS = [lx.Cholesky(), lx.SVD(), lx.CG(1e-10, 1e-10), lx.AutoLinearSolver(well_posed=None)]


def name(x):
    return type(x).__name__ if isinstance(x, lx.AbstractLinearSolver) else x.__name__


def chained(count):
    """Constraints of which each shares a component with the next one."""
    return dfc.FirstIntegral(lambda t, y, args: y[:count] ** 2 + y[1 : count + 1])


def candidate(count):
    return 1 + 0.1 * jnp.sin(jnp.arange(count + 1.0)), 1e-3 * jnp.cos(3 * jnp.arange(count + 1.0))


def projected(manifold, value, projection):
    def final(y):
        found, info = dfc.project(manifold, y, value=value, projection=projection)
        total = sum(jnp.sum(jnp.sin(3 * x)) for x in jax.tree.leaves(found))
        return total, (found, info)

    return jax.jit(jax.value_and_grad(final, has_aux=True))


def agree(manifold, y0, y, projection, *linear_solvers, **options):
    value = jax.tree.map(
        lambda entry: entry.fn(0.0, y0, None),
        manifold,
        is_leaf=lambda x: isinstance(x, dfc.FirstIntegral),
    )
    (_, (expected, _)), derivative = projected(manifold, value, projection(**options))(y)
    for linear_solver in linear_solvers:
        chosen = projection(**options, linear_solver=linear_solver)
        (_, (found, info)), gradient = projected(manifold, value, chosen)(y)
        assert info.ok
        for a, b in ((found, expected), (gradient, derivative)):
            for x, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
                np.testing.assert_allclose(x, other, rtol=0, atol=1e-11)


PAIRS = {
    f"{name(projection)}-{name(solver)}": (projection, solver)
    for solver in SOLVERS
    for projection in PROJECTIONS
}


@some_of("projection,linear_solver", PAIRS.values(), ids=PAIRS, period=4)
def test_few_constraints(projection, linear_solver):
    y = jax.tree.map(lambda x: x + 1e-3 * jnp.arange(1, x.size + 1), KEPLER.y0)
    agree(KEPLER.manifold, KEPLER.y0, y, projection, linear_solver)


@pytest.mark.slow
@pytest.mark.parametrize("count", [20, 150])
def test_many_constraints(count):
    y0, offset = candidate(count)
    solvers = lx.Cholesky(), lx.CG(1e-12, 0.0)
    agree(chained(count), y0, y0 + offset, dfc.SimplifiedNewton, *solvers)


@pytest.mark.parametrize("linear_solver", [None, lx.Cholesky(), lx.CG(0.5, 0.5)])
def test_the_derivative_far_from_the_manifold(linear_solver):
    """Where the two Jacobians of the implicit function theorem are not alike."""

    def g(t, y, args):
        return jnp.stack([y[0] ** 4 + 2 * y[1] ** 2 + y[2] ** 2 * y[1] - 1, y[2] - y[0] * y[1]])

    projection = dfc.SimplifiedNewton(linear_solver=linear_solver)
    project = jax.jit(lambda x: dfc.project(dfc.Constraint(g), x, projection=projection))
    x, v, h = jnp.array([1.27614744, 0.97407117, 0.56399029]), jnp.array([1.0, 0.3, 0.0]), 1e-4
    assert project(x)[1].ok
    near, far = (project(x + s * v)[0] - project(x - s * v)[0] for s in (h, 2 * h))
    _, slope = jax.jvp(lambda x: project(x)[0], (x,), (v,))
    np.testing.assert_allclose(slope, (8 * near - far) / (12 * h), atol=1e-9)


MANY = chained(150)


@jax.jit
def differences_and_derivatives(y0, x, v):
    """Along `v`, of the projection of `x` to the level set of `y0`."""

    def project(x):
        return dfc.project(MANY, x, value=MANY.fn(0.0, y0, None))

    steps = 1e-5 * jnp.array([0.0, 1.0, -1.0, 2.0, -2.0])
    ends, infos = jax.lax.map(lambda s: project(x + s * v), steps)
    found = ends[1] - ends[2], ends[3] - ends[4]
    _, slope = jax.jvp(lambda x: project(x)[0], (x,), (v,))
    (pulled,) = jax.vjp(lambda x: project(x)[0], x)[1](v)
    return infos.ok[0], found, slope, pulled


@pytest.mark.slow
@pytest.mark.parametrize("distance", [1e-4, 1e-2, 0.1, 0.3])
def test_the_derivative_with_many_constraints_is_right_or_nan(distance):
    y0, offset = candidate(150)
    x, v = y0 + distance * 1e3 * offset, jnp.cos(jnp.arange(151.0))
    ok, (near, far), slope, pulled = differences_and_derivatives(y0, x, v)
    if ok and jnp.all(jnp.isfinite(slope)):
        np.testing.assert_allclose(slope, (8 * near - far) / 12e-5, atol=1e-7)
        np.testing.assert_allclose(v @ pulled, v @ slope, rtol=1e-7)
    if distance < 1e-3:
        assert jnp.all(jnp.isfinite(slope))


@pytest.mark.slow
def test_with_bounds_and_a_metric():
    y0, offset = candidate(3)
    agree(chained(3), y0, y0 + offset, dfc.SimplifiedNewton, lx.Cholesky(), lower=0.95, metric=2.0)


def test_it_is_an_option_of_a_solve():
    @eqx.filter_jit
    def final(linear_solver):
        solver = dfc.ManifoldProjection(
            dfx.Tsit5(),
            KEPLER.manifold,
            projection=dfc.SimplifiedNewton(linear_solver=linear_solver),
        )
        return dfx.diffeqsolve(
            dfx.ODETerm(KEPLER.vector_field), solver, 0.0, 5.0, 0.1, KEPLER.y0,
            saveat=dfx.SaveAt(t0=True, steps=True), max_steps=64,
        )  # fmt: skip

    found, expected = final(lx.SVD()), final(None)
    for a, b in zip(found.ys, expected.ys, strict=True):
        used = np.isfinite(expected.ts)
        np.testing.assert_allclose(a[used], b[used], atol=1e-12)
    drift = dfc.drift(found, KEPLER.manifold)
    assert all(jnp.max(jnp.abs(x[used])) < 16 * EPS for x in drift.values())


def test_a_solver_of_another_library_is_refused():
    jaxtyping.config.update("jaxtyping_disable", True)  # which finds it first
    try:
        for projection in PROJECTIONS:
            with pytest.raises(TypeError, match="`linear_solver` is 'cholesky'"):
                projection(linear_solver="cholesky")
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
