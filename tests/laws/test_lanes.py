"""A lane of a batch is that lane alone, whatever happens to its neighbours."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import diffrax_conserve as dfc

from ..problems import EPS, RIGID_BODY, rigid_body, solve
from ..thinned import some_of

# Of implicit methods, which keep their last stage, lanes depend on each other within the tolerance.
# The first one keeps its last stage.
ADAPTIVE = [dfx.Tsit5(), dfx.Heun()]
GOOD, NAN, FAILED, REJECTED = range(4)
KINDS = [GOOD, NAN, FAILED, REJECTED]
# The initial step, which the controller rejects in the last kind of lane.
STEPS = np.array([1e-3, 1e-3, 1e-3, 1.0])


def energy(t, y, args):
    """Out of reach in a lane that is to fail."""
    return RIGID_BODY["energy"].fn(t, y, args) + jnp.where((t > 0.1) & (args == FAILED), 9.0, 0.0)


def vector_field(t, y, args):
    return rigid_body(t, y, args) + jnp.where((t > 0.1) & (args == NAN), jnp.nan, 0.0)


MANIFOLD = {"energy": dfc.FirstIntegral(energy), "momentum": RIGID_BODY["momentum"]}


@eqx.filter_jit
def lane(solver, controller, y0, kind, dt0):
    solver = dfc.ManifoldProjection(solver, MANIFOLD)
    options = dict(stepsize_controller=controller, max_steps=600, throw=False)
    sol = solve(vector_field, solver, y0, dt0=dt0, args=kind, **options)
    return sol.ys[-1], dfx.is_okay(sol.result), sol.stats["num_rejected_steps"]


@eqx.filter_jit
def batch(solver, controller, *lanes):
    return jax.vmap(lambda *x: lane(solver, controller, *x))(*lanes)


def check(solver, controller, y0, kinds, dt0):
    kinds = np.asarray(kinds)
    ys, okay, rejected = batch(solver, controller, y0, kinds, dt0)
    good = (kinds == GOOD) | (kinds == REJECTED)
    np.testing.assert_array_equal(okay, good)
    for i in np.flatnonzero(good):
        one = y0[i], jnp.asarray(kinds[i]), jnp.asarray(dt0[i])
        alone, _, _ = lane(solver, controller, *one)
        among_its_like, _, _ = batch(solver, controller, *(jnp.stack([x] * len(y0)) for x in one))
        size = EPS * np.max(np.abs(alone))
        np.testing.assert_allclose(ys[i], among_its_like[i], rtol=0, atol=100 * size)
        # Alone it is another program, whose roundoff grows with the number of steps.
        np.testing.assert_allclose(ys[i], alone, rtol=0, atol=1000 * size)
    return rejected


@some_of("solver", ADAPTIVE, ids=[type(x).__name__ for x in ADAPTIVE], period=2)
@given(
    kinds=st.permutations([*KINDS, GOOD]),
    y0=st.lists(st.floats(0.8, 1.6), min_size=15, max_size=15),
)
def test_bad_lanes_of_an_adaptive_batch_change_no_other(solver, kinds, y0):
    controller = dfx.PIDController(rtol=1e-5, atol=1e-5)
    y0 = jnp.asarray(y0).reshape(5, 3)
    rejected = check(solver, controller, y0, kinds, jnp.asarray(STEPS[list(kinds)]))
    assert int(rejected[kinds.index(REJECTED)]) > 0


@pytest.mark.slow
def test_bad_lanes_change_no_gradient():
    controller = dfx.PIDController(rtol=1e-5, atol=1e-5)

    def gradient(y0, kind, dt0):
        return jax.grad(lambda y0: jnp.sum(lane(dfx.Bosh3(), controller, y0, kind, dt0)[0]))(y0)

    y0 = jnp.array([1.0, 0.8, 0.6]) + 0.1 * jnp.arange(4)[:, None]
    lanes = y0, jnp.array(KINDS), jnp.asarray(STEPS)
    gradients = jax.jit(jax.vmap(gradient))
    together = gradients(*lanes)
    for i in (0, 3):
        # Among its like, which takes no other program.
        like = gradients(*(jnp.stack([x[i]] * 4) for x in lanes))
        np.testing.assert_allclose(together[i], like[0], rtol=0, atol=1000 * EPS)
