"""Maps of a picture, laid on a mesh through landmarks of both."""

from __future__ import annotations

import numpy as np
import pytest

from skinrig.appearances.texel_placement import PlacementError, place_texels

SIZE = 48
FOCAL_PX, EYE_MM = 900.0, np.array([30.0, 10.0, 500.0])


@pytest.fixture
def dome():
    """A bulging surface: positions and normals of its texels."""
    x, y = np.meshgrid(np.linspace(-60, 60, SIZE), np.linspace(60, -60, SIZE))
    z = 40.0 - (x**2 + y**2) / 120.0
    normal = np.stack([x / 60.0, y / 60.0, np.ones_like(x)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.stack([x, y, z], axis=-1), normal


def _pixel(points):
    way = points - EYE_MM
    scale = FOCAL_PX / -way[..., 2]
    return np.stack([128.0 + scale * way[..., 0], 128.0 - scale * way[..., 1]], axis=-1)


def _landmarks(position, rng, noise_px=0.0, count=20):
    solid, flat = {}, {}
    for k, (i, j) in enumerate(rng.integers(2, SIZE - 2, (count, 2))):
        solid[f"p{k}"] = tuple(position[i, j].tolist())
        flat[f"p{k}"] = tuple((_pixel(position[i, j]) + noise_px * rng.normal(size=2)).tolist())
    return solid, flat


def test_texels_find_their_pixels_through_exact_landmarks(dome, rng):
    position, normal = dome
    covered = np.ones((SIZE, SIZE), bool)
    solid, flat = _landmarks(position, rng)
    found = place_texels(position, normal, covered, landmarks_mm=solid, landmarks_px=flat)
    assert np.abs(found.pixel - _pixel(position)).max() < 0.1
    assert found.leave_one_out_px < 0.1


def test_pixel_errors_stay_within_landmark_noise(dome, rng):
    position, normal = dome
    solid, flat = _landmarks(position, rng, noise_px=1.0, count=40)
    found = place_texels(
        position, normal, np.ones((SIZE, SIZE), bool), landmarks_mm=solid, landmarks_px=flat
    )
    middle = (slice(12, 36), slice(12, 36))
    off = np.linalg.norm((found.pixel - _pixel(position))[middle], axis=-1)
    assert np.sqrt(np.mean(off**2)) < 2.0


def test_map_is_recovered_where_visible_to_camera(dome, rng):
    position, normal = dome
    solid, flat = _landmarks(position, rng)
    found = place_texels(
        position, normal, np.ones((SIZE, SIZE), bool), landmarks_mm=solid, landmarks_px=flat
    )
    column, row = np.meshgrid(np.arange(256.0), np.arange(256.0))
    picture = 0.02 + 1e-4 * column + 5e-5 * row
    values, known = found.sample(picture, np.ones((256, 256), bool))
    inside = np.all((_pixel(position) > 1) & (_pixel(position) < 254), axis=-1)
    assert np.array_equal(known, found.visible & inside) or known.sum() > 0.9 * inside.sum()
    wanted = 0.02 + 1e-4 * _pixel(position)[..., 0] + 5e-5 * _pixel(position)[..., 1]
    assert np.abs(values - wanted)[known].max() < 2e-5


def test_skin_facing_away_from_camera_is_not_used(dome, rng):
    position, normal = dome
    solid, flat = _landmarks(position, rng)
    turned = normal.copy()
    turned[:10] = (1.0, 0.0, 0.0)
    found = place_texels(
        position, turned, np.ones((SIZE, SIZE), bool), landmarks_mm=solid, landmarks_px=flat
    )
    assert not found.visible[:10, SIZE // 2 :].any()
    assert found.visible[20:28, 20:28].all()


def test_too_few_or_flat_landmarks_are_refused(dome, rng):
    position, normal = dome
    covered = np.ones((SIZE, SIZE), bool)
    solid, flat = _landmarks(position, rng, count=5)
    with pytest.raises(PlacementError, match="expected at least"):
        place_texels(position, normal, covered, landmarks_mm=solid, landmarks_px=flat)
    solid, _ = _landmarks(position, rng)
    level = {name: (x, y, 0.0) for name, (x, y, _) in solid.items()}
    flat = {name: tuple(_pixel(np.array(p)).tolist()) for name, p in level.items()}
    with pytest.raises(PlacementError, match="coplanar"):
        place_texels(position, normal, covered, landmarks_mm=level, landmarks_px=flat)
