"""The benchmark runs, checks what it times, and refuses a wrong answer."""

import importlib.util
import json
import sys
from pathlib import Path

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc

FOLDER = Path(__file__).parent.parent / "benchmarks"


def benchmark(name):
    """The benchmark as a module, loaded by its path; it finds its neighbours as a script does."""
    (file,) = FOLDER.glob(f"*/{name}.py")
    if str(file.parent) not in sys.path:
        sys.path.append(str(file.parent))
    spec = importlib.util.spec_from_file_location(name, file)
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
    assert all(row["ns"] > 0 for row in rows.values())
    assert all(rows[name]["compile_seconds"] > 0 for name in ("plain", "projected"))
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


@pytest.mark.slow
def test_c_leaves_the_arithmetic_of_the_process_alone(overhead):
    problem = overhead.PROBLEMS["rigid-body"]
    overhead.hand_written_c(problem, overhead.initial_states(problem, 1))
    assert np.finfo(np.float64).tiny / np.array(2.0) > 0  # subnormal


def test_contestants_take_turns_and_long_ones_have_one():
    measuring, calls = benchmark("measuring"), []
    runs = {"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}
    best = measuring.take_turns(runs, rounds=2, long=-1.0)
    assert calls == ["a", "b"]
    assert all(result.seconds >= 0 for result in best.values())
    calls.clear()
    measuring.take_turns(runs, rounds=2)
    assert calls == ["a", "b", "a", "a", "b", "b"]  # short ones are run twice, timed once


# ---- Error against time, scaling, and what the pages show of it ----


@pytest.fixture(scope="module")
def precision():
    return benchmark("work_precision")


@pytest.fixture(scope="module")
def precision_curves(precision):
    return sys.modules["curves"]


def test_the_time_to_an_error_is_read_off_a_power_law(precision_curves):
    rows = [dict(seconds=10.0**k, error=100.0**-k) for k in range(5)]
    assert precision_curves.time_to(rows, "error", 1e-5) == pytest.approx(10**2.5)
    assert precision_curves.time_to(rows, "error", 2.0) == 1.0  # the first is accurate enough
    assert precision_curves.time_to(rows, "error", 1e-9) is None


def test_a_drift_that_never_was_too_large_costs_nothing(precision_curves):
    rows = [dict(seconds=10.0**k, error=100.0**-k, drift=0.0) for k in range(5)]
    rows[0]["seconds"] = 1e6
    drifting = [row | {"drift": 1e-10 * row["error"]} for row in rows]
    found = precision_curves.times_to({"kept": rows, "drifts": drifting}, 1e-5)
    assert found["kept"]["error"] == found["kept"]["error and drift"] == pytest.approx(10**2.5)
    assert found["drifts"]["error and drift"] == pytest.approx(10**2.5)  # 1e-15 there
    drifting = [row | {"drift": 1e-8 * row["error"]} for row in rows]
    found = precision_curves.times_to({"drifts": drifting}, 1e-5)
    assert found["drifts"]["error and drift"] == pytest.approx(10**3)


def test_one_lucky_error_does_not_count(precision_curves):
    errors = [1e-2, 1e-9, 1e-4, 1e-6]
    rows = [dict(seconds=10.0**k, error=error) for k, error in enumerate(errors)]
    assert 100 < precision_curves.time_to(rows, "error", 1e-5) < 1000


@pytest.mark.slow
def test_every_timed_answer_is_judged(precision):
    system = precision.SYSTEMS["rigid-body"]
    solver = dfc.ManifoldProjection(dfx.Tsit5(), system.manifold)
    contestants = {
        "projected Tsit5": precision.ours(system, solver, 1, (1e-6, 1e-9)),
        "scipy DOP853": precision.Contestant(
            precision.peers.scipy_dop853(precision.peers.EQUATIONS["rigid-body"], precision.T1),
            (1e-6, 1e-9),
        ),
    }
    start = precision.measuring.initial_states(system, 1)
    found = precision.curves(system, contestants, start, rounds=1)
    for coarse, fine in found.values():
        assert fine["error"] < 1e-5 < 0.1 * coarse["error"]
    coarse, fine = found["scipy DOP853"]
    assert 1e-10 < fine["drift"] < 0.1 * coarse["drift"]
    still = precision.Contestant(lambda tolerance, y0: y0 * (1 + tolerance), (1e-5, 1e-8))
    with pytest.raises(AssertionError, match="the drift is"):
        precision.curves(system, {"projected": still}, start, rounds=1)
    worse = precision.Contestant(lambda tolerance, y0: y0 / tolerance, (1e-5, 1e-8))
    with pytest.raises(AssertionError, match="not that of a solver that converges"):
        precision.curves(system, {"a peer": worse}, start, rounds=1)


@pytest.mark.parametrize("name", ["rigid-body", "kepler"])
def test_the_others_solve_our_equations(precision, name):
    system, equations = precision.SYSTEMS[name], precision.peers.EQUATIONS[name]
    state = np.random.default_rng(0).uniform(0.5, 1.5, equations.size)
    y = jfu.ravel_pytree(system.y0)[1](jnp.asarray(state))
    ours, _ = jfu.ravel_pytree(system.vector_field(0.0, y, None))
    np.testing.assert_allclose(equations.vector_field(0.0, state), ours, rtol=1e-14)
    entries = zip(system.manifold.values(), equations.integrals, equations.gradients, strict=True)
    for entry, integral, gradient in entries:
        np.testing.assert_allclose(integral(*state), entry.fn(0.0, y, None), rtol=1e-14)
        ours, _ = jfu.ravel_pytree(jax.grad(lambda y, fn=entry.fn: fn(0.0, y, None))(y))
        np.testing.assert_allclose(gradient(*state), ours, rtol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rigid-body", "kepler"])
@pytest.mark.parametrize("program", ["CVODE", "CVODE with projection", "heyoka", "homproj"])
def test_the_others_arrive_where_we_do(precision, name, program):
    system, equations, t1 = precision.SYSTEMS[name], precision.peers.EQUATIONS[name], 2.0
    solve = {
        "CVODE": lambda: precision.peers.cvode(equations, t1, projected=False),
        "CVODE with projection": lambda: precision.peers.cvode(equations, t1, projected=True),
        "heyoka": lambda: precision.peers.heyoka(equations, t1, [1e-10], width=2),
        "homproj": lambda: precision.peers.homproj(equations, t1),
    }[program]()
    if solve is None:
        pytest.skip(f"{program} is not installed")
    start = precision.measuring.initial_states(system, 3)
    exact = jax.vmap(lambda y0: system.reference(jnp.array([t1]), y0))(start)
    exact = precision.flattened(jax.tree.map(lambda leaf: leaf[:, 0], exact))
    np.testing.assert_allclose(solve(1e-10, precision.flattened(start)), exact, atol=1e-6)


@pytest.mark.slow
def test_a_smoke_run_of_work_and_precision(precision, tmp_path):
    out = tmp_path / "work_precision.json"
    found = precision.main(["--smoke", "--out", str(out)])
    # At toy sizes adaptive Tsit5 stops just short of the batch's target: 1.2e-9 for 1e-9.
    projected = {"rigid-body": "projected Tsit5", "batch": "projected Tsit5, fixed steps"}
    for part, name in projected.items():
        times = found[part]["times"]
        assert times[name]["error and drift"] > 0
        assert times["plain Dopri8"]["error and drift"] is None
    assert found["unlike"]["steps"][0] < found["unlike"]["steps"][2]
    assert json.loads(out.read_text())["parts"] == json.loads(json.dumps(found))


@pytest.mark.slow
def test_the_cost_of_one_constraint_is_measured():
    scaling = benchmark("scaling")
    row = scaling.constraints(1, scaling.SMOKE)
    assert row["projected s/step"] > 0
    assert row["projected drift"] < scaling.MAX_DRIFT < row["plain drift"]
    with pytest.raises(AssertionError, match="the drift is"):
        scaling.check(row | {"projected drift": row["plain drift"]})


def test_shares_of_the_limits_of_a_device():
    scaling = benchmark("scaling")
    row = {"flops": 300.0, "bytes": 50.0}
    shares = scaling.Limits(flops=1e12, bandwidth=1e11).share(row, seconds=1e-9)
    assert shares == pytest.approx(
        {"flops, share of the limit": 0.3, "bytes, share of the limit": 0.5}
    )
    assert scaling.Limits(None, None).share(row, 1e-9) == {}


@pytest.mark.slow
def test_a_smoke_run_of_the_scaling():
    found = benchmark("scaling").main(["--smoke"])
    for table in found["batch"]:
        assert all(row["ns"] > 0 for row in table["rows"].values())
    assert [row["constraints"] for row in found["constraints"]] == [1, 6]
    assert all(row["without energy"] < row["projection"] for row in found["bodies"])


def test_the_results_are_what_the_pages_show():
    report = benchmark("report")
    results = report.read_results()
    pages = [page.read_text(encoding="utf-8") for page in report.PAGES]
    for page in pages:
        assert report.filled(page, results) == page
    for name in report.tables(results):
        assert any(f"<!-- begin: {name} -->" in page for page in pages)


def test_a_goal_is_reached_or_missed():
    goal = benchmark("report").Goal
    assert goal("", 2, 1.9).reached
    assert not goal("", 2, 2.1).reached
    assert goal("", 10, 11, most=False).reached
    assert not goal("", 10, 9, most=False).reached
    assert not goal("", 2, None).reached


@pytest.mark.slow
def test_the_figures_show_every_curve(tmp_path):
    report = benchmark("report")
    results = report.read_results()
    report.write_figures(results, tmp_path)
    assert {x.name for x in tmp_path.iterdir()} == {
        f"{name}.{suffix}" for name in ("work-precision", "scaling") for suffix in ("png", "svg")
    }
    figure = report.figures.work_precision(results["work_precision"])
    legend = figure.axes[-1].get_legend()
    parts = results["work_precision"]["parts"]
    names = {name for part in parts.values() for name in part.get("curves", ())}
    assert {text.get_text() for text in legend.get_texts()} == names


# ---- Learned solvers ----


@pytest.mark.slow
def test_a_smoke_run_of_the_cost_of_learning(capsys):
    found = benchmark("learned_solvers").main(["--smoke"])
    assert found["epochs"]["rigid-body"]["ratio"] > 0
    assert found["solves"]["ratio"] > 0
    assert "| `rigid-body` |" in capsys.readouterr().out


@pytest.mark.slow
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
    page = (FOLDER.parent / "docs" / "appendix" / "zoo.md").read_text(encoding="utf-8")
    assert zoo.tables(benchmark("trained").read_results(zoo.RESULTS)) in page


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
    page = (FOLDER.parent / "docs" / "appendix" / "zoo.md").read_text(encoding="utf-8")
    assert curve.table(results) in page
    curve.draw(results, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 1000


@pytest.mark.slow
def test_a_smoke_run_of_the_pool(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    sample, grown = benchmark("pool").main(["--smoke"])
    assert grown["outside"] < sample["outside"]
    assert 0 < grown["one_step_rms"] < 1


def test_the_pools_results_are_what_the_documentation_shows(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    pool = benchmark("pool")
    page = (FOLDER.parent / "docs" / "appendix" / "training.md").read_text(encoding="utf-8")
    assert pool.table(json.loads(pool.OUT.read_text())) in page


@pytest.mark.slow
def test_a_smoke_run_of_the_paper():
    standard, conservative = benchmark("paper").main(["--smoke"])
    assert standard["plain"]["drift"] > 1e-6
    for found in (standard, conservative):
        assert found["projected"]["drift"] < 1e-14
        assert found["projected"]["failed"] == 0


def test_the_papers_results_are_what_the_documentation_shows():
    """The table of all seeds is that of the result files."""
    paper = benchmark("paper")
    page = (FOLDER.parent / "docs" / "appendix" / "paper.md").read_text(encoding="utf-8")
    assert paper.table(benchmark("trained").read_results(paper.RESULTS)) in page


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
    page = (FOLDER.parent / "docs" / "appendix" / "learning-from-data.md").read_text(
        encoding="utf-8"
    )
    lines = list(learning.table(json.loads(learning.OUT.read_text())))
    assert len(lines) > 20
    assert [line for line in lines if line not in page] == []


@pytest.mark.slow
def test_a_smoke_run_of_the_balances():
    found = benchmark("balance").main(["--smoke"])
    rows = found["pendulum"]["weak friction"]
    assert rows["Tsit5 kept"]["energy"] < 0.1 * rows["Tsit5 plain"]["energy"]
    assert all(row["kept"] <= 1.2 * row["plain"] for row in found["entropy"])


# ---- A hundred million steps ----


@pytest.mark.parametrize("which", ["recorded", pytest.param("short", marks=pytest.mark.slow)])
def test_the_drift_is_flat(which):
    """Of a short run, and of the recorded one, whose table is in the documentation."""
    run = benchmark("long_run")
    recorded = json.loads(run.RESULTS.read_text())
    for row in recorded if which == "recorded" else run.measure(10**3):
        eps = float(np.finfo(row["dtype"]).eps)
        if row["solver"] == "projected":
            assert max(row["drift"].values()) < 4 * eps
        else:
            assert row["drift"]["1e+03"] > 20 * eps
    page = (FOLDER.parent / "docs" / "appendix" / "performance.md").read_text(encoding="utf-8")
    assert run.table(recorded) in page


# ---- What a learned step is worth ----


def test_at_equal_error_a_method_has_a_fraction_of_its_pieces():
    worth = benchmark("worth")
    errors = {1: 1e-2, 2: 1e-3, 4: 1e-5}
    assert worth.around(errors, 1e-2) == (1, 2, 0.0)
    assert worth.around(errors, 1e-3) == (1, 2, 1.0)
    first, second, weight = worth.around(errors, 1e-4)
    assert (first, second) == (2, 4)
    np.testing.assert_allclose(weight, 0.5)
    np.testing.assert_allclose(worth.around(errors, 1e-7)[2], 2.0)


def test_the_table_of_what_a_learned_step_is_worth_is_in_the_documentation():
    worth = benchmark("worth")
    page = (FOLDER.parent / "docs" / "zoo.md").read_text(encoding="utf-8")
    lines = worth.table(json.loads(worth.RESULTS.read_text())).splitlines()
    assert len(lines) == 2 + len(worth.FORCES)
    assert [line for line in lines if line not in page] == []


def test_the_elimination_of_the_rosenbrock_method():
    stiff = benchmark("worth_stiff")
    matrix = jnp.array([[4.0, 1.0], [2.0, 5.0]])[:, :, None] * jnp.ones(3)
    b = jnp.array([1.0, 2.0])[:, None] * jnp.ones(3)
    x = stiff.elimination(matrix)(b)
    np.testing.assert_allclose(x[:, 0], np.linalg.solve(matrix[:, :, 0], b[:, 0]), rtol=1e-14)


@pytest.mark.slow
def test_a_smoke_run_of_what_a_learned_step_is_worth():
    cheap, dear = benchmark("worth").main(["--smoke"])
    for row in (cheap, dear):
        assert all(b["ratio"] > 0 for b in row["batches"].values())
    assert dear["batches"]["4"]["ratio"] > cheap["batches"]["4"]["ratio"]


@pytest.mark.slow
def test_a_smoke_run_of_a_family_of_equations():
    (row,) = benchmark("parameters").main(["--smoke"])
    assert row["family"]["step_rms"] > 0 < row["fixed"]["step_rms"]


@pytest.mark.slow
def test_a_smoke_run_of_stiff_chemistry_from_data():
    found = benchmark("chemistry").main(["--smoke"])
    assert found["balances"] < 1e-13
    assert found["smallest"] >= 0
