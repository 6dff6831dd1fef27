"""The verdict for a projection: what it reports against independent truth, and what it says.

Functions are given numbers by `args`, so that tests share what is compiled.
"""

import dataclasses

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve._diagnostics.compared_solves import Task, references, sizes_of, switched
from diffrax_conserve._diagnostics.comparison import (
    ComparisonReport,
    ComparisonRow,
    by_errors,
    distance,
    judged,
    worsened,
)
from diffrax_conserve._diagnostics.linear_invariants import changes, linear_invariants
from diffrax_conserve._tree import ravel, unravel
from diffrax_conserve.reproduce import _verdict, main

from .problems import KEPLER, KEPLER0, kepler, refused

STEPS, DT = 600, 0.25
Y0 = np.array([0.3, 0.2, 0.1, -0.4])  # two positions, two velocities


def henon_heiles(t, y, args):
    """Two oscillators, coupled by `args[0]`; the second one has the stiffness `args[2]`."""
    (x, z, u, v), (c, _, k) = y, args
    return jnp.stack([u, v, -x - 2 * c * x * z, -k * z - c * (x**2 - z**2)])


def energy(t, y, args):
    """It is conserved if `args[1]` is one."""
    (x, z, u, v), (c, factor, k) = y, args
    return (u**2 + v**2) / 2 * factor + (x**2 + k * z**2) / 2 + c * (x**2 * z - z**3 / 3)


def compared(coupling, factor, capsys, y0=Y0, dt0=DT, stiffness=1.0):
    report = dfc.compare(
        henon_heiles, dfc.RK4(), dfc.FirstIntegral(energy), jnp.asarray(y0), t1=STEPS * dt0,
        dt0=dt0, args=jnp.array([coupling, factor, stiffness]),
    )  # fmt: skip
    assert capsys.readouterr().out == f"{report}\n"
    return report


def test_errors_and_drifts_are_those_of_the_closed_form(capsys):
    """RK4 on an oscillator loses amplitude and phase; with the energy kept only the phase. A step
    is a power of the Taylor polynomial of a rotation."""
    report = compared(0.0, 1.0, capsys)
    a, t = DT * np.array([[0, 1], [-1, 0]]), DT * np.arange(STEPS + 1)
    step = np.eye(2) + a + a @ a / 2 + a @ a @ a / 6 + a @ a @ a @ a / 24
    powers = [np.linalg.matrix_power(step, n) for n in range(STEPS + 1)]
    ys = np.stack(powers) @ Y0.reshape(2, 2)
    rotations = np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]]).transpose(2, 0, 1)
    exact = rotations @ Y0.reshape(2, 2)
    shown = np.arange(0, STEPS + 1, STEPS // 100)
    np.testing.assert_allclose(report.ts, t[shown])

    def errors(ys):
        largest = np.maximum.accumulate(np.abs(ys - exact)[shown])
        return np.prod(largest / np.max(np.abs(exact[shown]), axis=0), axis=(1, 2)) ** 0.25

    plain, kept, euclidean, _ = report.rows
    np.testing.assert_allclose(plain.errors[0], errors(ys), rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(report.error[0], np.max(errors(ys)), rtol=1e-6)
    square = np.sum(ys**2, axis=(1, 2))
    drift = np.max(np.abs(square[shown] / square[0] - 1)) / 3
    np.testing.assert_allclose(plain.drift["manifold"], drift, rtol=1e-9)
    assert kept.drift["manifold"] < 1e-15
    # In the Euclidean metric the projection is a division by the norm.
    scaled = ys * np.sqrt(square[0] / square)[:, None, None]
    np.testing.assert_allclose(euclidean.errors[0], errors(scaled), rtol=1e-6, atol=1e-10)
    assert report.choice.startswith("all kept")
    assert "the error little: `all kept" in report.verdict  # 0.92 times
    assert np.all(plain.steps == STEPS)


def test_that_a_projection_hurts_is_told(capsys):
    report = compared(0.0, 1.3, capsys)
    assert report.choice == "nothing kept"
    assert report.verdict.startswith("Do not project: `manifold` is not conserved; with `all kept")
    assert "its drift along the reference is 0." in " ".join(report.notes)
    assert isinstance(report.solver, dfc.RK4)


def test_a_slow_part_that_a_projection_would_spoil_is_told(capsys):
    """Of a fast and a slow oscillator all of the error of the energy is that of the fast one."""
    report = compared(0.0, 1.0, capsys, np.array([0.3, 0.2, 0.1, -0.02]), stiffness=0.01)
    _, nearest, euclidean, _, by_errors, *_ = report.rows
    for row in (nearest, euclidean):
        assert row.worsened[0] in ("y[1]", "y[3]")
        assert row.worsened[1] > 10
    assert by_errors.worsened[1] < 2
    assert report.choice == "all kept, metric by errors"
    weights = report.solver.projection.metric
    assert np.all(weights[[1, 3]] > 1e4 * weights[[0, 2]])


def halves(x):
    return {"q": x[: len(x) // 2], "p": x[len(x) // 2 :]}


def of_halves(y):
    return jnp.concatenate([y["q"], y["p"]])


def nested(x):
    return [(x[:1],), halves(x[1:])]


def of_nested(y):
    return jnp.append(y[0][0], of_halves(y[1]))


def apart(x):
    return {"b": [x[0]], "a": tuple(x[1:])}


def of_apart(y):
    return jnp.stack([*y["b"], *y["a"]])


# How a state of like units may be packed, and the components of what is packed so.
LIKE = {
    "one array": (lambda x: x, lambda y: y),
    "leaves": (halves, of_halves),
    "nested leaves": (nested, of_nested),
}
# Components of unlike units are in one array, or each in a leaf of its own.
UNLIKE = {
    "one array": LIKE["one array"],
    "leaves": (tuple, jnp.stack),
    "nested leaves": (apart, of_apart),
}


def verdict_on(field, manifold, y0, packing, unit, **steps):
    """The verdict on a system whose components are packed so, and have units."""
    pack, components = packing
    state = lambda y: unravel(components(y) / unit, y0)  # noqa: E731
    kept = {
        name: type(entry)(lambda t, y, args, fn=entry.fn: fn(t, state(y), args))
        for name, entry in manifold.items()
    }
    packed = lambda t, y, args: pack(unit * ravel(field(t, state(y), args)))  # noqa: E731
    return dfc.compare(packed, dfc.RK4(), kept, pack(unit * ravel(y0)), **steps)


@pytest.mark.slow
@pytest.mark.parametrize("packings", [LIKE, UNLIKE])
@pytest.mark.parametrize(
    ("name", "dt0"),
    [
        ("harmonic-oscillator", 0.25), ("lotka-volterra", 0.2), ("rigid-body", 0.05),
        ("conservative-lorenz", 0.25), ("double-pendulum", 0.1), ("henon-heiles", 0.25),
    ],
)  # fmt: skip
def test_twelve_verdicts_do_not_depend_on_the_packing(name, dt0, packings):
    """In natural units, and in units as unlike as metres and metres per second. The metric of
    motion knows vectors from single components, so of like units only what to keep is the same."""
    system = dfc.systems.get(name)
    size = ravel(system.y0).size
    unit = jnp.asarray(np.ones(size) if packings is LIKE else 10.0 ** np.linspace(6, -3, size))
    first, *others = (
        verdict_on(system.vector_field, system.manifold, system.y0, packing, unit,
                   t1=60 * dt0, dt0=dt0)
        for packing in packings.values()
    )  # fmt: skip
    assert first.choice is not None
    for other in others:
        assert other.rows[other.index].kept == first.rows[first.index].kept
        assert other.choice == first.choice or packings is LIKE
        np.testing.assert_allclose(other.error[0], first.error[0], rtol=1e-6)


@pytest.mark.slow
def test_a_part_in_a_small_unit_does_not_hide_another_in_its_array():
    """Beside Lotka and Volterra's system, which a projection harms, a pendulum of large numbers."""
    system = dfc.systems.LotkaVolterra()

    def field(t, y, args):
        slope = jnp.stack([0.5 * y[3], -0.5 * jnp.sin(y[2])])
        return jnp.concatenate([system.vector_field(t, y[:2], args), slope])

    (entry,) = system.manifold.values() if isinstance(system.manifold, dict) else [system.manifold]
    kept = {
        "species": dfc.FirstIntegral(lambda t, y, args: entry.fn(t, y[:2], args)),
        "pendulum": dfc.FirstIntegral(lambda t, y, args: y[3] ** 2 / 2 - jnp.cos(y[2])),
    }
    y0, unit = jnp.append(system.y0, jnp.array([2.0, 0.0])), jnp.array([1.0, 1.0, 1e6, 1e6])
    one, two = (
        verdict_on(field, kept, y0, LIKE[name], unit, t1=50.0, dt0=0.2)
        for name in ("one array", "leaves")
    )
    # The species would become 1.2 times less accurate, the pendulum four times.
    assert one.choice == two.choice == "nothing kept"


def test_what_is_judged_depends_neither_on_the_packing_nor_on_units():
    """Two lanes at four times; the third component is at rest but for roundoff."""
    rng = np.random.default_rng(0)
    exact = rng.normal(size=(2, 4, 5)) * np.array([1.0, 1.0, 1e-17, 1.0, 1.0])
    off = rng.normal(size=(3, 2, 4, 5)) * np.array([1e-3, 1e-6, 1e-17, 1e-2, 1e-9])
    plain, row, rough = exact + off * np.array([1.0, 5.0, 1e-9])[:, None, None, None]

    def found(pack, unit):
        states = [pack(np.moveaxis(y * unit, -1, 0)) for y in (plain, row, exact, rough)]
        states = [jax.tree.map(lambda x: np.moveaxis(x, 0, -1), y) for y in states]
        plain_, row_, exact_, rough_ = states
        counted = judged(plain_, exact_)
        assert list(counted) == [True, True, False, True, True]
        weights = jax.tree.leaves(by_errors(plain_, exact_))
        return (
            distance(row_, exact_, counted),
            worsened(plain_, exact_, rough_, np.array([3, 3]), row_)[1],
            np.concatenate(weights) * unit**2,
        )

    expected = found(lambda x: x, np.ones(5))
    for unit in np.ones(5), 10.0 ** np.array([6, -2, 0, 3, 5]):
        for pack in (lambda x: x, lambda x: (x[:2], x[2:]), lambda x: [{"q": (x[:1], x[1:])}]):
            for a, b in zip(found(pack, unit), expected, strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-6)


def test_a_component_has_its_own_size_unless_it_may_be_roundoff():
    """The first is small, but nothing large moves it; in the slope of the last one two large ones
    cancel. Of that 1e-2 in a step of 0.1 is at most 1."""
    slope = lambda t, y, args: jnp.stack([-y[0], -y[1], -y[2], y[1] - y[2]])  # noqa: E731
    start, step = jnp.zeros(()), jnp.array(0.1)
    task = Task(
        dfx.ODETerm(slope), None, jnp.array([[1e-6, 1e3, 1e3, 0.0]]), start, 10 * step, step,
        dfx.ConstantStepSize(), dfx.SaveAt(t0=True, t1=True), False, 10,
    )  # fmt: skip
    sol = dfx.Solution(
        start, 10 * step, jnp.array([[0.0, 1.0]]), task.y0s[:, None] * jnp.ones((2, 1)), None,
        {"num_steps": np.array([10])}, dfx.RESULTS.successful, None, None, None, None,
    )  # fmt: skip
    sizes = sizes_of(task, sol)
    np.testing.assert_allclose(sizes[:3], [1e-6, 1e3, 1e3])
    assert 0.1 < sizes[3] <= 1.0


def test_chaos_is_told(capsys):
    """At an energy of 1/7 nearly all orbits are chaotic, and separate by a factor of e in a time of
    about ten."""
    start = np.array([0.0, 0.1, 0.5, np.sqrt(2 / 7 - 0.25 - 0.01 + 2e-3 / 3)])
    report = compared(1.0, 1.0, capsys, start, 0.5)
    assert report.last[0] < len(report.ts) - 1
    assert "as in chaos" in " ".join([*report.notes, report.verdict])


def largest_error(y, ts, y0):
    """Against Kepler's equation, which does not share the reference of `compare`."""
    exact = dfc.systems.Kepler().reference(ts, y0)
    errors = [
        jnp.max(jnp.abs(a - b), axis=0) / jnp.max(jnp.abs(b), axis=0)
        for a, b in zip(y, exact, strict=True)
    ]
    return float(jnp.prod(jnp.stack(errors)) ** 0.25)


@pytest.mark.slow
def test_errors_of_a_batch_are_those_of_the_solver_that_it_hands_out():
    """The programs differ: an entry that is left out is zero where many lists share one."""
    starts = jax.tree.map(lambda x: jnp.stack([x, 1.02 * x]), KEPLER0)
    report = dfc.compare(kepler, dfc.RK4(), KEPLER, starts, t1=9.95, dt0=0.1, batch=True)
    names = [row.name for row in report.rows]
    assert names[0] == "nothing kept"
    assert names[1::3] == ["all kept", "all but energy", "all but momentum"]
    assert "2 lanes" in report.verdict
    assert report.ts[-1] == 9.95
    row = report.rows[names.index("all but energy, metric=1.0")]
    assert row.kept == ("momentum",)
    assert np.all(row.drift["momentum"] < 1e-14)
    assert np.all(row.drift["energy"] > 1e-9)
    y0 = jax.tree.map(lambda x: x[1], starts)
    saveat = dfx.SaveAt(t0=True, steps=True)
    sol = dfx.diffeqsolve(
        dfx.ODETerm(kepler), row.solver, 0.0, 9.95, 0.1, y0, saveat=saveat, max_steps=100
    )
    found = largest_error(sol.ys, report.ts, y0)
    np.testing.assert_allclose(row.errors[1, -1], found, rtol=1e-6)
    assert row.steps[1] == sol.stats["num_steps"] == 100


@pytest.mark.slow
def test_adaptive_steps_and_a_balance():
    """A pendulum with friction, of which the energy is kept with its rate."""
    balance = dfc.FirstIntegral(
        lambda t, y, args: y[1] ** 2 / 2 - jnp.cos(y[0]), rate=lambda t, y, args: -0.1 * y[1] ** 2
    )
    report = dfc.compare(
        lambda t, y, args: jnp.stack([y[1], -jnp.sin(y[0]) - 0.1 * y[1]]), dfx.Tsit5(), balance,
        jnp.array([2.0, 0.0]), t1=20.0, rtol=1e-5, atol=1e-5,
    )  # fmt: skip
    plain, kept, *_ = report.rows
    assert kept.drift["manifold"] < 1e-13 < 1e-8 < plain.drift["manifold"]
    assert report.last[0] == len(report.ts) - 1 == 100
    assert report.index is not None


# ---- Parts, without a solve ----


def report_of(*errors, doubt=1e-13, lanes=1):
    """A report of errors that are given at five times after the start."""
    rows = []
    for i, error in enumerate(errors):
        curve = np.broadcast_to(np.array(error, float), (lanes, 5))
        curve = np.concatenate([np.zeros((lanes, 1)), curve], axis=1)
        row = ComparisonRow(
            name="nothing kept" if i == 0 else f"choice {i}", kept=("x",) * (i > 0),
            solver=dfx.Tsit5(), errors=curve, success=np.isfinite(curve).all(axis=1),
            message="it failed", drift={"x": np.full(lanes, 1e-3)}, linear=np.zeros(lanes),
            steps=np.full(lanes, 7), seconds=1e-4,
        )  # fmt: skip
        rows.append(row)
    doubts = np.broadcast_to(np.append(0.0, np.broadcast_to(doubt, 5)), (lanes, 6))
    return ComparisonReport(tuple(rows), np.arange(6.0), doubts, 0)


@pytest.mark.parametrize(
    ("errors", "doubt", "choice", "words"),
    [
        ((1e-3, 1e-4, 1e-5), 1e-9, "choice 2", ("0.01 times",)),
        ((1e-3, 1.4e-4, 1e-4), 1e-9, "choice 1", ("0.14 times",)),
        ((1e-3, 1.2e-3, 8.5e-4), 1e-9, "choice 2", ("0.85 times",)),
        ((1e-3, 1.05e-3, 8.5e-4), 1e-9, "choice 2", ("0.85 times",)),
        ((1e-3, 2e-3, 1.5e-3), 1e-9, "nothing kept", ("Do not project", "choice 2", "1.5 times")),
        (
            (1e-3, 1.08e-3),
            1e-9,
            "choice 1",
            ("1.1 times", "the error little", "good for what it keeps"),
        ),
        ((np.nan, 1e-3), 1e-9, "choice 1", ("without projection the solve fails",)),
        ((1e-3, np.nan), 1e-9, "nothing kept", ("every projection fails.",)),
        ((np.nan, np.nan), 1e-9, None, ("Take shorter steps", "it failed")),
        ((1e-3, 1e-4), 1e-4, None, ("cannot be trusted", "shorter interval")),
        ((1e-3, 1e-4), np.nan, None, ("reference failed", "Kvaerno5")),
        ((0.9, 0.8), 1e-9, None, ("as large as the state",)),
    ],
)
def test_what_is_said(errors, doubt, choice, words):
    report = report_of(*errors, doubt=doubt)
    assert report.choice == choice
    assert [word for word in words if word not in report.verdict] == []
    assert report.verdict in str(report)
    assert report.solver is not None


def test_what_the_solver_keeps_by_itself_needs_no_projection():
    """Unless the projection gains all the same, as by bounds."""

    def report(error, drift):
        found = report_of(1e-3, error, doubt=1e-9)
        rows = [dataclasses.replace(row, drift={"x": np.array([drift])}) for row in found.rows]
        return dataclasses.replace(found, rows=tuple(rows))

    assert report(1e-3, 1e-9).choice == "choice 1"
    itself = report(1e-3, 1e-15)
    assert itself.choice == "nothing kept"
    assert "keeps `x` to roundoff without projection" in str(itself)
    assert report(1e-4, 1e-15).choice == "choice 1"


def test_a_projection_that_spoils_a_component_is_not_for_what_it_keeps():
    for error, choice in {1e-3: "nothing kept", 1e-4: "choice 1"}.items():
        plain, kept = report_of(1e-3, error).rows
        rows = plain, dataclasses.replace(kept, worsened=("y[1]", 45.0))
        report = dataclasses.replace(report_of(1e-3, error), rows=rows)
        assert report.choice == choice
        assert report.verdict.endswith(", but `y[1]` is 45 times less accurate.")


def test_what_spoils_a_component_is_taken_only_for_a_gain_as_large():
    """Of a place beside a speed, for example. What is three times as inaccurate is told."""
    for error, factor, choice in (
        (5e-4, 8.0, "nothing kept"), (5e-4, 3.1, "nothing kept"), (5e-4, 2.9, "choice 1"),
        (3e-4, 8.0, "choice 1"),
    ):  # fmt: skip
        report = report_of(1e-3, error)
        rows = report.rows[0], dataclasses.replace(report.rows[1], worsened=("y[0]", factor))
        report = dataclasses.replace(report, rows=rows)
        assert report.choice == choice
        assert (f"`y[0]` is {factor:.2g} times less accurate" in report.verdict) is (factor > 3)
    # Of two that gain about alike the one that spoils nothing is taken.
    plain, first, second = (report := report_of(1e-3, 2e-4, 2.5e-4)).rows
    rows = plain, dataclasses.replace(first, worsened=("y[0]", 8.0)), second
    assert dataclasses.replace(report, rows=rows).choice == "choice 2"


def test_without_a_gain_no_component_may_become_less_accurate():
    for factor, choice in {1.05: "choice 1", 1.2: "nothing kept"}.items():
        report = report_of(1e-3, 1e-3)
        rows = report.rows[0], dataclasses.replace(report.rows[1], worsened=("y[0]", factor))
        assert dataclasses.replace(report, rows=rows).choice == choice


def test_the_component_that_is_least_accurate_beside_plain():
    """In two lanes at three times, of which the last is not judged."""
    exact = np.ones((2, 3, 2))
    off = np.array([0, 1, 9])[:, None] * np.array([1e-3, 1e-6])
    ys = exact + np.array([2, 8])[:, None, None] * off * np.array([1, 100])
    found = worsened({"a": exact + off}, {"a": exact}, {"a": exact}, np.array([1, 1]), {"a": ys})
    assert found == ("y['a'][1]", pytest.approx(400))
    doubtful = exact + off * 10
    found = worsened({"a": exact + off}, {"a": exact}, {"a": doubtful}, np.array([1, 1]), {"a": ys})
    assert found == ("y['a'][1]", pytest.approx(400 / 30))


def test_the_verdict_names_keep_linear_where_linear_invariants_break():
    plain, kept = report_of(1e-3, 1e-5).rows
    for change, named in {1e-6: True, 1e-16: False}.items():
        rows = plain, dataclasses.replace(kept, linear=np.full(1, change))
        report = dataclasses.replace(report_of(1e-3, 1e-5), rows=rows, num_linear=1)
        assert ("keep_linear=True" in report.verdict) is named


def test_errors_are_judged_up_to_where_the_reference_is_trusted():
    growing = 10.0 ** np.arange(-7, -2)
    report = report_of(growing, growing / 10, doubt=np.array([0, 0, 0, 1e-3, 1e-2]))
    assert list(report.last) == [3]
    np.testing.assert_allclose(report.error[:, 0], [1e-5, 1e-6])
    assert any("t = 3" in note and "trusted" in note for note in report.notes)
    assert "Take `choice 1`: up to t = 3 of 5 the error is 0.1 times" in report.verdict
    lost = report_of((1e-2, 0.1, 0.6, 0.9, 1), (1e-3, 1e-2, 0.5, 1, 1))
    assert list(lost.last) == [2]
    assert any("as large as the state, as in chaos" in note for note in lost.notes)


def test_a_failure_in_one_lane_counts():
    report = report_of(1e-3, 1e-4, lanes=3)
    bad = dataclasses.replace(report.rows[1], success=np.array([True, False, True]))
    report = dataclasses.replace(report, rows=(report.rows[0], bad))
    assert report.choice == "nothing kept"
    assert "`choice 1` fails in 1 of 3 lanes: it failed." in report.notes


def test_of_equal_means_the_one_without_risk_is_taken():
    report = report_of(1e-3, 1e-3, 1e-3, lanes=2)
    plain, first, second = report.rows
    risky = first.errors * np.array([[0.5], [1.9]])
    rows = plain, dataclasses.replace(first, errors=risky), second
    assert dataclasses.replace(report, rows=rows).choice == "choice 2"
    report = dataclasses.replace(report, rows=rows[:2])
    assert report.choice == "nothing kept"
    assert "1.9 times at worst; in 1 of them it is larger" in report.verdict
    # The logarithms of the ratios are half of log(1.9 / 0.5) from their mean, which has this error.
    assert "change by a factor of about 1.9," in report.verdict


def test_the_picture_has_a_curve_for_each_and_the_choice_is_bold():
    pytest.importorskip("matplotlib").use("Agg")
    ax = report_of(1e-3, 1e-4, 1e-5).plot()
    widths = {line.get_label(): line.get_linewidth() for line in ax.lines}
    assert list(widths) == ["nothing kept", "choice 1", "choice 2", "reference"]
    assert widths["choice 2"] > widths["choice 1"]


MASSES = np.array([1.0, 3.0, 1e3])


def springs(t, y, args):
    """Three bodies on a line, with unequal springs."""
    q, v = y
    force = 5 * (q[1] - q[0]) ** 3, 2 * jnp.sin(q[2] - q[1])
    return v, jnp.stack([force[0], force[1] - force[0], -force[1]]) / MASSES


def test_linear_invariants_that_nobody_declared_are_found():
    rng = np.random.default_rng(0)
    ys = tuple(rng.normal(size=(2, 4, 3)) for _ in range(2))
    sizes = tuple(np.abs(y).max(axis=(0, 1)) for y in ys)
    momentum = dfc.FirstIntegral(lambda t, y, args: jnp.sum(MASSES * y[1]))
    power = dfc.FirstIntegral(lambda t, y, args: jnp.sum(MASSES * y[1] ** 2))
    ts = jnp.arange(4.0)
    found = linear_invariants(springs, ts, ys, sizes, None, {"power": power})
    expected = np.concatenate([np.zeros(3), MASSES * sizes[1]])
    np.testing.assert_allclose(np.abs(found[0]), expected / np.linalg.norm(expected), 0, 1e-8)
    assert len(found) == 1
    assert len(linear_invariants(springs, ts, ys, sizes, None, {"p": momentum, "e": power})) == 0
    still = tuple(np.repeat(y[:, :1], 4, axis=1) for y in ys)
    np.testing.assert_allclose(changes(found, still, sizes), 0)
    still[1][0, 2, 1] += sizes[1][1]  # one velocity of one lane changes by its size
    np.testing.assert_allclose(changes(found, still, sizes), [abs(found[0, 4]), 0], 0, 1e-12)


def test_linear_invariants_of_a_complex_state():
    """The real and the imaginary part of a sum of amplitudes."""
    rng = np.random.default_rng(0)
    ys = rng.normal(size=(2, 4, 3)) + 1j * rng.normal(size=(2, 4, 3))
    sizes = np.abs(ys).max(axis=(0, 1))

    def exchange(t, y, args):
        flow = (y - jnp.roll(y, 1)) ** 2
        return flow - jnp.roll(flow, 1)

    norm = dfc.FirstIntegral(lambda t, y, args: jnp.sum(jnp.abs(y) ** 2))
    found = linear_invariants(exchange, jnp.arange(4.0), ys, sizes, None, {"norm": norm})
    unit = sizes / np.linalg.norm(sizes)
    expected = np.zeros((6, 6))
    expected[:3, :3] = expected[3:, 3:] = np.outer(unit, unit)
    np.testing.assert_allclose(found.T @ found, expected, atol=1e-8)
    still = np.repeat(ys[:, :1], 4, axis=1)
    still[0, 2, 1] += 1j * sizes[1]
    np.testing.assert_allclose(changes(found, still, sizes), [unit[1], 0], atol=1e-8)


def test_an_entry_that_is_left_out_is_zero():
    entry = dfc.FirstIntegral(
        lambda t, y, args: {"a": y**2}, value={"a": 4.0}, rate=lambda t, y, args: {"a": y}
    )
    on, off = switched(entry, kept=True), switched(entry, kept=False)
    y = jnp.array(3.0)
    assert on.fn(0.0, y, None)["a"] == 9
    assert off.fn(0.0, y, None)["a"] == off.value["a"] == off.rate(0.0, y, None)["a"] == 0
    assert on.rate(0.0, y, None)["a"] == 3
    assert isinstance(switched(dfc.Constraint(entry.fn), kept=True), dfc.Constraint)


KEPT = dfc.FirstIntegral(energy)


def of(field=henon_heiles, solver=dfc.RK4(), manifold=KEPT, y0=Y0, **options):
    options = dict(t1=1.0, dt0=0.1, args=(1.0, 1.0, 1.0)) | options
    return lambda: dfc.compare(field, solver, manifold, y0, **options)


ALONG = dfc.AlongLine(direction="error")
test_what_is_refused = refused(
    (of(rtol=1e-6, atol=1e-6), ValueError, "dt0.*rtol.*both"),
    (of(dt0=None), ValueError, "dt0.*neither"),
    (of(dt0=None, rtol=1e-6), ValueError, "`atol` is missing"),
    (of(dt0=-0.1), ValueError, "dt0.*positive"),
    (of(t1=-1.0), ValueError, "`t1` is -1.0.*it must be"),
    (of(max_steps=0), ValueError, "max_steps"),
    (of(y0={"a": Y0, "b": Y0[:2]}, batch=True), ValueError, "leading axis"),
    (of(reference="Dopri8"), TypeError, r"reference.*diffrax.Dopri8\(\)"),
    (of(projection=ALONG, metric=2.0), ValueError, "AlongLine.*no metric"),
    (of(solver=dfc.ManifoldProjection(dfc.RK4(), KEPT)), ValueError, "solver.solver"),
    (of(solver=dfx.Tsit5), TypeError, r"diffrax.Tsit5\(\)"),
    (of(manifold=energy), TypeError, r"FirstIntegral\(fn\)"),
    (of(manifold={}), ValueError, "nothing to conserve"),
    (of(y0=np.array([1, 0])), TypeError, "floating-point.*dtype=float"),
    (of(lambda y: y), TypeError, r"vector_field\(t, y, args\)"),
    (of(lambda t, y, args: y[:1]), ValueError, "`vector_field` returns"),
)


def test_starts_in_float32_have_a_reference_in_float64():
    start, end = jnp.float32(0), jnp.float32(1)
    task = Task(
        dfx.ODETerm(lambda t, y, args: -y), None, jnp.ones((1, 2), jnp.float32), start, end, end,
        dfx.ConstantStepSize(), dfx.SaveAt(t1=True), False, 1,
    )  # fmt: skip
    exact, _ = references(task, dfx.Dopri8(), np.array([0.0, 1.0]), np.ones(2))
    np.testing.assert_allclose(exact[0, -1], np.exp(-1.0), rtol=1e-12)


def test_float64_is_asked_for():
    with jax.enable_x64(False), pytest.raises(RuntimeError, match="jax_enable_x64"):
        of(y0=jnp.ones(4))()


def test_the_command_passes_on_what_it_is_given_and_draws(monkeypatch, tmp_path):
    given = {}

    def remember(field, solver, manifold, y0, **options):
        given.update(options, solver=solver, y0=y0)
        return report_of(1e-3, 1e-4)

    monkeypatch.setattr(_verdict, "compare", remember)
    assert main(["compare", "pollu", "--starts", "3", "--seed", "1", "--tol", "1e-5"]) == 0
    assert isinstance(given["solver"], dfx.Kvaerno5)
    assert given["y0"].shape == (3, 20)
    assert (given["rtol"], given["atol"], given["t1"]) == (1e-5, 1e-9, dfc.systems.Pollu.t1)
    assert given["projection"] is not None
    assert main(["compare", "kepler", "--t1", "3", "--out", str(tmp_path)]) == 0
    assert {file.name for file in tmp_path.iterdir()} == {"verdict.png", "verdict.pdf"}
    assert (given["t1"], given["dt0"], given["batch"]) == (3.0, dfc.systems.Kepler.dt, False)
