"""A network evaluated in float32 inside a flow map in float64."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

import diffrax_conserve as dfc

from ..learned import CORES, LORENZ, flow_map, states, unchecked
from ..problems import drift_of

EPS32 = float(np.finfo(np.float32).eps)


def both(core):
    """A network and the same in single precision."""
    network = flow_map(core=core, taylor=dfc.learned.Taylor(LORENZ.vector_field, 1))
    return network, dfc.learned.single_precision(network)


@pytest.fixture(scope="module")
def pair():
    return both(dfc.learned.Gated)


def products(jaxpr):
    """The dtypes of the factors of all products of matrices."""
    found = set()
    for eqn in jaxpr.eqns:
        if eqn.primitive.name == "dot_general":
            found |= {v.aval.dtype.name for v in eqn.invars}
        for inner in jaxprs_in_params(eqn.params):
            found |= products(inner)
    return found


@pytest.mark.parametrize("core", CORES.values(), ids=CORES)
def test_only_the_network_is_rounded(core):
    network, single = both(core)
    y0s, h = states(20), 0.2
    exact, rounded = (jax.jit(jax.vmap(lambda y, f=f: f(y, h)))(y0s) for f in (network, single))
    assert rounded.dtype == jnp.float64
    # The network's output is multiplied by (h / Δ)² S, and here it is of order one.
    size = (h / network.max_step) ** 2 * np.asarray(network.scale)
    error = np.abs(np.asarray(exact - rounded)) / size
    assert 0 < np.max(error) < 32 * EPS32
    assert products(jax.make_jaxpr(single)(LORENZ.y0, h).jaxpr) == {"float32"}
    np.testing.assert_array_equal(single(LORENZ.y0, 0.0), LORENZ.y0)


def test_what_is_conserved_is_so_to_roundoff_of_the_state(pair):
    _, single = pair
    solver = dfc.ManifoldProjection(unchecked(single), LORENZ.manifold)
    sol = eqx.filter_jit(dfx.diffeqsolve)(
        dfx.ODETerm(LORENZ.vector_field), solver, 0.0, 0.5, 0.05, LORENZ.y0,
        saveat=dfx.SaveAt(t0=True, steps=True),
    )  # fmt: skip
    for drift in jax.tree.leaves(drift_of(sol, LORENZ.manifold)):
        assert np.nanmax(np.abs(drift)) < 4e-15


def test_inside_other_flow_maps_and_solvers(pair):
    network, single = pair
    for within in (lambda f: dfc.learned.Repeated(f, 2), dfc.DeepONetSolver, lambda f: (f, 1.0)):
        assert eqx.tree_equal(dfc.learned.single_precision(within(network)), within(single))
    assert eqx.tree_equal(dfc.learned.single_precision(single), single)
