"""What the figures of the pages share: names at the curves instead of a legend."""

import numpy as np
from scipy.optimize import isotonic_regression

GAP = 11.0  # points between two names, at least


def label(ax, places=None):
    """Writes the name of each curve at its last point, in its colour, names apart from each other.

    `places` has names that stand elsewhere: the index of their point, and "left" or "right" of it.
    """
    ax.figure.draw_without_rendering()  # which scales and places the axes
    names = []
    for line in ax.lines:
        index, side = (places or {}).get(line.get_label(), (-1, "right"))
        seen = np.all(np.isfinite(_in_points(ax, line.get_xydata())), axis=1)
        if not line.get_label().startswith("_"):
            names.append((side, line, line.get_xydata()[seen][index]))
    for side in {side for side, *_ in names}:
        here = [(line, point) for beside, line, point in names if beside == side]
        heights = np.array([_in_points(ax, point)[1] for _, point in here])
        for (line, point), up in zip(here, _apart(heights) - heights, strict=True):
            ax.annotate(
                line.get_label(),
                point,
                xytext=(5 if side == "right" else -5, up),
                textcoords="offset points",
                ha="left" if side == "right" else "right",
                va="center",
                color=line.get_color(),
                annotation_clip=False,
            )


def _in_points(ax, data):
    return ax.transData.transform(np.asarray(data, dtype=float)) * 72 / ax.figure.dpi


def _apart(heights):
    """The heights, moved as little as needed to be `GAP` apart."""
    order = np.argsort(heights, kind="stable")
    ranks = GAP * np.arange(len(heights))
    moved = np.empty_like(heights)
    moved[order] = isotonic_regression(heights[order] - ranks).x + ranks
    return moved
