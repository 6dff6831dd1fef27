"""What a batch costs whose lanes need different numbers of iterations.

The time of a step and trajectory of projected RK4, beside that of the batch in which no lane needs
more than the two iterations that every projection makes. `python benchmarks/cost/unlike_lanes.py`.
"""

import measuring  # isort: skip  (it sets XLA's options)

from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_conserve as dfc

SMOKE = dict(lanes=(64,), steps=4)
FULL = dict(lanes=(1_000, 100_000), steps=200_000)


def bodies(lanes: int) -> tuple[Any, dict[str, tuple[Any, float]]]:
    """Momenta from N(0, 1); in the last case a third of them are slow and the others fast."""
    system = dfc.systems.RigidBody()
    y = np.random.default_rng(0).normal(size=(lanes, 3))
    mixed = y * np.where(np.arange(lanes) % 3 == 0, 0.3, 3.0)[:, None]
    cases = {f"dt = {dt}": (y, dt) for dt in (0.01, 0.015, 0.02, 0.03, 0.05)}
    return system, cases | {"mixed, dt = 0.05": (mixed, 0.05)}


def orbits(lanes: int) -> tuple[Any, dict[str, tuple[Any, float]]]:
    """Kepler orbits at their pericentres, of one eccentricity and of many."""
    system = dfc.systems.Kepler()
    rng = np.random.default_rng(1)

    def starts(e: Any) -> Any:
        q = np.stack([1 - e, 0 * e], axis=1)
        p = np.stack([0 * e, np.sqrt((1 + e) / (1 - e))], axis=1)
        return system_state(system, q, p)

    return system, {
        "e = 0.3": (starts(np.full(lanes, 0.3)), 0.01),
        "e from 0.01 to 0.9": (starts(rng.uniform(0.01, 0.9, lanes)), 0.01),
    }


def system_state(system: Any, q: Any, p: Any) -> Any:
    leaves, treedef = jax.tree.flatten(system.y0)
    return jax.tree.unflatten(treedef, [q, p] if len(leaves) == 2 else [np.concatenate([q, p], 1)])


def vortices(lanes: int) -> tuple[Any, dict[str, tuple[Any, float]]]:
    """Three vortices: a wide triangle, and one in which two of a tenth of the lanes are close."""
    system = dfc.systems.PointVortices()
    rng = np.random.default_rng(2)
    wide = np.array([[1.0, 0.0], [-0.5, 0.9], [-0.5, -0.9]]) + 0.1 * rng.normal(size=(lanes, 3, 2))
    close = wide.copy()
    close[::10, 1] = close[::10, 0] + [0.15, 0.0]
    return system, {"wide": (wide, 0.02), "a tenth are close": (close, 0.02)}


FAMILIES: dict[str, Callable] = {"bodies": bodies, "orbits": orbits, "vortices": vortices}


def runs_of(
    system: Any, cases: dict[str, tuple[Any, float]], steps: int
) -> dict[str, Callable[[], Any]]:
    def one(dt: Any, y0: Any) -> Any:
        solution = dfx.diffeqsolve(
            dfx.ODETerm(system.vector_field),
            dfc.ManifoldProjection(dfc.RK4(), system.manifold, max_correction=None),
            0.0,
            steps * dt,
            dt,
            y0,
            max_steps=None,
            throw=False,
        )
        return solution.ys, dfx.is_okay(solution.result)

    arguments = {
        case: (jnp.asarray(dt), jax.tree.map(jnp.asarray, y)) for case, (y, dt) in cases.items()
    }
    program, _ = measuring.compiled(jax.vmap(one, (None, 0)), *next(iter(arguments.values())))
    return {case: partial(program, *xs) for case, xs in arguments.items()}


def main() -> None:
    parser = measuring.parser(__doc__ or "", "unlike_lanes")
    parser.add_argument("--lanes", type=int, nargs="+")
    options = parser.parse_args()
    sizes = SMOKE if options.smoke else FULL
    about = measuring.machine()
    measuring.print_machine(about)
    rows = []
    for lanes in options.lanes or sizes["lanes"]:
        steps = sizes["steps"] if options.smoke else max(40, sizes["steps"] // lanes)
        for name, family in FAMILIES.items():
            system, cases = family(lanes)
            runs = runs_of(system, cases, steps)
            times = measuring.take_turns(runs, rounds=1 if options.smoke else 3)
            easy = next(iter(times.values())).seconds
            for case, found in times.items():
                row = {
                    "family": name,
                    "lanes": lanes,
                    "case": case,
                    "ns": found.seconds / steps / lanes * 1e9,
                    "ratio": found.seconds / easy,
                    "failed": float(1 - np.mean(found.answer[1])),
                }
                rows.append(row)
                print(
                    f"{name:9} {lanes:7,} {case:20} {row['ns']:8.1f} ns  "
                    f"{row['ratio']:6.2f}  failed {row['failed']:.1%}",
                    flush=True,
                )
    measuring.write(options, about, rows=rows)


if __name__ == "__main__":
    main()
