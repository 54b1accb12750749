"""Stages of the gradient sphere: patterns to normals, heights, strain, histograms and kernels."""

import dataclasses
import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from scipy import ndimage

from capture.calibration.led_sphere.lights import SphereLightTable, SpherePolarizers
from capture.calibration.sensor import SensorCalibration
from capture.session import Session
from model.skin import MAP_UNITS, SkinMap
from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from reconstruction.gradient_normals import Roughness, estimate_roughness, from_patterns
from reconstruction.gradient_normals.estimation import Smoothing
from reconstruction.gradient_normals.occlusion import estimate_occlusion_ratios
from reconstruction.gradient_normals.sphere_lights import SphereLights
from reconstruction.normal_histogram.relief_slopes import slopes
from reconstruction.normal_histogram.statistics import NormalStatistics
from reconstruction.normal_integration import HeightMap, integrate_map, relief_errors
from reconstruction.normal_integration.height_filters import high_pass
from reconstruction.normal_integration.lens_restoration import (
    Aperture,
    RestoredNormals,
    restore_normals,
)
from reconstruction.normal_integration.slope_fields import Perspective
from reconstruction.normal_maps import NormalMaps
from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.gradient.images import GradientImages, SkinState, StatePatterns
from reconstruction.pipeline.gradient.pattern_diagnosis import diagnose_states
from reconstruction.pipeline.gradient.skin_strain import StateStrain, measure_states, skin_mask
from reconstruction.pipeline.gradient.strain_kernels import (
    common_skin,
    count_normals,
    fit_kernels,
    histogram_document,
    noise_variances,
)
from reconstruction.pipeline.inputs import Inputs
from reconstruction.pipeline.sensor_noise import ElectronNoise

_log = logging.getLogger(__name__)

STAGE_REVISION = 15
"""Grows when the code of a stage changes its result, so that older maps are recomputed."""

MAP_NAMES = ("normals", "height", "diffuse_normals", "crossed", "strain", "histograms", "kernels")
"""Products of a gradient-sphere session; `products` maps each name to its maps and files."""
STRAIN_FILE, HISTOGRAM_FILE, KERNEL_FILE = "strain.json", "histograms.json", "kernels.json"
FILE_NAMES = (STRAIN_FILE, HISTOGRAM_FILE, KERNEL_FILE)

FAULT_LOG = "_diagnosed"
"""Product of the stage that judges the patterns before any map is made of them."""
CUTOFF_UM = 1000.0
"""Longest wavelength of the surface topography (Nagano et al. 2015, section 4)."""
SMOOTH_PX = 1.0
"""Blur of the images before facet roughness is estimated: the lens resolves three pixels."""
CROSSED_SMOOTH_PX = 2.0
"""Blur of the crossed images, which have half the noise and less detail."""
DIFFUSE_SMOOTH_PX = 2.0
WAVELENGTH_UM = 0.535
"""Mean wavelength of a white LED's light on a monochrome sensor."""
STDERR_SAMPLES = 6
STDERR_SIGMA_PX = 8.0


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
    noises = " ".join(f"_slope_noise_{state.name}" for state in rig.images.states)
    diffuse, counted = f"diffuse_normals_{neutral}", f"{HISTOGRAM_FILE} _histograms"
    kernels = partial(_kernels, inputs, rig)
    strain, facets = partial(_strain, inputs, rig), partial(_facets, inputs, rig)
    made = [
        stage("diagnosis", "", FAULT_LOG, partial(_diagnose, inputs, rig)),
        stage("strain", FAULT_LOG, f"_strains {STRAIN_FILE}", _diagnosed(strain)),
        stage("facets", FAULT_LOG, "_facets", _diagnosed(facets)),
        stage(f"diffuse normals {neutral}", FAULT_LOG, diffuse, _diagnosed(partial(_diffuse, rig))),
        stage(
            "histograms", f"_strains _facets {heights} {noises}", counted, partial(_histograms, rig)
        ),
        stage("kernels", f"_strains _histograms {heights}", KERNEL_FILE, kernels),
    ]
    for state in rig.images.states:
        name, restored = state.name, f"_restored_{state.name}"
        normals, height = partial(_normals, rig, state), partial(_height, rig, state)
        crossed = partial(_crossed, rig, state)
        made += [
            stage(f"crossed {name}", FAULT_LOG, f"crossed_{name}", _diagnosed(crossed)),
            stage(f"normals {name}", "_facets", f"normals_{name} {restored}", normals),
            stage(f"height {name}", restored, f"height_{name} _slope_noise_{name}", height),
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
        smooth_px=SMOOTH_PX,
    )
    inputs.noted["alpha"] = {"value": found.alpha, "stderr": found.stderr}
    return found


def _normals(rig: GradientRig, state: SkinState, _facets: Roughness) -> Mapping[str, Any]:
    """Return normals blurred by the lens, and slopes of the surface with the blur removed."""
    patterns = rig.images.of(state)
    skin = skin_mask(patterns.crossed())
    smooth = _patterns_normals(rig, patterns, "specular", smoothing="wiener", alpha=_facets)
    sharp = _patterns_normals(rig, patterns, "specular", alpha=_facets)
    # noise moves single pixels of steep grooves outside the range of a lobe; a hole there would cut
    # the height map, so these pixels take the filtered normal
    normals = np.where(sharp.valid[..., None], sharp.normals, smooth.normals)
    known = (sharp.valid | smooth.valid) & skin
    grooves = relief_errors.normal_stderr
    shown = _normal_map(smooth, skin, "of the surface's reflection", grooves)
    restored = restore_normals(normals, lens=rig.lens, valid=known)
    return {
        f"normals_{state.name}": shown,
        f"_restored_{state.name}": (restored, known, smooth.stderr_rad),
    }


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


def _height(rig: GradientRig, state: SkinState, **made: Any) -> Mapping[str, Any]:
    """Integrate the deblurred slopes; remove wavelengths above `CUTOFF_UM`.

    Also returns the variance of one slope's noise per pixel.
    """
    restored: RestoredNormals
    valid: BoolArray
    restored, valid, stderr_rad = made[f"_restored_{state.name}"]
    shape = valid.shape

    def relief(normals: FloatArray, known: BoolArray) -> HeightMap:
        # steep walls of grooves are dim and partly hidden, so they have less weight
        found = integrate_map(
            normals,
            valid=known,
            pixel=rig.pixel_um,
            camera=rig.perspective((shape[0], shape[1])),
            stderr_rad=stderr_rad,
        )
        height = high_pass(found.height, pixel=rig.pixel_um, cutoff=CUTOFF_UM, valid=found.valid)
        return dataclasses.replace(found, height=height)

    found = relief(restored.normals, valid)
    found.convergence.warn_unless_converged(f"height of {state.name}", _log)
    by_noise, slope_noise = _height_noise(restored, found.valid, relief, rig.pixel_um)
    stderr = relief_errors.height_stderr(found.height, by_noise, found.valid, pixel_um=rig.pixel_um)
    what = (
        "height towards the camera, the lens's blur removed as far as noise allows, without "
        f"wavelengths above {CUTOFF_UM / 1e3:g} mm"
    )
    return {
        f"height_{state.name}": SkinMap(
            found.height.astype(np.float32), "um", stderr, found.valid, what
        ),
        f"_slope_noise_{state.name}": slope_noise,
    }


def _height_noise(
    restored: RestoredNormals,
    valid: BoolArray,
    relief: Callable[[FloatArray, BoolArray], HeightMap],
    pixel_um: float,
) -> tuple[Float32Array, Float32Array]:
    """Return a height's standard error, and the noise variance of one slope, each (H, W).

    Random noise fields are integrated in the same way. A pixel without slopes has variance 0.
    """
    rng = np.random.default_rng(0)
    total, of_slopes = np.zeros(valid.shape), np.zeros(valid.shape)
    for _ in range(STDERR_SAMPLES):
        x, y = restored.sample_noise(rng)
        field = np.stack([-x, -y, np.ones_like(x)], axis=-1)
        height = relief(field, valid).height.astype(np.float64)
        total += height**2
        slope_x, slope_y, _ = slopes(height, pixel=pixel_um, valid=valid)
        of_slopes += 0.5 * (slope_x**2 + slope_y**2)
    # noise is nearly stationary, so its variance is smooth except at borders
    weight = ndimage.gaussian_filter(valid.astype(float), STDERR_SIGMA_PX)
    even = ndimage.gaussian_filter(total, STDERR_SIGMA_PX) / np.maximum(weight, 1e-3)
    stderr = np.where(valid, np.sqrt(even / STDERR_SAMPLES), np.inf).astype(np.float32)
    return stderr, (of_slopes / STDERR_SAMPLES).astype(np.float32)


def _histograms(
    rig: GradientRig, _strains: list[StateStrain], _facets: Roughness, **made: Any
) -> Mapping[str, Any]:
    by_state = _by_state(made)
    noise = _by_state(made, "_slope_noise_")
    found = count_normals(_strains, by_state, pixel_um=rig.pixel_um)
    occlusion, by_noise = {}, {}
    for each in _strains:
        name, height = each.state.name, by_state[each.state.name]
        if name in found:
            counted = common_skin(each, _strains[0], by_state)
            axis = {"pixel_um": rig.pixel_um, "angle_rad": each.state.angle_rad}
            by_noise[name] = noise_variances(height.values, noise[name], valid=counted, **axis)
            occlusion[name] = estimate_occlusion_ratios(
                height.values,
                height.mask,
                lights=rig.lights,
                alpha=_facets.alpha,
                counted=counted,
                **axis,
            )
    document = histogram_document(_strains, found, occlusion, by_noise)
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
