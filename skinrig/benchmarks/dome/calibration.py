"""Benchmarks of the dome's calibration: error over the number of boards, and of mirror spheres."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from capture.calibration.geometry import CameraPose, bundle, nominal_cameras
from capture.calibration.geometry.board import Board, Sighting, find_board
from capture.calibration.lights import mirror_lights, mirror_sphere
from capture.calibration.sensor.mosaic import channel_levels, neutral_mosaic
from capture.raw import RawFrame, linear_rgb
from capture.rig import Rig, load_rig
from rigsim.as_built.dome import Tolerances, build, image_of
from rigsim.boxes.led_table import LedPulse
from rigsim.scenes.dome.targets import target_scene
from rigsim.sensor import sensor_of
from skinrig.arrays import Float64Array
from skinrig.benchmarks.description import described
from skinrig.benchmarks.measurement import measure, measure_and_keep
from skinrig.benchmarks.resampling import drawn_again
from skinrig.benchmarks.results import Knobs, Point, StageBenchmark, Timing

if TYPE_CHECKING:
    from rigsim.scenes.dome.targets import TargetScene

CHARUCO_BOARD = Board.of(("charuco", 7, 5, "4X4_50"), square_mm=36.0)
SPHERE_RADIUS_MM = 50.0
DOME_SEED = 5


def geometry(*, toy: bool) -> StageBenchmark:
    """Adjust cameras to 4 to 12 places of a simulated board."""
    views = ["C03", "C07", "C11", "C14"] if toy else ["C03", "C05", "C07", "C10", "C11", "C14"]
    rig = load_rig("dome").subset(views=views).resized(324 if toy else 650)
    dome = build(rig, seed=DOME_SEED, tolerances=Tolerances(distortion=0.2))
    scene = target_scene("charuco", rig, seed=DOME_SEED, dome=dome)
    counts = (5, 6, 7, 8) if toy else (6, 8, 10, 12)
    sightings: dict[tuple[str, int], Sighting] = {}
    for pose in range(counts[-1]):
        scene.show(pose)
        for name in views:
            frame = _frame(scene, name, range(0, 150, 8), 0.02, 1.0, pose)
            found = find_board(linear_rgb(frame, demosaic="bilinear").rgb, CHARUCO_BOARD)
            if found is not None:
                sightings[name, pose] = found
    start = nominal_cameras(rig)
    probes = np.random.default_rng(0).uniform(-70, 70, (300, 3))
    points, worst = [], 0.0
    for count in counts:
        seen = {key: s for key, s in sightings.items() if key[1] < count}
        result = bundle.adjust(seen, CHARUCO_BOARD, start)
        gaps, variances, projected = [], [], []
        for name, camera in result.cameras.items():
            view = dome.rig.view(name)
            gaps.append(np.mean((camera.center_mm - view.position_mm) ** 2))
            variances.append(np.trace(result.center_covariance_mm2[name]) / 3)
            truth = image_of(view, dome.distortion[name], probes)
            projected.append(np.linalg.norm(camera.project(probes) - truth, axis=1).mean())
        worst = float(max(projected))

        timing = measure(lambda: bundle.adjust(seen, CHARUCO_BOARD, start))
        points.append(_point({"places": count}, timing, np.array(gaps), np.array(variances)))
    return described("dome-geometry", points, {"reprojection": worst})


def lights(*, toy: bool) -> StageBenchmark:
    """Place lights by one to four places of a simulated mirror sphere."""
    views = ["C05", "C07", "C14"] if toy else ["C01", "C05", "C07", "C10", "C11", "C14"]
    dome_rig = load_rig("dome")
    every = [light.name for light in dome_rig.lights][:: 30 if toy else 10]
    rig = dome_rig.subset(views=views, lights=every).resized(324 if toy else 1300)
    dome = build(rig, seed=DOME_SEED)
    scene = target_scene("mirror", rig, seed=DOME_SEED, dome=dome)
    cameras = {view.name: CameraPose.nominal(view) for view in dome.rig.views}
    spheres: dict[int, mirror_sphere.SpherePosition] = {}
    seen: list[mirror_lights.Highlights] = []
    most = 4
    for number in range(most):
        scene.show(number)
        _add_sphere(scene, rig, cameras, number, spheres, seen)
    nominal = {light.name: np.array(light.position_mm) for light in rig.lights}
    truth = scene.truth()["position_mm"]
    points, last = [], np.inf
    for count in range(1, most + 1):
        rows = [row for row in seen if row.sphere < count]
        some = {number: spheres[number] for number in range(count)}

        timing, result = measure_and_keep(
            lambda: mirror_lights.locate_lights(rows, cameras, some, nominal)
        )
        ok = result.valid
        gaps = np.mean((result.position_mm - truth)[ok] ** 2, axis=1)
        last = float(np.median(np.linalg.norm((result.position_mm - truth)[ok], axis=1)))
        variances = np.mean(result.stderr_mm[ok] ** 2, axis=1)
        points.append(_point({"spheres": count}, timing, gaps, variances))
    return described("dome-lights", points, {"distance": last})


def _add_sphere(
    scene: TargetScene,
    rig: Rig,
    cameras: dict[str, CameraPose],
    number: int,
    spheres: dict[int, mirror_sphere.SpherePosition],
    seen: list[mirror_lights.Highlights],
) -> None:
    """Add one place of the sphere and its highlights."""
    every = range(len(rig.lights))
    outlines, colors = {}, {}
    for name, camera in cameras.items():
        frame = _frame(scene, name, every, 0.06, 1.0, number)
        colors[name] = channel_levels(frame)
        image = neutral_mosaic(frame, colors[name])
        edges = mirror_sphere.find_outline(image, camera, SPHERE_RADIUS_MM)
        if edges is not None:
            outlines[name] = edges
    spheres[number] = mirror_sphere.locate_sphere(outlines, cameras, SPHERE_RADIUS_MM)
    for name, camera in cameras.items():
        window = mirror_lights.SphereWindow.of(camera, spheres[number])
        frame = _frame(scene, name, every, 0.012, 0.002, number)
        spots = mirror_lights.find_highlights(neutral_mosaic(frame, colors[name]), window)
        names = tuple(light.name for light in rig.lights)
        seen.append(mirror_lights.Highlights(name, number, names, *spots))


def _frame(
    scene: TargetScene, name: str, lit: Sequence[int], exposure_s: float, level: float, seed: int
) -> RawFrame:

    view = scene.rig.view(name)
    pops = [LedPulse(k, level, 0.0, exposure_s) for k in lit]
    cfa = scene.exposure(name, pops=pops, exposure_s=exposure_s, seed=seed)
    return RawFrame(
        cfa=cfa,
        pattern=view.cfa,
        black=(float(view.black_level),) * 4,
        white=view.white_level,
        noise_profile=sensor_of(view).noise_profile(exposure_s),
    )


def _point(knobs: Knobs, timing: Timing, squares: Float64Array, variances: Float64Array) -> Point:
    """Return a point with a bootstrap interval of the error and the bound that errors state."""
    low, high = np.sqrt(drawn_again(squares, np.mean, draws=400))
    error, bound = (float(np.sqrt(part.mean())) for part in (squares, variances))
    return Point(knobs, timing, error, (float(low), float(high)), bound)
