"""One soliton of the cubic Schrödinger equation, with its mass, energy and momentum kept.

It has the least energy for its mass and momentum, so that the three gradients depend on each other
there, and the manifold is the soliton with its phases and places, and nothing beside it.
"""

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

LENGTH, AMPLITUDE = 40.0, 1.2
SPEED = 2 * np.pi * 6 / LENGTH


class Waves:
    """The equation by Fourier modes, for a state of two rows, the real and the imaginary part."""

    def __init__(self, points):
        self.dx = LENGTH / points
        self.x = jnp.arange(points) * self.dx - LENGTH / 2
        self.k = 2 * jnp.pi * jnp.fft.fftfreq(points, self.dx)
        self.manifold = {name: dfc.FirstIntegral(getattr(self, name)) for name in NAMES}

    def derivative(self, p, power):
        return jnp.fft.ifft((1j * self.k) ** power * jnp.fft.fft(p))

    def __call__(self, t, y, args):
        p = y[0] + 1j * y[1]
        rate = 1j * (self.derivative(p, 2) / 2 + jnp.abs(p) ** 2 * p)
        return jnp.stack([rate.real, rate.imag])

    def mass(self, t, y, args):
        return self.dx * jnp.sum(y**2)

    def energy(self, t, y, args):
        slope = self.derivative(y[0] + 1j * y[1], 1)
        return self.dx * jnp.sum(jnp.abs(slope) ** 2 - jnp.sum(y**2, axis=0) ** 2) / 2

    def momentum(self, t, y, args):
        p = y[0] + 1j * y[1]
        return self.dx * jnp.sum(jnp.imag(jnp.conj(p) * self.derivative(p, 1)))

    def soliton(self, t):
        phase = SPEED * self.x + (AMPLITUDE**2 - SPEED**2) / 2 * t
        p = AMPLITUDE / jnp.cosh(AMPLITUDE * (self.x - SPEED * t)) * jnp.exp(1j * phase)
        return jnp.stack([p.real, p.imag])


NAMES = ("mass", "energy", "momentum")


@eqx.filter_jit
def solved(waves, solver, t1, **options):
    term, saveat = dfx.ODETerm(waves), dfx.SaveAt(t1=True)
    y0 = waves.soliton(0.0)
    options = dict(dt0=0.005, saveat=saveat, max_steps=20_000, throw=False) | options
    return dfx.diffeqsolve(term, solver, 0.0, t1, y0=y0, **options)


@pytest.mark.slow
def test_on_a_coarse_grid_no_state_has_all_three():
    """The equation on the grid itself changes the momentum."""
    waves = Waves(128)
    control = dfx.PIDController(rtol=1e-13, atol=1e-13)
    exact = solved(waves, dfx.Dopri8(), 1.0, stepsize_controller=control, dt0=None).ys[-1]
    lost = waves.momentum(0.0, exact, None) - waves.momentum(0.0, waves.soliton(0.0), None)
    assert 1e-9 < abs(lost) < 1e-8
    sol = solved(waves, dfc.ManifoldProjection(dfc.RK4(), waves.manifold), 1.0)
    assert "was not reached" in dfx.RESULTS[sol.result]


@pytest.mark.slow
@pytest.mark.parametrize("projection", [dfc.SimplifiedNewton(), dfc.SimplifiedNewton(metric=1.0)])
def test_on_a_finer_grid_all_are_kept(projection):
    waves = Waves(256)
    errors = []
    projected = dfc.ManifoldProjection(dfc.RK4(), waves.manifold, projection=projection)
    for solver in (dfc.RK4(), projected):
        sol = solved(waves, solver, 2.0)
        assert sol.result == dfx.RESULTS.successful
        errors.append(float(jnp.max(jnp.abs(sol.ys[-1] - waves.soliton(2.0)))))
    assert errors[1] < 1.1 * errors[0] < 1e-8
