"""Does the answer depend on the units? Planets in metres, and random powers of two.

    python benchmarks/studies/units.py               # one row for each promise
    python benchmarks/studies/units.py --only planet # the parts whose names hold this text
    python benchmarks/studies/units.py --smoke       # toy sizes

Errors are against Kepler's equation, solved here in long double, and plain Dopri8 at 1e-13. A row
says what was measured, the number, and what it should be at most. Times are those of the processor.
"""

import argparse
import functools
import time

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
EUCLIDEAN = dfc.SimplifiedNewton(metric=1.0)
ITERATIONS = (dfc.SimplifiedNewton(), dfc.Newton())


def few(many, toy):
    return toy if SMOKE else many


def say(*text):
    print(" ", *text, flush=True)


def largest(x):
    """NaN is the largest."""
    return float(np.max(np.nan_to_num(x, nan=np.inf)))


def solve(field, solver, t1, dt0, y0, args=None, *, rtol=None, **options):
    if rtol is not None:
        pid = dfx.PIDController(rtol=rtol, atol=options.pop("atol", rtol))
        options["stepsize_controller"] = pid
    options = dict(max_steps=200_000, throw=False) | options
    return dfx.diffeqsolve(dfx.ODETerm(field), solver, 0.0, t1, dt0, y0, args, **options)


def truth(field, y0, ts):
    return solve(field, dfx.Dopri8(), ts[-1], None, y0, rtol=1e-13, saveat=dfx.SaveAt(ts=ts)).ys


def lane_errors(ys, exact, okay):
    """The largest error of each lane, each leaf in units of its own; infinite where it failed."""
    errors = []
    for pair in zip(jax.tree.leaves(ys), jax.tree.leaves(exact), strict=True):
        a, b = (np.asarray(x).reshape(len(okay), -1) for x in pair)
        errors.append(np.max(np.abs(a - b), axis=1) / np.max(np.abs(b), axis=1))
    return np.where(okay, np.nan_to_num(np.max(errors, axis=0), nan=np.inf), np.inf)


# ---- Powers of two ----


def in_units(fn, unravel, factor):
    """`fn` of what is in units of `args[0]`, and of `args[1]` for time, times `factor(args)`."""

    def wrapped(t, y, args):
        out = fn(t / args[1], unravel(y / args[0]), None)
        return factor(args) * (ravel_pytree(out)[0] if isinstance(out, tuple | list) else out)

    return wrapped


def powers_of_two():
    rng, worst = np.random.default_rng(1), 0.0
    names = ("kepler", "rigid-body", "double-pendulum", "lotka-volterra", "cartesian-pendulum")
    for name in few(names, names[1:2]):
        system = dfc.systems.get(name)
        flat, unravel = ravel_pytree(system.y0)
        field = in_units(system.vector_field, unravel, lambda args: args[0] / args[1])
        manifold = {
            k: type(entry)(in_units(entry.fn, unravel, lambda args, i=i: args[2][i]))
            for i, (k, entry) in enumerate(system.manifold.items())
        }
        dt = system.dt / (20 if name == "double-pendulum" else 2)
        for projection in few(ITERATIONS, ITERATIONS[:1]):
            solver = dfc.ManifoldProjection(dfx.Tsit5(), manifold, projection=projection)

            @jax.jit
            def run(units, clock, sizes, field=field, solver=solver, flat=flat, dt=dt):
                ts = jnp.linspace(0, 20 * dt, 101) * clock
                sol = solve(
                    field, solver, ts[-1], dt * clock, flat * units, (units, clock, sizes),
                    rtol=1e-6, atol=1e-6 * units, saveat=dfx.SaveAt(ts=ts), max_steps=256,
                )  # fmt: skip
                return sol.ys / units, dfx.is_okay(sol.result)

            base, okay = run(np.ones(flat.size), np.ones(()), np.ones(len(manifold)))
            for _ in range(few(6, 2)):
                draw = (2.0 ** rng.integers(-40, 41, k) for k in (flat.size, (), len(manifold)))
                got, _ = run(*map(np.asarray, draw))
                off = largest(np.abs(got - base)) if okay else np.inf
                worst = max(worst, off / largest(np.abs(base)))
            say(f"{name}, {type(projection).__name__}: {worst:.1e} so far")
    yield "five systems, random powers of two: change of the solution", worst, 1e-12


# ---- Kepler's problem in any units, in its plane: y = (q₁, q₂, v₁, v₂), args = μ ----

SUN, EARTH = 1.32712440018e20, 3.986004418e14


def kepler(t, y, mu):
    return jnp.concatenate([y[2:], -mu * y[:2] / jnp.sum(y[:2] ** 2) ** 1.5])


KEPLER = {
    "energy": dfc.FirstIntegral(lambda t, y, mu: y[2:] @ y[2:] / 2 - mu / jnp.sqrt(y[:2] @ y[:2])),
    "momentum": dfc.FirstIntegral(lambda t, y, mu: y[0] * y[3] - y[1] * y[2]),
}


class Orbits:
    """Lanes of orbits that begin anywhere; `exact(ts)` has the states at (lanes, times)."""

    def __init__(self, mu, a, e, seed=0, anomaly=None):
        self.mu, self.a, self.e = np.broadcast_arrays(mu, a, np.asarray(e, float))
        self.angle, start = np.random.default_rng(seed).uniform(0, 2 * np.pi, (2, len(self.e)))
        self.anomaly = start if anomaly is None else anomaly
        self.rate = np.sqrt(self.mu.astype(np.longdouble) / self.a.astype(np.longdouble) ** 3)
        self.period = (2 * np.pi / self.rate).astype(float)
        self.scale = np.stack([self.a] * 2 + [self.a * self.rate] * 2, -1).astype(float)
        self.y0 = self.exact(np.zeros((len(self.e), 1)))[:, 0].astype(float)

    def exact(self, ts):
        a, e, angle, n = (x[:, None] for x in (self.a, self.e, self.angle, self.rate))
        m = self.anomaly[:, None] + n * ts
        big = m + e * np.sin(m)
        for _ in range(12):
            big = big - (big - e * np.sin(big) - m) / (1 - e * np.cos(big))
        c, s, b, w = np.cos(big), np.sin(big), np.sqrt(1 - e * e), a * n / (1 - e * np.cos(big))
        turned = np.exp(1j * angle.astype(np.longdouble))
        q, v = turned * a * (c - e + 1j * b * s), turned * w * (-s + 1j * b * c)
        return np.stack([q.real, q.imag, v.real, v.imag], axis=-1)

    def error(self, ts, ys):
        """Of position and velocity, relative to the size of each."""
        off = (np.asarray(ys) - self.exact(np.asarray(ts))) / self.scale[:, None]
        return np.max(np.abs(off), axis=-1).astype(float)

    def saved(self, solver, ts, rtol, every_step=None):
        """The states at `ts`, whether each lane succeeded, and `every_step` its first steps."""
        lanes = ts, self.period / 100, self.y0, self.mu.astype(float), self.scale
        return [np.asarray(x) for x in saved_states(solver, *lanes, rtol, every_step)]


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, 0, 0, 0, 0, 0, None, None))
def saved_states(solver, ts, dt0, y0, mu, scale, rtol, every_step):
    subs = [dfx.SubSaveAt(ts=ts)]
    subs += [dfx.SubSaveAt(t0=True, steps=True)] if every_step else []
    options = dict(saveat=dfx.SaveAt(subs=subs), max_steps=every_step or 200_000)
    sol = solve(kepler, solver, ts[-1], dt0, y0, mu, rtol=rtol, atol=rtol * scale, **options)
    return sol.ys[0], dfx.is_okay(sol.result), *((sol.ts[1], sol.ys[1]) if every_step else ())


def planets():
    eccentricities = (0.0, 1e-5, 2e-4, 1e-3, 1e-2, 0.0167, 0.05, 0.1, 0.2)
    bodies = ((SUN, 1.496e11), (SUN, 7.785e11), (EARTH, 7.078e6), (EARTH, 4.2164e7))
    lanes = np.array([(*body, e) for body in bodies for e in eccentricities])
    orbits, turns = Orbits(*few(lanes, lanes[::8]).T), few(50, 12)
    worst, medians = [], []
    ts = orbits.period[:, None] * np.linspace(0, turns, few(1001, 101))
    late = np.linspace(0, turns, ts.shape[1]) >= 10
    for method in few((dfx.Tsit5(), dfx.Dopri8()), (dfx.Tsit5(),)):
        for rtol in (1e-6, 1e-9):
            errors = []
            for solver in (method, dfc.ManifoldProjection(method, KEPLER)):
                ys, okay, *_ = orbits.saved(solver, ts, rtol)
                error = np.where(okay[:, None], orbits.error(ts, ys), np.inf)
                errors.append(np.maximum.accumulate(error, axis=1)[:, late])
            ratio = errors[1] / errors[0]
            worst, medians = [*worst, largest(ratio)], [*medians, np.median(ratio[:, -1])]
            say(f"{type(method).__name__} {rtol:.0e}: {worst[-1]:.2g}, median {medians[-1]:.2g}; "
                f"plain {np.median(errors[0][:, -1]):.1e}, failed {np.sum(~okay)}")  # fmt: skip
    yield "planets in metres: largest error over plain, after ten orbits", max(worst), 1.0
    yield "planets in metres: median error over plain (largest of all methods)", max(medians), 0.1


def circles():
    """Exactly circular orbits, of which the manifold has a dimension less than its functions tell.
    They begin anywhere, and are solved for five turns with fixed steps of low order."""
    lanes, turn = few(40, 4), 2 * np.pi
    anomaly = np.linspace(0, turn, lanes, endpoint=False)
    y0 = Orbits(1.0, 1.0, np.zeros(lanes), anomaly=anomaly).y0
    cases = ((dfc.RK4(), 20), (dfc.RK4(), 100), (dfx.Bosh3(), 60), (dfx.Heun(), 150))
    for solver, steps in few(cases, cases[:1]):
        kinds = ("default", ITERATIONS[0]), ("metric=1.0", EUCLIDEAN)
        for name, projection in few(kinds, kinds[:1]):
            kept = dfc.ManifoldProjection(solver, KEPLER, projection=projection)

            def okay(y, kept=kept, steps=steps):
                return dfx.is_okay(solve(kepler, kept, 5 * turn, turn / steps, y, 1.0).result)

            failed = int(np.sum(~jax.jit(jax.vmap(okay))(y0)))
            title = f"circles, {type(solver).__name__} in {steps} steps a turn, {name}"
            yield f"{title}: failed of {lanes}", failed, 0


def other_times():
    """200 orbits: those that are off by 3 times the error at the steps around them."""
    units = {"m": (EARTH, 7e6, 4e7), "km": (EARTH / 1e9, 7e3, 4e4), "atomic": (1.0, 1.0, 9.0),
             "AU, days": (2.959122082855911e-4, 0.4, 30.0)}  # fmt: skip
    shares, num = [], few(50, 4)
    for name, (mu, low, high) in units.items():
        rng, found = np.random.default_rng(3), []
        e = np.where(np.arange(num) % 5 == 0, 0.0, rng.uniform(0, 0.3, num))
        orbits = Orbits(mu, np.exp(rng.uniform(np.log(low), np.log(high), num)), e, seed=4)
        ts = orbits.period[:, None] * np.linspace(0, few(10, 3), few(401, 61))
        for solver in (dfx.Dopri8(), dfc.ManifoldProjection(dfx.Dopri8(), KEPLER)):
            ys, okay, steps, y = orbits.saved(solver, ts, 1e-6, every_step=400)
            at_steps = orbits.error(np.where(np.isfinite(steps), steps, 0), y)
            right = [np.searchsorted(s, t).clip(1, np.sum(np.isfinite(s)) - 1)
                     for s, t in zip(steps, ts, strict=True)]  # fmt: skip
            around = [np.take_along_axis(at_steps, np.stack(right) - k, axis=1) for k in (0, 1)]
            found.append((np.nan_to_num(orbits.error(ts, ys), nan=np.inf), np.maximum(*around)))
        (plain, plain_near), (mine, near) = found
        # What the interpolant itself errs is not a state of another time.
        interpolant = np.max(np.maximum(plain - plain_near, 0), axis=1)[:, None]
        shares.append(np.mean(mine > 3 * (near + interpolant) + 1e-12) + np.mean(~okay))
        say(f"{name}: {shares[-1]:.2%}; with no allowance for the interpolant "
            f"{np.mean(mine > 3 * near + 1e-12):.2%}, plain {np.mean(plain > 3 * plain_near):.2%}; "
            f"failed {np.sum(~okay)}")  # fmt: skip
    yield "saved states of another time: share", max(shares), 0


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, 0, 0, 0))
def perigee(solver, y0, axis, scale):
    # An angle: in metres no root finder meets an absolute tolerance of 1e-10.
    event = dfx.Event(
        lambda t, y, args, **_: (axis @ y[:2]) / jnp.sqrt(y[:2] @ y[:2]),
        optx.Newton(1e-10, 1e-10), direction=True,
    )  # fmt: skip
    options = dict(rtol=1e-9, atol=1e-9 * scale, event=event)
    sol = solve(kepler, solver, 1e5, 100.0, y0, EARTH / 1e9, **options)
    return sol.ts[0], sol.result == dfx.RESULTS.event_occurred


def events():
    phases = np.linspace(0.3, 6.0, few(200, 8))
    for e in (2e-4, 0.0):
        orbits, off = Orbits(EARTH / 1e9, 4.2164e4, e + 0 * phases, anomaly=phases), []
        axis = np.stack([-np.sin(orbits.angle), np.cos(orbits.angle)], -1)
        for solver in (dfx.Dopri8(), dfc.ManifoldProjection(dfx.Dopri8(), KEPLER)):
            t, okay = perigee(solver, orbits.y0, axis, orbits.scale)
            error = np.abs(np.asarray(t) - (2 * np.pi - phases) / orbits.rate)
            off.append(np.where(okay, error, np.inf).astype(float))
        found = off[0] < 1
        missed, ratio = np.sum(off[1][found] > 60), largest(off[1][found]) / largest(off[0][found])
        medians = [f"{np.median(x):.1e} s" for x in off]
        say(f"e = {e:g}: plain finds {found.sum()}; medians {medians}")
        yield f"perigees with Newton, e = {e:g}: missed of what plain finds", missed, 0
        yield f"perigees with Newton, e = {e:g}: largest error in time over plain", ratio, 1.5


# ---- The catalogue ----


def compared(system, manifold, y0, dt, steps):
    """Errors by RK4 of lanes: plain, projected, and projected by the Euclidean metric."""
    default = dfc.ManifoldProjection(dfc.RK4(), manifold)
    euclidean = dfc.ManifoldProjection(dfc.RK4(), manifold, projection=EUCLIDEAN)

    @jax.jit
    @jax.vmap
    def run(y0):
        found, options = [], dict(saveat=dfx.SaveAt(steps=True), max_steps=steps + 1)
        for solver in (dfc.RK4(), default, euclidean):
            sol = solve(system.vector_field, solver, steps * dt, dt, y0, **options)
            found.append((jax.tree.map(lambda y: y[:steps], sol.ys), dfx.is_okay(sol.result)))
        return found, truth(system.vector_field, y0, dt * jnp.arange(1, steps + 1))

    found, exact = run(y0)
    return np.stack([lane_errors(ys, exact, okay) for ys, okay in found])


def energy_alone():
    """From the start of the catalogue, and beside it rigid bodies from 50 others."""
    both = ("outer-solar-system", 0.3), ("rigid-body", 0.5)
    for name, target in few(both, both[1:]):
        system, ratios = dfc.systems.get(name), []
        energy = {"energy": system.manifold["energy"]}
        y0 = jax.tree.map(lambda x: x[None], system.y0)
        if name == "rigid-body":
            drawn = jax.vmap(system.sample)(jr.split(jr.key(9), few(50, 2)))
            y0 = jnp.concatenate([y0, drawn])
        for share in few((0.5, 1, 2), (1,)):
            dt = system.dt * share
            steps = few(round(min(system.t1, 200 * system.dt) / dt), 10)
            plain, mine, euclidean = compared(system, energy, y0, dt, steps)
            ratios.append(mine[0] / plain[0])
            lanes = [f"{np.median(x / plain):.2g}" for x in (mine, euclidean)]
            say(f"{name}, {steps} steps of {dt:g}: {ratios[-1]:.2g} of plain's {plain[0]:.1e}, "
                f"Euclidean {euclidean[0] / plain[0]:.2g}; medians of lanes {lanes}")  # fmt: skip
        yield f"{name}, RK4, on the energy alone: error over plain (largest)", max(ratios), target


def spinning(t, y, args):
    """A unit quaternion, and the angular velocity in the body; the moments of inertia 1, 2, 3."""
    del t, args
    q, w = y[:4], y[4:]
    turn = jnp.array([-q[1:] @ w, *(q[0] * w + jnp.cross(q[1:], w))]) / 2
    return jnp.concatenate([turn, jnp.cross(INERTIA * w, w) / INERTIA])


def in_space(t, y, args):
    """The angular momentum."""
    del t, args
    q, x = y[:4], INERTIA * y[4:]
    return x + 2 * jnp.cross(q[1:], jnp.cross(q[1:], x) + q[0] * x)


INERTIA = jnp.array([1.0, 2.0, 3.0])
SPINNING = {
    "length": dfc.Constraint(lambda t, y, args: jnp.sum(y[:4] ** 2) - 1),
    "energy": dfc.FirstIntegral(lambda t, y, args: jnp.sum(INERTIA * y[4:] ** 2) / 2),
    "momentum": dfc.FirstIntegral(in_space),
}


def attitudes():
    """Fast spins, of which quaternion and velocity have different frequencies."""
    spin, lanes = 200.0, few(50, 2)
    y0 = jr.normal(jr.key(0), (lanes, 7))
    y0 = y0.at[:, :4].divide(jnp.linalg.norm(y0[:, :4], axis=1, keepdims=True))
    y0 = y0.at[:, 4:].multiply(spin / jnp.linalg.norm(y0[:, 4:], axis=1, keepdims=True))
    sizes = jnp.array([1.0] * 4 + [spin] * 3)
    ts = jnp.linspace(0.0, 0.4, few(201, 11))
    by_size = dfc.SimplifiedNewton(metric=1 / sizes**2)
    solvers = [
        dfx.Tsit5(),
        dfc.ManifoldProjection(dfx.Tsit5(), SPINNING),
        dfc.ManifoldProjection(dfx.Tsit5(), SPINNING, projection=by_size),
    ]

    @jax.jit
    def run(rtol):
        options = dict(rtol=rtol, atol=rtol * sizes, saveat=dfx.SaveAt(ts=ts))
        found = []
        for solver in solvers:
            sol = jax.vmap(lambda y, s=solver: solve(spinning, s, 0.4, 1e-4, y, **options))(y0)
            found.append((sol.ys, dfx.is_okay(sol.result)))
        return found

    exact = jax.jit(jax.vmap(lambda y: truth(spinning, y, ts)))(y0) / sizes
    for rtol in few((1e-4, 1e-6, 1e-8), (1e-4,)):
        plain, mine, sized = (lane_errors(ys / sizes, exact, ok) for ys, ok in run(rtol))
        for name, errors in {"default": mine, "1/size^2": sized}.items():
            name, ratio = f"attitudes, {rtol:g}, {name}", errors / plain
            say(f"{name}: median {np.median(ratio):.2g}, worst {max(ratio):.2g}")
            yield f"{name}: median of the error over plain", np.median(ratio), 1


def catalogue():
    worst = {}
    for name in few(dfc.systems.names(), ("rigid-body",)):
        system, shares = dfc.systems.get(name), (10 if name == "double-pendulum" else 1)
        y0 = jax.vmap(system.sample)(jr.split(jr.key(5), few(12, 2)))
        steps = few(20 if name in ("double-pendulum", "korteweg-de-vries") else 60, 5)
        plain, mine, euclidean = compared(system, system.manifold, y0, system.dt / shares, steps)
        both = np.isfinite(mine) & np.isfinite(euclidean)
        failed = [np.sum(~np.isfinite(x)) for x in (mine, euclidean)]
        each = mine[both] / euclidean[both]
        worst[name] = np.exp(np.mean(np.log(each))) if both.any() else np.inf
        say(f"{name}: {worst[name]:.2g}; plain {np.median(plain):.1e}, failed {failed}")
    name = max(worst, key=worst.get)
    yield f"natural units: error over Euclidean, largest ({name})", worst[name], 2.0


# ---- Cost ----


def seconds(fn, *args):
    start = time.process_time()
    jax.block_until_ready(fn(*args))
    return time.process_time() - start


def over_euclidean(name, y0, inner, t1, dt, **options):
    """Processor time of compilation and of a run: the default's over the Euclidean metric's."""
    system, found = dfc.systems.get(name), []
    for projection in (ITERATIONS[0], EUCLIDEAN):
        solver = dfc.ManifoldProjection(inner, system.manifold, projection=projection)
        run = functools.partial(solve, system.vector_field, solver, t1, dt, **options)
        lowered = jax.jit(jax.vmap(lambda y, run=run: run(y).ys)).lower(y0)
        compilation, compiled = seconds(lowered.compile), lowered.compile()
        found.append(np.array([compilation, min(seconds(compiled, y0) for _ in range(few(5, 1)))]))
    say(f"{name}: compiled and run in {found[0]} s, Euclidean {found[1]} s")
    return found[0] / found[1]


def cost():
    cases = (
        ("cartesian-pendulum", 1, few(100_000, 100), 1.05),
        ("rigid-body", 1000, 500, 1.2),
    )
    for name, lanes, steps, target in few(cases, cases[:1]):
        system = dfc.systems.get(name)
        y0, dt = jax.tree.map(lambda x, n=lanes: jnp.stack([x] * n), system.y0), system.dt / 10
        _, ratio = over_euclidean(name, y0, dfc.RK4(), steps * dt, dt)
        yield f"{lanes} of {name}: time of a step over Euclidean", ratio, target
    for name in few(("point-vortices", "kepler"), ()):
        system = dfc.systems.get(name)
        y0 = jax.tree.map(lambda x: x[None], system.y0)
        options = dict(rtol=1e-6, saveat=dfx.SaveAt(ts=jnp.linspace(0, system.t1, 50)))
        ratio, _ = over_euclidean(name, y0, dfx.Tsit5(), system.t1, 0.1, **options)
        yield f"{name} with `ts`: time of compilation over Euclidean", ratio, 1.0


# ---- Very long steps ----


def long_steps():
    num, rng, steps = few(300, 10), np.random.default_rng(6), 20
    orbits = Orbits(1.0, 1.0, rng.uniform(0.3, 0.9, num), seed=6)
    vortices = dfc.systems.get("point-vortices")
    pendulum = {"energy": dfc.FirstIntegral(lambda t, y, _: y[1] ** 2 / 2 - jnp.cos(y[0]))}
    top = np.stack([np.pi - 10 ** rng.uniform(-6, -1, num), rng.choice([0, 1e-3, -1e-2], num)], 1)
    cases = {
        "eccentric orbits": (kepler, KEPLER, orbits.y0, 2 * np.pi / rng.uniform(10, 60, num)),
        "vortices": (vortices.vector_field, vortices.manifold,
                     jax.vmap(vortices.sample)(jr.split(jr.key(2), num)),
                     vortices.dt * 10 ** rng.uniform(0, 1.5, num)),
        "pendulums": (lambda t, y, _: jnp.stack([y[1], -jnp.sin(y[0])]), pendulum, top,
                      rng.uniform(0.3, 1.5, num)),
    }  # fmt: skip
    chosen = list(cases.items())
    for name, (field, manifold, y0, dt) in few(chosen, chosen[-1:]):

        @jax.jit
        @jax.vmap
        def run(y0, dt, field=field, manifold=manifold):
            saveat = dfx.SaveAt(ts=dt * jnp.linspace(0, steps, 7 * steps + 1))
            solver = dfc.ManifoldProjection(dfc.RK4(), manifold)
            sol = solve(field, solver, steps * dt, dt, y0, 1.0, saveat=saveat, max_steps=steps + 2)
            drift, _ = ravel_pytree(dfc.drift(sol, manifold, 1.0))
            off = dfc.off_manifold(sol, manifold, 1.0)
            return dfx.is_okay(sol.result), off, jnp.max(jnp.abs(drift))

        okay, off, drift = map(np.asarray, run(y0, dt))
        lanes = okay & np.any(off, axis=1)
        worst = [f"{np.max(drift[x], initial=0):.1e}" for x in (lanes, okay & ~lanes)]
        say(f"{name}: {okay.sum()} of {num} succeed, {lanes.sum()} off; drift {worst}")
        share = lanes.sum() / max(okay.sum(), 1)
        yield f"long steps, {name}: share of successes with a state off the manifold", share, 0.01


NATURE = (powers_of_two, planets, circles, other_times, events, energy_alone, attitudes)
PARTS = (*NATURE, catalogue, cost, long_steps)
# `tests/laws/test_units.py` solves what these solve; the catalogue is compared as the energy alone.
# So at toy sizes they run only if they are asked for.
NOT_AT_TOY_SIZES = (powers_of_two, planets, events, catalogue)


def main():
    global SMOKE
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="the parts whose names hold this text")
    parser.add_argument("--smoke", action="store_true", help="toy sizes")
    options = parser.parse_args()
    SMOKE, rows = options.smoke, []
    left_out = () if options.only else few((), NOT_AT_TOY_SIZES)
    for part in PARTS:
        if options.only in part.__name__ and part not in left_out:
            start = time.process_time()
            rows += part()
            say(f"({part.__name__}: {time.process_time() - start:.0f} s)")
    print("| what | measured | at most | |\n|---|---|---|---|")
    for what, value, target in rows:
        mark = "holds" if value <= target else "VIOLATED"
        print(f"| {what} | {value:.2g} | {target:g} | {mark} |")


if __name__ == "__main__":
    main()
