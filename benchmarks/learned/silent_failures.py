"""How often a PINN is wrong, and whether it says so: four oscillators over three periods.

    python benchmarks/learned/silent_failures.py  # 25 seeds: writes results/silent_failures.json
    python benchmarks/learned/silent_failures.py --seeds 5  # fewer
    python benchmarks/learned/silent_failures.py --table  # only print the table of the results
    python benchmarks/learned/silent_failures.py --smoke  # one seed of one system, few epochs

Twelve windows of thirty units, trained with `target=1e-8`. A silent failure is an error above 1e-4,
relative to the largest component, without a warning. The reference is Dopri8 at 1e-13.
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

import diffrax_conserve as dfc

jax.config.update("jax_enable_x64", True)
OUT = Path(__file__).parent.parent / "results" / "silent_failures.json"
TARGET, SILENT = 1e-8, 1e-4


def pendulum(t, y, args):
    return jnp.stack([y[1], -jnp.sin(y[0])])


def duffing(t, y, args):
    return jnp.stack([y[1], y[0] - y[0] ** 3])


def van_der_pol(t, y, args):
    return jnp.stack([y[1], 2 * (1 - y[0] ** 2) * y[1] - y[0]])


def kepler(t, y, args):
    q = y[:2]
    return jnp.concatenate([y[2:], -q / jnp.sum(q**2) ** 1.5])


# The field, the initial state and three periods.
PROBLEMS = {
    "pendulum from 2.2 rad": (pendulum, [2.2, 0.0], 3 * 9.1214),
    "Duffing": (duffing, [1.7, 0.0], 3 * 6.6667),
    "van der Pol, mu = 2": (van_der_pol, [2.0, 0.0], 3 * 7.6299),
    "Kepler, e = 0.3": (kepler, [0.7, 0.0, 0.0, (1.3 / 0.7) ** 0.5], 3 * 2 * np.pi),
}


def reference(field, y0, t1):
    ts = jnp.linspace(0, t1, 1000)
    controller = dfx.PIDController(rtol=1e-13, atol=1e-13)
    return ts, dfx.diffeqsolve(
        dfx.ODETerm(field), dfx.Dopri8(), 0.0, t1, None, y0,
        stepsize_controller=dfx.ClipStepSizeController(controller, step_ts=ts),
        saveat=dfx.SaveAt(ts=ts), max_steps=10**6,
    ).ys  # fmt: skip


def measure(name, seed, ts, exact, epochs):
    field, y0, t1 = PROBLEMS[name]
    started, begun = time.process_time(), time.perf_counter()
    key = jr.key(seed)
    pinn = dfc.PINN(jnp.array(y0), 0.0, t1, windows=12, width=30, depth=1, slope=2.0, key=key)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        recipe = dfc.learned.second_order(pinn, epochs=epochs)
        pinn, log = dfc.fit(pinn, field, key=jr.fold_in(key, 1), recipe=recipe, target=TARGET)
    seconds = time.process_time() - started, time.perf_counter() - begun
    found = jax.jit(jax.vmap(pinn))(ts)
    error = float(jnp.max(jnp.abs(found - exact)) / jnp.max(jnp.abs(exact)))
    warned = any("is not the solution" in str(w.message) for w in caught)
    record = {"problem": name, "seed": seed, "error": error, "estimate": log.error}
    record |= {"warned": warned, "windows": pinn.windows, "trainings": log.state.trained + 1}
    return record | {"cpu_seconds": round(seconds[0], 1), "seconds": round(seconds[1], 1)}


def table(records):
    lines = [
        "| problem | seeds | silent failures | warned | below 1e-8 | median error | largest error "
        "| estimate / error, 5 to 95 % | windows, median | s, median | s, largest |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(r["problem"] for r in records):
        rows = [r for r in records if r["problem"] == name]
        get = lambda key, rows=rows: np.array([r[key] for r in rows])  # noqa: E731
        errors, warned = get("error"), get("warned")
        low, high = np.percentile(get("estimate") / errors, [5, 95])
        lines.append(
            f"| {name} | {len(rows)} | {np.sum((errors > SILENT) & ~warned)} | {np.sum(warned)} "
            f"| {np.sum(errors < TARGET)} | {np.median(errors):.1e} | {np.max(errors):.1e} "
            f"| {low:.2f} to {high:.2f} | {np.median(get('windows')):.0f} "
            f"| {np.median(get('cpu_seconds')):.0f} | {np.max(get('cpu_seconds')):.0f} |"
        )
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=25)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--smoke", action="store_true")
    options = parser.parse_args()
    if options.table:
        print(table(json.loads(OUT.read_text())))
        return
    records, problems = [], list(PROBLEMS)
    for name in problems[:1] if options.smoke else problems:
        field, y0, t1 = PROBLEMS[name]
        ts, exact = reference(field, jnp.array(y0), t1)
        for seed in range(1 if options.smoke else options.seeds):
            records.append(measure(name, seed, ts, exact, 5 if options.smoke else None))
            print(json.dumps(records[-1]), flush=True)
    if not options.smoke:
        OUT.write_text(json.dumps(records, indent=1) + "\n")
    print(table(records))


if __name__ == "__main__":
    main()
