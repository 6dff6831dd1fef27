"""Laws of a whole solve, and of the derivative of a projection."""

import diffrax as dfx
import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import pytest
from hypothesis import given, settings
from jax.flatten_util import ravel_pytree

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from .. import problems
from ..problems import final
from ..thinned import some_of
from .common import PARALLEL, SYSTEMS, check, every_law_on_every_system, inputs, project, within

STEPS = 8


def solve(system, y0, *, solver=None, field=None, t0=0.0, t1=None):
    """Eight fixed steps of projected RK4, each an eighth of the system's own."""
    step = system.dt / 8
    t1 = t0 + STEPS * step if t1 is None else t1
    solver = dfc.ManifoldProjection(dfc.RK4() if solver is None else solver, system.manifold)
    options = dict(t0=t0, t1=t1, dt0=jnp.sign(t1 - t0) * step, max_steps=STEPS + 2, throw=False)
    return problems.solve(system.vector_field if field is None else field, solver, y0, **options)


def okay(*solutions):
    return jnp.stack([dfx.is_okay(sol.result) for sol in solutions])


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
    saveat = dfx.SaveAt(ts=fractions * t1, t1=True, dense=True)
    options = dict(t1=t1, dt0=step, saveat=saveat, max_steps=STEPS + 2, throw=False)
    solver = dfc.ManifoldProjection(dfx.Tsit5(), system.manifold)
    return problems.solve(system.vector_field, solver, y0, **options)


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


def direction(flat, phase):
    return jnp.sin(1 + phase + jnp.arange(flat.size))


def on_the_manifold_it_is_the_orthogonal_projector_that_keeps_the_flow(system, y, displacement):
    """In the Euclidean metric."""
    fixed = jax.tree.map(jnp.asarray, y)
    flat, unravel = ravel_pytree(fixed)

    def run(flat):
        out, ok = project(system.manifold, unravel(flat), fixed)
        return ravel_pytree(out)[0], ok

    _, jvp, ok = jax.linearize(run, flat, has_aux=True)
    a, b = direction(flat, 0), direction(flat, 5)
    flow = ravel_pytree(system.vector_field(0.0, fixed, None))[0]
    flow = flow / jnp.linalg.norm(flow)
    once = jvp(a)
    return ok, (1 + jvp(once), 1 + once @ b, jvp(flow)), (1 + once, 1 + a @ jvp(b), flow)


LAW = on_the_manifold_it_is_the_orthogonal_projector_that_keeps_the_flow


@every_law_on_every_system([LAW], skip={(LAW.__name__, PARALLEL)})
@settings(max_examples=6)
@given(data=st.data())
def test_derivative(law, name, data):
    system = SYSTEMS[name]
    check(law, system, data.draw(inputs(system)))


def balancing(t, y, args):
    rate, angle = args
    return jnp.stack([y[1], -jnp.sin(rate * y[0] - angle)])


def balancing_energy(t, y, args):
    rate, angle = args
    return y[1] ** 2 / 2 - jnp.cos(rate * y[0] - angle) / rate


@eqx.filter_jit
def sensitivity(solver, y0, args):
    def end(y0):
        sol = dfx.diffeqsolve(dfx.ODETerm(balancing), solver, 0, 0.5, 0.05, y0, args)
        return sol.ys[-1]

    return jax.jacrev(end)(y0)


@pytest.mark.slow
@given(
    rate=st.floats(0.5, 2),
    angle=st.floats(-3, 3),
    exponent=st.floats(-9, -1),  # closer to it, derivatives lose all digits with the gradient
    side=st.sampled_from([-1, 1]),
)
def test_a_start_near_an_unstable_equilibrium(rate, angle, exponent, side):
    """The gradient of the energy is small there."""
    args, distance = jnp.array([rate, angle]), side * 10**exponent
    y0 = jnp.array([(angle + jnp.pi) / rate + distance, 0.0])
    projected = dfc.ManifoldProjection(dfc.RK4(), dfc.FirstIntegral(balancing_energy))
    found, plain = (sensitivity(solver, y0, args) for solver in (projected, dfc.RK4()))
    if abs(distance) > 1e-4:
        assert jnp.all(jnp.isfinite(found))
    # Both are derivatives of the flow up to the error of the method.
    assert jnp.all(jnp.isnan(found)) or jnp.max(jnp.abs(found - plain)) < 1e-4
