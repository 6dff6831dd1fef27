"""Density matrices, rotation matrices and unit vectors, by formulas, and those of a user."""

import functools as ft

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import polar
from scipy.optimize import minimize

import diffrax_conserve as dfc
from diffrax_conserve import closed_forms

from ..problems import EPS, difference, oscillator, refused, solve
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


def test_of_a_positive_matrix_the_trace_is_shifted_whatever_is_beside_it():
    """Without eigenvalues: those of the other matrix of the batch are needed."""
    project, x = FORMULAS["density"]
    root = matrices(7, 4, 4, kind=complex)
    positive = root @ root.conj().T + np.eye(4)
    mixed = positive / np.trace(positive) * 1.01
    for given in (mixed, mixed + 1e-9 * root):
        hermitian = (given + given.conj().T) / 2
        want = hermitian + (1 - np.trace(hermitian).real) / 4 * np.eye(4)
        np.testing.assert_allclose(project(given), want, rtol=0, atol=2 * EPS)
        both = jax.vmap(project)(np.stack([given, x]))
        np.testing.assert_array_equal(both[0], project(given))
        np.testing.assert_array_equal(both[1], project(x))


Z, X = np.diag([1.0 + 0j, -1]), np.array([[0j, 1], [1, 0]])
DOWN = np.array([[0j, 1], [0, 0]])


def decaying_qubit(t, rho, args):
    """A driven qubit in the equation of Lindblad."""
    h, excited = Z / 2 + 2 * jnp.cos(t) * X, DOWN.T @ DOWN
    lost = (excited @ rho + rho @ excited) / 2
    return -1j * (h @ rho - rho @ h) + 0.01 * (DOWN @ rho @ DOWN.T - lost)


@pytest.mark.filterwarnings("ignore:Complex dtype")
def test_a_density_matrix_stays_one():
    """From a pure state, whose other eigenvalue is zero."""
    trace = dfc.Constraint(lambda t, rho, args: jnp.trace(rho).real - 1)
    solver = dfc.ManifoldProjection(dfx.Tsit5(), trace, projection=closed_forms.density_matrix())
    saveat, rho0 = dfx.SaveAt(ts=jnp.linspace(0, 50, 1000)), jnp.diag(jnp.array([1.0 + 0j, 0]))
    states = np.asarray(solve(decaying_qubit, solver, rho0, t1=50, dt0=0.05, saveat=saveat).ys)
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
    field = lambda t, y, args: {"R": spin @ y["R"], "x": -y["x"]}  # noqa: E731
    y0, saveat = {"R": jnp.eye(3), "x": jnp.ones(())}, dfx.SaveAt(ts=jnp.linspace(0, 1000, 1000))
    ys = solve(field, solver, y0, t1=1000, saveat=saveat, max_steps=10_001).ys
    assert np.max(np.abs(ys["R"].mT @ ys["R"] - np.eye(3))) <= 4 * EPS
    np.testing.assert_allclose(ys["x"][10], np.exp(-10_000 / 999), rtol=1e-4)


def test_the_zero_vector_has_no_direction():
    unit = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)
    assert not dfc.project(unit, jnp.zeros(3), projection=closed_forms.unit_vector())[1].ok


# ---- A formula of the user is used as it is, and checked; half precision ----

SQUARE = {"square": dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))}


def rescale(t, y, args, values):
    return y * jnp.sqrt(values["square"] / jnp.sum(y**2))


@ft.partial(jax.jit, static_argnums=2)
def rescaled(y, value, projection):
    return dfc.project(SQUARE, y, value={"square": value}, projection=projection)[0]


def test_it_agrees_with_newton_and_so_do_its_derivatives():
    gradient = jax.value_and_grad(lambda *given: jnp.sum(rescaled(*given) ** 3), (0, 1))
    given = jnp.array([3.0, 4.1]), jnp.array(25.0)
    closed, newton = (gradient(*given, p) for p in (dfc.ClosedForm(rescale), dfc.Newton()))
    assert difference(closed, newton) < 1e-9


WORK = {
    "simplified": dfc.SimplifiedNewton(),
    "bounded": dfc.SimplifiedNewton(lower=-2.0),
    "formula": dfc.ClosedForm(rescale),
    "along a line": dfc.AlongLine(direction="error"),
    "staged": dfc.Staged(("square", dfc.SimplifiedNewton())),
}


def in_half_precision(projection, dtype):
    solver = dfc.ManifoldProjection(dfx.Bosh3(), SQUARE, projection=projection)
    saveat = dfx.SaveAt(ts=jnp.array([0.25, 0.4, 1], dtype))
    return solve(oscillator, solver, jnp.array([1.0, 0.5], dtype), dt0=0.125, saveat=saveat)


@some_of("dtype", [jnp.float16, jnp.bfloat16], ids=["float16", "bfloat16"], period=2)
@some_of("name", WORK, ids=WORK, period=5)
def test_it_works_in_half_precision(name, dtype):
    ys = in_half_precision(WORK[name], dtype).ys
    assert ys.dtype == dtype
    squares = np.sum(np.asarray(ys, np.float64) ** 2, axis=1)
    # The tolerance, of a scale of three times the square, and what rounding the state costs.
    limit = (16 * 3 + 4) * 1.25 * float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(squares, 1.25, rtol=0, atol=limit)


def from_half_precision(solver):
    term, y0 = dfx.ODETerm(oscillator), jnp.array([1.0, 0.5], jnp.float16)
    return solver.init(term, jnp.float16(0), jnp.float16(0.125), y0, None)


def consistent_in_half_precision():
    dae = dfc.DAE(lambda t, x, z, args: -z, algebraic=lambda t, x, z, args: z - x)
    return dae.consistent(jnp.float16(1), jnp.float16(0.5))


test_mistakes_are_named = refused(
    (lambda: formula(closed_forms.density_matrix())(jnp.ones((2, 3))), ValueError, "no square"),
    (lambda: formula(closed_forms.rotation_matrix())(jnp.eye(2) + 0j), TypeError, "is real"),
    (lambda: closed_forms.unit_vector("R"), TypeError, "`where` is of type `str`"),
    *(
        (lambda fn=fn: rescaled(jnp.ones(2), 1.0, dfc.ClosedForm(fn)), ValueError, "`fn` of a `Cl")
        for fn in (lambda t, y, args, values: (y,), lambda t, y, args, values: y[:1])
    ),
    (lambda: in_half_precision(dfc.Newton(), jnp.float16), TypeError, "the state to float32"),
    *(
        (lambda solver=solver: from_half_precision(solver), TypeError, "the state to float32")
        for solver in (dfc.ImplicitMidpoint(), dfc.RandomFeatureSolver(), dfc.Radau())
    ),
    (consistent_in_half_precision, TypeError, "A `DAE` cannot solve .* float16"),
)
