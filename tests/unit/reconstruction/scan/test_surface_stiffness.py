"""Energies of displacements against closed forms."""

import numpy as np
import pytest
from fixtures.flat_sheets import sheet

from reconstruction.scan.face_template import load_default_template
from reconstruction.scan.surface_stiffness import surface_stiffness


def test_affine_maps_do_not_bend(rng):
    template = load_default_template().mesh
    bending = surface_stiffness(template).bending
    affine = template.vertices_mm @ rng.standard_normal((3, 3)) + rng.standard_normal(3)
    rough = affine + rng.standard_normal(affine.shape)
    # a ring thinner than 5 % of its radius does not determine the map across it
    assert np.sum((bending @ affine) ** 2) < 1e-2 * np.sum((bending @ rough) ** 2)


@pytest.mark.parametrize("cells", [12, 24])
def test_bending_of_parabola_is_that_of_plate(cells):
    flat = sheet(cells=cells)
    x = flat.vertices_mm[:, 0]
    curvature = 0.02
    energy = np.sum((surface_stiffness(flat).bending @ (0.5 * curvature * x**2)) ** 2)
    # six neighbors at distance h and angles t: sum of (c h^2 cos^2 t / 2)^2 = 9/16 c^2 h^4
    assert energy == pytest.approx(0.375 * curvature**2 * 60.0**2, rel=0.1)


def test_stretch_counts_differences_along_edges():
    flat = sheet(side_mm=3.0, cells=1)
    stretch = surface_stiffness(flat).stretch
    assert sorted(np.abs(stretch @ flat.vertices_mm[:, 0])) == [0.0, 0.0, 3.0, 3.0, 3.0]
