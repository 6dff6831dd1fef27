"""`RandomFeatureSolver`: exact to roundoff, and honest about its error."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..features import EIGHT, NORTH, lorenz, oscillation, oscillator, solve
from ..problems import EXPONENTIAL0, KEPLER0, exponential, exponential_solution, kepler, largest

# ---- Accuracy ----


def relative_error(ys, expected):
    return np.linalg.norm(ys - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize(
    "tol", [pytest.param(None, marks=pytest.mark.slow), 1e-12], ids=["fixed", "adaptive"]
)
def test_target_of_the_oscillator(tol):
    """Relative L2 error of the state over [0, 30] at most 1e-12: issue 5."""
    ts = jnp.linspace(0, 30, 301)
    sol = solve(
        oscillator,
        NORTH,
        30.0,
        solver=dfc.RandomFeatureSolver(),
        dt0=2.0 if tol is None else None,
        tol=tol,
        saveat=dfx.SaveAt(ts=ts),
    )
    assert relative_error(sol.ys, oscillation(np.asarray(ts))) <= 1e-12


def test_target_of_the_rigid_body():
    """Over [0, 1.75], against Jacobi's elliptic functions."""
    system = dfc.systems.RigidBody()
    ts = jnp.linspace(0, 1.75, 36)
    sol = solve(
        system.vector_field,
        system.y0,
        1.75,
        solver=dfc.RandomFeatureSolver(),
        dt0=0.25,
        saveat=dfx.SaveAt(ts=ts),
    )
    assert relative_error(sol.ys, system.solution(ts, system.y0)) <= 1e-12


def test_a_nonlinear_solution_to_roundoff():
    sol = solve(exponential, EXPONENTIAL0, 1.0, solver=dfc.RandomFeatureSolver(), dt0=0.25)
    np.testing.assert_allclose(sol.ys[-1], exponential_solution(1.0), rtol=0, atol=2e-14)


# ---- The error estimate ----


def step(vector_field, solver, y0, h):
    term = dfx.ODETerm(vector_field)
    y1, error, _, _, result = solver.step(term, 0.0, h, y0, None, None, False)
    return y1, jnp.max(error), result == dfx.RESULTS.successful


def kepler_vector(t, y, args):
    return jnp.concatenate(kepler(t, (y[:2], y[2:]), args))


def van_der_pol(t, y, args):
    return jnp.stack([y[1], 5 * (1 - y[0] ** 2) * y[1] - y[0]])


ONE_STEP = {
    "oscillator": (oscillator, NORTH, (0.5, 10.0)),
    "kepler": (kepler_vector, jnp.concatenate(KEPLER0), (0.1, 2.0)),
    "lorenz": (lorenz, jnp.array([1.0, 1.0, 20.0]), (0.08, 0.4)),
    "van der pol": (van_der_pol, jnp.array([2.0, 0.0]), (0.05, 1.0)),
}


CHEAP = [("lorenz", 8)]


@pytest.mark.parametrize(
    ("name", "features"),
    CHEAP
    + [
        pytest.param(name, features, marks=pytest.mark.slow)
        for name in ONE_STEP
        for features in (8, 12, 16)
        if (name, features) not in CHEAP
    ],
)
def test_the_estimate_is_the_true_error_of_a_step(name, features):
    """Over step lengths from easy to hopeless: to a few per cent, down to 1e-12."""
    vector_field, y0, (shortest, longest) = ONE_STEP[name]
    lengths = jnp.geomspace(shortest, longest, 12)
    solver = dfc.RandomFeatureSolver(features)

    @jax.jit
    @jax.vmap
    def measure(h):
        y1, error, ok = step(vector_field, solver, y0, h)
        fine = dfx.diffeqsolve(
            dfx.ODETerm(vector_field), dfx.Dopri8(), 0.0, h, h / 1000, y0, max_steps=1002
        )
        return error, jnp.max(jnp.abs(y1 - fine.ys[-1])), ok

    estimates, errors, ok = measure(lengths)
    counted = np.asarray(ok & (errors > 1e-12 * jnp.max(jnp.abs(y0))))
    assert np.any(counted)
    ratios = np.asarray(estimates / errors)[counted]
    assert np.all((ratios > 0.7) & (ratios < 1.5))


@pytest.mark.parametrize(
    ("name", "t1"), [pytest.param("kepler", 10.0, marks=pytest.mark.slow), ("lorenz", 2.0)]
)
def test_the_error_of_an_adaptive_solve_follows_the_tolerance(name, t1):
    vector_field, y0, _ = ONE_STEP[name]
    final = solve(vector_field, y0, t1, solver=dfx.Dopri8(), dt0=t1 / 1e4, max_steps=10_001).ys[-1]
    errors, counts = [], []
    tolerances = [1e-3, 1e-5, 1e-7, 1e-9, 1e-11]
    for tol in tolerances:
        sol = solve(vector_field, y0, t1, tol=jnp.asarray(tol))
        errors.append(largest(sol.ys[-1] - final))
        counts.append(int(sol.stats["num_accepted_steps"]))
    # The error of a step grows until the end, on the Lorenz system up to 1,000 times.
    assert all(e <= 2e3 * tol for e, tol in zip(errors, tolerances, strict=True))
    assert errors[-1] < 1e-6 * errors[0]
    assert counts == sorted(counts)
    assert counts[-1] < 100


def test_a_stiff_problem():
    """Robertson's kinetics: rates from 1e-5 to 1e4 and more."""

    def robertson(t, y, args):
        a, b, c = y
        slow, fast, back = 0.04 * a, 3e7 * b**2, 1e4 * b * c
        return jnp.stack([back - slow, slow - back - fast, fast])

    y0 = jnp.array([1.0, 0.0, 0.0])
    controller = dfx.PIDController(rtol=1e-8, atol=1e-12)
    sol = solve(
        robertson, y0, 4e3, solver=dfc.RandomFeatureSolver(), stepsize_controller=controller
    )
    assert int(sol.stats["num_steps"]) < 100
    # By Kvaerno5 with tolerance 1e-11, in 6,779 steps.
    expected = [1.83202258e-1, 8.94237125e-7, 8.16796848e-1]
    np.testing.assert_allclose(sol.ys[-1], expected, rtol=1e-8)


# ---- Structure ----


def test_a_step_decays_where_the_solution_does():
    """On `z' = λ z`, for λ in the left half plane and on its boundary."""

    def linear(t, y, args):
        return jnp.stack([args[0] * y[0] - args[1] * y[1], args[1] * y[0] + args[0] * y[1]])

    @jax.jit
    @jax.vmap
    def modulus(rate):
        term = dfx.ODETerm(linear)
        y1, *_, result = EIGHT.step(term, 0.0, 1.0, jnp.array([1.0, 0.0]), rate, None, False)
        return jnp.linalg.norm(y1), result == dfx.RESULTS.successful

    radius, angle = np.meshgrid(np.geomspace(0.1, 1e4, 40), np.linspace(np.pi / 2, np.pi, 9))
    rates = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(-1, 2)
    moduli, found = modulus(jnp.asarray(rates))
    assert np.all(found)
    assert np.max(moduli) <= 1 + 1e-8
    np.testing.assert_allclose(moduli[:40], 1, atol=1e-7)  # purely imaginary


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_the_draw_does_not_matter_to_the_tolerance(seed):
    a, b = (
        solve(lorenz, jnp.ones(3), 1.0, solver=dfc.RandomFeatureSolver(12, seed=s), tol=1e-9).ys[-1]
        for s in (0, seed)
    )
    assert 0 < largest(a - b) < 1e-7
