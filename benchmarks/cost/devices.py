"""One batch over several devices: automatic sharding, `shard_map` and `pmap` against one device.

Each core of the machine is made a device of JAX. Prints, for plain and projected RK4, the time of
each way relative to automatic sharding, and how many all-reduces its compiled program has. Times
are seconds of the clock, the best of several rounds in turns; so only ratios inside one run mean
something, and the machine should do nothing else. Run: `python benchmarks/cost/devices.py`.
"""

import argparse
import os
import time

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

import diffrax_conserve as dfc

COUNT = max(2, os.cpu_count() or 2)
jax.config.update("jax_num_cpu_devices", COUNT)
# One thread for each device, so that one device does not use the cores of the others.
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false " + os.environ.get("XLA_FLAGS", "")
jax.config.update("jax_enable_x64", True)
SYSTEM = dfc.systems.RigidBody()
SOLVERS = {"plain": dfc.RK4(), "projected": dfc.ManifoldProjection(dfc.RK4(), SYSTEM.manifold)}


def programs(solver, lanes, steps):
    """The compiled programs by name, and what each is called with."""

    def solve(y0):
        term = dfx.ODETerm(SYSTEM.vector_field)
        return dfx.diffeqsolve(term, solver, 0.0, 0.02 * steps, 0.02, y0, max_steps=None).ys[-1]

    batched = jax.vmap(solve)
    mesh = jax.make_mesh((COUNT,), ("lanes",), axis_types=(jax.sharding.AxisType.Auto,))
    spec = PartitionSpec("lanes")
    y0s = jax.vmap(SYSTEM.sample)(jr.split(jr.key(0), lanes))
    spread = jax.device_put(y0s, NamedSharding(mesh, spec))
    mapped = jax.shard_map(batched, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    parts = y0s.reshape(COUNT, lanes // COUNT, 3)
    return {
        "automatic sharding": (jax.jit(batched).lower(spread).compile(), spread),
        "shard_map": (jax.jit(mapped).lower(spread).compile(), spread),
        "pmap": (jax.pmap(batched).lower(parts).compile(), parts),
        "one device": (jax.jit(batched).lower(y0s).compile(), y0s),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="toy sizes, to see that it runs")
    smoke = parser.parse_args().smoke
    sizes, steps, rounds = ([8 * COUNT], 10, 1) if smoke else ([16 * COUNT, 4096 * COUNT], 500, 15)
    print(f"{COUNT} devices, {steps} steps of RK4\n")
    print("| rigid bodies | solver | way | time | all-reduces |\n|---|---|---|---|---|")
    for lanes in sizes:
        for kind, solver in SOLVERS.items():
            for name, relative, count in measured(programs(solver, lanes, steps), rounds):
                print(f"| {lanes} | {kind} | {name} | {relative:.2f} | {count} |", flush=True)


def measured(ways, rounds):
    """Name, time relative to automatic sharding and number of all-reduces of each way."""
    best = dict.fromkeys(ways, float("inf"))
    answers = {}
    for _ in range(rounds):
        for name, (program, y0s) in ways.items():
            begin = time.perf_counter()
            answers[name] = jax.block_until_ready(program(y0s))
            best[name] = min(best[name], time.perf_counter() - begin)
    expected = answers["one device"]
    for name, (program, _) in ways.items():
        same = np.array_equal(jnp.reshape(answers[name], expected.shape), expected)
        assert same, f"{name}: not the bits of one device"
        count = program.as_text().count(" all-reduce(")
        yield name, best[name] / best["automatic sharding"], count


if __name__ == "__main__":
    main()
