"""Projection along the error estimate."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from .. import problems
from ..problems import drift_of, evaluated, largest

TODA = dfc.systems.get("toda-lattice")


def momentum(y):
    return jnp.sum(y[1], axis=-1)


def energy(t, y, args):
    return args * TODA.energy(t, y, None)


ENERGY, TERM, Y0 = dfc.FirstIntegral(energy), dfx.ODETerm(TODA.vector_field), TODA.y0
ONE = jnp.array(1.0)


def solve(inner, y0=Y0, args=ONE, t1=3.0, dt0=0.05, **options):
    solver = dfc.ManifoldProjection(inner, ENERGY, projection=dfc.Directional())
    options = dict(t1=t1, dt0=dt0, args=args) | options
    return problems.solve(TODA.vector_field, solver, y0, **options)


ADAPTIVE = dfx.PIDController(rtol=1e-6, atol=1e-6)


def test_energy_and_momentum_are_kept_at_every_saved_time():
    saveat = dfx.SaveAt(ts=jnp.linspace(0, 3, 50), dense=True)
    sol = solve(dfx.Bosh3(), saveat=saveat, stepsize_controller=ADAPTIVE)
    assert largest(drift_of(sol, ENERGY, ONE)) < 4e-15
    np.testing.assert_allclose(momentum(sol.ys), momentum(Y0), atol=1e-13)
    between = evaluated(sol, jnp.linspace(0.0, 3.0, 77))
    energies = jax.vmap(energy, (None, 0, None))(0.0, between, ONE)
    np.testing.assert_allclose(momentum(between), momentum(Y0), atol=1e-13)
    np.testing.assert_allclose(energies, energy(0.0, Y0, ONE), rtol=4e-15)


def test_it_lies_on_the_line_along_the_embedded_difference():
    """One step against Bosh3 by hand."""

    @jax.jit
    def by_hand():
        state = dfx.Bosh3().init(TERM, 0.0, 0.2, Y0, ONE)
        return dfx.Bosh3().step(TERM, 0.0, 0.2, Y0, ONE, state, False)[:2]

    plain, error = by_hand()
    found = solve(dfx.Bosh3(), t1=0.2, dt0=0.2).ys
    w = np.concatenate(error)
    moved = np.concatenate([a[-1] - b for a, b in zip(found, plain, strict=True)])
    np.testing.assert_allclose(moved, w * (moved @ w) / (w @ w), atol=1e-15)
    assert abs(energy(0.0, plain, ONE) - energy(0.0, Y0, ONE)) > 1e-9


@pytest.mark.slow
def test_derivatives_agree_with_finite_differences():
    def run(y0, args):
        return solve(dfx.Bosh3(), y0, args, t1=0.6, dt0=0.2).ys

    dct.assert_gradients(run, Y0, ONE, rtol=1e-6, forward=False)


def test_a_tangent_direction_is_a_failure():
    """On a circle whose field is constant speed, the error estimate is made tangent by hand."""

    class Tangent(dfx.Euler):
        def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
            y1, _, *rest = super().step(terms, t0, t1, y0, args, solver_state, made_jump)
            return y1, 1e-3 * jnp.array([-y1[1], y1[0]]), *rest

    circle = dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2))
    solver = dfc.ManifoldProjection(Tangent(), circle, projection=dfc.Directional())
    field = dfx.ODETerm(lambda t, y, args: jnp.array([-y[1], y[0]]))
    sol = dfx.diffeqsolve(field, solver, 0, 1, 0.1, jnp.array([1.0, 0.0]), throw=False)
    assert sol.result != dfx.RESULTS.successful


def test_what_cannot_be_is_refused_before_compilation():
    two = (ENERGY, dfc.FirstIntegral(lambda t, y, args: momentum(y)))

    def step(inner, manifold):
        solver = dfc.ManifoldProjection(inner, manifold, projection=dfc.Directional())
        dfx.diffeqsolve(TERM, solver, 0, 1, 0.1, Y0, ONE)

    for inner, manifold, match in [
        (dfx.Tsit5(), two, "2 scalar constraints"),
        (dfx.HalfSolver(dfc.RK4()), ENERGY, "without its sign"),
        (dfc.RK4(), ENERGY, "embedded method"),
    ]:
        with pytest.raises(ValueError, match=match):
            step(inner, manifold)
    with pytest.raises(ValueError, match=r"Elsewhere pass `projection=Newton\(\)`"):
        dfc.project(ENERGY, Y0, args=ONE, value=0.0, projection=dfc.Directional())
