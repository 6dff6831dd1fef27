"""`Radau` with sparse linear systems against itself with dense ones."""

import subprocess
import sys

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.sparse as sp

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


@pytest.mark.parametrize(
    "name", ["checkpoints", "forward", pytest.param("direct", marks=pytest.mark.slow)]
)
def test_each_program_frees_what_it_factors(monkeypatch, name):
    """In each computation, such as the body of a loop, and in the passes of derivatives."""
    monkeypatch.setattr(stage_systems, "MIN_KLU", 2)
    order = jax.jacfwd if name == "forward" else jax.grad
    rates = jnp.array([0.1, 1.0, 3.0])

    def total(rate):
        return jnp.sum(solved(start(), rate, ADJOINTS[name])[0] ** 2)

    assert number_freed(jax.vmap(order(total)), rates) >= 2


def number_freed(fn, given):
    """The number of factors, each of which is freed in the computation that makes it."""
    computations = jax.jit(fn).lower(given).compile().as_text().split("\n\n")
    factored = [part.count('custom_call_target="factor_c128"') for part in computations]
    freed = [part.count('custom_call_target="conserve_klu_free"') for part in computations]
    assert factored == freed
    return sum(factored)


def test_the_search_for_a_consistent_state_frees_what_it_factors():
    def f(t, y, args):
        x, z = y[:100], y[100:]
        return jnp.concatenate([z - x, args * z - jnp.cos(jnp.roll(x, 1) + z)])

    dae = dfc.DAE(f, mass=sp.diags_array(np.repeat([1.0, 0.0], 100)))
    total = lambda args: jnp.sum(dae.consistent(jnp.ones(200), args=args) ** 2)  # noqa: E731
    for fn, given in ((jax.grad(total), 2.0), (jax.vmap(jax.grad(total)), jnp.array([2.0, 3.0]))):
        assert number_freed(fn, given) >= 1


def test_a_singular_lane_fails_without_harm_to_others(monkeypatch):
    """The pencil of the equations is singular where `args` is zero."""
    monkeypatch.setattr(stage_systems, "MIN_KLU", 2)

    def f(t, y, args):
        x, z = y[: N // 2], y[N // 2 :]
        return jnp.concatenate([z - 1e3 * (x - jnp.roll(x, 1)), args * (z - jnp.cos(x))])

    mass = np.diag(np.repeat([1.0, 0.0], N // 2))
    dae = dfc.DAE(f, mass=mass)
    y0 = dae.consistent(start(), args=1.0)

    @jax.jit
    @jax.vmap
    def lanes(args):
        found = diffrax.diffeqsolve(
            dae.term, dae.wrap(dfc.Radau()), 0.0, 0.5, 1e-3, y0, args, max_steps=64, throw=False,
            stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6),
        )  # fmt: skip
        return found.ys[-1], found.result == diffrax.RESULTS.successful

    ends, ok = lanes(jnp.array([1.0, 0.0, 2.0]))
    assert list(ok) == [True, False, True]
    np.testing.assert_allclose(ends[2], ends[0], atol=1e-5)
    np.testing.assert_allclose(ends[0][N // 2 :], np.cos(ends[0][: N // 2]), rtol=1e-12)


@pytest.mark.slow
def test_the_gradient_of_ten_thousand_unknowns_is_the_difference():
    n = 10**4

    def f(t, y, rate):
        beside = jnp.concatenate([y[:1], y[:-1]]) + jnp.concatenate([y[1:], y[-1:]])
        return rate * (1e4 * (beside - 2 * y) - y**3)

    y0 = jnp.cos(jnp.arange(n) / 300.0)
    finder = diffrax.VeryChord(rtol=1e-13, atol=1e-13, norm=optx.rms_norm)

    @jax.jit
    def total(rate):
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(f), dfc.Radau(root_finder=finder), 0.0, 1.0, 0.1, y0, rate,
            stepsize_controller=diffrax.ConstantStepSize(), max_steps=10,
        )  # fmt: skip
        return jnp.mean(found.ys[-1] ** 2)

    found = jax.jit(jax.grad(total))(1.0)
    near, far = ((total(1 + h) - total(1 - h)) / (2 * h) for h in (1e-2, 2e-2))
    np.testing.assert_allclose(found, (4 * near - far) / 3, rtol=1e-6)


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
