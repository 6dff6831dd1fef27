"""`RandomFeatureSolver`: exact to roundoff, honest about its error, and a solver of diffrax."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc

from .. import problems
from ..problems import EXPONENTIAL0, exponential, oscillator

EIGHT = dfc.RandomFeatureSolver(8)


def solve(vector_field, y0, t1, *, solver=EIGHT, dt0=None, tol=None, **kwargs):
    if tol is not None:
        tol = jnp.asarray(tol)  # another one compiles nothing anew
        kwargs["stepsize_controller"] = dfx.PIDController(rtol=tol, atol=tol)
    kwargs.setdefault("max_steps", 512)
    return problems.solve(vector_field, solver, y0, t1=t1, dt0=dt0, **kwargs)


def lorenz(t, y, args):
    x, y, z = y
    return jnp.stack([10 * (y - x), x * (28 - z) - y, x * y - 8 / 3 * z])


def driven(t, y, args):
    """`y' = args cos(t) y`: neither autonomous nor without `args`."""
    return jax.tree.map(lambda x: args * jnp.cos(t) * x, y)


def test_target_of_the_rigid_body():
    """Over [0, 1.75], against Jacobi's elliptic functions."""
    system = dfc.systems.RigidBody()
    ts = jnp.linspace(0, 1.75, 36)
    options = dict(solver=dfc.RandomFeatureSolver(), dt0=0.25, saveat=dfx.SaveAt(ts=ts))
    sol = solve(system.vector_field, system.y0, 1.75, **options)
    exact = np.asarray(eqx.filter_jit(system.solution)(ts, system.y0))
    assert np.linalg.norm(sol.ys - exact) <= 1e-12 * np.linalg.norm(exact)


def step(vector_field, solver, y0, h):
    term = dfx.ODETerm(vector_field)
    y1, error, _, _, result = solver.step(term, 0.0, h, y0, None, None, False)
    return y1, jnp.max(error), result == dfx.RESULTS.successful


@pytest.mark.slow
@pytest.mark.parametrize(
    ("field", "y0", "shortest", "longest", "features"),
    [(lorenz, [1.0, 1.0, 20.0], 0.08, 0.4, 8), (oscillator, [1.0, 0.3], 0.5, 10.0, 16)],
    ids=["lorenz", "oscillator"],
)
def test_the_estimate_is_not_below_the_true_error_of_a_step(field, y0, shortest, longest, features):
    """Over step lengths from easy to hopeless, down to 1e-12, and at most 20 times as large: what
    the Gauss rule does not resolve is counted too."""
    vector_field, y0 = field, jnp.array(y0)
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
    assert np.all((ratios > 0.9) & (ratios < 20))


def test_the_estimate_sees_jumps_and_kinks_of_the_vector_field():
    """A force that is switched on, and a spring that pushes from one side, beside another solver.
    With so many times some lie between an end of a step and the Gauss point next to it."""

    def switched(t, y, at):
        return jnp.stack([y[1], -y[0] - 0.1 * y[1] + jnp.where(t < at, 0.0, 1.0)])

    def one_sided(t, y, at):
        return jnp.stack([y[1], -y[0] - 5 * jnp.maximum(y[0] - at / 10, 0)])

    y0, ats = jnp.array([1.0, 0.0]), jnp.linspace(1.0, 9.0, 100)
    for field in (switched, one_sided):

        def last(at, solver, tol, field=field):
            options = dict(args=at, solver=solver, tol=tol, max_steps=4096)
            return solve(field, y0, 10.0, **options).ys[-1]

        found = jax.vmap(lambda at: last(at, EIGHT, 1e-8))(ats)
        exact = jax.vmap(lambda at: last(at, dfx.Dopri8(), 1e-11))(ats)
        np.testing.assert_allclose(found, exact, rtol=0, atol=1e-7)


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


@pytest.mark.slow
def test_any_state_and_backwards_in_time():
    y0 = {"a": jnp.array(1.0), "b": (jnp.ones((2, 1)), jnp.array([3.0]))}
    sol = solve(driven, y0, -1.0, t0=2.0, dt0=-0.75, args=0.5)
    factor = np.exp(0.5 * (np.sin(-1.0) - np.sin(2.0)))
    assert jax.tree.structure(sol.ys) == jax.tree.structure(y0)
    for start, end in zip(jax.tree.leaves(y0), jax.tree.leaves(sol.ys), strict=True):
        np.testing.assert_allclose(end[0], factor * start, rtol=1e-9)


@pytest.mark.slow
def test_a_batch_is_its_lanes():
    """With lanes that need different numbers of iterations, and one that fails."""

    def growth(t, y, args):
        return args * y**2

    rates = jnp.array([0.0, 0.1, 0.9, 3.0])

    def run(rate):
        sol = solve(growth, jnp.ones(1), 1.0, dt0=1.0, args=rate, throw=False, max_steps=2)
        return sol.ys[-1], sol.result == dfx.RESULTS.successful

    batch = jax.vmap(run)(rates)
    assert list(batch[1]) == [True, True, True, False]
    for i, rate in enumerate(rates):
        y, ok = run(rate)
        assert bool(ok) == bool(batch[1][i])
        np.testing.assert_allclose(batch[0][i], y, rtol=1e-13)


def test_second_derivatives_of_a_step():
    def final(h):
        term = dfx.ODETerm(lambda t, y, args: args * exponential(t, y, None))
        y0 = EXPONENTIAL0 + h * jnp.array([0.3, -1.0])
        return jnp.sum(jnp.sin(EIGHT.step(term, 0.0, 0.4, y0, 1.0 + h, None, False)[0]))

    slope = jax.jit(jax.grad(final))
    expected = (slope(1e-5) - slope(-1e-5)) / 2e-5
    np.testing.assert_allclose(jax.jit(jax.grad(jax.grad(final)))(0.0), expected, rtol=1e-6)


def explode(t, y, args):
    """To infinity at t = 1."""
    return y**2


def test_fixed_steps_that_are_too_long_fail_and_say_so(errors_raise):
    with pytest.raises(eqx.EquinoxRuntimeError, match="Take smaller steps"):
        solve(explode, jnp.ones(1), 2.0, dt0=2.0)
    sol = solve(explode, jnp.ones(1), 2.0, dt0=2.0, throw=False)
    assert "RandomFeatureSolver" in dfx.RESULTS[sol.result]


def test_adaptive_steps_recover():
    sol = solve(explode, jnp.ones(1), 0.99, dt0=0.99, tol=1e-9)
    assert int(sol.stats["num_rejected_steps"]) > 0
    np.testing.assert_allclose(sol.ys[-1], 100.0, rtol=1e-6)


@pytest.mark.filterwarnings("ignore:.*not marked as converging")
def test_problems_that_are_refused():
    path = dfx.VirtualBrownianTree(0.0, 1.0, 1e-2, (), jr.key(0))
    noise = dfx.ControlTerm(lambda t, y, args: y, path)
    terms = dfx.MultiTerm(dfx.ODETerm(lambda t, y, args: y), noise)
    with pytest.raises(TypeError, match=r"pass a `diffrax\.ODETerm`"):
        dfx.diffeqsolve(terms, EIGHT, 0.0, 1.0, 0.1, jnp.array(1.0))
    with pytest.raises(TypeError, match="`RandomFeatureSolver` needs real"):
        solve(lambda t, y, args: 1j * y, jnp.array(1.0 + 0j), 1.0, dt0=0.1)
    with pytest.raises(ValueError, match="`features` must be an integer from 3 to 32"):
        dfc.RandomFeatureSolver(33)
