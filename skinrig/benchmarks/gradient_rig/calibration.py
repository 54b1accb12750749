"""Benchmark of the gradient sphere's calibration: errors over the exposures of the glass ball."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from capture.calibration.fiber.spot_photometry import Shot, shot
from capture.calibration.led_sphere.findings import SphereSurvey
from capture.calibration.led_sphere.survey import survey_sphere
from capture.plan.gradient import BALL_SERIES, EXPOSURE_S
from capture.raw import RawFrame
from capture.rig import Rig, load_rig
from rigsim.as_built.sphere import build_sphere
from rigsim.boxes.gradient_sphere import PatternLight
from rigsim.scenes.gradient.scene import GradientScene
from rigsim.sensor import vignetting_map
from skinrig.arrays import Float64Array
from skinrig.benchmarks.description import described
from skinrig.benchmarks.measurement import Point, StageBenchmark, measure, once

SPHERE_SEED = 7


def sphere_lights(*, toy: bool) -> StageBenchmark:
    """Survey a simulated sphere with two and four readings of the analyser, and large pixels."""
    points, last = [], (np.inf, np.inf, np.inf)
    for width_px in (192,) if toy else (512, 1024):
        rig = load_rig("gradient").resized(width_px)
        sphere = build_sphere(rig, seed=SPHERE_SEED)
        scene = GradientScene(rig, "ball", sphere=sphere, seed=SPHERE_SEED)
        shots = _shots(scene, rig)
        fewer = ((0, 80, 90), (0, 90, 100)) if toy else ()
        for readings in (*fewer, (0, 90), (0, 80, 90, 100)):
            part = [one for one in shots if one.reading_deg in readings]

            def call(part: Sequence[Shot] = part, rig: Rig = rig) -> SphereSurvey:
                return survey_sphere(part, rig)

            # nine tenths of a small survey's seconds are the LEDs': it is made once
            timing, result = once(call) if toy else (measure(call), call())
            good = result.lights.valid & ~result.lights.dead
            place = sphere.position_mm
            true = sphere.intensity / np.sum(place**2, axis=1)
            error = 100 * (result.lights.intensities * true[good].mean() / true - 1)[good]
            stated = 100 * (result.lights.intensities_stderr / result.lights.intensities)[good]
            points.append(
                Point(
                    {"pixels": width_px, "readings": " ".join(map(str, readings))},
                    timing,
                    float(np.median(np.abs(error))),
                    _interval(np.abs(error)),
                    # the median of a normal distribution's size is 0.674 of its deviation
                    float(0.674 * np.median(stated)),
                )
            )
            aim = place / np.linalg.norm(place, axis=1, keepdims=True)
            off = np.degrees(np.linalg.norm(result.lights.directions - aim, axis=1))
            zero = np.degrees(result.films.misalignment_rad) - scene.films.analyser_zero_deg
            sigmas = abs(zero) / np.degrees(result.films.misalignment_stderr_rad)
            last = (
                float(np.median(off[result.lights.seen])),
                float(np.median(np.abs(error))),
                float(sigmas),
            )
    return described(
        "sphere-lights",
        points,
        {"direction": last[0], "intensity": last[1], "misalignment": last[2]},
    )


def _shots(scene: object, rig: Rig) -> list[Shot]:

    if not isinstance(scene, GradientScene):
        raise TypeError(f"scene: got {type(scene).__name__}, expected GradientScene")
    view = rig.views[0]
    sensor = scene.sensor()
    flat = vignetting_map(sensor.vignetting, view.height_px, view.width_px)
    shots: list[Shot] = []
    for reading, levels in BALL_SERIES.items():
        for level in levels:
            light = PatternLight("full", level, 0.0, EXPOSURE_S, float(reading))
            cfa = scene.exposure(view.name, pops=[light], exposure_s=EXPOSURE_S, seed=len(shots))
            frame = RawFrame(
                cfa=cfa,
                pattern=view.cfa,
                black=(float(view.black_level),),
                white=view.white_level,
                noise_profile=sensor.noise_profile(EXPOSURE_S),
            )
            shots.append(
                shot(frame, amount_s=EXPOSURE_S * level, reading_deg=float(reading), flat=flat)
            )
    return shots


def _interval(sizes: Float64Array) -> tuple[float, float]:
    """Return a bootstrap interval of a median, 68 %."""
    rng = np.random.default_rng(0)
    again = np.median(sizes[rng.integers(0, len(sizes), (400, len(sizes)))], axis=1)
    low, high = np.quantile(again, [0.16, 0.84])
    return float(low), float(high)
