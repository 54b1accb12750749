"""Stages of the gradient sphere: patterns to normals, heights, strain, histograms and kernels."""

import dataclasses
import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from capture.calibration.led_sphere.lights import SphereLightTable, SpherePolarizers
from capture.calibration.sensor import SensorCalibration
from capture.session import Session
from model.skin import MAP_UNITS, SkinMap
from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from reconstruction.gradient_normals import Roughness, estimate_roughness, from_patterns
from reconstruction.gradient_normals.estimation import Smoothing
from reconstruction.gradient_normals.sphere_lights import SphereLights
from reconstruction.normal_histogram.statistics import NormalStatistics
from reconstruction.normal_integration import relief_errors
from reconstruction.normal_integration.lens_restoration import Aperture
from reconstruction.normal_integration.slope_fields import Perspective
from reconstruction.normal_maps import NormalMaps
from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.gradient.images import GradientImages, SkinState, StatePatterns
from reconstruction.pipeline.gradient.patch_relief import (
    CUTOFF_UM,
    PatchOptics,
    PatchRelief,
    estimate_relief,
)
from reconstruction.pipeline.gradient.pattern_diagnosis import diagnose_states
from reconstruction.pipeline.gradient.skin_strain import StateStrain, measure_states, skin_mask
from reconstruction.pipeline.gradient.strain_kernels import (
    common_skin,
    count_normals,
    fit_kernels,
    histogram_document,
    lost_variances,
)
from reconstruction.pipeline.inputs import Inputs
from reconstruction.pipeline.sensor_noise import ElectronNoise

_log = logging.getLogger(__name__)

STAGE_REVISION = 16
"""Grows when the code of a stage changes its result, so that older maps are recomputed."""

MAP_NAMES = ("normals", "height", "diffuse_normals", "crossed", "strain", "histograms", "kernels")
"""Products of a gradient-sphere session; `products` maps each name to its maps and files."""
STRAIN_FILE, HISTOGRAM_FILE, KERNEL_FILE = "strain.json", "histograms.json", "kernels.json"
FILE_NAMES = (STRAIN_FILE, HISTOGRAM_FILE, KERNEL_FILE)

FAULT_LOG = "_diagnosed"
"""Product of the stage that judges the patterns before any map is made of them."""
CROSSED_SMOOTH_PX = 2.0
"""Blur of the crossed images, which have half the noise and less detail."""
DIFFUSE_SMOOTH_PX = 2.0
WAVELENGTH_UM = 0.535
"""Mean wavelength of a white LED's light on a monochrome sensor."""


def products(session: Session) -> Mapping[str, tuple[str, ...]]:
    """Return the maps and files of a session that each name of :data:`MAP_NAMES` means."""
    states = GradientImages(session).states
    neutral = states[0].name
    return {
        "normals": tuple(f"normals_{state.name}" for state in states),
        "height": tuple(f"height_{state.name}" for state in states),
        "diffuse_normals": (f"diffuse_normals_{neutral}",),
        "crossed": tuple(f"crossed_{state.name}" for state in states),
        "strain": (STRAIN_FILE,),
        "histograms": (HISTOGRAM_FILE,),
        "kernels": (KERNEL_FILE,),
    }


@dataclass(frozen=True, slots=True)
class GradientRig:
    """Session, camera and lights, calibrated or nominal."""

    images: GradientImages
    pixel_um: float
    """Size of a pixel on the skin, in the center of the field."""
    focal_px: float
    camera_mm: Float64Array
    """Center of projection, shape (3,)."""
    lights: SphereLights
    lens: Aperture

    def points_mm(self, shape: tuple[int, int]) -> Float32Array:
        """Return the pixels' positions on the plane z = 0, shape (H, W, 2)."""
        rows, columns = np.mgrid[0 : shape[0], 0 : shape[1]]
        x = (columns - (shape[1] - 1) / 2) * (self.pixel_um / 1e3)
        y = ((shape[0] - 1) / 2 - rows) * (self.pixel_um / 1e3)
        return np.stack([x, y], axis=-1).astype(np.float32)

    def views(self, shape: tuple[int, int]) -> Float32Array:
        """Return unit vectors from the pixels' positions to the camera, shape (H, W, 3)."""
        points = self.points_mm(shape)
        way = np.concatenate([-points, np.zeros((*shape, 1), np.float32)], axis=-1)
        way += self.camera_mm.astype(np.float32)
        return unit_vectors(way)

    def perspective(self, shape: tuple[int, int]) -> Perspective:
        """Return the camera's rays."""
        return Perspective(self.focal_px, ((shape[1] - 1) / 2, (shape[0] - 1) / 2))


def graph(inputs: Inputs) -> list[stages.PipelineStage]:
    """Return the stages of a gradient-sphere session."""
    rig = _rig(inputs)
    stage = inputs.stage_maker(STAGE_REVISION)
    neutral = rig.images.neutral.name
    heights = " ".join(f"height_{state.name}" for state in rig.images.states)
    errors = " ".join(f"_slope_error_{state.name}" for state in rig.images.states)
    diffuse, counted = f"diffuse_normals_{neutral}", f"{HISTOGRAM_FILE} _histograms"
    kernels = partial(_kernels, inputs, rig)
    strain, facets = partial(_strain, inputs, rig), partial(_facets, inputs, rig)
    made = [
        stage("diagnosis", "", FAULT_LOG, partial(_diagnose, inputs, rig)),
        stage("strain", FAULT_LOG, f"_strains {STRAIN_FILE}", _diagnosed(strain)),
        stage("facets", FAULT_LOG, "_facets", _diagnosed(facets)),
        stage(f"diffuse normals {neutral}", FAULT_LOG, diffuse, _diagnosed(partial(_diffuse, rig))),
        stage("histograms", f"_strains {heights} {errors}", counted, partial(_histograms, rig)),
        stage("kernels", f"_strains _histograms {heights}", KERNEL_FILE, kernels),
    ]
    for state in rig.images.states:
        name, relief = state.name, f"_relief_{state.name}"
        normals, height = partial(_normals, rig, state), partial(_heights, name)
        crossed = partial(_crossed, rig, state)
        made += [
            stage(f"crossed {name}", FAULT_LOG, f"crossed_{name}", _diagnosed(crossed)),
            stage(f"normals {name}", "_facets", f"normals_{name} {relief}", normals),
            stage(f"height {name}", relief, f"height_{name} _slope_error_{name}", height),
        ]
    return made


def _rig(inputs: Inputs) -> GradientRig:
    session = inputs.session
    shots = session.frames("gradient")
    view = session.rig.view(shots[0].camera) if shots else session.rig.views[0]
    sensor = inputs.load(
        "sensor", [view.serial], "the frames' noise is that of their own noise profiles"
    )
    noise = None
    if sensor is not None:
        known = SensorCalibration.from_calibration(sensor, view.serial)
        noise = ElectronNoise(
            float(known.gain_e_per_dn.value[0]), float(known.read_noise_e.value[0])
        )
    pixel_um = view.pixel_um * view.distance_mm / view.focal_mm
    inputs.noted["pixel_um"] = pixel_um
    images = GradientImages(session, noise=noise)
    inputs.noted["states"] = [state.name for state in images.states]
    return GradientRig(
        images,
        pixel_um,
        view.focal_px,
        np.array(view.position_mm),
        _lights(inputs, view.serial),
        Aperture.of(
            f_number=view.f_number,
            magnification=view.pixel_um / pixel_um,
            wavelength_um=WAVELENGTH_UM,
            pixel_um=pixel_um,
        ),
    )


def _lights(inputs: Inputs, serial: str) -> SphereLights:
    """Return the sphere's lights, calibrated or nominal."""
    rig = inputs.session.rig
    names = [light.name for light in rig.lights]
    place = np.array([light.position_mm for light in rig.lights], np.float64)
    nominal = SphereLightTable.nominal(rig)
    found = inputs.load("lights", names, "the lights have the nominal values of the rig file")
    table = nominal if found is None else SphereLightTable.from_calibration(found, rig)
    leak = inputs.load(
        "polarization", [*names, serial], "crossed polarizers stop all specular reflection"
    )
    leakage = np.zeros(len(names))
    leakage_stderr = np.zeros(len(names))
    axis_deg = rig.views[0].analyzer_axis_deg
    axis_rad = math.radians(90.0 if axis_deg is None else axis_deg)
    if leak is not None:
        films = SpherePolarizers.from_calibration(leak, rig, serial)
        leakage, leakage_stderr = films.leakage, films.leakage_stderr
        axis_rad += films.misalignment_rad
    return SphereLights(
        table.directions,
        intensities=table.intensities,
        leakage=leakage,
        analyzer=(math.cos(axis_rad), math.sin(axis_rad), 0.0),
        programmed=nominal.directions,
        distance_mm=float(np.mean(np.linalg.norm(place, axis=1))),
        intensity_stderr=table.intensities_stderr,
        leakage_stderr=leakage_stderr,
    )


def _diagnose(inputs: Inputs, rig: GradientRig) -> bool:
    """Record the faults of the patterns; return whether any was found."""
    found = diagnose_states(rig.images, inputs.session)
    found.record_in(inputs)
    return bool(found.findings)


def _diagnosed(run: Callable[..., Any]) -> Callable[..., Any]:
    """Return a stage's function that runs after the diagnosis, which marks its maps."""

    def run_after(**made: Any) -> Any:
        return run(**{name: value for name, value in made.items() if name != FAULT_LOG})

    return run_after


def _strain(inputs: Inputs, rig: GradientRig) -> Mapping[str, Any]:
    found = measure_states(rig.images)
    lost = [each.state.name for each in found if not each.usable]
    if lost:
        what = "no texture could be followed; these states are omitted from histograms and kernels"
        inputs.assumed.append(f"strain of {', '.join(lost)}: {what}")
    document = {
        "schema": "skinrig.strain/1",
        "neutral": rig.images.neutral.name,
        "pixel_um": rig.pixel_um,
        "states": [each.document(rig.pixel_um) for each in found],
    }
    return {"_strains": found, STRAIN_FILE: stages.serialize_document(document)}


def _crossed(rig: GradientRig, state: SkinState) -> SkinMap:
    patterns = rig.images.of(state)
    lit = [key for key in patterns.values if key[1] == "crossed"]
    variance = np.sum([patterns.variance[key] for key in lit], axis=0) / len(lit) ** 2
    what = "subsurface-scattered light, mean of all crossed images, fraction of full scale"
    return SkinMap(patterns.crossed(), "1", np.sqrt(variance), patterns.valid, what)


def _patterns_normals(
    rig: GradientRig,
    patterns: StatePatterns,
    component: Literal["specular", "diffuse"],
    *,
    smoothing: Smoothing = (0.0, CROSSED_SMOOTH_PX),
    alpha: Roughness | None = None,
) -> NormalMaps:
    shape = patterns.shape
    return from_patterns(
        patterns.values,
        component=component,
        view=rig.views(shape),
        variance=patterns.variance,
        valid=patterns.valid,
        lights=rig.lights,
        points_mm=rig.points_mm(shape),
        smoothing=smoothing,
        alpha=alpha,
    )


def _facets(inputs: Inputs, rig: GradientRig) -> Roughness:
    """Estimate facet roughness in the neutral state; strain rotates facets, it keeps the value."""
    patterns = rig.images.of(rig.images.neutral)
    found = estimate_roughness(
        patterns.values,
        lights=rig.lights,
        view=rig.views(patterns.shape),
        variance=patterns.variance,
        valid=patterns.valid,
        sharpen=rig.lens.restore,
    )
    inputs.noted["alpha"] = {"value": found.alpha, "stderr": found.stderr}
    return found


def _normals(rig: GradientRig, state: SkinState, _facets: Roughness) -> Mapping[str, Any]:
    """Return normals as the lens resolves them, and the relief with the lens's blur removed."""
    patterns = rig.images.of(state)
    shape, skin = patterns.shape, skin_mask(patterns.crossed())
    normals_of = partial(_patterns_normals, rig, patterns, "specular", alpha=_facets)
    blurred = normals_of(smoothing="wiener")
    clear = normals_of(smoothing=rig.lens.restore)
    camera = rig.perspective(shape)
    optics = PatchOptics(rig.pixel_um, camera, rig.lens, rig.lights, _facets.alpha)
    relief = estimate_relief(clear, normals_of(), blurred, skin, optics, name=state.name)
    found = dataclasses.replace(
        blurred,
        normals=relief.seen_normals(),
        valid=relief.surface.valid & blurred.valid,
        stderr_rad=blurred.stderr_rad / math.sqrt(2.0),
    )
    shown = _normal_map(found, skin, "of a continuous surface", relief_errors.normal_stderr)
    return {f"normals_{state.name}": shown, f"_relief_{state.name}": relief}


def _diffuse(rig: GradientRig) -> SkinMap:
    patterns = rig.images.of(rig.images.neutral)
    found = _patterns_normals(rig, patterns, "diffuse", smoothing=DIFFUSE_SMOOTH_PX)
    what = (
        "of subsurface-scattered light: those of the surface smoothed by a Gaussian of "
        f"{relief_errors.DIFFUSE_SCALE_MM:g} mm"
    )
    grooves = relief_errors.diffuse_normal_stderr
    return _normal_map(found, skin_mask(patterns.crossed()), what, grooves)


def _normal_map(
    found: NormalMaps,
    skin: BoolArray,
    what: str,
    with_relief: Callable[[FloatArray, Float32Array, BoolArray], Float32Array],
) -> SkinMap:
    valid = found.valid & skin
    # standard error per tangential axis, as in the other normal maps
    stderr = np.where(valid, found.stderr_rad / math.sqrt(2.0), np.pi).astype(np.float32)
    stderr = with_relief(found.normals, stderr, valid)
    return SkinMap(
        np.asarray(found.normals, np.float32),
        MAP_UNITS["normals"],
        np.repeat(stderr[..., None], 3, axis=2),
        valid,
        f"unit normals {what}, rig frame, +x right, +y up, +z to the camera; errors in rad",
    )


def _heights(name: str, **made: Any) -> Mapping[str, Any]:
    """Return the map of heights, and the variance of one slope's error per pixel."""
    relief: PatchRelief = made[f"_relief_{name}"]
    by_noise, slope_error = relief.sample_errors()
    height, valid, pixel_um = relief.height(), relief.surface.valid, relief.optics.pixel_um
    stderr = relief_errors.height_stderr(height, by_noise, valid, pixel_um=pixel_um)
    what = (
        "height towards the camera, the lens's blur removed as far as noise allows, corrected for "
        f"lights that the relief hides, without wavelengths above {CUTOFF_UM / 1e3:g} mm"
    )
    found = SkinMap(height.astype(np.float32), "um", stderr, valid, what)
    return {f"height_{name}": found, f"_slope_error_{name}": slope_error}


def _histograms(rig: GradientRig, _strains: list[StateStrain], **made: Any) -> Mapping[str, Any]:
    by_state = _by_state(made)
    errors = _by_state(made, "_slope_error_")
    found = count_normals(_strains, by_state, pixel_um=rig.pixel_um)
    lost = {}
    for each in _strains:
        name, height = each.state.name, by_state[each.state.name]
        if name in found:
            counted = common_skin(each, _strains[0], by_state)
            axis = {"pixel_um": rig.pixel_um, "angle_rad": each.state.angle_rad}
            lost[name] = lost_variances(height.values, errors[name], valid=counted, **axis)
    document = histogram_document(_strains, found, lost)
    return {"_histograms": found, HISTOGRAM_FILE: stages.serialize_document(document)}


def _kernels(
    inputs: Inputs,
    rig: GradientRig,
    _strains: list[StateStrain],
    _histograms: Mapping[str, NormalStatistics],
    **heights: SkinMap,
) -> bytes:
    document = fit_kernels(
        _strains,
        _by_state(heights),
        _histograms,
        pixel_um=rig.pixel_um,
        compute_tiles=inputs.compute_tiles,
    )
    return stages.serialize_document(document)


def _by_state(made: Mapping[str, Any], kind: str = "height_") -> dict[str, Any]:
    return {name.removeprefix(kind): one for name, one in made.items() if name.startswith(kind)}
