"""Does the answer depend on the units? Planets in metres, atoms, circuits, and random powers of two.

    python benchmarks/studies/units.py               # one row for each promise
    python benchmarks/studies/units.py --only planet # the parts whose names hold this text
    python benchmarks/studies/units.py --smoke       # toy sizes

Errors are measured against Kepler's equation, solved here in long double, and against plain Dopri8 at
1e-13. A row says what was measured, the number, and what it should be at most.
"""

import argparse
import functools
import traceback

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree

import diffrax_conserve as dfc

jax.config.update("jax_enable_x64", True)

SMOKE = False
METHODS = {"Tsit5": dfx.Tsit5(), "Dopri8": dfx.Dopri8()}
# What is off the manifold by more than this, relative, was not projected.
OFF = 1e-12


def euclidean():
    """The projection in the user's numbers; the versions before had no other, nor this name."""
    try:
        projection = dfc.SimplifiedNewton(metric=1.0)
        project_once = dfc.ManifoldProjection(
            dfx.Tsit5(), dfc.FirstIntegral(lambda t, y, _: y @ y), projection=projection
        )
        dfx.diffeqsolve(dfx.ODETerm(lambda t, y, _: y * 0), project_once, 0, 1, 1.0, jnp.ones(2))
        return projection
    except (TypeError, ValueError):
        return dfc.SimplifiedNewton()


def solve(field, solver, t1, dt0, y0, args=None, *, t0=0.0, rtol=None, atol=None, **options):
    controller = dfx.ConstantStepSize() if rtol is None else dfx.PIDController(rtol=rtol, atol=atol)
    options = dict(max_steps=200_000, throw=False) | options
    return dfx.diffeqsolve(
        dfx.ODETerm(field), solver, t0, t1, dt0, y0, args, stepsize_controller=controller, **options
    )  # fmt: skip


def compiled(fn):
    """Compiled once for all numbers: none of them is static."""
    jitted = eqx.filter_jit(fn)

    @functools.wraps(fn)
    def call(*args, **kwargs):
        args = [jnp.asarray(x) if isinstance(x, float) else x for x in args]
        return jitted(
            *args, **{k: jnp.asarray(x) if isinstance(x, float) else x for k, x in kwargs.items()}
        )

    return call


def few(many, toy):
    return toy if SMOKE else many


def largest(x):
    """NaN is the largest."""
    return float(np.max(np.where(np.isnan(x), np.inf, x)))


# ---- Kepler's problem in any units, in its plane: y = (q₁, q₂, v₁, v₂), args = μ ----


def kepler(t, y, mu):
    return jnp.concatenate([y[2:], -mu * y[:2] / jnp.sum(y[:2] ** 2) ** 1.5])


KEPLER = {
    "energy": dfc.FirstIntegral(lambda t, y, mu: y[2:] @ y[2:] / 2 - mu / jnp.sqrt(y[:2] @ y[:2])),
    "momentum": dfc.FirstIntegral(lambda t, y, mu: y[0] * y[3] - y[1] * y[2]),
}


def on_ellipse(mu, a, e, angle, anomaly):
    """The state at a mean anomaly. Kepler's equation, in long double."""
    mu, a, e, angle, m = (np.asarray(x, np.longdouble) for x in (mu, a, e, angle, anomaly))
    big = m + e * np.sin(m)
    for _ in range(15):
        big = big - (big - e * np.sin(big) - m) / (1 - e * np.cos(big))
    n, b, r = np.sqrt(mu / a**3), np.sqrt(1 - e * e), 1 - e * np.cos(big)
    q = a[..., None] * np.stack([np.cos(big) - e, b * np.sin(big)], -1)
    v = (a * n / r)[..., None] * np.stack([-np.sin(big), b * np.cos(big)], -1)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.moveaxis(np.stack([np.stack([c, -s]), np.stack([s, c])]), (0, 1), (-2, -1))
    return np.concatenate([(turn @ x[..., None])[..., 0] for x in (q, v)], -1)


class Orbits:
    """Lanes of orbits; `exact(ts)` has the states at times of shape (lanes, times)."""

    def __init__(self, mu, a, e, seed=0):
        rng = np.random.default_rng(seed)
        self.mu, self.a, self.e = (np.asarray(x, float) for x in np.broadcast_arrays(mu, a, e))
        self.angle, self.anomaly = rng.uniform(0, 2 * np.pi, (2, len(self.a)))
        self.rate = np.sqrt(self.mu / self.a**3)
        self.period = 2 * np.pi / self.rate
        self.scale = np.stack([self.a] * 2 + [self.a * self.rate] * 2, -1)
        self.y0 = self.exact(np.zeros((len(self.a), 1)))[:, 0].astype(float)

    def exact(self, ts):
        rate = np.sqrt(self.mu.astype(np.longdouble) / self.a.astype(np.longdouble) ** 3)
        m = self.anomaly[:, None] + rate[:, None] * ts
        lanes = (x[:, None] + 0 * ts for x in (self.mu, self.a, self.e, self.angle))
        return on_ellipse(*lanes, m)

    def error(self, ts, ys):
        """Of position and velocity, relative to the size of each."""
        off = (np.asarray(ys) - self.exact(np.asarray(ts))) / self.scale[:, None]
        return np.max(np.abs(off), axis=-1).astype(float)


# ---- 1. Powers of two ----


def five_systems():
    for name in ("kepler", "rigid-body", "double-pendulum", "lotka-volterra", "cartesian-pendulum"):
        system = dfc.systems.get(name)
        flat, unravel = ravel_pytree(system.y0)
        entries = system.manifold
        yield name, system, flat, unravel, entries


def with_units(fn, unravel, factor):
    """`fn` of states in units of `args[0]` and times in units of `args[1]`, times `factor(args)`."""

    def wrapped(t, y, args):
        out = fn(t / args[1], unravel(y / args[0]), None)
        return factor(args) * (ravel_pytree(out)[0] if isinstance(out, tuple | list) else out)

    return wrapped


def covariant_solve(system, unravel, entries, solver, projection, controlled, derivative=False):
    """A function of the start and the units; all that it returns is in natural units."""
    field = with_units(system.vector_field, unravel, lambda args: args[0] / args[1])
    manifold = {
        name: type(entry)(with_units(entry.fn, unravel, lambda args, i=i: args[2][i]))
        for i, (name, entry) in enumerate(entries.items())
    }
    solver = dfc.ManifoldProjection(solver, manifold, projection=projection)
    dt = system.dt / (20 if system.name == "double-pendulum" else 2)

    def run(flat, units, clock, sizes):
        ts = jnp.linspace(0, 20 * dt, 5 if derivative else 101) * clock
        rtol, atol = (1e-6, 1e-6 * units) if controlled else (None, None)
        sol = solve(
            field, solver, ts[-1], dt * clock, flat * units, (units, clock, sizes), rtol=rtol,
            atol=atol, saveat=dfx.SaveAt(ts=ts, solver_state=not derivative), max_steps=256,
        )  # fmt: skip
        ys = sol.ys / units
        if derivative:
            return jnp.sum(jnp.cos(jnp.arange(ys.size).reshape(ys.shape)) * ys)
        counts = dfc.statistics(sol)
        kept = counts.num_projections, counts.num_iterations, counts.residual_before
        # In the metric, since the versions that have the error estimate there.
        kept += (counts.correction,) if hasattr(counts, "error") else ()
        return ys, (*kept, counts.residual_after, counts.roundoff), dfx.is_okay(sol.result)

    return jax.jit(jax.grad(run) if derivative else run)


def change(a, b):
    """Relative to the largest number; NaN in both is no change."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    size = np.nanmax(np.abs(b)) if np.any(np.isfinite(b)) else 1.0
    same = np.isnan(a) & np.isnan(b)
    off = np.abs(a - b) / (size or 1.0)
    return largest(np.where(same, 0, off))


def random_units(rng, num, m, draw):
    """Of the components, of time in every other draw, and of the integrals."""
    units, sizes = (2.0 ** rng.integers(-40, 41, k) for k in (num, m))
    return jnp.asarray(units), 2.0 ** rng.integers(-40, 41) if draw % 2 else 1.0, jnp.asarray(sizes)


def powers_of_two():
    rng, worst = np.random.default_rng(1), {"solution": 0.0, "statistics": 0.0, "gradient": 0.0}
    programs = {
        "RK4": (dfc.RK4(), dfc.SimplifiedNewton(), False),
        "Tsit5": (dfx.Tsit5(), dfc.SimplifiedNewton(), True),
        "Tsit5, Newton": (dfx.Tsit5(), dfc.Newton(), True),
        "gradient of RK4": (dfc.RK4(), dfc.SimplifiedNewton(), False, True),
    }
    systems = list(five_systems())
    for name, system, flat, unravel, entries in few(systems, systems[1:2]):
        for kind, options in few(programs, {"RK4": programs["RK4"]}).items():
            run = covariant_solve(system, unravel, entries, *options)
            ones = jnp.ones(flat.size), 1.0, jnp.ones(len(entries))
            base, found = run(flat, *ones), {}
            for draw in range(few(6, 2)):
                got = run(flat, *random_units(rng, flat.size, len(entries), draw))
                if kind.startswith("gradient"):
                    # The derivative is by the start in natural units.
                    off = {"gradient": change(got, base)}
                else:
                    stats = max(change(x, y) for x, y in zip(got[1], base[1], strict=True))
                    off = {"solution": change(got[0], base[0]), "statistics": stats}
                found = {k: max(v, found.get(k, 0.0)) for k, v in off.items()}
            finite = all(np.all(np.isfinite(x)) for x in jax.tree.leaves(base))
            note = "" if finite else ", not finite in natural units"
            print(
                f"  {name}, {kind}{note}:", *(f"{k} {v:.1e}" for k, v in found.items()), flush=True
            )
            worst |= {k: max(worst[k], v) for k, v in found.items()}
    for what, value in worst.items():
        yield f"five systems, powers of two: change of the {what}", value, 1e-12


def powers_of_two_events():
    rng, worst = np.random.default_rng(2), 0.0
    orbit = Orbits(np.ones(1), np.ones(1), np.full(1, 0.3))
    fns = [lambda t, y, args, f=entry.fn: f(t, y, 1.0) for entry in KEPLER.values()]
    manifold = {
        name: dfc.FirstIntegral(with_units(fn, lambda y: y, lambda args, i=i: args[2][i]))
        for i, (name, fn) in enumerate(zip(KEPLER, fns, strict=True))
    }
    field = with_units(
        lambda t, y, _: kepler(t, y, 1.0), lambda y: y, lambda args: args[0] / args[1]
    )

    @compiled
    def run(root, *args):
        units, clock, _ = args
        event = dfx.Event(
            lambda t, y, args, **kw: args[1] * y[1] / args[0][1], root(1e-10, 1e-10 * clock)
        )
        sol = solve(
            field, dfc.ManifoldProjection(dfx.Tsit5(), manifold), 9 * clock, 0.1 * clock,
            jnp.asarray(orbit.y0[0]) * units, args, rtol=1e-7, atol=1e-7 * units, event=event,
            max_steps=500,
        )  # fmt: skip
        return sol.ts[0] / clock, sol.ys[0] / units

    for root in (optx.Newton, optx.Bisection):
        base = run(root, jnp.ones(4), 1.0, jnp.ones(2))
        for draw in range(few(8, 1)):
            got = run(root, *random_units(rng, 4, 2, draw))
            off = max(change(x, y) for x, y in zip(got, base, strict=True))
            print(f"  event, {root.__name__}: {off:.1e}", flush=True)
            worst = max(worst, off)
    yield "powers of two: change of time and state of an event", worst, 1e-12


# ---- 2. Planets and satellites in metres ----

SUN, EARTH = 1.32712440018e20, 3.986004418e14
BODIES = {
    "Mercury": (SUN, 5.791e10), "Earth": (SUN, 1.496e11), "Jupiter": (SUN, 7.785e11),
    "low orbit": (EARTH, 7.078e6), "GPS": (EARTH, 2.6560e7), "geostationary": (EARTH, 4.2164e7),
    "Moon": (EARTH, 3.844e8),
}  # fmt: skip
ECCENTRICITIES = (0.0, 1e-5, 2e-4, 1e-3, 1e-2, 0.0167, 0.05, 0.1, 0.2)


@compiled
def saved(solver, ts, dt0, y0, mu, rtol, atol, max_steps):
    def lane(ts, dt0, y0, mu, atol):
        sol = solve(
            kepler,
            solver,
            ts[-1],
            dt0,
            y0,
            mu,
            rtol=rtol,
            atol=atol,
            saveat=dfx.SaveAt(ts=ts),
            max_steps=max_steps,
        )
        return sol.ys, dfx.is_okay(sol.result), sol.stats["num_accepted_steps"]

    return jax.vmap(lane)(ts, dt0, y0, mu, atol)


def planets_in_metres():
    lanes = [(mu, a, e) for mu, a in BODIES.values() for e in ECCENTRICITIES]
    lanes = np.array(few(lanes, lanes[::9]))
    orbits = Orbits(*lanes.T)
    turns = few(50, 12)
    ts = orbits.period[:, None] * np.linspace(0, turns, few(1001, 101))
    late = np.linspace(0, turns, ts.shape[1]) >= 10
    worst, medians = 0.0, []
    for method, solver in METHODS.items():
        for rtol in few((1e-6, 1e-9), (1e-6,)):
            for form in ("atol = rtol", "atol by component"):
                atol = (
                    np.ones((len(lanes), 4)) * rtol * (1 if form == "atol = rtol" else orbits.scale)
                )
                errors = []
                for s in (solver, dfc.ManifoldProjection(solver, KEPLER)):
                    ys, okay, _ = saved(
                        s, ts, orbits.period / 100, orbits.y0, orbits.mu, rtol, atol, 200_000
                    )
                    errors.append(np.maximum.accumulate(orbits.error(ts, ys), axis=1))
                ratios = np.where(np.isnan(errors[1]), np.inf, errors[1] / errors[0])
                ratio, end = np.max(ratios[:, late], axis=1), ratios[:, -1]
                i = int(np.argmax(ratio))
                print(f"  {method} {rtol:.0e}, {form}: error over plain after ten orbits, largest {ratio[i]:.2g} "
                      f"(e = {lanes[i, 2]:g}, a = {lanes[i, 1]:.3g}; plain {errors[0][i, -1]:.1e}, "
                      f"projected {errors[1][i, -1]:.1e}), above 1: {np.sum(ratio > 1)} of {len(lanes)}, "
                      f"median at the end {np.median(end):.2g}, failed {np.sum(~okay)}", flush=True)  # fmt: skip
                worst = max(worst, largest(ratio))
                medians.append(np.median(end))
    yield "planets in metres: largest error over plain, after ten orbits", worst, 1.0
    yield (
        "planets in metres: the median of error over plain (largest of all methods)",
        max(medians),
        0.1,
    )


# ---- 3. States of another time ----

UNITS = {
    "m": (EARTH, 7.0e6, 4.2e7), "km": (EARTH / 1e9, 7.0e3, 4.2e4),
    "AU, days": (2.959122082855911e-4, 0.4, 30.0), "atomic units": (1.0, 1.0, 9.0),
    "hydrogen in SI": (253.2638, 5.29e-11, 4.8e-10),
}  # fmt: skip


@compiled
def saved_beside_steps(solver, ts, dt0, y0, mu, rtol, atol, num):
    def lane(ts, dt0, y0, mu):
        subs = dfx.SubSaveAt(ts=ts), dfx.SubSaveAt(t0=True, steps=True)
        sol = solve(
            kepler,
            solver,
            ts[-1],
            dt0,
            y0,
            mu,
            rtol=rtol,
            atol=atol,
            saveat=dfx.SaveAt(subs=subs),
            max_steps=num,
        )
        drifts = jax.tree.leaves(
            jax.tree.map(
                lambda k: relative_drift(k.fn, sol.ys[0], y0, mu), KEPLER, is_leaf=is_entry
            )
        )
        return sol.ts, sol.ys, dfx.is_okay(sol.result), functools.reduce(jnp.maximum, drifts)

    return jax.vmap(lane)(ts, dt0, y0, mu)


def is_entry(x):
    return isinstance(x, dfc.FirstIntegral | dfc.Constraint)


def relative_drift(fn, ys, y0, args):
    """Relative to the terms of the gradient, as `dfc.drift`, which is not used here."""
    value, gradient = jax.value_and_grad(lambda y: fn(0.0, y, args))(y0)
    scale = jnp.abs(value) + jnp.sum(jnp.abs(gradient * y0))
    return jnp.abs(jax.vmap(lambda y: fn(0.0, y, args))(ys) - value) / scale


def neighbours(ts, steps, errors):
    """The larger error at the two steps around each saved time."""
    steps = np.where(np.isfinite(steps), steps, np.inf)
    right = np.clip(np.searchsorted(steps, ts), 1, np.sum(np.isfinite(steps)) - 1)
    return np.maximum(errors[right - 1], errors[right])


def states_of_another_time():
    num = few(40, 8)  # in each of the units
    shares, plains = [], []
    rtol = 1e-6
    for name, (mu, low, high) in UNITS.items():
        rng = np.random.default_rng(3)
        e = np.where(
            np.arange(num) % 4 == 0, 10 ** rng.uniform(-6, -2, num), rng.uniform(0, 0.3, num)
        )
        e[:2] = 0
        orbits = Orbits(
            np.full(num, mu), np.exp(rng.uniform(np.log(low), np.log(high), num)), e, seed=4
        )
        ts = orbits.period[:, None] * np.linspace(0, few(10, 3), few(401, 61))
        found = {}
        for kind, solver in {
            "plain": dfx.Dopri8(),
            "projected": dfc.ManifoldProjection(dfx.Dopri8(), KEPLER),
        }.items():
            (t, st), (y, sy), okay, drift = saved_beside_steps(
                solver, ts, orbits.period / 100, orbits.y0, orbits.mu, rtol, rtol, 400
            )
            at_saved, at_steps = (
                orbits.error(ts, y),
                orbits.error(np.where(np.isfinite(st), st, 0), sy),
            )
            near = np.stack(
                [neighbours(*x) for x in zip(ts, np.asarray(st), at_steps, strict=True)]
            )
            found[kind] = at_saved, near, np.asarray(okay), np.asarray(drift)
        (plain, plain_near, *_), (mine, near, okay, drift) = found["plain"], found["projected"]
        # What the interpolant itself errs is not a state of another time.
        interpolation = np.max(np.maximum(plain - plain_near, 0), axis=1)[:, None]
        raw = np.mean(mine[okay] > 3 * near[okay] + 1e-12)
        beyond = np.mean((mine > 3 * near + 3 * interpolation + 1e-12)[okay])
        print(f"  {name}: off {raw:.2%} (plain {np.mean(plain > 3 * plain_near + 1e-12):.2%}), beyond the "
              f"interpolation error {beyond:.2%}, largest error {largest(mine[okay]):.1e} (plain {largest(plain):.1e}), "
              f"failed {np.sum(~okay)} of {num}, states off the manifold {np.sum(drift[okay] > OFF)}", flush=True)  # fmt: skip
        shares.append(beyond + np.mean(~okay))
        plains.append(raw)
    yield (
        "saved states off by 3 times the error at the steps and the interpolant's: share",
        max(shares),
        0.0,
    )
    yield "the same without allowance for the interpolant: share", max(plains), 0.0


# ---- 4. Events ----


@compiled
def passages(solver, root, y0, mu, t1, dt0, tolerance):
    # An angle: in metres no root finder meets an absolute tolerance of 1e-10.
    event = dfx.Event(lambda t, y, args, **kw: y[1] / jnp.sqrt(y[:2] @ y[:2]), root, direction=True)

    def lane(y0):
        sol = solve(kepler, solver, t1, dt0, y0, mu, rtol=1e-9, atol=tolerance, event=event)
        return sol.ts[0], sol.ys[0], sol.result == dfx.RESULTS.event_occurred

    return jax.vmap(lane)(y0)


def events():
    num = few(200, 8)
    for length, unit in {"km": 1e3, "m": 1.0}.items():
        for e in (2e-4, 0.0, 0.1):
            mu, a = EARTH / unit**3, 4.2164e7 / unit
            n = np.sqrt(mu / a**3)
            m0 = np.linspace(0.3, 6.0, num)
            y0 = on_ellipse(*np.broadcast_arrays(mu, a, e, 0.0, m0)).astype(float)
            exact = (2 * np.pi - m0) / n
            for name, root in {
                "Newton": optx.Newton(1e-10, 1e-10),
                "Bisection": optx.Bisection(1e-10, 1e-10),
            }.items():
                off, found, place = {}, {}, {}
                for kind, solver in {
                    "plain": dfx.Dopri8(),
                    "projected": dfc.ManifoldProjection(dfx.Dopri8(), KEPLER),
                }.items():
                    t, y, ok = map(
                        np.asarray, passages(solver, root, y0, mu, 1.2 * 2 * np.pi / n, 100.0, 1e-9)
                    )
                    ok = ok & np.all(np.isfinite(y), axis=1) & (np.abs(t - exact) < 60)
                    off[kind], found[kind] = np.where(ok, np.abs(t - exact), np.nan), ok
                    place[kind] = np.abs(y[:, 1]) / a
                missed = np.sum(found["plain"] & ~found["projected"])
                both = found["plain"] & found["projected"]
                pairs = [np.max(off[k][both], initial=0) for k in off]
                print(f"  {length}, e = {e:g}, {name}: plain {found['plain'].sum()}, projected {found['projected'].sum()} "
                      f"of {num}; time off by at most {pairs[0]:.1e} s, {pairs[1]:.1e} s; medians "
                      f"{np.nanmedian(off['plain']):.1e}, {np.nanmedian(off['projected']) if both.any() else np.nan:.1e} s", flush=True)  # fmt: skip
                yield f"events, {length}, e = {e:g}, {name}: missed of what plain finds", missed, 0
                yield (
                    f"events, {length}, e = {e:g}, {name}: largest error in time over plain",
                    pairs[1] / pairs[0] if both.any() else np.inf,
                    1.0,
                )


# ---- 5. The energy alone ----


def fixed_steps(field, solver, y0, dt, steps, args=None):
    saveat = dfx.SaveAt(steps=True)
    sol = solve(field, solver, steps * dt, dt, y0, args, saveat=saveat, max_steps=steps + 1)
    return jax.tree.map(lambda y: y[:steps], sol.ys), sol.ts[:steps], dfx.is_okay(sol.result)


def truth(field, y0, ts, args=None):
    """Plain Dopri8."""
    return solve(
        field,
        dfx.Dopri8(),
        ts[-1],
        None,
        y0,
        args,
        rtol=1e-13,
        atol=1e-13,
        saveat=dfx.SaveAt(ts=ts),
        max_steps=400_000,
    ).ys


def tree_error(ys, exact):
    """The largest component, relative to that of its leaf, at each time."""
    parts = [
        np.max(np.abs(np.asarray(a) - b).reshape(len(b), -1), axis=1) / np.max(np.abs(b))
        for a, b in zip(jax.tree.leaves(ys), map(np.asarray, jax.tree.leaves(exact)), strict=True)
    ]
    return np.max(parts, axis=0)


def energy_alone():
    """The outer solar system from its place, and rigid bodies from many."""
    lanes = few(50, 3)
    for name, dt, steps, target in (
        ("outer-solar-system", 100.0, few(2000, 50), 0.3),
        ("outer-solar-system", 25.0, few(8000, 50), 0.3),
        ("rigid-body", 0.05, few(200, 50), 0.5),
    ):
        system = dfc.systems.get(name)
        energy = {"energy": system.manifold["energy"]}
        solvers = (
            dfc.RK4(),
            dfc.ManifoldProjection(dfc.RK4(), energy),
            dfc.ManifoldProjection(dfc.RK4(), energy, projection=euclidean()),
        )
        y0 = jax.tree.map(lambda x: x[None], system.y0)
        if name == "rigid-body":
            y0 = (
                jax.vmap(system.sample)(jr.split(jr.key(9), lanes))
                .at[:2]
                .set(jnp.array([[1.0, 1.0, 1.0], [0.1, 0.2, 0.3]]))
            )

        @jax.jit
        @jax.vmap
        def run(y0, dt, solvers=solvers, system=system, steps=steps):
            found = [fixed_steps(system.vector_field, s, y0, dt, steps) for s in solvers]
            return found, truth(system.vector_field, y0, dt * jnp.arange(1, steps + 1))

        found, exact = run(y0, jnp.full(len(jax.tree.leaves(y0)[0]), dt))
        errors = np.stack([lane_errors(ys, exact, okay) for ys, _, okay in found])
        ratios = errors[1] / errors[0], errors[2] / errors[0]
        print(
            f"  {name}, {steps} steps of {dt:g}: plain {np.median(errors[0]):.1e}, over plain: "
            f"median {np.median(ratios[0]):.2g}, largest {np.max(ratios[0]):.2g}, first "
            f"{ratios[0][:2]}; Euclidean {np.median(ratios[1]):.2g}, {np.max(ratios[1]):.2g}",
            flush=True,
        )
        what = f"{name}, {steps} steps of {dt:g}, energy alone: median of error over plain"
        yield what, np.median(ratios[0]), target


def lane_errors(ys, exact, okay):
    """The largest error of each lane, infinite where it failed."""
    lane = lambda tree, i: jax.tree.map(lambda x: x[i], tree)  # noqa: E731
    found = [largest(tree_error(lane(ys, i), lane(exact, i))) for i in range(len(okay))]
    return np.where(okay, found, np.inf)


# ---- 6. Natural units: the catalogue ----


def catalogue():
    lanes = few(12, 2)
    for name in few(dfc.systems.names(), ("rigid-body",)):
        system = dfc.systems.get(name)
        y0 = jax.vmap(system.sample)(jr.split(jr.key(5), lanes))
        dt = system.dt / (10 if name == "double-pendulum" else 1)
        steps = 20 if name in ("double-pendulum", "korteweg-de-vries") else 60
        solvers = [dfc.RK4(), dfc.ManifoldProjection(dfc.RK4(), system.manifold),
                   dfc.ManifoldProjection(dfc.RK4(), system.manifold, projection=euclidean())]  # fmt: skip

        @jax.jit
        @jax.vmap
        def run(y0, system=system, dt=dt, steps=steps, solvers=tuple(solvers)):
            found = [fixed_steps(system.vector_field, s, y0, dt, steps) for s in solvers]
            return found, truth(system.vector_field, y0, dt * jnp.arange(1, steps + 1))

        found, exact = run(y0)
        errors = np.stack([lane_errors(ys, exact, ok) for ys, _, ok in found])
        okay = np.stack([ok for *_, ok in found])
        both = np.all(okay, axis=0)
        mean = lambda x: np.exp(np.mean(np.log(x)))  # noqa: E731
        ratio = mean(errors[1, both]) / mean(errors[2, both]) if both.any() else np.nan
        each = largest((errors[1] / errors[2])[both]) if both.any() else np.nan
        print(f"  {name}: plain {mean(errors[0]):.1e}, default {mean(errors[1, both]):.1e}, Euclidean "
              f"{mean(errors[2, both]):.1e}; failed {np.sum(~okay[1])}, Euclidean {np.sum(~okay[2])}; largest of a lane {each:.2g}", flush=True)  # fmt: skip
        yield f"{name}, natural units: error over Euclidean", ratio, 2.0


# ---- 7. Very long steps ----


def vortices(t, y, args):
    z = y[:3] + 1j * y[3:]
    apart = z[:, None] - z[None, :] + jnp.eye(3)
    rate = jnp.sum((1 - jnp.eye(3)) / apart, axis=1) / (2j * jnp.pi)
    return jnp.concatenate([rate.real, -rate.imag])


def vortex_energy(t, y, args):
    x, z = y[:3], y[3:]
    pairs = jnp.stack(
        [(x[i] - x[j]) ** 2 + (z[i] - z[j]) ** 2 for i, j in ((0, 1), (0, 2), (1, 2))]
    )
    return -jnp.sum(jnp.log(pairs)) / (4 * jnp.pi)


def long_steps_cases(num):
    rng = np.random.default_rng(6)
    orbits = Orbits(np.ones(num), np.ones(num), rng.uniform(0.3, 0.9, num), seed=6)
    yield (
        "eccentric orbits",
        kepler,
        KEPLER,
        orbits.y0,
        orbits.mu,
        2 * np.pi / rng.uniform(10, 60, num),
    )
    r, angle = np.sqrt(rng.uniform(0.25, 2.25, (num, 3))), rng.uniform(0, 2 * np.pi, (num, 3))
    manifold = {
        "energy": dfc.FirstIntegral(vortex_energy),
        "impulse": dfc.FirstIntegral(
            lambda t, y, args: jnp.stack([jnp.sum(y[:3]), jnp.sum(y[3:])])
        ),
        "angular": dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**2)),
    }
    y0 = np.concatenate([r * np.cos(angle), r * np.sin(angle)], axis=1)
    yield "three vortices", vortices, manifold, y0, np.ones(num), rng.uniform(0.3, 3, num)
    energy = {"energy": dfc.FirstIntegral(lambda t, y, args: y[1] ** 2 / 2 - jnp.cos(y[0]))}
    field = lambda t, y, args: jnp.stack([y[1], -jnp.sin(y[0])])  # noqa: E731
    top = np.stack([np.pi - 10 ** rng.uniform(-6, -1, num), rng.choice([0, 1e-3, -1e-2], num)], 1)
    yield "pendulums near the top", field, energy, top, np.ones(num), rng.uniform(0.3, 1.5, num)


def long_steps():
    steps, per = 20, 7
    for name, field, manifold, y0, args, dt in long_steps_cases(few(300, 10)):

        def lane(solver, y0, args, dt, field=field):
            ts = dt * jnp.linspace(0, steps, steps * per + 1)
            subs = dfx.SubSaveAt(ts=ts), dfx.SubSaveAt(t0=True, steps=True)
            sol = solve(
                field,
                solver,
                ts[-1],
                dt,
                y0,
                args,
                saveat=dfx.SaveAt(subs=subs),
                max_steps=steps + 2,
            )
            return sol.ys[0], dfx.is_okay(sol.result)

        @jax.jit
        @jax.vmap
        def run(y0, args, dt, field=field, manifold=manifold, lane=lane):
            mine, okay = lane(dfc.ManifoldProjection(dfc.RK4(), manifold), y0, args, dt)
            plain, _ = lane(dfc.RK4(), y0, args, dt)
            exact = truth(field, y0, dt * jnp.linspace(0, steps, steps * per + 1), args)
            drifts = [
                relative_drift(lambda *a, i=i, k=k: jnp.atleast_1d(k.fn(*a))[i], mine, y0, args)
                for k in manifold.values() for i in range(jnp.size(k.fn(0.0, y0, args)))
            ]  # fmt: skip
            return mine, plain, exact, okay, functools.reduce(jnp.maximum, drifts)

        mine, plain, exact, okay, drift = map(np.asarray, run(y0, args, dt))
        error, plain_error = (np.max(np.abs(y - exact), axis=-1) for y in (mine, plain))
        nan = okay & np.any(np.isnan(mine), axis=(1, 2))
        off = okay & np.any(drift > 1e-11, axis=1)
        at_steps = error[:, ::per]
        near = np.repeat(np.maximum(at_steps[:, :-1], at_steps[:, 1:]), per, axis=1)
        moved = np.repeat(np.max(np.abs(np.diff(mine[:, ::per], axis=1)), axis=-1), per, axis=1)
        further = okay[:, None] & (error[:, :-1] > plain_error[:, :-1] + 3 * near + 1e-9)
        far = okay[:, None] & (error[:, :-1] > plain_error[:, :-1] + near + moved)
        print(f"  {name}: {okay.sum()} of {len(okay)} succeed, off the manifold in {off.sum()} (by up to "
              f"{np.max(drift[okay], initial=0):.1e}; {np.sum(drift[okay] > 1e-11)} states), NaN {nan.sum()}, "
              f"states further than plain + 3 × steps' error {further.sum()} in {np.any(further, axis=1).sum()} lanes, "
              f"further by more than the step is long {far.sum()}", flush=True)  # fmt: skip
        yield (
            f"long steps, {name}: share of successes with a state off the manifold",
            off.sum() / max(okay.sum(), 1),
            0.01,
        )
        yield f"long steps, {name}: successes with NaN", nan.sum(), 0
        yield (
            f"long steps, {name}: saved states further from the truth than plain and the step",
            further.sum(),
            0,
        )


# ---- 8. Systems in SI ----

PROTON, CHARGE = 1.67262192e-27, 1.602176634e-19


def j2(t, y, args):
    mu, factor, q = EARTH, 1.5 * 1.08263e-3 * 6.378e6**2, y[:3]
    r2 = q @ q
    z2 = q[2] ** 2 / r2
    pull = 1 + factor / r2 * (jnp.array([1.0, 1, 3]) - 5 * z2)
    return jnp.concatenate([y[3:], -mu * q / r2**1.5 * pull])


def j2_energy(t, y, args):
    r = jnp.sqrt(y[:3] @ y[:3])
    term = 1.08263e-3 * (6.378e6 / r) ** 2 * (3 * (y[2] / r) ** 2 - 1) / 2
    return y[3:] @ y[3:] / 2 - EARTH / r * (1 - term)


def morse_energy(t, y, args):
    depth, width, mass = 7.61e-19, 1.94e10, 8.369e-28
    return mass * y[1] ** 2 / 2 + depth * (1 - jnp.exp(-width * (y[0] - 7.41e-11))) ** 2


def morse(t, y, args):
    depth, width, mass = 7.61e-19, 1.94e10, 8.369e-28
    s = jnp.exp(-width * (y[0] - 7.41e-11))
    return jnp.stack([y[1], -2 * depth * width / mass * (1 - s) * s])


WATER = np.array([2.6567e-26, 1.6735e-27, 1.6735e-27])


def water_potential(q):
    q = q.reshape(3, 2)
    apart = jnp.stack([q[1] - q[0], q[2] - q[0], q[1] - q[2]])
    lengths = jnp.sqrt(jnp.sum(apart**2, axis=1))
    return (
        jnp.sum(
            jnp.array([845.0, 845, 230])
            * (lengths - jnp.array([9.57e-11, 9.57e-11, 1.514e-10])) ** 2
        )
        / 2
    )


def water(t, y, args):
    return jnp.concatenate([y[6:], -jax.grad(water_potential)(y[:6]) / np.repeat(WATER, 2)])


def water_momenta(t, y, args):
    q, p = y[:6].reshape(3, 2), y[6:].reshape(3, 2) * WATER[:, None]
    return jnp.append(jnp.sum(p, 0), jnp.sum(q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0]))


TRAP = 100.0 / 1e-2**2  # volts over metres squared


def trap(t, y, args):
    q, v = y[:3], y[3:]
    electric = TRAP * q * jnp.array([0.5, 0.5, -1.0])
    magnetic = jnp.stack([v[1], -v[0], 0 * v[0]])
    return jnp.concatenate([v, CHARGE / PROTON * (electric + magnetic)])


TRAPPED = {
    "energy": dfc.FirstIntegral(lambda t, y, args: PROTON * y[3:] @ y[3:] / 2 + CHARGE * TRAP / 2 * (y[2] ** 2 - (y[0] ** 2 + y[1] ** 2) / 2)),
    "momentum": dfc.FirstIntegral(lambda t, y, args: PROTON * (y[0] * y[4] - y[1] * y[3]) + CHARGE / 2 * (y[0] ** 2 + y[1] ** 2)),
}  # fmt: skip


def in_si():
    """Name, field, manifold, start, the size of each component, a period."""
    orbit = on_ellipse(*(np.array([x]) for x in (EARTH, 7.0e6, 1e-3, 0.3, 1.0)))[0].astype(float)
    tilt = np.array([[1, 0], [0, np.cos(0.9)], [0, np.sin(0.9)]])
    y0 = np.concatenate([tilt @ orbit[:2], tilt @ orbit[2:]])
    spin = lambda t, y, args: y[0] * y[4] - y[1] * y[3]  # noqa: E731
    yield (
        "satellite with J2",
        j2,
        {"energy": dfc.FirstIntegral(j2_energy), "spin": dfc.FirstIntegral(spin)},
        y0,
        np.repeat([7e6, 7.5e3], 3),
        5830.0,
    )
    yield (
        "H2",
        morse,
        {"energy": dfc.FirstIntegral(morse_energy)},
        np.array([9.0e-11, 0.0]),
        np.array([1e-11, 1e4]),
        7.6e-15,
    )
    angle = 0.9121
    h = (
        9.57e-11
        * np.array([[np.sin(angle), np.cos(angle)], [-np.sin(angle), np.cos(angle)]])
        * [[1.05], [0.98]]
    )
    q = np.concatenate([np.zeros((1, 2)), h])
    v = np.array([[0.0, 0], [900, 400], [-300, 1100]])
    v[0] = -WATER[1] * v[1:].sum(0) / WATER[0]
    manifold = {"energy": dfc.FirstIntegral(lambda t, y, args: jnp.repeat(WATER, 2) @ y[6:] ** 2 / 2 + water_potential(y[:6])),
                "momenta": dfc.FirstIntegral(water_momenta)}  # fmt: skip
    yield (
        "water",
        water,
        manifold,
        np.concatenate([q.ravel(), v.ravel()]),
        np.repeat([1e-11, 1e3], 6),
        9e-15,
    )
    yield (
        "proton in a trap",
        trap,
        TRAPPED,
        np.array([1e-3, 0, 5e-4, 0, 4e4, 2e4]),
        np.repeat([1e-3, 4e4], 3),
        6.6e-8,
    )
    circuit = lambda t, y, args: jnp.stack([y[1], -y[0] / (1e-6 * 1e-12)])  # noqa: E731
    energy = {
        "energy": dfc.FirstIntegral(lambda t, y, args: y[0] ** 2 / 2e-12 + 1e-6 * y[1] ** 2 / 2)
    }
    yield "LC circuit", circuit, energy, np.array([1e-12, 0.0]), np.array([1e-12, 1e-3]), 6.3e-9
    # Two capacitors of 1 µF and 1 pF through 1 kΩ: the charge is shared, the energy is lost at a known rate.
    current = lambda y: (y[0] / 1e-6 - y[1] / 1e-12) / 1e3  # noqa: E731
    discharge = lambda t, y, args: current(y) * jnp.array([-1.0, 1.0])  # noqa: E731
    charge = {"charge": dfc.FirstIntegral(lambda t, y, args: y[0] + y[1])}
    yield "RC circuit", discharge, charge, np.array([1e-6, 0.0]), np.array([1e-6, 1e-12]), 1e-9
    loss = dfc.FirstIntegral(
        lambda t, y, args: y[0] ** 2 / 2e-6 + y[1] ** 2 / 2e-12,
        rate=lambda t, y, args: -1e3 * current(y) ** 2,
    )
    yield (
        "RC circuit, with its balance",
        discharge,
        charge | {"energy": loss},
        np.array([1e-6, 0.0]),
        np.array([1e-6, 1e-12]),
        1e-9,
    )


def systems_in_si():
    """With Tsit5 and RK4, and both projections."""
    turns, ratios, failed, drifts = few(10, 2), {}, 0, 0.0
    programs = {
        "RK4": (dfc.RK4(), None, (dfc.SimplifiedNewton(),)),
        "Tsit5": (dfx.Tsit5(), 1e-6, (dfc.SimplifiedNewton(), dfc.Newton())),
    }
    cases = list(in_si())
    for name, field, manifold, y0, size, period in few(cases, cases[1:2]):
        ts, dense = period * jnp.linspace(0, turns, 40 * turns + 1), "balance" in name

        @compiled
        def run(solver, rtol, atol, y0, field=field, dense=dense, manifold=manifold, ts=ts):
            sol = solve(
                field, solver, ts[-1], ts[1] / 2, y0, rtol=rtol, atol=atol,
                saveat=dfx.SaveAt(ts=ts, dense=dense), max_steps=10_000,
            )  # fmt: skip
            drift = jax.tree.map(lambda x: jnp.max(jnp.abs(x)), dfc.drift(sol, manifold))
            drift = functools.reduce(jnp.maximum, jax.tree.leaves(drift))
            return sol.ys, dfx.is_okay(sol.result), drift

        exact, _, _ = run(dfx.Dopri8(), 1e-13, 1e-15 * size, jnp.asarray(y0))
        for method, (solver, rtol, projections) in programs.items():
            atol = None if rtol is None else rtol * size
            plain = largest(np.abs(run(solver, rtol, atol, jnp.asarray(y0))[0] - exact) / size)
            for projection in projections:
                s = dfc.ManifoldProjection(solver, manifold, projection=projection)
                ys, okay, drift = run(s, rtol, atol, jnp.asarray(y0))
                error = largest(np.abs(ys - exact) / size) if okay else np.inf
                key = f"{name}, {method}, {type(projection).__name__}"
                print(
                    f"  {key}: error {error:.1e} (plain {plain:.1e}), drift {drift:.1e}", flush=True
                )
                # Both at roundoff is no loss.
                ratios[key] = 0.0 if error < 1e-11 else error / plain
                failed, drifts = failed + (not okay), max(drifts, float(drift) if okay else 0)
    yield "systems in SI: solves that fail", failed, 0
    yield "systems in SI: drift", drifts, 1e-13
    name = max(ratios, key=ratios.get)
    yield f"systems in SI: largest error over plain ({name})", ratios[name], 1.0
    worse = np.array(list(ratios.values())) > 1
    yield f"systems in SI: how many of {len(ratios)} are worse than plain", np.sum(worse), 0


def single_precision():
    bohr = {
        k: dfc.FirstIntegral(lambda t, y, args, f=v.fn: 9.109e-31 * f(t, y, 253.2638))
        for k, v in KEPLER.items()
    }
    sun = {k: dfc.FirstIntegral(lambda t, y, args, f=v.fn: f(t, y, SUN)) for k, v in KEPLER.items()}
    cases = {
        name: rest
        for name, *rest in in_si()
        if name in ("H2", "LC circuit", "proton in a trap", "satellite with J2")
    }
    for name, mu, a, e, manifold in (("hydrogen in SI", 253.2638, 5.29e-11, 0.1, bohr), ("Earth in SI", SUN, 1.496e11, 0.0167, sun),
                                     ("Earth in SI, circular", SUN, 1.496e11, 0.0, sun)):  # fmt: skip
        orbit = Orbits(*(np.array([x]) for x in (mu, a, e)))
        cases[name] = (
            lambda t, y, args, mu=mu: kepler(t, y, mu),
            manifold,
            orbit.y0[0],
            orbit.scale[0],
            float(orbit.period[0]),
        )
    for name, (field, manifold, y0, size, period) in list(cases.items())[: few(None, 1)]:
        kinds = {"SimplifiedNewton": dfc.SimplifiedNewton(), "Newton": dfc.Newton()}
        kinds = kinds if "SI" in name else {"SimplifiedNewton": kinds["SimplifiedNewton"]}
        y0, one = jnp.asarray(y0, jnp.float32), jnp.ones((), jnp.float32)
        ts = period * jnp.linspace(0, 5, 101)

        @compiled
        def run(solver, ts, y0, rtol=None, atol=None, field=field):
            return solve(
                field, solver, ts[-1], ts[1] / 5, y0, t0=0 * ts[0], rtol=rtol, atol=atol, saveat=dfx.SaveAt(ts=ts)
            )  # fmt: skip

        exact = run(dfx.Dopri8(), ts, y0.astype(float), rtol=1e-13, atol=1e-15 * size).ys
        single = ts.astype(jnp.float32) * one
        plain = largest(np.abs(np.asarray(run(dfc.RK4(), single, y0).ys, float) - exact) / size)
        for kind, projection in kinds.items():
            sol = run(
                dfc.ManifoldProjection(dfc.RK4(), manifold, projection=projection), single, y0
            )
            okay = bool(dfx.is_okay(sol.result))
            error = largest(np.abs(np.asarray(sol.ys, float) - exact) / size) if okay else np.inf
            print(f"  {name}, float32, {kind}: error {error:.1e} (plain {plain:.1e})", flush=True)
            yield (
                f"{name}, float32, {kind}: error over plain, or over 3e-5",
                error / max(plain, 3e-5),
                2.0,
            )


def enzyme_field(t, y, args):
    """S + E -> C -> E + P, in milliseconds."""
    s, e, c, _ = y
    bind, make = s * e, 300 * c
    return jnp.stack([-bind, make - bind, bind - make, make])


ENZYME = {
    "enzyme": dfc.FirstIntegral(lambda t, y, args: y[1] + y[2]),
    "substrate": dfc.FirstIntegral(lambda t, y, args: y[0] + y[2] + y[3]),
}


def bounds():
    """Amounts in mol: 1e-12 of an enzyme beside 1e3 of its substrate, none below zero."""
    y0, size = jnp.array([1e3, 1e-12, 0, 0]), np.array([1e3, 1e-12, 1e-12, 1e3])
    ts = jnp.linspace(0, 0.02, 41)

    @compiled
    def run(solver, dt0, rtol):
        sol = solve(
            enzyme_field,
            solver,
            0.02,
            dt0,
            y0,
            rtol=rtol,
            atol=None if rtol is None else rtol * size,
            saveat=dfx.SaveAt(ts=ts),
        )
        return sol.ys, dfx.is_okay(sol.result)

    exact, _ = run(dfx.Dopri8(), 1e-5, 1e-12)
    for method, dt0, rtol in (
        (dfx.Tsit5(), 1e-4, 1e-6),
        (dfx.Euler(), 1.25e-3, None),
        (dfx.Euler(), 1e-4, None),
    ):
        plain, _ = run(method, dt0, rtol)
        for projection in (dfc.SimplifiedNewton(lower=0), dfc.Newton(lower=0)):
            ys, okay = run(dfc.ManifoldProjection(method, ENZYME, projection=projection), dt0, rtol)
            error, other = (
                largest(np.max(np.abs(y - exact), axis=0)[1:3] / 1e-12) for y in (ys, plain)
            )
            kept = largest(np.abs(ys[:, 1] + ys[:, 2] - 1e-12)) / 1e-12
            name = f"enzyme beside 1e15 times as much, {type(method).__name__} {dt0:g}, {type(projection).__name__}"
            print(
                f"  {name}: error of the enzyme {error:.1e} (plain {other:.1e}), its balance {kept:.1e}, smallest {np.min(ys):.1e}{'' if okay else ', FAILED'}",
                flush=True,
            )
            yield f"{name}: balance of the enzyme", kept if okay else np.inf, 1e-13
            yield f"{name}: error over plain", error / max(other, 1e-11) if okay else np.inf, 1.5
            yield f"{name}: below zero", max(0.0, -float(np.min(ys))), 0


def newton_and_circles():
    """Circular and nearly circular orbits in km, fixed and adaptive steps, for both projections."""
    e = np.array([0.0, 1e-12, 1e-8, 1e-5, 1e-3])
    orbits = Orbits(EARTH / 1e9, np.full(len(e), 7078.0), e)
    ts = orbits.period[:, None] * np.linspace(0, few(20, 2), few(401, 21))
    for method, solver, rtol, dt in (("RK4, 100 steps a turn", dfc.RK4(), None, 100), ("RK4, 30 steps a turn", dfc.RK4(), None, 30),
                                     ("Dopri8 1e-6", dfx.Dopri8(), 1e-6, 100),):  # fmt: skip
        atol = None if rtol is None else rtol * orbits.scale
        plain = np.max(
            orbits.error(
                ts,
                saved(solver, ts, orbits.period / dt, orbits.y0, orbits.mu, rtol, atol, 50_000)[0],
            ),
            axis=1,
        )
        for projection in (dfc.SimplifiedNewton(), dfc.Newton()):
            s = dfc.ManifoldProjection(solver, KEPLER, projection=projection)
            ys, okay, _ = saved(s, ts, orbits.period / dt, orbits.y0, orbits.mu, rtol, atol, 50_000)
            error = np.max(orbits.error(ts, ys), axis=1)
            ratio = np.where(okay, error / plain, np.inf)
            name = f"circular orbits in km, {method}, {type(projection).__name__}"
            print(
                f"  {name}: failed {np.sum(~okay)} of {len(e)}, error over plain {np.round(ratio, 4)}, plain {plain[0]:.1e}",
                flush=True,
            )
            yield f"{name}: failed", np.sum(~okay), 0
            yield f"{name}: error over plain", largest(ratio), 1.0


# ---- 9. What else could go wrong ----


@compiled
def compared(field, solver, ts, dt, y0, args, rtol):
    sol = solve(field, solver, ts[-1], dt, y0, args, rtol=rtol, atol=rtol, saveat=dfx.SaveAt(ts=ts))
    return sol.ys, dfx.is_okay(sol.result)


def compare(name, field, manifold, y0, t1, dt, args=0.0, rtol=None, target=2.0, every=1):
    """The error with the metric of motion over that with the Euclidean one, and over plain."""
    ts = jnp.linspace(0, t1, 201)
    exact, _ = compared(field, dfx.Dopri8(), ts, dt, y0, args, 1e-13)
    plain = dfc.RK4() if rtol is None else dfx.Tsit5()
    solvers = (
        plain,
        dfc.ManifoldProjection(plain, manifold, every=every),
        dfc.ManifoldProjection(plain, manifold, projection=euclidean(), every=every),
    )
    errors = []
    for solver in solvers:
        ys, okay = compared(field, solver, ts, dt, y0, args, rtol)
        errors.append(largest(tree_error(ys, exact)) if okay else np.inf)
    print(
        f"  {name}: plain {errors[0]:.1e}, default {errors[1]:.1e}, Euclidean {errors[2]:.1e}",
        flush=True,
    )
    yield (
        f"{name}: error over the better of plain and Euclidean",
        errors[1] / min(errors[0], errors[2]),
        target,
    )


def pendulum(t, y, args):
    return jnp.stack([y[1], -jnp.sin(y[0])])


PENDULUM = {"energy": dfc.FirstIntegral(lambda t, y, args: y[1] ** 2 / 2 - jnp.cos(y[0]))}


def with_heat(t, y, args):
    """An oscillator that is damped from t = 20 on, and the heat that this makes."""
    gate = 0.1 / (1 + jnp.exp(-20 * (t - 20)))
    return jnp.stack([y[1], -y[0] - gate * y[1], gate * y[1] ** 2])


HEAT = {"energy": dfc.FirstIntegral(lambda t, y, args: (y[0] ** 2 + y[1] ** 2) / 2 + y[2])}


def two_oscillators(t, y, rate):
    return jnp.stack([y[1], -y[0], y[3] * rate, -y[2] * rate])


SQUARES = {"energy": dfc.FirstIntegral(lambda t, y, args: y @ y / 2)}


def henon_heiles(t, y, args):
    return jnp.stack([y[2], y[3], -y[0] - 2 * y[0] * y[1], -y[1] - y[0] ** 2 + y[1] ** 2])


HENON = {
    "energy": dfc.FirstIntegral(lambda t, y, args: y @ y / 2 + y[0] ** 2 * y[1] - y[1] ** 3 / 3)
}


def resting():
    yield from compare(
        "heat that rests until t = 20", with_heat, HEAT, jnp.array([1.0, 0, 0]), 40.0, 0.2
    )
    for angle in (1e-3, 2.5, 3.1):
        start = jnp.array([angle, 0.0])
        yield from compare(f"pendulum from rest at {angle}", pendulum, PENDULUM, start, 40.0, 0.2)
        yield from compare(
            f"pendulum from rest at {angle}, Tsit5",
            pendulum,
            PENDULUM,
            start,
            40.0,
            1e-3,
            rtol=1e-6,
        )
    yield from compare(
        "pendulum that turns, backwards", pendulum, PENDULUM, jnp.array([0.0, 2.5]), -40.0, -0.2
    )
    yield from compare(
        "pendulum, every=2", pendulum, PENDULUM, jnp.array([2.0, 0.0]), 40.0, 0.2, every=2
    )
    yield from compare(
        "Hénon-Heiles from rest", henon_heiles, HENON, jnp.array([0.3, 0.2, 0, 0]), 40.0, 0.25
    )
    # One oscillator moves, another rests at its equilibrium, or nearly.
    for name, start, rate in (
        ("at rest", 0.0, 1.0),
        ("tiny", 1e-8, 3.0),
        ("small and fast", 1e-3, 10.0),
    ):
        start = jnp.array([1.0, 0, start, 0])
        yield from compare(
            f"two oscillators, one {name}",
            two_oscillators,
            SQUARES,
            start,
            40.0,
            0.4 / (1 + rate),
            rate,
        )


def parameters_stay():
    for mu, a in ((EARTH, 7e6), (1.0, 1.0)):
        orbit = Orbits(*(np.array([x]) for x in (mu, a, 0.1)))
        field = lambda t, y, _: jnp.append(kepler(t, y[:4], y[4]), 0 * y[4])  # noqa: E731
        manifold = {
            k: dfc.FirstIntegral(lambda t, y, _, f=v.fn: f(t, y[:4], y[4]))
            for k, v in KEPLER.items()
        }
        period = float(orbit.period[0])
        y0 = jnp.append(jnp.asarray(orbit.y0[0]), mu)
        for projection in (dfc.SimplifiedNewton(), dfc.Newton()):
            s = dfc.ManifoldProjection(dfc.RK4(), manifold, projection=projection)
            sol = compiled(solve)(
                field, s, 5 * period, period / 60, y0, saveat=dfx.SaveAt(steps=True), max_steps=301
            )
            moved = largest(np.abs(sol.ys[:300, 4] / mu - 1)) if dfx.is_okay(sol.result) else np.inf
            yield f"μ = {mu:g} as a component, {type(projection).__name__}: it moves by", moved, 0


def restarts_lanes_dense():
    orbits = Orbits(
        np.full(4, EARTH), np.array([7e6, 1e7, 2e7, 4.2e7]), np.array([0.0, 1e-4, 0.05, 0.4])
    )
    s = dfc.ManifoldProjection(dfx.Dopri8(), KEPLER)

    @compiled
    def run(y0, mu, t1, dt, t0=0.0, state=None, controlled=False):
        rtol = 1e-8 if controlled else None
        return solve(
            kepler, s, t1, dt, y0, mu, t0=t0, rtol=rtol, atol=rtol, solver_state=state, max_steps=4096,
            saveat=dfx.SaveAt(t1=True, dense=True, solver_state=True),
        )  # fmt: skip

    for i, period in enumerate(orbits.period):
        e, y0, mu, dt = orbits.e[i], jnp.asarray(orbits.y0[i]), orbits.mu[i], period / 32
        whole, half = run(y0, mu, 64 * dt, dt), run(y0, mu, 32 * dt, dt)
        rest = run(half.ys[-1], mu, 64 * dt, dt, 32 * dt, half.solver_state)
        yield (
            f"restart from solver_state, e = {e:g}: change of the end",
            change(rest.ys[-1], whole.ys[-1]),
            1e-13,
        )
        sol = run(y0, mu, 3 * period, dt, controlled=True)
        ts = np.linspace(0, 3 * period, 3001)
        error = orbits_error(orbits, i, ts, jax.jit(jax.vmap(sol.evaluate))(ts))
        steps = np.asarray(sol.interpolation.ts)[: int(sol.stats["num_accepted_steps"]) + 1]
        at_steps = orbits_error(orbits, i, steps, jax.jit(jax.vmap(sol.evaluate))(steps))
        plain = solve(
            kepler,
            dfx.Dopri8(),
            3 * period,
            dt,
            y0,
            mu,
            rtol=1e-8,
            atol=1e-8,
            saveat=dfx.SaveAt(ts=ts),
        ).ys
        other = largest(orbits_error(orbits, i, ts, plain))
        print(
            f"  e = {e:g}: dense output, error {largest(error):.1e}, at the steps {largest(at_steps):.1e}, plain {other:.1e}",
            flush=True,
        )
        yield f"dense output, e = {e:g}: error over plain", largest(error) / other, 1.0
        inside = (steps[1:-1, None] * (1 + np.array([-1, 1]) * 1e-15 * 4)).ravel()
        jump = (
            np.diff(np.asarray(jax.jit(jax.vmap(sol.evaluate))(inside)).reshape(-1, 2, 4), axis=1)
            / orbits.scale[i]
        )
        yield f"dense output, e = {e:g}: largest jump at a step", largest(np.abs(jump)), 1e-11
    ts = orbits.period[:, None] * np.linspace(0, 5, 101)
    options = orbits.period / 50, orbits.y0, orbits.mu, 1e-8, np.full((4, 4), 1e-8)
    together = saved(s, ts, *options, 10_000)[0]
    alone = [
        saved(s, *(x[i : i + 1] for x in (ts, *options[:3])), 1e-8, options[4][i : i + 1], 10_000)[
            0
        ][0]
        for i in range(4)
    ]
    off = np.abs(np.stack(alone) - together) / orbits.scale[:, None]
    yield "lanes in metres alone and in a batch: change", largest(off), 1e-11


def orbits_error(orbits, i, ts, ys):
    exact = on_ellipse(*(np.broadcast_to(x[i], ts.shape) for x in (orbits.mu, orbits.a, orbits.e, orbits.angle)),
                       orbits.anomaly[i] + orbits.rate[i].astype(np.longdouble) * ts)  # fmt: skip
    return np.max(np.abs((np.asarray(ys) - exact) / orbits.scale[i]), axis=-1).astype(float)


def gradients():
    """Of the place after a turn and a half in metres, by the start: against central differences."""
    for e in (0.0, 1e-3, 0.1):
        orbit = Orbits(*(np.array([x]) for x in (EARTH, 7e6, e)))
        y0, scale, period = (
            jnp.asarray(orbit.y0[0]),
            jnp.asarray(orbit.scale[0]),
            float(orbit.period[0]),
        )
        ts = jnp.linspace(0, 1.5 * period, 8)
        for projection in (dfc.SimplifiedNewton(), dfc.Newton()):
            s = dfc.ManifoldProjection(dfc.RK4(), KEPLER, projection=projection)

            def states(x, adjoint, s=s, ts=ts, scale=scale, period=period):
                sol = solve(
                    kepler,
                    s,
                    ts[-1],
                    period / 40,
                    scale * x,
                    EARTH,
                    saveat=dfx.SaveAt(ts=ts),
                    max_steps=64,
                    adjoint=adjoint,
                )
                return jnp.sum(sol.ys / scale * jnp.cos(jnp.arange(32.0)).reshape(8, 4))

            x = y0 / scale
            reverse = jax.jit(jax.grad(lambda x: states(x, dfx.RecursiveCheckpointAdjoint())))(x)
            forward = jax.jit(jax.jacfwd(lambda x: states(x, dfx.ForwardMode())))(x)
            value = jax.jit(lambda x: states(x, dfx.ForwardMode()))
            h = 1e-4  # of each component's size
            finite = np.stack([
                (8 * (value(x + h * d) - value(x - h * d)) - (value(x + 2 * h * d) - value(x - 2 * h * d))) / (12 * h)
                for d in np.eye(4)
            ])  # fmt: skip
            off = change(reverse, finite), change(forward, finite)
            print(
                f"  e = {e:g}, {type(projection).__name__}: reverse {off[0]:.1e}, forward {off[1]:.1e} off the differences",
                flush=True,
            )
            # Where the gradients of energy and momentum are parallel a derivative may be NaN.
            name = f"gradients in metres, e = {e:g}, {type(projection).__name__}: off the finite differences"
            yield name, max(off), np.inf if e == 0 else 1e-6


def complex_states():
    """Three levels; amplitudes in units of their own."""
    h = np.array([[1.0, 0.3, 0], [0.3, 0.5, 0.2j], [0, -0.2j, -0.4]])
    rng, worst = np.random.default_rng(8), 0.0

    @jax.jit
    def run(units):
        manifold = {
            "norm": dfc.FirstIntegral(lambda t, y, _: jnp.sum(jnp.abs(y / units) ** 2)),
            "energy": dfc.FirstIntegral(
                lambda t, y, _: jnp.real(jnp.vdot(y / units, h @ (y / units)))
            ),
        }
        field = lambda t, y, _: -1j * units * (h @ (y / units))  # noqa: E731
        y0 = units * jnp.array([0.6, 0.64j, 0.48])
        ts = jnp.linspace(0, 10.0, 41)
        ys = [solve(field, s, 10.0, 0.2, y0, saveat=dfx.SaveAt(ts=ts)).ys / units
              for s in (dfx.RK4() if hasattr(dfx, "RK4") else dfc.RK4(), dfc.ManifoldProjection(dfc.RK4(), manifold))]  # fmt: skip
        return ys

    plain, base = run(jnp.ones(3))
    values, vectors = np.linalg.eigh(h)
    phases = np.exp(-1j * values * np.linspace(0, 10, 41)[:, None])
    exact = (phases * (vectors.conj().T @ np.array([0.6, 0.64j, 0.48]))) @ vectors.T
    yield (
        "complex states: error over plain",
        largest(np.abs(base - exact)) / largest(np.abs(plain - exact)),
        1.0,
    )
    for _ in range(few(6, 1)):
        got = run(jnp.asarray(2.0 ** rng.integers(-40, 41, 3)))[1]
        worst = max(worst, largest(np.abs(got - base)))
    yield "complex states, powers of two: change", worst, 1e-12


PARTS = {
    f.__name__.replace("_", " "): f
    for f in (
        powers_of_two, powers_of_two_events, planets_in_metres, states_of_another_time, events, energy_alone, catalogue,
        long_steps, systems_in_si, single_precision, bounds, newton_and_circles, resting, parameters_stay,
        restarts_lanes_dense, gradients, complex_states,
    )
}  # fmt: skip


def main():
    global SMOKE
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="the parts whose names hold this text")
    parser.add_argument("--smoke", action="store_true", help="toy sizes")
    options = parser.parse_args()
    SMOKE = options.smoke
    rows = []
    for name, part in PARTS.items():
        if options.only in name:
            print(name, flush=True)
            try:
                rows += part()
            except Exception:  # the other parts are of interest all the same
                traceback.print_exc()
                rows.append((f"{name}: broke", np.inf, 0))
    print("| what | measured | at most | |\n|---|---|---|---|")
    for what, value, target in rows:
        mark = "holds" if value <= target else "VIOLATED"
        print(f"| {what} | {float(value):.2g} | {target:g} | {mark} |")


if __name__ == "__main__":
    main()
