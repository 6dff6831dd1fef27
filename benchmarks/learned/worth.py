"""What a learned step is worth: time for a step at equal error, over the cost of the field.

    python benchmarks/learned/worth.py            # trains, measures, writes ../results/worth.json
    python benchmarks/learned/worth.py --table    # only the table and the figure of the results
    python benchmarks/learned/worth.py --smoke    # toy sizes, to see that it runs

A pendulum, q'' = -sin q + g(q, q') with g of growing cost: nothing, a neural network of width 32 or
128 with two hidden layers, also in float32, a quadrature of 64 points, or an inner solve, ten
iterations for a fixed point. For each of these a flow map is trained from the vector field, all by
the same recipe, and evaluated in float32.

A classical method takes the step in so many equal pieces that the root mean square of its error is
that of the flow map. That number is not rounded: it is interpolated between whole ones, in
logarithms, to its favour. Times are those of 20 steps in one compiled loop, without diffrax around
it on either side; all methods take turns, and the best round counts. A ratio above one is by how
much the learned step is faster than the best of the classical methods.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_conserve as dfc

jax.config.update("jax_enable_x64", True)
RESULTS = Path(__file__).parents[1] / "results" / "worth.json"
IMAGES = Path(__file__).parents[2] / "docs" / "images"
STEP, STEPS = 0.5, 20
METHODS = {
    "RK4": dfc.RK4(),
    "Tsit5": dfc.Unrolled(dfx.Tsit5()),
    "Dopri8": dfc.Unrolled(dfx.Dopri8()),
}
PIECES = {"RK4": (1, 2, 3, 4, 6, 8), "Tsit5": (1, 2, 3, 4), "Dopri8": (1, 2)}


# ---- The vector fields ----


def neural(width, dtype=jnp.float64):
    keys = jr.split(jr.key(width), 3)
    shapes = [(2, width), (width, width), (width, 1)]
    weights = [jr.normal(k, s) / s[0] ** 0.5 for k, s in zip(keys, shapes, strict=True)]
    weights = [w.astype(dtype) for w in weights]

    def force(y):
        x = y.astype(dtype)
        for w in weights[:-1]:
            x = jnp.tanh(x @ w)
        return 0.2 * (x @ weights[-1])[0].astype(y.dtype)

    return force


def quadrature(y):
    x, w = map(jnp.asarray, np.polynomial.legendre.leggauss(64))
    return 0.1 * jnp.sum(w * jnp.cos(3 * x * y[0]) * jnp.exp(-x * y[1]))


def inner_solve(y):
    x = jnp.zeros(())
    for _ in range(10):
        x = 0.5 * jnp.cos(x + y[0]) + 0.1 * y[1]
    return 0.2 * x


FORCES = {
    "cheap": lambda y: 0.0,
    "inner solve": inner_solve,
    "neural 32": neural(32),
    "quadrature": quadrature,
    "neural 128, float32": neural(128, jnp.float32),
    "neural 128": neural(128),
}


def field_of(force):
    return lambda t, y, args: jnp.stack([y[1], -jnp.sin(y[0]) + force(y)])


def sample(key):
    return jr.uniform(key, (2,), minval=-1.5, maxval=1.5)


# ---- Errors and times ----


def train(field, epochs):
    states = jax.vmap(sample)(jr.split(jr.key(0), 500))
    network = dfc.DeepONet(states, STEP, width=32, depth=2, core="concatenated", key=jr.key(1))
    recipe = dfc.learned.second_order(network, epochs=epochs)
    recipe = dataclasses.replace(recipe, points=min(150, 10 * epochs))
    return dfc.fit(network, field, sample=sample, recipe=recipe, key=jr.key(2))


def piece_of(solver, field):
    """`(y, h) -> y`, one step of a classical method."""
    term = dfx.ODETerm(field)

    def step(y, h):
        zero = jnp.zeros_like(h)
        state = solver.init(term, zero, h, y, None)
        return solver.step(term, zero, h, y, None, state, False)[0]

    return step


def in_pieces(step, count):
    if count == 1:
        return lambda y: step(y, jnp.asarray(STEP))
    each = jnp.asarray(STEP / count)
    return lambda y: lax.fori_loop(0, count, lambda _, y: step(y, each), y)


def rms(step, y0s, exact):
    return float(jnp.sqrt(jnp.mean((eqx.filter_jit(jax.vmap(step))(y0s) - exact) ** 2)))


def compiled(step, y0s, count):
    def steps(y0s):
        return lax.fori_loop(0, count, lambda _, y: jax.vmap(step)(y), y0s)

    run = jax.jit(steps).lower(y0s).compile()
    return lambda: run(y0s).block_until_ready()


def take_turns(steps, y0s, seconds):
    """The best time of each, in nanoseconds for a step of one state."""
    # Enough of them for the clock, and no more: long ones need no repetition.
    count = max(1, min(STEPS, STEPS * 1000 // len(y0s)))
    calls = {key: compiled(step, y0s, count) for key, step in steps.items()}
    best, begun, rounds = dict.fromkeys(calls, np.inf), time.perf_counter(), 0
    while rounds == 0 or time.perf_counter() - begun < seconds:
        for key, call in calls.items():
            turn = time.perf_counter()
            # Short calls several times, or their best is worse than that of long ones.
            while True:
                start = time.perf_counter()
                call()
                now = time.perf_counter()
                best[key] = min(best[key], now - start)
                if now - turn > seconds / 300:
                    break
        rounds += 1
    return {key: 1e9 * best[key] / count / len(y0s) for key in calls}


def around(errors, error):
    """Between which two numbers of pieces a method has this error, and the weight of the second.

    Beyond the last number the weight is above one, by the order of the method.
    """
    counts = sorted(errors)
    if error >= errors[counts[0]]:
        return counts[0], counts[1], 0.0
    second = next((n for n in counts if errors[n] <= error), counts[-1])
    first = counts[counts.index(second) - 1]
    return first, second, np.log(errors[first] / error) / np.log(errors[first] / errors[second])


def measure(name, epochs, batches, count, seconds):
    field = field_of(FORCES[name])
    network, log = train(field, epochs)
    single = jax.tree.map(lambda x: x.astype(jnp.float32), network.core)
    network = eqx.tree_at(lambda m: m.core, network, single)
    y0s = jax.vmap(sample)(jr.split(jr.key(9), count))
    exact = jax.jit(jax.vmap(in_pieces(piece_of(dfx.Dopri8(), field), 20)))(y0s)
    steps = {("learned", 1): lambda y: network(y, jnp.asarray(STEP))}
    for method, counts in PIECES.items():
        piece = piece_of(METHODS[method], field)
        steps |= {(method, n): in_pieces(piece, n) for n in counts}
    errors = {key: rms(step, y0s, exact) for key, step in steps.items()}
    error = errors["learned", 1]
    places = {m: around({n: errors[m, n] for n in ns}, error) for m, ns in PIECES.items()}
    needed = {("learned", 1)} | {(m, n) for m, (a, b, _) in places.items() for n in (a, b)}
    row = {"field": name, "training_seconds": log.seconds, "error": error, "batches": {}}
    row |= {"errors": {m: {n: errors[m, n] for n in ns} for m, ns in PIECES.items()}}
    for batch in batches:
        many = jax.vmap(sample)(jr.split(jr.key(5), batch))
        ns = take_turns({key: steps[key] for key in steps if key in needed}, many, seconds)
        equal = {
            m: float(ns[m, a] ** (1 - weight) * ns[m, b] ** weight)
            for m, (a, b, weight) in places.items()
        }
        best = min(equal, key=equal.get)
        learned = ns["learned", 1]
        row["batches"][str(batch)] = {
            "learned_ns": learned, "at_equal_error_ns": equal, "best": best,
            "ratio": equal[best] / learned,
        }  # fmt: skip
    return row


# ---- The table and the figure ----


def table(rows):
    batches = list(rows[0]["batches"])
    head = ["vector field", "error of a step", *(f"batch of {int(b):,}" for b in batches)]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for row in rows:
        cells = [row["field"], f"{row['error']:.1e}"]
        for b in row["batches"].values():
            cells.append(f"{b['ratio']:.2g} ({b['best']}, {b['learned_ns']:,.0f} ns)")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def figure(rows):
    """A row for each force, which have no order, so that no line joins them."""
    import matplotlib.pyplot as plt

    plt.style.use(Path(__file__).parents[2] / "docs" / "figures.mplstyle")
    fig, ax = plt.subplots()
    places = np.arange(len(rows))
    looks = zip("osD", ("right", "right", "left"), rows[0]["batches"], strict=False)
    for marker, side, batch in looks:
        ratios = [row["batches"][batch]["ratio"] for row in rows]
        (line,) = ax.semilogx(ratios, places, marker)
        name = f"batch of {batch}" if batch == "1" else f"{int(batch):,}"
        place = (ratios[-1], places[-1])
        look = dict(textcoords="offset points", ha=side, color=line.get_color())
        ax.annotate(name, place, (0, 8), **look)
    ax.axvline(1, color="black", linewidth=0.8)
    ax.set_yticks(places, [row["field"] for row in rows])
    ax.set(xlabel="classical time over learned time, alone and in batches")
    ax.set(ylabel="force added", ylim=(-0.5, len(rows) - 0.2))
    fig.savefig(IMAGES / "worth.svg", metadata={"Date": None})


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true", help="toy sizes, nothing is written")
    parser.add_argument("--table", action="store_true", help="only print what was measured")
    options = parser.parse_args(argv)
    if options.table:
        rows = json.loads(RESULTS.read_text())
        figure(rows)
        print(table(rows))
        return rows
    sizes = (2, (1, 4), 5, 0.0) if options.smoke else (600, (1, 1000, 100_000), 1000, 6.0)
    rows = []
    for name in ("cheap", "neural 32") if options.smoke else FORCES:
        rows.append(measure(name, *sizes))
        print(table(rows[-1:]), flush=True)
    if not options.smoke:
        RESULTS.write_text(json.dumps(rows, indent=1) + "\n")
        figure(rows)
    return rows


if __name__ == "__main__":
    main()
