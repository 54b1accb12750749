"""Benchmark of head motion: tracking frames of the simulated dome, and errors of the motion."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from capture.calibration.geometry import CameraPose
from capture.rig import load_rig
from reconstruction.registration import head_motion
from rigsim.boxes.led_table import LedPulse
from rigsim.needs.effects import SceneEffects
from rigsim.scenes.dome.scene import DomeScene
from rigsim.subject import make_subject
from rigsim.subject.head_motion import draw_head_motion as drawn
from skinrig.arrays import Float64Array
from skinrig.benchmarks.resampling import mean_error
from skinrig.benchmarks.results import ErrorEstimate
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.evaluating.skin_bands import MelaninBand

TRACKING_EXPOSURE_S = 0.03


@dataclass(frozen=True, slots=True)
class _Superpixels:
    """A camera whose image has one pixel for each 2 x 2 cell of its sensor."""

    sensor: head_motion.TrackingCamera

    @property
    def center_mm(self) -> Float64Array:
        """Center of projection, mm, (3,)."""
        return self.sensor.center_mm

    def project(self, points_mm: Float64Array) -> Float64Array:
        """Project points to column and row of the binned image, (N, 2)."""
        return (self.sensor.project(points_mm) - 0.5) / 2


@dataclass(frozen=True, slots=True)
class DriftingCapture:
    """Tracking frames of one capture, with the true poses of the head."""

    frames: Sequence[Sequence[Float64Array]]
    cameras: Sequence[_Superpixels]
    points_mm: Float64Array
    normals: Float64Array
    times_s: Float64Array
    poses: Sequence[tuple[Float64Array, Float64Array]]
    twitch: Float64Array
    """Amount of the mouth's twitch by frame, 0 to 1."""

    def estimate(self, tracks: int) -> head_motion.HeadMotion:
        """Estimate the motion with `tracks` tracks per camera."""
        return head_motion.estimate(
            self.frames,
            self.cameras,
            self.points_mm,
            self.normals,
            self.times_s,
            tracks_per_camera=tracks,
        )

    def error(self, found: head_motion.HeadMotion) -> ErrorEstimate:
        """Return the mean error over the frames, mm."""
        errors = self.point_errors_mm(found)
        return (
            mean_error(errors)
            if len(errors) > 1
            else ErrorEstimate.symmetric(float(errors[0]), 0.0)
        )

    def point_errors_mm(self, found: head_motion.HeadMotion) -> Float64Array:
        """Return the RMS distance between estimated and true points by frame, mm, (T - 1,)."""
        rotations = head_motion.rotation_matrix(found.rotation_rad)
        pairs = zip(self.poses[1:], rotations[1:], found.translation_mm[1:], strict=True)
        return np.array(
            [
                _rms_mm(self.points_mm @ (estimated - rotation).T + (translation - shift))
                for (rotation, shift), estimated, translation in pairs
            ]
        )

    def true_motion_mm(self) -> Float64Array:
        """Return the RMS true displacement of the points by frame, mm, (T - 1,)."""
        return np.array(
            [
                _rms_mm(self.points_mm @ (rotation - np.eye(3)).T + shift)
                for rotation, shift in self.poses[1:]
            ]
        )


def _rms_mm(gap: Float64Array) -> float:
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))


def simulate_drifting_capture(
    *,
    width_px: int,
    views: int,
    drift_mm: float,
    times_s: Sequence[float],
    twitch: bool = False,
    preset: str = "III",
    texels: int = 512,
) -> DriftingCapture:
    """Render tracking frames of a drifting head.

    Parameters
    ----------
    width_px
        Width of the sensors; the frames have half of it.
    views
        Number of frontal cameras.
    drift_mm
        Largest translation within 25 s; the rotation is a third as many degrees.
    times_s
        Times of the frames, s; the first should be 0.
    twitch
        Whether the mouth twitches; a further frame then shows the middle of the twitch.
    preset
        Melanin preset of the subject.
    texels
        Side of the subject's maps, texels.
    """
    rig = load_rig("dome")
    leds = [light.name for light in rig.lights if light.position_mm[2] > 350.0][::6]
    front = sorted(rig.views, key=lambda view: -view.position_mm[2])[:views]
    rig = rig.subset(lights=leds, views=[view.name for view in front]).resized(width_px)
    motion = drawn(3, drift_mm=drift_mm, drift_deg=drift_mm / 3, twitch=twitch)
    times_s = sorted([*times_s, motion.twitch_start_s + 0.25] if twitch else times_s)
    subject = make_subject(preset, seed=0, size=texels)
    scene = DomeScene(
        rig, subject, motion=motion, effects=SceneEffects(lateral=False, interreflections=False)
    )
    frames = []
    for t in times_s:
        pops = [LedPulse(k, 1.0, t, t + TRACKING_EXPOSURE_S) for k in range(len(rig.lights))]
        row = []
        for view in rig.views:
            cfa = scene.exposure(
                view.name, pops=pops, exposure_s=TRACKING_EXPOSURE_S, seed=round(100 * t)
            )
            x = np.asarray(cfa, np.float64) - view.black_level
            row.append((x[::2, ::2] + x[::2, 1::2] + x[1::2, ::2] + x[1::2, 1::2]) / 4)
        frames.append(row)
    mesh = subject.mesh
    chosen = np.random.default_rng(0).choice(
        len(mesh.vertices_mm), min(6000, len(mesh.vertices_mm)), replace=False
    )
    return DriftingCapture(
        frames,
        [_Superpixels(CameraPose.nominal(view)) for view in rig.views],
        np.asarray(mesh.vertices_mm[chosen], np.float64),
        np.asarray(mesh.normals[chosen], np.float64),
        np.asarray(times_s, np.float64),
        [motion.pose(float(t)) for t in times_s],
        np.array([motion.twitch_amount(float(t)) for t in times_s]),
    )


def measure_head_motion(stage: BenchmarkStage) -> None:
    """Measure errors of the head's position over drift and number of tracks."""
    width, views, times = (
        (160, 2, (0.0, 8.0, 16.0)) if stage.toy else (484, 3, (0.0, 5.0, 12.5, 20.0))
    )
    texels = 128 if stage.toy else 512
    drift = partial(simulate_drifting_capture, width_px=width, views=views, texels=texels)

    for drift_mm in (1.0,) if stage.toy else (0.3, 1.0, 3.0):
        captured = drift(drift_mm=drift_mm, times_s=times)
        moved_mm = round(float(captured.true_motion_mm().mean()), 3)
        for tracks in (30, 60, 120, 200) if stage.toy else (30, 100, 300):
            knobs = {"drift mm": drift_mm, "tracks": tracks}
            follow = partial(captured.estimate, tracks)
            stage.measure(knobs, follow, captured.error, extra_values={"moved_mm": moved_mm})

    def on_skin(band: MelaninBand) -> ErrorEstimate:
        captured = drift(drift_mm=1.0, times_s=times[:3], preset=band.preset)
        return captured.error(captured.estimate(100))

    stage.measure_bands(on_skin)
    stage.description_values = {"width": width // 2, "views": views}
