"""The strategies draw what they say; each assertion says what is wrong with a planted defect."""

import dataclasses
import importlib.util
import re
import runpy

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import Phase, find, given, settings

import diffrax_conserve as dfc
import diffrax_conserve.testing as dct

from .. import problems
from ..problems import OMEGA0, RIGID_BODY, refused, rigid_body

TERM = dfx.ODETerm(rigid_body)
PLAIN, PROJECTED = dfx.Heun(), dfc.ManifoldProjection(dfx.Heun(), RIGID_BODY)
SAVED = dfx.SaveAt(t0=True, steps=True, dense=True)


def solve(solver, y0=OMEGA0, *, dense=False, **options):
    """In one program for each solver, from whose solution the dense output is taken away."""
    options = dict(t1=2.0, max_steps=32, saveat=SAVED, throw=False) | options
    sol = problems.solve(rigid_body, solver, y0, **options)
    return sol if dense else dataclasses.replace(sol, interpolation=None)


def batch(y0s):
    """As `jax.vmap` returns it, by the program of one lane."""
    return jax.tree.map(lambda *x: np.stack(x), *(solve(PROJECTED, y0) for y0 in y0s))


def rows_of(sol, *rows):
    """As saved with `SaveAt(t1=True)`, or with `t0=True` too, by a solve in 20 steps."""
    ts, ys = (np.asarray(x)[list(rows)] for x in (sol.ts, sol.ys))
    return dataclasses.replace(sol, ts=ts, ys=ys)


def fails(function, *args, **kwargs):
    """What the failed assertion says."""
    with pytest.raises(AssertionError) as caught:
        function(*args, **kwargs)
    return str(caught.value)


def test_a_projected_solution_is_conserved_and_a_plain_one_not():
    """With rows that diffrax padded, and at the dense output of two saved states."""
    saved, dense = solve(PROJECTED, dense=True), solve(PLAIN, dense=True)
    plain = dataclasses.replace(dense, interpolation=None)
    sol = rows_of(saved, 0, 20)
    for right in (dataclasses.replace(saved, interpolation=None), sol):
        dct.assert_conserved(right, RIGID_BODY)
        dct.assert_conserved(right, RIGID_BODY, y0=OMEGA0)
    text = fails(dct.assert_conserved, plain, RIGID_BODY)
    assert "`manifold['energy']` first at time 0.1 (saved state, row 1 of 21)" in text
    assert "must stay 0.3" in text
    assert "units of roundoff (float64)" in text
    assert "violated in 20 of 21 rows" in text
    dct.assert_conserved(plain, RIGID_BODY, rtol=1e-2)
    dct.assert_conserved(plain, RIGID_BODY, rtol=0, atol=1e-2)
    # The nodes lie on the manifold; this is the defect of a naive wrapper.
    mixed = eqx.tree_at(lambda s: s.interpolation, sol, dense.interpolation)
    assert "dense output, row" in fails(dct.assert_conserved, mixed, RIGID_BODY)
    end = rows_of(plain, 20)
    assert "first at time 2" in fails(dct.assert_conserved, end, RIGID_BODY, y0=OMEGA0)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_state_that_is_not_finite_never_passes(bad):
    """Not even in a component that no integral depends on."""
    sol = solve(PROJECTED)
    sol = eqx.tree_at(lambda s: s.ys, sol, sol.ys.at[3, 2].set(bad))
    first = dfc.FirstIntegral(lambda t, y, args: 0 * y[0])
    text = fails(dct.assert_conserved, sol, first, rtol=1e300, atol=1e300)
    assert "not finite at time 0.3 (saved state, row 3 of 21)" in text
    assert "not finite" in fails(dct.assert_on_manifold, first, sol.ys[3], value=0.0)
    # A row that diffrax padded has the time infinity, one of a failed solve may have NaN.
    lost = sol.ys.at[3].set(bad), sol.ts.at[3].set(jnp.nan)
    lost = eqx.tree_at(lambda s: (s.ys, s.ts), sol, lost)
    assert not np.isfinite(dfc.drift(lost, RIGID_BODY["energy"])[3])


def test_an_unsuccessful_solve_is_reported_as_that():
    text = fails(dct.assert_conserved, solve(PROJECTED, t1=10.0), RIGID_BODY)
    assert re.search("did not succeed.*maximum number of solver steps", text, re.DOTALL)


def test_lanes_of_a_batch_are_all_checked():
    y0s = jnp.stack([OMEGA0, 2 * OMEGA0, 3 * OMEGA0])
    sol = batch(y0s)
    dct.assert_conserved(sol, RIGID_BODY, y0=y0s)
    moved = eqx.tree_at(lambda s: s.ys, sol, jnp.asarray(sol.ys).at[2, 5].multiply(1.001))
    text = fails(dct.assert_conserved, moved, RIGID_BODY)
    assert "first at time 0.5 (saved state, row 5 of 21, lane (2,))" in text
    assert "violated in 1 of 63 rows" in text
    text = fails(dct.assert_conserved, batch(y0s.at[1].set(jnp.nan)), RIGID_BODY)
    assert "in 1 of 3 lanes, first in lane (1,)" in text


CIRCLE = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - args)


def test_a_state_on_the_manifold():
    dct.assert_on_manifold(CIRCLE, np.array([0.6, 0.8]), args=1.0)
    text = fails(dct.assert_on_manifold, CIRCLE, np.array([0.6, 0.8]), t=3.0, args=2.0)
    assert "`manifold` first at time 3" in text
    assert "it is -1.0, but must be 0" in text
    values = {name: entry.fn(0.0, OMEGA0, None) for name, entry in RIGID_BODY.items()}
    dct.assert_on_manifold(RIGID_BODY, OMEGA0, value=values)
    off = OMEGA0 * (1 + 1e-13)
    assert "must stay 0.3" in fails(dct.assert_on_manifold, RIGID_BODY, off, value=values)


def test_order():
    dct.assert_order(dfx.Heun(), TERM, OMEGA0, t1=2.0, dt0=0.1)
    text = fails(dct.assert_order, dfx.Heun(), TERM, OMEGA0, t1=2.0, dt0=0.1, order=3)
    assert re.search(r"measured order is (1\.9|2\.0)., but 3 is claimed", text)


def test_wrong_gradients_are_found_and_the_argument_is_named():
    def f(y):
        return jnp.sum(y["good"] ** 2) + jnp.sum(jax.lax.stop_gradient(y["bad"]) ** 2)

    y = {"good": OMEGA0, "bad": OMEGA0}
    text = fails(dct.assert_gradients, f, y)
    assert "`args[0]['bad']`, forward mode gives 0" in text
    assert "`args[0]['bad']`, reverse mode gives 0" in text
    assert "good" not in text
    assert "forward mode" not in fails(dct.assert_gradients, f, y, forward=False)


def test_right_gradients_of_mixed_precision_and_of_complex_numbers_pass():
    single, number = OMEGA0.astype(jnp.float32), jnp.asarray(2.0)
    dct.assert_gradients(lambda y, a: a * jnp.sum(y), single, number)
    dct.assert_gradients(lambda y: jnp.sum(y).astype(jnp.float32) ** 2, OMEGA0)
    dct.assert_gradients(lambda z: (jnp.abs(z) ** 2, z**2), OMEGA0 + 1j)
    half = lambda z: jnp.abs(jax.lax.complex(z.real, jax.lax.stop_gradient(z.imag)))  # noqa: E731
    assert "`args[0]`" in fails(dct.assert_gradients, half, OMEGA0 + 1j)


def test_nothing_to_check_is_an_error():
    sol = solve(PROJECTED)
    empty = dataclasses.replace(sol, ts=None, ys=None)
    subs = dataclasses.replace(sol, ts=[sol.ts, sol.ts], ys=[sol.ys, sol.ys])
    for match, function, *args in [
        ("holds no states", dct.assert_conserved, empty, RIGID_BODY),
        ("SubSaveAt", dct.assert_conserved, subs, RIGID_BODY),
        ("`y0=...`", dct.assert_conserved, rows_of(sol, 20), RIGID_BODY),
        ("`value=...`", dct.assert_on_manifold, RIGID_BODY, OMEGA0),
        ("nothing to vary", dct.assert_gradients, lambda n: n, 3),
        ("nothing to compare", dct.assert_gradients, lambda x: 3, 1.0),
    ]:
        with pytest.raises(ValueError, match=re.escape(match)):
            function(*args)


# ---- What the strategies draw is what they say, and it shrinks to what they say ----


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


test_mistakes_are_named = refused(
    (lambda: dct.states(np.zeros(3, int)), TypeError, "floating-point"),
    (lambda: dct.states(np.zeros(3), magnitude=0.0), ValueError, "`magnitude`"),
    (lambda: dct.step_sizes(-0.1), ValueError, "smallest"),
    (lambda: dct.times(0.0, np.inf), ValueError, "finite"),
)


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


def test_systems_shrink_to_the_first_of_the_catalogue():
    assert simplest(dct.catalogue_systems()).name == dfc.systems.names()[0]


def test_without_hypothesis_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install '\.\[testing\]'"):
        runpy.run_path(dct.__file__)
