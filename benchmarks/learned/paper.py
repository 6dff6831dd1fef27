"""The paper's recipe, measured: trains its networks, judges them, and writes what it found.

    python benchmarks/learned/paper.py  # five systems, three seeds: hours
    python benchmarks/learned/paper.py --system rigid-body --seed 0
    python benchmarks/learned/paper.py --system rigid-body --seed 0 --ship  # and ship
    python benchmarks/learned/paper.py --smoke  # toy sizes, to see that it runs

One JSON file for each system, kind of network and seed goes to `benchmarks/results/paper/`.
`--ship` writes the networks themselves into the package, with weights rounded to single precision:
half the size, and an error far below theirs.
"""

import json
import sys
import time
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import trained

import diffrax_conserve as dfc
from diffrax_conserve import reproduce as _reproduce
from diffrax_conserve.reproduce._trained import KINDS, is_flow_map, is_learned

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "results" / "paper"
SHIPPED = ROOT.parent / "diffrax_conserve" / "pretrained"
SYSTEMS = [name for name in dfc.systems.names() if is_learned(dfc.systems.get(name))]


@eqx.filter_jit
def rollout(system, solver, y0s, ts):
    def one(y0):
        return dfx.diffeqsolve(
            dfx.ODETerm(system.vector_field),
            solver,
            0.0,
            ts[-1],
            system.dt,
            y0,
            saveat=dfx.SaveAt(ts=ts),
            max_steps=len(ts) + 2,
            throw=False,
        )

    solutions = jax.vmap(one)(y0s)
    drifts = jax.vmap(lambda sol: dfc.drift(sol, system.manifold))(solutions)
    largest = [jnp.max(jnp.abs(d)) for d in jax.tree.leaves(drifts)]
    return solutions.ys, jnp.max(jnp.stack(largest)), solutions.result == dfx.RESULTS.successful


def judge(system, network, t1=None):
    """The errors of a network, plain and projected, over the paper's horizon.

    Medians over the initial states.
    """
    y0s = _reproduce.initial_states(system)
    t1 = system.t1 if t1 is None else t1
    ts = jnp.arange(round(t1 / system.dt) + 1) * system.dt
    reference = jax.vmap(lambda y0: system.reference(ts, y0))(y0s)
    pair = _reproduce.learned_solvers(system, {"standard": network, "conservative": network})
    found = {"initial_states": len(y0s)}
    for label, solver in {"plain": pair["standard"], "projected": pair["conservative"]}.items():
        ys, drift, ok = rollout(system, solver, y0s, ts)
        distance = np.asarray(jnp.linalg.norm((ys - reference).reshape(*ys.shape[:2], -1), axis=-1))
        size = np.asarray(jnp.linalg.norm(reference.reshape(*ys.shape[:2], -1), axis=-1))
        # A solve that failed has an infinite error, which a median can bear.
        distance = np.where(np.asarray(ok)[:, None], distance, np.inf)
        relative = np.linalg.norm(distance, axis=1) / np.linalg.norm(size, axis=1)
        found[label] = {
            "one_step_error": trained.number(np.median(distance[:, 1])),
            "state_error": trained.number(np.median(distance[:, -1])),
            "largest_state_error": trained.number(np.median(np.max(distance, axis=1))),
            "relative_l2_error": trained.number(np.median(relative)),
            "drift": trained.number(drift),
            "failed": int(np.sum(~np.asarray(ok))),
        }
    return found


def single_precision(network):
    return jax.tree.map(
        lambda x: x.astype(jnp.float32).astype(x.dtype) if eqx.is_inexact_array(x) else x, network
    )


def measure(name, kind, seed, epochs, points, ship):
    system = dfc.systems.get(name)
    network, log = _reproduce.train(
        system, kind, seed=seed, epochs=epochs, points=points, progress=True
    )
    return record(system, kind, seed, epochs, network, log, ship)


def record(system, kind, seed, epochs, network, log, ship, out=RESULTS):
    times, losses = _reproduce.history(log)
    if ship:
        network = single_precision(network)
    result = {
        "system": system.name,
        "kind": kind,
        "seed": seed,
        "epochs": epochs,
        "best_loss": trained.number(log.criteria.min()),
        "best_epoch": int(log.checked[log.criteria.argmin()]),
        "last_loss": trained.number(log.criteria[-1]),
        "skipped_updates": log.skipped,
        "largest_training_loss": trained.number(np.max(log.losses)),
        "seconds": round(log.seconds, 1),
        "compile_seconds": round(log.compile_seconds, 1),
        "errors": judge(system, network),
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{system.name}-{kind}-{seed}.json").write_text(json.dumps(result, indent=1) + "\n")
    if ship:
        info = {
            **result,
            "command": "python benchmarks/learned/paper.py "
            f"--system {system.name} --seed {seed} --ship"
            + ("" if epochs == 5000 else f" --epochs {epochs}"),
            "recipe": "paper",
            "horizon": system.t1,
            "step": system.dt,
            "domain": "diffrax_conserve.systems.get(system).sample"
            if is_flow_map(system)
            else "diffrax_conserve.systems.get(system).y0",
            "history": {
                "epochs": [round(float(t)) for t in times],
                "losses": [float(f"{x:.4g}") for x in losses],
            },
        }
        SHIPPED.mkdir(exist_ok=True)
        dfc.save(SHIPPED / f"{system.name}-{kind}.network", network, info=info)
    return result


def table(results):
    """A Markdown table of all results, worst and best seed where there are several."""
    lines = [
        "| network | seeds | loss | one step | largest error | projected | s |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in SYSTEMS:
        for kind in KINDS:
            rows = [r for r in results if r["system"] == name and r["kind"] == kind]
            if rows:
                lines.append("| " + " | ".join([f"`{name}`, {kind}", *cells(rows)]) + " |")
    return "\n".join(lines)


def cells(rows):
    def span(values):
        texts = [trained.error(v) for v in sorted(map(trained.or_infinity, values))]
        return texts[0] if texts[0] == texts[-1] else f"{texts[0]} to {texts[-1]}"

    return [
        str(len(rows)),
        span([r["best_loss"] for r in rows]),
        span([r["errors"]["plain"]["one_step_error"] for r in rows]),
        span([r["errors"]["plain"]["largest_state_error"] for r in rows]),
        span([r["errors"]["projected"]["largest_state_error"] for r in rows]),
        f"{np.median([r['seconds'] for r in rows]):.0f}",
    ]


def main(argv=None):
    jax.config.update("jax_enable_x64", True)
    parser = trained.parser(__doc__, SYSTEMS)
    parser.add_argument("--kind", choices=KINDS, action="append")
    parser.add_argument("--seed", type=int, action="append")
    parser.add_argument("--ship", action="store_true", help="write the networks into the package")
    parser.add_argument(
        "--epochs", type=int, default=5000, help="another number is not the paper's"
    )
    options = parser.parse_args(argv)
    if options.table:
        print(table(trained.read_results(RESULTS)))
        return []
    epochs, points = (10, 20) if options.smoke else (options.epochs, None)
    results = []
    for name in options.system or SYSTEMS[: 1 if options.smoke else None]:
        for seed in options.seed or ([0] if options.smoke else [0, 1, 2]):
            for kind in options.kind or KINDS:
                started = time.perf_counter()
                if options.smoke:
                    system = dfc.systems.get(name)
                    network, _ = _reproduce.train(system, kind, epochs=epochs, points=points)
                    results.append({"system": name, **judge(system, network, t1=2 * system.dt)})
                else:
                    results.append(measure(name, kind, seed, epochs, points, options.ship))
                took = time.perf_counter() - started
                print(f"{name}, {kind}, seed {seed}: {took:.0f} s", file=sys.stderr)
                print(json.dumps(results[-1]))
    return results


if __name__ == "__main__":
    main()
