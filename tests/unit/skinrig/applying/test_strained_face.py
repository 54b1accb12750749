"""A square of a head in an expression: size, surface and strain against first principles."""

import numpy as np
import pytest

from model.microstructure import FOREHEAD
from rigsim.subject.head import build_head
from skinrig.applying.strained_face import FACE_VIEWS, FaceView, crop_face, surface_normals
from skinrig.errors import UnusableError

CHEEK = FACE_VIEWS["figure-15"]


@pytest.fixture(scope="module")
def cheek():
    return crop_face(CHEEK, side_mm=8.0, texels=160)


def test_texels_have_asked_size_on_skin(cheek):
    assert np.median(cheek.pixel_um) == pytest.approx(50.0, rel=0.03)
    step = np.linalg.norm(np.diff(cheek.rest_mm, axis=1), axis=-1)
    assert step.mean() * 1e3 == pytest.approx(50.0, rel=0.03)


def test_surface_passes_through_vertices_of_head(cheek):
    vertices = build_head(np.random.default_rng(0)).vertices_mm
    middle = cheek.rest_mm[80, 80]
    near = vertices[np.linalg.norm(vertices - middle, axis=1) < 2.5]
    flat = cheek.rest_mm.reshape(-1, 3)
    away = [np.linalg.norm(flat - one, axis=1).min() for one in near]
    assert len(near) >= 4
    assert max(away) < 0.036  # half a texel's diagonal
    assert surface_normals(cheek.rest_mm)[80, 80] @ (middle - [0.0, middle[1], -70.0]) > 0.0


def principal_stretches(rest, deformed):
    """Stretches of a surface element, from the lengths and angles of its tangents."""
    first, second = (
        np.stack(np.gradient(surface, axis=(0, 1)), axis=-1) for surface in (rest, deformed)
    )
    before, after = (np.einsum("...ka,...kb->...ab", one, one) for one in (first, second))
    squares = np.linalg.eigvals(np.linalg.solve(before, after)).real
    return np.sqrt(np.sort(squares, axis=-1)[..., ::-1])


def test_strain_is_that_of_both_surfaces(cheek):
    _, field = cheek.convolve(np.zeros((160, 160), np.float32), table=FOREHEAD)
    expected = principal_stretches(cheek.rest_mm, cheek.deformed_mm)[8:-8, 8:-8]
    np.testing.assert_allclose(field.stretch[8:-8, 8:-8], expected, atol=0.01)
    assert expected[..., 0].mean() > 1.05
    assert expected[..., 1].mean() < 0.9


def test_face_at_rest_keeps_its_relief(rng):
    still = crop_face(FaceView("rest", CHEEK.center_mm, "happiness", 0.0), side_mm=8.0, texels=64)
    relief = rng.standard_normal((64, 64)).astype(np.float32)
    moved, field = still.convolve(relief, table=FOREHEAD)
    np.testing.assert_array_equal(moved, relief)
    before, after = (still.slope_variances(relief, field, deformed=d) for d in (False, True))
    assert before == pytest.approx(after)


def test_slope_variances_are_those_of_ramp(cheek):
    _, field = cheek.convolve(np.zeros((160, 160), np.float32), table=FOREHEAD)
    wave = np.sin(2.0 * np.pi * np.arange(160) / 32.0)
    heights = np.broadcast_to(5.0 * wave, (160, 160)).astype(np.float32)
    both = cheek.slope_variances(heights, field, deformed=False)
    per_texel = 5.0 * np.sin(2.0 * np.pi / 32.0)  # amplitude of central differences
    expected = 0.5 * (per_texel / 50.0) ** 2
    assert sum(both) == pytest.approx(expected, rel=0.08)


def test_square_beyond_texture_is_refused():
    with pytest.raises(UnusableError, match="side_mm"):
        crop_face(CHEEK, side_mm=300.0, texels=64)
    with pytest.raises(UnusableError, match="texels"):
        crop_face(CHEEK, side_mm=8.0, texels=8)
