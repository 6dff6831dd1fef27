"""`Unrolled` is the same method, only faster."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..problems import KEPLER, KEPLER0, drift_of, kepler
from ..thinned import some_of

SOLVERS = [dfx.Tsit5(), dfx.Dopri5(), dfx.Dopri8(), dfx.Bosh3(), dfx.Heun(), dfx.Ralston()]


def solve(solver, y0=KEPLER0, t1=1.5, **kwargs):
    options = dict(
        dt0=None,
        stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
        saveat=dfx.SaveAt(ts=jnp.linspace(0, t1, 7), t1=True),
    )
    return compiled(dfx.ODETerm(kepler), solver, 0.0, jnp.asarray(t1), y0=y0, **(options | kwargs))


compiled = eqx.filter_jit(dfx.diffeqsolve)


@some_of("solver", SOLVERS, ids=[type(s).__name__ for s in SOLVERS], period=6)
def test_same_steps_and_dense_output(solver):
    ours, theirs = solve(dfc.Unrolled(solver)), solve(solver)
    assert ours.stats["num_steps"] == theirs.stats["num_steps"]
    for x, y in zip(jtu.tree_leaves(ours.ys), jtu.tree_leaves(theirs.ys), strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-12)


def test_projected_and_batched():
    solver = dfc.ManifoldProjection(dfc.Unrolled(dfx.Bosh3()), KEPLER)
    y0s = jtu.tree_map(lambda x: x * (1 + 0.02 * jr.normal(jr.key(0), (5, 2))), KEPLER0)
    sol = jax.jit(jax.vmap(lambda y0: solve(solver, y0)))(y0s)
    drift = jax.vmap(lambda sol: drift_of(sol, KEPLER))(sol)
    assert max(float(jnp.max(jnp.abs(x))) for x in jtu.tree_leaves(drift)) < 4e-15


@pytest.mark.parametrize("solver", [dfx.Euler(), dfx.Kvaerno5(), "Tsit5", dfc.RK4()])
def test_other_solvers_are_refused(solver):
    with pytest.raises(TypeError, match="explicit Runge-Kutta"):
        dfc.Unrolled(solver)
