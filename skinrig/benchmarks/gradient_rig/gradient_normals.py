"""Benchmark of gradient normals on simulated skin: patterns, corrections, filters, pixels."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter
from threadpoolctl import threadpool_limits

from capture.rig import Rig, load_rig
from model.metrics import angular_error_rad
from reconstruction.gradient_normals import SensorNoise, SphereLights, from_patterns
from reconstruction.normal_maps import NormalMaps
from rigsim.as_built.sphere import ActualSphere, nominal_sphere
from rigsim.scenes.gradient.scene import GradientScene
from rigsim.scenes.gradient.truth import gradient_truth as ground_truth
from rigsim.skin_patch.microrelief import make_micro_skin
from rigsim.subject.pigment import MELANIN_PRESETS
from rigsim.world.taped_skin import GripState
from skinrig.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from skinrig.benchmarks.measurement import LIMIT_CORES, measure_processor_seconds
from skinrig.benchmarks.resampling import bootstrap_interval
from skinrig.benchmarks.results import ErrorEstimate, Knobs
from skinrig.benchmarks.stage import BenchmarkStage, LimitValues
from skinrig.evaluating.skin_bands import MelaninBand

Images = Mapping[tuple[str, str], FloatArray]

NEUTRAL = GripState(0.0, 0, 8.0, 1.0, True, False)
PATTERN_EXPOSURE_S = 0.03
MELANIN_PRESET = "III"
"""Melanin preset of the skin."""
PATTERN_NAMES = ("full", "x", "y", "z", "-x", "-y", "-z", "dark")
ANALYZER_DEG = {"parallel": 0.0, "crossed": 90.0}
RELIEF_BLUR_PX = 8.0
"""Standard deviation of the Gaussian that smooths the relief of the smooth patch, texels."""
IGNORED_BORDER_PX = 6
"""Border that is not evaluated: the lens blurs the surroundings into it."""


@dataclass(frozen=True, slots=True)
class SkinPatch:
    """Noise-free images of skin in the gradient rig, with ground truth."""

    images: dict[tuple[str, str], Float32Array]
    """Fractions of full scale."""
    visible: Float64Array
    """Normals at the lens' resolution, (H, W, 3)."""
    sharp: Float64Array
    lights: SphereLights
    geometry: dict[str, Any]
    """View direction and position of each pixel."""
    noise: SensorNoise


def ideal_light_calibration(sphere: ActualSphere) -> SphereLights:
    """Return the lights of a sphere as calibrated without error."""
    distance = np.linalg.norm(sphere.position_mm, axis=1)
    directions = sphere.position_mm / distance[:, None]
    # a polarizer transmits the field across its absorbing axis and across the ray
    fields = np.cross(sphere.absorbs, directions)
    middle = float(np.median(distance))
    return SphereLights(
        directions,
        sphere.intensity * (middle / distance) ** 2,
        programmed=sphere.weights[:, 1:],
        polarizers=fields / np.linalg.norm(fields, axis=1)[:, None],
        distance_mm=middle,
    )


def pixel_geometry(rig: Rig) -> dict[str, Any]:
    """Return the view direction and the position of each pixel, as `from_patterns` takes them."""
    view = rig.views[0]
    distance = float(np.linalg.norm(view.position_mm))
    pixel = view.pixel_um * 1e-3 * distance / view.focal_mm
    x = (np.arange(view.width_px) - (view.width_px - 1) / 2) * pixel
    y = ((view.height_px - 1) / 2 - np.arange(view.height_px)) * pixel
    points = np.stack([*np.meshgrid(x, y), np.zeros((view.height_px, view.width_px))], axis=-1)
    view_dir = np.array([0.0, 0.0, distance]) - points
    view_dir /= np.linalg.norm(view_dir, axis=-1, keepdims=True)
    return {"points_mm": points, "view": view_dir}


def render_skin_patch(side: int, *, smooth: bool) -> SkinPatch:
    """Render a patch of cheek, as it is or smoothed, under all sixteen conditions."""
    rig = load_rig("gradient").cropped(side)
    size_mm = max(0.006 * side + 0.8, 1.2)
    skin = make_micro_skin("cheek", seed=5, size_mm=size_mm, preset=MELANIN_PRESET)
    if smooth:
        height = gaussian_filter(skin.height_um, RELIEF_BLUR_PX, mode="wrap").astype(np.float32)
        skin = replace(skin, height_um=height)
    sphere = nominal_sphere(rig)
    scene = GradientScene(rig, skin, sphere=sphere)
    images = {
        (name, polarizer): PATTERN_EXPOSURE_S
        * scene.radiance(name, grip=NEUTRAL, analyzer_deg=ANALYZER_DEG[polarizer])
        for name in PATTERN_NAMES
        for polarizer in ANALYZER_DEG
    }
    truth = ground_truth(scene, [NEUTRAL]).maps
    view = rig.views[0]
    # in fractions of full scale, where a full well is 1: gain 1 / N and read variance (r / N)^2
    noise = SensorNoise(1.0 / view.full_well_e, (view.read_noise_e / view.full_well_e) ** 2)
    return SkinPatch(
        images,
        np.asarray(truth["normals_seen_a000_n0"].values, np.float64),
        np.asarray(truth["normals"].values, np.float64),
        ideal_light_calibration(sphere),
        pixel_geometry(rig),
        noise,
    )


def add_sensor_noise(
    patch: SkinPatch, rng: np.random.Generator
) -> dict[tuple[str, str], Float32Array]:
    """Return the images with shot and read noise of the sensor."""
    read, gain = patch.noise.read_variance, patch.noise.gain
    return {
        key: (
            image + np.sqrt(read + gain * image) * rng.standard_normal(image.shape, np.float32)
        ).astype(np.float32)
        for key, image in patch.images.items()
    }


def normals_without_corrections(images: Images) -> Float64Array:
    """Compute normals by Ma et al.'s formula in plain NumPy, with complements, (H, W, 3)."""
    # differences of complementary patterns give the mirror direction r; n is halfway between r and
    # the view +z
    s = {
        name: images[name, "parallel"].astype(np.float64) - images[name, "crossed"]
        for name in PATTERN_NAMES[:7]
    }
    c = np.stack([s[axis] - s[f"-{axis}"] for axis in "xyz"], axis=-1)
    n = c / np.linalg.norm(c, axis=-1, keepdims=True) + [0.0, 0.0, 1.0]
    return np.asarray(n / np.linalg.norm(n, axis=-1, keepdims=True))


def _evaluate(normals: FloatArray, valid: BoolArray, truth: Float64Array) -> ErrorEstimate:
    inner = (slice(IGNORED_BORDER_PX, -IGNORED_BORDER_PX),) * 2
    good = valid[inner]
    error = np.degrees(angular_error_rad(normals[inner][good], truth[inner][good]))
    # errors of neighboring pixels are correlated: blocks of rows are resampled, not pixels
    parts = [part.mean() for part in np.array_split(error, 64) if part.size]
    return ErrorEstimate(float(error.mean()), bootstrap_interval(parts, np.mean))


def measure_normals(stage: BenchmarkStage) -> None:
    """Measure normals of a skin patch over patterns, corrections and filters, then full size."""
    rng = np.random.default_rng(0)
    side = 40 if stage.toy else 192
    patch = render_skin_patch(side, smooth=False)
    noisy = add_sensor_noise(patch, rng)
    corrections = {"lights": patch.lights, **patch.geometry}

    def add(knobs: Knobs, images: Images, **options: Any) -> float:
        def error(found: NormalMaps) -> ErrorEstimate:
            outcome = _evaluate(found.normals, found.valid, patch.visible)
            if "variance" not in options or "smoothing" in options:
                return outcome
            # weighted least squares attains the bound; a Rayleigh error has the mean
            # sqrt(pi) / 2 = 0.886 of its root mean square
            rms = float(np.degrees(np.sqrt(np.pi) / 2 * found.stderr_rad[found.valid].mean()))
            return replace(outcome, cramer_rao_bound=rms)

        knobs.setdefault("noise", "the sensor's")
        return stage.measure(knobs, lambda: from_patterns(images, **options), error).error

    subsets = {
        "16": PATTERN_NAMES,
        "14, no dark": PATTERN_NAMES[:7],
        "14, no -x": tuple(n for n in PATTERN_NAMES if n != "-x"),
        "8": ("full", "x", "y", "z"),
        "8, x and -x": ("x", "-x", "y", "z"),
    }
    base = {**corrections, "variance": patch.noise, "smoothing": "wiener"}
    worst = 0.0
    for label, names in subsets.items():
        some = {key: image for key, image in noisy.items() if key[0] in names}
        error = add({"patterns": label, "filter": "Wiener"}, some, **base)
        worst = error if label == "16" else worst
        if stage.toy and label != "16":
            break
    plain = {**corrections, "variance": patch.noise}
    add({"patterns": "16", "filter": "none"}, noisy, **plain)
    for sigma in (1.0,) if stage.toy else (0.7, 1.0, 1.5):
        add({"patterns": "16", "filter": "Gaussian", "px": sigma}, noisy, smoothing=sigma, **plain)
    knobs: Knobs = {"patterns": "16", "filter": "Wiener", "lights": "ideal"}
    add(knobs, noisy, variance=patch.noise, smoothing="wiener")
    add({"patterns": "16", "noise": "none"}, patch.images, **corrections)
    add({"patterns": "16", "noise": "none", "lights": "ideal"}, patch.images)
    stage.measure_bands(lambda band: _on_skin(patch, band))
    if not stage.toy:
        stage.limits = _limits(worst, rng)


def _on_skin(patch: SkinPatch, band: MelaninBand) -> ErrorEstimate:
    """Return the error on the same relief with a band's melanin, 16 patterns, all corrections.

    Crossed images contain half of the diffuse reflection, parallel images the other half and the
    specular reflection. A change of albedo thus changes both by a fraction of the crossed image.
    """
    usual = replace(band, melanin=MELANIN_PRESETS[MELANIN_PRESET]).reflectance()
    ratio = float((band.reflectance() / usual)[1])
    images = {
        (name, polarizer): image - np.float32(1.0 - ratio) * patch.images[name, "crossed"]
        for (name, polarizer), image in patch.images.items()
    }
    seen = replace(patch, images=images)
    found = from_patterns(
        add_sensor_noise(seen, np.random.default_rng(0)),
        lights=patch.lights,
        variance=patch.noise,
        smoothing="wiener",
        **patch.geometry,
    )
    return _evaluate(found.normals, found.valid, patch.visible)


def _limits(worst: float, rng: np.random.Generator) -> LimitValues:
    smooth = render_skin_patch(128, smooth=True)
    found = from_patterns(smooth.images, lights=smooth.lights, **smooth.geometry)
    against = {"lens' resolution": smooth.visible, "as it is": smooth.sharp}
    big = {
        key: np.tile(image, (16, 16)).astype(np.float32)
        for key, image in add_sensor_noise(smooth, rng).items()
    }
    options: dict[str, Any] = {"lights": smooth.lights, "alpha": 0.26, "variance": smooth.noise}
    ours_s = measure_processor_seconds(lambda: from_patterns(big, **options), 3) / LIMIT_CORES
    with threadpool_limits(1):
        peer_s = measure_processor_seconds(lambda: normals_without_corrections(big))
    return {
        **{
            ("clean", name): _evaluate(found.normals, found.valid, true).error
            for name, true in against.items()
        },
        "noisy": worst,
        "seconds": ours_s,
        "slowdown": LIMIT_CORES * ours_s / peer_s,
    }
