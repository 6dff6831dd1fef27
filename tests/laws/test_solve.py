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
from .common import PARALLEL, SYSTEMS, check, every_law_on_every_system, inputs, within

STEPS = 8


def solve(system, y0, *, solver=None, field=None, manifold=None, t0=0.0, t1=None, **kwargs):
    """Eight fixed steps of projected RK4, each an eighth of the system's own."""
    step = system.dt / 8
    t1 = t0 + STEPS * step if t1 is None else t1
    manifold = system.manifold if manifold is None else manifold
    return dfx.diffeqsolve(
        dfx.ODETerm(system.vector_field if field is None else field),
        dfc.ManifoldProjection(dfc.RK4() if solver is None else solver, manifold),
        t0,
        t1,
        jnp.sign(t1 - t0) * step,
        y0,
        args=kwargs.pop("args", None),
        throw=False,
        max_steps=kwargs.pop("max_steps", STEPS + 2),
        **kwargs,
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


def every_way_to_save_shows_the_same(system, y, displacement):
    del displacement
    t1 = STEPS * system.dt / 8
    ts = jnp.linspace(0.0, t1, STEPS + 1)
    subs = (
        dfx.SubSaveAt(ts=ts),
        dfx.SubSaveAt(t0=True, steps=True),
        dfx.SubSaveAt(t0=True, t1=True),
    )
    sol = solve(system, y, saveat=dfx.SaveAt(subs=subs, dense=True))
    at_ts, at_steps, at_ends = sol.ys
    dense = jax.vmap(sol.evaluate)(ts)
    inside = jax.tree.map(lambda a, b: (a[: STEPS + 1], b[0], b[1]), at_steps, at_ends)
    expected = jax.tree.map(lambda a: (a, a[0], a[-1]), at_ts)
    return okay(sol), (dense, inside), (at_ts, expected)


@within(1e-10)
def a_moving_frame_moves_the_solution(system, y, displacement):
    """Equation and integrals depend on time then, and on `args`."""
    t0, t1 = 2.0 * system.dt, system.dt
    velocity = jax.tree.map(
        lambda d, x: d * jnp.mean(jnp.abs(x)) / system.dt,
        jax.tree.map(jnp.asarray, displacement),
        y,
    )

    def seen(y, t, sign=1):
        return jax.tree.map(lambda a, c: a + sign * c * t, y, velocity)

    def field(t, z, args):
        slope = system.vector_field(t, seen(z, t, -1), None)
        return jax.tree.map(jnp.add, slope, args)

    manifold = {
        name: type(entry)(lambda t, z, args, fn=entry.fn: fn(t, seen(z, t, -1), None))
        for name, entry in system.manifold.items()
    }
    moving = solve(system, seen(y, t0), field=field, manifold=manifold, t0=t0, t1=t1, args=velocity)
    sol = solve(system, y, t0=t0, t1=t1)
    # Runge-Kutta methods commute with affine maps; so does the Euclidean projection with shifts.
    return okay(moving, sol), final(moving), seen(final(sol), t1)


@within(1e-7)
def the_gradient_of_an_integral_is_carried_back_unchanged(system, y, displacement):
    """`I(y(T)) = I(y0)` for every `y0`, so both sides have the same derivative along any direction
    in which the constraints hold: here the flow's and that of the displacement."""

    def total(y):
        return jnp.stack(
            [
                jnp.sum(jnp.sin(1 + jnp.arange(jnp.size(v))) * jnp.ravel(v))
                for v in (entry.fn(0.0, y, None) for entry in integrals)
            ]
        )

    integrals = [e for e in system.manifold.values() if isinstance(e, dfc.FirstIntegral)]
    manifold = [dfc.FirstIntegral(e.fn) for e in system.manifold.values()]

    def end(y):
        sol = solve(system, y, manifold=manifold)
        return total(final(sol)), dfx.is_okay(sol.result)

    y = jax.tree.map(jnp.asarray, y)
    (value, pullback, ok) = jax.vjp(end, y, has_aux=True)
    weights = jnp.cos(jnp.arange(value.size))
    (got,) = pullback(weights)
    (expected,) = jax.vjp(total, y)[1](weights)
    return ok, got, expected


LAWS = [
    the_negative_field_backwards_is_the_field_forwards,
    there_and_back_again,
    every_way_to_save_shows_the_same,
    a_moving_frame_moves_the_solution,
    the_gradient_of_an_integral_is_carried_back_unchanged,
]


# Tests of single features hold these by default.
SLOW = {
    a_moving_frame_moves_the_solution,
    every_way_to_save_shows_the_same,
    the_gradient_of_an_integral_is_carried_back_unchanged,
}


@every_law_on_every_system(
    LAWS,
    skip={(the_gradient_of_an_integral_is_carried_back_unchanged.__name__, PARALLEL)},
    slow=SLOW,
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
