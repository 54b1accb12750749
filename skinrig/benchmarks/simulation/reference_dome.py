"""Benchmark of the dome's normals and R_d on patches of voxel skin, which no estimator describes.

The same patches are also rendered by the equations of session images. The difference of both errors
is what simulations of the dome gain from a simulator and a reconstruction of one model.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from capture import hdr, raw
from capture.calibration.geometry import CameraPose
from capture.calibration.lights import LightTable
from capture.plan.dome import DOME_EXPOSURES_S
from capture.rig import Rig, load_rig
from model import metrics
from model.vectors import unit_vectors
from reconstruction.pipeline.dome import stages as dome_stages
from reconstruction.pipeline.dome.calibrated import CalibratedDome
from reconstruction.pipeline.dome.images import DomeImage, DomeImages
from reconstruction.scan.mesh import RefinedScan
from reconstruction.scan.repair import RepairReport, TriangleMesh
from rigsim.light.led_light import lobe_exponent, white_intensity
from rigsim.light.surface_brdf import evaluate_brdf
from rigsim.population.files import load_subject
from rigsim.scenes.reference.directions import (
    DirectionalReflectance,
    normal_reflectance,
    render_directions,
)
from rigsim.scenes.reference.facets import FACET_OIL_FRACTION, FACET_ROUGHNESS, SkinFacets
from rigsim.scenes.reference.plane import Reflection, render_plane
from rigsim.sensor import expose_sensor, make_sensor
from skinrig.arrays import Float64Array
from skinrig.benchmarks.intervals.dome import FACTORS_95
from skinrig.benchmarks.measurement import measure_processor_time
from skinrig.benchmarks.resampling import mean_error
from skinrig.benchmarks.results import Timing
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.evaluating.surface import CHANNEL_NAMES, RAYLEIGH_68
from skinrig.simulating.dome import LIGHT_COUNTS, VIEW_COUNTS, WIDTHS_PX, small_dome

NO_MEMORY_REASON = "renderer and estimator share the process"
MELANIN_PRESETS: Final = ("I", "II", "III", "IV", "V", "VI")
FACE_SITE: Final = "cheek"
TILT_DEG: Final = (0.0, 20.0, 40.0)
"""Angles between the patch's normal and the direction in which the subject looks."""
SCAN_ERROR_DEG: Final = 2.0
"""Angle between the normals of scan and patch."""
SIDE_POINTS: Final = 4
POINT_SPACING_PX: Final = 2.0
"""Distance of points in pixels of the merged images, so that their noise is independent."""
SENSOR_PX: Final = 28
"""Side of the part of the sensors that is simulated."""
PLANE_HALF_MM: Final = 100.0
NORMAL_QUANTITY: Final = "normals"
FIRST_SEED: Final = 11
"""Seed of the first person; no person set a constant of the reconstruction."""

Image = Literal["voxels", "model"]


@dataclass(frozen=True, slots=True, eq=False)
class PatchEstimate:
    """Errors of the estimates at the points of one patch, relative for R_d, rad for normals."""

    error: dict[str, Float64Array]
    """By quantity, shape (points,); normals have the angle to the true one."""
    stderr: dict[str, Float64Array]
    """Stated ones, of the same shape; of normals in each of two directions."""
    valid: float
    """Fraction of points with an estimate."""


class PatchImages(DomeImages):
    """Images of a patch instead of a session's: exposed and merged as a session's are.

    Parameters
    ----------
    rig
        The dome.
    normal
        Unit normal of the patch, shape (3,).
    reflection
        Reflection of the patch.
    rng
        Source of the sensors' noise.
    """

    def __init__(
        self, rig: Rig, normal: Float64Array, reflection: Reflection, rng: np.random.Generator
    ) -> None:
        self._rig, self._rng = rig, rng
        self.views = tuple(view.name for view in rig.views)
        self.lights = tuple(light.name for light in rig.lights)
        self.captures = tuple((light, -1) for light in self.lights)
        self._rates = {
            view.name: render_plane(view, rig.lights, normal, reflection) for view in rig.views
        }

    def image(self, view: str, light: str, exposure: int = -1) -> DomeImage:
        """Return a camera's image under a light, all exposures merged."""
        camera, rate = self._rig.view(view), self._rates[view][self.lights.index(light)]
        sensor = make_sensor(camera, vignetting=0.0)
        frames = [
            expose_sensor(rate * on_s, sensor=sensor, rng=self._rng, exposure_s=on_s)
            for on_s in DOME_EXPOSURES_S
        ]
        values, variance, valid = hdr.merge(
            frames,
            DOME_EXPOSURES_S,
            gain=sensor.gain_e_per_dn,
            read_noise=sensor.read_noise_e,
            black=sensor.black,
            white=sensor.white,
        )
        span = np.float32(sensor.white - sensor.black)
        linear = raw.interpolate(
            values / span, variance / span**2, valid, camera.cfa, demosaic="centered"
        )
        return DomeImage(linear.rgb, linear.variance, linear.valid)


def measure_reference_dome(stage: BenchmarkStage) -> None:
    """Measure normals and R_d of patches of voxels, and of the same patches by the model."""
    samples, presets = (8, ("III", "VI")) if stage.toy else (256, MELANIN_PRESETS)
    tilts = TILT_DEG[1:2] if stage.toy else TILT_DEG
    rig = dome_of_patches()
    colors = rig.views[0].spectral_sensitivity, str(rig.lights[0].illuminant)
    found: dict[Image, list[list[PatchEstimate]]] = {"voxels": [], "model": []}
    seconds = dict.fromkeys(found, 0.0)
    chi2, ratios = [], []
    for preset in presets:
        seed = FIRST_SEED + MELANIN_PRESETS.index(
            preset
        )  # independent optics and noise of each person
        skin = load_subject(preset).skin(seed=seed).at(FACE_SITE)
        truth = normal_reflectance(skin, *colors)
        spent_s, below = measure_processor_time(
            lambda: render_directions(skin, *colors, samples=samples, seed=seed)
        )
        seconds["voxels"] += spent_s
        chi2.append(below.chi2)
        ratios.append(below.beam_reflectance() / truth)
        for image in found:
            spent_s, patches = measure_processor_time(
                lambda: [
                    estimate_patch(rig, image, below, truth, tilt_deg=tilt, seed=[seed, k])
                    for k, tilt in enumerate(tilts)
                ]
            )
            seconds[image] += spent_s
            found[image].append(patches)
    _add_results(stage, found, seconds)
    stage.limits["chi2"] = float(np.mean(chi2))
    stage.limits["beam"] = 100.0 * float(np.abs(np.mean(ratios, axis=0) - 1.0).max())


def _add_results(
    stage: BenchmarkStage,
    found: Mapping[Image, list[list[PatchEstimate]]],
    seconds: Mapping[Image, float],
) -> None:
    """Add one point per image and quantity, over people."""
    for quantity in (NORMAL_QUANTITY, *CHANNEL_NAMES):
        errors = {
            image: [_typical_error(patches, quantity) for patches in people]
            for image, people in found.items()
        }
        for image, people in found.items():
            timing = Timing.single(seconds[image] / len(people), no_memory_reason=NO_MEMORY_REASON)
            reach, factor = (
                (RAYLEIGH_68, FACTORS_95["normals"])
                if quantity == NORMAL_QUANTITY
                else (1.0, FACTORS_95["R_d"])
            )
            every = [patch for patches in people for patch in patches]
            held = [_coverage(patch, quantity, reach) for patch in every]
            wide = [_coverage(patch, quantity, reach * factor) for patch in every]
            extra: dict[str, float] = {
                "coverage of 68 % intervals": round(float(np.mean(held)), 3),
                "coverage of 95 % intervals": round(float(np.mean(wide)), 3),
                "half-width": round(float(np.mean([_half_width(p, quantity) for p in every])), 2),
            }
            if quantity != NORMAL_QUANTITY:
                bias = [
                    100.0 * float(np.mean([p.error[quantity].mean() for p in one]))
                    for one in people
                ]
                extra["mean error"] = round(float(np.mean(bias)), 2)
                extra["lowest of a person"] = round(min(bias), 2)
                extra["highest of a person"] = round(max(bias), 2)
            gains = np.subtract(errors[image], errors["model"])
            if image == "voxels" and len(gains) > 1:
                extra["error minus that of the model"] = round(float(gains.mean()), 2)
                stderr = float(gains.std(ddof=1) / np.sqrt(len(gains)))
                extra["its standard error"] = round(stderr, 2)
            outcome = mean_error(errors[image])
            stage.add({"image": image, "quantity": quantity}, timing, outcome, extra)
            stage.limits["coverage", image, quantity] = float(np.mean(held))
            stage.limits["wide", image, quantity] = float(np.mean(wide))
    stage.limits["valid"] = min(
        patch.valid for people in found.values() for patches in people for patch in patches
    )


def _typical_error(patches: list[PatchEstimate], quantity: str) -> float:
    """Return the mean over patches of the median error, % or degrees."""
    medians = [float(np.median(np.abs(patch.error[quantity]))) for patch in patches]
    return _shown(float(np.mean(medians)), quantity)


def _half_width(patch: PatchEstimate, quantity: str) -> float:
    return _shown(float(np.median(patch.stderr[quantity])), quantity)


def _shown(value: float, quantity: str) -> float:
    return float(np.degrees(value)) if quantity == NORMAL_QUANTITY else 100.0 * value


def _coverage(patch: PatchEstimate, quantity: str, reach: float) -> float:
    """Return the fraction of points whose interval contains the ground truth."""
    inside = np.abs(patch.error[quantity]) <= reach * patch.stderr[quantity]
    return float(np.mean(inside))


def dome_of_patches() -> Rig:
    """Return the dome of a small session, its sensors cropped to the patch."""
    rig = small_dome(
        load_rig("dome"),
        lights=LIGHT_COUNTS["small"],
        views=VIEW_COUNTS["small"],
        width_px=WIDTHS_PX["small"],
    )
    views = tuple(
        dataclasses.replace(view, width_px=SENSOR_PX, height_px=SENSOR_PX) for view in rig.views
    )
    return dataclasses.replace(rig, views=views)


def estimate_patch(
    rig: Rig,
    image: Image,
    below: DirectionalReflectance,
    truth: Float64Array,
    *,
    tilt_deg: float,
    seed: list[int],
) -> PatchEstimate:
    """Photograph a tilted patch, and estimate its normals and R_d as a session's stages do.

    Parameters
    ----------
    rig
        The dome, calibrated without error.
    image
        "voxels": light from below the surface by ``below``, facets by Mitsuba's own materials;
        "model": both by the equations of session images with R_d of ``truth``.
    below
        Light from below the surface of the patch.
    truth
        Its R_d, shape (3,).
    tilt_deg
        Angle of the patch's normal to the direction in which a subject looks.
    seed
        Seeds the tilt's direction, the scan's error and the noise.
    """
    rng = np.random.default_rng(seed)
    normal = tilt_vector(np.array([0.0, 0.0, 1.0]), tilt_deg, rng)
    scan_normal = tilt_vector(normal, SCAN_ERROR_DEG, rng)
    packed = np.array([*truth, FACET_ROUGHNESS, FACET_OIL_FRACTION, 0.0, 1.0])

    facets = SkinFacets(FACET_ROUGHNESS, FACET_OIL_FRACTION)

    def reflect_voxels(light: Float64Array, camera: Float64Array) -> Float64Array:
        on_surface = facets.evaluate(normal, light, camera)
        return below.evaluate(normal, light, camera) + on_surface[:, None]

    def reflect_model(light: Float64Array, camera: Float64Array) -> Float64Array:
        return evaluate_brdf(packed, normal, light, camera)[0].astype(np.float64)

    reflection = {"voxels": reflect_voxels, "model": reflect_model}[image]
    dome = _calibrated_dome(rig, PatchImages(rig, normal, reflection, rng))
    surface = _plane_scan(normal, scan_normal, POINT_SPACING_PX * dome.pixel_mm)
    samples = dome_stages.sample_surface(dome, surface, None)
    normals, _ = dome_stages.measure_normals(dome, surface, samples)
    r_d = dome_stages.measure_albedo(dome, surface, samples, normals)
    valid = normals.valid & r_d.valid
    error = {NORMAL_QUANTITY: metrics.angular_error_rad(normals.values[valid], normal)}
    stderr = {NORMAL_QUANTITY: normals.stderr[valid, 0]}
    for channel, color in enumerate(CHANNEL_NAMES):
        error[color] = r_d.values[valid, channel] / truth[channel] - 1.0
        stderr[color] = r_d.stderr[valid, channel] / truth[channel]
    return PatchEstimate(error, stderr, float(valid.mean()))


def tilt_vector(normal: Float64Array, degrees: float, rng: np.random.Generator) -> Float64Array:
    """Tilt a unit vector by an angle into a random direction."""
    side = np.cross(normal, unit_vectors(rng.standard_normal(3)))
    angle = np.radians(degrees)
    return np.asarray(np.cos(angle) * normal + np.sin(angle) * unit_vectors(side), np.float64)


def _calibrated_dome(rig: Rig, images: DomeImages) -> CalibratedDome:
    """Return the dome with the rig's own geometry and lights as its calibration."""
    lights = LightTable(
        np.array([light.position_mm for light in rig.lights]),
        np.array([white_intensity(light, rig.views[0]) for light in rig.lights]),
        np.array([lobe_exponent(light) for light in rig.lights]),
        tuple(light.name for light in rig.lights),
    )
    cameras = tuple(CameraPose.nominal(view) for view in rig.views)
    response = tuple(
        np.ones((view.height_px // 2, view.width_px // 2, 3), np.float32) for view in rig.views
    )
    return CalibratedDome(
        images,
        cameras,
        lights,
        lights,
        response,
        True,
        lambda _, tiles, compute, **_given: map(compute, tiles),
    )


def _plane_scan(normal: Float64Array, scan_normal: Float64Array, step_mm: float) -> RefinedScan:
    """Return the scan of a plane: a square of points, and its normals with the scan's error."""
    first = unit_vectors(np.cross(normal, [0.0, 1.0, 0.0]))
    sides = np.stack([first, np.cross(normal, first)])
    row, column = np.indices((SIDE_POINTS, SIDE_POINTS)).reshape(2, -1)
    steps = np.stack([column, row], axis=-1) - 0.5 * (SIDE_POINTS - 1)
    at = np.arange(SIDE_POINTS**2).reshape(SIDE_POINTS, SIDE_POINTS)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    corners = PLANE_HALF_MM * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return RefinedScan(
        (step_mm * steps @ sides).astype(np.float32),
        np.tile(scan_normal.astype(np.float32), (SIDE_POINTS**2, 1)),
        faces.astype(np.int32),
        np.zeros((len(faces), 3, 2), np.float32),
        TriangleMesh(corners @ sides, np.array([[0, 1, 2], [0, 2, 3]])),
        RepairReport(),
    )
