"""Fill, rim, environment, timeline, comparisons and people of the live page."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from twins import facial_specular

from skinrig.viewer import faces, page

pytestmark = pytest.mark.long

FLAT = {"relief": 0, "wrinkles": 0, "microstructure": 0, "hybrid_normals": 0, "detail": 0}
NO_ENVIRONMENT = {"environment": "none", "environment_intensity": 1.0, "environment_azimuth_deg": 0}
NO_LIGHT = {"light_intensity": 0, "ambient": 0, "fill": 0, "rim": 0, "shadows": 0}
DARK = FLAT | NO_LIGHT | NO_ENVIRONMENT
BAND_ERROR = 0.02
"""Error of irradiance without bands above 2, fraction of its largest value."""


def directions(count: int) -> NDArray[np.floating]:
    """Return random directions, (count, 3), uniform over the sphere."""
    found = np.random.default_rng(12345).standard_normal((count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def overcast(d: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the radiance of Moon and Spencer's sky above gray ground."""
    return np.where(d[:, 1] > 0.0, 9.0 / 7.0 * (1.0 + 2.0 * d[:, 1]) / 3.0, 0.2)


def shown(viewer: Any, **params: Any) -> tuple[NDArray[np.floating], ...]:
    """Return irradiance, specular and normals of skin pixels, (N, 3) each."""
    viewer.set(**(DARK | params))
    inside = viewer.read("albedo")[..., 3] > 0.5
    return tuple(
        viewer.read(name)[..., :3][inside] for name in ("irradiance", "specular", "normal")
    )


def test_uniform_environment_gives_irradiance_of_its_radiance(viewer):
    irradiance, specular, _ = shown(viewer, environment="uniform")
    np.testing.assert_allclose(irradiance, 1.0, atol=2e-3)
    half, less, _ = shown(viewer, environment="uniform", environment_intensity=0.5)
    np.testing.assert_allclose(half, 0.5, atol=1e-3)
    np.testing.assert_allclose(less, 0.5 * specular, rtol=2e-3, atol=1e-4)
    none, dark, _ = shown(viewer, environment="constructor")  # from a damaged link
    assert not none.any()
    assert not dark.any()


def test_overcast_sky_agrees_with_numerical_irradiance(viewer):
    irradiance, _, normals = shown(viewer, environment="overcast")
    light = directions(100_000)
    radiance = overcast(light)
    chosen = np.random.default_rng(1).choice(len(normals), 60, replace=False)
    for pixel in chosen:
        cosines = np.clip(light @ normals[pixel], 0.0, None)
        expected = 4.0 * np.mean(cosines * radiance)  # 4 pi / pi times the mean
        assert abs(irradiance[pixel, 1] - expected) < BAND_ERROR
    spread = irradiance[chosen, 1]
    assert spread.max() - spread.min() > 10 * BAND_ERROR  # a constant would miss the bound


def test_rotated_environment_lights_other_side(viewer):
    def tilt(azimuth: float) -> float:
        irradiance, _, normals = shown(
            viewer, environment="window", environment_azimuth_deg=azimuth
        )
        return float(np.polyfit(normals[:, 0], irradiance[:, 1], 1)[0])

    assert tilt(0.0) > 0.05
    assert tilt(-106.0) < -0.05  # the window at 56 degrees moves to the other side


def test_highlight_table_is_integral_of_formula(viewer):
    table = viewer.page.evaluate(
        """() => { const {shape, data} = window.viewer.scene.tables.environment_brdf;
        return {shape, data: Array.from(data)}; }"""
    )
    rows, columns, _ = table["shape"]
    found = np.reshape(table["data"], table["shape"])
    normal, light = np.array([0.0, 0.0, 1.0]), directions(400_000)
    light = light[light[:, 2] > 0.0]
    for row, column in ((2, columns - 1), (5, 12), (rows - 1, 8)):
        m = 0.08 + 0.92 * row / (rows - 1)
        cosine = column / (columns - 1)
        eye = np.array([np.sqrt(1.0 - cosine**2), 0.0, cosine])
        for f0 in (0.028, 0.2):
            value = facial_specular.kelemen(normal, light, eye, roughness=m, f0=f0)
            expected = 2.0 * np.pi * np.mean(value * light[:, 2])
            got = f0 * found[row, column, 0] + found[row, column, 1]
            assert got == pytest.approx(expected, rel=0.03)


def test_fill_lights_shadowed_side_rim_from_behind(viewer):
    key = {"light_intensity": 2.0, "shadows": 1}
    alone, _, normals = shown(viewer, **key)
    filled, _, _ = shown(viewer, **key, fill=0.5)
    left = normals[:, 0] < -0.3
    right = normals[:, 0] > 0.3
    assert np.median(filled[left]) > 3.0 * np.median(alone[left])
    assert np.median(filled[right]) < 1.5 * np.median(alone[right])
    rimmed, _, _ = shown(viewer, **key, rim=1.0)
    ahead = normals[:, 2] > 0.9
    np.testing.assert_array_equal(rimmed[ahead], alone[ahead])
    assert (rimmed - alone).max() > 0.1


def test_timeline_plays_blood_and_wrinkles_until_paused(viewer):
    group = viewer.page.locator("#group-expression")
    group.evaluate("group => { group.open = true; }")
    before, blood = viewer.mesh()[0], viewer.read("hemoglobin_rig")
    group.get_by_label("Timeline").fill("3.6")
    weights = viewer.page.evaluate("() => window.viewer.params.weights")
    assert weights["surprise"] == pytest.approx(0.5)
    assert weights["anger"] == pytest.approx(0.5)
    assert np.abs(viewer.mesh()[0] - before).max() > 0.5
    assert np.abs(viewer.read("hemoglobin_rig") - blood).max() > 1e-3
    group.get_by_role("button", name="Play").press("Enter")
    time = "() => window.viewer.params.timeline_s"
    viewer.wait_until(f"() => ({time})() !== 3.6")
    group.get_by_role("button", name="Pause").press("Enter")
    assert group.get_by_role("button", name="Play").get_attribute("aria-pressed") == "false"
    paused = viewer.page.evaluate(time)
    viewer.wait_frames()
    assert viewer.page.evaluate(time) == paused


def test_neutral_as_b_shows_difference_and_flips(viewer):
    pixels = """() => { const gl = document.getElementById("view").getContext("webgl2");
      const [w, h] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
      const out = new Uint8Array(w * h * 4);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, out);
      return Array.from(out).filter((_, i) => i % 4 < 3); }"""
    view = viewer.page.locator("#group-view")
    view.evaluate("group => { group.open = true; }")
    view.get_by_role("button", name="Neutral as B").click()
    viewer.set(difference_gain=8)
    equal = np.array(viewer.page.evaluate(pixels))
    assert np.abs(equal - 127.5).max() <= 0.5
    viewer.set(weights={"anger": 1.0})
    assert np.abs(np.array(viewer.page.evaluate(pixels)) - 127.5).max() > 60
    view.get_by_role("button", name="Flip").click()
    for split in (1, 0, 1):
        viewer.wait_until("split => window.viewer.params.split === split", split)
    view.get_by_role("button", name="End").click()
    view.get_by_role("button", name="Scattering off as B").click()
    compared = viewer.page.evaluate("() => window.viewer.params.compare")
    assert compared["scattering"] is False
    view.get_by_role("button", name="End").click()
    assert viewer.page.evaluate("() => window.viewer.params.compare") is None


def test_people_have_own_color_on_one_head(open_page):
    scene = faces.build_scene(size=64, people=("II", "IV", "VI"))
    viewer = open_page(page.build(scene), canvas=128)
    albedo = []
    for person in range(3):
        viewer.set(person=person)
        found = viewer.read("albedo")
        albedo.append(float(np.median(found[..., 1][found[..., 3] > 0.5])))
    assert albedo[0] > 1.2 * albedo[1] > 1.44 * albedo[2]
    viewer.page.get_by_role("button", name="Side by side").click()
    viewer.set()
    row = viewer.read("albedo")
    thirds = [row[:, k : k + 40] for k in (0, 44, 88)]
    seen = [float(np.median(one[..., 1][one[..., 3] > 0.5])) for one in thirds]
    np.testing.assert_allclose(seen, albedo, rtol=0.1)
    covered = viewer.read("hair")[..., 3] > 0.5
    assert all(covered[:, k : k + 40].sum() > 20 for k in (0, 44, 88))
    # hair and irises of darker skin have more melanin
    colors = scene.facts["people_parts"]
    assert colors[0]["iris"][2] > colors[1]["iris"][2]
    hair = viewer.read("hair")
    left, right = (hair[:, k : k + 40][covered[:, k : k + 40]] for k in (0, 88))
    assert np.median(left[:, 0] / left[:, 3]) > 1.5 * np.median(right[:, 0] / right[:, 3])
    assert viewer.problems == []
