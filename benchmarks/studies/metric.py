"""Which default metric makes the errors of a solve smallest? Many problems, five candidates.

    python benchmarks/studies/metric.py                # all problems: an hour
    python benchmarks/studies/metric.py --only kepler  # the problems whose names hold this text
    python benchmarks/studies/metric.py --smoke        # toy sizes

Each problem is solved from several random starts, by RK4 in fixed steps and by Tsit5 in adaptive
ones: without a projection, and with all that it conserves kept, once for each candidate. A
candidate is a rule for the units of the components, put in the place of `State.motion_after` while
a program is traced. The error of a lane is the largest over its saved times against Dopri8 at
1e-13, each part of the state in a unit of its own. The table has the errors over those of the plain
solve; `benchmarks/results/metric.json` has those of every lane.
"""
# ruff: noqa: E731

import argparse
import itertools
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optimistix as optx

import diffrax_conserve as dfc
from diffrax_conserve._solver.state import State
from diffrax_conserve._tree import ravel, real_view, unflatten

jax.config.update("jax_enable_x64", True)

RESULTS = Path(__file__).parents[1] / "results" / "metric.json"
SAVED = 20  # The numbers of fixed steps are multiples of it.
# Without a projection, a lane with a larger relative error is chaos, and one with a smaller error
# is roundoff. Neither tells anything.
CHAOS, ROUNDOFF = 0.3, 1e-11
TOLERANCES, MAX_STEPS = (1e-4, 1e-6, 1e-8), 4096
# At toy sizes: the problems, and what is left out, because nearly all of it is compilation.
SMALL = {"parameters-in-a-leaf": "Tsit5", "lotka-cycle": "RK4"}


# ---- Candidates ----


def largest_of_leaf(x, like):
    parts = unflatten(x, jax.eval_shape(real_view, like))
    return ravel(jax.tree.map(lambda part: jnp.full_like(part, jnp.max(part)), parts))


def size(change, end):
    return jnp.maximum(jnp.abs(ravel(end)), change)


def motion(change, end):
    """What hardly moves has a small unit, as it has by default; what stays zero has none."""
    return jnp.maximum(change, float(jnp.finfo(change.dtype).eps) ** 0.5 * size(change, end))


DEFAULT, EUCLIDEAN = State.motion_after, dfc.SimplifiedNewton(metric=1.0)
# The units in a step, of its change and its end; those of a solve are the largest so far. `None` is
# the method of `State`. In the size of a leaf only what moves counts. The units are also a part of
# the scale of roundoff, so with large ones the iteration ends a little earlier.
CANDIDATES = {
    "motion of each component": motion,
    "largest motion of the leaf": lambda x, end: largest_of_leaf(motion(x, end), end),
    "largest size of the leaf": lambda x, end: largest_of_leaf((x > 0) * size(x, end), end),
    "mean, the default": None,
    "Euclidean": None,
}


def rule(units):
    return lambda state, change, end: jnp.maximum(state.motion, units(change, end))


# ---- Problems ----


class Problem(NamedTuple):
    """`draw(key)` is a random start, `kept` what is conserved. `steps` are numbers of fixed steps.
    `scale` is the unit of an error, like the state or a number; `None` is the size of each leaf."""

    field: Callable
    kept: dict
    draw: Callable
    t1: float
    steps: tuple[int, ...]
    scale: Any = None
    lanes: int = 8


PROBLEMS: dict[str, Callable[[], Problem]] = {}


def problem(*settings, **more):
    """Of a function that returns the field, what is conserved and how a start is drawn."""

    def keep(fn):
        PROBLEMS[fn.__name__.replace("_", "-")] = lambda: Problem(*fn(), *settings, **more)

    return keep


def integral(fn):
    return dfc.FirstIntegral(lambda t, y, args: fn(y))


def constraint(fn):
    return dfc.Constraint(lambda t, y, args: fn(y))


def of_catalogue(name, t1, *steps):
    system = dfc.systems.get(name)
    return Problem(system.vector_field, system.manifold, system.sample, t1, steps)


CATALOGUE = (
    ("harmonic-oscillator", 30.0, 100, 300), ("rigid-body", 7.0, 60, 200),
    ("double-pendulum", 4.0, 200, 600), ("conservative-lorenz", 20.0, 100, 300),
    ("point-vortices", 50.0, 100, 300), ("kepler", 30.0, 200, 600),
    ("henon-heiles", 40.0, 200, 600), ("lotka-volterra", 30.0, 160, 400),
    ("toda-lattice", 20.0, 100, 300), ("cartesian-pendulum", 10.0, 100, 300),
    ("rigid-body-attitude", 10.0, 100, 300),
)  # fmt: skip
PROBLEMS |= {f"catalogue-{x[0]}": lambda x=x: of_catalogue(*x) for x in CATALOGUE}


def rotated(q, x):
    return x + 2 * jnp.cross(q[1:], jnp.cross(q[1:], x) + q[0] * x)


def turning(q, w):
    return jnp.concatenate([-(q[1:] @ w)[None], q[0] * w + jnp.cross(q[1:], w)]) / 2


def unit(key, n=3):
    x = jr.normal(key, (n,))
    return x / jnp.linalg.norm(x)


@problem(4.0, (400, 1000), lanes=6)
def rolling_hoop():
    m, r, g = 2.0, 0.3, 9.81
    inertia = m * r * r * jnp.array([0.5, 0.5, 1.0])

    def lowest(q):
        n = rotated(q, jnp.array([0.0, 0.0, 1.0]))
        d = jnp.array([0.0, 0.0, -1.0]) + n[2] * n
        return r * d / jnp.linalg.norm(d)

    def free(t, y, args):
        gravity, turn = jnp.array([0.0, 0.0, -g]), jnp.cross(inertia * y["w"], y["w"]) / inertia
        return dict(c=y["v"], q=turning(y["q"], y["w"]), v=gravity, w=turn)

    def energy(y):
        return m * y["v"] @ y["v"] / 2 + inertia @ y["w"] ** 2 / 2 + m * g * y["c"][2]

    def draw(key):
        a, b, c = jr.split(key, 3)
        tilt = jr.uniform(a, minval=0.9, maxval=1.1)
        q = jnp.array([jnp.cos(tilt), jnp.sin(tilt), 0.0, 0.0])
        w = jnp.array([0.0, jr.uniform(b, minval=-2, maxval=2), jr.uniform(c, minval=8, maxval=14)])
        v = -jnp.cross(rotated(q, w), lowest(q))
        return dict(c=jnp.array([0.0, 0.0, -lowest(q)[2]]), q=q, v=v, w=w)

    slip = constraint(lambda y: y["v"] + jnp.cross(rotated(y["q"], y["w"]), lowest(y["q"])))
    height = constraint(lambda y: y["c"][2] + lowest(y["q"])[2])
    kept = dict(slip=slip, height=height, length=constraint(lambda y: y["q"] @ y["q"] - 1))
    field = dfc.tangent(free, slip, metric=dict(c=jnp.inf, q=jnp.inf, v=m, w=inertia))
    return field, kept | dict(energy=integral(energy)), draw


@problem(4.0, (100, 300), lanes=3)
def free_molecule():
    mass = jnp.asarray(np.repeat([[12.011], [1.008], [1.008], [1.008], [1.008]], 3, 1))
    corners = [[0, 0, 0], [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]
    q0 = 0.109 / 3**0.5 * np.array(corners, float)
    i, j = (x[:9] for x in np.tril_indices(5, -1))
    free = lambda t, y, args: (y[1], jnp.zeros_like(y[1]))
    lengths = lambda q: jnp.sum((q[i] - q[j]) ** 2, axis=1)
    fixed = constraint(lambda y: lengths(y[0]) - lengths(q0))
    kept = dict(lengths=fixed, velocities=fixed.derivative(free))
    kept["energy"] = integral(lambda y: jnp.sum(mass * y[1] ** 2) / 2)

    field = dfc.tangent(free, kept["velocities"], metric=(jnp.inf, mass))
    draw = lambda a, b: (jnp.asarray(q0), jnp.cross(9 * unit(a), q0) + 0.4 * jr.normal(b, (3,)))
    return field, kept, lambda key: draw(*jr.split(key))


@problem(0.2, (200, 600), scale=jnp.array([1.0] * 4 + [200.0] * 3), lanes=16)
def fast_spins():
    inertia = jnp.array([1.0, 2.0, 3.0])
    euler = lambda w: jnp.cross(inertia * w, w) / inertia
    field = lambda t, y, args: jnp.concatenate([turning(y[:4], y[4:]), euler(y[4:])])
    kept = dict(
        length=constraint(lambda y: jnp.sum(y[:4] ** 2) - 1),
        energy=integral(lambda y: inertia @ y[4:] ** 2 / 2),
        momentum=integral(lambda y: rotated(y[:4], inertia * y[4:])),
    )
    draw = lambda a, b: jnp.concatenate([unit(a, 4), 200 * unit(b)])
    return field, kept, lambda key: draw(*jr.split(key))


def satellites(e, far=0.0):
    """In metres, in one array, started at the perigee, which may have any direction."""
    mu, a = 3.986004418e14, 7e6
    rate = (mu / a**3) ** 0.5
    place = lambda y: y[:2] - far * a
    radius = lambda y: jnp.sqrt(place(y) @ place(y))
    field = lambda t, y, args: jnp.concatenate([y[2:], -mu * place(y) / radius(y) ** 3])
    energy = integral(lambda y: y[2:] @ y[2:] / 2 - mu / radius(y))
    momentum = integral(lambda y: place(y)[0] * y[3] - place(y)[1] * y[2])

    def draw(key):
        k, l = jr.split(key)
        angle, share = jr.uniform(k, maxval=2 * jnp.pi), e * jr.uniform(l, minval=0.5, maxval=1.5)
        c, s = jnp.cos(angle), jnp.sin(angle)
        r, v = a * (1 - share), a * rate * jnp.sqrt((1 + share) / (1 - share))
        return jnp.stack([far * a + r * c, far * a + r * s, -v * s, v * c])

    kept, scale = dict(energy=energy, momentum=momentum), a * jnp.array([1, 1, rate, rate])
    return Problem(field, kept, draw, 5 * 2 * np.pi / rate, (400, 1000), scale)


def in_leaves(base, **parts):
    """The same problem with slices of its array as leaves."""
    join = lambda y: jnp.concatenate([y[k] for k in parts])
    part = lambda y: {k: y[x] for k, x in parts.items()}
    return base._replace(
        field=lambda t, y, args: part(base.field(t, join(y), args)),
        kept={k: integral(lambda y, f=x.fn: f(0.0, join(y), None)) for k, x in base.kept.items()},
        draw=lambda key: part(base.draw(key)), scale=part(base.scale),
    )  # fmt: skip


PROBLEMS |= {
    "satellite-almost-circular": lambda: satellites(1e-3),
    "satellite-eccentric": lambda: satellites(0.3),
    "satellite-far-from-the-origin": lambda: satellites(0.1, far=1000.0),
    "satellite-in-leaves-far-from-the-origin": lambda: in_leaves(
        satellites(0.2, far=1000.0), q=slice(2), v=slice(2, 4)
    ),
}


@problem(5.0, (80, 240), lanes=6)
def spin_chain():
    """Classical spins on a ring, with an anisotropy."""
    near = lambda s: jnp.array([1.0, 1.0, 0.7]) * (jnp.roll(s, 1, 0) + jnp.roll(s, -1, 0))
    kept = dict(
        energy=integral(lambda s: -jnp.sum(s * near(s)) / 2),
        lengths=constraint(lambda s: jnp.sum(s**2, axis=1) - 1),
        total=integral(lambda s: jnp.sum(s[:, 2])),
    )
    draw = lambda key: jax.vmap(unit)(jr.split(key, 6))
    return lambda t, s, args: jnp.cross(near(s), s), kept, draw


@problem(3e-4, (200, 600), scale=jnp.array([0.5] * 3 + [5e4] * 3))
def proton_in_a_magnetic_bottle():
    """In SI, in one array. The field is without divergence; the electric one has a potential."""
    ratio, b0, length, volts = 9.5788e7, 1e-3, 0.5, -2.0

    def field(t, y, args):
        (q, v), shape = (y[:3], y[3:]), jnp.array([1.0, 1.0, -2.0])
        b = jnp.array([0.0, 0.0, 1.0]) + q[2] * q * jnp.array([-1.0, -1.0, 1.0]) / length**2
        return jnp.concatenate([v, ratio * (-volts / length**2 * q * shape + jnp.cross(v, b0 * b))])

    def momentum(y):
        flux = (y[0] ** 2 + y[1] ** 2) * (1 + y[2] ** 2 / length**2)
        return y[0] * y[4] - y[1] * y[3] + ratio * b0 / 2 * flux

    potential = lambda q: volts / length**2 * (q[0] ** 2 + q[1] ** 2 - 2 * q[2] ** 2) / 2
    energy = lambda y: y[3:] @ y[3:] / 2 + ratio * potential(y[:3])

    draw = lambda a, b: jnp.concatenate([0.2 * jr.normal(a, (3,)), 2e4 * jr.normal(b, (3,))])
    kept = dict(energy=integral(energy), momentum=integral(momentum))
    return field, kept, lambda key: draw(*jr.split(key))


@problem(6.0, (200, 600), scale=jnp.array([1.0, 6.0]))
def pendulum_from_rest():
    kept = dict(energy=integral(lambda y: y[1] ** 2 / 2 - 9.81 / 0.3 * jnp.cos(y[0])))
    draw = lambda key: jnp.stack([jr.uniform(key, minval=0.2, maxval=2.9), 0.0])
    return lambda t, y, args: jnp.stack([y[1], -9.81 / 0.3 * jnp.sin(y[0])]), kept, draw


@problem(4.0, (160, 400), scale=jnp.array([1.0, 6.0, 9.81, 0.3]))
def parameters_in_one_array():
    """A pendulum whose gravity and length are components of the state."""
    swing = lambda y: jnp.stack([y[1], -y[2] / y[3] * jnp.sin(y[0]), 0.0 * y[2], 0.0 * y[3]])
    energy = lambda y: (y[3] * y[1]) ** 2 / 2 - y[2] * y[3] * jnp.cos(y[0])

    def draw(key):
        a, b = jr.split(key)
        angle, v = jr.uniform(a, minval=0.2, maxval=2.5), jr.uniform(b, minval=-1.0, maxval=1.0)
        return jnp.stack([angle, v, 9.81, 0.3])

    return lambda t, y, args: swing(y), dict(energy=integral(energy)), draw


PROBLEMS["parameters-in-a-leaf"] = lambda: in_leaves(
    PROBLEMS["parameters-in-one-array"](), q=slice(1), v=slice(1, 2), p=slice(2, 4)
)


@problem(20.0, (200, 600))
def lotka_cycle():
    """Three species in a cycle; their sum and their product are conserved."""
    kept = dict(total=integral(jnp.sum), product=integral(lambda y: y[0] * y[1] * y[2]))
    draw = lambda key: jr.uniform(key, (3,), minval=0.1, maxval=2.0)
    return lambda t, y, args: y * (jnp.roll(y, 1) - jnp.roll(y, -1)), kept, draw


@problem(100.0, (40, 120), scale=1e5)
def epidemic():
    """Susceptible, infected, recovered people of a town."""

    def field(t, y, args):
        caught, healed = 0.4 * y[0] * y[1] / 1e5, 0.1 * y[1]
        return jnp.stack([-caught, caught - healed, healed])

    first = integral(lambda y: y[1] + y[0] - 0.1 / 0.4 * 1e5 * jnp.log(y[0]))
    draw = lambda key: jnp.array([1e5, 0.0, 0.0]) + ill(key) * jnp.array([-1.0, 1.0, 0.0])
    ill = lambda key: jr.uniform(key, minval=1.0, maxval=500.0)
    return field, dict(people=integral(jnp.sum), first=first), draw


# ---- The study ----


def times(t1):
    return jnp.linspace(0.0, t1, SAVED + 1)[1:]


def solves(made, scale, solver, fixed, settings):
    """Of all lanes at all settings: the states at the saved times, and whether each succeeded."""

    def one(y0, setting):
        if fixed:
            dt0, control, max_steps = made.t1 / setting, dfx.ConstantStepSize(), max(settings) + 1
        else:
            norm = lambda e: optx.rms_norm(jax.tree.map(lambda x, s: x / s, e, scale))
            control = dfx.PIDController(rtol=0.0, atol=setting, norm=norm)
            control = dfx.ClipStepSizeController(control, step_ts=times(made.t1))
            dt0, max_steps = made.t1 / 1000, MAX_STEPS
        sol = dfx.diffeqsolve(
            dfx.ODETerm(made.field), solver, 0.0, made.t1, dt0, y0, max_steps=max_steps,
            saveat=dfx.SaveAt(steps=True), stepsize_controller=control, throw=False,
        )  # fmt: skip
        # Steps end at the saved times, so that nothing of this depends on dense output.
        at = jnp.searchsorted(sol.ts, times(made.t1) * (1 - 1e-9))
        return jax.tree.map(lambda y: y[at], sol.ys), dfx.is_okay(sol.result)

    # One lane after the other: a solve of one trajectory is compiled faster than a batch, and no
    # lane waits for the slowest.
    lanes = lambda y0: lambda setting: jax.lax.map(lambda y: one(y, setting), y0)
    return lambda y0: jax.lax.map(lanes(y0), jnp.asarray(settings, float))


def errors(ys, okay, exact, scale):
    """The largest error of each lane; the states are at (settings, lanes, times)."""
    off = jax.tree.map(
        lambda y, x, s: np.max(np.abs(y - x) / np.asarray(s), axis=tuple(range(2, np.ndim(y)))),
        ys, exact, scale,
    )  # fmt: skip
    worst = np.max(jax.tree.leaves(off), axis=0)
    return np.where(okay, np.nan_to_num(worst, nan=np.inf), np.inf)


def study(name, made, smoke):
    """The rows of a problem: the errors of the lanes, plain and with each candidate."""
    if smoke:
        made = made._replace(lanes=2, t1=made.t1 / 10)
    y0 = jax.jit(jax.vmap(made.draw))(jr.split(jr.key(7), made.lanes))

    def truth(y):
        ts = times(made.t1)
        control = dfx.ClipStepSizeController(dfx.PIDController(rtol=1e-13, atol=1e-13), step_ts=ts)
        return dfx.diffeqsolve(
            dfx.ODETerm(made.field), dfx.Dopri8(), 0.0, made.t1, None, y, max_steps=100_000,
            saveat=dfx.SaveAt(ts=ts), stepsize_controller=control, throw=False,
        ).ys  # fmt: skip

    exact, scale = jax.jit(jax.vmap(truth))(y0), made.scale
    if scale is None:
        scale = jax.tree.map(lambda x: jnp.max(jnp.abs(x)), exact)  # over all lanes and times
    elif jax.tree.structure(scale) != jax.tree.structure(exact):
        scale = jax.tree.map(lambda x: made.scale, exact)
    cases = {"RK4": (dfc.RK4(), made.steps), "Tsit5": (dfx.Tsit5(), TOLERANCES)}
    if smoke:
        cases = {case: (solver, settings[:1]) for case, (solver, settings) in cases.items()}
        cases.pop(SMALL.get(name), None)
    found = {}
    for candidate, units in {"plain": None, **CANDIDATES}.items():
        runs = {}
        for case, (solver, settings) in cases.items():
            if candidate != "plain":
                projection = EUCLIDEAN if candidate == "Euclidean" else dfc.SimplifiedNewton()
                solver = dfc.ManifoldProjection(solver, made.kept, projection=projection)
            runs[case] = solves(made, scale, solver, case == "RK4", settings)
        # Nothing that was traced for another candidate may be found again.
        jax.clear_caches()
        own = DEFAULT if units is None else rule(units)
        with patch.object(State, "motion_after", autospec=True, side_effect=own) as used:
            out = jax.jit(lambda y0, runs=runs: {case: run(y0) for case, run in runs.items()})(y0)
        assert used.called == (candidate != "plain")
        found[candidate] = {case: errors(*x, exact, scale).tolist() for case, x in out.items()}
    for case, (_, settings) in cases.items():
        for i, setting in enumerate(settings):
            mine = {candidate: found[candidate][case][i] for candidate in CANDIDATES}
            row = dict(problem=name, solver=case, setting=setting)
            yield row | dict(plain=found["plain"][case][i], errors=mine)


def ratios(rows, candidate):
    """Of all lanes that tell something: the error over plain, infinite where the lane failed."""
    pairs = [(row["plain"], row["errors"][candidate]) for row in rows]
    plain, mine = (np.concatenate(x) for x in zip(*pairs, strict=True))
    tells = (plain > ROUNDOFF) & (plain < CHAOS)
    return mine[tells] / plain[tells]


def mean(x):
    """The geometric mean of what is finite."""
    x = x[np.isfinite(x)]
    return np.exp(np.mean(np.log(x))) if x.size else np.nan


def table(rows):
    """Each problem counts the same in the geometric mean, each lane in the rest."""
    yield "| steps | units | geometric mean | median | worst | over 1.5, % | over 3, % | failed |"
    yield "|---|---|---|---|---|---|---|---|"
    cases, names = (list(dict.fromkeys(row[k] for row in rows)) for k in ("solver", "problem"))
    for case, candidate in itertools.product(cases, CANDIDATES):
        part = [row for row in rows if row["solver"] == case]
        groups = ([row for row in part if row["problem"] == name] for name in names)
        means = [mean(ratios(group, candidate)) for group in groups if group]
        x = ratios(part, candidate)
        failed = np.sum(~np.isfinite(x))
        ok = x[np.isfinite(x)] if failed < x.size else np.array([np.nan])
        cells = [f"{value:.3g}" for value in (mean(np.array(means)), np.median(ok), max(ok))]
        cells += [f"{100 * np.mean(ok > limit):.1f}" for limit in (1.5, 3)]
        yield f"| {' | '.join((case, candidate, *cells))} | {failed} of {x.size} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="the problems whose names hold this text")
    parser.add_argument("--smoke", action="store_true", help="toy sizes")
    parser.add_argument("--out", type=Path, help="where the results are written")
    options = parser.parse_args()
    names, out, rows = [name for name in PROBLEMS if options.only in name], options.out, []
    if options.smoke and not options.only:
        names = list(SMALL)
    if out is None and not (options.only or options.smoke):
        out = RESULTS
    for name in names:
        start = time.process_time()
        new = list(study(name, PROBLEMS[name](), options.smoke))
        rows += new
        found = [ratios(new, candidate) for candidate in CANDIDATES]
        cells = [f"{mean(x):.2g}, {np.max(x, initial=0):.2g}" for x in found]
        print(name, *cells, f"({time.process_time() - start:.0f} s)", sep=" | ", flush=True)
        if out is not None:
            out.write_text(json.dumps(rows))
    print("(the geometric mean and the worst of each candidate)", *table(rows), sep="\n")


if __name__ == "__main__":
    main()
