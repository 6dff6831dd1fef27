"""Trainings that are hard, by the default recipe: through a projection, a logarithm, in float32.

    python benchmarks/learned/hard_cases.py                 # writes results/hard_cases.json
    python benchmarks/learned/hard_cases.py --table         # only print the tables of the results
    python benchmarks/learned/hard_cases.py --kind layer --system halo --seeds 1
    python benchmarks/learned/hard_cases.py --smoke         # toy sizes, to see that it runs

- `layer`: a `PINN` with a `ConservativeLayer`, judged by the largest error in the interval, and by
  the largest change of its integrals, relative to the sizes of their terms.
- `logarithm`: a flow map that learns from data, through a layer for an integral with a logarithm.
- `float32`: a `DeepONet` in single precision, judged by the root mean square error of its longest
  step at 300 other states along solutions.

Errors are relative to the largest component. The reference is Dopri8 at 1e-12, in float64. Seconds
are processor seconds, with compilation.
"""

import argparse
import json
import time
import warnings
from pathlib import Path

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from defaults import (
    FLOW_MAPS,
    duffing,
    flow_map_data,
    kepler,
    kept,
    lotka_volterra,
    pendulum,
    reference,
)

import diffrax_conserve as dfc

OUT = Path(__file__).parent.parent / "results" / "hard_cases.json"
# Rates at which rock, paper and scissors win, and the weights of what they conserve.
RATES = np.array([[0.0, 1.0, -1.3], [-1.0, 0.0, 0.7], [1.3, -0.7, 0.0]])
WEIGHTS = np.array([0.7, 1.3, 1.0])


def halo(t, y, args):
    """A star in the logarithmic potential of a flattened halo."""
    q, p = y[:2], y[2:]
    flat = jnp.array([1.0, 0.8**-2])
    return jnp.concatenate([p, -flat * q / (0.1 + jnp.sum(flat * q**2))])


def rock_paper_scissors(t, y, args):
    return y * (RATES @ y)


def integral(function):
    return dfc.FirstIntegral(lambda t, y, args: function(y))


def momentum(y):
    return y[0] * y[3] - y[1] * y[2]


# The field, the initial state, the time, which is that of one to three periods, and the manifold.
SOLUTIONS = {
    "pendulum": (pendulum, [0.8, 0.0], 6.0, integral(lambda y: y[1] ** 2 / 2 - jnp.cos(y[0]))),
    "duffing": (
        duffing,
        [1.7, 0.0],
        3 * 6.6667,
        integral(lambda y: y[1] ** 2 / 2 - y[0] ** 2 / 2 + y[0] ** 4 / 4),
    ),
    "halo": (
        halo,
        [1.0, 0.0, 0.2, 0.6],
        15.0,
        integral(
            lambda y: jnp.sum(y[2:] ** 2) / 2 + jnp.log(0.1 + y[0] ** 2 + (y[1] / 0.8) ** 2) / 2
        ),
    ),
    "rock-paper-scissors": (
        rock_paper_scissors,
        [0.5, 0.25, 0.25],
        3 * 12.0,
        (integral(jnp.sum), integral(lambda y: WEIGHTS @ jnp.log(y))),
    ),
    "lotka-volterra": (
        lotka_volterra,
        [1.8, 1.0],
        3 * 6.7,
        integral(lambda y: jnp.sum(y - jnp.log(y))),
    ),
    "kepler-0.3": (
        kepler,
        [0.7, 0.0, 0.0, (1.3 / 0.7) ** 0.5],
        6 * np.pi,
        (
            integral(lambda y: jnp.sum(y[2:] ** 2) / 2 - 1 / jnp.linalg.norm(y[:2])),
            integral(momentum),
        ),
    ),
}
# The field, the least and the largest components of initial states, and the conserved logarithm.
MEASURED = {
    "lotka-volterra": (lotka_volterra, 0.5, 1.5, 2, SOLUTIONS["lotka-volterra"][3]),
    "rock-paper-scissors": (
        rock_paper_scissors, 0.3, 1.0, 3, SOLUTIONS["rock-paper-scissors"][3],
    ),
}  # fmt: skip


def trained(network, *args, **options):
    """The network and the log of `fit`, and what it warned of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        network, log = dfc.fit(network, *args, **options)
    return network, log, sorted({str(w.message)[:60] for w in caught})


def layer(name, seed, smoke):
    field, y0, t1, manifold = SOLUTIONS[name]
    ts = jnp.linspace(0, t1, 1000)
    exact = reference(field, jnp.array([y0]), ts)[0]
    network = dfc.PINN(
        jnp.array(y0), 0.0, t1, key=jr.key(seed), layer=dfc.learned.ConservativeLayer(manifold)
    )
    recipe = dfc.learned.second_order(network, epochs=2) if smoke else None
    begun = time.process_time()
    network, log, said = trained(network, field, key=jr.key(seed + 100), recipe=recipe)
    seconds = time.process_time() - begun
    error = jnp.max(jnp.abs(jax.jit(jax.vmap(network))(ts) - exact)) / jnp.max(jnp.abs(exact))
    solution = dfx.diffeqsolve(
        dfx.ODETerm(field), dfc.PINNSolver(network), 0.0, t1, t1 / 1000, network.y0,
        saveat=dfx.SaveAt(steps=True), max_steps=1001,
    )  # fmt: skip
    drift = dfc.drift(solution, manifold)
    return {
        "error": float(error), "estimate over error": float(log.error / error),
        "drift": max(float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(drift)),
        "windows": network.windows, "said": said, "seconds": round(seconds, 1),
    }  # fmt: skip


def logarithm(name, seed, smoke):
    field, least, largest, n, conserved = MEASURED[name]
    y0s = jr.uniform(jr.key(seed), (60, n), minval=least, maxval=largest)
    y0s = y0s / jnp.sum(y0s, axis=1, keepdims=True) if n == 3 else y0s
    ts, ys = dfc.learned.trajectories(field, y0s, jnp.linspace(0, 10, 21))
    states, projected = ys.reshape(-1, n), dfc.learned.ConservativeLayer(conserved)
    network = dfc.DeepONet(states, 1.0, layer=projected, key=jr.key(seed + 50))
    recipe = dfc.learned.second_order(network, epochs=2 if smoke else None)
    begun = time.process_time()
    _, log, said = trained(network, data=(ts, ys), key=jr.key(seed + 100), recipe=recipe)
    seconds = time.process_time() - begun
    return {
        "nan": int(np.sum(np.isnan(log.losses))), "skipped": log.skipped,
        "epochs": log.losses.size, "error": log.error, "said": said, "seconds": round(seconds, 1),
    }  # fmt: skip


def float32(name, seed, smoke):
    field, *_, step = FLOW_MAPS[name]
    states, others, exact = flow_map_data(FLOW_MAPS[name], smoke)
    with jax.enable_x64(False):
        states, others, exact = (jnp.asarray(np.asarray(x, "f4")) for x in (states, others, exact))
        network = dfc.DeepONet(states, step, key=jr.key(seed))
        recipe = dfc.learned.second_order(network, epochs=4 if smoke else None)
        begun = time.process_time()
        network, log, said = trained(
            network, field, sample=states, key=jr.key(seed + 100), recipe=recipe
        )
        seconds = time.process_time() - begun
        found = jax.jit(jax.vmap(lambda y: network(y, step)))(others)
        error = jnp.max(jnp.sqrt(jnp.mean((found - exact) ** 2, axis=0))) / jnp.max(jnp.abs(exact))
    return {
        "skipped": log.skipped, "epochs": log.losses.size, "error": float(error),
        "estimate": log.error, "said": said, "seconds": round(seconds, 1),
    }  # fmt: skip


# What is measured of which systems, and the columns of its table: of these the largest.
KINDS = {
    "layer": (layer, SOLUTIONS, ("error", "estimate over error", "drift", "windows", "seconds")),
    "logarithm": (logarithm, MEASURED, ("nan", "skipped", "epochs", "error", "seconds")),
    "float32": (float32, FLOW_MAPS, ("skipped", "epochs", "error", "seconds")),
}


def shown(x):
    return f"{x:.1e}" if 0 < x < 0.01 else f"{x:.4g}"


def tables(records):
    """For each kind the medians and, behind a stroke, the largest over the seeds."""
    lines = []
    for kind, (_, systems, columns) in KINDS.items():
        lines += ["", f"| {kind} | seeds | warnings | {' | '.join(columns)} |"]
        lines.append("|---" * (3 + len(columns)) + "|")
        for name in systems:
            rows = [r for r in records if (r["kind"], r["system"]) == (kind, name)]
            if rows:
                cells = [[r[c] for r in rows] for c in columns]
                cells = [f"{shown(np.median(x))} / {shown(max(x))}" for x in cells]
                said = sum(bool(r["said"]) for r in rows)
                lines.append(f"| {name} | {len(rows)} | {said} | {' | '.join(cells)} |")
    return "\n".join(lines[1:])


def main(argv=None):
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kind", choices=KINDS, action="append")
    parser.add_argument("--system", action="append")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--smoke", action="store_true")
    options = parser.parse_args(argv)
    records = json.loads(OUT.read_text()) if OUT.exists() and not options.smoke else []
    for kind in [] if options.table else options.kind or KINDS:
        measure, systems, _ = KINDS[kind]
        for name in list(systems)[:1] if options.smoke else options.system or systems:
            for seed in range(1 if options.smoke else options.seeds):
                case = {"kind": kind, "system": name, "seed": seed}
                found = measure(name, seed, options.smoke)
                records = kept(records, case, found, None if options.smoke else OUT)
    print(tables(records))
    return records


if __name__ == "__main__":
    main()
