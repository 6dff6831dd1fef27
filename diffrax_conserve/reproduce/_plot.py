"""The figures of `reproduce`, for print. Only this module imports matplotlib."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from .._diagnostics.comparison import ComparisonReport
from ..learned._replace_file import replace_file
from ..systems import AbstractSystem
from ._solve import COMPARED_MAX, Run
from ._trained import Learned

# From the palette of M. Okabe and K. Ito, which is distinguishable with colour blindness; and
# markers that are distinguishable where they overlap.
_LOOKS = {
    "rk4": ("RK4", "#D55E00", "o", 5.0),
    "projected rk4": ("projected RK4", "#0072B2", ".", 3.0),
    "kvaerno5": ("Kvaerno5", "#D55E00", "o", 5.0),
    "projected kvaerno5": ("projected Kvaerno5", "#0072B2", ".", 3.0),
    "standard": ("standard network", "#CC79A7", "s", 5.0),
    "conservative": ("conservative network", "#009E73", "x", 4.0),
    "standard projected": ("standard, projected", "#E69F00", "^", 4.0),
}
_LEARNED = ("standard", "conservative", "standard projected")
_NETWORKS = (
    "The conservative network was trained\nthrough the projection, the standard one without."
)
_ROUNDOFF: dict[str, Any] = dict(color="black", linewidth=0.8, linestyle=":", zorder=3)

_EPS = float(np.finfo(np.float64).eps)
# The position of an exact 0 on the logarithmic axis of drifts.
_FLOOR = _EPS / 10
# The number of last steps of each solver that are marked: more markers would overlap.
_MARKED_MAX = 100

_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "legend.fontsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E6E6E6",
    "lines.linewidth": 1.0,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "pdf.fonttype": 42,  # embeds fonts, so that text remains text
    "savefig.dpi": 300,
}

_Pairs = dict[str, tuple[np.ndarray, np.ndarray]]  # by solver, abscissae and ordinates


@mpl.rc_context(_STYLE)
def draw(
    out: Path,
    system: AbstractSystem,
    runs: dict[str, Run],
    errors: dict[str, np.ndarray],
    networks: dict[str, Learned],
    schedule: _Pairs,
) -> None:
    """Writes the figures for what there is, as `.png` and as `.pdf`."""
    figures = {}
    if networks:
        losses = {kind: (epochs, found) for kind, (_, epochs, found) in networks.items()}
        figures["loss"] = _one_panel(losses, "epoch", "training loss")
    if schedule:
        figures["schedule"] = _schedule(schedule)
    succeeded = {name: run for name, run in runs.items() if run.failure is None}
    if succeeded:
        ts = next(iter(succeeded.values())).ts
        first = {k: jtu.tree_map(lambda y: jnp.asarray(y[0]), v.ys) for k, v in succeeded.items()}
        paths = {name: system.trajectories(ys) for name, ys in first.items()}
        exact = None
        if errors:
            times = np.linspace(ts[0], ts[-1], COMPARED_MAX + 1)
            exact = system.trajectories(system.reference(times))
            # The initial state has neither error nor drift.
            medians = {k: (ts[1:], np.median(v, axis=0)[1:]) for k, v in errors.items()}
            figures["state_error"] = _one_panel(medians, "t", "state error")
        figures["trajectory"] = _trajectory(paths, exact, system.axes)
        figures["drift"] = _drift(ts, list(system.manifold), succeeded)
    for name, figure in figures.items():
        for suffix in ("png", "pdf"):
            replace_file(out / f"{name}.{suffix}", lambda path, f=figure: save(f, path))


@mpl.rc_context(_STYLE)
def verdict(report: ComparisonReport) -> Figure:
    """The errors of a comparison against time."""
    figure = Figure(figsize=(5.5, 3.5), layout="constrained")
    report.plot(figure.subplots())
    return figure


def save(figure: Figure, path: Path) -> None:
    """Writes `figure` in the format given by the suffix of `path`."""
    # Without the date, equal figures give equal files.
    figure.savefig(path, metadata={"CreationDate": None} if path.suffix == ".pdf" else {})


def _drift(ts: np.ndarray, integrals: list[str], runs: dict[str, Run]) -> Figure:
    """One panel for each integral, one curve for each solver."""
    figure = Figure(figsize=(max(3.5, 2.2 * len(integrals) + 0.4), 2.7), layout="constrained")
    panels = figure.subplots(1, len(integrals), squeeze=False, sharey=True)[0]
    for ax, integral in zip(panels, integrals, strict=True):
        ax.axhline(_EPS, **_ROUNDOFF)
        drifts = {k: np.maximum(v.drift[integral], _FLOOR) for k, v in runs.items()}
        _lines(ax, {k: (ts[1:], drift[1:]) for k, drift in drifts.items()})
        ax.set(title=integral, xlabel="t")
    panels[0].set_ylabel("relative drift")
    _legend(figure, panels[0])
    note = "roundoff ε; an exact 0 is drawn at ε/10"
    figure.legend([Line2D([], [], **_ROUNDOFF)], [note], loc="outside lower center")
    return figure


def _one_panel(curves: _Pairs, x: str, y: str) -> Figure:
    figure = Figure(figsize=(3.5, 2.7), layout="constrained")
    ax = figure.subplots()
    _lines(ax, curves)
    ax.set(xlabel=x, ylabel=y)
    _legend(figure, ax)
    return figure


def _schedule(curves: _Pairs) -> Figure:
    """One panel for the iterations of the layer, one for the weight of the last one."""
    figure = Figure(figsize=(3.5, 2.7), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    for ax, (name, pair) in zip(panels, curves.items(), strict=True):
        ax.plot(*pair, color=_LOOKS["conservative"][1])
        ax.set(ylabel=name)
        ax.set_ylim(bottom=0)
    panels[-1].set_xlabel("epoch e")
    return figure


def _trajectory(
    paths: dict[str, Any], reference: dict[str, Any] | None, axis_labels: tuple[str, ...]
) -> Figure:
    """One panel for each part of the system: the reference, and the last steps of each solver.

    Of a single part numerical solvers and networks have a panel each, so that none hides another. A
    single curve in space is drawn in three dimensions, several by their first two coordinates.
    """
    parts = list(next(iter(paths.values())))
    learned = {name: path for name, path in paths.items() if name in _LEARNED}
    others = {name: path for name, path in paths.items() if name not in _LEARNED}
    shown = [(part, part, paths) for part in parts]
    if len(parts) == 1 and learned and others:
        shown = [("numerical", parts[0], others), ("learned", parts[0], learned)]
    dimension = len(axis_labels) if len(parts) == 1 else 2
    columns = min(len(shown), 3)
    rows = -(-len(shown) // columns)
    size = (max(3.5, 2.3 * columns), 2.5 * rows + 0.5)
    if dimension == 3:
        size = (3.2 * columns, 3.5)
    figure = Figure(figsize=size, layout="constrained")
    keywords = dict(projection="3d") if dimension == 3 else {}
    panels = figure.subplots(rows, columns, squeeze=False, subplot_kw=keywords)
    for ax, (title, part, group) in zip(panels.flat, shown, strict=False):
        if reference is not None:
            path = reference[part].T[:dimension]
            ax.plot(*path, label="reference", color="#BDBDBD", linewidth=0.8, zorder=1)
        for i, (name, curves) in enumerate(group.items()):
            label, colour, marker, width = _LOOKS[name]
            # Open markers of different sizes, so that one solver cannot hide another.
            look = dict(marker=marker, markersize=width, markerfacecolor="none", linestyle="none")
            last = curves[part][-_MARKED_MAX - 1 :].T[:dimension]
            ax.plot(*last, label=label, color=colour, zorder=2 + 0.1 * i, **look)
        ax.set(**dict(zip(("xlabel", "ylabel", "zlabel"), axis_labels[:dimension], strict=False)))
        if dimension == 3:
            ax.set_box_aspect((1, 1, 0.8), zoom=0.82)  # leaves room for the labels
        elif axis_labels[0][0] + axis_labels[1][0] in ("xy", "qq", "qp"):
            # Panels of a single part have the same limits, see below, so their boxes are adjusted.
            ax.set_aspect("equal", adjustable="box" if len(parts) == 1 else "datalim")
        ax.locator_params(nbins=4)
        if len(shown) > 1:
            ax.set_title(title)
    for ax in panels.flat[len(shown) :]:
        ax.set_axis_off()
    if len(parts) == 1:
        for axis in "xyz"[:dimension]:
            limits = np.array([getattr(ax, f"get_{axis}lim")() for ax in panels.flat])
            for ax in panels.flat:
                ax.set(**{f"{axis}lim": (limits.min(), limits.max())})
    _legend(figure, *panels.flat)
    long = any(len(curves[parts[0]]) > _MARKED_MAX + 1 for curves in paths.values())
    notes = [_NETWORKS] * bool(learned) + [f"The last {_MARKED_MAX} steps are marked."] * long
    if notes:
        figure.legend([], [], title="\n".join(notes), title_fontsize=8, loc="outside lower center")
    return figure


def _lines(ax: Any, curves: _Pairs) -> None:
    for i, (name, pair) in enumerate(curves.items()):
        label, colour, *_ = _LOOKS[name]
        ax.semilogy(*pair, label=label, color=colour, zorder=2 + 0.1 * i)
    ax.xaxis.set_major_locator(MaxNLocator(4))


def _legend(figure: Figure, *panels: Any) -> None:
    named = {}
    for ax in panels:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    columns = 2 if len(named) > 3 and figure.get_figwidth() < 4 else 3
    figure.legend(named.values(), named, loc="outside upper center", ncols=columns)
