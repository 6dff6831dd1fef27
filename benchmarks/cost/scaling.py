"""What a projected step costs: by the number of integrals, and in batches of growing size.

1. `methods`: projected over plain, of RK4 and of adaptive Tsit5, alone and in a batch of 1,000: a
   rigid body, the conservative Lorenz model, a Toda lattice, three vortices and ten; the times of a
   step, and those of compilation.
2. `batch`: rigid bodies, 1 to 10⁶ trajectories, fixed steps: ns per step and trajectory.

Runs on the device that jax picks. How to read it, and float32: `benchmarks/README.md`.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import measuring

import diffrax_conserve as dfc

MIN_STEPS = 30  # the start of a solve costs as much as some steps
MAX_DRIFT = 100 * measuring.EPS
# A system with its step.
SYSTEMS = {
    "rigid body": (dfc.systems.RigidBody(), 0.05),
    "Lorenz model": (dfc.systems.ConservativeLorenz(), 0.01),
    "Toda lattice": (dfc.systems.TodaLattice(), 0.05),
    "three vortices": (dfc.systems.PointVortices(), 0.1),
    "ten vortices": (dfc.systems.PointVortices([1.0] * 10), 0.02),
}


class Settings(NamedTuple):
    """What is measured. A run takes as many steps as fit into `seconds`, but at least 30."""

    systems: tuple[str, ...]
    batches: tuple[int, ...]
    rounds: int
    seconds: float


FULL = Settings(tuple(SYSTEMS), (1, 10, 100, 1_000, 10_000, 100_000, 1_000_000), 3, 0.1)
SMOKE = Settings(("rigid body",), (16,), 1, 0.01)


def solve(system: Any, solver: dfx.AbstractSolver, dt: float, adaptive: bool, steps: Any, y0: Any):
    controller = dfx.PIDController(rtol=1e-8, atol=1e-8) if adaptive else dfx.ConstantStepSize()
    solution = dfx.diffeqsolve(
        dfx.ODETerm(system.vector_field),
        solver,
        t0=0.0,
        t1=steps * dt,
        dt0=None if adaptive else dt,
        y0=y0,
        saveat=dfx.SaveAt(t1=True),
        stepsize_controller=controller,
        adjoint=dfx.ForwardMode(),
        max_steps=None,
        throw=False,
    )
    ok = solution.result == dfx.RESULTS.successful
    ys = jax.tree.map(lambda y: jnp.where(ok, y[0], jnp.nan), solution.ys)
    return ys, solution.stats["num_steps"]


def measure(name: str, size: int, settings: Settings, inners: dict[str, Any]) -> dict[str, Any]:
    """Of each solver, plain and projected: ns per step and trajectory, and the compilation."""
    system, dt = SYSTEMS[name]
    start = measuring.initial_states(system, size)
    runs, rows = {}, {}
    for method, inner in inners.items():
        projected = dfc.ManifoldProjection(inner, system.manifold)
        for kind, solver in (("plain", inner), ("projected", projected)):
            fn = jax.vmap(partial(solve, system, solver, dt, "adaptive" in method), (None, 0))
            executable, seconds = measuring.compiled(fn, 1.0, start)
            steps = steps_within(executable, start, settings.seconds)
            runs[f"{kind} {method}"] = partial(executable, float(steps), start)
            rows[f"{kind} {method}"] = dict(compile_seconds=seconds)
    for key, (seconds, (end, steps)) in measuring.take_turns(runs, settings.rounds).items():
        drift = measuring.largest_drift(system, start, end)
        if not drift <= (MAX_DRIFT if key.startswith("projected") else math.inf):
            raise AssertionError(f"{key}, batch of {size}: the drift is {drift:.1e}")
        # A batch takes steps until its last trajectory has arrived.
        rows[key] |= dict(ns=1e9 * seconds / int(jnp.max(steps)) / size, drift=drift)
    return dict(system=name, batch=size, rows=rows)


def steps_within(executable: Callable[..., Any], start: Any, seconds: float) -> int:
    steps = MIN_STEPS
    while True:
        duration = measuring.timed(partial(executable, float(steps), start)).seconds
        if duration > seconds / 4:
            return max(MIN_STEPS, round(steps * seconds / duration))
        steps *= 4


def methods(settings: Settings) -> list[dict[str, Any]]:
    inners = {"RK4": dfc.RK4(), "Tsit5 adaptive": dfx.Tsit5()}
    sizes = (1,) if settings is SMOKE else (1, 1_000)
    return [show(measure(x, size, settings, inners)) for x in settings.systems for size in sizes]


def batch(settings: Settings) -> list[dict[str, Any]]:
    inners = {"RK4": dfc.RK4(), "Tsit5": dfx.Tsit5()}
    return [show(measure("rigid body", x, settings, inners)) for x in settings.batches]


def show(result: dict[str, Any]) -> dict[str, Any]:
    print(f"\n{result['system']}, batch of {result['batch']:,}: ns per step and trajectory")
    for name, row in result["rows"].items():
        print(f"  {name:24} {row['ns']:12.1f}, compiled in {row['compile_seconds']:.2f} s")
    return result


def main(argv: list[str] | None = None) -> dict[str, list[dict[str, Any]]]:
    options = measuring.parser(__doc__, "scaling").parse_args(argv)
    settings = SMOKE if options.smoke else FULL
    about = measuring.machine()
    measuring.print_machine(about)
    parts = {"methods": methods, "batch": batch}
    found = {name: part(settings) for name, part in parts.items() if options.only in name}
    measuring.write(options, about, parts=found)
    return found


if __name__ == "__main__":
    main()
