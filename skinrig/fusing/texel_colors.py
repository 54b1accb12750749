"""Colors of a texture's texels by the dome and by the flash rig, with their covariances."""

from dataclasses import dataclass
from typing import Final, Protocol, TypeAlias

import numpy as np
from scipy.ndimage import map_coordinates

from model import fresnel
from model.skin import SkinAppearance, SkinMap
from reconstruction.chromophores import model_error, shading_prior
from reconstruction.fusion.signals import RigBands
from reconstruction.fusion.texels import RigColors
from reconstruction.surface.errors import SHARED_R_D_ERROR, interior_error
from skinrig.appearances.contents import intersect_valid
from skinrig.appearances.texel_placement import TexelPlacement
from skinrig.arrays import BoolArray, Float64Array, FloatArray, Int64Array

BRIGHTNESS_SHARE: Final = 0.5
"""Fraction of the variance of the dome's calibration error that its channels share."""
SHARED_GAIN_ERROR: Final = 0.005
"""Relative error of R_d that all texels of a face share, common to the channels.

Pixels average over relief and borders of shadow everywhere. It adds to `SHARED_R_D_ERROR`, which
has most of it: both together are 0.9 %. R_d of three simulated people at 2.1 mm per pixel, types
III, V and VI, was off by 0.5 to 1.3 %."""
UNRESOLVED_FRACTION: Final = 0.35
"""Fraction of the variance of R_d at a texel by detail finer than the dome's pixels.

Set on the same people: their fused R_d scattered by more than stated by this part."""
FLASH_CHANNEL_ERROR: Final = 0.003
"""Relative standard error of a channel of the flash rig's white reference over the others."""
PLACED_LIGHT_SD: Final = 1.0
"""Standard deviation of log light of a face's median texel.

The usual light is that of the median pixel of an image, which shows oblique skin smaller."""
MIN_VALID_SHARE: Final = 0.99
"""Least fraction of valid pixels around a texel's place in an image."""
LOG_R_D_OVER_REFLECTANCE: Final = -float(
    np.log(1.0 - fresnel.normal_reflectance(fresnel.ETA_SKIN))
    + np.log(1.0 - fresnel.diffuse_external(fresnel.ETA_SKIN))
)
"""Logarithm of R_d over the diffuse reflectance at normal incidence."""
_PAIRS: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


Texels: TypeAlias = slice | BoolArray | Int64Array
"""Choice of texels, numbered row by row."""


class ColorSource(Protocol):
    """Colors of a rig on a texture of H x W texels."""

    @property
    def bands(self) -> RigBands:
        """Channels of the rig."""
        ...

    @property
    def calibration(self) -> Float64Array:
        """Covariance of the calibration's errors in log color, (3, 3)."""
        ...

    @property
    def valid(self) -> BoolArray:
        """Texels with a color, (H W,)."""
        ...

    def colors(self, rig: int, texels: Texels) -> RigColors:
        """Return the colors of some texels, numbered row by row."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class DomeColors:
    """Diffuse reflectance by the light dome."""

    bands: RigBands
    calibration: Float64Array
    r_d: SkinMap

    @classmethod
    def of(cls, appearance: SkinAppearance, camera: str, illuminant: str) -> "DomeColors":
        """Return the colors of a dome's appearance with the map `r_d`.

        Parameters
        ----------
        appearance
            Maps of the dome.
        camera, illuminant
            Names of spectra.
        """
        share = BRIGHTNESS_SHARE * np.ones((3, 3)) + (1.0 - BRIGHTNESS_SHARE) * np.eye(3)
        bands = RigBands("dome", camera, illuminant)
        r_d = appearance.maps["r_d"]
        good = intersect_valid(r_d) & (r_d.values > 0.0).all(axis=-1)
        interior = 0.0
        if good.any():
            interior = float(np.median(_interior_variance(r_d.values[good])))
        calibration = SHARED_R_D_ERROR**2 * share + SHARED_GAIN_ERROR**2 + interior
        return cls(bands, calibration, r_d)

    @property
    def valid(self) -> BoolArray:
        """Texels with a positive R_d, (H W,)."""
        good = intersect_valid(self.r_d) & (self.r_d.values > 0.0).all(axis=-1)
        return np.asarray(good.reshape(-1))

    def colors(self, rig: int, texels: Texels) -> RigColors:
        """Return the colors of some texels.

        Errors of positions and normals scale the channels together: the least relative variance of
        the channels counts as common to them, as for the maps of skin tone. Errors that all texels
        share are those of `calibration`.
        """
        good = self.valid[texels]
        values = self.r_d.values.reshape(-1, 3)[texels].astype(np.float64)
        values = np.where(good[:, None], values, 1.0)
        stderr = np.full_like(values, 0.0)
        if self.r_d.stderr is not None:
            stderr = self.r_d.stderr.reshape(-1, 3)[texels].astype(np.float64)
        shared = SHARED_R_D_ERROR**2 + _interior_variance(values)[:, None]
        relative = np.maximum(np.square(stderr / values) - shared, 1e-8)
        common = relative.min(axis=-1, keepdims=True)
        covariance = (relative - common)[..., None] * np.eye(3) + common[..., None]
        covariance = covariance + 1e-8 * np.eye(3)
        log_rgb = np.log(values) - LOG_R_D_OVER_REFLECTANCE
        return RigColors(rig, log_rgb, covariance, good, unresolved=UNRESOLVED_FRACTION)


def _interior_variance(r_d: FloatArray) -> Float64Array:
    """Return the variance of log R_d by directions of light from below the surface, (N,).

    It is a gain of all channels that no rig witnesses, and grows from 2 % on light to 12 % on dark
    skin.
    """
    return np.asarray(np.square(interior_error(r_d)[:, 0] / r_d[:, 0]), np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class FlashColors:
    """Diffuse light by the flash rig over that of a white reference, at places in its image."""

    bands: RigBands
    calibration: Float64Array
    image: Float64Array
    """(h, w, 10): log color less the usual log shading, six covariances of it, valid."""
    pixel: Float64Array
    """(N, 2): column and row of each texel."""
    visible: BoolArray
    """(N,): texels that the camera's image shows."""
    brightness_variance: float

    @classmethod
    def of(
        cls,
        appearance: SkinAppearance,
        placement: TexelPlacement | None,
        camera: str,
        illuminant: str,
    ) -> "FlashColors":
        """Return the colors of a flash appearance with the map `diffuse`.

        Parameters
        ----------
        appearance
            Maps of the flash rig.
        placement
            Places of the texels in its image; None: the texels are its pixels.
        camera, illuminant
            Names of spectra.
        """
        diffuse = appearance.maps["diffuse"]
        good = intersect_valid(diffuse) & (diffuse.values > 0.0).all(axis=-1)
        values = np.where(good[..., None], diffuse.values, 1.0).astype(np.float64)
        stderr = np.zeros_like(values) if diffuse.stderr is None else diffuse.stderr
        variance = np.where(good[..., None], np.square(stderr), 1.0)
        covariance = model_error.image_covariance(values, variance, good)
        covariance += (variance / values**2)[..., None] * np.eye(3)
        log_rgb = np.log(values)
        if placement is None:
            rows, columns = np.indices(good.shape)
            pixel = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(np.float64)
            visible = np.ones(len(pixel), bool)
        else:
            pixel, visible = placement.pixel.reshape(-1, 2), placement.visible.reshape(-1)
            for axis in (0, 1):
                change = np.gradient(log_rgb, axis=axis) * placement.stderr_px
                covariance += change[..., :, None] * change[..., None, :]
        prior = shading_prior.face_prior()
        parts = [covariance[..., i, j] for i, j in _PAIRS]
        image = np.concatenate(
            [log_rgb - prior.median, np.stack(parts, axis=-1), good[..., None].astype(float)], -1
        )
        image = np.where(good[..., None], image, 0.0)
        light = shading_prior.LOG_SHADING_SOFTNESS if placement is None else PLACED_LIGHT_SD
        calibration = FLASH_CHANNEL_ERROR**2 * np.eye(3) + light**2
        bands = RigBands("flash", camera, illuminant)
        return cls(bands, calibration, image, pixel, visible, prior.sd**2)

    @property
    def valid(self) -> BoolArray:
        """Texels that the image shows with valid pixels, (N,)."""
        at = self.pixel.T[::-1]
        share = map_coordinates(self.image[..., -1], at, order=1, cval=0.0)
        return np.asarray(self.visible & (share > MIN_VALID_SHARE))

    def colors(self, rig: int, texels: Texels) -> RigColors:
        """Return the colors of some texels, sampled linearly from the image."""
        at = self.pixel[texels].T[::-1]
        found = np.stack(
            [map_coordinates(self.image[..., k], at, order=1, cval=0.0) for k in range(10)], -1
        )
        good = self.visible[texels] & (found[:, -1] > MIN_VALID_SHARE)
        covariance = np.empty((len(found), 3, 3))
        for k, (i, j) in enumerate(_PAIRS):
            covariance[:, i, j] = covariance[:, j, i] = found[:, 3 + k]
        covariance = np.where(good[:, None, None], covariance, np.eye(3))
        return RigColors(rig, found[:, :3], covariance, good, self.brightness_variance)
