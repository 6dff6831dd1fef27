"""Vector fields that see only admissible states."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import diffrax_conserve as dfc

from .problems import refused, solve
from .thinned import some_of

SEEN = dfc.clipped(lambda t, y, args: (2 * y[0], y[1]), lower=(0.0, -1.0), upper=(1.0, jnp.inf))
SLOPE = jax.jit(lambda y: SEEN(0.0, y, None))


@given(st.lists(st.floats(-3, 3, width=16), min_size=4, max_size=4))
def test_the_field_sees_the_nearest_admissible_state(numbers):
    a, b = np.array(numbers[:2]), np.array(numbers[2:])
    found = SLOPE((jnp.asarray(a), jnp.asarray(b)))
    assert np.array_equal(found[0], 2 * np.clip(a, 0, 1))
    assert np.array_equal(found[1], np.maximum(b, -1))


def test_the_derivative_is_that_from_inside_at_a_bound_and_zero_outside():
    slope = jax.grad(lambda y: SEEN(0.0, (y, y), None)[0])
    assert [float(slope(y)) for y in (-1e-9, 0.0, 0.5, 1.0, 1.1)] == [0, 2, 2, 2, 0]


def test_nan_stays_nan():
    assert jnp.isnan(SEEN(0.0, (jnp.nan, 0.0), None)[0])


@some_of("solver", [dfx.Tsit5(), dfx.Kvaerno3()], ids=["Tsit5", "Kvaerno3"], period=2)
def test_no_stage_is_evaluated_outside(solver):
    """`y' = -sqrt(y)` from one, which ends at `t = 2`, known from `y = (1 - t/2)²`."""
    worst = []

    def outflow(t, y, args):
        jax.debug.callback(lambda y: worst.append(float(y)), y)
        return -jnp.sqrt(y)

    field = dfc.clipped(outflow, lower=1e-30)
    controller = dfx.PIDController(rtol=1e-5, atol=1e-7)
    saveat = dfx.SaveAt(ts=jnp.array([1.0, 3.0]))
    options = dict(stepsize_controller=controller, saveat=saveat, max_steps=4096)
    found = solve(field, solver, jnp.array(1.0), t1=3.0, **options).ys
    jax.effects_barrier()
    assert min(worst) >= 1e-30
    assert np.allclose(found, [0.25, 0.0], rtol=0, atol=1e-4)


test_mistakes_are_named = refused(
    (lambda: dfc.clipped(1.0, lower=0.0), TypeError, "`vector_field` is"),
    (lambda: dfc.clipped(SEEN), ValueError, "needs a bound"),
    (lambda: dfc.clipped(SEEN, lower="0"), TypeError, "`lower` is"),
    (lambda: dfc.clipped(SEEN, lower=1.0, upper=0.0), ValueError, "at most `upper`"),
    (lambda: SEEN(0.0, jnp.ones(2), None), ValueError, "`lower` has the structure"),
    (lambda: SEEN(0.0, (1, 1), None), TypeError, "floating-point"),
)
