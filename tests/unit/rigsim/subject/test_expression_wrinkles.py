"""Wrinkles: none without shortening, as long as the skin that has no room, always at one place."""

import dataclasses
import math
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from rigsim.geometry.atlas import Atlas, unwrap
from rigsim.geometry.mesh import Mesh, build_mesh
from rigsim.subject import face_regions, relief
from rigsim.subject.expression_wrinkles import (
    GROOVE_NARROWING,
    WRINKLE_ZONES,
    WrinkleLines,
    Wrinkles,
    draw_wrinkle_lines,
    form_wrinkles,
    wave_depth,
)
from rigsim.subject.person import SimulatedSubject, make_subject

SIZE = 320
PLATE = 256
"""Texels along the sides of the flat piece, 28 mm up and 60 mm across."""


@pytest.fixture(scope="module")
def face() -> SimulatedSubject:
    return make_subject("II", seed=4, size=SIZE)


@pytest.fixture(scope="module")
def posed(face: SimulatedSubject) -> Callable[..., SimulatedSubject]:
    return cache(face.with_expression)


def brow_plate(stretch_x: float = 1.0, stretch_y: float = 1.0) -> Mesh:
    """Return a flat piece of forehead, stretched about its middle."""
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    places = corners * [30.0 * stretch_x, 14.0 * stretch_y] + [0.0, 64.0]
    return build_mesh(
        np.column_stack([places, np.full(4, 4.0)]), [[0, 1, 2], [0, 2, 3]], 0.5 * (corners + 1.0)
    )


def plate_wrinkles(
    stretch_x: float, stretch_y: float, *, seed: int = 1
) -> tuple[Wrinkles, WrinkleLines, Atlas]:
    rest = unwrap(brow_plate(), PLATE)
    posed = unwrap(brow_plate(stretch_x, stretch_y), PLATE)
    lines = draw_wrinkle_lines(rest.position_mm, rest.covered, seed=seed)
    return form_wrinkles(lines, rest, posed), lines, posed


def turned(mesh: Mesh, angle_rad: float) -> Mesh:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return dataclasses.replace(
        mesh,
        vertices_mm=(mesh.vertices_mm @ turn.T + [3.0, -2.0, 7.0]).astype(np.float32),
        normals=(mesh.normals @ turn.T).astype(np.float32),
    )


def test_nothing_wrinkles_that_is_not_shortened(face):
    points = face_regions.to_mean_head(face.atlas.position_mm, face.mesh)
    lines = draw_wrinkle_lines(points, face.atlas.covered, seed=face.seed)
    for mesh in (face.mesh, turned(face.mesh, 0.4)):
        wrinkles = form_wrinkles(lines, face.atlas, unwrap(mesh, SIZE))
        assert not wrinkles.height_um.any()
        assert not wrinkles.excess.any()
    grown = dataclasses.replace(face.mesh, vertices_mm=face.mesh.vertices_mm * np.float32(1.3))
    assert not form_wrinkles(lines, face.atlas, unwrap(grown, SIZE)).height_um.any()


def test_shortening_within_skin_tension_raises_no_wrinkles():
    _, lines, _ = plate_wrinkles(1.0, 0.8)
    below, _, _ = plate_wrinkles(1.0, 1.0 - 0.8 * lines.tension)
    above, _, _ = plate_wrinkles(1.0, 1.0 - 1.3 * lines.tension)
    assert not below.height_um.any()
    assert np.abs(above.height_um).max() > 50.0


def test_shortening_across_lines_raises_wrinkles_along_does_not():
    along, _, _ = plate_wrinkles(0.75, 1.0)
    across, _, _ = plate_wrinkles(1.0, 0.75)
    assert np.abs(along.height_um).mean() < 0.1 * np.abs(across.height_um).mean()


@pytest.mark.parametrize("stretch", [0.85, 0.75, 0.65])
def test_wrinkled_line_keeps_slack_length_of_skin(stretch):
    """Rationale: what has no room in the surface goes into the wrinkle.

    Expected: from furrow to furrow the length is that of the surface and of the excess, which in
    the middle of a zone makes it the skin's slack length, (1 - tension) of that at rest (next
    test). Tolerance: 1.5 % of the length; texels of 0.1 mm take 0.2 %, the rest is that the depth
    changes along the way.
    """
    wrinkles, _lines, posed = plate_wrinkles(1.0, stretch, seed=3)
    ratios, gains = [], []
    for column in range(96, 160, 4):
        height_mm = wrinkles.height_um[:, column].astype(np.float64) * 1e-3
        low = (height_mm[1:-1] < height_mm[:-2]) & (height_mm[1:-1] <= height_mm[2:])
        furrows = 1 + np.flatnonzero(low & (np.abs(np.arange(1, PLATE - 1) - PLATE // 2) < 96))
        part = slice(furrows[0], furrows[-1] + 1)
        assert len(furrows) >= 2
        step_mm = np.abs(np.diff(posed.position_mm[part, column, 1].astype(np.float64)))
        measured = np.hypot(np.diff(height_mm[part]), step_mm).sum()
        excess = 0.5 * (wrinkles.excess[part, column][1:] + wrinkles.excess[part, column][:-1])
        ratios.append(measured / np.sum(step_mm * (1.0 + excess)))
        gains.append(measured / step_mm.sum())
    np.testing.assert_allclose(ratios, 1.0, atol=0.015)
    assert min(gains) > 1.05


def test_wrinkles_mid_zone_take_whole_excess_length():
    wrinkles, lines, _ = plate_wrinkles(1.0, 0.75, seed=3)
    excess = wrinkles.excess[122:166, 96:160]
    whole = (1.0 - lines.tension) / 0.75 - 1.0
    # persons take up to a fifth less; the lines' wobble turns some of them a little
    assert (excess < 1.08 * whole).all()
    assert np.median(excess) > 0.75 * whole


def test_the_depth_of_a_wave_gives_its_length():
    """A wave of known depth, measured with a ruler of a thousandth of its length."""
    phase = np.linspace(-math.pi, math.pi, 20_001)
    bell = np.exp(GROOVE_NARROWING * (np.cos(phase) - 1.0))
    shape = -bell / (1.0 - math.exp(-2.0 * GROOVE_NARROWING))
    for excess in (0.003, 0.05, 0.3):
        depth = float(wave_depth(excess))
        line = np.hypot(np.diff(phase) / (2.0 * math.pi), np.diff(depth * shape)).sum()
        assert line - 1.0 == pytest.approx(excess, rel=2e-3)
        assert depth * np.ptp(shape) == pytest.approx(depth, rel=1e-6)


def test_wavelength_matches_stiff_layer_on_soft_substrate():
    length = {zone.name: zone.wavelength_mm for zone in WRINKLE_ZONES}
    assert 6.0 < length["forehead"] < 9.0
    assert 2.0 < length["crow's feet"] < 3.5
    thickness = {zone.name: zone.thickness_mm for zone in WRINKLE_ZONES}
    ratio = length["forehead"] / length["crow's feet"]
    assert ratio == pytest.approx(thickness["forehead"] / thickness["crow's feet"])


@pytest.mark.parametrize(
    ("state", "where"),
    [
        ("surprise", lambda p: (np.abs(p[..., 0]) < 30) & (np.abs(p[..., 1] - 58) < 9)),
        ("anger", lambda p: (np.abs(p[..., 0]) < 8) & (np.abs(p[..., 1] - 43) < 8)),
        ("happiness", lambda p: (p[..., 0] > 48) & (np.abs(p[..., 1] - 24) < 8)),
        ("disgust", lambda p: (np.abs(p[..., 0]) < 6) & (np.abs(p[..., 1] - 20) < 6)),
        ("smile", lambda p: (np.abs(p[..., 0] - 24) < 6) & (np.abs(p[..., 1] + 24) < 8)),
    ],
)
def test_each_expression_wrinkles_where_skin_is_shortened(face, posed, state, where):
    points = face_regions.to_mean_head(face.atlas.position_mm, face.mesh)
    inside = where(points) & (points[..., 2] > -45.0)
    raised = np.abs(posed(state).pose.wrinkles.height_um)
    assert np.quantile(raised[inside], 0.9) > 60.0
    # most of the face stays smooth
    assert (raised > 0.0).mean() < 0.15


def test_expressions_shortening_same_skin_raise_same_lines(face, posed):
    one = posed("surprise").pose.wrinkles.height_um
    other = posed("fear").pose.wrinkles.height_um
    points = face_regions.to_mean_head(face.atlas.position_mm, face.mesh)
    both = (np.abs(one) > 0) & (np.abs(other) > 0) & (points[..., 1] > 46.0)
    assert both.sum() > 1000
    assert np.corrcoef(one[both], other[both])[0, 1] > 0.9
    lines = draw_wrinkle_lines(points, face.atlas.covered, seed=5)
    stranger = form_wrinkles(lines, face.atlas, posed("surprise").atlas).height_um
    shared = (np.abs(one) > 0) & (np.abs(stranger) > 0) & (points[..., 1] > 46.0)
    assert abs(np.corrcoef(one[shared], stranger[shared])[0, 1]) < 0.6


def test_wrinkles_deepen_with_expression_and_fine_relief_stays(face, posed):
    depth = [
        float(np.abs(posed("surprise", amount).pose.wrinkles.height_um).max())
        for amount in (0.1, 0.6, 1.0, 1.5)
    ]
    assert depth[0] == 0.0
    assert 0.0 < depth[1] < depth[2] < depth[3] < 3000.0
    moved = posed("surprise")
    np.testing.assert_allclose(
        moved.height_um - moved.pose.wrinkles.height_um, face.height_um, atol=1e-3
    )


def test_coarse_texture_omits_fine_wrinkles_and_reports():
    coarse = make_subject("II", seed=4, size=128).with_expression("happiness")
    assert "crow's feet" in coarse.pose.wrinkles.omitted
    assert np.isfinite(coarse.pose.wrinkles.height_um).all()


def test_texture_frame_normals_show_relief_alone():
    """A flat plate turned in space has the same tangent normals; a slope along u tilts x only."""
    slope = 0.2
    for mesh in (brow_plate(), turned(brow_plate(), 0.7)):
        atlas = unwrap(mesh, 64)
        along = np.arange(64.0)[None, :] / 64 * 60.0  # mm along u
        height_um = np.broadcast_to(1e3 * slope * along, (64, 64)).astype(np.float32)
        normal = relief.tangent_normals(atlas, relief.relief_normals(atlas, height_um))
        expected = np.array([-slope, 0.0, 1.0]) / math.hypot(slope, 1.0)
        np.testing.assert_allclose(
            normal[5:-5, 5:-5], np.broadcast_to(expected, (54, 54, 3)), atol=1e-4
        )


def test_texture_frame_normals_point_up_where_height_falls():
    atlas = unwrap(brow_plate(), 64)
    rising = np.arange(63.0, -1.0, -1.0)[:, None] / 64 * 28.0  # row 0 is the top, v = 1
    height_um = np.broadcast_to(-200.0 * rising, (64, 64)).astype(np.float32)
    normal = relief.tangent_normals(atlas, relief.relief_normals(atlas, height_um))
    assert normal[32, 32, 1] == pytest.approx(0.2 / math.hypot(0.2, 1.0), abs=1e-4)


def test_tangent_normals_of_posed_face_change_by_wrinkles(face, posed):
    before, after = face.tangent_normal(), posed("surprise").tangent_normal()
    np.testing.assert_allclose(np.linalg.norm(after, axis=-1), 1.0, atol=1e-5)
    tilt = np.degrees(np.arccos(np.clip(np.sum(before * after, axis=-1), -1.0, 1.0)))
    points = face_regions.to_mean_head(face.atlas.position_mm, face.mesh)
    forehead = (np.abs(points[..., 0]) < 25) & (np.abs(points[..., 1] - 58) < 8)
    cheek = (np.abs(np.abs(points[..., 0]) - 45) < 8) & (np.abs(points[..., 1] + 8) < 8)
    assert np.quantile(tilt[forehead], 0.9) > 10.0
    assert np.quantile(tilt[cheek], 0.9) < 2.0
