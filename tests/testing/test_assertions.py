"""Each assertion passes what is right, and says what is wrong with a planted defect."""

import dataclasses

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from ..problems import OMEGA0, RIGID_BODY, rigid_body

TERM = dfx.ODETerm(rigid_body)
PROJECTED = dfc.ManifoldProjection(dfx.Tsit5(), RIGID_BODY)
STEPS = dfx.SaveAt(t0=True, steps=True)
DENSE = dfx.SaveAt(t0=True, t1=True, dense=True)


@eqx.filter_jit
def solve(solver, saveat, y0=OMEGA0, t1=2.0, max_steps=32):
    return dfx.diffeqsolve(
        TERM, solver, 0.0, t1, 0.1, y0, saveat=saveat, max_steps=max_steps, throw=False
    )


@eqx.filter_jit
def solve_batch(solver, y0s):
    return jax.vmap(lambda y0: solve(solver, STEPS, y0))(y0s)


def message(exception, function, *args, **kwargs):
    with pytest.raises(exception) as caught:
        function(*args, **kwargs)
    return str(caught.value)


@pytest.mark.parametrize("saveat", [STEPS, DENSE], ids=["steps", "dense"])
def test_a_projected_solution_is_conserved(saveat):
    """With rows that diffrax padded."""
    sol = solve(PROJECTED, saveat)
    dct.assert_conserved(sol, RIGID_BODY)
    dct.assert_conserved(sol, RIGID_BODY, y0=OMEGA0)


def test_a_plain_solution_is_not_and_the_message_says_where():
    sol = solve(dfx.Tsit5(), STEPS)
    text = message(AssertionError, dct.assert_conserved, sol, RIGID_BODY)
    assert "`manifold['energy']` first at time 0.1 (saved state, row 1 of 21)" in text
    assert "must stay 0.3" in text
    assert "units of roundoff (float64)" in text
    assert "violated in 20 of 21 rows" in text
    assert "is the solver wrapped" in text
    dct.assert_conserved(sol, RIGID_BODY, rtol=1e-6)
    dct.assert_conserved(sol, RIGID_BODY, rtol=0, atol=1e-6)


def test_an_interpolation_that_is_not_projected_is_found():
    """The nodes lie on the manifold; this is the defect of a naive wrapper."""
    sol = solve(PROJECTED, DENSE)
    plain = solve(dfx.Tsit5(), DENSE)
    broken = eqx.tree_at(lambda s: s.interpolation, sol, plain.interpolation)
    text = message(AssertionError, dct.assert_conserved, broken, RIGID_BODY)
    assert "dense output, row" in text
    assert "the solver's interpolation is not projected" in text


def test_a_drift_before_the_first_saved_state_is_found_if_the_initial_one_is_given():
    sol = solve(dfx.Tsit5(), dfx.SaveAt(t1=True))
    assert "first at time 2" in message(
        AssertionError, dct.assert_conserved, sol, RIGID_BODY, y0=OMEGA0
    )
    assert "`y0=...`" in message(ValueError, dct.assert_conserved, sol, RIGID_BODY)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_state_that_is_not_finite_never_passes(bad):
    """Not even in a component that no integral depends on."""
    sol = solve(PROJECTED, STEPS)
    sol = eqx.tree_at(lambda s: s.ys, sol, sol.ys.at[3, 2].set(bad))
    first = dfc.FirstIntegral(lambda t, y, args: 0 * y[0])
    text = message(AssertionError, dct.assert_conserved, sol, first, rtol=1e300, atol=1e300)
    assert "not finite at time 0.3 (saved state, row 3 of 21)" in text
    assert "not finite" in message(
        AssertionError, dct.assert_on_manifold, first, sol.ys[3], value=0.0
    )


def test_an_unsuccessful_solve_is_reported_as_that():
    sol = solve(PROJECTED, STEPS, t1=10.0)
    text = message(AssertionError, dct.assert_conserved, sol, RIGID_BODY)
    assert "did not succeed" in text
    assert "maximum number of solver steps" in text


def test_lanes_of_a_batch_are_all_checked():
    y0s = jnp.stack([OMEGA0, 2 * OMEGA0, 3 * OMEGA0])
    sol = solve_batch(PROJECTED, y0s)
    dct.assert_conserved(sol, RIGID_BODY, y0=y0s)
    moved = eqx.tree_at(lambda s: s.ys, sol, sol.ys.at[2, 5].multiply(1.001))
    text = message(AssertionError, dct.assert_conserved, moved, RIGID_BODY)
    assert "first at time 0.5 (saved state, row 5 of 21, lane (2,))" in text
    assert "violated in 1 of 63 rows" in text
    failed = solve_batch(PROJECTED, y0s.at[1].set(jnp.nan))
    text = message(AssertionError, dct.assert_conserved, failed, RIGID_BODY)
    assert "in 1 of 3 lanes, first in lane (1,)" in text


def test_nothing_to_check_is_an_error():
    sol = solve(PROJECTED, STEPS)
    empty = dataclasses.replace(sol, ts=None, ys=None)
    assert "holds no states" in message(ValueError, dct.assert_conserved, empty, RIGID_BODY)
    subs = dataclasses.replace(sol, ts=[sol.ts, sol.ts], ys=[sol.ys, sol.ys])
    assert "SubSaveAt" in message(ValueError, dct.assert_conserved, subs, RIGID_BODY)


CIRCLE = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - args)


def test_a_state_on_the_manifold():
    dct.assert_on_manifold(CIRCLE, np.array([0.6, 0.8]), args=1.0)
    text = message(
        AssertionError, dct.assert_on_manifold, CIRCLE, np.array([0.6, 0.8]), t=3.0, args=2.0
    )
    assert "`manifold` first at time 3" in text
    assert "it is -1.0, but must be 0" in text
    assert "was the state projected" in text


def test_a_state_and_given_conserved_values():
    values = {name: entry.fn(0.0, OMEGA0, None) for name, entry in RIGID_BODY.items()}
    dct.assert_on_manifold(RIGID_BODY, OMEGA0, value=values)
    text = message(
        AssertionError, dct.assert_on_manifold, RIGID_BODY, OMEGA0 * (1 + 1e-13), value=values
    )
    assert "must stay 0.3" in text
    assert "`value=...`" in message(ValueError, dct.assert_on_manifold, RIGID_BODY, OMEGA0)


def test_order():
    dct.assert_order(dfx.Heun(), TERM, OMEGA0, t1=2.0, dt0=0.1)
    text = message(
        AssertionError, dct.assert_order, dfx.Heun(), TERM, OMEGA0, t1=2.0, dt0=0.1, order=3
    )
    assert "measured order is 1.9" in text or "measured order is 2.0" in text
    assert "but 3 is claimed" in text
    assert "0.05 " in text


def test_gradients():
    def f(y, system, power):
        return system.energy(0.0, y["w"], None) ** power, y["w"] * y["scale"]

    y = {"w": OMEGA0, "scale": jnp.array(2.0)}
    dct.assert_gradients(f, y, dfc.systems.RigidBody(), 3)


def test_wrong_gradients_are_found_and_the_argument_is_named():
    def f(y):
        return jnp.sum(y["good"] ** 2) + jnp.sum(jax.lax.stop_gradient(y["bad"]) ** 2)

    y = {"good": OMEGA0, "bad": OMEGA0}
    text = message(AssertionError, dct.assert_gradients, f, y)
    assert "`args[0]['bad']`, forward mode gives 0" in text
    assert "`args[0]['bad']`, reverse mode gives 0" in text
    assert "good" not in text
    text = message(AssertionError, dct.assert_gradients, f, y, forward=False)
    assert "forward mode" not in text


def test_gradients_need_something_to_vary():
    assert "nothing to vary" in message(ValueError, dct.assert_gradients, lambda n: n, 3)
