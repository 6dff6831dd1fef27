"""A batch that is spread over devices is the batch on one device.

Bit for bit: a lane is computed by the same instructions wherever it is. The number of devices is
fixed when JAX starts, so each test starts its own interpreters, which run a function of this file.
"""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import diffrax as dfx
import jax
import numpy as np
import pytest
from jax.sharding import NamedSharding, PartitionSpec

import diffrax_conserve as dfc

OPTIMISED = "--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters"
ROOT = Path(__file__).parents[1]
LANES = 16


def solve(y0, **options):
    """Ten steps of Euler's method, the quickest to compile, for one rigid body."""
    system = dfc.systems.RigidBody()
    solver = dfc.ManifoldProjection(dfx.Euler(), system.manifold)
    term = dfx.ODETerm(system.vector_field)
    return dfx.diffeqsolve(term, solver, 0.0, 1.0, 0.1, y0, **options).ys[-1]


def spread_over_eight_devices():
    """Prints whether the lanes are those of one device."""
    mesh = jax.make_mesh((8,), ("lanes",), axis_types=(jax.sharding.AxisType.Auto,))
    lanes = PartitionSpec("lanes")
    y0s = jax.vmap(dfc.systems.RigidBody().sample)(jax.random.split(jax.random.key(0), LANES))
    spread = jax.device_put(y0s, NamedSharding(mesh, lanes))
    batched = jax.vmap(solve)
    alone = np.asarray(jax.jit(batched)(y0s))
    mapped = jax.shard_map(batched, mesh=mesh, in_specs=lanes, out_specs=lanes, check_vma=False)
    program = jax.jit(mapped).lower(spread).compile()
    found = {
        "equal": np.array_equal(program(spread), alone),
        "devices": len(program(spread).sharding.device_set),
        "all-reduces": program.as_text().count(" all-reduce("),
    }
    print(json.dumps(found))


def train_over_two_devices():
    """Prints the losses of a training on one device, and with its points shared by two."""
    mesh = jax.make_mesh((2,), ("points",), axis_types=(jax.sharding.AxisType.Auto,))
    system = dfc.systems.HarmonicOscillator()
    y0s = jax.vmap(system.sample)(jax.random.split(jax.random.key(0), LANES))
    flow_map = dfc.DeepONet(y0s, 0.5, width=8, depth=1, key=jax.random.key(1))
    recipe = dfc.learned.second_order(flow_map, epochs=5)
    losses, spread = [], NamedSharding(mesh, PartitionSpec("points"))
    for sharding in (None, spread):
        trained, log = dfc.fit(
            flow_map, system.vector_field, key=jax.random.key(2), recipe=recipe, sharding=sharding
        )
        losses.append(log.losses.tolist())
    (weight, *_) = jax.tree.leaves(trained)
    uneven = dataclasses.replace(recipe, points=31)
    try:
        dfc.fit(
            flow_map, system.vector_field, key=jax.random.key(2), recipe=uneven, sharding=spread
        )
    except ValueError as error:
        refused = str(error)
    print(json.dumps([*losses, len(weight.sharding.device_set), refused]))


def answer(devices, function):
    # Optimised: else products are added with one rounding or with two, as the batch is long.
    flags = f"{OPTIMISED} --xla_force_host_platform_device_count={devices}"
    done = subprocess.run(
        [sys.executable, "-m", "tests.test_devices", function],
        cwd=ROOT,
        env={**os.environ, "XLA_FLAGS": flags, "JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_a_solve_and_its_gradient_in_a_shard():
    """There a trace has types of its own, which differ from those around it by their shardings."""
    mesh, lanes = jax.make_mesh((1,), ("lanes",)), PartitionSpec("lanes")
    y0s = jax.vmap(dfc.systems.RigidBody().sample)(jax.random.split(jax.random.key(0), 2))
    options = {"adjoint": dfx.DirectAdjoint(), "max_steps": 16}
    batched = jax.vmap(jax.value_and_grad(lambda y0: solve(y0, **options)[0]))
    mapped = jax.shard_map(batched, mesh=mesh, in_specs=lanes, out_specs=lanes, check_vma=False)
    spread = jax.device_put(y0s, NamedSharding(mesh, lanes))
    for found, expected in zip(jax.jit(mapped)(spread), jax.jit(batched)(y0s), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-13)


@pytest.mark.slow
def test_a_batch_over_eight_devices_is_the_batch_on_one():
    found = answer(8, "spread_over_eight_devices")
    assert found == {"equal": True, "devices": 8, "all-reduces": 0}


@pytest.mark.slow
def test_a_training_over_two_devices_is_that_on_one():
    alone, spread, devices, refused = answer(2, "train_over_two_devices")
    assert devices == 2
    np.testing.assert_allclose(spread, alone, rtol=1e-6)
    assert spread != alone  # each device summed its share
    assert "cannot share out the 31 points" in refused


if __name__ == "__main__":
    globals()[sys.argv[1]]()
