"""What the figures of the pages share: names at the curves instead of a legend."""

import numpy as np

GAP = 11.0  # points between two names, at least


def label(ax, places=None):
    """Writes the name of each curve at its last point, in its colour, names apart from each other.

    `places` has names that stand elsewhere: the index of their point, and "left" or "right" of it.
    """
    places = places or {}
    lines = [line for line in ax.lines if not line.get_label().startswith("_")]
    given = [places.get(line.get_label(), (-1, "right")) for line in lines]
    points = [_point(ax, line, index) for line, (index, _) in zip(lines, given, strict=True)]
    heights = [point[1] for point in points]
    for side in ("left", "right"):
        here = [i for i, (_, beside) in enumerate(given) if beside == side]
        moved = _apart([heights[i] for i in here], GAP * ax.figure.dpi / 72)
        for i, height in zip(here, moved, strict=True):
            heights[i] = height
    for line, (x, y), height, (_, side) in zip(lines, points, heights, given, strict=True):
        ax.annotate(
            line.get_label(),
            ax.transData.inverted().transform((x, y)),
            xytext=(5 if side == "right" else -5, (height - y) * 72 / ax.figure.dpi),
            textcoords="offset points",
            ha="left" if side == "right" else "right",
            va="center",
            color=line.get_color(),
            annotation_clip=False,
        )


def _point(ax, line, index):
    points = ax.transData.transform(np.stack(line.get_data(), axis=1).astype(float))
    return points[np.all(np.isfinite(points), axis=1)][index]


def _apart(heights, gap):
    """The heights, moved as little as needed to be `gap` apart."""
    order = np.argsort(heights)
    groups = []
    for i in order:
        groups.append(([i], heights[i]))
        while len(groups) > 1:
            (below, low), (above, high) = groups[-2:]
            room = gap * (len(below) + len(above)) / 2
            if high - low >= room:
                break
            middle = (low * len(below) + high * len(above)) / (len(below) + len(above))
            groups[-2:] = [([*below, *above], middle)]
    moved = np.zeros(len(heights))
    for members, middle in groups:
        moved[members] = middle + gap * (np.arange(len(members)) - (len(members) - 1) / 2)
    return moved
