"""The command line: what it prints and writes, and how it refuses what it cannot do."""

import contextlib
import io
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve._replace_file import replace_file
from diffrax_conserve.reproduce import _job, main

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


def rk4(f, y, h, steps):
    ys = [y]
    for _ in range(steps):
        k1 = f(y)
        k2 = f(y + h / 2 * k1)
        k3 = f(y + h / 2 * k2)
        k4 = f(y + h * k3)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        ys.append(y)
    return np.array(ys)


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


PROJECT = tomllib.loads(Path(__file__).parents[1].joinpath("pyproject.toml").read_text())
MODULE, FUNCTION = PROJECT["project"]["scripts"]["diffrax-conserve"].split(":")


# One of the ways to start with each redirection.
@pytest.mark.parametrize(
    ("start", "redirection"),
    [
        ("-m diffrax_conserve", "> /dev/full"),
        pytest.param(
            f"-c 'import sys, {MODULE} as m; sys.exit(m.{FUNCTION}())'",
            "| head -1",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["module-full", "command-head"],
)
def test_an_output_that_ends_early(start, redirection):
    command = f"set -o pipefail; {sys.executable} {start} list {redirection}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert "Traceback" not in done.stderr
    assert "Exception" not in done.stderr
    if "full" in redirection:
        assert done.stderr == "error: cannot write: No space left on device\n"
        assert done.returncode == 1


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
