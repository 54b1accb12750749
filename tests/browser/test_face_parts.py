"""Eyes, brows, lashes and hair of the simulated head, which are not skin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rigsim.face_parts import eyelids
from skinrig.viewer import page

pytestmark = pytest.mark.long

CLOSE = {"camera_distance_mm": 230, "camera_target_mm": [0, 24, -10], "microstructure": 0}


def test_closed_eyes_leave_every_pixel_as_without_parts(open_page, procedural_scene, viewer):
    """Bit for bit: the same scene without the tables has no eyes and no hair at all."""
    tables = {n: t for n, t in procedural_scene.tables.items() if n[:4] not in ("lid_", "hair")}
    facts = {n: f for n, f in procedural_scene.facts.items() if n != "face_parts"}
    plain = open_page(page.build(replace(procedural_scene, tables=tables, facts=facts)))
    for change in ({}, {"weights": {"surprise": 1.2}, "camera_yaw_deg": 25}):
        plain.set(**change)
        viewer.set(**change)
        for name in ("display", "irradiance", "specular", "normal", "inspect"):
            np.testing.assert_array_equal(viewer.read(name), plain.read(name))


def test_lids_move_as_simulated_head_opens(viewer, procedural_scene):
    """Within the steps of the table; float32 positions add 1e-5 mm."""
    closed, _ = viewer.mesh()
    for weight in (0.3, 1.0):
        viewer.set(eyes_open=weight)
        moved, _ = viewer.mesh()
        expected = closed.astype(np.float64)
        for lids in eyelids.build_eyelids(procedural_scene.mesh):
            expected[lids.vertices] += lids.displacement_mm(weight)
        np.testing.assert_allclose(moved, expected, atol=1.5 / 512.0)


def test_open_eye_is_masked_as_no_skin(viewer):
    """Between the lids nothing of the inspection is left, about 10 by 29 mm per eye."""
    viewer.set(**CLOSE)
    closed = viewer.read("inspect")[..., :2].any(axis=-1)
    viewer.set(eyes_open=1)
    opened = viewer.read("inspect")[..., :2].any(axis=-1)
    lost = closed & ~opened
    pixel_mm = 2.0 * 240.0 * np.tan(np.radians(14.0)) / 256.0
    assert 2.0 * 140.0 < lost.sum() * pixel_mm**2 < 2.0 * 230.0
    assert not (opened & ~closed).any()
    # eyes are drawn there, none of the pixels is empty
    assert (viewer.read("albedo")[lost][:, 3] > 0.0).all()


def test_probe_reads_no_skin_on_eye_and_hair(viewer):
    """Chromophores of an eye would be 0 %, those below hair are not visible."""
    read = "([row, column]) => window.viewer.readings(column, row)"
    viewer.set(**CLOSE)
    skin = viewer.read("inspect")[..., :2].any(axis=-1)
    viewer.set(eyes_open=1)
    eyes = np.argwhere(skin & ~viewer.read("inspect")[..., :2].any(axis=-1))
    at = [int(n) for n in eyes[len(eyes) // 2]]
    assert viewer.page.evaluate(read, at)[0] == ["Eye", "not skin"]
    viewer.set(eyes_open=0)
    assert viewer.page.evaluate(read, at)[0][0] == "Melanosome volume fraction"
    viewer.set(camera_distance_mm=620, camera_target_mm=[0, 0, 0], hair=1)
    covered = np.argwhere(viewer.read("hair")[..., 3] > 0.9)
    at = [int(n) for n in covered[len(covered) // 2]]
    assert viewer.page.evaluate(read, at) == [["Hair", "not skin"]]


def test_expression_moves_no_skin_into_eyes(viewer, procedural_scene):
    eyes = eyelids.build_eyelids(procedural_scene.mesh)
    for name in ("surprise", "disgust", "happiness"):
        viewer.set(weights={"surprise": 0, "disgust": 0, "happiness": 0, name: 1.5}, eyes_open=1)
        moved, _ = viewer.mesh()
        for lids in eyes:
            off = np.linalg.norm(moved[lids.vertices] - lids.center_mm, axis=-1)
            assert off.min() > eyelids.APEX_MM + 0.3


def test_pupils_turn_to_camera_where_they_follow(viewer):
    """The pupils are the darkest parts of both eyes; they are seen within a pixel of 0.5 mm.

    The cornea's paraxial image of the iris is 10.0 mm in front of the eyeball's center, where
    perspective enlarges movements by 4 %.
    """

    def pupils():
        albedo = viewer.read("albedo")
        eye = (albedo[..., 3] > 0.0) & ~viewer.read("inspect")[..., :2].any(axis=-1)
        dark = eye & (albedo[..., 0] < 0.004)
        halves = (dark[:, :128], dark[:, 128:])
        return [float(np.nonzero(half)[1].mean()) for half in halves]

    viewer.set(**CLOSE, eyes_open=1, camera_yaw_deg=20, eyes_follow=1)
    follow = pupils()
    viewer.set(eyes_follow=0)
    ahead = pupils()
    pixel_mm = 2.0 * 240.0 * np.tan(np.radians(14.0)) / 256.0
    yaw = np.radians(20.0)
    eye = np.array([230.0 * np.sin(yaw), 230.0 * np.cos(yaw) - 10.0])
    for moved, x in zip(np.subtract(follow, ahead), (-31.5, 31.5), strict=True):
        turn = min(np.arctan2(eye[0] - x, eye[1] + 18.6), np.radians(26.0))
        expected = np.sin(turn) * np.cos(yaw) + (1.0 - np.cos(turn)) * np.sin(yaw)
        np.testing.assert_allclose(moved * pixel_mm, 10.4 * expected, atol=pixel_mm)


def test_hair_changes_only_pixels_it_covers(viewer):
    bald = viewer.read("display")
    viewer.set(hair=1, brows=1)
    covered = viewer.read("hair")[..., 3]
    haired = viewer.read("display")
    np.testing.assert_array_equal(haired[covered == 0.0], bald[covered == 0.0])
    assert (covered > 0.9).mean() > 0.02
    # brighter hair has less melanin, darker skin stays what it is behind uncovered pixels
    assert haired[covered > 0.9, :3].mean() < bald[covered > 0.9, :3].mean()
    assert viewer.problems == []


NO_LIGHT = {"light_intensity": 0, "ambient": 0, "fill": 0, "rim": 0, "shadows": 0}
PARTS = {**CLOSE, "eyes_open": 1, "hair": 1, "brows": 1}


def read_parts(viewer, **params):
    """Return irradiance and highlights, NaN but on eyes, (H, W, 3) each, and hair, (H, W, 4)."""
    viewer.set(**(PARTS | NO_LIGHT | params))
    eye = (viewer.read("albedo")[..., 3] > 0.0) & ~viewer.read("inspect")[..., :2].any(axis=-1)
    found = [viewer.read(name)[..., :3] for name in ("irradiance", "specular")]
    return (*(np.where(eye[..., None], one, np.nan) for one in found), viewer.read("hair"))


def test_integrating_sphere_lights_eyes_and_hair(viewer):
    """Radiance 1 from everywhere: at most 1 returns, and the eye's front has irradiance pi."""
    irradiance, highlight, hair = read_parts(viewer, environment="uniform")
    np.testing.assert_allclose(np.nanquantile(irradiance, 0.9), 1.0, atol=2e-3)
    assert np.nanmax(irradiance) < 1.002
    assert np.nanmin(irradiance) > 0.1  # below the upper lid and in the corners
    # 0.025 straight ahead (Fresnel's reflection of tears), where no lid is near
    assert np.nanmedian(highlight) == pytest.approx(0.025, rel=0.1)
    covered = hair[..., 3] > 0.9
    assert covered.sum() > 500
    assert 0.002 < np.median(hair[covered, :3]) < hair[covered, :3].max() < 1.0
    halves = read_parts(viewer, environment="uniform", environment_intensity=0.5)
    np.testing.assert_allclose(halves[0], 0.5 * irradiance, rtol=1e-3)
    np.testing.assert_allclose(halves[2][..., :3], 0.5 * hair[..., :3], atol=1e-3)


def test_fill_on_eyes_equals_key_from_there(viewer):
    """Light adds up: what fill adds is a key light of its direction and intensity.

    Fill is 80 degrees from the key light, 8 above the horizon. The ball around the head shadows
    none of the eye and brow on that side; light from behind reaches hair at the rim alone.
    """
    both = {"light_intensity": 2.0, "light_azimuth_deg": 35, "light_elevation_deg": 20}
    key, filled, rimmed = (
        read_parts(viewer, **both, **more) for more in ({}, {"fill": 0.5}, {"rim": 1.0})
    )
    alone = read_parts(viewer, light_intensity=1.0, light_azimuth_deg=-45, light_elevation_deg=8)
    side = np.s_[:, :120]
    np.testing.assert_allclose((filled[0] - key[0])[side], alone[0][side], atol=1e-5)
    assert np.nanmax(alone[0][side]) > 0.5
    brow = np.s_[60:110, :120, :3]
    np.testing.assert_allclose((filled[2] - key[2])[brow], alone[2][brow], atol=2e-3)
    assert alone[2][brow].max() > 0.02
    np.testing.assert_array_equal(rimmed[0], key[0])
    assert (rimmed[2] - key[2]).max() > 0.02
