"""The figures of the page on performance, from the results of work_precision.py and scaling.py."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

# M. Okabe and K. Ito's palette, told apart also by those who see fewer colours.
ORANGE, SKY, GREEN, BLUE = "#E69F00", "#56B4E9", "#009E73", "#0072B2"
RED, PURPLE, GREY, BLACK = "#D55E00", "#CC79A7", "#999999", "#000000"
# One colour for one program, in every panel; the line tells how it was used.
STYLES = {
    "plain Tsit5": (RED, "--", "o"),
    "projected Tsit5": (RED, "-", "o"),
    "projected Tsit5, fixed steps": (RED, ":", "o"),
    "projected Tsit5, unrolled": (ORANGE, "-", "o"),
    "plain Dopri8": (BLUE, "--", "s"),
    "projected Dopri8": (BLUE, "-", "s"),
    "projected Dopri8, fixed steps": (BLUE, ":", "s"),
    "projected Dopri8, unrolled": (SKY, "-", "s"),
    "plain RK4": (PURPLE, "--", "^"),
    "projected RK4": (PURPLE, "-", "^"),
    "projected RK4, fixed steps": (PURPLE, ":", "^"),
    "CVODE, Adams": (GREY, "--", "v"),
    "CVODE, BDF with projection": (GREY, "-", "v"),
    "scipy DOP853": (BLACK, "--", "D"),
    "homproj DOP853": (BLACK, "-", "D"),
    "heyoka": (GREEN, "-", "*"),
    "heyoka, 8 at a time": (GREEN, "-", "*"),
    "heyoka, 16 at a time": (GREEN, ":", "*"),
}
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
}
MAX_DRIFT = 1e-14


def save(figure: Figure, path: Path) -> None:
    """Writes `path` with the suffixes `.png` and `.svg`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(LOOK):
        figure.savefig(path.with_suffix(".png"))
        figure.savefig(path.with_suffix(".svg"), metadata={"Date": None})


def work_precision(results: dict[str, Any]) -> Figure:
    """Error against time; a filled marker where the drift is below 1e-14."""
    titles = {
        "rigid-body": "rigid body, one trajectory",
        "kepler": "Kepler orbit, one trajectory",
        "batch": "rigid bodies, batch of 1,000",
    }
    with mpl.rc_context(LOOK):
        # As wide as a page, so that the text keeps its size there.
        figure = Figure(figsize=(6.4, 6.4), layout="constrained")
        *axes, key = figure.subplots(2, 2).flat
        legend = {}
        for ax, (part, title) in zip(axes, titles.items(), strict=True):
            for name, rows in results["parts"][part]["curves"].items():
                legend.setdefault(name, _curve(ax, name, rows))
            ax.set(xscale="log", yscale="log", title=title, xlabel="ms per trajectory")
            if ax.get_xlim()[1] < 100 * ax.get_xlim()[0]:
                ax.xaxis.set_minor_formatter("")  # of powers of ten, which would overlap
            ax.set_ylabel("error at t = 100")
        key.set_axis_off()
        key.legend(legend.values(), legend.keys(), loc="center")
        return figure


def _curve(ax: Any, name: str, rows: list[dict[str, float]]) -> Any:
    colour, line, marker = STYLES[name]
    x, y = [1e3 * row["seconds"] for row in rows], [row["error"] for row in rows]
    for row, *point in zip(rows, x, y, strict=True):
        fill = colour if row["drift"] <= MAX_DRIFT else "white"
        ax.plot(*point, marker=marker, color=colour, markerfacecolor=fill)
    (handle,) = ax.plot(x, y, line, color=colour, zorder=1)
    return handle


def scaling(results: dict[str, Any]) -> Figure:
    """The batch, the constraints and the bodies, a panel each."""
    parts = results["parts"]
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(6.4, 6.4), layout="constrained")
        *axes, empty = figure.subplots(2, 2).flat
        empty.set_axis_off()
        for name in ("plain RK4", "projected RK4", "plain Tsit5", "projected Tsit5"):
            points = [(row["batch"], row["rows"][name]["ns"]) for row in parts["batch"]]
            colour, line, marker = STYLES[name]
            axes[0].plot(*zip(*points, strict=True), line, color=colour, marker=marker, label=name)
        axes[0].set(xlabel="trajectories", ylabel="ns per step and trajectory")
        for kind, line in (("plain", "--"), ("projected", "-")):
            points = [(r["constraints"], r[f"{kind} s/step"]) for r in parts["constraints"]]
            axes[1].plot(
                *zip(*points, strict=True), line, color=PURPLE, marker="^", label=f"{kind} RK4"
            )
        axes[1].set(xlabel="constraints of a chain", ylabel="s per step")
        styles = {
            "force": ("one evaluation of the forces", BLACK),
            "projection": ("projection, ten integrals", RED),
            "without energy": ("projection without the energy", ORANGE),
        }
        for name, (label, colour) in styles.items():
            points = [(row["bodies"], row[name]) for row in parts["bodies"]]
            axes[2].plot(*zip(*points, strict=True), color=colour, marker="o", label=label)
        axes[2].set(xlabel="gravitating bodies", ylabel="s")
        for ax in axes:
            ax.set(xscale="log", yscale="log")
            ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2 if ax is axes[0] else 1)
        return figure
