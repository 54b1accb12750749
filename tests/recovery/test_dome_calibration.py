"""The dome's truth is found again by calibration from simulated targets, within stated errors.

The frames are made by `rigsim.scenes.dome.targets`: its own rays, its own texture, sensor noise and
color filters. Estimators see raw frames only.
"""

import dataclasses
from datetime import date

import numpy as np
import pytest
from scipy.stats import chi2

from capture.calibration import geometry, store
from capture.calibration.geometry import CameraPose, bundle
from capture.calibration.geometry.board import Board, find_board
from capture.calibration.geometry.bundle_equations import LensPrior
from capture.calibration.lights import LightTable, light_fit, mirror_lights, mirror_sphere
from capture.calibration.lights.white_plate import PlateWindow, WhitePlate
from capture.calibration.sensor.mosaic import channel_levels, neutral_mosaic
from capture.raw import RawFrame, linear_rgb
from capture.rig import load_rig
from rigsim.as_built.dome import DomeTolerances, build_dome, project_points
from rigsim.scenes.dome.targets import make_target_scene
from rigsim.sensor import make_sensor, vignetting_map

pytestmark = pytest.mark.long

ALARM = 1e-3  # false alarm rate of each chi-square
BOARD = Board.of(("charuco", 7, 5, "4X4_50"), square_mm=36.0)
PLATE = WhitePlate()


@dataclasses.dataclass(frozen=True)
class Pulse:
    led: int
    level: float
    t_on_s: float
    t_off_s: float


def shot(scene, view_name, lights, *, exposure_s, level=1.0, seed=0):
    """Take a raw frame with some lights on."""
    view = scene.rig.view(view_name)
    pops = [Pulse(k, level, 0.0, exposure_s) for k in lights]
    cfa = scene.exposure(view_name, pops=pops, exposure_s=exposure_s, seed=seed)
    return RawFrame(
        cfa=cfa,
        pattern=view.cfa,
        black=(float(view.black_level),) * 4,
        white=view.white_level,
        noise_profile=make_sensor(view).noise_profile(exposure_s),
    )


def true_camera(dome, name):
    """The camera as it stands, in the estimators' words."""
    camera = CameraPose.nominal(dome.rig.view(name))
    return dataclasses.replace(camera, distortion=dome.distortion[name])


def small(views, *, lights=None, width_px=324):
    dome = load_rig("dome")
    names = None if lights is None else [light.name for light in dome.lights][:: 150 // lights]
    return dome.subset(views=views, lights=names).resized(width_px)


def boards_seen(scene, poses):
    sightings = {}
    lights = range(0, len(scene.rig.lights), 8)
    for pose in poses:
        scene.set_pose(pose)
        for view in scene.rig.views:
            frame = shot(scene, view.name, lights, exposure_s=0.02, seed=pose)
            found = find_board(linear_rgb(frame, demosaic="bilinear").rgb, BOARD)
            if found is not None:
                sightings[view.name, pose] = found
    return sightings


PROBES_MM = np.random.default_rng(8).uniform(-70, 70, (300, 3))


def reprojection_px(camera, dome, name):
    """How far from the truth a camera puts points where the face will be, mean, px."""
    truth = project_points(dome.rig.view(name), dome.distortion[name], PROBES_MM)
    return float(np.linalg.norm(camera.project(PROBES_MM) - truth, axis=-1).mean())


@pytest.fixture(scope="module")
def geometry_of_dome():
    rig = small(["C03", "C05", "C07", "C10", "C11", "C14"])
    dome = build_dome(rig, seed=11, tolerances=DomeTolerances(distortion=0.3))
    scene = make_target_scene("charuco", rig, seed=11, dome=dome)
    sightings = boards_seen(scene, range(12))
    return rig, dome, sightings, bundle.adjust(sightings, BOARD, geometry.nominal_cameras(rig))


def test_cameras_found_within_third_pixel_with_unknown_lens(geometry_of_dome):
    rig, dome, sightings, found = geometry_of_dome
    errors = {name: reprojection_px(c, dome, name) for name, c in found.cameras.items()}
    assert max(errors.values()) < 0.3
    assert found.sigma_px < 0.3
    # it could have failed: the nominal cameras, and cameras without distortion, do
    nominal = geometry.nominal_cameras(rig)
    assert min(reprojection_px(nominal[name], dome, name) for name in nominal) > 0.5
    blind = LensPrior(k1=0.0, k2=0.0, tangential=0.0)
    without = bundle.adjust(sightings, BOARD, nominal, prior=blind)
    assert max(without.rms_px.values()) > max(found.rms_px.values())
    assert without.sigma_px > 1.2 * found.sigma_px


def test_camera_errors_are_as_large_as_stated(geometry_of_dome):
    _, dome, _, found = geometry_of_dome
    squares = []
    for name, camera in found.cameras.items():
        gap = camera.center_mm - dome.rig.view(name).position_mm
        squares.append(gap @ np.linalg.solve(found.center_covariance_mm2[name], gap))
    degrees = 3 * len(squares)
    assert np.sum(squares) < chi2.ppf(1 - ALARM, degrees)
    assert np.sum(squares) > chi2.ppf(ALARM, degrees)


def test_a_moved_camera_is_named_from_new_images(geometry_of_dome):
    rig, dome, _, found = geometry_of_dome
    view = dome.rig.view("C07")
    # without a turn; a camera that still looked at the same point would show nearly the same
    places = {
        field: tuple(np.add(getattr(view, field), (3.0, 0.0, 0.0)).tolist())
        for field in ("position_mm", "target_mm")
    }
    moved = dataclasses.replace(view, **places)
    views = tuple(moved if v.name == "C07" else v for v in dome.rig.views)
    after = dataclasses.replace(dome, rig=dataclasses.replace(dome.rig, views=views))
    poses = (0, 1, 2, 4, 5)
    seen = boards_seen(make_target_scene("charuco", rig, seed=12, dome=after), poses)
    assert [m.name for m in bundle.find_moved_cameras(seen, BOARD, found.cameras)] == ["C07"]
    same = boards_seen(make_target_scene("charuco", rig, seed=13, dome=dome), poses)
    assert bundle.find_moved_cameras(same, BOARD, found.cameras) == ()


def mirrors_seen(dome, rig, spheres, *, groups, radius_mm=50.0):
    """Outlines, places and highlights of balls, with the true cameras."""
    scene = make_target_scene("mirror", rig, seed=5, dome=dome)
    cameras = {view.name: true_camera(dome, view.name) for view in rig.views}
    every = range(len(rig.lights))
    places, seen = {}, []
    for number in range(spheres):
        scene.set_pose(number)
        outlines, colors = {}, {}
        for k, name in enumerate(cameras):
            frame = shot(scene, name, every, exposure_s=0.06, seed=100 * number + k)
            colors[name] = channel_levels(frame)
            image = neutral_mosaic(frame, colors[name])
            outlines[name] = mirror_sphere.find_outline(image, cameras[name], radius_mm)
        outlines = {name: edges for name, edges in outlines.items() if edges is not None}
        places[number] = mirror_sphere.locate_sphere(
            outlines, cameras, radius_mm, check_radius=False
        )
        for name in cameras:
            window = mirror_lights.SphereWindow.of(cameras[name], places[number])
            for group in range(groups):
                lit = every[group::groups]
                frame = shot(scene, name, lit, exposure_s=0.012, level=0.002, seed=group)
                spots = mirror_lights.find_highlights(neutral_mosaic(frame, colors[name]), window)
                names = tuple(rig.lights[i].name for i in lit)
                seen.append(mirror_lights.Highlights(name, number, names, spots))
    return scene, cameras, places, seen


def nominal_places(rig):
    return {light.name: np.array(light.position_mm) for light in rig.lights}


@pytest.fixture(scope="module")
def mirrors():
    rig = small(["C01", "C05", "C07", "C10", "C14"], lights=15, width_px=650)
    dome = build_dome(rig, seed=3)
    return rig, dome, mirrors_seen(dome, rig, 3, groups=3)


def test_balls_are_found_by_their_perspective_outlines(mirrors):
    _, _, (scene, _, places, _) = mirrors
    for number, place in places.items():
        gap = place.center_mm - scene.ball_center_mm(number)
        assert np.linalg.norm(gap) < 0.02
        assert len(place.cameras) >= 3
        assert place.fitted_radius_mm == pytest.approx(50.0, abs=0.03)


def test_lights_are_located_within_two_millimeters_with_errors(mirrors):
    rig, _, (scene, cameras, places, seen) = mirrors
    found = mirror_lights.locate_lights(seen, cameras, places, nominal_places(rig))
    gap = found.position_mm - scene.truth()["position_mm"]
    assert found.valid.sum() >= 13
    kept = np.nonzero(found.valid)[0]
    distance = np.linalg.norm(gap[kept], axis=1)
    assert np.median(distance) < 1.0
    assert np.mean(distance < 2.0) > 0.85
    squares = [gap[k] @ np.linalg.solve(found.covariance_mm2[k], gap[k]) for k in kept]
    degrees = 3 * len(kept)
    assert np.sum(squares) < chi2.ppf(1 - ALARM, degrees)
    assert np.sum(squares) > chi2.ppf(ALARM, degrees)
    # the drawing is farther off than what was found
    drawn = np.array(list(nominal_places(rig).values())) - scene.truth()["position_mm"]
    assert np.median(np.linalg.norm(drawn, axis=1)) > 2.5


def test_radius_error_of_percent_is_refused_misplaces_lights(mirrors):
    rig, dome, _ = mirrors
    scene, cameras, places, seen = mirrors_seen(dome, rig, 2, groups=3, radius_mm=50.5)
    found = mirror_lights.locate_lights(seen, cameras, places, nominal_places(rig))
    gap = np.linalg.norm(found.position_mm - scene.truth()["position_mm"], axis=1)
    assert np.median(gap[found.valid]) > 2.0
    scene.set_pose(0)
    edges = {}
    for name, camera in cameras.items():
        frame = shot(scene, name, range(len(rig.lights)), exposure_s=0.06)
        image = neutral_mosaic(frame, channel_levels(frame))
        edges[name] = mirror_sphere.find_outline(image, camera, 50.5)
    edges = {name: e for name, e in edges.items() if e is not None}
    with pytest.raises(
        mirror_sphere.MirrorSphereError, match=r"radius_mm: got 50.5, but .* give 50\.0"
    ):
        mirror_sphere.locate_sphere(edges, cameras, 50.5)


def test_swapped_and_dead_lights_are_identified_by_balls():
    rig = small(["C05", "C07", "C14"], lights=12)
    straight = build_dome(rig, seed=6)
    wiring = list(range(len(rig.lights)))
    front = [k for k in wiring if rig.lights[k].position_mm[2] > 100]
    a, b, dead = front[0], front[1], front[2]
    wiring[a], wiring[b] = b, a
    dome = dataclasses.replace(
        straight, wiring=tuple(wiring), dead=frozenset([rig.lights[dead].name])
    )
    scene, cameras, places, seen = mirrors_seen(dome, rig, 2, groups=len(rig.lights))
    found = mirror_lights.locate_lights(seen, cameras, places, nominal_places(rig))
    names = [light.name for light in rig.lights]
    assert found.swapped == {names[a]: names[b], names[b]: names[a]}
    assert found.unobserved == (names[dead],)
    assert not found.valid[dead]
    truth = scene.truth()["position_mm"]
    assert np.linalg.norm(found.position_mm[a] - truth[b]) < 20.0


def plates_seen(dome, rig, poses, *, exposure_s=0.03):
    scene = make_target_scene("white", rig, seed=9, dome=dome)
    cameras = {view.name: true_camera(dome, view.name) for view in rig.views}
    samples = []
    for pose in poses:
        scene.set_pose(pose)
        markers = {}
        for name in cameras:
            frame = shot(scene, name, range(0, len(rig.lights), 2), exposure_s=0.02, seed=pose)
            sighting = PLATE.find(linear_rgb(frame, demosaic="bilinear").rgb)
            if sighting is not None:
                markers[name, pose] = sighting
        place = bundle.estimate_board_pose(markers, PLATE, cameras, pose)
        for name in cameras:
            window = PlateWindow.of(cameras[name], place, PLATE)
            for k, light in enumerate(rig.lights) if window is not None else ():
                frame = shot(scene, name, [k], exposure_s=exposure_s, seed=100 * pose + k)
                image = linear_rgb(frame, demosaic="centered")
                samples.append(
                    window.sample(
                        image.rgb,
                        image.variance,
                        image.valid,
                        view=name,
                        light=light.name,
                        on_s=exposure_s,
                    )
                )
    return scene, cameras, samples


def at_true_places(rig, scene):
    truth = scene.truth()
    nominal = LightTable.nominal(rig)
    return dataclasses.replace(nominal, position_mm=truth["position_mm"], axis=None)


@pytest.fixture(scope="module")
def plates():
    rig = small(["C03", "C07", "C11", "C14"], lights=15)
    dome = build_dome(rig, seed=7)
    return rig, dome, plates_seen(dome, rig, (0, 1, 2))


def test_intensities_gains_and_lobes_match_within_errors(plates):
    rig, dome, (scene, cameras, samples) = plates
    fit = light_fit.fit_lights(samples, at_true_places(rig, scene), cameras)
    truth = scene.truth()
    common = np.exp(np.mean([np.log(dome.gain[view.name]) for view in rig.views]))
    kept = fit.table.valid
    assert kept.sum() >= 9
    error = fit.table.intensity[kept] / (truth["intensity"][kept] * common) - 1
    relative = fit.table.intensity_stderr[kept] / fit.table.intensity[kept]
    assert np.abs(error).max() < 0.005
    assert relative.max() < 0.005
    pulls = (error / relative).mean(axis=1)  # channels share the plate's and the pulses' errors
    assert np.sum(pulls**2) < chi2.ppf(1 - ALARM, kept.sum())
    lobes = (fit.table.exponent - truth["exponent"])[kept] / fit.table.exponent_stderr[kept]
    assert np.sum(lobes**2) < chi2.ppf(1 - ALARM, kept.sum())
    for view in rig.views:
        response = fit.table.cameras[view.serial]
        gap = response.gain / (dome.gain[view.name] / common) - 1
        assert np.abs(gap).max() < 0.005
        # half way to the corner's square; the plate does not reach the corner itself
        half = 1 + response.vignetting @ [0.5, 0.25]
        truth_there = vignetting_map(0.25, 101, 101)[50, round(50 + 50 * 0.5**0.5 * 2**0.5)]
        assert half == pytest.approx(float(truth_there), abs=0.01)
    points = np.random.default_rng(1).uniform(-80, 80, (100, 3))
    exact = LightTable(
        truth["position_mm"],
        truth["intensity"] * common,
        truth["exponent"],
        fit.table.names,
        truth["axis"],
    )
    ratio = fit.table.irradiance(points)[1][kept] / exact.irradiance(points)[1][kept]
    assert np.sqrt(np.mean((ratio - 1) ** 2)) < 0.005
    # it could have failed: without the lights' own powers, irradiance is percents off
    equal = dataclasses.replace(exact, intensity=np.tile(exact.intensity.mean(axis=0), (15, 1)))
    flat = equal.irradiance(points)[1][kept] / exact.irradiance(points)[1][kept]
    assert np.sqrt(np.mean((flat - 1) ** 2)) > 0.02


def test_dead_and_swapped_lights_are_identified_by_shading(plates):
    rig, straight, _ = plates
    names = [light.name for light in rig.lights]
    front = [k for k, light in enumerate(rig.lights) if light.position_mm[2] > 100]
    a, b, dead = front[0], front[2], front[1]
    wiring = list(range(len(names)))
    wiring[a], wiring[b] = b, a
    dome = dataclasses.replace(straight, wiring=tuple(wiring), dead=frozenset([names[dead]]))
    _, cameras, samples = plates_seen(dome, rig.subset(views=["C07", "C14"]), (0, 1))
    fit = light_fit.fit_lights(samples, LightTable.nominal(rig), cameras)
    assert fit.swapped == {names[a]: names[b], names[b]: names[a]}
    assert fit.dead == (names[dead],)
    assert not fit.table.valid[[a, b, dead]].any()


def test_lights_as_drawn_are_not_blamed(plates):
    rig, _, (_, _, samples) = plates
    assert light_fit.find_swapped_lights(samples, LightTable.nominal(rig)) == ({}, ())


def test_lights_survive_their_calibration(plates, tmp_path):
    rig, _, (scene, cameras, samples) = plates
    table = light_fit.fit_lights(samples, at_true_places(rig, scene), cameras).table
    made = table.to_calibration(rig=rig.name, source="simulated", created=date(2026, 11, 21))
    store.save(made, tmp_path)
    again = LightTable.from_calibration(store.load(tmp_path, "lights"), rig)
    for name in ("position_mm", "intensity", "exponent", "axis", "valid", "intensity_stderr"):
        np.testing.assert_allclose(getattr(again, name), getattr(table, name), rtol=1e-12)
    assert again.names == table.names
    serial = rig.views[0].serial
    np.testing.assert_array_equal(again.cameras[serial].gain, table.cameras[serial].gain)
    assert store.measure_drift(made, made)[0].change == 0.0


def test_frames_without_light_cannot_calibrate(plates):
    rig, _, (scene, cameras, samples) = plates
    dark = [dataclasses.replace(s, signal=0.0 * s.signal) for s in samples]
    with pytest.raises(light_fit.LightFitError, match="none of"):
        light_fit.fit_lights(dark, at_true_places(rig, scene), cameras)
