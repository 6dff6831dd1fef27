"""What the strategies draw is what they say, and it shrinks to what they say."""

import importlib.util
import runpy

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import Phase, find, given, settings

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

SHRINK = settings(deadline=None, database=None, phases=(Phase.generate, Phase.shrink))
KEPLER = dfc.systems.Kepler()


def simplest(strategy, condition=lambda x: True):
    return find(strategy, condition, settings=SHRINK)


@given(y=dct.states({"a": np.zeros((2, 3), np.float32), "b": (np.zeros(()),)}, magnitude=0.3))
def test_states_are_like_the_given_one_and_bounded(y):
    assert y["a"].shape == (2, 3)
    assert y["a"].dtype == np.float32
    assert y["b"][0].dtype == np.float64
    for x in jax.tree.leaves(y):
        assert np.all(np.abs(x) <= np.asarray(0.3, x.dtype))
        assert np.all((x == 0) | (x.astype(np.float32) ** 2 > 0))


@pytest.mark.parametrize(
    ("make", "error", "match"),
    [
        (lambda: dct.states(np.zeros(3, int)), TypeError, "floating-point"),
        (lambda: dct.states(np.zeros(3), magnitude=0.0), ValueError, "`magnitude`"),
        (lambda: dct.step_sizes(-0.1), ValueError, "smallest"),
        (lambda: dct.times(0.0, np.inf), ValueError, "finite"),
        (lambda: dct.restructurings((KEPLER.y0[0], np.zeros(2, "f4"))), ValueError, "dtypes"),
        (lambda: dct.quadratic_systems(2, integrals=2), ValueError, "1 or 2 integrals"),
    ],
)
def test_mistakes_are_named(make, error, match):
    with pytest.raises(error, match=match):
        make()


@given(y=dct.system_states(dfc.systems.CartesianPendulum(), dtype=np.float32))
def test_system_states_lie_on_the_constraints(y):
    manifold = dfc.systems.CartesianPendulum().manifold
    dct.assert_on_manifold({k: manifold[k] for k in ("rod length", "velocity constraint")}, y)
    assert y[0].dtype == np.float32


def test_system_states_shrink_to_the_own_one_and_are_many():
    states = dct.system_states(KEPLER)
    assert np.array_equal(simplest(states)[0], KEPLER.y0[0])
    seen = set()

    @settings(max_examples=50)
    @given(y=states)
    def collect(y):
        seen.add(float(y[0][0]))
        y[0][:] = 0  # what is drawn is not shared

    collect()
    assert len(seen) > 10
    assert np.array_equal(simplest(states)[0], KEPLER.y0[0])


@given(step=dct.step_sizes(0.5, smallest=0.001), ts=dct.times(2.0, -1.0, size=7))
def test_step_sizes_and_times(step, ts):
    assert 0.001 <= step <= 0.5
    assert ts.shape == (7,)
    assert np.all(np.diff(ts) <= 0)
    assert np.all((ts >= -1) & (ts <= 2))


@given(packing=dct.restructurings(KEPLER.y0, max_depth=3))
def test_restructurings_keep_the_numbers(packing):
    z = packing.pack(KEPLER.y0)
    assert sum(np.size(x) for x in jax.tree.leaves(z)) == 4
    back = packing.unpack(z)
    assert all(np.array_equal(a, b) for a, b in zip(back, KEPLER.y0, strict=True))
    assert packing.manifold(KEPLER.manifold)["energy"].fn(0.0, z, None) == pytest.approx(-0.5)
    slope = packing.unpack(packing.vector_field(KEPLER.vector_field)(0.0, z, None))
    assert np.array_equal(slope[0], KEPLER.y0[1])
    balance = dfc.FirstIntegral(KEPLER.energy, rate=lambda t, y, args: t + y[0][0])
    assert packing.manifold(balance).rate(2.0, z, None) == 2.0 + KEPLER.y0[0][0]
    assert repr(packing).startswith("Restructuring(")


def test_restructurings_vary_and_shrink_to_one_vector():
    assert simplest(dct.catalogue_systems()).name == dfc.systems.names()[0]
    strategy = dct.restructurings(KEPLER.y0)
    assert simplest(strategy).pack(KEPLER.y0).shape == (4,)
    nested = simplest(strategy, lambda p: isinstance(p.pack(KEPLER.y0), dict))
    assert len(jax.tree.leaves(nested.pack(KEPLER.y0))) == 2
    assert "{'a': f64[" in repr(nested)


@pytest.mark.parametrize(("dimension", "integrals"), [(2, 1), (5, 2)])
def test_quadratic_systems_conserve_their_integrals(dimension, integrals):
    @jax.jit
    def slope(system):
        f = system.vector_field(0.0, jnp.asarray(system.y0), None)
        rates = jax.jvp(lambda y: system.quadratic(0.0, y, None), (system.y0,), (f,))[1]
        return rates, f

    moving = []

    @given(system=dct.quadratic_systems(dimension, integrals=integrals))
    def run(system):
        rates, f = slope(system)
        assert rates.shape == (integrals,)
        assert np.max(np.abs(rates)) <= 1e-12 * (1 + np.max(np.abs(f)))
        assert np.all(np.linalg.eigvalsh(system.forms) > 0)
        moving.append(bool(np.max(np.abs(f)) > 1e-3))
        assert "forms=[[[" in repr(system)

    run()
    assert any(moving)


def test_without_hypothesis_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install 'diffrax-conserve\[testing\]'"):
        runpy.run_path(dct.__file__)
