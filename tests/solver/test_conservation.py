"""The drift of projected solves at every kind of saved time, and their order."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

import diffrax_conserve as dfc

from ..problems import (
    EXPONENTIAL,
    EXPONENTIAL0,
    KEPLER,
    KEPLER0,
    difference,
    drift_of,
    exponential,
    exponential_solution,
    kepler,
    largest,
    solve,
)
from ..structures import packings
from ..thinned import some_of

SYSTEMS = ["rigid-body", "kepler", "point-vortices", "conservative-lorenz", "double-pendulum"]


@some_of("name", SYSTEMS, ids=SYSTEMS, period=5)
def test_drift_is_at_roundoff_in_single_precision(name):
    def single(x):
        return x.astype(jnp.float32) if eqx.is_inexact_array(x) else x

    system = jax.tree.map(single, dfc.systems.get(name))
    solver = dfc.ManifoldProjection(dfx.Dopri8(), system.manifold)
    options = dict(t1=4.0, dt0=0.02, saveat=dfx.SaveAt(t0=True, steps=True), max_steps=202)
    sol = solve(system.vector_field, solver, jax.tree.map(single, system.y0), **options)
    assert largest(drift_of(sol, system.manifold)) <= 1e-6
    assert all(y.dtype == jnp.float32 for y in jax.tree.leaves(sol.ys))


@some_of("bounds", [{}, {"lower": 0.0}], ids=["free", "bounds"], period=2)
def test_drift_is_at_roundoff_where_a_species_almost_dies_out(bounds):
    """The prey falls from 12 to 7e-5, where its logarithm is steep. That it once moved by 12 must
    not count there."""
    manifold = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y - jnp.log(y)))
    projection = dfc.SimplifiedNewton(**bounds)
    solver = dfc.ManifoldProjection(dfx.Tsit5(), manifold, projection=projection)
    field = lambda t, y, args: y * jnp.array([1.0, -1.0]) * (1 - y[::-1])  # noqa: E731
    saveat = dfx.SaveAt(t0=True, steps=True)
    control = dfx.PIDController(rtol=1e-6, atol=1e-9)
    options = dict(saveat=saveat, stepsize_controller=control, max_steps=400)
    sol = solve(field, solver, jnp.array([12.0, 1.0]), t1=40.0, dt0=0.01, **options)
    assert jnp.min(sol.ys[:, 0]) < 1e-4
    assert largest(drift_of(sol, manifold)) <= 16 * np.finfo(float).eps


ORBIT = dfc.systems.Kepler()


@pytest.mark.slow
@settings(max_examples=2)
@given(packing=packings(ORBIT.y0))
def test_any_pytree_is_a_state(packing):
    """Of integrals too: in other containers the solve is the same, in a metric that does not see
    them."""
    euclidean = dfc.SimplifiedNewton(metric=1.0)
    manifold = [packing.manifold(ORBIT.manifold), {"both": packing.manifold(ORBIT.manifold)}]
    field = packing.vector_field(ORBIT.vector_field)
    saveat = dfx.SaveAt(t0=True, t1=True)
    solver = dfc.ManifoldProjection(dfx.Heun(), manifold, projection=euclidean)
    sol = solve(field, solver, packing.pack(ORBIT.y0), dt0=0.05, saveat=saveat)
    assert jax.tree.structure(drift_of(sol, manifold)) == jax.tree.structure(
        jax.tree.map(lambda x: 0, manifold, is_leaf=lambda x: isinstance(x, dfc.FirstIntegral))
    )
    assert largest(drift_of(sol, manifold)) <= 4e-15
    solver = dfc.ManifoldProjection(dfx.Heun(), ORBIT.manifold, projection=euclidean)
    plain = solve(ORBIT.vector_field, solver, ORBIT.y0, dt0=0.05, saveat=saveat)
    for a, b in zip(jax.vmap(packing.unpack)(sol.ys), plain.ys, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)


# ---- Projection keeps the order of the solver, as published; `Unrolled` is the same method ----

EUCLIDEAN = dfc.SimplifiedNewton(metric=1.0)


def final(vector_field, solver, y0, t1, num_steps):
    """The state at `t1`, with a leading axis."""
    return solve(vector_field, solver, y0, t1=t1, dt0=t1 / num_steps, max_steps=None).ys


@pytest.mark.parametrize(("num_steps", "error"), [(50, 5.62e-5), (100, 3.56e-6), (200, 2.24e-7)])
def test_published_error_of_rk4(num_steps, error):
    """`u' = -e^v, v' = e^u` to t = 5, projected on `e^u + e^v`."""
    solver = dfc.ManifoldProjection(dfc.RK4(), EXPONENTIAL, projection=EUCLIDEAN)
    ys = final(exponential, solver, EXPONENTIAL0, 5.0, num_steps)
    found = float(jnp.linalg.norm(ys[-1] - exponential_solution(5.0)))
    assert float(f"{found:.2e}") == pytest.approx(error)


@pytest.mark.parametrize(
    ("manifold", "error"),
    [
        (None, 1.46),
        pytest.param(KEPLER["energy"], 3.48e-2, marks=pytest.mark.slow),
        (KEPLER, 8.69e-3),
    ],
    ids=["plain", "energy", "energy and momentum"],
)
def test_published_error_of_kepler(manifold, error):
    """RK4 with h = 0.2 to t = 20, where the exact position is known."""
    solver = dfc.RK4()
    if manifold is not None:
        solver = dfc.ManifoldProjection(solver, manifold, projection=EUCLIDEAN)
    q, _ = final(kepler, solver, KEPLER0, 20.0, 100)
    got = np.linalg.norm(q[-1] - np.array([-0.77007558, 0.78834482]))
    assert float(f"{got:.2e}") == pytest.approx(error)


def test_dense_output_of_rk4_is_of_fourth_order():
    def error(num_steps):
        ts = jnp.linspace(0, 1, 37)
        options = dict(dt0=1 / num_steps, saveat=dfx.SaveAt(ts=ts))
        ys = solve(exponential, dfc.RK4(), EXPONENTIAL0, **options).ys
        return largest(ys - jax.jit(jax.vmap(exponential_solution))(ts))

    assert np.log2(error(20) / error(40)) == pytest.approx(4, abs=0.4)


SOLVERS = [dfx.Tsit5(), dfx.Dopri8(), dfc.RK4()]
ADAPTIVE, STEPS = dfx.PIDController(rtol=1e-6, atol=1e-6, error_order=5), dfx.ConstantStepSize()


@pytest.mark.slow
@some_of("solver", SOLVERS, ids=[type(s).__name__ for s in SOLVERS], period=3)
def test_same_steps_and_dense_output(solver):
    """Of a tableau alone, which knows neither its order nor a dense output, the last state."""

    def run(solver, controller):
        options = dict(stepsize_controller=controller, saveat=dfx.SaveAt(ts=np.linspace(0, 1.5, 7)))
        return solve(kepler, solver, KEPLER0, t1=1.5, dt0=0.1, **options)

    controller = ADAPTIVE if isinstance(solver, dfx.AbstractAdaptiveSolver) else STEPS
    unrolled = dfc.Unrolled(solver.tableau)
    assert unrolled == dfc.Unrolled(solver.tableau)
    assert hash(unrolled) == hash(dfc.Unrolled(solver.tableau))
    theirs = run(solver, controller)
    whole, alone = run(dfc.Unrolled(solver), controller), run(unrolled, controller)
    assert whole.stats["num_steps"] == alone.stats["num_steps"] == theirs.stats["num_steps"]
    assert difference(whole.ys, theirs.ys) < 1e-12
    assert largest([y[-1] - z[-1] for y, z in zip(alone.ys, theirs.ys, strict=True)]) < 1e-12


def test_rk4_has_no_error_estimate():
    assert not isinstance(dfc.RK4(), dfx.AbstractAdaptiveSolver)
    with pytest.raises(RuntimeError, match="error estimates"):
        solve(kepler, dfc.RK4(), KEPLER0, stepsize_controller=ADAPTIVE)
