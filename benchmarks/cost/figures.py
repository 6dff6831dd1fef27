"""The figures of the page on performance, from the results of work_precision.py and scaling.py.

A figure has six curves at most, each with its name beside it.
"""

import runpy
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

label = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "drawing.py"))["label"]

# M. Okabe and K. Ito's palette, told apart also by those who see fewer colours.
ORANGE, SKY, GREEN, BLUE = "#E69F00", "#56B4E9", "#009E73", "#0072B2"
RED, PURPLE, GREY, BLACK = "#D55E00", "#CC79A7", "#999999", "#000000"
# The programs in the figure; `benchmarks/README.md` has the times of all. Plain solves are dashed.
SHOWN = {
    "plain Tsit5": (RED, "--", "o"),
    "projected Tsit5": (RED, "-", "o"),
    "plain Dopri8": (BLUE, "--", "s"),
    "projected Dopri8": (BLUE, "-", "s"),
    "CVODE, Adams": (PURPLE, "--", "v"),
    "heyoka": (GREEN, "-", "D"),
}
STYLES = SHOWN | {"plain RK4": (PURPLE, "--", "^"), "projected RK4": (PURPLE, "-", "^")}
LOOK: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "legend.fontsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "lines.linewidth": 1.0,
    "lines.markersize": 4,
    "legend.frameon": False,
    "savefig.dpi": 200,
    "svg.hashsalt": "diffrax-conserve",
    # `docs/stylesheets/pages.css` turns the lightness over in the dark scheme.
    "savefig.transparent": True,
}
MAX_DRIFT = 1e-14


def save(figure: Figure, path: Path) -> None:
    """Writes `path` with the suffix `.svg`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(LOOK):
        figure.savefig(path.with_suffix(".svg"), metadata={"Date": None})


def work_precision(results: dict[str, Any]) -> Figure:
    """Error against time on a Kepler orbit; a filled marker where the drift is below 1e-14."""
    curves = results["parts"]["kepler"]["curves"]
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(6.4, 4.0), layout="constrained")
        ax = figure.subplots()
        for name in SHOWN:
            if name in curves:
                _curve(ax, name, curves[name])
        ax.set(xscale="log", yscale="log", xlabel="ms", ylabel="error at t = 100")
        label(ax, {"plain Dopri8": (0, "left"), "projected Dopri8": (-1, "left")})
        return figure


def _curve(ax: Any, name: str, rows: list[dict[str, float]]) -> None:
    colour, line, marker = STYLES[name]
    x, y = [1e3 * row["seconds"] for row in rows], [row["error"] for row in rows]
    for row, *point in zip(rows, x, y, strict=True):
        fill = colour if row["drift"] <= MAX_DRIFT else "white"
        ax.plot(*point, marker=marker, color=colour, markerfacecolor=fill, label="_")
    ax.plot(x, y, line, color=colour, zorder=1, label=name)


def scaling(results: dict[str, Any]) -> Figure:
    """The batch and the constraints, a panel each."""
    parts = results["parts"]
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(6.4, 3.2), layout="constrained")
        left, right = figure.subplots(1, 2)
        for name in ("plain RK4", "projected RK4", "plain Tsit5", "projected Tsit5"):
            points = [(row["batch"], row["rows"][name]["ns"]) for row in parts["batch"]]
            _line(left, name, points)
        left.set(xlabel="trajectories", ylabel="ns per step and trajectory")
        for name in ("plain RK4", "projected RK4"):
            key = f"{name.split()[0]} s/step"
            _line(right, name, [(row["constraints"], row[key]) for row in parts["constraints"]])
        right.set(xlabel="constraints of a chain", ylabel="s per step")
        for ax in (left, right):
            ax.set(xscale="log", yscale="log")
            label(ax)
        return figure


def _line(ax: Any, name: str, points: list[tuple[float, float]]) -> None:
    colour, line, marker = STYLES[name]
    ax.plot(*zip(*points, strict=True), line, color=colour, marker=marker, label=name)
