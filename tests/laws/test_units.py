"""The answer does not depend on the units: neither its digits, nor how accurate it is.

What is exact is computed here in numpy, by Kepler's equation; one of the orbits is an electron's.
"""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import diffrax_conserve as dfc

TURNS = 12
EARTH, SUN = 3.986004418e14, 1.32712440018e20
# The gravitational parameter, or e²/(4π ε₀ m), and the semi-major axis: satellites and planets, one
# in kilometres, and an electron in SI.
ORBITS = {
    "low orbit": (EARTH, 7.078e6),
    "geostationary": (EARTH, 4.2164e7),
    "geostationary, in km": (EARTH / 1e9, 4.2164e4),
    "Earth": (SUN, 1.496e11),
    "Earth, in AU and days": (2.959122082855911e-4, 1.0),
    "electron": (253.2638, 5.29e-11),
}
ECCENTRICITIES = (0.0, 1e-5, 2e-4, 1e-2, 0.2)


def kepler(t, y, mu):
    return jnp.concatenate([y[2:], -mu * y[:2] / jnp.sum(y[:2] ** 2) ** 1.5])


KEPLER = {
    "energy": dfc.FirstIntegral(lambda t, y, mu: y[2:] @ y[2:] / 2 - mu / jnp.sqrt(y[:2] @ y[:2])),
    "momentum": dfc.FirstIntegral(lambda t, y, mu: y[0] * y[3] - y[1] * y[2]),
}


def on_ellipse(mu, a, e, mean_anomaly):
    """The states at mean anomalies, and the size of each component."""
    m = np.asarray(mean_anomaly, np.longdouble)
    anomaly = m + e * np.sin(m)
    for _ in range(8):
        anomaly -= (anomaly - e * np.sin(anomaly) - m) / (1 - e * np.cos(anomaly))
    c, s, b = np.cos(anomaly), np.sin(anomaly), np.sqrt(1 - e * e)
    speed = np.sqrt(mu / a) / (1 - e * c)
    states = np.stack([a * (c - e), a * b * s, -speed * s, speed * b * c], axis=-1)
    return states.astype(float), np.repeat([a, np.sqrt(mu / a)], 2)


LANES = [(*ORBITS[name], e) for name in ORBITS for e in ECCENTRICITIES]


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, 0, 0, 0, 0))
def orbit(solver, ts, y0, mu, size):
    """At saved times, and at the steps."""
    subs = dfx.SubSaveAt(ts=ts), dfx.SubSaveAt(t0=True, steps=True)
    return dfx.diffeqsolve(
        dfx.ODETerm(kepler), solver, 0.0, ts[-1], ts[-1] / TURNS / 50, y0, mu,
        saveat=dfx.SaveAt(subs=subs), throw=False, max_steps=1200,
        stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6 * size),
    )  # fmt: skip


@pytest.fixture(scope="module")
def orbits():
    """The errors of all lanes, plain and projected, at the saved times and at the steps."""
    phase = 0.7
    starts, sizes = (np.stack(x) for x in zip(*(on_ellipse(*x, phase) for x in LANES), strict=True))
    mu, a, _ = np.transpose(LANES)
    rate = np.sqrt(mu / a**3)
    ts = 2 * np.pi * TURNS / rate[:, None] * np.linspace(0, 1, 301)
    found = {}
    for name, solver in (
        ("plain", dfx.Dopri8()),
        ("projected", dfc.ManifoldProjection(dfx.Dopri8(), KEPLER)),
    ):
        sol = orbit(solver, ts, starts, mu, sizes)
        assert np.all(dfx.is_okay(sol.result)) if name == "plain" else True
        errors = []
        for t, y in zip(sol.ts, sol.ys, strict=True):
            exact = [
                on_ellipse(*lane, phase + n * np.where(np.isfinite(x), x, 0))[0]
                for lane, n, x in zip(LANES, rate, np.asarray(t), strict=True)
            ]
            errors.append(np.max(np.abs(y - np.stack(exact)) / sizes[:, None], axis=-1))
        found[name] = ts, np.asarray(sol.ts[1]), *errors, np.asarray(dfx.is_okay(sol.result))
    return found


def test_orbits_in_any_units_are_more_accurate_than_plain(orbits):
    *_, plain, _, _ = orbits["plain"]
    *_, projected, _, okay = orbits["projected"]
    assert np.all(okay)
    ratio = np.max(projected, axis=1) / np.max(plain, axis=1)
    assert np.all(ratio < 1), dict(zip(LANES, ratio, strict=True))
    assert np.median(ratio) < 0.1


def at_neighbours(ts, steps, at_steps):
    """The larger error at the two steps around each saved time."""
    count = np.sum(np.isfinite(steps))
    right = np.clip(np.searchsorted(steps[:count], ts), 1, count - 1)
    return np.maximum(at_steps[right - 1], at_steps[right])


def test_no_saved_state_is_that_of_another_time(orbits):
    """It errs as the steps around it, beside what the interpolant of the plain solver errs."""
    for i, lane in enumerate(LANES):
        ts, steps, saved, at_steps, _ = (x[i] for x in orbits["plain"])
        interpolant = np.max(saved - at_neighbours(ts, steps, at_steps))
        ts, steps, saved, at_steps, _ = (x[i] for x in orbits["projected"])
        allowed = 3 * (at_neighbours(ts, steps, at_steps) + max(interpolant, 0)) + 1e-12
        assert np.all(saved <= allowed), lane


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, None, 0, 0, 0, 0))
def perigee(solver, root_finder, y0, mu, size, rate):
    # An angle: in metres no root finder meets an absolute tolerance of 1e-10.
    angle = lambda t, y, args, **kwargs: y[1] / jnp.sqrt(y[:2] @ y[:2])  # noqa: E731
    event = dfx.Event(angle, root_finder, direction=True)
    sol = dfx.diffeqsolve(
        dfx.ODETerm(kepler), solver, 0.0, 7.5 / rate, 0.1 / rate, y0, mu,
        event=event, throw=False, max_steps=600,
        stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8 * size),
    )  # fmt: skip
    return sol.ts[0] * rate, sol.ys[0], sol.result == dfx.RESULTS.event_occurred


@pytest.mark.parametrize("root_finder", [optx.Newton, optx.Bisection], ids=lambda x: x.__name__)
def test_perigees_are_found_on_circles_too(root_finder):
    starts, lanes = np.linspace(0.3, 6.0, 12), [x for x in LANES if x[0] in (EARTH, EARTH / 1e9)]
    lanes = [(*lane, m) for lane in lanes for m in starts]
    y0, size = (np.stack(x) for x in zip(*(on_ellipse(*x) for x in lanes), strict=True))
    mu, a, _, m = np.transpose(lanes)
    exact, off = 2 * np.pi - m, {}
    for name, solver in (
        ("plain", dfx.Dopri8()),
        ("projected", dfc.ManifoldProjection(dfx.Dopri8(), KEPLER)),
    ):
        root = root_finder(1e-10, 1e-10)
        t, y, happened = perigee(solver, root, y0, mu, size, np.sqrt(mu / a**3))
        off[name] = np.where(happened & np.all(np.isfinite(y), axis=1), np.abs(t - exact), np.inf)
    found = off["plain"] < 1e-3
    assert np.mean(found) > 0.95
    assert np.max(off["projected"][found]) <= 1.5 * np.max(off["plain"][found])


def in_units(fn, factor):
    """`fn` of what is in units of `args[0]`, and of `args[1]` for time, times `factor(args)`."""
    return lambda t, y, args: factor(args) * fn(t / args[1], y / args[0], 1.0)


FIELD = in_units(kepler, lambda args: args[0] / args[1])
IN_UNITS = {
    name: dfc.FirstIntegral(in_units(entry.fn, lambda args, i=i: args[2][i]))
    for i, (name, entry) in enumerate(KEPLER.items())
}


@eqx.filter_jit
def scaled(solver, adaptive, y0, units, clock, sizes):
    """Saved times, an event, statistics and derivatives, all brought back to natural units."""
    solver = dfc.ManifoldProjection(solver, IN_UNITS)
    controller = dfx.ConstantStepSize()
    if adaptive:
        controller = dfx.PIDController(rtol=1e-5, atol=1e-5 * units)
    event = dfx.Event(
        lambda t, y, args, **kwargs: clock * y[1] / units[1], optx.Bisection(1e-10, 1e-10 * clock)
    )

    def states(y0):
        sol = dfx.diffeqsolve(
            dfx.ODETerm(FIELD), solver, 0.0 * clock, 8 * clock, 0.1 * clock, y0 * units,
            (units, clock, sizes), event=event, throw=False, max_steps=200,
            saveat=dfx.SaveAt(ts=clock * jnp.linspace(0, 2, 20), t1=True, solver_state=True),
            stepsize_controller=controller, adjoint=dfx.ForwardMode(),
        )  # fmt: skip
        counts = dfc.statistics(sol)
        kept = counts.num_iterations, counts.residual_before, counts.residual_after
        return sol.ys / units, (sol.ts / clock, *kept, sol.result == dfx.RESULTS.event_occurred)

    ys, derivative, rest = jax.jvp(states, (y0,), (jnp.array([0.3, -0.2, 0.1, 0.5]),), has_aux=True)
    return ys, derivative, rest


exponents = st.integers(-40, 40).map(lambda k: 2.0**k)


@pytest.mark.parametrize("name", ["RK4", "Tsit5"])
@settings(max_examples=10)
@given(
    units=st.tuples(*[exponents] * 4), clock=exponents, sizes=st.tuples(*[exponents] * 2),
    e=st.sampled_from([0.05, 0.3]),
)  # fmt: skip
def test_powers_of_two_as_units_change_nothing(name, units, clock, sizes, e):
    solver, adaptive = {"RK4": (dfc.RK4(), False), "Tsit5": (dfx.Tsit5(), True)}[name]
    y0 = jnp.asarray(on_ellipse(1.0, 1.0, e, -2.0)[0])
    given = (np.asarray(x) for x in (units, clock, sizes))
    got = scaled(solver, adaptive, y0, *given)
    expected = scaled(solver, adaptive, y0, np.ones(4), np.ones(()), np.ones(2))
    assert expected[-1][-1]
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)
