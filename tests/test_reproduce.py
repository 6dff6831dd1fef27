"""The command line: what it prints and writes, and how it refuses what it cannot do."""

import json
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_conserve as dfc
from diffrax_conserve.learned._files import read_info
from diffrax_conserve.reproduce import _command, _job, main

from .problems import KEPLER0, kepler, solve

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


KEPLER = ("kepler", "--t1", "3", "--dt", "0.2")


FIGURES = {f"{x}.{y}" for x in ("trajectory", "drift", "state_error") for y in ("png", "pdf")}


def test_metrics_and_words_of_keplers_problem(tmp_path, capsys):
    """The numbers against those of a solve."""
    status, metrics = reproduce(tmp_path, *KEPLER)
    assert status == 0
    printed, said = capsys.readouterr()
    assert said.splitlines()[0] == "[1/2] rk4: compiles and solves"
    for text in ("rk4", "drift of angular momentum", "steps", "compile"):
        assert text in printed
    saveat = dfx.SaveAt(t0=True, steps=True)
    q, p = solve(kepler, dfc.RK4(), KEPLER0, t1=3.0, dt0=0.2, saveat=saveat, max_steps=15).ys
    exact = [x[0] for x in dfc.systems.Kepler().reference(jnp.array([3.0]))]
    error = np.linalg.norm(np.concatenate([q[-1] - exact[0], p[-1] - exact[1]]))
    l = q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0]
    # At the perihelion (q, p) = ((a, 0), (0, b)), where L = a b: the scale is 3 |L|.
    drift = np.max(np.abs(l / l[0] - 1)) / 3
    row, projected = (metrics["solvers"][name] for name in ("rk4", "projected rk4"))
    np.testing.assert_allclose(row["state_error"], error, rtol=1e-9)
    np.testing.assert_allclose(row["drift"]["angular momentum"], drift, rtol=1e-9)
    assert np.max([*projected["drift"].values()]) < 4e-15
    assert projected["state_error"] < row["state_error"]


PROJECT = tomllib.loads(Path(__file__).parents[1].joinpath("pyproject.toml").read_text())
MODULE, FUNCTION = PROJECT["project"]["scripts"]["diffrax-conserve"].split(":")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("start", "redirection"),
    [
        ("-m diffrax_conserve", "> /dev/full"),
        (f"-c 'import sys, {MODULE} as m; sys.exit(m.{FUNCTION}())'", "| head -1"),
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
    stiff = dfc.systems.names(stiff=True)
    assert [line.split()[0] for line in lines] == [*dfc.systems.names(), *stiff]


@pytest.mark.parametrize("command", [(), ("list",), ("reproduce",)])
def test_help_shows_examples_that_are_understood(command, capsys):
    with pytest.raises(SystemExit):
        main([*command, "--help"])
    examples = re.findall(r"^  diffrax-conserve (.*)$", capsys.readouterr().out, re.MULTILINE)
    assert examples
    for example in examples:
        assert _command._parser().parse_args(shlex.split(example)).command in example


@pytest.mark.slow
@pytest.mark.draws
@pytest.mark.parametrize("name", dfc.systems.names(stiff=True))
def test_every_stiff_system(name, tmp_path):
    status, metrics = reproduce(tmp_path, name)
    assert status == 0
    plain, projected = (metrics["solvers"][k] for k in ("kvaerno5", "projected kvaerno5"))
    assert projected["state_error"] < 1e-5
    assert np.max([*projected["drift"].values()]) < 1e-15
    assert projected["steps"] < 1.5 * plain["steps"]


# Slow by their number, and for the learned solvers that they compile.
@pytest.mark.slow
@pytest.mark.draws
@pytest.mark.parametrize("name", dfc.systems.names())
def test_every_system(name, tmp_path, caplog):
    system = dfc.systems.get(name)
    status, metrics = reproduce(tmp_path, name, "--t1", str(3 * system.dt))
    assert status == 0
    # matplotlib tells by its logger what it cannot draw as asked.
    assert [x.getMessage() for x in caplog.records if x.name.startswith("matplotlib")] == []
    files = list((tmp_path / "out").iterdir())
    others = {file.name for file in files} - {*FIGURES, "metrics.json"}
    assert len(files) == 7 + len(others)
    assert (name in PAPER) or not others
    assert all(file.stat().st_size > 100 for file in files)
    assert set(metrics["solvers"]) == {"rk4", "projected rk4", *(LEARNED if name in PAPER else ())}
    for row in metrics["solvers"].values():
        assert row["steps"] == 3
        assert row["drift"].keys() == system.manifold.keys()
        assert np.isfinite(row["state_error"])
    for solver in {"projected rk4", "conservative", "standard projected"} & set(metrics["solvers"]):
        assert np.max([*metrics["solvers"][solver]["drift"].values()]) < 1e-14


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("reproduce keppler", ("kepler", "rigid-body", "pollu")),
        *(
            (f"reproduce kepler --t1={value}", ("--t1", "positive"))
            for value in ("0", "nan", "inf")
        ),
        *((f"reproduce kepler --dt={x}", ("--dt", "positive")) for x in ("-1", "nan")),
        ("reproduce kepler --t1 ten", ("--t1", "'ten'")),
        ("reproduce kepler --t1 1 --dt 2", ("at most t1",)),
        ("reproduce kepler --dt 1e-9", ("larger dt",)),
        ("reproduce kepler --train", ("no learned solvers for kepler",)),
        ("reproduce rigid-body --epochs 3", ("--train",)),
        ("reproduce rigid-body --train --epochs=0", ("--epochs", "positive")),
        ("reproduce rigid-body --train --epochs=many", ("--epochs", "'many'")),
        ("reproduce kepler --out file/out", ("--out",)),
        ("compare kepler --tol 1e-6 --dt 0.1", ("--tol", "--dt", "one of them")),
        ("compare kepler --starts 0", ("--starts", "positive")),
        ("compare kepler --t1=-2", ("--t1", "positive")),
        ("compare robertson --dt 0.1", ("stiff", "--tol")),
    ],
)
def test_what_is_refused(arguments, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit) as exit:
        main(arguments.split())
    assert exit.value.code == 2
    message = capsys.readouterr().err
    assert [word for word in words if word not in message] == []
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.draws
@pytest.mark.parametrize("parts", [1, 2])
def test_a_curve_is_drawn_with_equal_scales_and_all_of_it(parts, caplog, tmp_path):
    """A single part has common limits, those of several parts are their own."""
    from diffrax_conserve.reproduce import _plot

    angles = np.linspace(0, 6, 50)
    curve = np.stack([3 * np.cos(angles), np.sin(angles)], axis=1)
    curves = {str(i): (1 + i) * curve for i in range(parts)}
    paths = {"rk4": curves, "standard": curves}
    figure = _plot._trajectory(paths, None, ("q₁", "q₂"))
    _plot.save(figure, tmp_path / "trajectory.png")
    for ax, limit in zip(figure.axes, (3, 3 if parts == 1 else 6), strict=True):
        across, up = np.diff(ax.transData.transform([(0, 0), (1, 1)]), axis=0)[0]
        np.testing.assert_allclose(across, up)
        (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
        assert left < -limit < limit < right
        assert bottom < -limit / 3 < limit / 3 < top
    assert [x.getMessage() for x in caplog.records if x.name.startswith("matplotlib")] == []


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
    assert "pip install '.[plots]'" in printed
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["metrics.json"]


def test_a_projection_that_fails_costs_the_other_solver_nothing(tmp_path, capsys):
    """The first of steps this long, of three revolutions, ends where no projection gets back."""
    # As many steps as those of the others, for which nothing is compiled anew.
    status, metrics = reproduce(tmp_path, "kepler", "--t1", "300", "--dt", "20")
    rows = metrics["solvers"]
    failed = [name for name, row in rows.items() if "failure" in row]
    assert status == 1
    assert failed == ["projected rk4"]
    assert rows["projected rk4"]["state_error"] is None
    assert np.isfinite(rows["rk4"]["state_error"])
    assert "projected rk4 FAILED after t = " in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.draws
def test_training_anew(tmp_path):
    arguments = ("rigid-body", "--train", "--epochs", "3", "--seed", "1", "--t1", "0.1")
    status, metrics = reproduce(tmp_path, *arguments)
    assert status == 0
    assert {"loss.png", "schedule.png"} <= {file.name for file in (tmp_path / "out").iterdir()}
    for kind in ("standard", "conservative"):
        file = tmp_path / "out" / f"{kind}.network"
        assert read_info(file)["info"]["seed"] == 1
        assert (dfc.load(file).layer is None) == (kind == "standard")
    # Three epochs teach nothing, and the manifold holds all the same.
    assert metrics["solvers"]["conservative"]["state_error"] > 1e-3
    assert np.max([*metrics["solvers"]["conservative"]["drift"].values()]) < 1e-14
