"""Label the points of a plot without overlap."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from skinrig.arrays import Float64Array, FloatArray

_ACROSS, _UP = {1: "left", 0: "center", -1: "right"}, {1: "bottom", -1: "top"}
_LABEL_OFFSETS = tuple(
    (5 * x, y * far, _ACROSS[x], _UP[y])
    for far in (5, 12, 20)
    for x, y in ((1, 1), (-1, 1), (1, -1), (-1, -1), (0, 1), (0, -1))
)
"""Candidate offsets of a label from its point, points, with the label's aligned corner."""
LABEL_PT = 8
"""Size of a label's text, points."""


def name_points(
    figure: Any,
    axes: Any,
    labels: Sequence[tuple[str, float, float]],
    *,
    points: Sequence[tuple[float, float]],
    lines: Sequence[FloatArray] = (),
    legend: Any = None,
) -> None:
    """Write labels next to points, without overlap; labels without free space are omitted.

    Parameters
    ----------
    figure, axes
        Figure and axes with final limits and scales.
    labels
        Name, x and y of each labeled point, the most important first.
    points
        x and y of all points that labels must not cover.
    lines
        Lines, (N, 2) each, x and y; a label crosses them only without free space.
    legend
        Legend of the axes, which labels must not cover.

    Notes
    -----
    Of equal names, the first one is written if the others have no free space. A label that is
    wider than the axes is omitted; tables and alt texts list all of them.
    """
    from matplotlib.transforms import Bbox

    figure.draw_without_rendering()  # computes the constrained layout of the axes
    inside = axes.get_window_extent()
    dot = figure.dpi / 72.0
    taken = [
        Bbox.from_bounds(x - 3 * dot, y - 3 * dot, 6 * dot, 6 * dot)
        for x, y in axes.transData.transform(np.asarray(points, float).reshape(-1, 2))
    ]
    if legend is not None:
        taken.append(legend.get_window_extent())
    crossed = np.concatenate(
        [_along(axes.transData.transform(line)) for line in lines] or [np.zeros((0, 2))]
    )
    for label, x, y in labels:
        if not label:
            continue
        words = axes.annotate(
            label, (x, y), xytext=(0, 0), textcoords="offset points", fontsize=LABEL_PT
        )
        words.set_in_layout(False)  # a long label must not shrink the axes
        found = None
        for place in _LABEL_OFFSETS:
            box = _place_label(words, place)
            within = inside.containsx(box.x0) and inside.containsx(box.x1)
            within = within and inside.containsy(box.y0) and inside.containsy(box.y1)
            if not within or any(box.overlaps(other) for other in taken):
                continue
            over = np.all((crossed > box.min) & (crossed < box.max), axis=1).any()
            if found is None or not over:
                found = place
            if not over:
                break
        if found is None:
            words.remove()
        else:
            taken.append(_place_label(words, found))


def _place_label(words: Any, offset: tuple[int, int, str, str]) -> Any:
    """Move a label to an offset of `_LABEL_OFFSETS` and return its bounding box, pixels."""
    dx, dy, across, up = offset
    words.set_position((dx, dy))
    words.set_ha(across)
    words.set_va(up)
    return words.get_window_extent()


def _along(line: FloatArray) -> Float64Array:
    """Return points along a line of (N, 2) pixels, denser than the height of a label."""
    parts = np.linspace(0.0, 1.0, 200)[:, None]
    pairs = itertools.pairwise(line)
    return np.concatenate([start + parts * (end - start) for start, end in pairs])
