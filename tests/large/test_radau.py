"""`Radau` with sparse linear systems against itself with dense ones."""

import subprocess
import sys

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve._dae import stage_systems

pytest.importorskip("klujax")
N = 12


@pytest.fixture
def both(monkeypatch):
    """Both kinds of linear systems for small equations, for which compilation is short."""

    def agree(compute, rtol):
        for least in (2, 10**6):
            monkeypatch.setattr(stage_systems, "MIN_KLU", least)
            found = jax.tree.leaves(jax.jit(compute)())
            want = found if least == 2 else want
        for a, b in zip(found, want, strict=True):
            np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * np.max(np.abs(b)))
        return found

    return agree


def reacting(t, y, rate):
    """A reaction that diffuses, stiff, with a total that all are slowed down by: a dense row."""
    beside = jnp.concatenate([y[1:], y[:1]]) + jnp.concatenate([y[-1:], y[:-1]])
    return 2e3 * rate * (beside - 2 * y) + y**2 * (1 - y) + jnp.sin(t)


def start():
    return 0.5 + 0.4 * jnp.sin(jnp.arange(N) ** 2.0)


def solved(y0, rate, adjoint=None):
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(reacting), dfc.Radau(), 0.0, 0.5, 1e-3, y0, rate, max_steps=64,
        stepsize_controller=diffrax.PIDController(rtol=1e-7, atol=1e-9),
        **({} if adjoint is None else {"adjoint": adjoint}),
    )  # fmt: skip
    return solution.ys[-1], solution.stats["num_steps"]


def test_steps_states_and_lanes_are_those_of_dense_systems(both):
    rates = jnp.array([0.1, 1.0, 3.0])
    lanes, _ = both(lambda: jax.vmap(lambda rate: solved(start(), rate))(rates), 1e-9)
    np.testing.assert_allclose(lanes[1], jax.jit(solved)(start(), rates[1])[0], rtol=1e-9)


ADJOINTS = {
    "checkpoints": diffrax.RecursiveCheckpointAdjoint(),
    "direct": diffrax.DirectAdjoint(),
    "forward": diffrax.ForwardMode(),
}


@pytest.mark.parametrize(
    "name", ["checkpoints", "forward", pytest.param("direct", marks=pytest.mark.slow)]
)
def test_derivatives_are_those_of_dense_systems(both, name):
    def total(rate):
        return jnp.sum(solved(start(), rate, ADJOINTS[name])[0] ** 2)

    if name != "forward":
        both(lambda: jax.grad(total)(1.0), 1e-7)
        return
    rates = jnp.array([0.999, 1.0, 1.001])
    along = lambda rate: jax.jvp(total, (rate,), (1.0,))  # noqa: E731
    totals, found = both(lambda: jax.vmap(along)(rates), 1e-7)
    difference = (totals[2] - totals[0]) / 0.002
    np.testing.assert_allclose(found[1], difference, rtol=1e-3)


def test_sparse_systems_are_used_from_a_size_on():
    taken = []

    def systems(n, dtype):
        def f(t, y, args):
            return jnp.roll(y, 1) - y

        y = jnp.ones(n, dtype)
        residual = lambda t, y, s: s - f(t, y, None)  # noqa: E731
        return type(stage_systems.systems_at(residual, jnp.asarray(0.0), y, y))

    for n, dtype in ((20, jnp.float64), (200, jnp.float64), (200, jnp.float32)):
        taken.append(systems(n, dtype))
    sparse, dense = stage_systems.SparseSystems, stage_systems.DenseSystems
    assert taken == [dense, sparse, dense]


def test_a_large_dense_solve_says_what_to_install():
    code = (
        "import sys; sys.modules['klujax'] = None\n"
        "import jax, warnings; jax.config.update('jax_enable_x64', True)\n"
        "import jax.numpy as jnp\n"
        "from diffrax_conserve._dae.stage_systems import DenseSystems, systems_at\n"
        "with warnings.catch_warnings(record=True) as seen:\n"
        "    warnings.simplefilter('always')\n"
        "    y = jnp.ones(400)\n"
        "    found = systems_at(lambda t, y, s: s + y, jnp.asarray(0.0), y, y)\n"
        "assert isinstance(found, DenseSystems)\n"
        "assert 'diffrax-conserve[sparse]' in str(seen[0].message), seen\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
