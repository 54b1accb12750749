"""The ball by its spots, and lights by theirs; spots are put where rays of a traced image go."""

import numpy as np
import pytest
from scipy.optimize import brentq, minimize
from scipy.stats import chi2

from capture.calibration.geometry.intrinsics import CameraPose
from capture.calibration.led_sphere.glass_ball import (
    BallError,
    BallPosition,
    GlassBall,
    find_spots,
    light_directions,
    locate_ball,
)
from capture.calibration.lights.reflection import mirror_lights
from capture.rig import load_rig

RIG = load_rig("gradient")
VIEW = RIG.view("cam")
CAMERA = CameraPose.nominal(VIEW)
PLACE = np.array([light.position_mm for light in RIG.lights])
DISTANCE = np.linalg.norm(PLACE, axis=1)
BEHIND = np.array([0.0, 0.0, -3.0])
TARGET = GlassBall(center_mm=(0.0, 0.0, -3.0))
ALARM = 1e-3


def seen(center_mm, places, radius_mm=6.0, camera=CAMERA):
    return mirror_lights(camera, np.asarray(center_mm, float), radius_mm, places).pixels


def sphere(rng, scatter_mm=1.5):
    return PLACE + scatter_mm * rng.standard_normal(PLACE.shape)


def directions_of(places):
    return places / np.linalg.norm(places, axis=1, keepdims=True)


def angle_deg(a, b):
    return np.degrees(np.linalg.norm(a - b, axis=1))


def test_spot_is_where_optical_path_is_stationary():
    """Fermat's principle knows no normals: the length of the way over the ball is least."""
    center, light = np.array([0.4, -0.3, -2.5]), PLACE[77]
    eye = CAMERA.center_mm

    def length(angles):
        a, b = angles
        n = np.array([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])
        point = center + 6.0 * n
        return np.linalg.norm(point - eye) + np.linalg.norm(light - point)

    start = [0.5 * np.arccos(light[2] / 600), np.arctan2(light[1], light[0])]
    a, b = minimize(length, start, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 0}).x
    point = center + 6.0 * np.array([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])
    np.testing.assert_allclose(seen(center, light[None])[0], CAMERA.project(point), atol=2e-3)


def test_ball_located_to_microns_by_millimeter_known_lights(rng):
    center, places = np.array([0.4, -0.3, -2.7]), sphere(rng)
    pixels = seen(center, places, 6.01) + 0.1 * rng.standard_normal(PLACE[:, :2].shape)
    fit = locate_ball(pixels, CAMERA, PLACE, TARGET, noise_px=0.1)
    np.testing.assert_array_equal(fit.spot, np.arange(len(PLACE)))
    gap = np.append(fit.ball.center_mm - center, fit.ball.radius_mm - 6.01)
    assert np.abs(gap[:2]).max() < 0.005
    assert gap @ np.linalg.solve(fit.ball.covariance_mm2, gap) < chi2.ppf(1 - ALARM, 4)
    assert fit.light_scatter_mm == pytest.approx(1.5, rel=0.3)


def test_directions_are_within_errors_and_beat_nominal(rng):
    center, places = np.array([-0.2, 0.5, -3.2]), sphere(rng)
    pixels = seen(center, places) + 0.05 * rng.standard_normal(PLACE[:, :2].shape)
    fit = locate_ball(pixels, CAMERA, PLACE, TARGET, noise_px=0.05)
    found = light_directions(CAMERA, fit.ball, pixels, np.full(len(PLACE), 0.05), DISTANCE)
    error = angle_deg(found.direction, directions_of(places))
    drawn = angle_deg(directions_of(PLACE), directions_of(places))
    assert np.median(error) < 0.03 < 0.15 < np.median(drawn)
    stated = np.degrees(np.sqrt(np.trace(found.covariance, axis1=1, axis2=2)))
    assert np.sqrt(np.mean((error / stated) ** 2)) < 2.5  # most of it is the ball's, in common
    # with the ball's true place what is left is each spot's own
    true = light_directions(
        CAMERA,
        BallPosition(center, 6.0, np.zeros((4, 4))),
        pixels,
        np.full(len(PLACE), 0.05),
        DISTANCE,
    )
    own = (true.direction - directions_of(places)) / np.sqrt(
        np.trace(true.covariance, axis1=1, axis2=2)
    )[:, None]
    low, high = chi2.ppf([ALARM / 2, 1 - ALARM / 2], 2 * len(PLACE))
    # distances are nominal: 1.5 mm of 600 tilt a direction by less than a tenth of its error
    assert low < 2 * np.sum(own**2) < 1.3 * high


def test_dead_lights_and_stray_spots_change_nothing(rng):
    center, places = np.array([0.4, -0.3, -2.7]), sphere(rng)
    dead = rng.choice(len(PLACE), 13, replace=False)
    pixels = np.delete(seen(center, places), dead, axis=0)
    stray = rng.uniform(100, 1900, (20, 2))
    fit = locate_ball(np.concatenate([stray, pixels]), CAMERA, PLACE, TARGET)
    alive = np.setdiff1d(np.arange(len(PLACE)), dead)
    np.testing.assert_array_equal(fit.spot[alive], 20 + np.arange(len(alive)))
    assert np.mean(fit.spot[dead] == -1) > 0.8  # a stray may lie where a dead light would
    assert np.abs(fit.ball.center_mm - center)[:2].max() < 0.01


def test_displaced_ball_is_found_and_spots_outside_known(rng):
    center, places = np.array([2.0, -0.5, -3.0]), sphere(rng)
    pixels = seen(center, places)
    inside = ((pixels > 0) & (pixels < 2047)).all(axis=1)
    assert 5 < np.sum(~inside) < 66
    fit = locate_ball(pixels[inside], CAMERA, PLACE, TARGET)
    assert np.abs(fit.ball.center_mm - center)[:2].max() < 0.01
    np.testing.assert_array_equal(fit.spot[inside], np.arange(inside.sum()))
    assert (fit.spot[~inside] == -1).all()
    assert fit.in_field[~inside].sum() == 0


def test_crop_showing_half_ball_is_refused_by_name(rng):
    small = CameraPose.nominal(RIG.cropped(512).view("cam"))
    pixels = seen(BEHIND, PLACE, camera=small)
    inside = ((pixels > 0) & (pixels < 511)).all(axis=1)
    with pytest.raises(BallError, match="can show only"):
        locate_ball(pixels[inside], small, PLACE, TARGET)
    half = CameraPose.nominal(RIG.cropped(1300).view("cam"))
    pixels = seen([3.2, 2.0, -3.0], PLACE, camera=half)
    inside = ((pixels > 0) & (pixels < 1299)).all(axis=1)
    assert 30 < inside.sum() < 66
    with pytest.raises(BallError, match="spots are in the field"):
        locate_ball(pixels[inside], half, PLACE, TARGET)


def test_missing_and_foreign_spots_are_refused_by_name(rng):
    with pytest.raises(BallError, match="no spot above the dark level"):
        locate_ball(np.zeros((0, 2)), CAMERA, PLACE, TARGET)
    with pytest.raises(BallError, match="lights' pattern"):
        locate_ball(rng.uniform(0, 2047, (100, 2)), CAMERA, PLACE, TARGET)


def test_an_image_of_noise_has_no_spots(rng):
    assert len(find_spots(rng.normal(0, 1e-3, (512, 512)), pixel_mm=0.006)) == 0


def test_spots_are_found_to_a_pixel(rng):
    image = rng.normal(0, 1e-3, (300, 400))
    places = np.array([[50.3, 60.8], [200.0, 150.5], [390.2, 20.1]])
    y, x = np.mgrid[:300, :400]
    for column, row in places:
        image += 0.05 * np.exp(-((x - column) ** 2 + (y - row) ** 2) / (2 * 3.0**2))
    found = find_spots(image, pixel_mm=0.006)
    assert len(found) == 3
    gaps = np.linalg.norm(found[:, None] - places[None], axis=-1)
    assert gaps.min(axis=0).max() < 1.5


def test_magnification_is_that_of_convex_mirror_on_axis():
    light = np.array([[0.0, 0.0, 600.0]])
    shown = mirror_lights(CAMERA, BEHIND, 6.0, light)
    # thin mirror of focal length R / 2: the image of a light s away stands f s / (s + f) behind
    behind = 3.0 * 597.0 / 600.0
    size = behind / 597.0  # mm of image for a mm of light
    per_mm = VIEW.focal_px / (300.0 - (3.0 - behind))
    np.testing.assert_allclose(shown.magnification_px2[0], (size * per_mm) ** 2, rtol=1e-4)


def test_mirrored_light_position_matches_surface_root_finder():
    """In the plane of camera, ball and light one angle decides; it is found by bisection."""
    light = np.array([400.0, 0.0, 447.0])
    eye = CAMERA.center_mm

    def miss(angle):
        n = np.array([np.sin(angle), 0.0, np.cos(angle)])
        point = BEHIND + 6.0 * n
        ways = [(p - point) / np.linalg.norm(p - point) for p in (eye, light)]
        return float(np.arccos(ways[0] @ n) - np.arccos(ways[1] @ n))

    angle = brentq(miss, 0.0, 1.0)
    point = BEHIND + 6.0 * np.array([np.sin(angle), 0.0, np.cos(angle)])
    np.testing.assert_allclose(seen(BEHIND, light[None])[0], CAMERA.project(point), atol=1e-6)
