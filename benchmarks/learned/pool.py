"""Where a flow map is trained: where solves start, where the network goes, where solutions go.

    python benchmarks/learned/pool.py          # two systems, three seeds: writes results/pool.json
    python benchmarks/learned/pool.py --table  # only print the table of the results
    python benchmarks/learned/pool.py --smoke  # toy sizes, to see that it runs

The networks are those of the zoo, trained for fewer epochs and without its last updates.
"""

import dataclasses
import json
import sys
import time
from pathlib import Path

import jax
import jax.random as jr
import numpy as np
import trained
import zoo

import diffrax_conserve as dfc

OUT = zoo.ROOT / "results" / "pool.json"
EPOCHS = {"double-pendulum": 400, "conservative-lorenz": 600}
WHERE = {
    "sample": "where solves start",
    "pool": "`Pool`",
    "reachable": "`reachable_states`",
}


def train(system, spec, where, seed):
    """The network, and the processor seconds of all that made it."""
    started = time.process_time()
    starts = jax.jit(jax.vmap(system.sample))(jr.split(jr.key(seed + 100), spec.pool))
    states, sample = starts, system.sample
    if where == "reachable":
        states = zoo.reachable(system, spec, spec.pool, seed)
        sample = states
    elif where == "pool":
        sample = dfc.learned.Pool(system.sample, manifold=system.manifold)
    network = dfc.DeepONet(
        states, system.dt,
        width=spec.width, depth=spec.depth, core=spec.core,
        taylor=dfc.learned.Taylor(system.vector_field, spec.order), key=jr.key(seed),
    )  # fmt: skip
    recipe = dfc.learned.second_order(network, epochs=spec.epochs)
    recipe = dataclasses.replace(recipe, points=spec.points)
    network, log = dfc.fit(
        network, system.vector_field, key=jr.key(seed), sample=sample, recipe=recipe
    )
    return network, log, time.process_time() - started


def judge(system, spec, network, steps, states):
    """Errors over states along solutions and over rollouts, and how many states of these are
    outside the domain of the network."""
    fresh, exact, y0s, ts, reference = zoo.judged_on(system.name, spec, steps, states)
    solver = dfc.DeepONetSolver(network)
    projected = dfc.ManifoldProjection(solver, system.manifold, projection=dfc.Newton())
    visited = reference.reshape(-1, *reference.shape[2:])
    inside = jax.jit(jax.vmap(network.domain.contains))(visited)
    rollout = zoo.rollout(system, projected, y0s, ts, reference)
    return {
        "one_step_rms": zoo.one_step(system, solver, fresh, exact)[0],
        "largest_state_error": rollout["largest_state_error"],
        "failed": rollout["failed"],
        "outside": float(np.mean(~np.asarray(inside))),
    }


def measure(name, where, seed, specs, steps=None, states=1000):
    system, spec = dfc.systems.get(name), specs[name]
    network, log, seconds = train(system, spec, where, seed)
    steps = round(system.t1 / system.dt) if steps is None else steps
    record = {"system": name, "where": where, "seed": seed, "epochs": spec.epochs}
    record |= {"cpu_seconds": round(seconds, 1), "skipped_updates": log.skipped}
    return record | judge(system, spec, network, steps, states)


def table(records):
    """The medians over the seeds."""
    lines = [
        "| system | trained | s | one step | rollout, projected | outside the domain |",
        "|---|---|---|---|---|---|",
    ]
    for name in EPOCHS:
        for where, title in WHERE.items():
            rows = [r for r in records if (r["system"], r["where"]) == (name, where)]
            if rows:
                lines.append(f"| `{name}` | {title} | {cells(rows)} |")
    return "\n".join(lines)


def cells(rows):
    def median(key):
        return trained.median(row[key] for row in rows)

    end = trained.error(median("largest_state_error"))
    first = f"{median('cpu_seconds'):.0f} | {median('one_step_rms'):.1e}"
    return f"{first} | {end} | {median('outside'):.1%}"


def main(argv=None):
    jax.config.update("jax_enable_x64", True)
    parser = trained.parser(__doc__, EPOCHS)
    parser.add_argument("--seed", type=int, action="append")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(argv)
    if options.table:
        print(table(json.loads(options.out.read_text())))
        return []
    if options.smoke:
        name = "conservative-lorenz"
        two = ("sample", "pool")
        records = [measure(name, where, 0, zoo.SMOKE, steps=4, states=10) for where in two]
        print(table(records))
        return records
    specs = {
        name: dataclasses.replace(zoo.SPECS[name], epochs=epochs) for name, epochs in EPOCHS.items()
    }
    records = []
    for name in options.system or EPOCHS:
        for seed in options.seed or [0, 1, 2]:
            for where in WHERE:
                records.append(measure(name, where, seed, specs))
                print(json.dumps(records[-1]), file=sys.stderr, flush=True)
    options.out.write_text(json.dumps(records, indent=1) + "\n")
    print(table(records))
    return records


if __name__ == "__main__":
    main()
