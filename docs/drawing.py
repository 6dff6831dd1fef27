"""What the figures of the pages share: names at the curves instead of a legend."""

import numpy as np

GAP = 11.0  # points between two names, at least


def label(ax, room=0.0):
    """Writes the name of each curve at its last point, in its colour, names apart from each other.

    `room` is what a name may take beside the curves, as a fraction of the axis.
    """
    lines = [line for line in ax.lines if not line.get_label().startswith("_")]
    if room:
        left, right = ax.transAxes.transform([(0, 0), (1 + room, 0)])[:, 0]
        start, end = ax.transData.inverted().transform([(left, 0), (right, 0)])[:, 0]
        ax.set_xlim(start, end)
    ends = [_last(ax, line) for line in lines]
    heights = _apart([end[1] for end in ends], GAP * ax.figure.dpi / 72)
    for line, (x, y), height in zip(lines, ends, heights, strict=True):
        ax.annotate(
            line.get_label(),
            ax.transData.inverted().transform((x, y)),
            xytext=(5, (height - y) * 72 / ax.figure.dpi),
            textcoords="offset points",
            va="center",
            color=line.get_color(),
            annotation_clip=False,
        )


def _last(ax, line):
    points = ax.transData.transform(np.stack(line.get_data(), axis=1).astype(float))
    return points[np.all(np.isfinite(points), axis=1)][-1]


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
