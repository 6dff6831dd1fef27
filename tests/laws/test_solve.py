"""Laws of a whole solve and of its lanes, and of the derivative of a projection."""

import diffrax as dfx
import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from jax.flatten_util import ravel_pytree

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from .. import problems
from ..problems import EPS, RIGID_BODY, final, rigid_body
from ..thinned import some_of
from .common import PARALLEL, SYSTEMS, every_law_on_every_system, project, within

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


test_law = every_law_on_every_system(
    [the_negative_field_backwards_is_the_field_forwards, there_and_back_again]
)


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


test_derivative = every_law_on_every_system([LAW], skip={(LAW.__name__, PARALLEL)})


lean = lambda y, args: args[0] * y[0] - args[1]  # noqa: E731
BALANCING = dfx.ODETerm(lambda t, y, args: jnp.stack([y[1], -jnp.sin(lean(y, args))]))
LEANING = dfc.FirstIntegral(lambda t, y, a: y[1] ** 2 / 2 - jnp.cos(lean(y, a)) / a[0])


@eqx.filter_jit
def sensitivity(solver, y0, args):
    def end(y0):
        return dfx.diffeqsolve(BALANCING, solver, 0, 0.5, 0.05, y0, args).ys[-1]

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
    projected = dfc.ManifoldProjection(dfc.RK4(), LEANING)
    found, plain = (sensitivity(solver, y0, args) for solver in (projected, dfc.RK4()))
    if abs(distance) > 1e-4:
        assert jnp.all(jnp.isfinite(found))
    # Both are derivatives of the flow up to the error of the method.
    assert jnp.all(jnp.isnan(found)) or jnp.max(jnp.abs(found - plain)) < 1e-4


# ---- A lane of a batch is that lane alone, whatever happens to its neighbours ----

# Of implicit methods, which keep their last stage, lanes depend on each other within the tolerance.
# The first one keeps its last stage.
ADAPTIVE = [dfx.Tsit5(), dfx.Heun()]
GOOD, NAN, FAILED, REJECTED = KINDS = range(4)
# The initial step, which the controller rejects in the last kind of lane.
FIRST_STEPS = np.array([1e-3, 1e-3, 1e-3, 1.0])


def energy(t, y, args):
    """Out of reach in a lane that is to fail."""
    return RIGID_BODY["energy"].fn(t, y, args) + jnp.where((t > 0.1) & (args == FAILED), 9.0, 0.0)


def vector_field(t, y, args):
    return rigid_body(t, y, args) + jnp.where((t > 0.1) & (args == NAN), jnp.nan, 0.0)


MANIFOLD = {"energy": dfc.FirstIntegral(energy), "momentum": RIGID_BODY["momentum"]}


@eqx.filter_jit
def lane(solver, y0, kind, dt0):
    options = dict(stepsize_controller=dfx.PIDController(rtol=1e-5, atol=1e-5), max_steps=600)
    options |= dict(dt0=dt0, args=kind, throw=False)
    sol = problems.solve(vector_field, dfc.ManifoldProjection(solver, MANIFOLD), y0, **options)
    return sol.ys[-1], dfx.is_okay(sol.result), sol.stats["num_rejected_steps"]


batch = eqx.filter_jit(eqx.filter_vmap(lane, in_axes=(None, 0, 0, 0)))


@some_of("solver", ADAPTIVE, ids=[type(x).__name__ for x in ADAPTIVE], period=2)
@given(
    kinds=st.permutations([*KINDS, GOOD]),
    y0=st.lists(st.floats(0.8, 1.6), min_size=15, max_size=15),
)
def test_bad_lanes_of_an_adaptive_batch_change_no_other(solver, kinds, y0):
    lanes = jnp.asarray(y0).reshape(5, 3), jnp.asarray(kinds), jnp.asarray(FIRST_STEPS[list(kinds)])
    ys, okay, rejected = batch(solver, *lanes)
    good = np.isin(kinds, (GOOD, REJECTED))
    np.testing.assert_array_equal(okay, good)
    assert int(rejected[kinds.index(REJECTED)]) > 0
    for i in np.flatnonzero(good):
        alone, _, _ = lane(solver, *(x[i] for x in lanes))
        among_its_like, _, _ = batch(solver, *(jnp.stack([x[i]] * 5) for x in lanes))
        size = EPS * np.max(np.abs(alone))
        np.testing.assert_allclose(ys[i], among_its_like[i], rtol=0, atol=100 * size)
        # Alone it is another program, whose roundoff grows with the number of steps.
        np.testing.assert_allclose(ys[i], alone, rtol=0, atol=1000 * size)


@pytest.mark.slow
def test_bad_lanes_change_no_gradient():
    gradient = jax.grad(lambda y0, *rest: jnp.sum(lane(dfx.Bosh3(), y0, *rest)[0]))
    gradients = jax.jit(jax.vmap(gradient))
    y0 = jnp.array([1.0, 0.8, 0.6]) + 0.1 * jnp.arange(4)[:, None]
    lanes = y0, jnp.array(KINDS), jnp.asarray(FIRST_STEPS)
    together = gradients(*lanes)
    for i in (0, 3):
        # Among its like, which takes no other program.
        like = gradients(*(jnp.stack([x[i]] * 4) for x in lanes))
        np.testing.assert_allclose(together[i], like[0], rtol=0, atol=1000 * EPS)
