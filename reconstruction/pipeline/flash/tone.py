"""Maps of skin tone of the flash rig: Lab, typology angle, Monk tone, erythema, melanin index."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from capture.calibration.color import ColorMatrix
from capture.calibration.color.colorimetry import delta_e_2000, xyz_to_linear_srgb
from model import skin_tone, spectra
from model.skin import MAP_UNITS, SkinMap
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray, UInt8Array
from reconstruction.pipeline.flash import tone_kernels
from reconstruction.pipeline.flash.skin_color import SkinColorCorrection, skin_color_correction
from reconstruction.pipeline.graph import PipelineStage
from reconstruction.pipeline.masked_map import masked_map

SURFACE_REFLECTION: Final = skin_tone.sphere_specular()
"""Reflectance added to diffuse reflectance before Lab: the bands of the typology angle and the
published colors of skin come from spheres that include the surface reflection (d/8)."""
NEEDS_WHITE: Final = (
    "lab, ita, monk: got a session without a white reference, whose brightness is unknown; "
    "expected a white calibration; make one with `skinrig calibrate white`, then give --calibration"
)
"""Reason for a refusal."""
MONK_STEP: Final = 0.5
"""Step of L*, a* and b* to which colors are rounded before the nearest Monk tone: at most 0.43 off
in color difference."""
_LAB_LOW: Final = np.array([-20.0, -100.0, -100.0])
_LAB_HIGH: Final = np.array([130.0, 100.0, 100.0])


def tone_stages(
    stage: Callable[..., PipelineStage],
    color: tuple[ColorMatrix | None, Float64Array | None],
    *,
    has_white: bool,
    camera: str,
    illuminant: str,
) -> list[PipelineStage]:
    """Return the stages that make the maps of skin tone from the map `diffuse`.

    Parameters
    ----------
    stage
        Factory of stages, see `graph.make_stage_factory`.
    color
        Matrix of the color calibration, and the camera RGB of white that belongs to it; or None.
    has_white
        Whether a white reference fixes the brightness; without one all but the erythema index are
        refused.
    camera, illuminant
        Names of spectra.
    """
    table = {"camera": camera, "illuminant": illuminant}
    tone_camera = partial(ToneCamera.of, camera, illuminant, *color)
    refused = "" if has_white else NEEDS_WHITE
    both, tones = "lab lab_covariance", "monk monk_low monk_high"
    return [
        stage("lab", "diffuse", both, partial(lab_map, tone_camera), refused, **table),
        stage("ita", both, "ita", ita_map),
        stage("monk", both, tones, monk_maps),
        stage("erythema", "diffuse", "erythema_index", erythema_map),
        stage("melanin_index", "diffuse", "melanin_index", melanin_index_map, refused),
    ]


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

    def lab(self, rgb: FloatArray, variance: FloatArray) -> tuple[Float32Array, Float32Array]:
        """Return CIE L*a*b* of skin with the surface reflection, and its covariance.

        Parameters
        ----------
        rgb, variance
            (n, 3): diffuse reflectance in camera RGB, white = 1, and its variance.

        Returns
        -------
        lab : ndarray of float32, shape (n, 3)
        covariance : ndarray of float32, shape (n, 3, 3)
            By noise and the white's error, the matrix, and the remaining error of the correction.
        """
        light = (rgb + SURFACE_REFLECTION) * self.neutral
        noise = variance * np.square(self.neutral)
        to_xyz = np.linalg.inv(spectra.XYZ_TO_LINEAR_SRGB)
        adapted = to_xyz @ xyz_to_linear_srgb(np.eye(3), illuminant=self.matrix.illuminant).T
        found = np.empty(light.shape, np.float32)
        covariance = np.empty((*light.shape, 3), np.float32)
        tone_kernels.fill_lab(
            np.ascontiguousarray(light, np.float64),
            np.ascontiguousarray(noise, np.float64),
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
    camera: Callable[[], ToneCamera], diffuse: SkinMap
) -> Mapping[str, SkinMap | LabCovariance]:
    """Return `lab` with its standard errors, and `lab_covariance`."""
    good = diffuse.mask & (diffuse.values > 0.0).all(axis=-1)
    rgb = diffuse.values[good]
    stderr = np.zeros_like(rgb) if diffuse.stderr is None else diffuse.stderr[good]
    found, covariance = camera().lab(rgb, np.square(stderr))
    values = np.zeros(diffuse.values.shape, np.float32)
    whole = np.zeros((*values.shape, 3), np.float32)
    values[good], whole[good] = found, covariance
    error = np.sqrt(np.maximum(np.diagonal(whole, axis1=-2, axis2=-1), 0.0))
    what = "CIE L*, a*, b* under D65 with the surface reflection that a sphere d/8 includes"
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
    what = "individual typology angle, degrees; a surface that is tilted from the light is darker"
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


def erythema_map(diffuse: SkinMap) -> SkinMap:
    """Return the erythema index of the camera's red and green channels; shading cancels."""
    values, error, good = _channels(diffuse)
    found = skin_tone.erythema_index(values[..., 0], values[..., 1])
    stderr = skin_tone.erythema_index_stderr(
        values[..., 0], values[..., 1], error[..., 0], error[..., 1]
    )
    what = f"100 log10(red / green), {_BANDS_NOTE}"
    return masked_map(found, stderr, good, MAP_UNITS["erythema_index"], what)


def melanin_index_map(diffuse: SkinMap) -> SkinMap:
    """Return the melanin index of the camera's red channel."""
    values, error, good = _channels(diffuse)
    found = skin_tone.melanin_index(values[..., 0])
    stderr = skin_tone.melanin_index_stderr(values[..., 0], error[..., 0])
    what = f"100 log10(1 / red), {_BANDS_NOTE}"
    return masked_map(found, stderr, good, MAP_UNITS["melanin_index"], what)


_BANDS_NOTE: Final = (
    "this camera's channels without surface reflection: not comparable with other cameras, nor "
    "with the narrow bands of instruments"
)


def _channels(diffuse: SkinMap) -> tuple[Float32Array, Float32Array, BoolArray]:
    """Return channels, 1 where they are unknown, their standard errors and the known pixels."""
    good = diffuse.mask & (diffuse.values > 0.0).all(axis=-1)
    values = np.where(good[..., None], diffuse.values, np.float32(1.0))
    error = np.zeros_like(values) if diffuse.stderr is None else diffuse.stderr
    return values, error, good
