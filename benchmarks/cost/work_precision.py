"""Error against time: plain and projected solvers of diffrax, scipy, homproj, heyoka and CVODE.

1. One trajectory of a rigid body and of a Kepler orbit, to t = 100, over a range of tolerances.
2. A batch of rigid bodies.
3. A batch of Kepler orbits that need different numbers of steps and iterations, against each alone.

Every timed answer is judged at t = 100: its error against the exact solution, and its drift. How
to read it, and what is left out where something is not installed: `benchmarks/README.md`.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.random as jr
import measuring
import numpy as np
import peers
from curves import MAX_DRIFT, T1, Contestant, curves, diffeqsolve, flattened, ours, times_to

import diffrax_conserve as dfc

SYSTEMS = {"rigid-body": dfc.systems.RigidBody(), "kepler": dfc.systems.Kepler()}


class Settings(NamedTuple):
    """How much is measured."""

    systems: tuple[str, ...]  # of which one trajectory is solved
    rounds: int
    tolerances: tuple[float, ...]
    batch_tolerances: tuple[float, ...]
    trajectories: int  # in the batch of rigid bodies
    lanes: int  # in the batch of unlike orbits
    solvers: tuple[dfx.AbstractSolver, ...] = (dfx.Tsit5(), dfx.Dopri8())
    of_a_batch: int | None = None  # contestants; all if it is `None`


FULL = Settings(
    systems=tuple(SYSTEMS),
    rounds=4,
    tolerances=tuple(10.0 ** (-k / 2) for k in range(10, 26)),
    batch_tolerances=(1e-8, 1e-9, 1e-10, 1e-11),
    trajectories=1_000,
    lanes=100,
)
SMOKE = Settings(
    systems=("rigid-body",),
    rounds=1,
    tolerances=(1e-6, 1e-10),
    batch_tolerances=(1e-8, 1e-10),
    trajectories=4,
    lanes=2,
    solvers=(dfx.Tsit5(),),
    of_a_batch=2,
)


# ---- The three parts ----


def one_trajectory(name: str, settings: Settings) -> dict[str, Any]:
    system, tolerances = SYSTEMS[name], settings.tolerances
    equations = peers.EQUATIONS[name]
    contestants = {}
    for solver in settings.solvers:
        label = type(solver).__name__
        projected = dfc.ManifoldProjection(solver, system.manifold)
        contestants[f"plain {label}"] = ours(system, solver, 1, tolerances)
        contestants[f"projected {label}"] = ours(system, projected, 1, tolerances)
        unrolled = dfc.ManifoldProjection(dfc.Unrolled(solver), system.manifold)
        contestants[f"projected {label}, unrolled"] = ours(system, unrolled, 1, tolerances)
    # heyoka's errors get down to roundoff; the Python programs are slow.
    few = tolerances[::2] if len(tolerances) > 4 else tolerances
    others = {
        "CVODE, Adams": (peers.cvode(equations, T1, projected=False), tolerances),
        "CVODE, BDF with projection": (peers.cvode(equations, T1, projected=True), tolerances),
        "scipy DOP853": (peers.scipy_dop853(equations, T1), few),
        "homproj DOP853": (peers.homproj(equations, T1), few),
    }
    contestants |= {label: Contestant(*x) for label, x in others.items() if x[0] is not None}
    contestants |= heyoka(name, (*tolerances, 1e-14))
    return part(name, system, contestants, 1, settings.rounds, error=1e-6)


def batch(settings: Settings) -> dict[str, Any]:
    system, lanes = SYSTEMS["rigid-body"], settings.trajectories
    tolerances = settings.batch_tolerances

    def projected(solver: dfx.AbstractSolver, values: tuple[float, ...], adaptive: bool = True):
        solver = dfc.ManifoldProjection(solver, system.manifold)
        return ours(system, solver, lanes, values, adaptive=adaptive)

    finer = (*tolerances, 1e-12)
    contestants = {
        "plain Dopri8": ours(system, dfx.Dopri8(), lanes, finer),
        "projected Dopri8": projected(dfx.Dopri8(), tolerances),
        "projected Tsit5": projected(dfx.Tsit5(), tolerances),
        "projected Dopri8, unrolled": projected(dfc.Unrolled(dfx.Dopri8()), finer),
        "projected Tsit5, unrolled": projected(dfc.Unrolled(dfx.Tsit5()), finer),
        "projected Dopri8, fixed steps": projected(dfx.Dopri8(), (1_500, 2_000, 3_000), False),
        "projected Tsit5, fixed steps": projected(dfx.Tsit5(), (5_000, 10_000, 20_000), False),
        "projected RK4, fixed steps": projected(dfc.RK4(), (40_000, 80_000, 160_000), False),
    }
    contestants = dict(list(contestants.items())[: settings.of_a_batch])
    for width in (8, 16):
        contestants |= heyoka("rigid-body", (*tolerances, 1e-12, 1e-13, 1e-14), width)
    return part("rigid-body", system, contestants, lanes, settings.rounds, error=1e-9)


def heyoka(name: str, tolerances: tuple[float, ...], width: int = 1) -> dict[str, Contestant]:
    make = partial(peers.heyoka, peers.EQUATIONS[name], T1, tolerances, width)
    seconds, solve = measuring.timed(make)
    label = "heyoka" if width == 1 else f"heyoka, {width} at a time"
    return {} if solve is None else {label: Contestant(solve, tolerances, seconds)}


def part(
    name: str,
    system: Any,
    contestants: Mapping[str, Contestant],
    trajectories: int,
    rounds: int,
    error: float,
) -> dict[str, Any]:
    start = measuring.initial_states(system, trajectories)
    found = curves(system, contestants, start, rounds)
    return dict(
        system=name,
        trajectories=trajectories,
        target=error,
        curves=found,
        times=times_to(found, error),
        compile_seconds={label: x.compile_seconds for label, x in contestants.items()},
    )


def unlike_lanes(settings: Settings) -> dict[str, Any]:
    """Sampled Kepler orbits, adaptive, at a tolerance at which the projections need few to many
    iterations: seconds per trajectory in the batch and alone, plain and projected.

    A batch of adaptive solves goes on until its last lane has arrived, so the plain one, too, costs
    more than the mean of its lanes.
    """
    system, lanes, tolerance = SYSTEMS["kepler"], settings.lanes, 1e-4
    starts = jax.vmap(system.sample)(jr.split(jr.key(0), lanes))
    flat = flattened(starts)
    projected = dfc.ManifoldProjection(dfx.Tsit5(), system.manifold)
    runs: dict[Any, Callable[[], Any]] = {}
    for name, solver in {"plain": dfx.Tsit5(), "projected": projected}.items():
        alone = ours(system, solver, 1, (tolerance,))
        together = ours(system, solver, lanes, (tolerance,))
        runs[name, "batch"] = partial(together.solve, tolerance, flat)
        for i in range(lanes):
            runs[name, i] = partial(alone.solve, tolerance, flat[i : i + 1])
    best = measuring.take_turns(runs, settings.rounds)
    steps, iterations, ends = _effort(system, projected, starts, tolerance)
    if not np.all(np.isfinite(ends)):
        raise AssertionError("an orbit failed")
    for answer in (
        best["projected", "batch"].answer,
        np.concatenate([best["projected", i].answer for i in range(lanes)]),
    ):
        np.testing.assert_allclose(answer, ends, rtol=1e-6)
    found = dict(lanes=lanes, tolerance=tolerance, steps=_spread(steps))
    found["iterations of the longest projection"] = _spread(iterations)
    for name in ("plain", "projected"):
        each = float(np.mean([best[name, i].seconds for i in range(lanes)]))
        found[name] = {"batch": best[name, "batch"].seconds / lanes, "alone": each}
    return found


def _effort(system: Any, solver: dfx.AbstractSolver, starts: Any, tolerance: float) -> list[Any]:
    """The steps of each lane, the iterations of its longest projection, its final state."""

    def one(y0: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
        solution = diffeqsolve(system, solver, y0, tolerance, solver_state=True)
        iterations = dfc.statistics(solution).max_iterations
        return solution.stats["num_steps"], iterations, jfu.ravel_pytree(solution.ys)[0]

    return [np.asarray(x) for x in jax.jit(jax.vmap(one))(starts)]


def _spread(x: np.ndarray) -> list[float]:
    return [float(np.min(x)), float(np.mean(x)), float(np.max(x))]


# ---- Reporting ----


def milliseconds(seconds: float | None) -> str:
    return "not reached" if seconds is None else f"{1e3 * seconds:.4g}"


def print_part(result: dict[str, Any]) -> None:
    count, target = result["trajectories"], result["target"]
    print(f"\n{result['system']}, {count:,} trajectories: ms per trajectory, error, drift")
    for name, rows in result["curves"].items():
        compilation = result["compile_seconds"][name]
        print(f"  {name}" + (f", compiled in {compilation:.1f} s" if compilation else ""))
        for row in rows:
            print(
                f"    {row['setting']:8.1e} {1e3 * row['seconds']:10.4f} "
                f"{row['error']:8.1e} {row['drift']:8.1e}"
            )
    print(f"  ms to error {target:.0e}; and drift below {MAX_DRIFT:.0e}")
    for name, times in result["times"].items():
        both = milliseconds(times["error and drift"])
        print(f"    {name:30} {milliseconds(times['error']):>11} {both:>11}", flush=True)


def print_unlike(result: dict[str, Any]) -> None:
    print(f"\n{result['lanes']} unlike Kepler orbits, projected Tsit5 at {result['tolerance']:.0e}")
    for quantity in ("steps", "iterations of the longest projection"):
        low, mean, high = result[quantity]
        print(f"  {quantity}: {low:.0f} to {high:.0f}, mean {mean:.1f}")
    for name in ("plain", "projected"):
        batch, alone = result[name]["batch"], result[name]["alone"]
        print(
            f"  {name}: {1e3 * batch:.4f} ms per orbit in the batch, {1e3 * alone:.4f} alone, "
            f"ratio {batch / alone:.2f}"
        )


def main(argv: list[str] | None = None) -> dict[str, Any]:
    options = measuring.parser(__doc__, "work_precision").parse_args(argv)
    settings = SMOKE if options.smoke else FULL
    about = measuring.machine("scipy", "homproj", "heyoka")
    measuring.print_machine(about)
    parts = {name: partial(one_trajectory, name, settings) for name in settings.systems}
    parts |= {"batch": partial(batch, settings), "unlike": partial(unlike_lanes, settings)}
    found = {}
    for name, measure in parts.items():
        if options.only in name:
            found[name] = measure()
            (print_unlike if name == "unlike" else print_part)(found[name])
    left_out = peers.missing()
    for text in left_out:
        print("left out, not installed:", text)
    measuring.write(options, about, parts=found, left_out=left_out)
    return found


if __name__ == "__main__":
    main()
