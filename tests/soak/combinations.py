"""Attack: random combinations of everything, in search of one that is wrong.

A program is compiled for each static choice (system, constraints, solver, controller, projection,
save mode, precision) and run on a batch of lanes, each with its own numbers (initial state, frame,
direction and length of time, step size or tolerance). A lane is one combination. It is right if
the solve says that it failed, or else if the state is finite, all constraints hold to 32 units of
roundoff at every saved and interpolated time, and the solution is as close to a reference as its
tolerance asks for. Every program draws from `(seed, program)` alone, so each can be run again.
"""

import dataclasses
import functools
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_conserve as dfc
from diffrax_conserve.testing import QuadraticSystem
from diffrax_conserve.testing._conserved import ULPS, measure
from diffrax_conserve.testing._quadratic import _alternating, _definite

from .oracle import Tally

LANES, TIMEOUT = 100, 1200
MAX_STEPS = 256
NUM_TIMES = 7

# Solver and order.
EXPLICIT = {
    "Euler": (dfx.Euler(), 1),
    "Heun": (dfx.Heun(), 2),
    "Midpoint": (dfx.Midpoint(), 2),
    "Ralston": (dfx.Ralston(), 2),
    "Bosh3": (dfx.Bosh3(), 3),
    "Tsit5": (dfx.Tsit5(), 5),
    "Dopri5": (dfx.Dopri5(), 5),
    "Dopri8": (dfx.Dopri8(), 8),
    "ReversibleHeun": (dfx.ReversibleHeun(), 2),
}
FIXED_ONLY = {"RK4": (dfc.RK4(), 4), "LeapfrogMidpoint": (dfx.LeapfrogMidpoint(), 2)}
HALVED = {"HalfSolver(RK4)": (dfx.HalfSolver(dfc.RK4()), 4)}
IMPLICIT = {
    "ImplicitEuler": (dfx.ImplicitEuler(), 1),
    "Kvaerno3": (dfx.Kvaerno3(), 3),
    "Kvaerno5": (dfx.Kvaerno5(), 5),
}
IMEX = {"KenCarp3": (dfx.KenCarp3(), 3)}
SYMPLECTIC = {"SemiImplicitEuler": (dfx.SemiImplicitEuler(), 1)}
SOLVERS = EXPLICIT | FIXED_ONLY | HALVED | IMPLICIT | IMEX | SYMPLECTIC

# Where `q'` depends on `p` alone and `p'` on `q` alone, and the state is `(q, p)`.
SEPARABLE = {"kepler", "outer-solar-system", "henon-heiles", "toda-lattice"}
QUADRATIC = {"quadratic": (4, 1), "quadratic pair": (4, 2)}
SYSTEMS = [*dfc.systems.names(), *QUADRATIC]
MODES = ["ts", "steps", "t1", "dense", "all"]


@dataclasses.dataclass(frozen=True)
class Program:
    """The static choices."""

    system: str
    entries: tuple[str, ...]
    solver: str
    adaptive: bool
    newton: bool
    mode: str
    single: bool

    def __str__(self) -> str:
        words = [
            self.system,
            "[" + ", ".join(self.entries) + "]",
            self.solver,
            "PID" if self.adaptive else "fixed",
            "Newton" if self.newton else "SimplifiedNewton",
            self.mode,
            "float32" if self.single else "float64",
        ]
        return " | ".join(words)


def draw_program(seed: int, number: int) -> Program:
    rng = np.random.default_rng([seed, number])
    # In turn, so that a short run has every system.
    system = SYSTEMS[(seed + number) % len(SYSTEMS)]
    names = list(manifold_names(system))
    entries = list(rng.permutation(names)[: rng.integers(1, len(names) + 1)])
    # More scalar constraints than unknowns are refused, so few are duplicated.
    if rng.random() < 0.25 and system not in ("outer-solar-system", "quadratic pair"):
        entries.append(rng.choice(entries))
        entries = list(rng.permutation(entries))
    groups = [EXPLICIT, EXPLICIT, EXPLICIT, FIXED_ONLY, HALVED, IMPLICIT, IMEX]
    if system in SEPARABLE:
        groups.append(SYMPLECTIC)
    solver = rng.choice(list(groups[rng.integers(len(groups))]))
    adaptive = solver not in FIXED_ONLY | SYMPLECTIC and rng.random() < 0.65
    adaptive = adaptive and solver != "Euler"
    return Program(
        system,
        tuple(map(str, entries)),
        str(solver),
        bool(adaptive),
        # With 36 unknowns the nearest point takes minutes in a batch.
        bool(rng.random() < 0.15) and system != "outer-solar-system",
        str(rng.choice(MODES)),
        bool(rng.random() < 0.3),
    )


@functools.cache
def manifold_names(system: str) -> tuple[str, ...]:
    return ("quadratic",) if system in QUADRATIC else tuple(dfc.systems.get(system).manifold)


def draw_systems(name: str, rng: np.random.Generator, lanes: int) -> tuple[Any, Any]:
    """For each lane a system and an initial state, in float64."""
    if name not in QUADRATIC:
        system = dfc.systems.get(name)
        keys = jr.split(jr.key(int(rng.integers(2**31))), lanes)
        batch = jax.tree.map(lambda x: jnp.broadcast_to(x, (lanes, *jnp.shape(x))), system)
        return batch, sample(system, keys)
    n, integrals = QUADRATIC[name]
    count = {1: 6, 2: 4}[integrals]  # increasing indices
    systems = [
        QuadraticSystem(
            _definite(rng.uniform(-0.5, 0.5, (integrals, n, n))),
            _alternating(rng.uniform(-1, 1, count), n, integrals + 1),
            rng.uniform(-2, 2, n),
        )
        for _ in range(lanes)
    ]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *systems)
    return batch, batch.y0


@eqx.filter_jit
def sample(system: Any, keys: jax.Array) -> Any:
    return jax.vmap(system.sample)(keys)


class Lane(eqx.Module):
    """The numbers of one combination, or of a batch of them."""

    system: Any
    y0: Any
    velocity: Any  # of the frame: it makes the equation and its integrals depend on time
    t0: Any
    span: Any  # negative: backwards in time
    dt0: Any
    tolerance: Any
    fractions: Any  # of the span, where to save or interpolate
    pcoeff: Any
    icoeff: Any


def draw_lanes(program: Program, seed: int, number: int, lanes: int) -> Lane:
    rng = np.random.default_rng([seed, number, 1])
    system, y0 = draw_systems(program.system, rng, lanes)
    unit = 0.1 if program.system in QUADRATIC else dfc.systems.get(program.system).dt
    _, order = SOLVERS[program.solver]

    def log_uniform(low: float, high: float) -> np.ndarray:
        return np.exp(rng.uniform(np.log(low), np.log(high), lanes))

    dt0 = unit * log_uniform(0.02, 0.5)
    if program.adaptive:
        span = unit * rng.uniform(2, 20, lanes)
        tolerance = log_uniform(*tolerance_range(order, program.single))
    else:
        # At most as many steps as fit, with room for one more by roundoff.
        span = dt0 * rng.uniform(2, 150, lanes)
        tolerance = np.ones(lanes)
    moving = rng.random(lanes) < 0.5
    scale = jax.tree.map(lambda y: np.mean(np.abs(y)) / (10 * unit), y0)
    velocity = jax.tree.map(
        lambda y, s: rng.normal(size=y.shape) * s * moving.reshape(-1, *[1] * (y.ndim - 1)),
        y0,
        scale,
    )
    batch = Lane(
        system=system,
        y0=y0,
        velocity=velocity,
        t0=unit * rng.uniform(-5, 5, lanes) * (rng.random(lanes) < 0.7),
        span=span * rng.choice([-1, 1], lanes),
        dt0=dt0,
        tolerance=tolerance,
        fractions=np.sort(rng.uniform(0, 1, (lanes, NUM_TIMES)), axis=1),
        pcoeff=rng.choice([0.0, 0.2, 0.4], lanes),
        icoeff=rng.choice([0.3, 1.0], lanes),
    )
    dtype = jnp.float32 if program.single else jnp.float64
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), batch)


def tolerance_range(order: int, single: bool) -> tuple[float, float]:
    """What `MAX_STEPS` steps can usually reach."""
    lowest = {1: 1e-3, 2: 1e-5, 3: 1e-6}.get(order, 1e-9)
    return (max(lowest, 3e-5), 3e-3) if single else (lowest, 3e-3)


def moved(y: Any, velocity: Any, t: Any) -> Any:
    return jax.tree.map(lambda a, c: a + c * t, y, velocity)


def still(y: Any, velocity: Any, t: Any) -> Any:
    return jax.tree.map(lambda a, c: a - c * t, y, velocity)


def moving_manifold(program: Program, system: Any) -> list[Any]:
    """In a moving frame, whose velocity is `args`."""

    def seen(entry: Any) -> Any:
        return type(entry)(lambda t, z, args: entry.fn(t, still(z, args, t), None))

    return [seen(system.manifold[name]) for name in program.entries]


def terms_of(program: Program, lane: Lane) -> Any:
    def vector_field(t: Any, z: Any, args: Any) -> Any:
        slope = lane.system.vector_field(t, still(z, args, t), None)
        return jax.tree.map(jnp.add, slope, args)

    if program.solver in IMEX:
        half = dfx.ODETerm(
            lambda t, z, args: jax.tree.map(lambda x: x / 2, vector_field(t, z, args))
        )
        return dfx.MultiTerm(half, half)
    if program.solver in SYMPLECTIC:
        q, p = lane.y0
        return (
            dfx.ODETerm(lambda t, p, args: vector_field(t, (q, p), args)[0]),
            dfx.ODETerm(lambda t, q, args: vector_field(t, (q, p), args)[1]),
        )
    return dfx.ODETerm(vector_field)


class Outcome(eqx.Module):
    okay: Any
    steps: Any
    finite: Any
    ratio: Any  # the largest residual over what is allowed
    states: Any  # at `fractions`, where they are saved, and at the end
    end: Any


def run_lane(program: Program, lane: Lane) -> Outcome:
    inner, _ = SOLVERS[program.solver]
    if program.solver in IMPLICIT | IMEX and not program.adaptive:
        # Adaptive steps hand their own tolerances on. (With tighter ones diffrax's chord iteration
        # takes its own roundoff for divergence.)
        chord = dfx.VeryChord(rtol=1e-3, atol=1e-6)
        inner = eqx.tree_at(lambda s: s.root_finder, inner, chord)
    projection = dfc.Newton() if program.newton else dfc.SimplifiedNewton()
    manifold = moving_manifold(program, lane.system)
    t1 = lane.t0 + lane.span
    ts = jnp.clip(
        lane.t0 + lane.fractions * lane.span, jnp.minimum(lane.t0, t1), jnp.maximum(lane.t0, t1)
    )
    z0 = moved(lane.y0, lane.velocity, lane.t0)
    atol = lane.tolerance * jnp.mean(jnp.abs(jnp.concatenate([x.ravel() for x in leaves(lane.y0)])))
    pid = dfx.PIDController(lane.tolerance, atol, pcoeff=lane.pcoeff, icoeff=lane.icoeff)
    sol = dfx.diffeqsolve(
        terms_of(program, lane),
        dfc.ManifoldProjection(inner, manifold, projection=projection),
        lane.t0,
        t1,
        lane.dt0 * jnp.sign(lane.span),
        z0,
        lane.velocity,
        saveat=save_mode(program.mode, ts),
        stepsize_controller=pid if program.adaptive else dfx.ConstantStepSize(),
        max_steps=MAX_STEPS,
        throw=False,
    )
    kinds, states = collect(program.mode, sol, ts, z0)
    ratios, finites = [], []
    for times, zs in kinds:
        got = measure(manifold, None, (times, zs, lane.t0, z0), lane.velocity)
        finites.append(jnp.all(got.finite))
        eps = max(jnp.finfo(x.dtype).eps for x in leaves(zs))
        for g, s in zip(leaves(got.residual), leaves(got.scale), strict=True):
            # NaN propagates through `max`.
            ratios.append(jnp.max(jnp.where(g == 0, 0, jnp.abs(g) / (ULPS * eps * s))))
    end = jax.tree.map(lambda x: x[-1], states)
    return Outcome(
        okay=sol.result == dfx.RESULTS.successful,
        steps=sol.stats["num_steps"],
        finite=jnp.all(jnp.stack(finites)),
        ratio=jnp.max(jnp.stack(ratios)),
        states=states,
        end=end,
    )


leaves = jax.tree.leaves


def save_mode(mode: str, ts: Any) -> dfx.SaveAt:
    if mode == "ts":
        return dfx.SaveAt(t0=True, ts=ts, t1=True)
    if mode == "steps":
        return dfx.SaveAt(t0=True, steps=True)
    if mode == "t1":
        return dfx.SaveAt(t1=True)
    if mode == "dense":
        return dfx.SaveAt(dense=True, t1=True)
    subs = [dfx.SubSaveAt(ts=ts, t1=True), dfx.SubSaveAt(t0=True, steps=True)]
    return dfx.SaveAt(subs=subs, dense=True)


def collect(mode: str, sol: dfx.Solution, ts: Any, z0: Any) -> tuple[list[Any], Any]:
    """All that is to lie on the manifold, and the states that are compared with the reference."""

    def last(times: Any, zs: Any) -> Any:
        index = jnp.sum(~jnp.isinf(times)) - 1
        return jax.tree.map(lambda x: x[index][None], zs)

    if mode in ("ts", "t1"):
        drop = 1 if mode == "ts" else 0
        return [(sol.ts, sol.ys)], jax.tree.map(lambda x: x[drop:], sol.ys)
    if mode == "steps":
        return [(sol.ts, sol.ys)], last(sol.ts, sol.ys)
    dense = jax.vmap(sol.evaluate)(ts)
    if mode == "dense":
        return [(sol.ts, sol.ys), (ts, dense)], jax.tree.map(
            lambda a, b: jnp.concatenate([a, b]), dense, sol.ys
        )
    pairs = list(zip(sol.ts, sol.ys, strict=True))
    return [*pairs, (ts, dense)], sol.ys[0]


@eqx.filter_jit
def run_batch(program: Program, lanes: Lane) -> Outcome:
    return eqx.filter_vmap(lambda lane: run_lane(program, lane))(lanes)


@eqx.filter_jit
def reference(systems: Any, y0s: Any, times: Any) -> Any:
    """States at `times` counted from the initial state, with neither frame nor projection."""

    def solve(system: Any, y0: Any, ts: Any) -> Any:
        scale = jnp.max(jnp.abs(jnp.concatenate([x.ravel() for x in leaves(y0)])))
        return dfx.diffeqsolve(
            dfx.ODETerm(lambda t, y, args: system.vector_field(t, y, None)),
            dfx.Dopri8(),
            0.0,
            ts[-1],
            None,
            y0,
            saveat=dfx.SaveAt(ts=ts),
            stepsize_controller=dfx.ClipStepSizeController(
                dfx.PIDController(rtol=1e-12, atol=1e-14 * scale), step_ts=ts
            ),
            max_steps=10**5,
            throw=False,
        ).ys

    return eqx.filter_vmap(solve)(systems, y0s, times)


def errors(program: Program, lanes: Lane, outcome: Outcome) -> tuple[np.ndarray, np.ndarray]:
    """The largest error of each lane relative to the size of its state, and how much a small
    change of the initial state grows."""
    double = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), lanes)
    fractions = jnp.concatenate([double.fractions, jnp.ones_like(double.fractions[:, :1])], axis=1)
    elapsed = fractions * double.span[:, None]
    rng = np.random.default_rng(0)
    shaken = jax.tree.map(lambda y: y * (1 + 1e-7 * rng.normal(size=y.shape)), double.y0)
    exact = reference(double.system, double.y0, elapsed)
    other = reference(double.system, shaken, elapsed)
    compared = leaves(outcome.states)[0].shape[1]
    times = double.t0[:, None] + elapsed

    def worst(trees: list[Any]) -> np.ndarray:
        rows = [np.max(np.abs(np.asarray(x)), axis=tuple(range(1, x.ndim))) for x in trees]
        return np.max(np.stack(rows), axis=0)

    def frame(y: Any, c: Any) -> Any:
        expand = [1] * (y.ndim - 2)
        return y + c[:, None] * times.reshape(*times.shape, *expand)

    seen = jax.tree.map(frame, exact, double.velocity)
    gaps = [a - b[:, -compared:] for a, b in zip(leaves(outcome.states), leaves(seen), strict=True)]
    # The roundoff of the frame's displacement counts as size of the state.
    size = worst(leaves(exact))
    growth = worst([a - b for a, b in zip(leaves(exact), leaves(other), strict=True)]) / (
        worst([a - b for a, b in zip(leaves(double.y0), leaves(shaken), strict=True)])
    )
    return worst(gaps) / size, np.maximum(growth, 1)


def allowed(program: Program, lanes: Lane, outcome: Outcome, growth: np.ndarray) -> np.ndarray:
    """The error that is still right: infinite where no tolerance was asked for.

    A step errs by its tolerance, and by a multiple of it between nodes; errors add up and grow.
    """
    steps = np.asarray(outcome.steps)
    eps = np.finfo(np.float32 if program.single else np.float64).eps
    roundoff = 100 * eps * np.maximum(steps, 10)
    if not program.adaptive:
        _, order = SOLVERS[program.solver]
        unit = 0.1 if program.system in QUADRATIC else dfc.systems.get(program.system).dt
        fine = np.asarray(lanes.dt0) <= 0.1 * unit
        return np.where(fine & (order >= 4), 1e-2 * growth + roundoff * growth, np.inf)
    return 100 * growth * (np.asarray(lanes.tolerance) * np.maximum(steps, 10)) + roundoff * growth


@dataclasses.dataclass
class Verdict:
    failed: np.ndarray
    wrong: dict[int, str]
    worst_ratio: float
    worst_error: float


def judge(program: Program, lanes: Lane, outcome: Outcome) -> Verdict:
    okay, finite = np.asarray(outcome.okay), np.asarray(outcome.finite)
    ratio = np.asarray(outcome.ratio)
    error, growth = errors(program, lanes, outcome)
    limit = allowed(program, lanes, outcome, growth)
    wrong = {}
    for i in np.flatnonzero(okay):
        if not finite[i]:
            wrong[int(i)] = "success, but a state is not finite"
        elif not ratio[i] <= 1:
            wrong[int(i)] = f"success, but a residual is {ULPS * ratio[i]:.3g} units of roundoff"
        elif not error[i] <= limit[i]:
            wrong[int(i)] = f"success, but the error is {error[i]:.2e}, allowed {limit[i]:.2e}"
    kept = okay & np.isfinite(limit)
    return Verdict(
        ~okay,
        wrong,
        float(np.max(ratio[okay], initial=0.0)),
        float(np.max((error / limit)[kept], initial=0.0)),
    )


def show(lane: Lane, outcome: Outcome, index: int) -> str:
    one = jax.tree.map(lambda x: np.asarray(x)[index], (lane, outcome))
    fields = {**vars(one[0]), "steps": one[1].steps, "end": one[1].end}
    return "\n".join(
        f"      {name} = {jax.tree.map(np.asarray, value)}" for name, value in fields.items()
    )


def run(seed: int, number: int, lanes: int) -> Tally:
    program = draw_program(seed, number)
    batch = draw_lanes(program, seed, number, lanes)
    outcome = run_batch(program, batch)
    verdict = judge(program, batch, outcome)
    tally = Tally(lanes, lanes - int(verdict.failed.sum()))
    for index, reason in verdict.wrong.items():
        tally.wrong[reason.split(" is ")[0]] += 1
        if not tally.examples:
            tally.examples.append(f"{program}: {reason}\n{show(batch, outcome, index)}")
    return tally
