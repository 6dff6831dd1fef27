"""Many constraints: the rows are never formed, and nothing else changes."""

import math

import diffrax as dfx
import jax
import jax.extend.core
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import diffrax_conserve as dfc
from diffrax_conserve._projection import linearise as _jacobian
from diffrax_conserve._projection.jacobian import estimated_norms
from diffrax_conserve._projection.linearise import DENSE_MAX

from ..problems import solve

EPS = float(np.finfo(float).eps)
BONDS = DENSE_MAX + 22


def bonds(t, q, args):
    return jnp.sum(jnp.diff(q, axis=0) ** 2, -1) - args


CHAIN = dfc.Constraint(bonds)


def chain(count=BONDS, noise=1e-4):
    rng = np.random.default_rng(0)
    d = rng.normal(size=(count, 3))
    q = np.concatenate([np.zeros((1, 3)), np.cumsum(d / np.linalg.norm(d, axis=1)[:, None], 0)])
    return jnp.asarray(q + noise * rng.normal(size=q.shape))


@jax.jit
def projected(q, length=1.0):
    return dfc.project(CHAIN, q, args=length, projection=dfc.SimplifiedNewton())


def test_the_rows_are_never_formed():
    jaxpr = jax.make_jaxpr(projected)(chain())

    def shapes(jaxpr):
        for equation in jaxpr.eqns:
            for variable in equation.outvars:
                yield variable.aval.size
            for sub in jax.extend.core.jaxprs_in_params(equation.params):
                yield from shapes(sub)

    # One row is 3 (BONDS + 1) numbers; the probes of the norms are 16 states.
    assert max(shapes(jaxpr.jaxpr)) <= 32 * 3 * (BONDS + 1) < 3 * (BONDS + 1) * BONDS


def test_it_agrees_with_the_dense_solver(monkeypatch):
    q = chain()
    y, info = projected(q)
    assert info.residual_after <= 1e-15
    assert float(jnp.max(jnp.abs(bonds(0.0, y, 1.0)))) <= 1e-13
    monkeypatch.setattr(_jacobian, "DENSE_MAX", 10**6)
    # A function of its own, as what was compiled before knows the other number.
    dense, _ = jax.jit(lambda q: projected.__wrapped__(q))(q)
    np.testing.assert_allclose(y, dense, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_derivatives_agree_with_finite_differences():
    q, rng = chain(), np.random.default_rng(1)
    d, h = jnp.asarray(rng.normal(size=q.shape)), 1e-6

    @jax.jit
    def value(q, length):
        return jnp.sum(jnp.sin(projected(q, length)[0]))

    dq, dl = jax.jit(jax.grad(value, (0, 1)))(q, 1.0)
    difference = (value(q + h * d, 1.0 + h) - value(q - h * d, 1.0 - h)) / (2 * h)
    np.testing.assert_allclose(jnp.sum(dq * d) + dl, difference, rtol=1e-6)
    _, forward = jax.jvp(value, (q, 1.0), (d, 1.0))
    np.testing.assert_allclose(forward, jnp.sum(dq * d) + dl, rtol=1e-9)


def test_a_lane_of_a_batch_is_that_lane_alone():
    qs = jnp.stack([chain(noise=1e-4), chain(noise=1e-3)])
    batch, info = jax.jit(jax.vmap(projected))(qs)
    assert bool(jnp.all(info.residual_after <= 1e-15))
    for q, y in zip(qs, batch, strict=True):
        np.testing.assert_allclose(y, projected(q)[0], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_redundant_constraints_change_nothing():
    twice = {"once": CHAIN, "again": CHAIN}
    q = chain()
    project = jax.jit(lambda q: dfc.project(twice, q, args=1.0, projection=dfc.SimplifiedNewton()))
    y, info = project(q)
    assert info.residual_after <= 1e-15
    np.testing.assert_allclose(y, projected(q)[0], rtol=0, atol=1e-11)


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_dependent_linear_constraints_against_their_pseudoinverse(dtype):
    rng, eps = np.random.default_rng(0), float(jnp.finfo(dtype).eps)
    rows = rng.normal(size=(DENSE_MAX + 2, 200))
    rows[-20:] = rng.normal(size=(20, DENSE_MAX - 18)) @ rows[:-20] / 10
    y0, ys = rng.normal(size=200), rng.normal(size=(3, 200))
    ys = jnp.asarray(y0 + np.array([1e-4, 1e-2, 1.0])[:, None] * ys, dtype)
    y0, matrix = jnp.asarray(y0, dtype), jnp.asarray(rows, dtype)
    integrals = dfc.FirstIntegral(lambda t, y, args: matrix @ y, value=matrix @ y0)

    @jax.jit
    @jax.vmap
    def projected(y):
        project = lambda y: dfc.project(integrals, y, projection=dfc.SimplifiedNewton())  # noqa: E731
        return *project(y), jax.grad(lambda y: jnp.sum(jnp.sin(project(y)[0])))(y)

    found, info, gradients = projected(ys)
    assert np.all(info.ok)
    assert found.dtype == dtype
    inverse = np.linalg.pinv(rows, rcond=1e-10)
    exact = ys - (ys @ rows.T - rows @ y0) @ inverse.T
    np.testing.assert_allclose(found, exact, atol=100 * eps)
    cosines = np.cos(exact)
    np.testing.assert_allclose(gradients, cosines - cosines @ inverse @ rows, atol=200 * eps)


@pytest.mark.parametrize("near", [1e-6, 1e-8, 1e-10])
def test_the_derivative_with_nearly_dependent_constraints_is_right_or_nan(near):
    rng, n, m = np.random.default_rng(0), 200, DENSE_MAX + 4
    rows, y, v = rng.normal(size=(m, n)), rng.normal(size=n), rng.normal(size=n)
    rows[-40:] = rows[:40] + near * rng.normal(size=(40, n))
    _, slope = _slope(rows, y, rows @ y, v)
    _, _, basis = np.linalg.svd(rows, full_matrices=False)
    error = np.abs(slope - (v - basis.T @ (basis @ v)))
    assert np.all(np.isnan(error)) or np.max(error) < 1e-3


@jax.jit
def _slope(rows, y, values, v):
    def project(y):
        integrals = dfc.FirstIntegral(lambda t, y, rows: rows @ y)
        simplified = dfc.SimplifiedNewton()
        return dfc.project(integrals, y, args=rows, value=values, projection=simplified)[0]

    return jax.jvp(project, (y,), (v,))


def test_the_scale_of_terms_that_do_not_cancel():
    """Their sum is as large as that of their moduli, and so is the roundoff."""
    rng = np.random.default_rng(1)
    matrix, y = rng.uniform(0.5, 1.5, (DENSE_MAX + 2, 2000)), rng.uniform(0.5, 1.5, 2000)
    kept = dfc.Constraint(lambda t, y, b: jnp.asarray(matrix) @ y - b)
    project = jax.jit(lambda y, b: dfc.project(kept, y, args=b, projection=dfc.SimplifiedNewton()))
    _, info = project(y * (1 + 1e-6 * rng.normal(size=2000)), matrix @ y)
    assert info.ok
    _, info = project(1.001 * y, matrix @ y)
    # The residual is a thousandth of the sum of the moduli.
    np.testing.assert_allclose(info.residual_before, 1e-3, rtol=0.01)


def test_contradicting_constraints_fail():
    other = dfc.Constraint(lambda t, q, args: bonds(t, q, 1.01 * args))
    both, simplified = [CHAIN, other], dfc.SimplifiedNewton()
    _, info = jax.jit(lambda q: dfc.project(both, q, args=1.0, projection=simplified))(chain())
    assert info.result != optx.RESULTS.successful


@pytest.mark.slow
def test_a_solve_keeps_every_constraint_at_every_saved_time():
    def free_rotation(t, q, args):  # rigid, so that it keeps the bonds
        return jnp.cross(jnp.array([0.0, 0.3, 1.0]), q)

    y0, _ = projected(chain())
    sol = solve(
        free_rotation,
        dfc.ManifoldProjection(dfx.Heun(), CHAIN),
        y0,
        args=1.0,
        t1=0.3,
        saveat=dfx.SaveAt(ts=jnp.linspace(0, 0.3, 5)),
    )
    assert float(jnp.max(jnp.abs(dfc.drift(sol, CHAIN, 1.0)))) <= 2e-15


def test_estimated_norms_are_right_to_a_factor_of_two():
    rng = np.random.default_rng(2)
    matrix = jnp.asarray(rng.normal(size=(300, 40)) * np.logspace(-6, 6, 300)[:, None])
    weights = jnp.asarray(rng.uniform(0.5, 2, size=40))
    estimate = estimated_norms(lambda y: matrix @ y, weights)
    ratio = estimate / np.linalg.norm(matrix * weights, axis=1)
    assert float(jnp.min(ratio)) > 0.4
    assert float(jnp.max(ratio)) < 2


@pytest.mark.slow
def test_newton_copes_with_many_constraints():
    y, info = jax.jit(lambda q: dfc.project(CHAIN, q, args=1.0))(chain(noise=1e-2))
    assert info.residual_after <= 4e-15
    assert float(jnp.max(jnp.abs(bonds(0.0, y, 1.0)))) <= 1e-12


def test_a_large_state_takes_no_iteration_more_than_it_needs():
    def energy(t, y, args):
        return jnp.sum(y**4) / 4

    integral = dfc.FirstIntegral(energy, value=2.0)
    project = jax.jit(lambda y: dfc.project(integral, y, projection=dfc.SimplifiedNewton()))
    y = np.random.default_rng(3).normal(size=1000)
    y *= (2.0 / energy(0.0, y, None)) ** 0.25
    counts = []
    for off in (1e-9, 1e-5, 1e-2):
        found, info = project(y * (1 + off))
        counts.append(int(info.num_steps))
        assert info.ok
        exact = math.fsum(float(x) ** 4 for x in found) / 4
        scale = 2.0 + math.fsum(float(x) ** 4 for x in found)
        assert abs(exact - 2.0) <= 16 * EPS * scale
    assert counts[0] == 1 < counts[1] < counts[2]
    _, infos = jax.jit(jax.vmap(project))(np.stack([y * (1 + off) for off in (1e-9, 1e-5, 1e-2)]))
    assert infos.num_steps.tolist() == counts
