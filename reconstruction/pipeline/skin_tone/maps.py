"""Maps of skin tone: Lab, typology angle, Monk tone, erythema and melanin index.

All describe the skin itself, whatever its angle to the light: their input is the reflectance of
skin, with shading removed.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from capture.calibration.color import ColorMatrix
from capture.calibration.color.colorimetry import delta_e_2000, xyz_to_linear_srgb
from model import fresnel, skin_tone, spectra
from model.skin import MAP_UNITS, SkinMap
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray, UInt8Array
from reconstruction.pipeline.graph import PipelineStage
from reconstruction.pipeline.masked_map import masked_map
from reconstruction.pipeline.skin_tone import kernels
from reconstruction.pipeline.skin_tone.chart_correction import (
    SkinColorCorrection,
    skin_color_correction,
)

SURFACE_REFLECTION: Final = skin_tone.sphere_specular()
"""Reflectance added to diffuse reflectance before Lab: the bands of the typology angle and the
published colors of skin come from spheres that include the surface reflection (d/8)."""
MAP_NAMES: Final = (
    "lab",
    "ita",
    "monk",
    "monk_low",
    "monk_high",
    "erythema_index",
    "melanin_index",
)
"""Names of the maps."""
REFLECTANCE_PRODUCT: Final = "skin_reflectance"
"""Name of the product that the stages read."""
MONK_STEP: Final = 0.5
"""Step of L*, a* and b* to which colors are rounded before the nearest Monk tone: at most 0.43 off
in color difference."""
_LAB_LOW: Final = np.array([-20.0, -100.0, -100.0])
_LAB_HIGH: Final = np.array([130.0, 100.0, 100.0])


def tone_stages(
    stage: Callable[..., PipelineStage],
    color: tuple[ColorMatrix | None, Float64Array | None],
    *,
    refused: str,
    camera: str,
    illuminant: str,
) -> list[PipelineStage]:
    """Return the stages that make the maps of skin tone from the product `skin_reflectance`.

    Parameters
    ----------
    stage
        Factory of stages, see `graph.make_stage_factory`.
    color
        Matrix of the color calibration, and the camera RGB of white that belongs to it; or None.
    refused
        Why brightness is unknown, so that all but the erythema index are refused; empty: known.
    camera, illuminant
        Names of spectra.
    """
    table = {"camera": camera, "illuminant": illuminant}
    tone_camera = partial(ToneCamera.of, camera, illuminant, *color)
    both, tones = "lab lab_covariance", "monk monk_low monk_high"
    return [
        stage("lab", REFLECTANCE_PRODUCT, both, partial(lab_map, tone_camera), refused, **table),
        stage("ita", both, "ita", ita_map),
        stage("monk", both, tones, monk_maps),
        stage("melanin_index", REFLECTANCE_PRODUCT, "melanin_index", melanin_index_map, refused),
    ]


@dataclass(frozen=True, slots=True, eq=False)
class SkinReflectance:
    """Diffuse reflectance of skin in camera RGB, white = 1, with shading removed."""

    rgb: Float32Array
    """(H, W, 3); positive where valid."""
    variance: Float32Array
    """Variance of each channel by errors that the channels do not share."""
    log_variance: Float32Array
    """(H, W): relative variance by errors that scale the channels together."""
    valid: BoolArray

    @classmethod
    def of_map(cls, reflectance: SkinMap) -> "SkinReflectance":
        """Return a map's reflectance, whose errors are those of each channel.

        Parameters
        ----------
        reflectance
            Three channels with standard errors.
        """
        good = reflectance.mask & (reflectance.values > 0.0).all(axis=-1)
        values = np.where(good[..., None], reflectance.values, np.float32(1.0))
        error = np.zeros_like(values) if reflectance.stderr is None else reflectance.stderr
        none = np.zeros(good.shape, np.float32)
        return cls(values, np.square(np.where(good[..., None], error, 0.0)), none, good)

    def with_common_errors(self) -> "SkinReflectance":
        """Return the same with the smallest relative variance of the channels as a common one.

        It suits errors that are not noise, such as those of normals and positions: they scale all
        channels.
        """
        relative = self.variance / np.square(self.rgb)
        common = relative.min(axis=-1)
        own = (relative - common[..., None]) * np.square(self.rgb)
        return replace(self, variance=own, log_variance=self.log_variance + common)

    def in_light(
        self, log_light: Float32Array, log_variance: Float32Array, valid: BoolArray
    ) -> "SkinReflectance":
        """Divide by the light on each pixel.

        Parameters
        ----------
        log_light, log_variance
            (H, W): logarithm of the light over that on a white reference, and its variance.
        valid
            Where the light is known.
        """
        light = np.exp(np.where(valid, log_light, 0.0))[..., None]
        return SkinReflectance(
            np.asarray(self.rgb / light, np.float32),
            np.asarray(self.variance / np.square(light), np.float32),
            self.log_variance + log_variance,
            self.valid & valid,
        )


def reflectance_of_albedo(r_d: SkinMap) -> SkinReflectance:
    """Return reflectance at normal incidence, all light collected, as instruments measure it.

    Parameters
    ----------
    r_d
        Diffuse albedo of the dome: a factor between the transmittances of the boundary, into the
        skin and out of it (Weyrich et al. 2006, doi:10.1145/1141911.1141987, eq. 6). Its errors by
        normals and positions scale the channels together.
    """
    entering = 1.0 - fresnel.normal_reflectance(fresnel.ETA_SKIN)
    leaving = 1.0 - fresnel.diffuse_external(fresnel.ETA_SKIN)
    scale = np.float32(entering * leaving)
    error = None if r_d.stderr is None else scale * r_d.stderr
    scaled = replace(r_d, values=scale * r_d.values, stderr=error)
    return SkinReflectance.of_map(scaled).with_common_errors()


@dataclass(frozen=True, slots=True)
class ToneCamera:
    """Conversion of white-balanced camera RGB of skin to linear sRGB with its uncertainty."""

    correction: SkinColorCorrection
    matrix: ColorMatrix
    """Camera RGB to XYZ: of the color calibration, or the nominal one."""
    neutral: Float64Array
    """Camera RGB of white that belongs to `matrix`, (3,)."""

    @classmethod
    def of(
        cls, camera: str, illuminant: str, matrix: ColorMatrix | None, neutral: Float64Array | None
    ) -> "ToneCamera":
        """Return the conversion of a calibrated camera, or of the nominal one without a matrix.

        Parameters
        ----------
        camera, illuminant
            Names of spectra.
        matrix, neutral
            The color calibration: matrix, and camera RGB of a white surface.
        """
        if matrix is None or neutral is None:
            correction = skin_color_correction(camera, illuminant, has_chart=False)
            exact = np.zeros_like(correction.nominal.stderr)
            return cls(correction, replace(correction.nominal, stderr=exact), np.ones(3))
        correction = skin_color_correction(camera, illuminant, method=matrix.method)
        return cls(correction, _without_misfit(matrix, correction.nominal, neutral), neutral)

    def lab(
        self, rgb: FloatArray, variance: FloatArray, log_variance: FloatArray | float = 0.0
    ) -> tuple[Float32Array, Float32Array]:
        """Return CIE L*a*b* of skin with the surface reflection, and its covariance.

        Parameters
        ----------
        rgb, variance
            (n, 3): diffuse reflectance in camera RGB, white = 1, and its variance.
        log_variance
            (n,) or one: relative variance by errors that scale the channels together.

        Returns
        -------
        lab : ndarray of float32, shape (n, 3)
        covariance : ndarray of float32, shape (n, 3, 3)
            By these errors, the matrix, and the remaining error of the correction.
        """
        light = (rgb + SURFACE_REFLECTION) * self.neutral
        noise = variance * np.square(self.neutral)
        to_xyz = np.linalg.inv(spectra.XYZ_TO_LINEAR_SRGB)
        adapted = to_xyz @ xyz_to_linear_srgb(np.eye(3), illuminant=self.matrix.illuminant).T
        found = np.empty(light.shape, np.float32)
        covariance = np.empty((*light.shape, 3), np.float32)
        kernels.fill_lab(
            np.ascontiguousarray(light, np.float64),
            np.ascontiguousarray(noise, np.float64),
            (
                np.ascontiguousarray(rgb * self.neutral, np.float64),
                np.array(np.broadcast_to(log_variance, len(light)), np.float64),
            ),
            np.asarray(self.neutral, np.float64),
            (
                np.ascontiguousarray(self.matrix.matrix),
                np.ascontiguousarray(np.square(self.matrix.stderr)),
                np.ascontiguousarray(adapted),
                to_xyz.sum(axis=1),
            ),
            np.ascontiguousarray(self.correction.coefficients),
            (self.correction.log_y, self.correction.log_covariance),
            found,
            covariance,
        )
        return found, covariance


def _without_misfit(
    matrix: ColorMatrix, nominal: ColorMatrix, neutral: Float64Array
) -> ColorMatrix:
    """Reduce a matrix's standard errors by those of the nominal camera without noise.

    The jackknife includes the misfit of patches, which the correction removes from skin.
    """
    balanced = np.square(matrix.stderr[:, :3] * neutral)
    share = max(
        1.0 - float(np.square(nominal.stderr[:, :3]).sum() / max(balanced.sum(), 1e-300)), 0.0
    )
    return replace(matrix, stderr=matrix.stderr * np.sqrt(share))


@dataclass(frozen=True, slots=True)
class LabCovariance:
    """Covariance of a map of Lab, (H, W, 3, 3)."""

    values: Float32Array


def lab_map(
    camera: Callable[[], ToneCamera], skin_reflectance: SkinReflectance
) -> Mapping[str, SkinMap | LabCovariance]:
    """Return `lab` with its standard errors, and `lab_covariance`."""
    given, good = skin_reflectance, skin_reflectance.valid
    found, covariance = camera().lab(
        given.rgb[good], given.variance[good], given.log_variance[good]
    )
    values = np.zeros(given.rgb.shape, np.float32)
    whole = np.zeros((*values.shape, 3), np.float32)
    values[good], whole[good] = found, covariance
    error = np.sqrt(np.maximum(np.diagonal(whole, axis1=-2, axis2=-1), 0.0))
    what = "CIE L*, a*, b* of skin under D65, surface reflection as in a sphere d/8 included"
    return {
        "lab": masked_map(values, error, good, MAP_UNITS["lab"], what),
        "lab_covariance": LabCovariance(whole),
    }


def ita_map(lab: SkinMap, lab_covariance: LabCovariance) -> SkinMap:
    """Return the individual typology angle in degrees."""
    angle = np.zeros(lab.mask.shape, np.float32)
    error = np.zeros(lab.mask.shape, np.float32)
    colors = lab.values[lab.mask]
    angle[lab.mask] = skin_tone.ita(colors)
    error[lab.mask] = skin_tone.ita_stderr(colors, lab_covariance.values[lab.mask])
    what = "individual typology angle of skin, degrees"
    return masked_map(angle, error, lab.mask, MAP_UNITS["ita"], what)


def monk_maps(lab: SkinMap, lab_covariance: LabCovariance) -> Mapping[str, SkinMap]:
    """Return the nearest Monk tone, and those one standard error of L* lighter and darker."""
    colors = lab.values[lab.mask]
    # other coordinates move with lightness as their covariance with it makes them
    of_lightness = lab_covariance.values[..., 0][lab.mask]
    step = of_lightness / np.sqrt(np.maximum(of_lightness[..., :1], 1e-12))
    tones = nearest_monk_tone(np.stack([colors, colors + step, colors - step]))
    by_name = {"monk": tones[0], "monk_low": tones.min(axis=0), "monk_high": tones.max(axis=0)}
    meaning = {
        "monk": "Monk skin tone 1 (light) to 10 with the nearest color, CIEDE2000",
        "monk_low": "lightest Monk tone of the 68 % interval of lightness",
        "monk_high": "darkest Monk tone of the 68 % interval of lightness",
    }
    maps = {}
    for name, found in by_name.items():
        values = np.zeros(lab.mask.shape, np.float32)
        values[lab.mask] = found
        maps[name] = masked_map(values, None, lab.mask, MAP_UNITS[name], meaning[name])
    return maps


def nearest_monk_tone(lab_color: FloatArray) -> UInt8Array:
    """Return the nearest Monk tone of many colors by rounding them to `MONK_STEP`.

    Parameters
    ----------
    lab_color
        (..., 3), CIE L*a*b* under D65, finite.

    Returns
    -------
    ndarray of uint8
        (...), 1 to 10. Tones differ from those of `model.skin_tone.monk` only where two tones are
        nearly as near: their color differences are within 0.9.

    Examples
    --------
    >>> nearest_monk_tone(np.array([[77.8, 2.9, 23.7], [15.0, 1.0, 2.0]])).tolist()
    [5, 10]
    """
    sides = tuple(int(side) for side in (_LAB_HIGH - _LAB_LOW) / MONK_STEP + 1.0)
    index = np.zeros(lab_color.shape[:-1], np.int32)
    for axis, (low, side) in enumerate(zip(_LAB_LOW, sides, strict=True)):
        cell = np.rint((lab_color[..., axis] - np.float32(low)) * np.float32(1.0 / MONK_STEP))
        index *= side
        index += np.clip(cell, 0, side - 1).astype(np.int32)
    occupied = np.zeros(sides, np.bool_)
    occupied.ravel()[index.ravel()] = True
    colors = np.argwhere(occupied) * MONK_STEP + _LAB_LOW
    tone = np.zeros(sides, np.uint8)
    tone[occupied] = skin_tone.monk(colors, delta_e_2000)
    return np.asarray(tone.ravel()[index])


def erythema_map(skin_reflectance: SkinReflectance) -> SkinMap:
    """Return the erythema index of the camera's red and green channels; shading cancels."""
    red, green, _ = np.moveaxis(skin_reflectance.rgb, -1, 0)
    errors = np.moveaxis(np.sqrt(skin_reflectance.variance), -1, 0)
    found = skin_tone.erythema_index(red, green)
    stderr = skin_tone.erythema_index_stderr(red, green, errors[0], errors[1])
    what = f"100 log10(red / green), {_BANDS_NOTE}"
    return masked_map(found, stderr, skin_reflectance.valid, MAP_UNITS["erythema_index"], what)


def melanin_index_map(skin_reflectance: SkinReflectance) -> SkinMap:
    """Return the melanin index of the camera's red channel."""
    red = skin_reflectance.rgb[..., 0]
    variance = skin_reflectance.variance[..., 0] + np.square(red) * skin_reflectance.log_variance
    found = skin_tone.melanin_index(red)
    stderr = skin_tone.melanin_index_stderr(red, np.sqrt(variance))
    what = f"100 log10(1 / red), {_BANDS_NOTE}"
    return masked_map(found, stderr, skin_reflectance.valid, MAP_UNITS["melanin_index"], what)


_BANDS_NOTE: Final = (
    "this camera's channels without surface reflection: not comparable with other cameras, nor "
    "with the narrow bands of instruments"
)
