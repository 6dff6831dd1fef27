"""What the form of a function costs: a projection that is written out in scalars is several times
faster in a batch than one in arrays, and no natural form of a function should lose that.

Nanoseconds per step and trajectory of RK4 in a batch of 1,000, plain and projected, in one run: two
integrals of a rigid body in several forms, beside `jnp.stack`, and the systems of the catalogue.
`python benchmarks/cost/forms.py`; `--only forms` or `--only systems` for one of the tables.
"""

import measuring  # isort: skip  (it sets XLA's options)

from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_conserve as dfc

LANES, STEPS = 1_000, 100
BODY = dfc.systems.RigidBody()
# Systems of more than a few numbers take fewer steps.
NUMBERS_MAX = 20


def energy(y: Any) -> Any:
    return BODY.manifold["energy"].fn(0.0, y, None)


def momentum(y: Any) -> Any:
    (other,) = (x for name, x in BODY.manifold.items() if name != "energy")
    return other.fn(0.0, y, None)


def both(y: Any) -> Any:
    return jnp.stack([energy(y), momentum(y)])


FORMS: dict[str, Callable[[Any], Any]] = {
    "jnp.stack": both,
    "tuple": lambda y: (energy(y), momentum(y)),
    "dictionary": lambda y: {"energy": energy(y), "momentum": momentum(y)},
    "jnp.array": lambda y: jnp.array([energy(y), momentum(y)]),
    "concatenate": lambda y: jnp.concatenate([energy(y)[None], momentum(y)[None]]),
    "hstack": lambda y: jnp.hstack([energy(y), momentum(y)]),
    ".at[].set": lambda y: jnp.zeros(2, y.dtype).at[0].set(energy(y)).at[1].set(momentum(y)),
    "take": lambda y: jnp.take(jnp.stack([momentum(y), energy(y)]), jnp.array([1, 0])),
    "take of the state": lambda y: both(jnp.take(y, jnp.array([0, 1, 2]))),
    "indices": lambda y: both(y[np.array([0, 1, 2])]),
    "split": lambda y: both(jnp.concatenate(jnp.split(y, 3))),
    "roll": lambda y: both(jnp.roll(jnp.roll(y, 1), -1)),
    # What is not known is evaluated in arrays in its place, which is not cheap.
    "sort": lambda y: jnp.stack([jnp.sum(jnp.sort(both(y))), momentum(y)]),
}


def solve(system: Any, manifold: Any, steps: int, y0: Any) -> Any:
    solver = dfc.RK4()
    if manifold is not None:
        solver = dfc.ManifoldProjection(solver, manifold)
    solution = dfx.diffeqsolve(
        dfx.ODETerm(system.vector_field),
        solver,
        0.0,
        steps * system.dt / 10,
        system.dt / 10,
        y0,
        adjoint=dfx.ForwardMode(),
        max_steps=None,
        throw=False,
    )
    return solution.ys, dfx.is_okay(solution.result)


def measure(
    system: Any, manifolds: dict[str, Any], steps: int, lanes: int, rounds: int
) -> list[dict[str, Any]]:
    """A row for each manifold, of which `None` is a plain solve."""
    y0 = jax.vmap(system.sample)(jr.split(jr.key(0), lanes))
    runs, seconds = {}, {}
    for name, manifold in manifolds.items():
        jax.clear_caches()
        fn = jax.vmap(partial(solve, system, manifold, steps))
        executable, seconds[name] = measuring.compiled(fn, y0)
        runs[name] = partial(executable, y0)
    times = measuring.take_turns(runs, rounds)
    return [
        dict(
            name=name,
            ns=found.seconds / steps / lanes * 1e9,
            compile=seconds[name],
            failed=float(1 - jnp.mean(found.answer[1])),
        )
        for name, found in times.items()
    ]


def forms(steps: int, lanes: int, rounds: int) -> list[dict[str, Any]]:
    manifolds: dict[str, Any] = {"plain": None}
    for name, fn in list(FORMS.items())[: None if lanes == LANES else 1]:
        manifolds[name] = dfc.FirstIntegral(lambda t, y, args, fn=fn: fn(y))
    rows = measure(BODY, manifolds, steps, lanes, rounds)
    stacked = next(row["ns"] for row in rows if row["name"] == "jnp.stack")
    return [row | {"ratio": row["ns"] / stacked} for row in rows]


def systems(steps: int, lanes: int, rounds: int) -> list[dict[str, Any]]:
    rows = []
    for name in dfc.systems.names()[: None if lanes == LANES else 1]:
        system = dfc.systems.get(name)
        numbers = sum(x.size for x in jax.tree.leaves(system.y0))
        made = steps if numbers <= NUMBERS_MAX else max(2, steps // 10)
        manifolds = {"plain": None, "projected": system.manifold}
        plain, projected = measure(system, manifolds, made, lanes, rounds)
        ratio = projected["ns"] / plain["ns"]
        rows.append(projected | dict(name=name, plain=plain["ns"], ratio=ratio))
    return rows


def main() -> None:
    options = measuring.parser(__doc__ or "", "forms").parse_args()
    about = measuring.machine()
    measuring.print_machine(about)
    size = (2, 16, 1) if options.smoke else (STEPS, LANES, 5)
    found = {}
    for title, table in {"forms, over jnp.stack": forms, "systems, over plain": systems}.items():
        if options.only not in title:
            continue
        print(f"\n{title:24} {'ns a step':>10} {'ratio':>7} {'compile (s)':>12}")
        found[title] = table(*size)
        for row in found[title]:
            failed = f"   failed {row['failed']:.1%}" if row["failed"] else ""
            numbers = f"{row['ns']:10,.1f} {row['ratio']:7.2f} {row['compile']:12.2f}"
            print(f"{row['name']:24} {numbers}{failed}", flush=True)
    measuring.write(options, about, tables=found)


if __name__ == "__main__":
    main()
