"""The benchmark runs, checks what it times, and refuses a wrong answer."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).parent.parent / "benchmarks"


def benchmark(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def overhead():
    return benchmark("overhead")


def test_a_smoke_run_measures_verified_answers(overhead, tmp_path, capsys):
    out = tmp_path / "overhead.json"
    tables = overhead.main(["--smoke", "--only", "rigid-body RK4 8", "--out", str(out)])
    assert len(tables) == 1
    rows = tables[0]["rows"]
    assert {"plain", "projected", "root_find by hand"} <= rows.keys()
    assert all(row["ns"] > 0 and row["compile_seconds"] > 0 for row in rows.values())
    assert rows["projected"]["drift"] <= overhead.MAX_DRIFT < rows["plain"]["drift"]
    assert json.loads(out.read_text())["tables"] == json.loads(json.dumps(tables))
    assert "rigid-body, RK4, batch of 8" in capsys.readouterr().out


def test_an_answer_that_drifts_is_refused(overhead):
    problem = overhead.PROBLEMS["rigid-body"]
    start = overhead.initial_states(problem, 1)
    wrong = overhead.Contestant(lambda steps: (1.001 * start, steps), overhead.MAX_DRIFT)
    with pytest.raises(AssertionError, match="drift"):
        overhead.measure(problem, {"projected": wrong}, start, overhead.SMOKE, horizon=0.1)


def test_an_answer_that_is_not_a_number_is_refused(overhead):
    problem = overhead.PROBLEMS["rigid-body"]
    start = overhead.initial_states(problem, 1)
    wrong = overhead.Contestant(lambda steps: (np.nan * start, steps), np.inf)
    with pytest.raises(AssertionError, match="drift"):
        overhead.measure(problem, {"plain": wrong}, start, overhead.SMOKE, horizon=0.1)


def test_another_answer_from_c_is_refused(overhead):
    start = overhead.initial_states(overhead.PROBLEMS["rigid-body"], 1)
    ours = overhead.Contestant(lambda steps: (start, steps), np.inf)
    theirs = overhead.Contestant(lambda steps: (start + 1e-9, steps), np.inf)
    with pytest.raises(AssertionError, match="C and we differ"):
        overhead.check_states({"plain": ours, "plain, C": theirs}, 1)


# ---- Learned solvers ----


@pytest.mark.slow
def test_c_leaves_the_arithmetic_of_the_process_alone(overhead):
    problem = overhead.PROBLEMS["rigid-body"]
    overhead.hand_written_c(problem, overhead.initial_states(problem, 1))
    assert np.finfo(np.float64).tiny / np.array(2.0) > 0  # subnormal


def test_a_smoke_run_of_the_cost_of_learning(capsys):
    found = benchmark("learned").main(["--smoke"])
    assert found["epochs"]["rigid-body"]["ratio"] > 0
    assert found["solves"]["ratio"] > 0
    assert "| `rigid-body` |" in capsys.readouterr().out


def test_a_smoke_run_of_the_sweeps(capsys):
    found = benchmark("sweeps").main(["--smoke"])
    none, two = found["sweeps"]["conservative-lorenz-standard"]["rows"]
    assert two["error"] < 0.1 * none["error"]
    (places,) = found["estimates"].values()
    np.testing.assert_allclose(places["inside"]["ratio"], 1, atol=0.05)
    assert "| 2 Picard |" in capsys.readouterr().out


@pytest.mark.slow
def test_a_smoke_run_of_the_zoo():
    pinn, flow_map = benchmark("zoo").main(["--smoke"])
    assert pinn["errors"]["projected"]["relative_l2_error"] < 1
    assert flow_map["errors"]["RK4"]["one_step_rms"] < flow_map["errors"]["plain"]["one_step_rms"]
    assert all(x["ns_per_step"] > 0 for x in flow_map["errors"].values())


def test_the_zoos_results_are_what_the_documentation_shows():
    zoo = benchmark("zoo")
    page = (FOLDER.parent / "docs" / "zoo.md").read_text(encoding="utf-8")
    assert zoo.tables(zoo.read_results()) in page


@pytest.mark.slow
def test_a_smoke_run_of_the_zoos_curve(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    point = benchmark("zoo_curve").main(["--smoke"])
    assert 0 < point["one_step_rms"] < 1
    assert point["cpu_seconds"] > 0


def test_the_zoos_curve_is_what_the_documentation_shows(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(FOLDER)
    curve = benchmark("zoo_curve")
    results = curve.read_results()
    page = (FOLDER.parent / "docs" / "zoo.md").read_text(encoding="utf-8")
    assert curve.table(results) in page
    curve.draw(results, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 1000


def test_a_smoke_run_of_the_paper():
    standard, conservative = benchmark("paper").main(["--smoke"])
    assert standard["plain"]["drift"] > 1e-6
    for found in (standard, conservative):
        assert found["projected"]["drift"] < 1e-14
        assert found["projected"]["failed"] == 0


def test_the_papers_results_are_what_the_documentation_shows():
    """The table of all seeds is that of the result files."""
    paper = benchmark("paper")
    page = (FOLDER.parent / "docs" / "paper.md").read_text(encoding="utf-8")
    assert paper.table(paper.read_results()) in page


@pytest.mark.slow
def test_a_smoke_run_of_random_features_meets_the_targets(tmp_path):
    out = tmp_path / "random_features.json"
    found = benchmark("random_features").main(["--smoke", "--out", str(out)])
    assert all(row["error"] <= 1e-12 and row["seconds"] < 1 for row in found["targets"])
    assert all(row["okay"] and row["error"] < 1e-4 for row in found["comparison"])
    assert found["energy"][1]["drift"]["energy"] < 1e-14 < found["energy"][0]["drift"]["energy"]
    assert json.loads(out.read_text())["targets"] == found["targets"]


@pytest.mark.slow
def test_a_smoke_run_of_learning_from_data():
    found = benchmark("learning_from_data").main(["--smoke"])
    known = found["known"]["0.01"]["plain"]["solved"]
    assert known["projected"]["drift"] < 1e-14 < 1e-6 < known["plain"]["drift"]
    unknown = found["unknown"]["learned field"]
    assert unknown["true integral"]["drift"] < 1e-14 < 1e-6 < unknown["plain"]["drift"]
    assert all(row["failed"] == 0 for row in (*known.values(), *unknown.values()))


def test_the_results_of_learning_from_data_are_what_the_documentation_shows():
    learning = benchmark("learning_from_data")
    page = (FOLDER.parent / "docs" / "learning-from-data.md").read_text(encoding="utf-8")
    lines = list(learning.table(json.loads(learning.OUT.read_text())))
    assert len(lines) > 20
    assert [line for line in lines if line not in page] == []
