"""How the cost of a projected step grows: with the batch, with the constraints, with the bodies.

1. Batches of rigid bodies, 1 to 10⁶ trajectories, fixed steps: ns per step and trajectory, and the
   bytes and operations of a step, on a GPU against the card's limits.
2. A hanging chain of rigid bonds, 1 to 2,000 constraints.
3. 10 to 10⁵ gravitating bodies with their ten integrals: the projection against one evaluation of
   the pairwise forces.

Runs on the device that jax picks. How to read it, and float32: `benchmarks/README.md`.
"""

import argparse
import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import many_constraints as many
import measuring

import diffrax_conserve as dfc

MIN_STEPS = 30  # the start of a solve costs as much as some steps


class Settings(NamedTuple):
    """What is measured. A run takes as many steps as fit into `seconds`, but at least 30."""

    batches: tuple[int, ...]
    constraints: tuple[int, ...]
    bodies: tuple[int, ...]
    rounds: int
    seconds: float


FULL = Settings(
    batches=(1, 10, 100, 1_000, 10_000, 100_000, 1_000_000),
    constraints=(1, 6, 10, 20, 100, 200, 500, 2_000),
    bodies=(10, 100, 1_000, 10_000),
    rounds=3,
    seconds=0.1,
)
SMOKE = Settings(batches=(16,), constraints=(1, 6), bodies=(100,), rounds=1, seconds=0.01)
MAX_DRIFT = 100 * measuring.EPS


# ---- 1. The batch ----


def solve(system: Any, solver: dfx.AbstractSolver, dt: float, steps: Any, y0: Any) -> Any:
    solution = dfx.diffeqsolve(
        dfx.ODETerm(system.vector_field),
        solver,
        t0=0.0,
        t1=steps * dt,
        dt0=dt,
        y0=y0,
        saveat=dfx.SaveAt(t1=True),
        adjoint=dfx.ForwardMode(),
        max_steps=None,
        throw=False,
    )
    ok = solution.result == dfx.RESULTS.successful
    return jax.tree.map(lambda y: jnp.where(ok, y[0], jnp.nan), solution.ys)


def batch(size: int, settings: Settings, *, limits: "Limits") -> dict[str, Any]:
    system, dt = dfc.systems.RigidBody(), 0.05
    start = measuring.initial_states(system, size)
    runs, rows, made = {}, {}, {}
    for inner in (dfc.RK4(), dfx.Tsit5()):
        projected = dfc.ManifoldProjection(inner, system.manifold)
        for kind, solver in (("plain", inner), ("projected", projected)):
            name = f"{kind} {type(inner).__name__}"
            fn = jax.vmap(partial(solve, system, solver, dt), (None, 0))
            executable, seconds = measuring.compiled(fn, 1.0, start)
            made[name] = steps = steps_within(executable, start, settings.seconds)
            runs[name] = partial(executable, float(steps), start)
            rows[name] = dict(compile_seconds=seconds, steps=steps, **cost(executable, size))
    for name, (seconds, end) in measuring.take_turns(runs, settings.rounds).items():
        drift = measuring.largest_drift(system, start, end)
        if not drift <= (MAX_DRIFT if name.startswith("projected") else math.inf):
            raise AssertionError(f"{name}, batch of {size}: the drift is {drift:.1e}")
        per_step = seconds / made[name] / size
        rows[name] |= dict(ns=1e9 * per_step, drift=drift)
        rows[name] |= limits.share(rows[name], per_step)
    return dict(batch=size, rows=rows)


def steps_within(executable: Callable[..., Any], start: Any, seconds: float) -> int:
    steps = MIN_STEPS
    while True:
        duration = measuring.timed(partial(executable, float(steps), start)).seconds
        if duration > seconds / 4:
            return max(MIN_STEPS, round(steps * seconds / duration))
        steps *= 4


def cost(executable: Any, size: int) -> dict[str, float]:
    """Operations and bytes per step and trajectory, by XLA's own count.

    XLA counts the body of a loop once, so this is one step, with what is done once for a solve, and
    with the further iterations of a projection, which few steps take: more than what is executed.
    """
    analysis = executable.cost_analysis() or {}
    names = {"flops": "flops", "bytes": "bytes accessed"}
    return {name: analysis[key] / size for name, key in names.items() if key in analysis}


class Limits(NamedTuple):
    """Of the device, in operations and bytes per second; `None` where they are not known."""

    flops: float | None
    bandwidth: float | None

    def share(self, row: dict[str, float], seconds: float) -> dict[str, float]:
        """What part of each limit a step of `seconds` used."""
        out = {}
        for name, limit in (("flops", self.flops), ("bytes", self.bandwidth)):
            if limit is not None and name in row:
                out[f"{name}, share of the limit"] = row[name] / seconds / limit
        return out


# Per second, from the data sheets: operations in float64 and float32 without tensor cores, bytes.
DATA_SHEETS = {"H100": (34e12, 67e12, 3.35e12), "H200": (34e12, 67e12, 4.8e12)}


def limits_of(options: argparse.Namespace) -> Limits:
    kind = jax.devices()[0].device_kind
    sheet = next((x for name, x in DATA_SHEETS.items() if name in kind), (None, None, None))
    flops = sheet[0 if jax.config.jax_enable_x64 else 1]
    return Limits(options.peak_flops or flops, options.peak_bandwidth or sheet[2])


# ---- 2. Constraints ----


def constraints(count: int, settings: Settings) -> dict[str, Any]:
    """One, the energy of three bonds; else the lengths and velocities of `count / 2` bonds."""
    del settings
    if count == 1:
        manifold, bonds = {"energy": dfc.FirstIntegral(many.chain_energy)}, 3
    else:
        manifold, bonds = many.CHAIN, count // 2
    steps = 1000 if count <= 20 else 50 if count <= 100 else 3
    case = (f"chain, {bonds} bonds", many.chain_vector_field, manifold, many.chain(bonds), 1e-3)
    row = many.measure(*case, steps, plain_steps=1000)
    check(row)
    return dict(constraints=count, **row)


def check(row: dict[str, Any]) -> None:
    if not (row["projected succeeded"] and row["projected drift"] <= MAX_DRIFT):
        raise AssertionError(f"{row['problem']}: the drift is {row['projected drift']:.1e}")


# ---- 3. Bodies ----


def bodies(count: int, settings: Settings) -> dict[str, Any]:
    """One projection of a state that is about as far off as a step, one evaluation of the forces.

    The energy is a sum over all pairs, like the forces; so one evaluation of it is measured by
    itself, and the projection without it, too. Sums go row by row: 10⁵ bodies need memory for 10⁷
    pairs at a time, not for 10¹⁰.
    """
    y0 = many.bodies(count)
    candidate = jax.tree.map(lambda x: x + 1e-8 * jnp.roll(x, 1), y0)
    force, _ = measuring.compiled(partial(many.bodies_vector_field, 0.0), y0, None)
    energy, _ = measuring.compiled(partial(many.energy, 0.0), y0, None)
    runs = {"force": partial(force, y0, None), "energy": partial(energy, y0, None)}
    compile_seconds = {}
    manifolds = {"projection": many.BODIES, "without energy": many.BODIES.copy()}
    del manifolds["without energy"]["energy"]
    for name, manifold in manifolds.items():
        values = {name: entry.fn(0.0, y0, None) for name, entry in manifold.items()}
        fn = partial(dfc.project, manifold, value=values, projection=dfc.SimplifiedNewton())
        executable, compile_seconds[name] = measuring.compiled(fn, candidate)
        runs[name] = partial(executable, candidate)
    best = measuring.take_turns(runs, settings.rounds)
    for name in manifolds:
        _, info = best[name].answer
        if not info.residual_after <= MAX_DRIFT:
            raise AssertionError(f"{count} bodies: the residual is {info.residual_after:.1e}")
    seconds = {name: result.seconds for name, result in best.items()}
    names = ["energy", *manifolds]
    ratios = {f"{name} / force": seconds[name] / seconds["force"] for name in names}
    compilation = {f"{name}, compile seconds": x for name, x in compile_seconds.items()}
    return dict(bodies=count, **seconds, **ratios, **compilation)


# ---- Reporting ----


def print_batch(result: dict[str, Any]) -> None:
    print(f"\nbatch of {result['batch']:,}: ns per step and trajectory")
    for name, row in result["rows"].items():
        rest = {key: x for key, x in row.items() if key not in ("ns", "compile_seconds")}
        print(f"  {name:16} {row['ns']:12.1f}  " + _cells(rest), flush=True)


def print_row(result: dict[str, Any]) -> None:
    print(_cells(result), flush=True)


def _cells(row: dict[str, Any]) -> str:
    return ", ".join(f"{k} {x:.3g}" if isinstance(x, float) else f"{k} {x}" for k, x in row.items())


def main(argv: list[str] | None = None) -> dict[str, list[dict[str, Any]]]:
    parser = measuring.parser(__doc__, "scaling")
    parser.add_argument("--large", action="store_true", help="10⁵ bodies too: minutes on a CPU")
    parser.add_argument("--peak-flops", type=float, help="of the device, per second")
    parser.add_argument("--peak-bandwidth", type=float, help="of the device, bytes per second")
    options = parser.parse_args(argv)
    settings = SMOKE if options.smoke else FULL
    if options.large:
        settings = settings._replace(bodies=(*settings.bodies, 100_000))
    about = measuring.machine() | {"limits": limits_of(options)._asdict()}
    measuring.print_machine(about)
    parts = {
        "batch": (settings.batches, partial(batch, limits=limits_of(options)), print_batch),
        "constraints": (settings.constraints, constraints, print_row),
        "bodies": (settings.bodies, bodies, print_row),
    }
    found: dict[str, list[dict[str, Any]]] = {}
    for name, (sizes, measure, show) in parts.items():
        for size in sizes if options.only in name else ():
            found.setdefault(name, []).append(measure(size, settings))
            show(found[name][-1])
    measuring.write(options, about, parts=found)
    return found


if __name__ == "__main__":
    main()
