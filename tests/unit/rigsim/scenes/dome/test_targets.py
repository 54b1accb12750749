import dataclasses

import cv2
import numpy as np
import pytest

from capture.rig import load_rig
from rigsim.as_built.dome import (
    DomeTolerances,
    build_dome,
    distort,
    pixel_corner_rays,
    project_points,
    undistort,
)
from rigsim.light.led_light import white_intensity
from rigsim.scenes.dome.targets import TARGET_POSES, TargetScene, make_target_scene, plate_normals
from rigsim.scenes.exposing import SceneError
from rigsim.sensor import vignetting_map
from rigsim.targets import mirror_ball, printed_plate

RIG = load_rig("dome").subset(views=["C07", "C10"]).resized(324)
FRONT = int(np.argmax([light.position_mm[2] for light in RIG.lights]))
EXACT = DomeTolerances(**{f.name: 0.0 for f in dataclasses.fields(DomeTolerances)})


@dataclasses.dataclass(frozen=True)
class Pulse:
    led: int
    level: float
    t_on_s: float
    t_off_s: float


def lit(*lights, seconds=1.0):
    on_s = np.zeros(len(RIG.lights))
    on_s[list(lights)] = seconds
    return on_s


def test_the_printed_bits_are_those_of_the_dictionary():
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for number, bits in enumerate(printed_plate.DICT_4X4_50):
        rows = cv2.aruco.Dictionary.getBitsFromByteList(
            dictionary.bytesList[number : number + 1], 4
        )
        assert int("".join(map(str, rows.ravel())), 2) == bits


def test_a_lens_bends_and_unbends(rng):
    lens = np.array([-0.2, 0.1, 0.002, -0.003, 0.02])
    slopes = rng.uniform(-0.25, 0.25, (40, 2))
    np.testing.assert_allclose(undistort(distort(slopes, lens), lens), slopes, atol=1e-12)
    view = RIG.views[0]
    corners = pixel_corner_rays(view, lens)
    middles = (corners[:-1, :-1] + corners[1:, 1:]) / 2
    places = np.array(view.position_mm) + 700.0 * middles
    rows, columns = np.mgrid[: view.height_px, : view.width_px]
    np.testing.assert_allclose(
        project_points(view, lens, places), np.stack([columns, rows], axis=-1), atol=1e-3
    )


def test_actual_dome_is_reproducible_and_near_nominal():
    whole, part = build_dome(load_rig("dome"), seed=4), build_dome(RIG, seed=4)
    assert whole.rig.view("C10").position_mm == part.rig.view("C10").position_mm
    assert whole.rig.light("L033") == part.rig.light("L033")
    shift = np.array(
        [
            np.subtract(a.position_mm, b.position_mm)
            for a, b in zip(whole.rig.lights, whole.nominal.lights, strict=True)
        ]
    )
    # 450 normal numbers of deviation 2.5: the root mean square is within 4.5 sigma of that
    assert np.sqrt(np.mean(shift**2)) == pytest.approx(2.5, rel=4.5 / np.sqrt(900))
    exact = build_dome(RIG, seed=4, tolerances=EXACT)
    assert exact.rig.views[0].position_mm == pytest.approx(RIG.views[0].position_mm)


def test_white_plate_follows_inverse_square_and_cosine():
    scene = TargetScene("white", build_dome(RIG, seed=1, tolerances=EXACT), seed=1, slope_deg=0.0)
    frontal = int(np.argmax([light.position_mm[2] for light in RIG.lights]))
    light = scene.light("C07", lit(frontal))
    rotation, place = scene.plate_pose(0)
    middle = rotation @ np.array([126.0, 99.0, 0.0]) + place
    column, row = project_points(RIG.view("C07"), np.zeros(5), middle).round().astype(int)
    to_light = np.array(RIG.lights[frontal].position_mm) - middle
    distance = np.linalg.norm(to_light)
    cosine = to_light @ -rotation[:, 2] / distance
    expected = 0.99 * white_intensity(RIG.lights[frontal], RIG.view("C07")) * cosine / distance**2
    np.testing.assert_allclose(light[row, column], expected, rtol=2e-3)
    twice = scene.light("C07", lit(frontal, seconds=2.0))
    np.testing.assert_allclose(twice, 2.0 * light, rtol=1e-6)


def test_plate_is_dark_from_behind_and_when_backlit():
    scene = TargetScene("white", build_dome(RIG, seed=1, tolerances=EXACT), seed=1)
    behind = int(np.argmin([light.position_mm[2] for light in RIG.lights]))
    assert scene.light("C07", lit(behind)).max() == 0.0
    scene.set_pose(6)  # turned to -105 degrees; the camera at +80 sees its back
    assert scene.light("C10", lit(*range(150))).max() == 0.0


def test_print_appears_at_its_position(rng):
    scene = make_target_scene("charuco", RIG, seed=2)
    view, lens = scene.rig.views[0], scene.dome.distortion["C07"]
    image = scene.light("C07", lit(*range(0, 150, 10)))[..., 1]
    rotation, place = scene.plate_pose(0)
    reflectance = printed_plate.charuco_board().reflectance
    rows, columns = np.nonzero(reflectance[1:-1, 1:-1] > 0)
    cells = np.column_stack([columns + 1, rows + 1])
    px = project_points(
        view, lens, np.column_stack([(cells + 0.5) * 4.5, 0 * rows]) @ rotation.T + place
    )
    seen = image[px[:, 1].round().astype(int), px[:, 0].round().astype(int)]
    light = reflectance[cells[:, 1], cells[:, 0]] > 0.5
    assert seen[light].min() > 2.0 * seen[~light].max()


def test_a_ball_shows_lights_where_angles_are_equal(rng):
    for _ in range(20):
        eye, lamp = (v / np.linalg.norm(v) * 700 for v in rng.standard_normal((2, 3)))
        ball = rng.uniform(-60, 60, 3)
        point = mirror_ball.reflection_point(eye, lamp, ball, 50.0)
        normal = (point - ball) / 50.0
        out, back = lamp - point, eye - point
        if back @ normal <= 0:
            continue
        out, back = out / np.linalg.norm(out), back / np.linalg.norm(back)
        assert out @ normal == pytest.approx(back @ normal, abs=1e-9)
        assert np.linalg.norm(np.cross(out + back, normal)) < 1e-9


def test_light_of_led_in_ball_is_conserved():
    """Flux of a highlight in closed form: a convex mirror of radius r shows a small distant disc of
    radiance L and radius a at d as an image that is smaller by about r / (2 d)."""
    scene = TargetScene("mirror", build_dome(RIG, seed=1, tolerances=EXACT), seed=1)
    view = RIG.view("C07")
    frontal = int(
        np.argmin(
            [
                np.linalg.norm(np.subtract(light.position_mm, view.position_mm))
                for light in RIG.lights
            ]
        )
    )
    image = scene.light("C07", lit(frontal))[..., 1].astype(float)
    ball = scene.ball_center_mm(0)
    eye, lamp = np.array(view.position_mm), np.array(RIG.lights[frontal].position_mm)
    point = mirror_ball.reflection_point(eye, lamp, ball, 50.0)
    column, row = project_points(view, np.zeros(5), point).round().astype(int)
    part = image[row - 4 : row + 5, column - 4 : column + 5]
    flux = (part - np.median(part)).sum()
    d = np.linalg.norm(lamp - point)
    magnification = 1.0 / (1.0 + 2.0 * d / 50.0)
    area_px = np.pi * (10.0 * magnification * view.focal_px / np.linalg.norm(eye - point)) ** 2
    strength = white_intensity(RIG.lights[frontal], view)[1]
    expected = mirror_ball.CHROMIUM_REFLECTANCE * strength / 10.0**2 * area_px
    # the image lies half a radius behind the surface and the angle is not quite 0
    assert flux == pytest.approx(expected, rel=0.15)


def test_frames_have_sensor_noise_and_follow_seed():
    scene = make_target_scene("white", RIG, seed=3)
    pops = [Pulse(FRONT, 1.0, 1.0, 1.03)]
    one = scene.exposure("C07", pops=pops, exposure_s=0.03, seed=1)
    assert (one == scene.exposure("C07", pops=pops, exposure_s=0.03, seed=1)).all()
    other = scene.exposure("C07", pops=pops, exposure_s=0.03, seed=2)
    view = RIG.view("C07")
    clean = scene.light("C07", lit(FRONT, seconds=0.03))[..., 1]
    clean = clean * vignetting_map(0.25, *clean.shape)
    bright = np.zeros(clean.shape, bool)
    bright[::2, 1::2] = clean[::2, 1::2] > 0.5 * clean.max()
    gap = (one.astype(float) - other)[bright]
    electrons = clean[bright].mean() * view.full_well_e
    expected = np.sqrt(2 * (electrons + view.read_noise_e**2)) / view.gain_e_per_dn
    # the pulses differ by 0.1 %, which shifts the mean, not the spread
    assert gap.std() == pytest.approx(expected, rel=4.5 / np.sqrt(2 * gap.size) + 0.02)


def test_dead_lights_are_dark_crossed_wires_light_others():
    straight = build_dome(RIG, seed=1)
    wiring = list(range(150))
    wiring[40], wiring[FRONT] = FRONT, 40
    crossed = dataclasses.replace(straight, wiring=tuple(wiring), dead=frozenset(["L040"]))
    pops = [Pulse(40, 1.0, 0.0, 0.03)]
    kind = {"exposure_s": 0.03, "seed": 1}
    a = TargetScene("white", crossed, seed=1).exposure("C07", pops=pops, **kind)
    b = TargetScene("white", straight, seed=1).exposure(
        "C07", pops=[Pulse(FRONT, 1.0, 0, 0.03)], **kind
    )
    assert (a == b).all()
    assert a.max() > 1000
    dark = TargetScene("white", crossed, seed=1).exposure(
        "C07", pops=[Pulse(FRONT, 1.0, 0, 1)], **kind
    )
    assert dark.max() < 64 + 10


def test_targets_that_do_not_exist_are_refused():
    with pytest.raises(SceneError, match="charuco, mirror, white"):
        make_target_scene("cube", RIG, seed=0)
    scene = make_target_scene("mirror", RIG, seed=0)
    with pytest.raises(SceneError, match="expected 0 to 3"):
        scene.set_pose(4)
    with pytest.raises(SceneError, match="level"):
        scene.exposure("C07", pops=[Pulse(0, 1.5, 0, 1)], exposure_s=1.0, seed=0)
    with pytest.raises(SceneError, match="no view 'C00'"):
        scene.light("C00", lit(0))
    assert len(plate_normals()) == TARGET_POSES["white"]
