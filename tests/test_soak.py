"""The soak finds what is wrong, draws the same again, and continues where it was."""

import argparse

import numpy as np
import pytest

from .soak import __main__ as runner
from .soak import far, oracle
from .soak.families import FAMILIES


@pytest.mark.parametrize("name", [name for name in FAMILIES if not FAMILIES[name].hides])
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


def test_every_attack_has_its_turn_and_its_share():
    options = argparse.Namespace(attack=None, count=10**6, lanes=None, seed=0, program=None)
    jobs = runner.jobs_of(options)
    assert {job.attack for job in jobs[: len(runner.SHARES)]} == set(runner.SHARES)
    assert sum(job.lanes for job in jobs) == pytest.approx(10**6, rel=0.02)


@pytest.mark.parametrize(
    ("code", "wrong"),
    [("raise SystemExit(3)", "crashed"), ("import time; time.sleep(60)", "not ended after 1.0 s")],
)
def test_a_program_that_crashes_or_hangs_is_wrong(monkeypatch, code, wrong):
    monkeypatch.setattr(runner, "GRACE", 1.0 - far.TIMEOUT)
    monkeypatch.setattr(runner, "command_of", lambda _: [runner.sys.executable, "-c", code])
    assert set(runner.run_job(runner.Job("far", 4, 10, 0)).wrong) == {wrong}


def test_a_run_continues_from_its_file(monkeypatch, tmp_path, capsys):
    ran = []

    def run_job(job):
        ran.append(job.number)
        return oracle.Tally(job.lanes, 7, {"why": 1} if job.number == 2 else {}, {}, [])

    monkeypatch.setattr(runner, "run_job", run_job)
    command = ["soak", "--attack", "far", "--lanes", "100", "--state", str(tmp_path / "state")]
    for count, status in [(200, 0), (400, 1), (400, 1)]:
        monkeypatch.setattr(runner.sys, "argv", [*command, "--count", str(count)])
        with pytest.raises(SystemExit) as end:
            runner.main()
        assert end.value.code == status
    assert ran == [0, 1, 2, 3]
    assert "WRONG: why: 1" in capsys.readouterr().out


@pytest.mark.parametrize("which", [("exponential", "simplified"), ("quartic", "closed form")])
def test_far_candidates_in_short(which):
    index = far.PROGRAMS.index((*which, np.float64))
    number = pow(far.STRIDE, -1, len(far.PROGRAMS)) * index % len(far.PROGRAMS)
    tally = far.run(0, number, 500)
    assert tally.tried == 500
    assert tally.success > 100
    assert not tally.wrong, tally.examples
