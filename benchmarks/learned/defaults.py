"""What `DeepONet`, `PINN` and `fit` reach without options, and what the paper's networks reach.

    python benchmarks/learned/defaults.py            # writes results/defaults.json
    python benchmarks/learned/defaults.py --table    # only print the table of the results
    python benchmarks/learned/defaults.py --kind pinn --seeds 20 --system kepler-0.6
    python benchmarks/learned/defaults.py --smoke    # toy sizes, to see that it runs

A flow map is judged by the root mean square error of its longest step at 300 other states along
solutions, a PINN by its largest error in three periods; both relative to the largest component.
The reference is Dopri8 at 1e-12. `before` is what was the default: four layers of 40 units, a
product of branch and trunk, no Taylor polynomial, one window; trained by the same second-order
recipe for about the same time. Seconds are processor seconds, with compilation.
"""

import argparse
import dataclasses
import json
import time
import warnings
from pathlib import Path

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_conserve as dfc

OUT = Path(__file__).parent.parent / "results" / "defaults.json"


def pendulum(t, y, args):
    return jnp.stack([y[1], -jnp.sin(y[0])])


def duffing(t, y, args):
    return jnp.stack([y[1], y[0] - y[0] ** 3])


def driven(t, y, args):
    """A damped Duffing oscillator; the phase of the force is a state."""
    force = 0.3 * jnp.cos(y[2]) - 0.1 * y[1]
    return jnp.stack([y[1], y[0] - y[0] ** 3 + force, jnp.asarray(1.2)])


def van_der_pol(t, y, args):
    return jnp.stack([y[1], 2 * (1 - y[0] ** 2) * y[1] - y[0]])


def lotka_volterra(t, y, args):
    return jnp.stack([y[0] * (1 - y[1]), y[1] * (y[0] - 1)])


def lorenz(t, y, args):
    x, y, z = y
    return jnp.stack([10 * (y - x), x * (28 - z) - y, x * y - 8 / 3 * z])


def chain(t, y, args):
    """Two masses between walls, coupled by springs that harden."""
    stretch = jnp.diff(y[:2], prepend=0.0, append=0.0)
    return jnp.concatenate([y[2:], jnp.diff(stretch + 0.5 * stretch**3)])


def kepler(t, y, args):
    return jnp.concatenate([y[2:], -y[:2] / jnp.sum(y[:2] ** 2) ** 1.5])


# The field, the box of initial states, the time for which they are followed, and the longest step.
FLOW_MAPS = {
    "pendulum": (pendulum, [-1.5, -1.0], [1.5, 1.0], 10.0, 0.5),
    "duffing-driven": (driven, [-1.0, -1.0, 0.0], [1.0, 1.0, 6.28], 5.0, 0.4),
    "van-der-pol": (van_der_pol, [-2.0, -2.0], [2.0, 2.0], 8.0, 0.2),
    "lotka-volterra": (lotka_volterra, [0.5, 0.5], [2.0, 2.0], 10.0, 0.5),
    "lorenz": (lorenz, [-10.0, -10.0, 10.0], [10.0, 10.0, 35.0], 10.0, 0.05),
    "chain": (chain, [-1.0] * 4, [1.0] * 4, 10.0, 0.3),
}
# The field, the initial state and three periods.
PINNS = {
    "pendulum-2.2": (pendulum, [2.2, 0.0], 3 * 9.1214),
    "duffing": (duffing, [1.7, 0.0], 3 * 6.6667),
    "van-der-pol": (van_der_pol, [2.0, 0.0], 3 * 7.6299),
    "kepler-0.3": (kepler, [0.7, 0.0, 0.0, (1.3 / 0.7) ** 0.5], 6 * np.pi),
    "kepler-0.6": (kepler, [0.4, 0.0, 0.0, 2.0], 6 * np.pi),
}


def reference(field, y0s, ts):
    controller = dfx.PIDController(rtol=1e-12, atol=1e-12)
    controller = dfx.ClipStepSizeController(controller, step_ts=ts)

    def one(y0):
        return dfx.diffeqsolve(
            dfx.ODETerm(field), dfx.Dopri8(), 0.0, ts[-1], None, y0,
            stepsize_controller=controller, saveat=dfx.SaveAt(ts=ts), max_steps=10**5,
        ).ys  # fmt: skip

    return jax.jit(jax.vmap(one))(y0s)


def flow_map_data(system, smoke):
    """States to train on, others along other solutions, and these after the longest step."""
    field, lower, upper, duration, step = system
    box = dfc.learned.Box(jnp.array(lower), jnp.array(upper))
    states, others = (
        dfc.learned.reachable_states(
            field, jax.vmap(box.sample)(jr.split(jr.key(k), count)), duration, key=jr.key(k + 1)
        )
        for k, count in ((0, 50 if smoke else 1000), (10, 300))
    )
    return states, others, reference(field, others, jnp.array([step]))[:, 0]


def judged(system, data, make, changes, seed):
    """Error, estimate and seconds of the network of `make`, with `changes` of the recipe."""
    (field, *_, step), (states, others, exact) = system, data
    started = time.process_time()
    network = make(states, step, key=jr.key(seed))
    recipe = dataclasses.replace(dfc.learned.second_order(network), **changes)
    network, log = dfc.fit(network, field, sample=states, key=jr.key(seed + 100), recipe=recipe)
    seconds = time.process_time() - started
    found = jax.jit(jax.vmap(lambda y: network(y, step)))(others)
    error = jnp.max(jnp.sqrt(jnp.mean((found - exact) ** 2, axis=0))) / jnp.max(jnp.abs(exact))
    return {"error": float(error), "estimate": log.error, "seconds": round(seconds, 1)}


def flow_map(name, before, seed, smoke):
    make = dfc.learned.paper.deeponet if before else dfc.DeepONet
    changes = {"taylor": 0, "epochs": 120} if before else {}
    changes |= {"epochs": 4} if smoke else {}
    system = FLOW_MAPS[name]
    return judged(system, flow_map_data(system, smoke), make, changes, seed)


def pinn(name, before, seed, smoke):
    field, y0, t1 = PINNS[name]
    ts = jnp.linspace(0, t1, 1000)
    exact = reference(field, jnp.array([y0]), ts)[0]
    started = time.process_time()
    make = dfc.learned.paper.pinn if before else dfc.PINN
    network = make(jnp.array(y0), 0.0, t1, key=jr.key(seed))
    recipe = dfc.learned.second_order(network, epochs=2 if smoke else 300 if before else None)
    recipe = dataclasses.replace(recipe, retries=0 if smoke else recipe.retries)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        network, log = dfc.fit(network, field, key=jr.key(seed + 100), recipe=recipe)
    seconds = time.process_time() - started
    error = jnp.max(jnp.abs(jax.jit(jax.vmap(network))(ts) - exact)) / jnp.max(jnp.abs(exact))
    record = {"error": float(error), "estimate": log.error, "seconds": round(seconds, 1)}
    warned = any("is not the solution" in str(w.message) for w in caught)
    return record | {"warned": warned, "windows": network.windows}


def table(records):
    """Medians over the seeds, and how many are below 1e-7 or silently wrong."""
    lines = [
        "| network | system | error before | s | error | s | below 1e-7; silently wrong |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind, name in dict.fromkeys((r["kind"], r["system"]) for r in records):
        rows = [r for r in records if (r["kind"], r["system"]) == (kind, name)]
        cells = []
        for before in (True, False):
            some = [r for r in rows if r["before"] == before]
            for key, form in (("error", ".1e"), ("seconds", ".0f")):
                cells.append(format(np.median([r[key] for r in some]), form) if some else "")
        new = [r for r in rows if not r["before"]]
        below = sum(r["error"] < 1e-7 for r in new)
        silent = sum(r["error"] > 1e-4 and not r["warned"] for r in new if kind == "pinn")
        cells.append(f"{below} of {len(new)}; {silent}" if kind == "pinn" else "")
        lines.append(f"| {kind} | {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def kept(records, case, found, out):
    """The records with what was found for a case in the place of what was, written to `out` too."""
    print(json.dumps(case | found), flush=True)
    records = [*(r for r in records if not case.items() <= r.items()), case | found]
    if out is not None:
        out.write_text(json.dumps(records, indent=1) + "\n")
    return records


def main(argv=None):
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kind", choices=("flow map", "pinn"), action="append")
    parser.add_argument("--system", action="append")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--before", action="store_true", help="only what was the default")
    parser.add_argument("--after", action="store_true", help="only what is the default")
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--smoke", action="store_true")
    options = parser.parse_args(argv)
    records = json.loads(OUT.read_text()) if OUT.exists() and not options.smoke else []
    kinds = {"flow map": (flow_map, FLOW_MAPS), "pinn": (pinn, PINNS)}
    for kind in [] if options.table else options.kind or kinds:
        measure, systems = kinds[kind]
        for name in systems if not options.smoke else list(systems)[:1]:
            if options.system and name not in options.system:
                continue
            for before in (True, False):
                if (before and (options.after or options.smoke)) or (options.before and not before):
                    continue
                for seed in range(options.seeds):
                    case = {"kind": kind, "system": name, "before": before, "seed": seed}
                    found = measure(name, before, seed, options.smoke)
                    records = kept(records, case, found, None if options.smoke else OUT)
    print(table(records))
    return records


if __name__ == "__main__":
    main()
