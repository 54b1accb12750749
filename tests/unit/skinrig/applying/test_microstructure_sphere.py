"""The sphere of Nagano2015 fig. 5: grown is smoother, shrunk rougher, squashed has a direction."""

import numpy as np
import pytest

from model.displacement_synthesis.volume_noise import VolumeNoise
from rigsim.skin_patch.microrelief import make_micro_skin
from skinrig.applying import microstructure_sphere as spheres
from skinrig.applying.microstructure_sphere import (
    DEFORMATION_RATIOS,
    ROUGHNESS_POINTS,
    Sphere,
    SphereError,
)

SPHERE = Sphere(texels=400, radius_mm=1.95)


NOISE = VolumeNoise.draw(
    rms_um=6.0, band_per_mm=(2.0, 16.0), waves=512, rng=np.random.default_rng(0)
)


@pytest.fixture(scope="module")
def relief():
    return SPHERE.sample_noise_relief(NOISE)


@pytest.fixture(scope="module")
def states(relief):
    """Spheres by name, with relief that follows and with relief that does not."""
    return {
        (name, dynamic): spheres.deform(SPHERE, relief, ratios, dynamic=dynamic)
        for name, ratios in DEFORMATION_RATIOS.items()
        for dynamic in (True, False)
    }


def test_chart_pixel_lengths_match_distance_on_sphere():
    points, pixel = SPHERE.points_mm(), SPHERE.pixel_um()
    np.testing.assert_allclose(np.linalg.norm(points, axis=-1), 1.95)
    for axis in (0, 1):
        steps = 1e3 * np.linalg.norm(np.diff(points, axis=axis), axis=-1)
        part = pixel[:-1] if axis == 0 else pixel[:, :-1]
        np.testing.assert_allclose(steps, part, rtol=5e-3)
    assert points[0, 200, 1] > 1.5
    assert points[200, -1, 0] > 1.5


def test_the_neutral_sphere_keeps_every_height(states, relief):
    np.testing.assert_array_equal(states["neutral", True].height_um, relief)


def test_noise_has_the_slopes_of_its_spectrum_everywhere(states):
    """Differences over two pixels p have the variance (C(0) - C(2 p)) / (2 p^2). On all places
    alike: no seam, no pole. Tolerance 20 %: some hundred grains a place."""
    neutral = states["neutral", True]
    for place, direction in ROUGHNESS_POINTS.items():
        near = SPHERE.points_mm() @ np.asarray(direction) > 1.95 * np.cos(0.4)
        p = 1e-3 * SPHERE.pixel_um()[near].mean()
        expected = (NOISE.covariance(0.0) - NOISE.covariance(2 * p)) / (2 * (1e3 * p) ** 2)
        for variance in neutral.roughness(place, within_rad=0.4):
            assert abs(variance / expected - 1.0) < 0.2


@pytest.mark.parametrize(("name", "sign"), [("shrunk", 1.0), ("grown", -1.0)])
def test_shrunk_skin_roughens_and_grown_smooths_beyond_stretch(states, name, sign):
    """In both directions alike, at all places; and more than unchanged heights would be."""
    neutral, moved, fixed = states["neutral", True], states[name, True], states[name, False]
    for place in ROUGHNESS_POINTS:
        for before, after, unchanged in zip(
            *(one.roughness(place) for one in (neutral, moved, fixed)), strict=True
        ):
            assert sign * np.log(after / before) > 0.2
            assert sign * np.log(after / unchanged) > 0.1
        assert abs(np.log(np.divide(*moved.roughness(place)))) < 0.4


def test_unchanged_heights_get_slopes_by_the_inverse_ratio(states):
    neutral, fixed = states["neutral", True], states["grown", False]
    np.testing.assert_allclose(
        fixed.roughness("front"), np.divide(neutral.roughness("front"), 1.25**2), rtol=1e-4
    )


def test_squashed_sphere_is_smooth_along_and_rough_across(states, relief):
    """At the front s lies along x and t along y, with the ratios of the squash."""
    moved, fixed = states["squashed", True], states["squashed", False]
    middle = SPHERE.texels // 2
    np.testing.assert_allclose(moved.strain.stretch[middle, middle], (1.25, 0.8), atol=2e-3)
    np.testing.assert_allclose(np.abs(moved.strain.axes[middle, middle]), np.eye(2), atol=0.05)
    along, across = moved.roughness("front")
    assert across / along > 1.2 * np.divide(*fixed.roughness("front")[::-1])
    swapped = spheres.deform(SPHERE, relief, (0.8, 1.25, 1.0))
    np.testing.assert_allclose(
        np.abs(swapped.strain.axes[middle, middle]), np.eye(2)[::-1], atol=0.05
    )


def test_grown_patches_keep_their_slopes_over_the_chart(rng):
    """Pixels differ by a factor of two between the middle and the rim. Tolerance 20 %: some
    twenty polygons a place."""
    skin = make_micro_skin("cheek", seed=1, size_mm=4.0, texel_um=16.0)
    patch = skin.height_um - skin.height_um.mean()
    relief = SPHERE.grow_relief([patch], patch_pixel_um=16.0, rng=rng)
    neutral = spheres.deform(SPHERE, relief, DEFORMATION_RATIOS["neutral"])
    found = [sum(neutral.roughness(place, within_rad=0.4)) for place in ROUGHNESS_POINTS]
    assert max(found) / min(found) < 1.4


def test_grown_sphere_is_shinier_in_its_image(states):
    """The highlight of a smoother surface is brighter and smaller."""
    peaks = {}
    for name in ("shrunk", "neutral", "grown"):
        picture = states[name, True].render(size_px=64)
        assert np.isfinite(picture).all()
        assert picture[0, 0] == 0.0
        peaks[name] = np.sort(picture.ravel())[-20:].mean()
    assert peaks["shrunk"] < peaks["neutral"] < peaks["grown"]


def test_highlight_is_on_light_side():
    flat = np.zeros((400, 400), np.float32)
    picture = spheres.deform(SPHERE, flat, (1, 1, 1)).render(size_px=65, light=(0.5, 0.5, 0.7))
    row, column = np.unravel_index(picture.argmax(), picture.shape)
    half = np.array([0.5, 0.5, 0.7]) / np.linalg.norm([0.5, 0.5, 0.7]) + [0, 0, 1]
    half /= np.linalg.norm(half)
    assert abs(column - (32 + 32.5 * half[0] / 1.3)) < 2
    assert abs(row - (32 - 32.5 * half[1] / 1.3)) < 2


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sphere(radius_mm=0.0), "radius_mm"),
        (lambda: Sphere(texels=4), "texels"),
        (lambda: spheres.deform(SPHERE, np.zeros((4, 4)), (1, 1, 1)), "height_um: got shape"),
        (lambda: spheres.deform(SPHERE, np.zeros((400, 400)), (1, 1)), "ratios"),
        (lambda: spheres.deform(SPHERE, np.zeros((400, 400)), (1, 0, 1)), "ratios"),
        (lambda: spheres.deform(SPHERE, np.zeros((400, 400)), (1, 1, 1)).roughness("x"), "site"),
        (
            lambda: spheres.deform(SPHERE, np.zeros((400, 400)), (1, 1, 1)).roughness(
                "top", within_rad=1.0
            ),
            "within_rad",
        ),
    ],
)
def test_non_sphere_is_refused_by_name(make, message):
    with pytest.raises(SphereError, match=message):
        make()
