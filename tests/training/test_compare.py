"""The verdict on a learned step: its numbers are those of other computations, and it is plain."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import diffrax_conserve as dfc
from diffrax_conserve.learned._flow_map_benchmark import Comparison

from ..learned import RADIUS, Rotation, Within
from ..problems import oscillator, refused
from ..thinned import some_of

STEP, OFF = 0.5, 1e-3
CLOCK = "diffrax_conserve.learned._flow_map_benchmark._seconds"
STATES = np.random.default_rng(0).normal(size=(40, 2))


def spring(t, y, stiffness):
    return jnp.stack([y[1], -stiffness * y[0]])


def rk4(count):
    """The matrix of so many steps of the oscillator."""
    matrix = STEP / count * np.array([[0.0, 1.0], [-1.0, 0.0]])
    terms = [np.linalg.matrix_power(matrix, k) / np.prod(np.arange(1, k + 1)) for k in range(5)]
    return np.linalg.matrix_power(sum(terms), count)


@pytest.mark.slow
def test_errors_and_substeps_are_those_of_formulas(monkeypatch):
    """Of a flow map whose domain is one half of the plane, without the clock."""
    half = dfc.learned.Box(jnp.array([0.0, -9.0]), jnp.array([9.0, 9.0]))
    monkeypatch.setattr(CLOCK, lambda *args: 1.0)
    found = dfc.learned.compare(Within(Rotation(OFF), half), oscillator, STATES)
    assert (found.outside, found.count) == (np.sum(STATES[:, 0] < 0), 40)
    assert np.all(np.isnan(found.batch_projected))
    assert np.isnan(found.args_error)
    exact = scipy.linalg.expm(STEP * np.array([[0.0, 1.0], [-1.0, 0.0]]))
    unit = np.max(np.abs(STATES @ exact.T))
    np.testing.assert_allclose(found.error[0], OFF * STEP / unit, rtol=1e-9)
    np.testing.assert_allclose(found.error_99[0], OFF * STEP / unit, rtol=1e-9)

    def error(count):
        return np.median(np.max(np.abs(STATES @ (rk4(count) - exact).T), axis=1)) / unit

    assert found.methods == ("network", "RK4", "Tsit5", "Dopri8")
    assert found.substeps[0] == found.substeps[3] == 1
    needed = next(n for n in (1, 2, 3, 4) if error(n) <= found.error[0])
    assert found.substeps[1] == needed
    np.testing.assert_allclose(found.error[1], error(needed), rtol=1e-9)
    assert np.all(found.error[1:] <= found.error[0])


UNKNOWN = np.full(4, np.nan)
REPORT = Comparison(
    methods=("network", "RK4", "Tsit5", "Dopri8"), substeps=np.array([1, 1, 1, 1]),
    error=np.full(4, OFF), error_99=np.full(4, OFF),
    alone=np.array([1.0, 3.0, 2.0, 5.0]), batch=np.array([8.0, 3.0, 2.0, 1.0]),
    alone_projected=UNKNOWN, batch_projected=UNKNOWN,
    outside=0, count=40, args_error=np.nan, args_wrong_sign=np.nan,
)  # fmt: skip
planted = functools.partial(dataclasses.replace, REPORT)


def test_the_verdict_is_plain():
    assert planted().verdict == (
        "Alone, the network is 2.0 times as fast as Tsit5. "
        "In the batch, Dopri8 is better: 8.0 times as fast."
    )
    projected = planted(batch_projected=np.array([9.0, 3.0, 4.0, 5.0]))
    assert "In the batch and projected, RK4 is better: 3.0 times as fast." in projected.verdict
    few = planted(substeps=np.array([1, 0, 16, 0]), outside=3)
    assert "In the batch, Tsit5 is better: 4.0 times as fast." in few.verdict
    assert "3 of 40 steps leave the domain of the flow map." in few.verdict
    assert str(few).count(">128") == 2
    none = planted(substeps=np.array([1, 0, 0, 0]))
    assert none.verdict == "No classical step is as accurate with 128 substeps."
    wrong = planted(error=np.full(4, np.nan)).verdict
    assert wrong == "The step of the network is not finite, or that of the reference is not."
    assert "70% point the wrong way" in planted(args_error=2.0, args_wrong_sign=0.7).verdict


@pytest.mark.slow
def test_it_prints_what_it_returns_also_projected(capsys):
    found = dfc.learned.compare(Rotation(OFF), oscillator, STATES, manifold=RADIUS, step=STEP / 2)
    assert capsys.readouterr().out == f"{found}\n"
    for name in ("alone", "batch", "alone_projected", "batch_projected"):
        assert np.all(getattr(found, name) > 0)
    assert found.verdict.count("projected") == 2


@pytest.mark.slow
@some_of("bend", [1.0, -1.0], period=2)
def test_derivatives_by_args_are_compared(bend, monkeypatch, capsys):
    monkeypatch.setattr(CLOCK, lambda *args: 1.0)
    family = Rotation(0.0, bend, args_domain=dfc.learned.Box(0.5, 1.5))
    found = dfc.learned.compare(family, spring, STATES[:5], args=1.0)
    assert found.args_wrong_sign == (bend == -1)
    np.testing.assert_allclose(found.args_error, 1 - bend, atol=1e-8)
    assert ("do not estimate parameters" in capsys.readouterr().out) == (bend == -1)


def of(states=STATES, **options):
    return lambda: dfc.learned.compare(Rotation(OFF), oscillator, states, **options)


test_mistakes_are_named = refused(
    (of(step=2 * STEP), "`step` is 1.0, but the network was trained from 0 to 0.5"),
    (of(step=-1.0), "`step` .*must be positive"),
    (of(STATES[0, 0]), "stacked along a leading axis"),
    (of(manifold=1.0), "neither a `FirstIntegral`"),
)
