"""The command line: what it prints and writes, and how it refuses what it cannot do."""

import contextlib
import errno
import io
import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve._replace_file import replace_file
from diffrax_conserve.reproduce import _compare, _job, main

FIGURES = ("trajectory", "drift", "state_error")
PAPER = dfc.systems.names()[:5]
LEARNED = ("standard", "conservative", "standard projected")


@pytest.fixture(autouse=True)
def no_figures(request, monkeypatch):
    """Drawing takes as long as solving: only the tests of it draw."""
    if "draws" not in request.keywords:
        monkeypatch.setattr(_job, "import_plot", lambda: None)


@pytest.fixture
def only_rk4(monkeypatch):
    """For what does not depend on the solvers."""
    monkeypatch.setattr(_job, "is_learned", lambda system: False)
    monkeypatch.setattr(_job, "solvers", lambda system, networks: {"rk4": dfc.RK4()})


def reproduce(tmp_path, *arguments, out="out"):
    """The exit status and the metrics."""
    folder = tmp_path / out
    status = main(["reproduce", *arguments, "--out", str(folder)])
    return status, json.loads((folder / "metrics.json").read_text())


def refused(capsys, *arguments):
    """What is said on standard error about arguments that are refused."""
    with pytest.raises(SystemExit) as exit:
        main(list(arguments))
    assert exit.value.code == 2
    return capsys.readouterr().err


# ---- What it computes, against numpy ----


def rk4(f, y, h, steps, after=lambda y, y0: y):
    ys = [y]
    for _ in range(steps):
        k1 = f(y)
        k2 = f(y + h / 2 * k1)
        k3 = f(y + h / 2 * k2)
        k4 = f(y + h * k3)
        y = after(y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), ys[0])
        ys.append(y)
    return np.array(ys)


def rotation(t):
    """The exact flow of the harmonic oscillator of unit frequency."""
    return np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]])


KEPLER = ("kepler", "--t1", "3", "--dt", "0.2")


@pytest.fixture(scope="module")
def of_kepler(tmp_path_factory):
    """The metrics, and what was said meanwhile."""
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stderr(io.StringIO()) as said:
        patch.setattr(_job, "import_plot", lambda: None)
        _, metrics = reproduce(tmp_path_factory.mktemp("kepler"), *KEPLER)
    return metrics, said.getvalue()


def test_it_says_what_it_is_doing_before_it_is_done(of_kepler):
    said = of_kepler[1].splitlines()
    assert said[0] == "[1/2] rk4: compiles and solves"
    assert said[1] == "[2/2] projected rk4: compiles and solves"


@pytest.mark.slow
def test_metrics_of_the_harmonic_oscillator(tmp_path, monkeypatch):
    monkeypatch.setattr(_job, "is_learned", lambda system: False)  # the others are slow to compile
    t1, h, steps = 3.0, 0.25, 12
    status, metrics = reproduce(tmp_path, "harmonic-oscillator", "--t1", str(t1), "--dt", str(h))
    y0 = np.array(dfc.systems.get("harmonic-oscillator").y0)

    def f(y):
        return np.array([y[1], -y[0]])

    # Projecting on a circle is scaling.
    runs = {
        "rk4": rk4(f, y0, h, steps),
        "projected rk4": rk4(
            f, y0, h, steps, lambda y, y0: y * np.linalg.norm(y0) / np.linalg.norm(y)
        ),
    }
    assert status == 0
    assert metrics["system"] == "harmonic-oscillator"
    assert list(metrics["solvers"]) == list(runs)
    for name, ys in runs.items():
        row = metrics["solvers"][name]
        errors = [np.linalg.norm(y - rotation(k * h) @ y0) for k, y in enumerate(ys)]
        # The scale of an integral that is quadratic, without cancellation, is 3 |I|.
        drift = np.max(np.abs(np.sum(ys**2, axis=1) / np.sum(y0**2) - 1)) / 3
        np.testing.assert_allclose(row["state_error"], errors[-1], rtol=1e-9)
        np.testing.assert_allclose(row["largest_state_error"], max(errors), rtol=1e-9)
        np.testing.assert_allclose(row["drift"]["energy"], drift, rtol=1e-9, atol=4e-16)
        assert row["steps"] == steps
        assert row["seconds"] > 0


def test_metrics_of_keplers_problem(of_kepler):
    t1, h, steps = 3.0, 0.2, 15
    metrics, _ = of_kepler
    system = dfc.systems.Kepler()
    y0 = np.concatenate(system.y0)

    def f(y):
        return np.concatenate([y[2:], -y[:2] / np.sum(y[:2] ** 2) ** 1.5])

    ys = rk4(f, y0, h, steps)
    exact = np.concatenate([x[0] for x in system.reference(jnp.array([t1]))])
    l = ys[:, 0] * ys[:, 3] - ys[:, 1] * ys[:, 2]
    # At the perihelion (q, p) = ((a, 0), (0, b)), where L = a b: the scale is 3 |L|.
    drift = np.max(np.abs(l / l[0] - 1)) / 3
    row = metrics["solvers"]["rk4"]
    np.testing.assert_allclose(row["state_error"], np.linalg.norm(ys[-1] - exact), rtol=1e-9)
    np.testing.assert_allclose(row["drift"]["angular momentum"], drift, rtol=1e-9)
    projected = metrics["solvers"]["projected rk4"]
    assert max(projected["drift"].values()) < 4e-15
    assert projected["state_error"] < row["state_error"]


def test_the_largest_drift_is_over_every_step_however_few_are_plotted(
    of_kepler, tmp_path, monkeypatch
):
    all_plotted, _ = of_kepler
    monkeypatch.setattr(_compare, "PLOTTED_MAX", 3)
    _, few_plotted = reproduce(tmp_path, *KEPLER)
    for name, row in few_plotted["solvers"].items():
        assert row["drift"] == all_plotted["solvers"][name]["drift"]
        assert row["state_error"] == pytest.approx(
            all_plotted["solvers"][name]["state_error"], rel=1e-9
        )


def test_a_last_step_that_is_shorter(tmp_path, of_kepler):
    # As many steps as those of the others, for which nothing is compiled anew.
    _, metrics = reproduce(tmp_path, "kepler", "--t1", "2.9", "--dt", "0.2")
    assert metrics["solvers"]["rk4"]["steps"] == 15
    whole = of_kepler[0]["solvers"]["projected rk4"]["state_error"]
    assert metrics["solvers"]["projected rk4"]["state_error"] < 2 * whole


# ---- What it writes and prints ----


def assert_written(folder, names, printed, *texts):
    """Figures of these names, the metrics and nothing else; and the texts in what was printed."""
    files = list(folder.iterdir())
    figures = {f"{name}.{suffix}" for name in names for suffix in ("png", "pdf")}
    assert {f.name for f in files} == {*figures, "metrics.json"}
    assert all(f.stat().st_size > 100 for f in files)
    for text in (*texts, "steps", "compile"):
        assert text in printed


@pytest.mark.draws
def test_files_and_nothing_else(tmp_path, capsys, only_rk4):
    reproduce(tmp_path, *KEPLER)
    printed = capsys.readouterr().out
    assert_written(tmp_path / "out", FIGURES, printed, "rk4", "drift of angular momentum")


def test_a_write_that_fails_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "metrics.json"
    path.write_text("old")

    def half(temporary):
        temporary.write_text("ne")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        replace_file(path, half)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk(tmp_path, monkeypatch, capsys, only_rk4):
    def full(*arguments, **options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "metrics.json")

    monkeypatch.setattr("diffrax_conserve.reproduce._job.replace_file", full)
    argv = ["reproduce", "harmonic-oscillator", "--t1", "0.5", "--out", str(tmp_path / "out")]
    assert main(argv) == 1
    found = capsys.readouterr().err
    assert found.endswith("\nerror: cannot write metrics.json: No space left on device\n")


PROJECT = tomllib.loads(Path(__file__).parents[1].joinpath("pyproject.toml").read_text())
MODULE, FUNCTION = PROJECT["project"]["scripts"]["diffrax-conserve"].split(":")


STARTS = "-m diffrax_conserve", f"-c 'import sys, {MODULE} as m; sys.exit(m.{FUNCTION}())'"


# Each start with each redirection; one of the four by default.
@pytest.mark.parametrize(
    ("start", "redirection"),
    [
        (STARTS[0], "> /dev/full"),
        pytest.param(STARTS[1], "| head -1", marks=pytest.mark.slow),
        pytest.param(STARTS[0], "| head -1", marks=pytest.mark.slow),
        pytest.param(STARTS[1], "> /dev/full", marks=pytest.mark.slow),
    ],
    ids=["module-full", "command-head", "module-head", "command-full"],
)
def test_an_output_that_ends_early(start, redirection):
    command = f"set -o pipefail; {sys.executable} {start} list {redirection}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert "Traceback" not in done.stderr
    assert "Exception" not in done.stderr
    if "full" in redirection:
        assert done.stderr == "error: cannot write: No space left on device\n"
        assert done.returncode == 1


def test_the_folder_of_the_system_is_the_default(tmp_path, monkeypatch, only_rk4):
    monkeypatch.chdir(tmp_path)
    assert main(["reproduce", "harmonic-oscillator", "--t1", "0.5"]) == 0
    assert (tmp_path / "out" / "harmonic-oscillator" / "metrics.json").exists()


def test_list_names_every_system(capsys):
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(dfc.systems.names())


# Slow by their number, and for the learned solvers that they compile.
@pytest.mark.slow
@pytest.mark.draws
@pytest.mark.parametrize("name", dfc.systems.names())
def test_every_system(name, tmp_path):
    system = dfc.systems.get(name)
    status, metrics = reproduce(tmp_path, name, "--t1", str(3 * system.dt))
    assert status == 0
    assert set(metrics["solvers"]) == {"rk4", "projected rk4", *(LEARNED if name in PAPER else ())}
    for row in metrics["solvers"].values():
        assert row["steps"] == 3
        assert row["drift"].keys() == system.manifold.keys()
        assert np.isfinite(row["state_error"])
    for solver in {"projected rk4", "conservative", "standard projected"} & set(metrics["solvers"]):
        assert max(metrics["solvers"][solver]["drift"].values()) < 1e-14


# ---- What it refuses ----


def test_an_unknown_system_is_told_the_close_matches(capsys):
    message = refused(capsys, "reproduce", "keppler")
    assert "'kepler'" in message
    assert "rigid-body" in message  # and what else there is


@pytest.mark.parametrize("option", ["--t1", "--dt"])
@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "ten"])
def test_times_that_are_not_positive_numbers(capsys, option, value):
    message = refused(capsys, "reproduce", "kepler", f"{option}={value}")
    assert option in message
    assert "positive" in message


def test_a_step_longer_than_the_solve(capsys, tmp_path):
    arguments = ("--t1", "1", "--dt", "2", "--out", str(tmp_path / "out"))
    message = refused(capsys, "reproduce", "kepler", *arguments)
    assert "dt" in message
    assert "at most dt = 1" in message
    assert not (tmp_path / "out").exists()


def test_more_steps_than_memory_holds(capsys, tmp_path):
    message = refused(capsys, "reproduce", "kepler", "--dt", "1e-9", "--out", str(tmp_path))
    assert "larger dt" in message


def test_training_what_cannot_be_trained(capsys, tmp_path):
    message = refused(capsys, "reproduce", "kepler", "--train", "--out", str(tmp_path / "out"))
    assert "no learned solvers for kepler" in message
    assert "--train" in refused(capsys, "reproduce", "rigid-body", "--epochs", "3")
    for epochs in ("0", "-1", "many"):
        message = refused(capsys, "reproduce", "rigid-body", "--train", f"--epochs={epochs}")
        assert "positive whole number" in message


def test_a_folder_that_cannot_be_written(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    message = refused(capsys, "reproduce", "kepler", "--out", str(tmp_path / "file" / "out"))
    assert "--out" in message


@pytest.mark.draws
def test_without_matplotlib(tmp_path, monkeypatch, capsys, only_rk4):
    """Everything works but the figures; `reproduce` says what to install for them."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    # It may have been imported before.
    monkeypatch.delitem(sys.modules, "diffrax_conserve.reproduce._plot", raising=False)
    monkeypatch.delattr("diffrax_conserve.reproduce._plot", raising=False)
    status, _ = reproduce(tmp_path, *KEPLER)
    assert status == 0
    printed = capsys.readouterr().out
    assert "rk4" in printed
    assert "pip install 'diffrax-conserve[plots]'" in printed
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["metrics.json"]


@pytest.mark.slow
def test_an_interpreter_without_matplotlib(tmp_path):
    (tmp_path / "matplotlib.py").write_text("raise ImportError('No module named matplotlib')")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}

    code = (
        "from diffrax_conserve.reproduce import main\n"
        "assert main(['list']) == 0\n"
        "raise SystemExit(main(['reproduce', 'kepler', '--t1', '1']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert all(name in done.stdout for name in dfc.systems.names())
    assert "projected rk4" in done.stdout
    assert "pip install 'diffrax-conserve[plots]'" in done.stdout
    assert [file.name for file in (tmp_path / "out" / "kepler").iterdir()] == ["metrics.json"]


# ---- What it says about a solver that fails ----


def test_a_projection_that_fails_costs_the_other_solver_nothing(tmp_path, capsys):
    """Steps this long have no point on the manifold near their candidates."""
    # As many steps as those of the others, for which nothing is compiled anew.
    status, metrics = reproduce(tmp_path, "kepler", "--t1", "90", "--dt", "6")
    rows = metrics["solvers"]
    failed = [name for name, row in rows.items() if "failure" in row]
    assert status == 1
    assert failed == ["projected rk4"]
    assert rows["projected rk4"]["state_error"] is None
    assert np.isfinite(rows["rk4"]["state_error"])
    assert "projected rk4 FAILED after t = " in capsys.readouterr().out


def test_a_solver_that_cannot_start(tmp_path, capsys, monkeypatch):
    def solvers(system, networks):
        return {"rk4": dfc.RK4(), "leapfrog": dfx.SemiImplicitEuler()}

    monkeypatch.setattr(_job, "solvers", solvers)
    status, metrics = reproduce(tmp_path, *KEPLER)
    assert status == 1
    assert "failure" in metrics["solvers"]["leapfrog"]
    assert metrics["solvers"]["rk4"]["state_error"] > 0
    assert "leapfrog FAILED at the start" in capsys.readouterr().out


@pytest.mark.slow
def test_a_step_longer_than_the_flow_map_was_trained_for(tmp_path, capsys):
    status, metrics = reproduce(
        tmp_path, "conservative-lorenz", "--dt", "0.5", "--t1", "1", out="long"
    )
    assert status == 1
    assert metrics["solvers"]["rk4"]["state_error"] > 0
    for name in LEARNED:
        assert metrics["solvers"][name]["state_error"] is None
        assert "0.5 " in metrics["solvers"][name]["failure"]
        assert "0.25" in metrics["solvers"][name]["failure"]


@pytest.mark.slow
def test_training_anew(tmp_path, capsys):
    arguments = ("rigid-body", "--train", "--epochs", "3", "--seed", "1", "--t1", "0.1")
    status, metrics = reproduce(tmp_path, *arguments)
    assert status == 0
    assert "Training the conservative network: 3 epochs, seed 1" in capsys.readouterr().out
    for kind in ("standard", "conservative"):
        file = tmp_path / "out" / f"{kind}.network"
        assert dfc.learned.read_info(file)["info"]["seed"] == 1
        assert (dfc.load(file).layer is None) == (kind == "standard")
    # Three epochs teach nothing, and the manifold holds all the same.
    assert metrics["solvers"]["conservative"]["state_error"] > 1e-3
    assert max(metrics["solvers"]["conservative"]["drift"].values()) < 1e-14


def test_a_state_that_blows_up(tmp_path, only_rk4):
    status, metrics = reproduce(tmp_path, "harmonic-oscillator", "--t1", "1.5e11", "--dt", "1e10")
    assert status == 1
    assert "not finite" in metrics["solvers"]["rk4"]["failure"]
