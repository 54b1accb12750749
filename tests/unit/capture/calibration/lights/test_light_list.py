import dataclasses
import tracemalloc

import cv2
import numpy as np
import pytest

from capture.calibration.geometry.intrinsics import CameraPose, nominal_cameras
from capture.calibration.lights import light_fit, mirror_lights, mirror_sphere, reflection
from capture.calibration.lights.chrome_ball import ChromeBallError, directions_from_chrome_ball
from capture.calibration.lights.light_list import CameraResponse, LightTable
from capture.calibration.lights.mirror_sphere import MirrorSphereError, SpherePosition
from capture.calibration.lights.white_plate import PlateSamples, WhitePlate
from capture.rig import load_rig

DOME = load_rig("dome")
CAMERAS = nominal_cameras(DOME.subset(views=["C03", "C06", "C07", "C08", "C13"]))
RADIUS_MM = 50.0


def test_white_follows_inverse_square_lobe_and_axis():
    table = LightTable(
        np.array([[0.0, 0.0, 700.0]]), np.full((1, 3), 490_000.0), np.array([2.0]), ("a",)
    )
    points = [[0, 0, 0], [0, 0, 350], [350 * np.sqrt(3), 0, 350]]
    direction, white = table.irradiance(points)
    np.testing.assert_allclose(direction[0, 0], [0, 0, 1])
    # half the distance: four times; 60 degrees off the axis: cos^2 = 1/4, at the full distance
    np.testing.assert_allclose(white[0, :, 0], [1.0, 4.0, 0.25], rtol=1e-12)
    behind = table.irradiance([[0.0, 0.0, 900.0]])[1]
    assert behind.max() == 0.0
    with pytest.raises(ValueError, match="at a light"):
        table.irradiance(table.position_mm)


def test_the_nominal_table_is_that_of_the_rig():
    table = LightTable.nominal(DOME, white_per_s=12.0)
    _, white = table.irradiance([[0.0, 0.0, 0.0]])
    np.testing.assert_allclose(white, 12.0, rtol=1e-9)
    for k in (0, 77):
        half = np.radians(DOME.lights[k].half_intensity_deg)
        assert np.cos(half) ** table.exponent[k] == pytest.approx(0.5)
    assert table.valid.all()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("intensity", -np.ones((150, 3))),
        ("position_mm", np.zeros((3, 3))),
        ("valid", np.ones(2)),
        ("axis", np.zeros((150, 3))),
        ("names", ("L",) * 150),
    ],
)
def test_tables_that_contradict_themselves_are_refused(field, value):
    with pytest.raises(ValueError, match="LightTable"):
        dataclasses.replace(LightTable.nominal(DOME), **{field: value})


def test_a_response_falls_towards_the_corner():
    table = dataclasses.replace(
        LightTable.nominal(DOME),
        cameras={"S": CameraResponse(np.array([1.1, 1.0, 0.9]), np.array([-0.2, -0.05]))},
    )
    middle, corner = table.response("S", [[49.5, 39.5], [-0.5, 79.5]], (100, 80))
    np.testing.assert_allclose(middle, [1.1, 1.0, 0.9])
    np.testing.assert_allclose(corner, 0.75 * middle)
    np.testing.assert_allclose(table.response("other", [[0.0, 0.0]], (100, 80)), 1.0)


def test_reflections_obey_the_law_of_reflection(rng):
    camera = CAMERAS["C07"]
    center = np.array([20.0, -10.0, 5.0])
    lights = rng.standard_normal((60, 3))
    lights *= 700 / np.linalg.norm(lights, axis=1, keepdims=True)
    pixels = reflection.reflection_pixels(camera, center, RADIUS_MM, lights)
    seen = np.isfinite(pixels).all(axis=1)
    assert seen.sum() > 40
    point, direction, hit = reflection.reflect(camera, pixels[seen], center, RADIUS_MM)
    assert hit.all()
    np.testing.assert_allclose(np.linalg.norm(point - center, axis=1), RADIUS_MM, rtol=1e-9)
    expected = lights[seen] - point
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(direction, expected, atol=1e-7)


def test_outline_is_ellipse_with_center_off_middle():
    camera = CAMERAS["C07"]
    center = np.array([90.0, 60.0, 40.0])
    outline = mirror_sphere.contour(camera, center, RADIUS_MM, 180)
    rays = camera.rays(outline)
    to_center = center - camera.center_mm
    distance = np.linalg.norm(to_center)
    np.testing.assert_allclose(
        rays @ to_center / distance, np.sqrt(1 - (RADIUS_MM / distance) ** 2), rtol=1e-12
    )
    away = cv2.fitEllipse(outline.astype(np.float32))[0] - camera.project(center)
    assert np.linalg.norm(away) > 0.5
    place = mirror_sphere.locate_sphere({"C07": outline}, CAMERAS, RADIUS_MM)
    np.testing.assert_allclose(place.center_mm, center, atol=1e-5)
    with pytest.raises(MirrorSphereError, match="inside"):
        mirror_sphere.contour(camera, camera.center_mm + 10.0, RADIUS_MM, 10)


def test_sphere_is_located_within_errors_wrong_radius_detected(rng):
    center = np.array([-60.0, 30.0, 10.0])
    squares = 0.0
    for _ in range(8):
        outlines = {
            name: mirror_sphere.contour(camera, center, RADIUS_MM, 120)
            + 0.1 * rng.standard_normal((120, 2))
            for name, camera in CAMERAS.items()
        }
        place = mirror_sphere.locate_sphere(outlines, CAMERAS, RADIUS_MM)
        gap = place.center_mm - center
        squares += gap @ np.linalg.solve(place.covariance_mm2, gap)
    # chi-square of 24 degrees of freedom, false alarm 1e-3 on each side
    assert 8.5 < squares < 51.2
    with pytest.raises(
        MirrorSphereError, match=r"got 50.5, but the outlines in 5 cameras give 50\.0"
    ):
        mirror_sphere.locate_sphere(outlines, CAMERAS, 1.01 * RADIUS_MM)


def lights_and_highlights(rng, sigma_px, *, views=tuple(CAMERAS), count=20):
    lights = {light.name: np.array(light.position_mm) for light in DOME.lights[:150:7][:count]}
    true = {name: place + rng.normal(0, 2.5, 3) for name, place in lights.items()}
    spheres, seen = {}, []
    for number, center in enumerate([[-85.0, 45, 30], [85.0, -45, -30], [0.0, 0, 20]]):
        spheres[number] = SpherePosition(
            np.array(center) + rng.normal(0, 0.01, 3),
            RADIUS_MM,
            1e-4 * np.eye(3),
            0.1,
            50.0,
            0.01,
            views,
        )
        for view in views:
            pixels = reflection.reflection_pixels(
                CAMERAS[view], np.array(center), RADIUS_MM, np.array(list(true.values()))
            )
            good = np.isfinite(pixels).all(axis=1)
            pixels = pixels[good] + sigma_px * rng.standard_normal((good.sum(), 2))
            order = rng.permutation(len(pixels))
            seen.append(mirror_lights.Highlights(view, number, tuple(lights), pixels[order]))
    return lights, true, spheres, seen


def test_lights_are_placed_within_their_errors(rng):
    squares, degrees = 0.0, 0
    for _ in range(3):
        lights, true, spheres, seen = lights_and_highlights(rng, 0.05)
        found = mirror_lights.locate_lights(seen, CAMERAS, spheres, lights)
        assert found.unobserved == ()
        for k, name in enumerate(found.names):
            if found.valid[k]:
                # one direction each: lights share the errors of the spheres' centres
                direction = rng.standard_normal(3)
                gap = (found.position_mm[k] - true[name]) @ direction
                squares += gap**2 / (direction @ found.covariance_mm2[k] @ direction)
                degrees += 1
    from scipy.stats import chi2

    assert degrees >= 50
    assert chi2.ppf(5e-4, degrees) < squares < chi2.ppf(1 - 5e-4, degrees)


def test_lights_visible_to_single_camera_keep_nominal_flagged(rng):
    lights, _, spheres, seen = lights_and_highlights(rng, 0.05)
    name = next(iter(lights))
    kept = []
    for shot in seen:
        miss = mirror_lights._ray_distance_mm(
            CAMERAS[shot.view], spheres[shot.sphere], shot.pixels, np.array([lights[name]])
        )[:, 0]
        pixels = shot.pixels if shot.view == "C07" else shot.pixels[miss > 40.0]
        kept.append(dataclasses.replace(shot, pixels=pixels))
    found = mirror_lights.locate_lights(kept, CAMERAS, spheres, lights)
    assert not found.valid[0]
    assert found.cameras[0] == 1
    np.testing.assert_array_equal(found.position_mm[0], lights[name])
    assert found.valid[1:].sum() > 10
    one = [shot for shot in seen if shot.view == "C07"]
    with pytest.raises(MirrorSphereError, match="no light was observed by 2 cameras"):
        mirror_lights.locate_lights(one, CAMERAS, spheres, lights)


def test_sparse_sightings_follow_nominal_given_tolerance(rng):
    lights, true, spheres, seen = lights_and_highlights(rng, 0.6)
    free = mirror_lights.locate_lights(seen, CAMERAS, spheres, lights)
    held = mirror_lights.locate_lights(seen, CAMERAS, spheres, lights, nominal_stderr_mm=2.5)

    def error(found):
        gap = found.position_mm - np.array(list(true.values()))
        return np.sqrt(np.mean(gap[free.valid & held.valid] ** 2))

    assert error(held) < error(free)
    assert (held.stderr_mm[held.valid] <= 2.5).all()


def plate_samples(rng, table, *, poses, gains, noise):
    plate = WhitePlate()
    low, high = plate.bare_mm
    x, y = np.meshgrid(np.linspace(low[0], high[0], 6), np.linspace(low[1], high[1], 4))
    flat = np.column_stack([x.ravel(), y.ravel(), np.zeros(24)]) - [126.0, 99.0, 0.0]
    rows = []
    for turn in poses:
        rotation = cv2.Rodrigues(np.array([0.0, np.radians(turn), 0.0]))[0] @ np.diag([1.0, -1, -1])
        points = flat @ rotation.T
        shapes = light_fit._shapes(table, points, np.tile(-rotation[:, 2], (24, 1)))
        for view, gain in gains.items():
            pixels = CAMERAS[view].project(points)
            for k, name in enumerate(table.names):
                white = 0.99 * gain * shapes[k][:, None] * table.intensity[k]
                signal = 0.05 * white * (1 + noise * rng.standard_normal(white.shape))
                rows.append(
                    PlateSamples(
                        view,
                        name,
                        0.05,
                        rotation,
                        np.arange(24),
                        points,
                        pixels,
                        signal,
                        (noise * white * 0.05) ** 2 + 1e-12,
                    )
                )
    return rows


def some_lights(rng):
    table = LightTable.nominal(DOME.subset(lights=[light.name for light in DOME.lights[10:130:9]]))
    power = np.exp(0.1 * rng.standard_normal((len(table.names), 1)))
    return dataclasses.replace(table, intensity=12.0 * power * table.intensity)


def test_powers_and_gains_are_separated(rng):
    table = some_lights(rng)
    gains = {"C06": 1.02, "C07": 1.0, "C08": 1 / 1.02}
    samples = plate_samples(rng, table, poses=(0, 60, -60), gains=gains, noise=1e-3)
    fit = light_fit.fit_lights(samples, table, CAMERAS)
    kept = fit.table.valid
    assert kept.sum() >= 8
    np.testing.assert_allclose(fit.table.intensity[kept], table.intensity[kept], rtol=2e-3)
    for view, gain in gains.items():
        np.testing.assert_allclose(fit.table.cameras[CAMERAS[view].serial].gain, gain, rtol=1e-3)
    assert (fit.dead, fit.swapped) == ((), {})


def test_a_shading_that_is_anothers_is_named(rng):
    table = some_lights(rng)
    gains = {"C07": 1.0}
    samples = plate_samples(rng, table, poses=(0, 60, -60), gains=gains, noise=1e-2)
    a, b, off = (table.names[k] for k in np.nonzero(table.position_mm[:, 2] > 100)[0][:3])
    names = {a: b, b: a}
    crossed = [dataclasses.replace(s, light=names.get(s.light, s.light)) for s in samples]
    dark = [
        dataclasses.replace(s, signal=1e-6 * rng.standard_normal(s.signal.shape))
        if s.light == off
        else s
        for s in crossed
    ]
    answers, dead = light_fit.find_swapped_lights(dark, table)
    assert answers == names
    assert dead == (off,)
    assert light_fit.find_swapped_lights(samples, table) == ({}, ())


def test_chrome_ball_photographs_give_the_list_of_lights(test_data):
    """The list was made from the whole ball, a dim window at its left edge with it: its directions
    lean there, most in the image with the darkest highlight (8 degrees). The mean is judged."""
    folder = test_data / "photometric_stereo"
    images = [cv2.imread(str(folder / "chrome" / f"chrome.{k}.png")) for k in range(12)]
    mask = cv2.imread(str(folder / "chrome" / "chrome.mask.png"))
    found = directions_from_chrome_ball(images, mask)
    listed = np.loadtxt(folder / "lights.txt", skiprows=1)
    angle = np.degrees(np.arccos(np.clip(np.sum(found * listed, axis=1), -1, 1)))
    assert angle.mean() < 3.5
    upside_down = np.degrees(np.arccos(np.clip(np.sum(found * listed * [1, -1, 1], axis=1), -1, 1)))
    assert upside_down.mean() > 20.0


def test_balls_without_highlight_are_named():
    y, x = np.mgrid[:81, :81] - 40
    ball = x**2 + y**2 <= 30**2
    spot = np.exp(-((x - 10) ** 2 + y**2) / 4.0)
    with pytest.raises(ChromeBallError, match="image 1: shows no highlight"):
        directions_from_chrome_ball([spot, np.ones((81, 81))], ball)
    with pytest.raises(ChromeBallError, match=r"expected .81, 81. as the mask"):
        directions_from_chrome_ball([np.ones((5, 5))], ball)
    with pytest.raises(ChromeBallError, match="mask: got 0 pixels"):
        directions_from_chrome_ball([spot], np.zeros((81, 81)))


def test_camera_at_own_origin_projects_to_image_middle():
    camera = CameraPose(
        "x", np.diag([500.0, 500.0, 1.0]), np.zeros(5), np.eye(3), np.zeros(3), (8, 6)
    )
    np.testing.assert_allclose(camera.project([0.0, 0.0, 10.0]), [0.0, 0.0])


def chrome_images(test_data):
    folder = test_data / "photometric_stereo" / "chrome"
    images = [cv2.imread(str(folder / f"chrome.{k}.png"), 0) for k in range(12)]
    return images, cv2.imread(str(folder / "chrome.mask.png"), 0) > 127


@pytest.mark.long
def test_stray_pixel_of_ball_mask_changes_nothing(test_data):
    images, mask = chrome_images(test_data)
    stray = mask.copy()
    stray[2, 500] = True
    found = directions_from_chrome_ball(images, stray)
    np.testing.assert_array_equal(found, directions_from_chrome_ball(images, mask))


def test_outline_of_large_ball_needs_little_memory():
    """A ball that fills the image: all circles at once took 1.9 GB."""
    y, x = np.mgrid[:240, :240] - 120
    ball = x**2 + y**2 <= 100**2
    spot = np.exp(-((x - 15) ** 2 + y**2) / 4.0) + 0.05 * ball
    tracemalloc.start()
    directions_from_chrome_ball([spot], ball)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6


@pytest.mark.long
def test_wrong_ball_masks_are_refused(test_data):
    images, mask = chrome_images(test_data)
    half = mask.copy()
    half[148:] = False
    two = mask | np.roll(mask, 250, axis=1)
    for wrong, message in (
        (half, "overlaps a disc of its area by 64%"),
        (two, "apart from the largest part"),
        (np.roll(mask, 8, axis=1), "-8 px to the right and [-+]0 px up"),
        (np.roll(mask, 20, axis=1), "-20 px to the right and [-+]0 px up"),
        (np.roll(mask, (14, -14), axis=(0, 1)), "[+]14 px to the right and [+]14 px up"),
    ):
        with pytest.raises(ChromeBallError, match=message):
            directions_from_chrome_ball(images, wrong)
