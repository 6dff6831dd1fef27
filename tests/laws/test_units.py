"""The answer does not depend on the units: neither its digits, nor how accurate it is.

What is exact is computed here in numpy, by Kepler's equation or in closed form.
"""

import functools

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import diffrax_conserve as dfc
from diffrax_conserve._solver.state import updated_units
from diffrax_conserve._tree import ravel

from ..problems import RIGID_BODY, rigid_body


def kepler(t, y, mu):
    return jnp.concatenate([y[2:], -mu * y[:2] / jnp.sum(y[:2] ** 2) ** 1.5])


KEPLER = {
    "energy": dfc.FirstIntegral(lambda t, y, mu: y[2:] @ y[2:] / 2 - mu / jnp.sqrt(y[:2] @ y[:2])),
    "momentum": dfc.FirstIntegral(lambda t, y, mu: y[0] * y[3] - y[1] * y[2]),
}


def pendulum(t, y, _):
    pull = (y[2:] @ y[2:] - y[1]) / (y[:2] @ y[:2])
    return jnp.append(y[2:], jnp.array([0.0, -1.0]) - pull * y[:2])


PENDULUM = {
    "length": dfc.Constraint(lambda t, y, _: y[:2] @ y[:2] - 1),
    "energy": dfc.FirstIntegral(lambda t, y, _: y[2:] @ y[2:] / 2 + y[1]),
}
# The field, what is kept, a start, the solver and the projection.
SYSTEMS = {
    "Kepler": (kepler, KEPLER, [0.8, 0.3, -0.4, 1.0], dfx.Tsit5(), dfc.SimplifiedNewton()),
    "rigid body": (rigid_body, RIGID_BODY, [1.0, 0.3, -0.6], dfc.RK4(), dfc.Newton()),
    "pendulum": (pendulum, PENDULUM, [0.8, 0.6, 0.0, 0.0], dfc.RK4(), dfc.SimplifiedNewton()),
}


def in_units(fn, factor):
    """`fn` of what is in units of `args[0]`, and of `args[1]` for time, times `factor(args)`."""
    return lambda t, y, args: factor(args) * fn(t / args[1], y / args[0], 1.0)


def natural(field, manifold, y0, solver, projection):
    """Saved times, an event, statistics and a derivative, all brought back to natural units."""
    manifold = {
        k: type(entry)(in_units(entry.fn, lambda args, i=i: args[2][i]))
        for i, (k, entry) in enumerate(manifold.items())
    }
    term = dfx.ODETerm(in_units(field, lambda args: args[0] / args[1]))
    projected = dfc.ManifoldProjection(solver, manifold, projection=projection)

    def run(y0, units, clock, sizes):
        crossed = lambda t, y, args, **kwargs: clock * (y[1] / units[1] + 0.1)  # noqa: E731
        event = dfx.Event(crossed, optx.Newton(1e-10, 1e-10 * clock)) if len(y0) > 3 else None
        pid = dfx.PIDController(rtol=1e-5, atol=1e-5 * units)
        sol = dfx.diffeqsolve(
            term, projected, 0.0 * clock, 9 * clock, 0.1 * clock, y0 * units, (units, clock, sizes),
            event=event, max_steps=100, throw=False, adjoint=dfx.ForwardMode(),
            saveat=dfx.SaveAt(ts=clock * jnp.linspace(0, 0.4, 9), t1=True, solver_state=True),
            stepsize_controller=pid if isinstance(solver, dfx.Tsit5) else dfx.ConstantStepSize(),
        )  # fmt: skip
        counts, happened = dfc.statistics(sol), sol.result == dfx.RESULTS.event_occurred
        happened = happened | (event is None) & dfx.is_okay(sol.result)
        kept = counts.num_iterations, counts.residual_before, counts.residual_after
        return sol.ys / units, (sol.ts / clock, *kept, happened)

    y0 = jnp.array(y0)
    return jax.jit(
        lambda *units: jax.jvp(lambda y: run(y, *units), (y0,), (jnp.cos(y0 + 1),), has_aux=True)
    )


@pytest.mark.parametrize(
    "name",
    ["rigid body", *(pytest.param(x, marks=pytest.mark.slow) for x in ("Kepler", "pendulum"))],
)
def test_powers_of_two_as_units_change_nothing(name):
    _, manifold, y0, *_ = SYSTEMS[name]
    run, shapes = natural(*SYSTEMS[name]), (len(y0), (), len(manifold))
    expected = jax.tree.leaves(run(*map(np.ones, shapes)))
    assert expected[-1]
    assert all(np.all(np.isfinite(x)) for x in expected)
    rng = np.random.default_rng(0)
    for _ in range(10):
        got = run(*(np.asarray(2.0 ** rng.integers(-40, 41, shape)) for shape in shapes))
        for a, b in zip(jax.tree.leaves(got), expected, strict=True):
            np.testing.assert_array_equal(a, b)


EARTH = 3.986004418e14  # its gravitational parameter


def on_ellipse(mu, a, e, mean_anomaly):
    m = np.asarray(mean_anomaly, np.longdouble)
    anomaly = m + e * np.sin(m)
    for _ in range(8):
        anomaly -= (anomaly - e * np.sin(anomaly) - m) / (1 - e * np.cos(anomaly))
    c, s, b = np.cos(anomaly), np.sin(anomaly), np.sqrt(1 - e * e)
    speed = np.sqrt(mu / a) / (1 - e * c)
    states = np.stack([a * (c - e), a * b * s, -speed * s, speed * b * c], axis=-1)
    return states.astype(float)


def test_roundoff_does_not_move_satellites_further_than_plain():
    """In single precision and metres, almost circular, where energy and momentum have nearly
    parallel gradients, so that a correction of roundoff in one of them only would be long."""
    rng, lanes = np.random.default_rng(0), 300
    a, e, phase = rng.uniform([[6.8e6], [0], [0]], [[8e6], [0.1], [2 * np.pi]], (3, lanes))
    rate = np.sqrt(EARTH / a**3)
    dt = (2 * np.pi / rate / 160).astype(np.float32)

    @jax.jit
    @jax.vmap
    def ends(y0, dt):
        solvers = dfc.RK4(), dfc.ManifoldProjection(dfc.RK4(), KEPLER)
        given = jnp.zeros((), dt.dtype), 400 * dt, dt, y0, jnp.asarray(EARTH, dt.dtype)
        options = dict(max_steps=None, adjoint=dfx.ForwardMode())
        sols = [dfx.diffeqsolve(dfx.ODETerm(kepler), s, *given, **options) for s in solvers]
        return [sol.ys[-1] for sol in sols]

    exact = on_ellipse(EARTH, a, e, phase + 400 * rate * dt)
    found = ends(jnp.asarray(on_ellipse(EARTH, a, e, phase), np.float32), dt)
    plain, projected = (np.linalg.norm((y - exact)[:, :2], axis=1) for y in map(np.asarray, found))
    assert np.max(projected) < np.max(plain)
    assert np.median(projected) < 0.7 * np.median(plain)


SEVEN = {
    "energy": dfc.FirstIntegral(lambda t, y, mu: y[3:] @ y[3:] / 2 - mu / jnp.linalg.norm(y[:3])),
    "momentum": dfc.FirstIntegral(lambda t, y, mu: jnp.cross(y[:3], y[3:])),
    "eccentricity": dfc.FirstIntegral(
        lambda t, y, mu: (
            jnp.cross(y[3:], jnp.cross(y[:3], y[3:])) - mu * y[:3] / jnp.linalg.norm(y[:3])
        )
    ),
}


@pytest.mark.slow
def test_the_seven_integrals_of_an_orbit_in_space_of_which_five_are_independent():
    a, e, turns = 7.078e6, np.array([0.0, 1e-8, 1e-4, 1e-2, 0.3]), 5
    rate, size = np.sqrt(EARTH / a**3), np.repeat([a, np.sqrt(EARTH / a)], 3)
    plane = np.array([[1, 0, 0], [0, np.cos(0.7), np.sin(0.7)]])
    ellipse = on_ellipse(EARTH, a, e[:, None], np.array([[0.3, 0.3 + 2 * np.pi * turns]]))
    in_space = [part @ plane for part in np.split(ellipse, 2, axis=-1)]
    y0, exact = np.moveaxis(np.concatenate(in_space, axis=-1), 1, 0)
    field = lambda t, y, mu: jnp.append(y[3:], -mu * y[:3] / jnp.linalg.norm(y[:3]) ** 3)  # noqa: E731

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, None))
    def run(y0, dt):
        solvers = dfx.Tsit5(), dfc.ManifoldProjection(dfx.Tsit5(), SEVEN)
        options, end = dict(saveat=dfx.SaveAt(t1=True, solver_state=True), throw=False), 2 * np.pi
        sols = [dfx.diffeqsolve(dfx.ODETerm(field), solver, 0.0, turns * end / rate, dt, y0, EARTH,
                                **options) for solver in solvers]  # fmt: skip
        return *[sol.ys[0] for sol in sols], dfc.statistics(sols[1]).max_iterations

    for count in 60, 200:
        plain, projected, iterations = run(y0, 2 * np.pi / rate / count)
        errors = [np.max(np.abs(y - exact) / size, axis=1) for y in (plain, projected)]
        assert np.all(errors[1] < errors[0])  # NaN is not
        assert np.all(iterations <= 12)


def test_a_vector_in_a_leaf_is_one_quantity_and_a_component_of_an_array_another():
    """By the sizes and the changes of a step: `sqrt(4 · 1)` and `sqrt(2 · 0.02)`."""
    place, speed = np.array([[0.0, 4.0], [3.0, 0.0]]), np.array([2.0, 0.0])
    moved = (place - np.array([[1.0, 0.0], [0.0, 0.0]]), speed - np.array([0.02, 0.0]))

    @jax.jit
    def units(start, end):
        zero = jax.tree.map(jnp.zeros_like, start)
        change = jnp.abs(ravel(end) - ravel(start))
        return updated_units(ravel(zero), change, ravel(end), end)

    eps = np.finfo(float).eps
    of_leaves = units(moved, (place, speed))
    np.testing.assert_allclose(of_leaves, [2, 2, *[3 * eps**0.5] * 2, 0.2, 0.2])
    of_array = units(np.asarray(ravel(moved)), np.asarray(ravel((place, speed))))
    np.testing.assert_allclose(of_array[np.array([1, 2, 4])], [4 * eps**0.5, 3 * eps**0.5, 0.2])
    assert of_array[5] == 0
