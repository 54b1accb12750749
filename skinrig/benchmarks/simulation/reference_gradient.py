"""Benchmark of diffuse normals and albedo from crossed images of voxel skin.

The same orientations are also lit by the fast renderer's equations, whose interior is Lambertian.
"""

import dataclasses
from collections import defaultdict
from dataclasses import dataclass
from typing import Final

import numpy as np

from capture.rig import Rig, load_rig
from model.metrics import angular_error_rad
from model.vectors import unit_vectors
from reconstruction.gradient_normals import SensorNoise, SphereLights, from_patterns
from reconstruction.normal_maps import NormalMaps
from reconstruction.pipeline.gradient.stages import DIFFUSE_SMOOTH_PX
from rigsim.as_built.sphere import PATTERN_WEIGHTS, ActualSphere, nominal_sphere
from rigsim.scenes.gradient.scene import GRADIENT_METER_RATE_PER_S
from rigsim.scenes.reference.gradient_skin import (
    BAND_NODES_NM,
    predict_moments,
    render_moments,
    turn_skin,
    weigh_bands,
)
from rigsim.scenes.reference.patch import SkinPatch, draw_patch
from rigsim.subject.person_skin import PersonSkin, draw_tissue
from rigsim.tissue.skin_layers import skin_layer_stack
from rigsim.tissue.tissue_mc import trace_photons
from skinrig.arrays import Float64Array
from skinrig.benchmarks.gradient_rig.gradient_normals import PATTERN_EXPOSURE_S
from skinrig.benchmarks.measurement import measure_processor_time
from skinrig.benchmarks.resampling import mean_error
from skinrig.benchmarks.results import Timing
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.evaluating.surface import RAYLEIGH_68

NO_MEMORY_REASON = "renderer and estimator share the process"
LIT_PRESETS: Final = ("I", "III", "V", "VI")
LIT_SITE: Final = "cheek"
LIT_FIELD_MM: Final = 4.0
LIT_VOXEL_MM: Final = 0.25
TILTS_DEG: Final = (0.0, 25.0, 45.0)
N_DRAWS: Final = 256
NOISE_PX: Final = 24
"""Side of the images with the sensor's noise, pixels of 6 um: skin is even over so few."""
R_D_PHOTONS: Final = 40_000
PERSON_SEED_OFFSET: Final = 700


@dataclass(frozen=True, slots=True, eq=False)
class LitSkin:
    """Light of one person in one orientation, in the camera's band."""

    moments: Float64Array
    """Of the voxels, over a white diffuser's full light, shape (4,)."""
    covariance: Float64Array
    """Covariance of `moments` by the renderer's noise, shape (4, 4)."""
    fast: Float64Array
    """The same by the fast renderer's equations."""
    normal: Float64Array
    """True normal, rig frame."""
    albedo: float
    """True diffuse reflectance, by the photon walk."""


@dataclass(frozen=True, slots=True)
class NormalAccuracy:
    """Accuracy of the diffuse normals of one orientation."""

    angle_deg: float
    """Angle between the mean normal and the truth."""
    tilt_deg: float
    """Part of it away from the camera's axis, > 0 where the tilt is overestimated."""
    noise_deg: float
    """Standard error of each tangential component by the renderer's noise."""
    coverage: float
    """Fraction of pixels whose 68 % cone, with the renderer's noise, has the true normal."""
    albedo: float
    """Mean albedo over the truth."""
    albedo_coverage: float
    """Fraction of 68 % intervals, with the renderer's noise, that contain the true albedo."""
    stated_deg: float
    """Median half angle of the stated 68 % cones."""


def light_person(
    person: PersonSkin, rig: Rig, turn: Float64Array, *, width_px: int, samples: int, seed: int
) -> LitSkin:
    """Render a person's skin in one orientation, by voxels and by the fast equations.

    Parameters
    ----------
    person
        The person.
    rig
        The gradient rig.
    turn
        See `rigsim.scenes.reference.gradient_skin.turn_skin`.
    width_px, samples, seed
        As for `rigsim.scenes.reference.gradient_skin.render_moments`.
    """
    patch = draw_patch(person, LIT_SITE, field_mm=LIT_FIELD_MM, voxel_mm=LIT_VOXEL_MM)
    sphere = nominal_sphere(rig)
    moments, covariance, fast = np.zeros(4), np.zeros((4, 4)), np.zeros(4)
    albedo = 0.0
    for k, (wavelength_nm, weight) in enumerate(zip(BAND_NODES_NM, weigh_bands(rig), strict=True)):
        image = render_moments(
            patch,
            rig,
            sphere,
            turn,
            wavelength_nm,
            width_px=width_px,
            samples=samples,
            seed=len(BAND_NODES_NM) * seed + k,
        )
        r_d = _field_reflectance(patch, wavelength_nm, seed)
        moments += weight * image.mean
        covariance += weight**2 * image.covariance
        fast += weight * predict_moments(r_d, rig, sphere, turn)
        albedo += weight * r_d
    return LitSkin(moments, covariance, fast, turn[2], albedo)


def _field_reflectance(patch: SkinPatch, wavelength_nm: float, seed: int) -> float:
    """Return R_d of flat layers with the field's mean pigment and blood."""
    inner = np.abs(patch.x_mm) < 0.5 * patch.field_mm
    melanin, blood = (
        float(part[np.ix_(inner, inner)].mean()) for part in (patch.melanin, patch.blood)
    )
    stack = skin_layer_stack(wavelength_nm, melanin, blood, patch.tissue)
    found = trace_photons(stack, photons=R_D_PHOTONS, rng=np.random.default_rng(seed))
    return found.reflectance


def estimate_normals(
    moments: Float64Array, rig: Rig, sphere: ActualSphere, *, seed: int
) -> NormalMaps:
    """Return diffuse normals and albedo of even skin, with the sensor's noise, as a session does.

    Parameters
    ----------
    moments
        Light of the four moments over a white diffuser's, shape (4,).
    rig, sphere
        The gradient rig, and its LEDs, which are known.
    seed
        Seed of the noise.
    """
    view = rig.views[0]
    exposed = GRADIENT_METER_RATE_PER_S * PATTERN_EXPOSURE_S
    noise = SensorNoise(1.0 / view.full_well_e, (view.read_noise_e / view.full_well_e) ** 2)
    rng = np.random.default_rng([seed, 0x6772])
    images = {}
    for name, weights in PATTERN_WEIGHTS.items():
        level = exposed * float(np.dot(weights, moments))
        spread = np.sqrt(noise.read_variance + noise.gain * max(level, 0.0))
        images[name, "crossed"] = level + spread * rng.standard_normal((NOISE_PX, NOISE_PX))
    distance = np.linalg.norm(sphere.position_mm, axis=1)
    found = from_patterns(
        images,
        component="diffuse",
        variance=noise,
        lights=SphereLights(
            sphere.position_mm / distance[:, None],
            sphere.intensity,
            programmed=sphere.weights[:, 1:],
            distance_mm=float(distance.mean()),
        ),
        smoothing=DIFFUSE_SMOOTH_PX,
    )
    return dataclasses.replace(
        found, albedo=found.albedo / exposed, stderr_albedo=found.stderr_albedo / exposed
    )


def judge_normals(
    lit: LitSkin, moments: Float64Array, rig: Rig, *, seed: int, has_noise: bool
) -> NormalAccuracy:
    """Compare normals and albedo of an orientation with the truth.

    Parameters
    ----------
    lit
        The skin.
    moments
        Its light, of voxels or by the fast equations.
    rig
        The gradient rig.
    seed
        Seed of the sensor's noise.
    has_noise
        Whether the moments have the renderer's noise.
    """
    sphere = nominal_sphere(rig)
    found = estimate_normals(moments, rig, sphere, seed=seed)
    good = found.valid
    normals = found.normals[good]
    noise = 0.0
    if has_noise:
        draws = np.random.default_rng(seed).multivariate_normal(moments, lit.covariance, N_DRAWS)
        ways = unit_vectors(draws[:, 1:])
        noise = float(np.sqrt(0.5 * ways.var(axis=0).sum()))
    cone = RAYLEIGH_68 * np.sqrt(0.5 * found.stderr_rad[good] ** 2 + noise**2)
    errors = angular_error_rad(normals, np.broadcast_to(lit.normal, normals.shape))
    mean = normals.mean(axis=0) / np.linalg.norm(normals.mean(axis=0))
    relative = np.sqrt(lit.covariance[0, 0]) / moments[0] if has_noise else 0.0
    spread = np.hypot(found.stderr_albedo[good], relative * found.albedo[good])
    close = np.abs(found.albedo[good] - lit.albedo) <= spread
    return NormalAccuracy(
        float(np.degrees(np.arccos(np.clip(mean @ lit.normal, -1.0, 1.0)))),
        float(np.degrees(np.arccos(mean[2]) - np.arccos(lit.normal[2]))),
        float(np.degrees(noise)),
        float((errors <= cone).mean()),
        float(found.albedo[good].mean() / lit.albedo),
        float(close.mean()),
        float(np.degrees(RAYLEIGH_68 / np.sqrt(2.0) * np.median(found.stderr_rad[good]))),
    )


def draw_lit_person(preset: str, seed: int) -> PersonSkin:
    """Return a person of a preset with drawn optics.

    Examples
    --------
    >>> draw_lit_person("III", 0).tissue == draw_lit_person("III", 1).tissue
    False
    """
    person = PersonSkin.of_preset(preset, seed=seed)
    return dataclasses.replace(person, tissue=draw_tissue(PERSON_SEED_OFFSET + seed))


def measure_reference_gradient(stage: BenchmarkStage) -> None:
    """Measure diffuse normals and albedo of voxels, and of the fast renderer's equations."""
    presets, tilts, width, samples = (
        (LIT_PRESETS[1:3], TILTS_DEG[1:], 4, 64) if stage.toy else (LIT_PRESETS, TILTS_DEG, 8, 512)
    )
    rig = load_rig("gradient")
    found: dict[tuple[str, float], list[NormalAccuracy]] = defaultdict(list)
    seconds = 0.0
    for seed, preset in enumerate(presets):
        person = draw_lit_person(preset, seed)
        for k, tilt_deg in enumerate(tilts):
            turn = turn_skin(tilt_deg, GOLDEN_DEG * (len(tilts) * seed + k))
            spent_s, lit = measure_processor_time(
                lambda: light_person(
                    person, rig, turn, width_px=width, samples=samples, seed=len(tilts) * seed + k
                )
            )
            seconds += spent_s
            for image, moments in (("voxels", lit.moments), ("fast", lit.fast)):
                found[image, tilt_deg].append(
                    judge_normals(lit, moments, rig, seed=seed, has_noise=image == "voxels")
                )
    timing = Timing.single(seconds / len(presets) / len(tilts), no_memory_reason=NO_MEMORY_REASON)
    for (image, tilt_deg), people in found.items():
        stage.add(
            {"image": image, "tilt, degrees": tilt_deg},
            timing,
            mean_error([one.angle_deg for one in people]),
            {
                "error of the tilt, degrees": _mean(people, "tilt_deg"),
                "its standard error by the renderer's noise": round(
                    float(np.sqrt(np.mean([one.noise_deg**2 for one in people]) / len(people))), 3
                ),
                "stated 68 % cone, degrees": _mean(people, "stated_deg"),
                "coverage of 68 % cones": _mean(people, "coverage"),
                "albedo over the truth": _mean(people, "albedo"),
                "coverage of 68 % intervals of albedo": _mean(people, "albedo_coverage"),
            },
        )
    for image in ("voxels", "fast"):
        own = [one for (name, _), some in found.items() if name == image for one in some]
        stage.limits["coverage", image] = _mean(own, "coverage")
        stage.limits["angle", image] = max(one.angle_deg for one in own)


GOLDEN_DEG: Final = 137.5
"""Step of the azimuth from one orientation to the next."""


def _mean(people: list[NormalAccuracy], name: str) -> float:
    return round(float(np.mean([getattr(one, name) for one in people])), 3)
