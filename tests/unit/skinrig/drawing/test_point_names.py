"""Names of points lie inside their plot and on nothing else."""

import itertools

import numpy as np
import pytest

from skinrig.drawing import figures, point_names


def boxes(axes):
    return [words.get_window_extent() for words in axes.texts]


@pytest.mark.parametrize("count", [3, 12])
def test_names_of_points_close_together_do_not_overlap(count):
    figure, axes = figures.create_canvas(5.2, 3.4)
    x = 1.0 + 0.01 * np.arange(count)
    axes.plot(x, x, "o", label="all of them")
    axes.set_xlim(0.5, 1.5)
    axes.set_ylim(0.5, 1.5)
    points = list(zip(x.tolist(), x.tolist(), strict=True))
    labels = [(f"method {k}, size 64", value, value) for k, value in enumerate(x.tolist())]
    point_names.name_points(figure, axes, labels, points=points, legend=axes.legend())
    found = boxes(axes)
    assert 3 <= len(found) <= count
    assert not any(a.overlaps(b) for a, b in itertools.combinations(found, 2))
    inside = axes.get_window_extent()
    for box in found:
        assert inside.x0 <= box.x0
        assert box.x1 <= inside.x1
        assert not box.overlaps(axes.get_legend().get_window_extent())
        for dot in axes.transData.transform(points):
            assert not box.contains(*dot)


def test_name_avoids_lines_and_is_omitted_if_wide():
    figure, axes = figures.create_canvas(5.2, 3.4)
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(0.0, 1.0)
    line = np.array([[0.5, 0.5], [1.0, 0.6]])  # runs where a name stands first, up to the right
    labels = [("a name of some length", 0.5, 0.5), ("w" * 300, 0.2, 0.2)]
    point_names.name_points(figure, axes, labels, points=[(0.5, 0.5), (0.2, 0.2)], lines=[line])
    (box,) = boxes(axes)
    for part in np.linspace(0.0, 1.0, 500):
        assert not box.contains(*axes.transData.transform(line[0] + part * (line[1] - line[0])))
