"""A first integral that is a network: conserved, transformed and differentiated like any other."""

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from ..problems import OMEGA0, drift_of, largest, rigid_body, solve


class NetworkIntegral(eqx.Module):
    """Some smooth function of the state; no solution keeps it, so each projection has work."""

    net: eqx.nn.MLP

    def __init__(self, key):
        self.net = eqx.nn.MLP(3, "scalar", 6, 1, jnp.tanh, key=key)

    def __call__(self, t, y, args):
        del t, args
        return self.net(y)


NETWORK = NetworkIntegral(jr.key(3))
TIMES = jnp.array([0.0, 0.13, 0.4])


def states(network, y0):
    manifold = {"learned": dfc.FirstIntegral(network)}
    # An untrained network is no integral of the vector field.
    solver = dfc.ManifoldProjection(dfc.RK4(), manifold, max_correction=jnp.inf)
    saveat = dfx.SaveAt(ts=TIMES)
    term = dfx.ODETerm(rigid_body)
    return dfx.diffeqsolve(term, solver, 0.0, 0.4, 0.1, y0, saveat=saveat, max_steps=8)


@eqx.filter_jit
def compiled(network, y0):
    return states(network, y0)


def test_its_value_is_kept_under_jit_and_without():
    manifold = {"learned": dfc.FirstIntegral(NETWORK)}
    plain = solve(rigid_body, dfc.RK4(), OMEGA0, t1=0.4, saveat=dfx.SaveAt(ts=TIMES))
    sol = compiled(NETWORK, OMEGA0)
    assert largest(drift_of(sol, manifold)) < 1e-14 < 1e-6 < largest(drift_of(plain, manifold))
    np.testing.assert_allclose(sol.ys, states(NETWORK, OMEGA0).ys, rtol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize(
    "projection", [dfc.SimplifiedNewton(), dfc.Newton()], ids=["simplified", "newton"]
)
def test_gradients_with_respect_to_its_weights(projection):
    """Against finite differences; the first test shows that there is something to correct."""

    def final(network, y0):
        manifold = {"learned": dfc.FirstIntegral(network)}
        solver = dfc.ManifoldProjection(
            dfc.RK4(), manifold, projection=projection, max_correction=jnp.inf
        )
        return solve(rigid_body, solver, y0, t1=0.3, max_steps=4).ys[-1]

    dct.assert_gradients(final, NETWORK, OMEGA0, atol=1e-10, forward=False)
