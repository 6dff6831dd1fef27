"""What a projection costs: ns per step and trajectory, against plain solvers, a loop with
`optimistix.root_find` written by hand, and hand-written C.

Every timed answer is checked: projected ones for their drift, C's against ours. How to run and read
it: `benchmarks/README.md`.
"""

import ctypes
import math
import re
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import measuring
import numpy as np
import optimistix as optx

import diffrax_conserve as dfc

MAX_DRIFT = 18 * measuring.EPS  # of whatever is projected by this package or by C
MAX_DRIFT_BY_HAND = 4500 * measuring.EPS  # a root finder stops where a user would let it stop
MAX_DIFFERENCE = 1e-10  # between C's states and ours
MIN_STEPS = 10
CHUNK = 1_000  # lanes that are solved side by side where a batch is larger than the caches
MAX_BATCH_BY_HAND = 1_000
MAX_BATCH_TSIT5 = 1_000  # scaling.py has the larger ones
LANES = 8  # of float64 in the vectors of the C program: one AVX-512 register


class Problem(NamedTuple):
    """A system of the catalogue, the step, how to tell the C program which one it is, and what is
    measured of it."""

    system: Any
    dt: float
    define: str
    methods: tuple[str, ...] = ("RK4", "Tsit5 adaptive")
    max_batch: int = 100_000


PROBLEMS = {
    "rigid-body": Problem(dfc.systems.RigidBody(), 0.05, "-DRIGID_BODY"),
    "three-vortices": Problem(dfc.systems.PointVortices(), 0.1, "-DVORTICES=3"),
    "ten-vortices": Problem(
        dfc.systems.PointVortices([1.0] * 10), 0.02, "-DVORTICES=10", ("RK4",), 1_000
    ),
}


class Settings(NamedTuple):
    """How much is measured. Contestants take as many steps as fit into `seconds`."""

    systems: tuple[str, ...]
    batches: tuple[int, ...]
    rounds: int
    seconds: float
    horizon: float  # t1 of the adaptive solves
    check_steps: int  # after which C and we are compared


FULL = Settings(
    systems=tuple(PROBLEMS),
    batches=(1, 1_000, 100_000),
    rounds=5,
    seconds=0.2,
    horizon=100.0,
    check_steps=100,
)
SMOKE = Settings(
    systems=("rigid-body",), batches=(1, 8), rounds=2, seconds=0.01, horizon=2.0, check_steps=10
)


class Contestant(NamedTuple):
    """`run(steps) -> (states, steps made)`, compiled, and what its answers are held to."""

    run: Callable[[int], tuple[np.ndarray, int]]
    max_drift: float
    compile_seconds: float | None = None


def initial_states(problem: Problem, batch: int) -> np.ndarray:
    return np.asarray(measuring.initial_states(problem.system, batch))


def conserved(problem: Problem, y: jax.Array) -> jax.Array:
    entries = problem.system.manifold.items()
    return jfu.ravel_pytree({name: entry.fn(0.0, y, None) for name, entry in entries})[0]


# ---- The contestants ----


def solve(problem: Problem, solver: dfx.AbstractSolver, t1, y0, *, adaptive: bool):
    controller = dfx.PIDController(rtol=1e-8, atol=1e-8) if adaptive else dfx.ConstantStepSize()
    solution = dfx.diffeqsolve(
        dfx.ODETerm(problem.system.vector_field),
        solver,
        t0=0.0,
        t1=t1,
        dt0=None if adaptive else problem.dt,
        y0=y0,
        saveat=dfx.SaveAt(t1=True),
        stepsize_controller=controller,
        adjoint=dfx.ForwardMode(),
        max_steps=None,
        throw=False,
    )
    ok = solution.result == dfx.RESULTS.successful
    return jnp.where(ok, solution.ys[0], jnp.nan), solution.stats["num_accepted_steps"]


def root_find_by_hand(problem: Problem, solver: dfx.AbstractSolver, t1, y0, *, adaptive: bool):
    """What a diffrax user does without this package: step, then find the multipliers."""
    del adaptive
    term = dfx.ODETerm(problem.system.vector_field)
    target = conserved(problem, y0)
    newton = optx.Newton(rtol=MAX_DRIFT_BY_HAND, atol=MAX_DRIFT_BY_HAND / 100)

    def body(step, carry):
        y, state = carry
        t = step * problem.dt
        y, _, _, state, _ = solver.step(term, t, t + problem.dt, y, None, state, made_jump=False)
        gradients = jax.jacrev(lambda y: conserved(problem, y))(y)

        def displaced(multipliers):
            return y + jnp.tensordot(multipliers, gradients, axes=1)

        solution = optx.root_find(
            lambda multipliers, _: conserved(problem, displaced(multipliers)) - target,
            newton,
            jnp.zeros_like(target),
            max_steps=20,
            throw=False,
        )
        return displaced(solution.value), state

    steps = jnp.round(t1 / problem.dt).astype(int)
    start = y0, solver.init(term, 0.0, problem.dt, y0, None)
    return jax.lax.fori_loop(0, steps, body, start)[0], steps


def compiled(
    method: Callable[..., Any],
    problem: Problem,
    solver: dfx.AbstractSolver,
    start: np.ndarray,
    max_drift: float = math.inf,
    *,
    adaptive: bool = False,
    chunk: int | None = None,
) -> Contestant:
    """`method` for the batch `start`; alone it is compiled without a batch axis."""

    def one(t1, y0):
        return method(problem, solver, t1, y0, adaptive=adaptive)

    alone = len(start) == 1
    y0 = jnp.asarray(start[0] if alone else start)

    def many(t1, y0s):
        return jax.lax.map(partial(one, t1), y0s, batch_size=chunk or len(start))

    function, seconds = measuring.compiled(one if alone else many, 1.0, y0)

    def run(steps: int) -> tuple[np.ndarray, int]:
        states, made = jax.block_until_ready(function(steps * problem.dt, y0))
        return np.asarray(states).reshape(start.shape), int(jnp.sum(made)) // jnp.size(made)

    return Contestant(run, max_drift, seconds)


def hand_written_c(problem: Problem, start: np.ndarray) -> dict[str, Contestant]:
    """Compiled on the spot; nothing where there is no compiler, or where it would be no match."""
    if measuring.suffix():
        return {}
    lanes = 1 if len(start) == 1 else LANES
    source = measuring.HERE / "projected_rk4.c"
    library = measuring.c_library(source, problem.define, f"-DLANES={lanes}")
    if library is None:
        return {}
    integrate = library.integrate
    pointer = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")
    integrate.argtypes = [pointer, ctypes.c_long, ctypes.c_long, ctypes.c_double, ctypes.c_int]
    integrate.restype = None

    def contestant(projected: bool) -> Contestant:
        def run(steps: int) -> tuple[np.ndarray, int]:
            states = start.copy()
            integrate(states, len(start), steps, problem.dt, projected)
            return states, steps

        return Contestant(run, MAX_DRIFT if projected else math.inf)

    return {"plain, C": contestant(False), "projected, C": contestant(True)}


def fixed_step_contestants(
    problem: Problem, solver: dfx.AbstractSolver, start: np.ndarray
) -> dict[str, Contestant]:
    nearest = dfc.SimplifiedNewton(metric=1.0)  # as by hand and in C
    projected = dfc.ManifoldProjection(solver, problem.system.manifold, projection=nearest)
    contestants = {
        "plain": compiled(solve, problem, solver, start),
        "projected": compiled(solve, problem, projected, start, MAX_DRIFT),
    }
    if len(start) > 10 * CHUNK:
        contestants["projected, by thousands"] = compiled(
            solve, problem, projected, start, MAX_DRIFT, chunk=CHUNK
        )
    if len(start) <= MAX_BATCH_BY_HAND:
        by_hand = compiled(root_find_by_hand, problem, solver, start, MAX_DRIFT_BY_HAND)
        contestants["root_find by hand"] = by_hand
    if isinstance(solver, dfc.RK4):
        contestants |= hand_written_c(problem, start)
    return contestants


def adaptive_contestants(
    problem: Problem, solver: dfx.AbstractSolver, start: np.ndarray
) -> dict[str, Contestant]:
    projected = dfc.ManifoldProjection(solver, problem.system.manifold)
    return {
        "plain": compiled(solve, problem, solver, start, adaptive=True),
        "projected": compiled(solve, problem, projected, start, MAX_DRIFT, adaptive=True),
    }


# ---- Checking and timing ----


def check_states(contestants: dict[str, Contestant], steps: int) -> None:
    """Raises unless the C program computes what we compute."""
    for name in ("plain", "projected"):
        if f"{name}, C" in contestants:
            ours, _ = contestants[name].run(steps)
            theirs, _ = contestants[f"{name}, C"].run(steps)
            difference = np.max(np.abs(ours - theirs))
            if not difference <= MAX_DIFFERENCE:
                raise AssertionError(f"{name}: C and we differ by {difference:.1e}")


def steps_within(contestant: Contestant, seconds: float) -> int:
    """How many steps fit into `seconds`, but at least so many that a solve's start is no matter."""
    steps = MIN_STEPS
    contestant.run(steps)  # the first run is slower
    while True:
        duration, (_, made) = measuring.timed(partial(contestant.run, steps))
        if duration > seconds / 4:
            return max(MIN_STEPS, round(made * seconds / duration))
        steps *= 4


def measure(
    problem: Problem,
    contestants: dict[str, Contestant],
    start: np.ndarray,
    settings: Settings,
    horizon: float | None = None,
) -> dict[str, dict[str, Any]]:
    """One row per contestant: its best round, with the drift of the states that were timed."""
    steps = {
        name: steps_within(c, settings.seconds) if horizon is None else round(horizon / problem.dt)
        for name, c in contestants.items()
    }
    rounds = settings.rounds if horizon is None else 4 * settings.rounds  # shorter ones
    runs = {name: partial(c.run, steps[name]) for name, c in contestants.items()}
    rows = {}
    for name, (seconds, (states, made)) in measuring.take_turns(runs, rounds).items():
        drift = measuring.largest_drift(problem.system, start, states)
        if not (drift <= contestants[name].max_drift and np.all(np.isfinite(states))):
            raise AssertionError(f"{name}: the drift after {made} steps is {drift:.1e}")
        rows[name] = dict(
            ns=seconds / made / len(start) * 1e9,
            seconds=seconds,
            steps=made,
            drift=drift,
            compile_seconds=contestants[name].compile_seconds,
        )
    return rows


RATIOS = {
    "projected / plain": ("projected", "plain"),
    "projected / C": ("projected", "projected, C"),
    "projected, by thousands / C": ("projected, by thousands", "projected, C"),
    "root_find by hand / projected": ("root_find by hand", "projected"),
}


def table(name: str, problem: Problem, method: str, batch: int, settings: Settings) -> dict:
    start = initial_states(problem, batch)
    solver = dfc.RK4() if method == "RK4" else dfx.Tsit5()
    if method.endswith("adaptive"):
        contestants = adaptive_contestants(problem, solver, start)
        rows = measure(problem, contestants, start, settings, settings.horizon)
    else:
        contestants = fixed_step_contestants(problem, solver, start)
        check_states(contestants, settings.check_steps)
        rows = measure(problem, contestants, start, settings)
    ratios = {
        label: rows[a]["ns"] / rows[b]["ns"]
        for label, (a, b) in RATIOS.items()
        if a in rows and b in rows
    }
    compilation = [rows[name]["compile_seconds"] for name in ("projected", "plain")]
    ratios["compilation, projected / plain"] = compilation[0] / compilation[1]
    return dict(system=name, method=method, batch=batch, dt=problem.dt, rows=rows, ratios=ratios)


# ---- Reporting ----


def print_table(result: dict[str, Any]) -> None:
    print(f"\n{result['system']}, {result['method']}, batch of {result['batch']:,}")
    columns = (
        f"  {'':18} {'ns/step':>11} {'run (s)':>9} {'steps':>9} {'drift':>9} {'compile (s)':>12}"
    )
    print(columns)
    for name, row in result["rows"].items():
        compilation = row["compile_seconds"]
        print(
            f"  {name:18} {row['ns']:11,.1f} {row['seconds']:9.4f} {row['steps']:9,d} "
            f"{row['drift']:9.1e} " + ("" if compilation is None else f"{compilation:12.2f}")
        )
    print("  " + "; ".join(f"{label} {ratio:.2f}" for label, ratio in result["ratios"].items()))


def main(argv: list[str] | None = None) -> list[dict[str, Any]]:
    options = measuring.parser(__doc__, "overhead").parse_args(argv)
    settings = SMOKE if options.smoke else FULL
    about = measuring.machine()
    measuring.print_machine(about)
    print("ns/step: per step and trajectory; best of", settings.rounds, "rounds")
    jax.jit(lambda x: x + 1).lower(1.0).compile()  # the first compilation also loads the compiler
    results = []
    for name in settings.systems:
        problem = PROBLEMS[name]
        for method in problem.methods:
            for batch in settings.batches:
                largest = problem.max_batch if method == "RK4" else MAX_BATCH_TSIT5
                if batch <= largest and re.search(options.only, f"{name} {method} {batch}"):
                    results.append(table(name, problem, method, batch, settings))
                    print_table(results[-1])
    measuring.write(options, about, tables=results)
    return results


if __name__ == "__main__":
    main()
