"""Benchmark of the gradient sphere's calibration: errors over the exposures of the glass ball."""

from functools import partial

import numpy as np

from capture.calibration.fiber.spot_photometry import SpotImage, make_spot_image
from capture.calibration.led_sphere.survey import survey_sphere
from capture.plan.gradient import BALL_SERIES, PATTERN_EXPOSURE_S
from capture.raw import RawFrame
from capture.rig import Rig, load_rig
from rigsim.as_built.sphere import build_sphere
from rigsim.boxes.gradient_sphere import PatternLight
from rigsim.scenes.gradient.scene import GradientScene
from rigsim.sensor import vignetting_map
from skinrig.benchmarks.measurement import measure_once
from skinrig.benchmarks.resampling import bootstrap_median
from skinrig.benchmarks.results import Knobs
from skinrig.benchmarks.stage import BenchmarkStage

SPHERE_SEED = 7


def measure_sphere_lights(stage: BenchmarkStage) -> None:
    """Measure the survey of a simulated sphere over analyzer readings and image size."""
    for width_px in (192,) if stage.toy else (512, 1024):
        rig = load_rig("gradient").resized(width_px)
        sphere = build_sphere(rig, seed=SPHERE_SEED)
        scene = GradientScene(rig, "ball", sphere=sphere, seed=SPHERE_SEED)
        shots = _shots(scene, rig)
        fewer = ((0, 80, 90), (0, 90, 100)) if stage.toy else ()
        for readings in (*fewer, (0, 90), (0, 80, 90, 100)):
            part = [one for one in shots if one.reading_deg in readings]

            # nine tenths of a small survey's time depend on the LEDs: the toy size runs once
            survey = partial(survey_sphere, part, rig)
            timing, result = measure_once(survey) if stage.toy else stage.time(survey)
            lights, polarizers = result.lights, result.polarizers
            good = lights.valid & ~lights.dead
            position = sphere.position_mm
            true = sphere.intensity / np.sum(position**2, axis=1)
            error = 100 * np.abs(lights.intensities * true[good].mean() / true - 1)[good]
            stated = 100 * (lights.intensities_stderr / lights.intensities)[good]
            # median of |error| of a normal error: 0.6745 standard deviations
            bound = float(0.674 * np.median(stated))
            knobs: Knobs = {"pixels": width_px, "readings": " ".join(map(str, readings))}
            outcome = stage.add(knobs, timing, bootstrap_median(error, bound, draws=400))
    aim = position / np.linalg.norm(position, axis=1, keepdims=True)
    off = np.degrees(np.linalg.norm(lights.directions - aim, axis=1))
    zero = np.degrees(polarizers.misalignment_rad) - scene.films.analyzer_zero_deg
    stage.limits = {
        "direction": float(np.median(off[lights.seen])),
        "intensity": outcome.error,
        "misalignment": float(abs(zero) / np.degrees(polarizers.misalignment_stderr_rad)),
    }


def _shots(scene: GradientScene, rig: Rig) -> list[SpotImage]:
    view = rig.views[0]
    sensor = scene.sensor()
    flat = vignetting_map(sensor.vignetting, view.height_px, view.width_px)
    shots: list[SpotImage] = []
    for reading, levels in BALL_SERIES.items():
        for level in levels:
            light = PatternLight("full", level, 0.0, PATTERN_EXPOSURE_S, float(reading))
            cfa = scene.exposure(
                view.name, pops=[light], exposure_s=PATTERN_EXPOSURE_S, seed=len(shots)
            )
            frame = RawFrame(
                cfa=cfa,
                pattern=view.cfa,
                black=(float(view.black_level),),
                white=view.white_level,
                noise_profile=sensor.noise_profile(PATTERN_EXPOSURE_S),
            )
            shots.append(
                make_spot_image(
                    frame,
                    amount_s=PATTERN_EXPOSURE_S * level,
                    reading_deg=float(reading),
                    flat=flat,
                )
            )
    return shots
