"""A training stops and goes on, bit for bit as if it had not stopped."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_conserve as dfc

from ..learned import LORENZ, flow_map, oscillator
from .test_truth import WRONG, pinn, recipe

pytestmark = pytest.mark.filterwarnings(f"ignore:{WRONG}")
KEY = jr.key(5)


class Interrupt:
    """A reader of the progress who presses Ctrl-C at some epochs."""

    def __init__(self, *epochs):
        self.epochs = list(epochs)

    def __call__(self, done, total, loss, best):
        assert np.isfinite(loss)
        assert np.isfinite(best)
        if self.epochs and done >= self.epochs[0]:
            self.epochs.pop(0)
            raise KeyboardInterrupt


def small_flow_map():
    network = flow_map(core=dfc.learned.Concatenated)
    chosen = dataclasses.replace(
        dfc.learned.second_order(network, epochs=24), points=20, check_every=4
    )
    return network, dict(
        vector_field=LORENZ.vector_field, key=KEY, sample=LORENZ.sample, recipe=chosen
    )


def small_pinn():
    """Whose second window is trained again and cut, before it is right."""
    network = pinn(t1=12.0, windows=[1.0])
    return network, dict(vector_field=oscillator, key=KEY, recipe=recipe(network, 20, retries=3))


def same(found, expected):
    (model, log), (other, other_log) = found, expected
    assert eqx.tree_equal(model, other)
    for name in ("losses", "checked", "criteria", "errors"):
        np.testing.assert_array_equal(getattr(log, name), getattr(other_log, name))
    assert (log.error, log.best, log.best_epoch) == (
        other_log.error, other_log.best, other_log.best_epoch
    )  # fmt: skip


@pytest.mark.parametrize("make", [small_flow_map, pytest.param(small_pinn, marks=pytest.mark.slow)])
def test_an_interrupted_training_goes_on(make):
    network, options = make()
    whole = dfc.fit(network, **options)
    state, stops = None, Interrupt(4, 12, 45)
    for _ in range(4):
        model, log = dfc.fit(network, **options, state=state, progress=stops)
        state = log.state
        if log.ended != "interrupt":
            break
        assert np.isfinite(log.best)
        assert isinstance(model, type(network))
    same((model, log), whole)
    if isinstance(model, dfc.PINN):
        assert model.windows > network.windows


def test_it_ends_at_a_target_and_after_a_time():
    network, options = small_flow_map()
    _, log = dfc.fit(network, **options, seconds=1e-6)
    assert log.ended == "seconds"
    assert log.losses.size == 24
    assert not np.any(np.isfinite(log.losses))
    target = float(log.best) / 2
    _, log = dfc.fit(network, **options, target=target)
    assert log.ended == "target"
    assert log.best <= target
    assert log.criteria[-2] > target
    network, options = small_pinn()
    with pytest.warns(UserWarning, match="Window 0 of 2"):
        _, log = dfc.fit(network, **options, seconds=1e-6)
    assert log.ended == "seconds"
    assert np.isinf(log.errors[1])


@pytest.mark.parametrize("make", [small_flow_map, pytest.param(small_pinn, marks=pytest.mark.slow)])
def test_a_checkpoint_is_the_state(make, tmp_path):
    network, options = make()
    path = tmp_path / "training.checkpoint"
    whole = dfc.fit(network, **options)
    _, log = dfc.fit(network, **options, checkpoint=path, progress=Interrupt(12))
    assert log.ended == "interrupt"
    again = dfc.fit(network, **options, checkpoint=path)
    same(again, whole)
    # Finished, it is read and nothing more is trained.
    begun = time.perf_counter()
    same(dfc.fit(network, **options, checkpoint=path), whole)
    assert time.perf_counter() - begun < 10
    with pytest.raises(ValueError, match="of another training"):
        dfc.fit(network, **(options | dict(key=jr.key(6))), checkpoint=path)
    for other in (
        dict(args=jnp.array(1.0)),
        dict(
            recipe=dataclasses.replace(
                options["recipe"], loss=lambda q, typical: jnp.mean(q) / typical
            )
        ),
    ):
        with pytest.raises(ValueError, match="of another training"):
            dfc.fit(network, **(options | other), checkpoint=path)
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(ValueError, match="holds no checkpoint"):
        dfc.fit(network, **options, checkpoint=path)
    assert list(tmp_path.iterdir()) == [path]


SCRIPT = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", sys.argv[2])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
from tests.training.test_resume import small_pinn
import diffrax_conserve as dfc
network, options = small_pinn()
model, log = dfc.fit(network, **options, checkpoint=sys.argv[1])
dfc.save(sys.argv[3], model)
"""


@pytest.mark.slow
def test_a_killed_training_goes_on(tmp_path):
    """Killed at 20 random times, in whatever it is doing."""
    checkpoint, cache, result = (str(tmp_path / name) for name in ("state", "cache", "network"))
    command = [sys.executable, "-W", "ignore", "-c", SCRIPT, checkpoint, cache, result]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    root = Path(__file__).parents[2]
    rng, killed, longest = np.random.default_rng(0), 0, 0.3
    while not Path(result).exists():
        process = subprocess.Popen(command, cwd=root, env=environment)
        try:
            # Longer each time, or it would never come to its first checkpoint.
            process.wait(timeout=None if killed == 20 else longest * rng.uniform(0.5, 1.0))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            killed += 1
            longest *= 1.25
    assert killed > 3
    network, options = small_pinn()
    expected, _ = dfc.fit(network, **options)
    assert eqx.tree_equal(dfc.load(result), expected)
