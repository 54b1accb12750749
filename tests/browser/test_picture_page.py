"""The page of a picture: shading against its closed form, tools, readings."""

from __future__ import annotations

import numpy as np
import pytest

from model import store
from model.skin import SkinAppearance, SkinMap
from skinrig.viewer import faces, page

SHAPE = (64, 64)
ALBEDO = 0.4
ROUGHNESS = 0.35


@pytest.fixture(scope="module")
def picture(open_page, tmp_path_factory):
    """A page of a sphere's cap, of known albedo, in two states."""
    y, x = (0.9 * (np.indices(SHAPE) + 0.5) / 32.0 - 0.9) * np.array([-1.0, 1.0])[:, None, None]
    z = np.sqrt(np.maximum(1.0 - x**2 - y**2, 0.0))
    cap = SkinMap(
        np.stack([x, y, z], axis=-1).astype(np.float32),
        "1",
        np.full((*SHAPE, 3), 0.01, np.float32),
        z > 0.3,
    )
    flat = SkinMap(np.tile(np.float32([0, 0, 1]), (*SHAPE, 1)), "1", cap.stderr)
    albedo = SkinMap(np.full((*SHAPE, 3), ALBEDO, np.float32), "1")
    maps = {"normals_cap": cap, "normals_flat": flat, "albedo": albedo}
    parameters = {"kind": "appearance", "states": ["cap", "flat"], "alpha": {"value": ROUGHNESS}}
    folder = tmp_path_factory.mktemp("picture") / "appearance"
    store.write(folder, SkinAppearance(maps, "measured", parameters, {}))
    return open_page(page.build(faces.build_scene([folder])), canvas=64)


def expected(normals, light, intensity):
    """Return radiance of Lambert and GGX (Walter et al. 2007, eqs. 33 and 34), view along z."""
    lit = np.maximum(normals @ light, 0.0)
    half = light + np.array([0.0, 0.0, 1.0])
    half /= np.linalg.norm(half)
    tangent2 = 1.0 / np.square(normals @ half) - 1.0
    distribution = ROUGHNESS**2 / (
        np.pi * np.square(np.square(normals @ half)) * np.square(ROUGHNESS**2 + tangent2)
    )

    def masking(cosine):
        return 2.0 / (1.0 + np.sqrt(1.0 + ROUGHNESS**2 * (1.0 / np.square(cosine) - 1.0)))

    seen = normals[..., 2]
    fresnel = 0.0278 + (1.0 - 0.0278) * (1.0 - half[2]) ** 5
    with np.errstate(divide="ignore"):
        shine = distribution * fresnel * masking(lit) * masking(seen) / (4.0 * seen)
    # the picture's brightest color is displayed as white
    return intensity * (lit / np.pi + np.where(lit > 0.0, shine, 0.0))


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 0), (40, 25), (-60, -30)])
def test_shading_agrees_with_its_closed_form(picture, azimuth, elevation):
    picture.set(
        light_azimuth_deg=azimuth,
        light_elevation_deg=elevation,
        light_intensity=2.0,
        ambient=0.0,
        picture_state=0,
    )
    normals = picture.read("normal")
    inside = normals[..., 3] > 0.99
    assert 0.6 < inside.mean() < 0.95
    a, e = np.radians([azimuth, elevation])
    light = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    wanted = expected(normals[inside][:, :3].astype(np.float64), light, 2.0)
    found = picture.read("radiance")[inside][:, 0]
    # half floats, and normals of half floats
    np.testing.assert_allclose(found, wanted, rtol=0.02, atol=0.004)
    turned = expected(normals[inside][:, :3].astype(np.float64), light * [-1, -1, 1], 2.0)
    if azimuth:
        assert np.abs(found - turned).max() > 0.1  # it can fail


def test_states_slopes_and_readings_follow_controls(picture):
    picture.set(picture_state=1, picture_slopes=1)
    assert np.ptp(picture.read("normal")[..., 2]) < 1e-3
    picture.set(picture_state=0, picture_slopes=0)
    kept = picture.read("normal")
    np.testing.assert_allclose(kept[kept[..., 3] > 0.99][:, 2], 1.0, atol=1e-3)
    picture.set(picture_slopes=1)
    rows = dict(picture.page.evaluate("() => window.viewer.readings(32, 32)"))
    assert rows["Its standard error"] == f"{np.degrees(0.01 * np.sqrt(2.0)):.2f}°"
    assert picture.page.evaluate("() => window.viewer.readings(0, 0)") == []
    assert picture.problems == []


def test_dragging_turns_the_light(picture):
    picture.set(light_azimuth_deg=0, light_elevation_deg=0)
    port = picture.page.locator("#port").bounding_box()
    middle = port["x"] + 0.5 * port["width"], port["y"] + 0.5 * port["height"]
    picture.page.mouse.move(*middle)
    picture.page.mouse.down()
    picture.page.mouse.move(middle[0] + 40, middle[1] - 20)
    picture.page.mouse.up()
    now = picture.page.evaluate("() => window.viewer.params")
    assert now["light_azimuth_deg"] > 5
    assert now["light_elevation_deg"] > 3


def test_reset_and_comparison_keep_pictures_together(picture):
    start = picture.page.evaluate("() => window.viewer.params")
    picture.page.get_by_role("button", name="Store as B").click()
    picture.set(picture_slopes=3, picture_x=0.3, picture_zoom=2)
    stored = picture.page.evaluate("() => window.viewer.params")["compare"]
    assert stored["picture_slopes"] == start["picture_slopes"]
    assert not {"picture_x", "picture_zoom"} & set(stored)  # both sides move together
    picture.page.get_by_role("button", name="Reset").click()
    now = picture.page.evaluate("() => window.viewer.params")
    assert (now["picture_slopes"], now["picture_x"], now["compare"]) == (1, 0.5, None)
    picture.page.locator("#port").focus()
    picture.page.keyboard.press("o")
    picture.page.keyboard.press("ArrowRight")
    assert picture.page.evaluate("() => window.viewer.params")["picture_x"] < 0.5  # moves right
    picture.page.keyboard.press("r")
    picture.page.keyboard.press("l")
    assert picture.problems == []
