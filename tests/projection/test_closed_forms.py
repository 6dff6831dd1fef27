"""Density matrices, rotation matrices and unit vectors, by formulas."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import polar
from scipy.optimize import minimize

import diffrax_conserve as dfc
from diffrax_conserve import closed_forms

from ..problems import EPS
from ..thinned import some_of


def matrices(seed, *shape, kind=float):
    real, imaginary = np.random.default_rng(seed).normal(size=(2, *shape))
    return real + 1j * imaginary if kind is complex else real


def formula(projection):
    return jax.jit(lambda y: projection.fn(0.0, y, None, None))


FORMULAS = {
    "density": (formula(closed_forms.density_matrix()), matrices(0, 4, 4, kind=complex)),
    "mixed": (formula(closed_forms.density_matrix()), np.eye(3) / 3 + 0j),
    "real": (formula(closed_forms.density_matrix()), np.diag([0.6, 0.4, -0.5])),
    "rotation": (formula(closed_forms.rotation_matrix()), matrices(1, 2, 3, 3)),
    "identity": (formula(closed_forms.rotation_matrix()), np.eye(3)),
    "unit": (formula(closed_forms.unit_vector(axis=0)), matrices(2, 3, 2)),
    "qubit": (formula(closed_forms.unit_vector()), np.array([1.0, 0j])),
}


@some_of("name", FORMULAS, ids=FORMULAS, period=4)
def test_derivatives_agree_with_differences_where_eigenvalues_coincide_too(name):
    project, x = FORMULAS[name]
    v = matrices(3, *x.shape, kind=complex if np.iscomplexobj(x) else float)
    y, tangent = jax.jvp(project, (x,), (v,))
    np.testing.assert_allclose(project(y), y, rtol=0, atol=8 * EPS)  # idempotent
    difference = (project(x + 1e-6 * v) - project(x - 1e-6 * v)) / 2e-6
    np.testing.assert_allclose(tangent, difference, rtol=0, atol=2e-9)
    adjoint = jax.vjp(project, x)[1](w := matrices(4, *x.shape).astype(x.dtype))[0]
    np.testing.assert_allclose(jnp.sum(adjoint * v).real, jnp.sum(w * tangent).real, rtol=1e-12)


def test_the_nearest_rotation_against_scipy():
    project, xs = FORMULAS["rotation"]
    for x, y in zip(xs, project(xs), strict=True):
        assert np.linalg.det(y) > 0
        if np.linalg.det(x) > 0:
            np.testing.assert_allclose(y, polar(x)[0], rtol=0, atol=16 * EPS)
    assert np.max(np.abs(project(-xs) + project(xs))) > 0.1  # one of each pair is improper


def test_the_nearest_density_matrix_against_a_minimiser():
    """Among all `L L† / tr(L L†)`."""
    project, x = FORMULAS["density"]

    def distance(z):
        factor = z[0] + 1j * z[1]
        y = factor @ factor.conj().T
        return jnp.sum(jnp.abs(y / jnp.trace(y).real - x) ** 2)

    flat = jax.jit(jax.value_and_grad(lambda z: distance(z.reshape(2, 4, 4))))
    start = matrices(5, 32)
    least = minimize(flat, start, jac=True, method="BFGS", options={"gtol": 1e-8}).fun
    np.testing.assert_allclose(jnp.sum(jnp.abs(project(x) - x) ** 2), least, rtol=1e-9)


def test_large_matrices_have_positive_density_matrices_too():
    project, _ = FORMULAS["density"]
    y = project(1e4 * matrices(6, 50, 8, 8, kind=complex))
    assert np.min(np.linalg.eigvalsh(y)) > 0
    np.testing.assert_allclose(project(y), y, rtol=0, atol=8 * EPS)


def lindblad(hamiltonian, decays):
    def field(t, rho, args):
        h = hamiltonian(t)
        rates = [c @ rho @ c.conj().T for c in decays]
        losses = [c.conj().T @ c for c in decays]
        inner = sum(losses, jnp.zeros_like(rho))
        return -1j * (h @ rho - rho @ h) + sum(rates) - (inner @ rho + rho @ inner) / 2

    return field


X, Z = np.array([[0, 1], [1, 0]]) + 0j, np.diag([1.0, -1.0]) + 0j
DOWN, ONE = np.array([[0, 1], [0, 0]]) + 0j, np.eye(2) + 0j
QUBIT = lindblad(lambda t: Z / 2 + 2 * jnp.cos(t) * X, [0.1 * DOWN])
PAIR = lindblad(
    lambda t: np.kron(Z, Z) + jnp.cos(t) * np.kron(X, ONE),
    [0.3 * np.kron(DOWN, ONE), 0.1 * np.kron(ONE, DOWN)],
)


@pytest.mark.filterwarnings("ignore:Complex dtype")
@some_of("name", ["pair", "qubit"], period=2)
def test_a_density_matrix_stays_one(name):
    """From a pure state, whose other eigenvalues are zero."""
    field, n = (QUBIT, 2) if name == "qubit" else (PAIR, 4)
    trace = dfc.Constraint(lambda t, rho, args: jnp.trace(rho).real - 1)
    solver = dfc.ManifoldProjection(dfx.Tsit5(), trace, projection=closed_forms.density_matrix())
    rho0, saveat = (
        jnp.zeros((n, n), complex).at[0, 0].set(1),
        dfx.SaveAt(ts=jnp.linspace(0, 50, 1000)),
    )
    solve = jax.jit(
        lambda rho0: dfx.diffeqsolve(dfx.ODETerm(field), solver, 0, 50, 0.05, rho0, saveat=saveat)
    )
    states = np.asarray(solve(rho0).ys)
    assert np.all(states == states.conj().swapaxes(1, 2))
    assert np.max(np.abs(np.trace(states, axis1=1, axis2=2) - 1)) <= EPS
    assert np.min(np.linalg.eigvalsh(states)) >= -1e-16


@pytest.mark.slow
def test_rotations_in_a_part_of_the_state():
    """A steady rotation, 178 times around, beside another component."""
    spin = jnp.array([[0.0, -1.0, 0.5], [1.0, 0.0, 0.0], [-0.5, 0.0, 0.0]])
    unit = dfc.Constraint(lambda t, y, args: y["R"].mT @ y["R"] - jnp.eye(3))
    projection = closed_forms.rotation_matrix(lambda y: y["R"])
    solver = dfc.ManifoldProjection(dfc.RK4(), unit, projection=projection)
    field = dfx.ODETerm(lambda t, y, args: {"R": spin @ y["R"], "x": -y["x"]})
    y0, saveat = {"R": jnp.eye(3), "x": jnp.ones(())}, dfx.SaveAt(ts=jnp.linspace(0, 1000, 1000))
    solve = jax.jit(
        lambda y0: dfx.diffeqsolve(field, solver, 0, 1000, 0.1, y0, saveat=saveat, max_steps=10_001)
    )
    ys = solve(y0).ys
    assert np.max(np.abs(ys["R"].mT @ ys["R"] - np.eye(3))) <= 4 * EPS
    np.testing.assert_allclose(ys["x"][10], np.exp(-10_000 / 999), rtol=1e-4)


def test_wrong_input_is_explained():
    with pytest.raises(ValueError, match="no square matrix"):
        formula(closed_forms.density_matrix())(jnp.ones((2, 3)))
    with pytest.raises(TypeError, match="is real"):
        formula(closed_forms.rotation_matrix())(jnp.eye(2) + 0j)
    with pytest.raises(TypeError, match="`where` is of type `str`"):
        closed_forms.unit_vector("R")
    unit = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)
    assert not dfc.project(unit, jnp.zeros(3), projection=closed_forms.unit_vector())[1].ok
