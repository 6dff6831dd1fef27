"""Correction sweeps and error estimates of learned flow maps, against classical methods.

    python benchmarks/cost/sweeps.py           # the shipped networks; writes results/sweeps.json
    python benchmarks/cost/sweeps.py NAME ...  # these shipped networks
    python benchmarks/cost/sweeps.py --smoke   # toy sizes, to see that it runs

The error is that of one step of the flow map's longest length, from random states of the domain,
against a solve at tolerance 1e-13: the median of the Euclidean norms. The cost is that of a
compiled solve with such steps, in processor time for each step and state. A classical method takes
the same step in several pieces; its error at the cost of a learned step is interpolated between
whole numbers of pieces.
"""

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import measuring
import numpy as np

import diffrax_conserve as dfc

OUT = Path(__file__).parent.parent / "results" / "sweeps.json"
FLOW_MAPS = ("conservative-lorenz", "double-pendulum", "point-vortices")
NETWORKS = tuple(f"{name}-standard" for name in FLOW_MAPS)
SHIPPED = tuple(f"{name}-{kind}" for name in FLOW_MAPS for kind in ("standard", "conservative"))
CLASSICAL = {"RK4": dfc.RK4(), "Tsit5": dfx.Tsit5(), "Dopri8": dfx.Dopri8()}
# Closer vortices turn about each other by more than half a radian in a step.
SEPARATION = 0.3


@dataclasses.dataclass(frozen=True)
class Size:
    states: int = 100
    steps: int = 20
    repeats: int = 5
    sweeps: tuple[int, ...] = (0, 1, 2, 3, 4, 6, 8)
    pieces: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 128)
    classical: tuple[str, ...] = tuple(CLASSICAL)


SMOKE = Size(states=1, steps=4, repeats=2, sweeps=(0, 2), pieces=(1, 4), classical=("RK4",))


def system_of(network):
    """The system of the catalogue whose name the network's begins with."""
    return dfc.systems.get(max((n for n in dfc.systems.names() if network.startswith(n)), key=len))


def states_of(system, count, factor=1.0):
    """Random states; a `factor` above one moves them away from their mean, out of the domain."""
    drawn = jax.vmap(system.sample)(jr.split(jr.key(11), 20 * count))
    if system.name == "point-vortices":
        gaps = jnp.linalg.norm(drawn[:, :, None] - drawn[:, None, :] + 0.0, axis=-1)
        apart = jnp.min(gaps + 1e9 * jnp.eye(drawn.shape[1]), axis=(1, 2)) > SEPARATION
        drawn = drawn[apart]
    drawn = drawn[:count]
    mean = jnp.mean(drawn, axis=0)
    return mean + factor * (drawn - mean)


def norms(vectors):
    return jnp.linalg.norm(vectors.reshape(vectors.shape[0], -1), axis=1)


@eqx.filter_jit
def exact(system, h, y0s):
    controller = dfx.PIDController(rtol=1e-13, atol=1e-13)

    def one(y0):
        term = dfx.ODETerm(system.vector_field)
        return dfx.diffeqsolve(
            term,
            dfx.Dopri8(),
            0.0,
            h,
            h / 1000,
            y0,
            stepsize_controller=controller,
            max_steps=100_000,
        ).ys[-1]

    return jax.vmap(one)(y0s)


@eqx.filter_jit
def one_step(solver, system, h, y0s):
    """The states after a step, and the error estimates."""
    term, t0 = dfx.ODETerm(system.vector_field), jnp.zeros(())

    def one(y0):
        state = solver.init(term, t0, h, y0, None)
        y1, error, *_ = solver.step(term, t0, h, y0, None, state, False)
        return y1, error

    return jax.vmap(one)(y0s)


def compile_solve(solver, system, y0s, max_steps):
    def solve(solver, y0s, span, dt):
        def one(y0):
            term = dfx.ODETerm(system.vector_field)
            return dfx.diffeqsolve(
                term, solver, 0.0, span, dt, y0, max_steps=max_steps, throw=False
            ).ys

        return jax.vmap(one)(y0s)

    dt = jnp.asarray(1.0)
    return eqx.filter_jit(solve).lower(solver, y0s, dt, dt).compile()


def seconds(call, repeats):
    return measuring.take_turns({"": call}, repeats + 1)[""].seconds


@dataclasses.dataclass(frozen=True)
class Solve:
    """A compiled solve, whose steps may be made of so many pieces."""

    compiled: Any
    solver: Any
    y0s: Any

    @classmethod
    def both(cls, solver, system, y0s, size, pieces=(1,)):
        """Of all states, and of one alone."""
        max_steps = size.steps * max(pieces) + 1
        starts = [y0s] if len(y0s) == 1 else [y0s, y0s[:1]]
        found = [cls(compile_solve(solver, system, y, max_steps), solver, y) for y in starts]
        return found[0], found[-1]

    def __call__(self, span, dt):
        return self.compiled(self.solver, self.y0s, jnp.asarray(span), jnp.asarray(dt))

    def us(self, h, size, pieces=1):
        """For each step of length `h` and each state."""
        span, dt = h * size.steps, h / pieces
        return 1e6 * seconds(lambda: self(span, dt), size.repeats) / size.steps / len(self.y0s)


def sweeps(name, size):
    """Error and cost of each number of sweeps, and of the classical methods."""
    network, system = dfc.load_pretrained(name), system_of(name)
    h, y0s = jnp.asarray(network.max_step), states_of(system, size.states)
    expected = exact(system, h, y0s)
    rows, classical = [], {}
    for k in size.sweeps:
        solver = dfc.DeepONetSolver(network, corrections=k)
        y1s, estimates = one_step(solver, system, h, y0s)
        batch, alone = Solve.both(solver, system, y0s, size)
        row = {
            "corrections": k,
            "error": float(jnp.median(norms(y1s - expected))),
            "estimate": float(jnp.median(norms(estimates))),
            "us": batch.us(h, size),
            "us_alone": alone.us(h, size),
        }
        rows.append(row)
    for label in size.classical:
        solver = CLASSICAL[label]
        batch, alone = Solve.both(solver, system, y0s, size, size.pieces)
        classical[label] = {
            "pieces": size.pieces,
            "error": [
                float(jnp.median(norms(batch(h, h / m)[:, -1] - expected))) for m in size.pieces
            ],
            "us": [batch.us(h, size, m) for m in size.pieces],
            "us_alone": [alone.us(h, size, m) for m in size.pieces],
        }
    for row in rows:
        for label, curve in classical.items():
            for us in ("us", "us_alone"):
                row[f"{label}, {us}"] = at_cost(row[us], curve[us], curve["error"])
    return {"step": float(h), "rows": rows, "classical": classical}


def at_cost(us, costs, errors):
    """The error of a classical method at the cost `us`; where not even one piece is as cheap,
    nothing."""
    costs = np.maximum.accumulate(np.asarray(costs))
    if us < costs[0]:
        return None
    return float(np.exp(np.interp(np.log(us), np.log(costs), np.log(np.maximum(errors, 1e-17)))))


def estimates(name, size):
    """Estimated over true error of one step: its 5th, 50th and 95th percentile."""
    network, system = dfc.load_pretrained(name), system_of(name)
    h = jnp.asarray(network.max_step)
    found = {}
    for place, factor in (("inside", 1.0), ("outside", 1.5)):
        y0s = states_of(system, size.states, factor)
        y1s, guesses = one_step(dfc.DeepONetSolver(network), system, h, y0s)
        errors = norms(exact(system, h, y0s) - y1s)
        ratio = np.asarray(norms(guesses) / errors)
        found[place] = {
            "error": float(jnp.median(errors)),
            "ratio": np.percentile(ratio, [5, 50, 95]).tolist(),
            "extremes": [float(ratio.min()), float(ratio.max())],
        }
    return found


def show_sweeps(name, found):
    print(f"\n`{name}`, one step of {found['step']:g}; times for each state, in a batch / alone\n")
    labels = list(found["classical"])
    print("| sweeps | error | µs | " + " | ".join(f"{x}, same cost" for x in labels) + " |")
    print("|---|---|---|" + "---|" * len(labels))

    def text(error):
        return "-" if error is None else f"{error:.1e}"

    for row in found["rows"]:
        label = row["corrections"] or "none"
        others = [f"{text(row[f'{x}, us'])} / {text(row[f'{x}, us_alone'])}" for x in labels]
        times = f"{row['us']:.3g} / {row['us_alone']:.3g}"
        print(f"| {label} | {row['error']:.1e} | {times} | " + " | ".join(others) + " |")


def show_estimates(found):
    print("\n| network | error inside | ratio 5 / 50 / 95 % | error outside | ratio |")
    print("|---|---|---|---|---|")
    for name, places in found.items():
        cells = []
        for place in places.values():
            cells += [f"{place['error']:.1e}", " / ".join(f"{r:.3f}" for r in place["ratio"])]
        print(f"| `{name}` | " + " | ".join(cells) + " |")


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("networks", nargs="*", metavar="NAME", help="shipped networks")
    parser.add_argument("--smoke", action="store_true", help="toy sizes, nothing is written")
    parser.add_argument("--out", type=Path, default=OUT, help="the JSON file")
    options = parser.parse_args(argv)
    size = SMOKE if options.smoke else Size()
    networks = tuple(options.networks) or (NETWORKS[:1] if options.smoke else NETWORKS)
    judged = tuple(options.networks) or (networks if options.smoke else SHIPPED)
    found = {
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "size": dataclasses.asdict(size),
        "sweeps": {},
        "estimates": {},
    }
    for name in networks:
        found["sweeps"][name] = sweeps(name, size)
        show_sweeps(name, found["sweeps"][name])
    for name in judged:
        found["estimates"][name] = estimates(name, size)
    show_estimates(found["estimates"])
    if not options.smoke:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(found, indent=1) + "\n")
    return found


if __name__ == "__main__":
    main()
