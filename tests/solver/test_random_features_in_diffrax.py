"""`RandomFeatureSolver` in `diffeqsolve`: what a solver of diffrax can do, it can."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optimistix as optx
import pytest

import diffrax_conserve as dfc

from ..features import EIGHT, NORTH, oscillation, oscillator, solve
from ..problems import EXPONENTIAL0, KEPLER, KEPLER0, drift_of, exponential, kepler, largest


def driven(t, y, args):
    """`y' = args cos(t) y`: neither autonomous nor without `args`."""
    return jax.tree.map(lambda x: args * jnp.cos(t) * x, y)


# ---- What diffrax offers ----


def test_dense_output_and_saved_times_are_as_accurate_as_the_steps():
    ts = jnp.linspace(0, 10, 101)
    subs = dict(ts=dfx.SubSaveAt(ts=ts), steps=dfx.SubSaveAt(steps=True))
    sol = solve(oscillator, NORTH, 10.0, tol=1e-9, saveat=dfx.SaveAt(subs=subs, dense=True))
    assert np.max(np.abs(sol.ys["ts"] - oscillation(np.asarray(ts)))) < 1e-8
    np.testing.assert_allclose(jax.vmap(sol.evaluate)(ts[::7]), sol.ys["ts"][::7], atol=1e-14)
    # Both ends of a step are its nodes.
    times = sol.ts["steps"][:3]
    for side in (True, False):
        ys = jax.vmap(lambda t, side=side: sol.evaluate(t, left=side))(times)
        np.testing.assert_allclose(ys, sol.ys["steps"][:3], atol=1e-14)
    np.testing.assert_allclose(
        sol.derivative(3.3), oscillator(0, jnp.asarray(oscillation(3.3)), None), atol=1e-6
    )


def test_events():
    event = dfx.Event(lambda t, y, args, **_: y[0], optx.Newton(1e-12, 1e-12))
    sol = solve(oscillator, NORTH, 10.0, dt0=1.0, event=event)
    assert sol.result == dfx.RESULTS.event_occurred
    np.testing.assert_allclose(sol.ts[-1], np.arctan2(1.0, -0.3), atol=1e-9)


def test_any_state_and_backwards_in_time():
    y0 = {"a": jnp.array(1.0), "b": (jnp.ones((2, 1)), jnp.array([3.0]))}
    sol = solve(driven, y0, -1.0, t0=2.0, dt0=-0.75, args=0.5)
    factor = np.exp(0.5 * (np.sin(-1.0) - np.sin(2.0)))
    assert jax.tree.structure(sol.ys) == jax.tree.structure(y0)
    for start, end in zip(jax.tree.leaves(y0), jax.tree.leaves(sol.ys), strict=True):
        np.testing.assert_allclose(end[0], factor * start, rtol=1e-9)


def test_single_precision():
    y0, t1, dt0 = NORTH.astype(jnp.float32), jnp.float32(30.0), jnp.float32(2.0)
    sol = solve(oscillator, y0, t1, t0=jnp.float32(0.0), dt0=dt0)
    assert sol.ys.dtype == jnp.float32
    np.testing.assert_allclose(sol.ys[-1], oscillation(30.0), atol=2e-5)


def test_several_terms():
    half = dfx.ODETerm(lambda t, y, args: y / 2)
    sol = dfx.diffeqsolve(dfx.MultiTerm(half, half), EIGHT, 0.0, 1.0, 0.5, jnp.array(1.0))
    np.testing.assert_allclose(sol.ys[0], np.e, rtol=1e-11)


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


def test_on_a_manifold():
    """At the steps and between them; the solver alone keeps the energy only."""
    solver = dfc.RandomFeatureSolver(6)
    saveat = dfx.SaveAt(ts=jnp.linspace(0, 6, 41))

    def run(solver):
        return solve(kepler, KEPLER0, 6.0, solver=solver, dt0=0.25, saveat=saveat)

    assert largest(drift_of(run(dfc.ManifoldProjection(solver, KEPLER)), KEPLER)) <= 4e-15
    assert largest(drift_of(run(solver), KEPLER)) > 1e-10


# ---- Derivatives ----


def loss(y0, args, adjoint, tol=None):
    """Of states between the steps."""
    dt0 = 0.25 if tol is None else None
    sol = solve(
        lambda t, y, args: driven(t, exponential(t, y, None), args),
        y0,
        1.5,
        dt0=dt0,
        tol=tol,
        args=args,
        adjoint=adjoint,
        saveat=dfx.SaveAt(ts=jnp.array([0.4, 1.5])),
        max_steps=32,
    )
    return jnp.sum(jnp.sin(sol.ys))


DIRECTION = jnp.array([0.3, -1.0])


def along(h, **options):
    adjoint = options.pop("adjoint", dfx.RecursiveCheckpointAdjoint())
    return loss(EXPONENTIAL0 + h * DIRECTION, 1.0 + 0.7 * h, adjoint, **options)


@pytest.mark.slow
@pytest.mark.parametrize("tol", [None, 1e-10], ids=["fixed", "adaptive"])
def test_gradients_against_finite_differences(tol):
    """In reverse mode and forwards."""
    function = jax.jit(lambda h: along(h, tol=tol))
    expected = (function(1e-5) - function(-1e-5)) / 2e-5
    assert abs(expected) > 1e-2
    reverse = jax.jit(jax.grad(lambda h: along(h, tol=tol)))(0.0)
    np.testing.assert_allclose(reverse, expected, rtol=3e-8 if tol is None else 1e-6)

    def forwards(h):
        return jax.jvp(lambda h: along(h, tol=tol, adjoint=dfx.ForwardMode()), (h,), (1.0,))[1]

    np.testing.assert_allclose(jax.jit(forwards)(0.0), reverse, rtol=1e-12)


def test_second_derivatives_of_a_step():
    def final(h):
        term = dfx.ODETerm(lambda t, y, args: args * exponential(t, y, None))
        y0 = EXPONENTIAL0 + h * DIRECTION
        return jnp.sum(jnp.sin(EIGHT.step(term, 0.0, 0.4, y0, 1.0 + h, None, False)[0]))

    slope = jax.jit(jax.grad(final))
    expected = (slope(1e-5) - slope(-1e-5)) / 2e-5
    np.testing.assert_allclose(jax.jit(jax.grad(jax.grad(final)))(0.0), expected, rtol=1e-6)


def test_gradient_with_respect_to_what_the_vector_field_closes_over():
    def final(rate):
        return solve(lambda t, y, args: rate * y, jnp.array(1.0), 1.0, dt0=0.5).ys[-1]

    np.testing.assert_allclose(jax.jit(jax.grad(final))(0.5), np.exp(0.5), rtol=1e-9)


# ---- Failure ----


def explode(t, y, args):
    """To infinity at t = 1."""
    return y**2


def test_fixed_steps_that_are_too_long_fail_and_say_so(errors_raise):
    with pytest.raises(eqx.EquinoxRuntimeError, match="Take smaller steps"):
        solve(explode, jnp.ones(1), 2.0, dt0=2.0)
    sol = solve(explode, jnp.ones(1), 2.0, dt0=2.0, throw=False)
    assert "RandomFeatureSolver" in dfx.RESULTS[sol.result]


def test_a_vector_field_that_is_not_finite_fails():
    sol = solve(lambda t, y, args: jnp.sqrt(0.5 - t) * y, jnp.ones(1), 1.0, dt0=1.0, throw=False)
    assert sol.result != dfx.RESULTS.successful


def test_adaptive_steps_recover():
    sol = solve(explode, jnp.ones(1), 0.99, dt0=0.99, tol=1e-9)
    assert int(sol.stats["num_rejected_steps"]) > 0
    np.testing.assert_allclose(sol.ys[-1], 100.0, rtol=1e-6)


def test_arguments_that_are_refused():
    for features in (-1, 2, 33):
        with pytest.raises(ValueError, match="`features` must be an integer from 3 to 32"):
            dfc.RandomFeatureSolver(features)
    for seed in (-1,):
        with pytest.raises(ValueError, match="`seed` must be an integer"):
            dfc.RandomFeatureSolver(seed=seed)


@pytest.mark.filterwarnings("ignore:.*not marked as converging")
def test_problems_that_are_refused():
    path = dfx.VirtualBrownianTree(0.0, 1.0, 1e-2, (), jr.key(0))
    noise = dfx.ControlTerm(lambda t, y, args: y, path)
    terms = dfx.MultiTerm(dfx.ODETerm(lambda t, y, args: y), noise)
    with pytest.raises(TypeError, match="is given a `ControlTerm`"):
        dfx.diffeqsolve(terms, EIGHT, 0.0, 1.0, 0.1, jnp.array(1.0))
    with pytest.raises(TypeError, match="`RandomFeatureSolver` needs real"):
        solve(lambda t, y, args: 1j * y, jnp.array(1.0 + 0j), 1.0, dt0=0.1)
