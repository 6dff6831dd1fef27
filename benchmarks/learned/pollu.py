"""A flow map of POLLU from data: its error, its balances and signs, and what a step costs.

    python benchmarks/pollu.py            # some minutes: writes results/pollu.json
    python benchmarks/pollu.py --smoke    # toy sizes, to see that it runs

Steps of up to two minutes, learned in Box-Cox coordinates from solves by Kvaerno5 that start from
the published state with factors between 1/2 and 2; projected so that no concentration is negative.
"""

import argparse
import json
import time
from pathlib import Path

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax

import diffrax_conserve as dfc

jax.config.update("jax_enable_x64", True)
OUT = Path(__file__).parent / "results" / "pollu.json"
SYSTEM = dfc.systems.get("pollu")
STEP, FIRST = 2.0, 0.05
BOXCOX = dfc.learned.BoxCox(0.1)
TRACE = 1e-10  # smaller concentrations do not count


def solve(count, steps, key, rtol):
    y0s = jax.vmap(SYSTEM.sample)(jr.split(key, count))
    ts = FIRST + STEP * jnp.arange(steps + 1)
    return dfc.learned.trajectories(
        SYSTEM.vector_field, y0s, ts, solver=dfx.Kvaerno5(), rtol=rtol, atol=1e-18
    )


def train(data, epochs, points):
    states = data[1].reshape(-1, 20)
    inner = dfc.DeepONet(
        BOXCOX(states), STEP, width=64, depth=3, core=dfc.learned.Concatenated, key=jr.key(1)
    )
    recipe = dfc.learned.Recipe(
        epochs=epochs,
        points=points,
        optimiser=optax.adam(optax.schedules.cosine_decay_schedule(3e-3, epochs)),
        refresh=1,
        check_every=max(epochs // 20, 1),
    )
    network = dfc.learned.Transformed(inner, BOXCOX)
    return dfc.fit(network, data=data, recipe=recipe, key=jr.key(2), progress=True)


def relative(found, exact):
    return np.abs(np.asarray(found / exact) - 1)[np.asarray(exact) > TRACE]


def judge(network, data):
    """Of one step and of all, projected; the balances and the signs of all."""
    ts, ys = data
    solver = dfc.ManifoldProjection(
        dfc.DeepONetSolver(network, check_field=False),
        SYSTEM.manifold,
        projection=SYSTEM.mechanism.positive_projection(),
    )

    @jax.jit
    @jax.vmap
    def rollout(y0):
        return dfx.diffeqsolve(
            dfx.ODETerm(SYSTEM.vector_field), solver, 0.0, STEP * (ts.shape[1] - 1), STEP, y0,
            saveat=dfx.SaveAt(steps=True), max_steps=ts.shape[1] - 1, throw=False,
        ).ys  # fmt: skip

    found = rollout(ys[:, 0])
    one, last = relative(found[:, 0], ys[:, 1]), relative(found[:, -1], ys[:, -1])
    weights = np.array([b.weights for b in SYSTEM.mechanism.balances.values()], float)
    kept = found @ weights.T / (ys[:, :1] @ weights.T) - 1
    norm = np.linalg.norm(found[:, 0] - ys[:, 1], axis=1) / np.linalg.norm(ys[:, 1], axis=1)
    return {
        "one_step_median": float(np.median(one)),
        "one_step_99": float(np.percentile(one, 99)),
        "one_step_l2_median": float(np.median(norm)),
        "steps": ts.shape[1] - 1,
        "last_median": float(np.median(last)),
        "last_99": float(np.percentile(last, 99)),
        "balances": float(np.max(np.abs(kept))),
        "smallest": float(np.min(found)),
    }


def cost(network, y0s, repeats=20):
    """Microseconds of processor time for a step, with and without its projection."""
    projection = SYSTEM.mechanism.positive_projection()

    def projected(y0):
        value = {name: b(0.0, y0, None) for name, b in SYSTEM.mechanism.balances.items()}
        y = network(y0, STEP)
        return dfc.project(SYSTEM.manifold, y, value=value, projection=projection)[0]

    found = {}
    for name, step in (("plain", lambda y0: network(y0, STEP)), ("projected", projected)):
        run = jax.jit(jax.vmap(step))
        run(y0s).block_until_ready()
        begun = time.process_time()
        for _ in range(repeats):
            run(y0s).block_until_ready()
        found[name] = (time.process_time() - begun) / repeats / len(y0s) * 1e6
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true")
    smoke = parser.parse_args().smoke
    begun = time.process_time()
    data = solve(4 if smoke else 600, 2 if smoke else 20, jr.key(0), 1e-3 if smoke else 1e-5)
    solved = time.process_time()
    network, log = train(data, 5 if smoke else 5000, 20 if smoke else 1000)
    trained = time.process_time()
    fresh = solve(2 if smoke else 60, 2 if smoke else 30, jr.key(9), 1e-3 if smoke else 1e-6)
    batch = jnp.tile(fresh[1][:, 0], (17, 1))[:1000]
    results = {"data_seconds": solved - begun, "training_seconds": trained - solved}
    results |= {"log_error": log.error} | judge(network, fresh) | cost(network, batch)
    print(json.dumps(results, indent=1))
    if not smoke:
        OUT.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
