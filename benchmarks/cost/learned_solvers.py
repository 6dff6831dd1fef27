"""What learned solvers cost: a training epoch, and a solve against the bare network.

    python benchmarks/cost/learned_solvers.py  # writes its results, prints tables
    python benchmarks/cost/learned_solvers.py --smoke  # toy sizes, to see that it runs

An epoch is one value and gradient of the loss, at the sizes of the paper's recipe; that of the
conservative network with all iterations of its layer, which is the most a schedule asks for.
"""

import argparse
import json
import time
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr

import diffrax_conserve as dfc
from diffrax_conserve.learned._training.objective import Problem, start
from diffrax_conserve.reproduce._trained import KINDS, build, is_flow_map, is_learned

OUT = Path(__file__).parent.parent / "results" / "learned_solvers.json"
SYSTEMS = [name for name in dfc.systems.names() if is_learned(dfc.systems.get(name))]


def compiled(function, *arguments):
    """The compiled function, and how long that took."""
    started = time.perf_counter()
    out = eqx.filter_jit(function).lower(*arguments).compile()
    return out, time.perf_counter() - started


def best_times(contestants, repeats):
    """The shortest time of each of several calls, interleaved."""
    best = dict.fromkeys(contestants, float("inf"))
    for _ in range(repeats + 1):
        for name, call in contestants.items():
            started = time.perf_counter()
            jax.block_until_ready(call())
            best[name] = min(best[name], time.perf_counter() - started)
    return best


def epoch(system, kind, points):
    """A call that makes one epoch without its update, and its compile time."""
    network = build(system, kind, jr.key(0), jr.key(1))
    if isinstance(network, dfc.PINN):
        network = network.window(0)
    sample = system.sample if is_flow_map(system) else None
    recipe = dfc.learned.Recipe(epochs=1, points=points)
    problem = Problem(system.vector_field, None, sample, None, recipe)
    objective, carry = start(problem, network, jr.key(2))

    def gradient(objective, carry, schedule):
        return jax.value_and_grad(objective.loss)(carry.weights, objective.first_points, schedule)

    arguments = (objective, carry, objective.schedule(jnp.asarray(0)))
    call, seconds = compiled(gradient, *arguments)
    return lambda: call(*arguments), seconds


def epochs(name, smoke):
    system = dfc.systems.get(name)
    points = 20 if smoke else (5000 if is_flow_map(system) else 2000)
    calls, compile_seconds = {}, {}
    for kind in KINDS:
        calls[kind], compile_seconds[kind] = epoch(system, kind, points)
    times = best_times(calls, 2 if smoke else 20)
    return {
        "ms": {kind: 1e3 * times[kind] for kind in KINDS},
        "ratio": times["conservative"] / times["standard"],
        "compile_seconds": compile_seconds,
    }


def solves(smoke):
    """`diffeqsolve` with a DeepONet on many states against a loop over the batched network."""
    system = dfc.systems.get("conservative-lorenz")
    network = build(system, "standard", jr.key(0), jr.key(1))
    states, steps = (10, 4) if smoke else (1000, 100)
    y0s = jax.vmap(system.sample)(jr.split(jr.key(3), states))
    term, solver = dfx.ODETerm(system.vector_field), dfc.DeepONetSolver(network, check_field=False)
    dt = system.dt

    def solve(solver, y0s):
        def one(y0):
            saveat = dfx.SaveAt(steps=True)
            return dfx.diffeqsolve(
                term, solver, 0.0, steps * dt, dt, y0, saveat=saveat, max_steps=steps
            ).ys

        return jax.vmap(one)(y0s)

    def bare(network, y0s):
        def step(ys, _):
            ys = jax.vmap(lambda y: network(y, dt))(ys)
            return ys, ys

        return jnp.swapaxes(jax.lax.scan(step, y0s, None, length=steps)[1], 0, 1)

    solve, _ = compiled(solve, solver, y0s)
    bare, _ = compiled(bare, network, y0s)
    assert float(jnp.max(jnp.abs(solve(solver, y0s) - bare(network, y0s)))) < 1e-12
    calls = {"diffeqsolve": lambda: solve(solver, y0s), "bare": lambda: bare(network, y0s)}
    times = best_times(calls, 2 if smoke else 20)
    per_step = {name: 1e9 * t / (states * steps) for name, t in times.items()}
    return {
        "states": states,
        "steps": steps,
        "ns_per_step_and_state": per_step,
        "ratio": times["diffeqsolve"] / times["bare"],
    }


def main(argv=None):
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true", help="toy sizes, nothing is written")
    options = parser.parse_args(argv)
    names = SYSTEMS[1:2] if options.smoke else SYSTEMS
    found = {
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "epochs": {name: epochs(name, options.smoke) for name in names},
        "solves": solves(options.smoke),
    }
    print(
        "| system | standard, ms | conservative, ms | ratio | compile, s |\n|---|---|---|---|---|"
    )
    for name, row in found["epochs"].items():
        ms, seconds = row["ms"], row["compile_seconds"]["conservative"]
        print(
            f"| `{name}` | {ms['standard']:.1f} | {ms['conservative']:.1f} | {row['ratio']:.2f} "
            f"| {seconds:.1f} |"
        )
    ns = found["solves"]["ns_per_step_and_state"]
    print(
        f"\n{found['solves']['states']} states: diffeqsolve {ns['diffeqsolve']:.0f} ns, bare "
        f"{ns['bare']:.0f} ns per step and state, ratio {found['solves']['ratio']:.2f}"
    )
    if not options.smoke:
        OUT.parent.mkdir(exist_ok=True)
        OUT.write_text(json.dumps(found, indent=1) + "\n")
    return found


if __name__ == "__main__":
    main()
