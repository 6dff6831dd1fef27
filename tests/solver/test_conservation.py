"""The drift of projected solves, at every kind of saved time."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from ..problems import RIGID_BODY, drift_of, evaluated, largest, rigid_body, solve
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


def test_saved_and_dense_times_lie_on_the_manifold():
    """Where the solution without projection does not."""
    system, ts = dfc.systems.get("kepler"), jnp.linspace(0, 4, 173)

    def run(solver, saveat):
        return solve(system.vector_field, solver, system.y0, t1=4.0, dt0=0.02, saveat=saveat)

    projected = dfc.ManifoldProjection(dfc.RK4(), system.manifold)
    saved = run(projected, dfx.SaveAt(ts=ts, dense=True))
    assert largest(drift_of(saved, system.manifold)) <= 4e-15
    ys = evaluated(saved, ts)
    for a, b in zip(jax.tree.leaves(ys), jax.tree.leaves(saved.ys), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)
    plain = run(dfc.RK4(), dfx.SaveAt(ts=ts))
    assert largest(drift_of(plain, system.manifold)) > 1e-12


def test_drift_does_not_grow_over_a_million_steps():
    system = dfc.systems.get("rigid-body")
    saveat = dfx.SaveAt(t0=True, ts=jnp.linspace(0, 2e4, 20))
    sol = solve(
        system.vector_field,
        dfc.ManifoldProjection(dfc.RK4(), system.manifold),
        system.y0,
        t1=2e4,
        dt0=0.02,
        saveat=saveat,
        max_steps=None,
        adjoint=dfx.ForwardMode(),
    )
    assert sol.stats["num_steps"] >= 1_000_000
    assert largest(drift_of(sol, system.manifold)) <= 4e-15


KEPLER = dfc.systems.Kepler()


@settings(max_examples=3)
@given(packing=dct.restructurings(KEPLER.y0))
def test_any_pytree_is_a_state(packing):
    """Of integrals too: in other containers the solve is the same."""
    manifold = [packing.manifold(KEPLER.manifold), {"both": packing.manifold(KEPLER.manifold)}]
    field = packing.vector_field(KEPLER.vector_field)
    saveat = dfx.SaveAt(t0=True, t1=True)
    solver = dfc.ManifoldProjection(dfx.Heun(), manifold)
    sol = solve(field, solver, packing.pack(KEPLER.y0), dt0=0.05, saveat=saveat)
    assert jax.tree.structure(drift_of(sol, manifold)) == jax.tree.structure(
        jax.tree.map(lambda x: 0, manifold, is_leaf=lambda x: isinstance(x, dfc.FirstIntegral))
    )
    assert largest(drift_of(sol, manifold)) <= 4e-15
    solver = dfc.ManifoldProjection(dfx.Heun(), KEPLER.manifold)
    plain = solve(KEPLER.vector_field, solver, KEPLER.y0, dt0=0.05, saveat=saveat)
    for a, b in zip(jax.vmap(packing.unpack)(sol.ys), plain.ys, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)


def test_at_and_near_a_steady_rotation():
    """About the middle axis, which is unstable: there all gradients are parallel."""
    for y0 in ([0.0, 1.5, 0.0], [1e-6, 1.5, 1e-5], [1e-3, 1.5, 0.0]):
        solver = dfc.ManifoldProjection(dfx.Tsit5(), RIGID_BODY, projection=dfc.Newton())
        saveat = dfx.SaveAt(t0=True, steps=True)
        sol = solve(rigid_body, solver, jnp.array(y0), t1=10.0, dt0=0.01, saveat=saveat)
        assert largest(drift_of(sol, RIGID_BODY)) <= 4e-15
