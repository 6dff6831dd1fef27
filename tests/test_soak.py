"""The soak finds what is wrong, draws the same again, and continues where it was."""

import collections

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from .soak import __main__ as runner
from .soak import combinations, far, kepler, oracle
from .soak.families import FAMILIES

PROGRAM = combinations.Program("harmonic-oscillator", ("energy",), "RK4", False, False, "ts", False)


@pytest.fixture(scope="module")
def run():
    lanes = combinations.draw_lanes(PROGRAM, 0, 0, 4)
    # Small steps, of which an error is asked for.
    lanes = eqx.tree_at(lambda x: x.dt0, lanes, jnp.full(4, 0.002))
    lanes = eqx.tree_at(lambda x: x.span, lanes, 0.1 * jnp.sign(lanes.span))
    return lanes, combinations.run_batch(PROGRAM, lanes)


@pytest.mark.slow
def test_what_is_right_is_judged_right(run):
    verdict = combinations.judge(PROGRAM, *run)
    assert not verdict.failed.any()
    assert verdict.wrong == {}
    assert 0 < verdict.worst_ratio <= 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [("ratio", 1.5, "residual"), ("ratio", np.nan, "residual"), ("finite", False, "not finite")],
)
def test_what_is_wrong_is_found(run, field, value, reason):
    lanes, outcome = run
    planted = getattr(outcome, field).at[2].set(value)
    outcome = eqx.tree_at(lambda o: getattr(o, field), outcome, planted)
    assert reason in combinations.judge(PROGRAM, lanes, outcome).wrong[2]
    # Unless the solve says that it failed.
    failed = eqx.tree_at(lambda o: o.okay, outcome, outcome.okay.at[2].set(False))
    assert combinations.judge(PROGRAM, lanes, failed).wrong == {}


@pytest.mark.slow
def test_a_wrong_solution_on_the_manifold_is_found(run):
    lanes, outcome = run
    mirrored = eqx.tree_at(lambda o: o.states, outcome, jax.tree.map(lambda x: -x, outcome.states))
    wrong = combinations.judge(PROGRAM, lanes, mirrored).wrong
    assert all("the error is" in why for why in wrong.values())
    assert len(wrong) == 4


def test_programs_are_drawn_again_and_cover_every_system():
    programs = [combinations.draw_program(3, k) for k in range(len(combinations.SYSTEMS))]
    assert programs == [combinations.draw_program(3, k) for k in range(len(combinations.SYSTEMS))]
    assert {p.system for p in programs} == set(combinations.SYSTEMS)
    other = [combinations.draw_program(4, k) for k in range(len(combinations.SYSTEMS))]
    assert programs != other


@pytest.mark.parametrize("name", FAMILIES)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_oracle_takes_a_rounded_answer_and_refuses_one_that_is_off(name, dtype):
    rng = np.random.default_rng(0)
    lane = far.draw(name, dtype, rng, 200)
    family = FAMILIES[name]
    value = oracle.values(family.fn, lane["start"], lane["a"])
    if family.constraint:
        value = np.zeros_like(value)
    rounded = (lane["start"] * (1 + 2e-9 * rng.normal(size=200))).astype(np.float32).astype(dtype)
    if dtype is np.float32:
        assert (oracle.ratio(family.fn, rounded, lane["a"], value) <= 1).all()
    else:
        assert (oracle.ratio(family.fn, lane["start"], lane["a"], value) <= 1).all()
        assert np.median(oracle.ratio(family.fn, rounded, lane["a"], value)) > 1
    lane["start"][0, 3] = np.nan
    assert np.isinf(oracle.ratio(family.fn, lane["start"], lane["a"], value)[3])


@pytest.mark.parametrize("name", FAMILIES)
def test_the_scale_is_that_of_finite_differences(name):
    family = FAMILIES[name]
    y, a = map(oracle.long, family.draw(np.random.default_rng(1), 5))
    value = oracle.values(family.fn, y, a)
    expected = np.abs(value)
    for k in range(family.n):
        h = 1e-6 * y[k] * np.eye(family.n)[:, [k]]
        change = oracle.values(family.fn, y + h, a) - oracle.values(family.fn, y - h, a)
        expected = expected + np.abs(change) / 2e-6
    np.testing.assert_allclose(oracle.scales(family.fn, y, a, value), expected, 1e-5)


@pytest.mark.parametrize("method", [kepler.nearest, kepler.frozen])
@pytest.mark.parametrize("e", [0.1, 1e-3, 1e-9])
def test_the_orbits_in_long_double_are_projected_to(method, e):
    rng = np.random.default_rng(2)
    on = kepler.orbit(oracle.long(e + np.zeros(9)), oracle.long(1.1), *rng.uniform(-3, 3, (2, 9)))
    z = on + 1e-2 * e * rng.normal(size=on.shape)
    y, length = method(z, (oracle.long(e) ** 2, oracle.long(1.1)), on)
    square, momentum = kepler.level(y)
    assert (length < 1e-9 * e).all()
    assert np.abs(np.sqrt(square) - e).max() < 1e-9 * e
    assert np.abs(momentum - oracle.long(1.1)).max() < 1e-15
    assert (np.abs(y - z).max(0) < e).all()


def options(tmp_path, **changes):
    class Options:
        attack, count, lanes, seed, first, program = ("far",), 600, 100, 0, 0, None

    for name, value in changes.items():
        setattr(Options, name, value)
    return Options


def test_every_attack_has_its_turn_and_its_share(tmp_path):
    jobs = runner.jobs_of(options(tmp_path, attack=None, count=10**6, lanes=None))
    assert {job.attack for job in jobs[: len(runner.SHARES)]} == set(runner.SHARES)
    tried = collections.Counter()
    for job in jobs:
        tried[job.attack] += len(job.numbers) * job.lanes
    assert sum(tried.values()) == pytest.approx(10**6, rel=0.02)


@pytest.mark.parametrize(
    ("code", "wrong"),
    [
        ("raise SystemExit(3)", "crashed"),
        ("import time; time.sleep(60)", "not ended after 0.0 s"),
    ],
)
def test_a_worker_that_crashes_or_hangs_is_wrong(monkeypatch, code, wrong):
    monkeypatch.setattr(runner, "GRACE", 1.0)
    monkeypatch.setattr(runner, "command_of", lambda *_: [runner.sys.executable, "-c", code])
    tallies = list(runner.run_job(runner.Job("far", [4, 5], 10, 0.0), 0))
    assert [number for number, _ in tallies] == [4, 5]
    assert all(set(tally.wrong) == {wrong} for _, tally in tallies)


def test_a_run_continues_from_its_file(monkeypatch, tmp_path, capsys):
    ran = []

    def run_job(job, seed):
        for number in job.numbers:
            ran.append(number)
            yield number, oracle.Tally(job.lanes, 7, {"why": 1} if number == 2 else {}, {}, [])

    monkeypatch.setattr(runner, "run_job", run_job)
    command = ["soak", "--attack", "far", "--lanes", "100", "--state", str(tmp_path / "state")]
    for count, status in [(200, 0), (400, 1), (400, 1)]:
        monkeypatch.setattr(runner.sys, "argv", [*command, "--count", str(count)])
        with pytest.raises(SystemExit) as end:
            runner.main()
        assert end.value.code == status
    assert ran == [0, 1, 2, 3]
    assert "WRONG: why: 1" in capsys.readouterr().out


# The exponential (far candidates by the default), the quartic (closed forms).
@pytest.mark.parametrize("which", [("exponential", "simplified"), ("quartic", "closed form")])
def test_far_candidates_in_short(which):
    index = far.PROGRAMS.index((*which, np.float64))
    number = next(n for n in range(len(far.PROGRAMS)) if 7 * n % len(far.PROGRAMS) == index)
    tally = far.run(0, number, 500)
    assert tally.tried == 500
    assert tally.success > 100
    assert not tally.wrong, tally.examples
