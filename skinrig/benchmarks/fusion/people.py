"""Draw one person's skin and its measurements by four rigs, with the ground truth.

Spectra come from the simulator's photon transport. People differ in melanin, blood, oxygenation,
scattering, baseline and kind of melanin. Signals have the errors that their covariances state. No
constant of the estimator was set on these people.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy import ndimage

from model import spectra
from model.tissue_optics.constants import SKIN_CONSTANTS
from model.tissue_optics.uncertainty import NUISANCE_PARAMETERS
from model.vectors import unit_vectors
from reconstruction.chromophores.model_error import load_covariance
from reconstruction.fusion.patch_normals import PatchNormals
from reconstruction.fusion.person import PersonSkin, Regions, estimate_person
from reconstruction.fusion.regions import summarize_regions
from reconstruction.fusion.signals import (
    PRESSED_BLOOD,
    SIGMA_TR_DISTANCE_MM,
    SIGMA_TR_OFFSET,
    SIGMA_TR_SD,
    RigBands,
    residual_covariance,
)
from reconstruction.fusion.texels import OffsetModel, RigColors, TexelSkin, estimate_texels
from rigsim.subject.pigment import MELANIN_PRESETS, typical_blood
from rigsim.tissue.skin_layers import DERMIS_SCATTERING_RATIO, TissueProperties, skin_coefficients
from rigsim.tissue.skin_table import SkinTable
from rigsim.tissue.skin_transport import SkinTransportError
from skinrig.arrays import Float64Array
from skinrig.fusing.measurements import LOCAL_SHARE, SITE_SIGMA_TR_SD, summarize_site

CAMERA_NAME: Final = "Nikon 5100 (NPL)"
RIGS: Final = (
    RigBands("dome", CAMERA_NAME, "LED-B3"),
    RigBands("flash", CAMERA_NAME, "D55"),
    RigBands("probe", CAMERA_NAME, "LED-B3", "sigma_tr"),
)
TEXEL_ERROR: Final[Mapping[str, float]] = {"dome": 0.05, "flash": 0.01}
"""Relative standard errors of a texel's color."""
LIGHT_SD: Final = 0.6
"""Standard deviation of log light on a texel in the flash image."""
SHARED_TEXELS: Final = 8
"""Neighboring texels with one error of the dome."""
N_SITES: Final = 3
"""Sites of the probe."""
SITE_TEXELS: Final = 64
"""Texels around a site."""
SITE_NOISE: Final = 0.03
"""Relative standard error of sigma_tr at a site by noise."""
PATCH_PX: Final = 64
"""Side of the gradient rig's patch."""
PATCH_NOISE_RAD: Final = 0.03
"""Standard error of its normals per direction."""


@dataclass(frozen=True, slots=True)
class RigFault:
    """A miscalibration of one rig."""

    rig: str
    log_gain: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Log gain of its channels."""
    rotation_deg: float = 0.0
    """Rotation of its normals about the camera axis."""


@dataclass(frozen=True, eq=False)
class DrawnFace:
    """Measurements of one person by dome, flash rig, probe and gradient rig, with the ground truth.

    Attributes
    ----------
    log_skin
        (N, 2): log melanin volume fraction and log blood.
    log_reflectance
        (N, 3): of the dome's channels.
    colors
        Colors by dome and flash rig.
    log_sigma_tr
        (`N_SITES`, 3): of the probe at sites of `SITE_TEXELS` texels each, from the first one on.
    errors
        Covariances of the signals' errors.
    patch
        Normals by the gradient rig.
    """

    log_skin: Float64Array
    log_reflectance: Float64Array
    colors: tuple[RigColors, ...]
    log_sigma_tr: Float64Array
    errors: OffsetModel
    patch: PatchNormals

    def regions(self, rigs: Sequence[int]) -> Regions:
        """Return the face's median colors by some of the rigs, and those of the probe's sites."""
        colors = [self.colors[k] for k in rigs if k < len(self.colors)]
        labels = np.zeros(len(self.log_skin), np.intp)
        parts = [summarize_regions(colors, labels, self.errors)[0]]
        if len(self.colors) in rigs:
            for k, log_sigma_tr in enumerate(self.log_sigma_tr):
                near = slice(k * SITE_TEXELS, (k + 1) * SITE_TEXELS)
                value = np.exp(log_sigma_tr)
                around = [one.part(near) for one in colors]
                parts.append(summarize_site(value, SITE_NOISE * value, around, self.errors))
        return Regions(
            np.concatenate([part.values for part in parts]),
            np.concatenate([part.covariance for part in parts]),
        )

    def estimate_person(self, regions: Regions) -> PersonSkin:
        """Return the common properties of the skin."""
        return estimate_person(RIGS, regions, self.errors.offset_covariance)

    def estimate(self, rigs: Sequence[int], iterations: int) -> tuple[PersonSkin, TexelSkin]:
        """Return the estimates by some of the rigs."""
        person = self.estimate_person(self.regions(rigs))
        colors = [self.colors[k] for k in rigs if k < len(self.colors)]
        ((_, found),) = estimate_texels(person, colors, self.errors, iterations=iterations)
        return person, found

    @cached_property
    def without_covariance(self) -> "DrawnFace":
        """The same measurements, whose errors count as independent."""
        return replace(
            self,
            colors=tuple(one.without_covariance() for one in self.colors),
            errors=self.errors.without_covariance(),
        )


def draw_face(
    skin_type: str, seed: int, *, texels: int, fault: RigFault | None = None
) -> DrawnFace:
    """Draw a person and the measurements of the rigs.

    Parameters
    ----------
    skin_type
        One of `rigsim.subject.pigment.MELANIN_PRESETS`.
    seed
        Seed of the person and of all errors.
    texels
        Number of texels, a multiple of `SHARED_TEXELS` and at least those of the probe's sites.
    fault
        Miscalibration of a rig.
    """
    rng = np.random.default_rng([seed, 0x6675])
    table, tissue = _draw_table(rng)
    middle = MELANIN_PRESETS[skin_type] * float(np.exp(0.1 * rng.standard_normal()))
    mean = np.log([middle, float(typical_blood(middle))])
    fractions = np.exp(mean + rng.standard_normal((texels, 2)) * [0.15, 0.25])
    fractions = np.clip(fractions, 6e-4, [0.45, 0.25])
    spectrum = table.spectra(*fractions.T.astype(np.float32)).astype(np.float64)
    depth = np.array([np.log(SKIN_CONSTANTS.melanin_depth_factor), 0.0])
    errors = _errors(mean + depth)
    light = errors.unexplained[:6, :6]

    def draw(covariance: Float64Array, *count: int) -> Float64Array:
        drawn = rng.standard_normal((*count, len(covariance)))
        return np.asarray(drawn @ np.linalg.cholesky(covariance).T)

    gains = np.zeros(9)
    if fault is not None and fault.rig in [rig.rig for rig in RIGS]:
        first = 3 * [rig.rig for rig in RIGS].index(fault.rig)
        gains[first : first + 3] = fault.log_gain
    weights = [spectra.band_weights(rig.camera, rig.illuminant) for rig in RIGS[:2]]
    log_color = np.concatenate([np.log(spectrum @ w) for w in weights], axis=-1)
    log_color += draw(light) + draw(LOCAL_SHARE * light, texels)
    offset = draw(errors.calibration[:6, :6]) + gains[:6]
    every = np.ones(texels, bool)
    colors = []
    for k, rig in enumerate(RIGS[:2]):
        at, sd = slice(3 * k, 3 * k + 3), TEXEL_ERROR[rig.rig]
        covariance = np.tile(0.25 * sd**2 * np.eye(3), (texels, 1, 1))
        noise = 0.5 * sd * rng.standard_normal((texels, 3))
        shaded = np.zeros((texels, 1))
        if rig.rig == "dome":
            covariance += 0.75 * sd**2
            few = rng.standard_normal((texels // SHARED_TEXELS, 1))
            noise += np.sqrt(0.75) * sd * np.repeat(few, SHARED_TEXELS, axis=0)
        else:
            shaded = LIGHT_SD * rng.standard_normal((texels, 1))
        seen = log_color[:, at] + offset[at] + noise + shaded
        free = LIGHT_SD**2 if rig.rig == "flash" else 0.0
        colors.append(RigColors(k, seen, covariance, every, free))
    at_sites = np.log(fractions[: N_SITES * SITE_TEXELS]).reshape(N_SITES, SITE_TEXELS, 2)
    log_sigma_tr = _draw_sigma_tr(rng, np.exp(at_sites.mean(axis=1)), tissue) + gains[6:]
    angle = fault.rotation_deg if fault is not None else 0.0
    patch = draw_patch(rng, rotation_deg=angle)
    log_skin = np.log(fractions)
    return DrawnFace(log_skin, log_color[:, :3], tuple(colors), log_sigma_tr, errors, patch)


def _errors(log_skin: Float64Array) -> OffsetModel:
    """Return the covariances of the signals' errors for a face of typical melanin and blood."""
    unexplained = residual_covariance(RIGS, log_skin)
    calibration = np.zeros((9, 9))
    calibration[:3, :3] = 0.02**2 + 0.005**2 * np.eye(3)
    calibration[3:6, 3:6] = 0.1**2 + 0.003**2 * np.eye(3)
    calibration[6:, 6:] = 1e-6 * np.eye(3)
    local = LOCAL_SHARE * unexplained
    local[:6, :6] += np.kron(np.eye(2), load_covariance())
    local[6:] = local[:, 6:] = 0.0
    local[6:, 6:] = SITE_SIGMA_TR_SD**2 * np.eye(3)
    return OffsetModel(unexplained, calibration, local)


def _draw_sigma_tr(
    rng: np.random.Generator, fractions: Float64Array, tissue: TissueProperties
) -> Float64Array:
    """Return log sigma_tr of sites as the probe measures it, (K, 3).

    The coefficients of the pressed dermis are the simulator's. The light at a distance and its
    errors are those that the estimator states, so that these people cannot show a wrong distance
    or offset; sessions of `tools/judge_fused_people.py` do.
    """
    weights = spectra.band_weights(RIGS[2].camera, RIGS[2].illuminant)
    pressed = fractions[:, 1] * PRESSED_BLOOD[0] * np.exp(PRESSED_BLOOD[1] * rng.standard_normal())
    found = skin_coefficients(
        spectra.WAVELENGTH_NM, fractions[:, :1], np.clip(pressed, 0.0, 0.3)[:, None], tissue
    )
    scattering = DERMIS_SCATTERING_RATIO * found.scattering
    sigma_tr = np.sqrt(3.0 * found.dermis * (found.dermis + scattering))
    common = SIGMA_TR_SD[0] * rng.standard_normal() + SIGMA_TR_SD[1] * rng.standard_normal(3)
    own = np.hypot(SITE_SIGMA_TR_SD, SITE_NOISE) * rng.standard_normal((len(fractions), 3))
    # a channel's light at a distance, as a sum over wavelengths
    reached = weights * np.exp(-SIGMA_TR_DISTANCE_MM * sigma_tr)[..., None]
    mean = (reached * sigma_tr[..., None]).sum(axis=1) / reached.sum(axis=1)
    return np.asarray(np.log(mean) + SIGMA_TR_OFFSET + common + own)


def draw_patch(rng: np.random.Generator, *, rotation_deg: float = 0.0) -> PatchNormals:
    """Draw a relief's normals with noise, turned about the camera's axis.

    Parameters
    ----------
    rng
        Generator.
    rotation_deg
        Angle, counterclockwise.
    """
    height = ndimage.gaussian_filter(rng.standard_normal((PATCH_PX, PATCH_PX)), 4.0, mode="wrap")
    slopes = np.stack([np.gradient(height, axis=1), -np.gradient(height, axis=0)], axis=-1)
    slopes = 0.2 * slopes / slopes.std()
    angle = np.radians(rotation_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    seen = slopes @ turn.T + PATCH_NOISE_RAD * rng.standard_normal(slopes.shape)
    normals = unit_vectors(np.concatenate([-seen, np.ones((PATCH_PX, PATCH_PX, 1))], axis=-1))
    stderr = np.full((PATCH_PX, PATCH_PX), PATCH_NOISE_RAD)
    return PatchNormals(normals, stderr, np.ones((PATCH_PX, PATCH_PX), bool), 6.0)


def _draw_table(rng: np.random.Generator) -> tuple[SkinTable, TissueProperties]:
    """Return spectra of a person; properties outside the table of photons are drawn again."""
    while True:
        drawn = {}
        for one in NUISANCE_PARAMETERS:
            if one.name == "epidermis_mm":
                continue  # all maps of melanin presume the thickness
            usual = float(getattr(SKIN_CONSTANTS, one.name))
            off = one.sd * float(np.clip(rng.standard_normal(), -2.0, 2.0))
            name = "baseline_amplitude" if one.name == "baseline_factor" else one.name
            drawn[name] = usual * float(np.exp(off)) if one.is_log else usual + off
        for name in ("oxygenation", "eumelanin_fraction"):
            drawn[name] = min(drawn[name], 1.0)
        try:
            tissue = TissueProperties(**drawn)
            return SkinTable.load(tissue), tissue
        except SkinTransportError:
            continue
