"""Laws of a whole solve, and what the testing tools say about it."""

import diffrax as dfx
import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
from hypothesis import given, settings

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from ..thinned import some_of
from .common import SYSTEMS, check, every_law_on_every_system, inputs, within

STEPS = 8


def solve(system, y0, *, solver=None, field=None, t0=0.0, t1=None):
    """Eight fixed steps of projected RK4, each an eighth of the system's own."""
    step = system.dt / 8
    t1 = t0 + STEPS * step if t1 is None else t1
    return dfx.diffeqsolve(
        dfx.ODETerm(system.vector_field if field is None else field),
        dfc.ManifoldProjection(dfc.RK4() if solver is None else solver, system.manifold),
        t0,
        t1,
        jnp.sign(t1 - t0) * step,
        y0,
        throw=False,
        max_steps=STEPS + 2,
    )


def okay(*solutions):
    return jnp.stack([dfx.is_okay(sol.result) for sol in solutions])


def final(sol):
    return jax.tree.map(lambda y: y[-1], sol.ys)


@within(1e-12)
def the_negative_field_backwards_is_the_field_forwards(system, y, displacement):
    del displacement

    def negative(t, y, args):
        return jax.tree.map(jnp.negative, system.vector_field(t, y, args))

    backward = solve(system, y, field=negative, t1=-STEPS * system.dt / 8)
    sol = solve(system, y)
    return okay(backward, sol), final(backward), final(sol)


@within(1e-6)
def there_and_back_again(system, y, displacement):
    """As far as the error of the method allows."""
    del displacement
    there = solve(system, y, solver=dfx.Dopri8())
    back = solve(system, final(there), solver=dfx.Dopri8(), t0=STEPS * system.dt / 8, t1=0.0)
    return okay(there, back), final(back), jax.tree.map(jnp.asarray, y)


@every_law_on_every_system(
    [the_negative_field_backwards_is_the_field_forwards, there_and_back_again]
)
@settings(max_examples=6)
@given(data=st.data())
def test_law(law, name, data):
    system = SYSTEMS[name]
    check(law, system, data.draw(inputs(system)))


@eqx.filter_jit
def saved(system, y0, step, fractions):
    t1 = STEPS * step
    return dfx.diffeqsolve(
        dfx.ODETerm(system.vector_field),
        dfc.ManifoldProjection(dfx.Tsit5(), system.manifold),
        0.0,
        t1,
        step,
        y0,
        saveat=dfx.SaveAt(ts=fractions * t1, t1=True, dense=True),
        max_steps=STEPS + 2,
        throw=False,
    )


@some_of("name", SYSTEMS, ids=SYSTEMS, period=14)
@settings(max_examples=6)
@given(data=st.data())
def test_a_solution_that_succeeds_is_conserved(name, data):
    """At drawn states, step sizes and times; the failure of a too large step may be reported."""
    system = SYSTEMS[name]
    y0 = data.draw(dct.system_states(system), label="y0")
    step = data.draw(dct.step_sizes(system.dt), label="step")
    fractions = data.draw(dct.times(0.0, 1.0), label="times")
    sol = saved(system, y0, step, fractions)
    if dfx.is_okay(sol.result):
        dct.assert_conserved(sol, system.manifold, y0=y0)
    else:
        assert step > system.dt / 20
