"""Flow maps of stiff chemistry from data: the error, balances and signs, and what a step costs.

    python benchmarks/learned/chemistry.py                     # POLLU: writes ../results/pollu.json
    python benchmarks/learned/chemistry.py --system robertson  # the same for Robertson's reaction
    python benchmarks/learned/chemistry.py --out FILE  # the network too, for `dfc.load`
    python benchmarks/learned/chemistry.py --smoke     # toy sizes, to see that it runs

Steps of up to two minutes (Robertson: one second), learned in Box-Cox coordinates from solves by
Kvaerno5 that start from the published state with factors between 1/2 and 2; projected so that no
concentration is negative. Half of the training is for whole steps, whose errors add up along a
solution, half for steps of many lengths. In the first two steps there are more times, because the
radicals form then. The network is trained and evaluated in float32.
"""

import os

# The factorisations of the optimiser are many times slower with threads of OpenBLAS beside XLA's.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import dataclasses
import json
import time
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from soap import soap

import diffrax_conserve as dfc

jax.config.update("jax_enable_x64", True)
RESULTS = Path(__file__).parents[1] / "results"
# The times of a step at which there are data, by half its length, and more in the first two steps.
WITHIN = np.array([0.0, 0.1, 0.5, 1.0])
FIRST = [0.02, 0.05, 0.2, 0.3, 0.4, 0.65, 0.8, 1.2, 1.4, 1.6, 1.8]
EARLY = np.array([*FIRST, 2.25, 2.75, 3.25, 3.5, 3.75])
BOXCOX = dfc.learned.BoxCox(0.125)
CHUNK = 300  # a batch of solves waits for its slowest
TRACE = 1e-10  # smaller concentrations do not count


@dataclasses.dataclass(frozen=True)
class Spec:
    """How a network is made and judged."""

    step: float
    first: float  # the time of the first state
    steps: int
    width: int
    solves: int = 1200
    judges: int = 60
    epochs: int = 100_000
    points: int = 1000
    rtol: float = 1e-6


SPECS = {
    "pollu": Spec(step=2.0, first=0.05, steps=30, width=128, epochs=240_000),
    "robertson": Spec(step=1.0, first=0.01, steps=39, width=32, solves=300, epochs=40_000),
}


def smoke(spec):
    return dataclasses.replace(spec, steps=2, solves=4, judges=2, epochs=20, points=20, rtol=1e-3)


def solve(system, count, ts, key, rtol):
    y0s = jax.vmap(system.sample)(jr.split(key, count))
    chunks = [
        dfc.learned.trajectories(
            system.vector_field,
            y0s[i : i + CHUNK],
            ts,
            solver=dfx.Kvaerno5(),
            rtol=rtol,
            atol=1e-15,
        )
        for i in range(0, count, CHUNK)
    ]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *chunks)


def times(spec):
    """Those of a solve, and for each time of a step the indices of whole steps from it on."""
    regular = WITHIN[:, None] + 2 * np.arange(spec.steps)
    ts = np.sort(np.concatenate([regular.reshape(-1), EARLY]))
    return spec.first + spec.step / 2 * ts, np.searchsorted(ts, regular)


def rows(data, whole):
    """Trajectories of equal length: as many of whole steps as of times that follow each other."""
    count, length = whole.shape
    last = data[0].shape[1] - length
    starts = np.linspace(0, last, max(count, -(-last // length) + 1)).astype(int)
    parts = [*whole, *(start + np.arange(length) for start in starts)]
    return jax.tree.map(lambda x: jnp.concatenate([x[:, part] for part in parts]), data)


def train(data, spec):
    data = jax.tree.map(lambda x: x.astype(jnp.float32), data)
    states = data[1].reshape(-1, data[1].shape[-1])
    inner = dfc.DeepONet(
        BOXCOX(states),
        spec.step,
        width=spec.width,
        depth=3,
        core="concatenated",
        key=jr.key(1),
    )
    epochs = spec.epochs
    schedule = optax.schedules.warmup_cosine_decay_schedule(0, 3e-3, epochs // 20, epochs)
    recipe = dfc.learned.Recipe(
        epochs=epochs,
        points=spec.points,
        optimiser=soap(schedule),
        refresh=1,
        check_every=max(epochs // 20, 1),
    )
    network = dfc.learned.Transformed(inner, BOXCOX)
    network, log = dfc.fit(network, data=data, recipe=recipe, key=jr.key(2), progress=True)
    wide = lambda x: x.astype(float) if eqx.is_inexact_array(x) else x  # noqa: E731
    # The network alone stays in single precision.
    single = network.flow_map.core
    return eqx.tree_at(lambda m: m.flow_map.core, jax.tree.map(wide, network), single), log


def relative(found, exact):
    return np.abs(np.asarray(found / exact) - 1)[np.asarray(exact) > TRACE]


def judge(system, spec, network, data):
    """Of one step and of all, projected; the balances and the signs of all."""
    ts, ys = data
    size, term = ys.shape[-1], dfx.ODETerm(system.vector_field)
    solver = dfc.ManifoldProjection(
        dfc.DeepONetSolver(network, check_field=False),
        system.manifold,
        projection=system.mechanism.positive_projection(),
    )

    @jax.jit
    @jax.vmap
    def rollout(y0):
        return dfx.diffeqsolve(
            term, solver, 0.0, spec.step * (ts.shape[1] - 1), spec.step, y0,
            saveat=dfx.SaveAt(steps=True), max_steps=ts.shape[1] - 1, throw=False,
        ).ys  # fmt: skip

    found = rollout(ys[:, 0])
    each = jax.jit(jax.vmap(lambda y: network(y, spec.step)))(ys[:, :-1].reshape(-1, size))
    one, last = relative(each, ys[:, 1:].reshape(-1, size)), relative(found[:, -1], ys[:, -1])
    weights = np.array([b.weights for b in system.mechanism.balances.values()], float)
    kept = found @ weights.T / (ys[:, :1] @ weights.T) - 1
    first = relative(found[:, 0], ys[:, 1])
    whole = relative(found, ys[:, 1:])
    return {
        "one_step_median": float(np.median(one)),
        "one_step_99": float(np.percentile(one, 99)),
        "first_step_median": float(np.median(first)),
        "first_step_99": float(np.percentile(first, 99)),
        "all_steps_median": float(np.median(whole)),
        "steps": ts.shape[1] - 1,
        "last_median": float(np.median(last)),
        "last_99": float(np.percentile(last, 99)),
        "balances": float(np.max(np.abs(kept))),
        "smallest": float(np.min(found)),
    }


def cost(system, spec, network, y0s, repeats=20):
    """Microseconds of processor time for a step, with and without its projection."""
    projection = system.mechanism.positive_projection()

    def projected(y0):
        value = {name: b(0.0, y0, None) for name, b in system.mechanism.balances.items()}
        y = network(y0, spec.step)
        return dfc.project(system.manifold, y, value=value, projection=projection)[0]

    found = {}
    for name, step in (("plain", lambda y0: network(y0, spec.step)), ("projected", projected)):
        run = jax.jit(jax.vmap(step)).lower(y0s).compile()
        times = []
        for _ in range(repeats):
            begun = time.process_time()
            run(y0s).block_until_ready()
            times.append(time.process_time() - begun)
        found[name] = min(times) / len(y0s) * 1e6
    return found


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--system", choices=SPECS, default="pollu")
    parser.add_argument("--smoke", action="store_true")
    parser.add_argument("--out", type=Path, help="where to write the network")
    options = parser.parse_args(argv)
    system, spec = dfc.systems.get(options.system), SPECS[options.system]
    spec = smoke(spec) if options.smoke else spec
    ts, whole = times(spec)
    begun = time.process_time()
    data = solve(system, spec.solves, jnp.asarray(ts), jr.key(0), spec.rtol)
    solved = time.process_time()
    network, log = train(rows(data, whole), spec)
    trained = time.process_time()
    if options.out is not None:
        command = f"python benchmarks/learned/chemistry.py --system {options.system}"
        info = {"system": options.system, "command": f"{command} --out {options.out}"}
        dfc.save(options.out, network, info=info)
    ts = spec.first + spec.step * jnp.arange(spec.steps + 1)
    fresh = solve(system, spec.judges, ts, jr.key(9), spec.rtol / 10)
    batch = fresh[1][:, :17].reshape(-1, fresh[1].shape[-1])[:1000]
    results = {"data_seconds": solved - begun, "training_seconds": trained - solved}
    results |= {"log_error": log.error} | judge(system, spec, network, fresh)
    results |= cost(system, spec, network, batch)
    # Where a solve failed there are no numbers, for which JSON has no name.
    results = {name: x if np.isfinite(x) else None for name, x in results.items()}
    print(json.dumps(results, indent=1))
    if not options.smoke:
        out = RESULTS / f"{options.system}.json"
        out.write_text(json.dumps(results, indent=1) + "\n")
    return results


if __name__ == "__main__":
    main()
