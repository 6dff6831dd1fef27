"""The figures of `reproduce`, for print. Only this module imports matplotlib."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, NullFormatter

# From the palette of M. Okabe and K. Ito, which is distinguishable with colour blindness.
_COLOURS = {
    "rk4": "#D55E00",
    "projected rk4": "#0072B2",
    "standard": "#CC79A7",
    "conservative": "#009E73",
    "standard projected": "#E69F00",
}
_OTHER_COLOURS = ("#56B4E9", "#999999", "#F0E442")
_NAMES = {"rk4": "RK4", "projected rk4": "projected RK4"}

_ROUNDOFF: dict[str, Any] = dict(color="black", linewidth=0.8, linestyle=":", zorder=3)

_EPS = float(np.finfo(np.float64).eps)
# The position of an exact 0 on a logarithmic axis.
_FLOOR = _EPS / 10
# The number of last steps of each solver that are marked: more markers would overlap.
_MARKED_MAX = 100

_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.labelsize": 9,
    "axes.titlesize": 9,
    "legend.fontsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "axes3d.grid": True,
    "lines.linewidth": 1.0,
    "lines.markeredgewidth": 0.8,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "legend.columnspacing": 1.4,
    "pdf.fonttype": 42,  # embeds fonts, so that text remains text
    "savefig.dpi": 300,
}

# In the order of the solvers: shapes that are distinguishable where they overlap.
_MARKERS = (("o", 5.0), (".", 3.0), ("s", 5.0), ("x", 4.0), ("^", 4.0))

_Curves = dict[str, np.ndarray]  # by solver, or by part of the system


@mpl.rc_context(_STYLE)
def save(figure: Figure, path: Path) -> None:
    """Writes `figure` in the format given by the suffix of `path`."""
    # Without the date, equal figures give equal files.
    metadata = {"CreationDate": None} if path.suffix == ".pdf" else {}
    figure.savefig(path, metadata=metadata)


@mpl.rc_context(_STYLE)
def drift(times: _Curves, drifts: dict[str, _Curves], time_unit: str) -> Figure:
    """One panel for each integral, one curve for each solver."""
    figure = Figure(figsize=(max(3.5, 2.2 * len(drifts) + 0.4), 2.7), layout="constrained")
    panels = figure.subplots(1, len(drifts), squeeze=False, sharey=True)[0]
    for ax, (integral, curves) in zip(panels, drifts.items(), strict=True):
        ax.axhline(_EPS, **_ROUNDOFF)
        curves = {name: np.maximum(values, _FLOOR) for name, values in curves.items()}
        _over_time(ax, times, curves, time_unit)
        ax.set_title(integral)
    panels[0].set_ylabel("relative drift")
    _legend(figure, *panels[0].get_legend_handles_labels())
    note = "roundoff $\\epsilon$; an exact 0 is drawn at $\\epsilon/10$"
    figure.legend([Line2D([], [], **_ROUNDOFF)], [note], loc="outside lower center")
    return figure


@mpl.rc_context(_STYLE)
def state_error(times: _Curves, errors: _Curves, time_unit: str, unit: str) -> Figure:
    """One curve for each solver."""
    figure = Figure(figsize=(3.5, 2.7), layout="constrained")
    ax = figure.subplots()
    # An error of exactly 0 is drawn at the smallest positive one.
    smallest = min(np.min(values, where=values > 0, initial=np.inf) for values in errors.values())
    floor = smallest if np.isfinite(smallest) else _FLOOR
    curves = {name: np.maximum(values, floor) for name, values in errors.items()}
    _over_time(ax, times, curves, time_unit)
    ax.set_ylabel(_label("state error", unit))
    _legend(figure, *ax.get_legend_handles_labels())
    return figure


@mpl.rc_context(_STYLE)
def loss(curves: dict[str, tuple[np.ndarray, np.ndarray]]) -> Figure:
    """The training loss against the epoch, one curve for each network."""
    figure = Figure(figsize=(3.5, 2.7), layout="constrained")
    ax = figure.subplots()
    for name, (epochs, losses) in curves.items():
        ax.plot(epochs, losses, label=_NAMES.get(name, name), color=_colour(name, curves))
    ax.set_yscale("log")
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.set_xlabel("epoch")
    ax.set_ylabel("training loss")
    _legend(figure, *ax.get_legend_handles_labels())
    return figure


def _in_space(paths: dict[str, _Curves], axis_labels: tuple[str, ...]) -> bool:
    """Whether the trajectory is drawn in three dimensions: a single curve in space. Several are
    drawn by their first two coordinates."""
    return len(axis_labels) == 3 and len(next(iter(paths.values()))) == 1


def shows_lines(paths: dict[str, _Curves], axis_labels: tuple[str, ...]) -> bool:
    """Whether the lines of the solvers can be told apart: in space, and not too long."""
    return _in_space(paths, axis_labels) and not any(_is_long(c) for c in paths.values())


@mpl.rc_context(_STYLE)
def trajectory(
    paths: dict[str, _Curves],
    lines: dict[str, _Curves],
    reference: _Curves | None,
    axis_labels: tuple[str, ...],
) -> Figure:
    """One panel for each part of the system: the reference, and the last steps of each solver, with
    `lines` between them if there are any."""
    parts = list(next(iter(paths.values())))
    solid = _in_space(paths, axis_labels)
    labels = axis_labels if solid else axis_labels[:2]
    columns = min(len(parts), 3)
    rows = -(-len(parts) // columns)
    figure = Figure(figsize=(max(3.5, 2.3 * columns), 2.5 * rows + 0.5), layout="constrained")
    if solid:
        figure.set_size_inches(3.5, 3.5)
    keywords = dict(projection="3d") if solid else {}
    panels = figure.subplots(rows, columns, squeeze=False, subplot_kw=keywords)
    for ax, part in zip(panels.flat, parts, strict=False):
        path = None if reference is None else reference[part]
        _draw_paths(ax, {name: curves[part] for name, curves in paths.items()}, path, labels)
        for name, curves in lines.items():
            ax.plot(*curves[part].T, color=_colour(name, paths), linewidth=0.6)
        if len(parts) > 1:
            ax.set_title(part)
    for ax in panels.flat[len(parts) :]:
        ax.set_axis_off()
    _legend(figure, *panels[0, 0].get_legend_handles_labels())
    if any(_is_long(curves) for curves in paths.values()):
        note = f"The last {_MARKED_MAX} steps are marked."
        figure.legend([], [], title=note, title_fontsize=8, loc="outside lower center")
    return figure


# ---- Within one panel ----


def _over_time(ax: Any, times: _Curves, curves: _Curves, time_unit: str) -> None:
    for i, (name, values) in enumerate(curves.items()):
        # Thinner lines for many values, because curves at roundoff level jump and would hide
        # others.
        width = 1.2 if len(values) <= 200 else 0.7
        ax.plot(
            times[name],
            values,
            label=_NAMES.get(name, name),
            color=_colour(name, curves),
            linewidth=width,
            zorder=2 + 0.1 * i,
        )
    ax.set_yscale("log")
    lowest, highest = (np.log10(ax.get_ylim()[i]) for i in (0, 1))
    ax.set_ylim(10 ** np.floor(lowest), 10 ** np.ceil(highest))
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.xaxis.set_major_locator(MaxNLocator(5 if len(ax.figure.axes) == 1 else 4))
    ax.set_xlabel(_label("$t$", time_unit))


def _draw_paths(
    ax: Any, paths: _Curves, reference: np.ndarray | None, axis_labels: tuple[str, ...]
) -> None:
    dimension = len(axis_labels)
    if reference is not None:
        style = dict(color="#BDBDBD", linewidth=0.5 if _is_long(paths) else 1.5, zorder=1)
        ax.plot(*reference.T[:dimension], label="reference", **style)
    for i, (name, path) in enumerate(paths.items()):
        # Open markers of different sizes, so that one solver cannot hide another.
        last = path[-_MARKED_MAX - 1 :].T[:dimension]
        marker, size = _MARKERS[i % len(_MARKERS)]
        ax.plot(
            *last,
            linestyle="none",
            marker=marker,
            markersize=size,
            markerfacecolor="none",
            label=_NAMES.get(name, name),
            color=_colour(name, paths),
            zorder=2 + 0.1 * i,
        )
    for axis, text in zip("xyz", axis_labels, strict=False):
        getattr(ax, f"set_{axis}label")(text)
    if dimension == 3:
        _tidy_space(ax)
        return
    if _are_alike(axis_labels):
        _make_square(ax)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))


def _make_square(ax: Any) -> None:
    """Sets equal scales and ranges, which unlike with `adjustable="datalim"` are known to the
    layout."""
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    half = max(x1 - x0, y1 - y0) / 2
    ax.set_xlim((x0 + x1) / 2 - half, (x0 + x1) / 2 + half)
    ax.set_ylim((y0 + y1) / 2 - half, (y0 + y1) / 2 + half)
    ax.set_aspect("equal")


def _is_long(paths: _Curves) -> bool:
    return len(next(iter(paths.values()))) > _MARKED_MAX + 1


def _tidy_space(ax: Any) -> None:
    ax.set_box_aspect((1, 1, 0.8), zoom=0.82)  # leaves room for the labels
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.pane.set_facecolor("white")
        axis.set_major_locator(MaxNLocator(4))
    ax.tick_params(pad=0)


def _are_alike(axis_labels: tuple[str, ...]) -> bool:
    """Whether the coordinates are of the same kind, so that their scales should be equal."""
    first, second = (text.split()[0].rstrip("₁₂₃") for text in axis_labels)
    return first == second or (first, second) == ("x", "y")


def _label(quantity: str, unit: str) -> str:
    return f"{quantity} [{unit}]" if unit else quantity


def _legend(figure: Figure, handles: list[Any], labels: list[str]) -> None:
    columns = 2 if len(labels) > 3 and figure.get_figwidth() < 4 else 3
    figure.legend(handles, labels, loc="outside upper center", ncols=columns)


def _colour(name: str, names: dict[str, Any]) -> str:
    others = [n for n in names if n not in _COLOURS]
    return _COLOURS.get(name) or _OTHER_COLOURS[others.index(name) % len(_OTHER_COLOURS)]
