"""Photographs of displaced skin: radiance, shadows and projection of closed form."""

import numpy as np
import pytest

from skinrig.applying import face_photograph as photographs
from skinrig.applying.face_photograph import FlashCamera, photograph
from skinrig.applying.subsurface_grid import SKIN_COLOR


def plane(side=120, width_mm=6.0):
    at = ((np.arange(side) + 0.5) / side - 0.5) * width_mm
    x, y = np.meshgrid(at, -at)
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def camera(**changes):
    about = {"field_mm": 3.0, "size_px": 30, "blur_px": 0.3, **changes}
    return FlashCamera(**about)


def test_specular_radiance_of_plane_is_closed_form():
    """GGX and Smith's masking written out for light and view at 0.4 rad about the normal."""
    tilt, alpha = 0.4, photographs.FACET_ROUGHNESS
    made = photograph(
        plane(), np.zeros((120, 120), np.float32), camera(camera_tilt_rad=tilt, light_tilt_rad=tilt)
    )
    density = 1.0 / (np.pi * alpha**2)  # of facets along the normal
    masked = np.sqrt(1.0 + (alpha * np.tan(tilt)) ** 2)  # 1 + Lambda of light and view
    c = np.cos(tilt)
    g = np.sqrt(1.4**2 - 1.0 + c * c)
    fresnel = 0.5 * ((g - c) / (g + c)) ** 2 * (1 + ((c * (g + c) - 1) / (c * (g - c) + 1)) ** 2)
    expected = np.pi * c * density * fresnel / (4.0 * c * c * masked)
    assert made.specular[15, 15] == pytest.approx(expected, rel=0.02)
    assert made.specular_contrast < 0.1


def test_skin_has_color_of_its_reflectance():
    made = photograph(plane(), np.zeros((120, 120), np.float32), camera())
    radiance = made.subsurface[15, 15]
    ratio = radiance / SKIN_COLOR
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=0.05)
    assert 0.8 * np.cos(0.75) < ratio.mean() < np.cos(0.75)  # less both surface reflections
    np.testing.assert_allclose(made.total[15, 15], radiance + made.specular[15, 15])


def test_wall_casts_shadow_of_its_height():
    """A wall of 200 um under light at 45 degrees shadows 200 um: 4 texels of 50 um."""
    surface, height = plane(), np.zeros((120, 120), np.float32)
    height[:, 60:62] = 200.0
    normals = np.broadcast_to(np.array([0.0, 0.0, 1.0]), surface.shape)
    for way, dark in ((1.0, slice(56, 60)), (-1.0, slice(62, 66))):
        light = np.zeros_like(surface) + np.array([way, 0.0, 1.0]) / np.sqrt(2.0)
        hidden = photographs._shadowed(surface, normals, height, light)
        expected = np.zeros(120, bool)
        expected[dark] = True
        assert np.abs(hidden[60].astype(int) - expected).sum() <= 1
    up = np.broadcast_to(np.array([0.0, 1e-9, 1.0]), surface.shape)
    assert not photographs._shadowed(surface, normals, height, up).any()


def test_edge_of_skin_is_at_its_pixel():
    """Seen from above, half of a field of 12 mm is skin of 6 mm."""
    flat = np.zeros((120, 120), np.float32)
    made = photograph(plane(), flat, camera(field_mm=12.0, camera_tilt_rad=0.0, size_px=40))
    visible = np.isfinite(made.specular)
    assert np.flatnonzero(visible.any(axis=0))[[0, -1]] == pytest.approx([10, 29], abs=1)
    assert np.flatnonzero(visible.any(axis=1))[[0, -1]] == pytest.approx([10, 29], abs=1)


def test_image_is_upright_and_unmirrored():
    """A bump at the upper right of the skin is at the upper right of the photograph."""
    height = np.zeros((120, 120), np.float32)
    height[35:40, 80:85] = 100.0
    straight = camera(camera_tilt_rad=0.0, light_tilt_rad=0.0)
    change = photograph(plane(), height, straight).specular
    change = np.abs(change - photograph(plane(), 0.0 * height, straight).specular)
    row, column = np.unravel_index(np.nanargmax(change), change.shape)
    assert row < 13
    assert column > 17


def test_noise_is_that_of_counted_photons(rng):
    flat = np.full((200, 200), 0.5)
    levels = photographs.develop(flat, 1.0, camera(full_well=1000.0), rng) ** 2.2
    assert levels.mean() == pytest.approx(0.5, abs=0.001)
    assert levels.std() == pytest.approx(np.sqrt(0.5 / 1000.0), rel=0.05)
