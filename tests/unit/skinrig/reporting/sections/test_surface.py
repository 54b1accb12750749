"""The surface seen from the front: the right side up, the nearest point in front."""

import numpy as np
import pytest

from model.skin import SkinAppearance, SkinMap
from skinrig.appearances.front_view import FrontView
from skinrig.reporting import page
from skinrig.reporting.sections.surface import section

BOX = np.array([0.0, 0.0, 0.0]), np.array([10.0, 20.0, 5.0])


def test_up_is_up_and_right_is_right():
    view = FrontView.of(np.array([[0.01, 19.99, 0.0], [9.99, 0.01, 0.0]]), BOX)
    image, valid = view.rasterize(np.array([1.0, 2.0]))
    assert image.shape == (440, 220)
    assert image[0, 0] == 1.0
    assert image[-1, -1] == 2.0
    assert valid[0, 0]
    assert not valid[200, 100]


def test_the_frontmost_of_two_points_is_shown():
    points = np.array([[5.0, 10.0, 1.0], [5.0, 10.0, 4.0], [5.0, 10.0, 2.0]])
    view = FrontView.of(points, BOX)
    image, _ = view.rasterize(np.array([1.0, 2.0, 3.0]))
    assert image[view.rows[0], view.columns[0]] == 2.0


def test_points_outside_bounds_are_not_wrapped():
    view = FrontView.of(np.array([[-1.0, 10.0, 0.0], [5.0, 10.0, 0.0]]), BOX)
    assert view.rows[0] == view.columns[0] == -1
    _, valid = view.rasterize(np.array([7.0, 1.0]))
    assert not valid[220, -1]


@pytest.fixture
def sphere():
    u, v = np.meshgrid(np.linspace(-1, 1, 60), np.linspace(-1, 1, 60))
    inside = u**2 + v**2 < 0.8
    normals = np.stack([u, v, np.sqrt(np.maximum(1 - u**2 - v**2, 0.0))], axis=-1)
    normals[~inside] = [0.0, 0.0, 1.0]
    return normals, inside


def test_surface_section_checks_normals_and_albedo_not_baseline(sphere):
    normals, inside = sphere
    albedo = np.full((60, 60, 3), 0.4)
    maps = {
        "position": SkinMap(50 * normals, "mm", valid=inside),
        "normals": SkinMap(normals, "1", np.full((60, 60, 3), 0.01), inside),
        "half_vector_normals": SkinMap(normals, "1", None, inside),
        "r_d": SkinMap(1.05 * albedo, "1", np.full((60, 60, 3), 0.01), inside),
    }
    truth = {
        "position": SkinMap(50 * normals, "mm", valid=inside),
        "normals": SkinMap(normals, "1", valid=inside),
        "r_d": SkinMap(albedo, "1", valid=inside),
    }
    checks: list[page.Check] = []
    both = (SkinAppearance(one, "simulated") for one in (maps, truth))
    body = page.render_fragment(section(page.ReportedAppearance("head", *both, checks)))
    assert [check.name for check in checks] == [
        "head: normals, mean error",
        "head: diffuse reflectance R_d, red, median error",
        "head: diffuse reflectance R_d, green, median error",
        "head: diffuse reflectance R_d, blue, median error",
    ]
    assert [check.passed for check in checks] == [True, False, False, False]
    assert "half-vector normals (half_vector_normals)" in body
    # 0.01 of 1.05 x 0.4, in the unit of the errors beside it
    assert "R_d, standard uncertainty: median 2.381 %" in body
    assert body.count("<img") > 8


def test_surface_section_without_truth_shows_stderr_without_checks(sphere):
    normals, inside = sphere
    maps = {
        "position": SkinMap(50 * normals, "mm", valid=inside),
        "normals": SkinMap(normals, "1", np.full((60, 60, 3), 0.01), inside),
    }
    checks: list[page.Check] = []
    body = page.render_fragment(
        section(page.ReportedAppearance("head", SkinAppearance(maps, "simulated"), None, checks))
    )
    assert checks == []
    assert "standard uncertainty" in body
    assert "truth" not in body
