"""Blood volume fraction of sites of a face in every frame of a sequence, with one melanin map.

A pixel's melanin is constant, so only its blood and its illumination vary. On a still face the
illumination changes little between frames, and smoothly over the skin. Many pixels then determine
it, and each pixel's brightness constrains its blood. This is several times less noisy than color
alone. Where the face has moved, every wrinkle changes the illumination: frames of one pose are
then compared by brightness, poses by color alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.color_table import ColorTable, with_exact_optics
from model.skin import SkinMap
from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.chromophores import model_error
from reconstruction.chromophores.face import estimate_face_optics
from reconstruction.chromophores.shading_prior import ShadingPrior
from reconstruction.facial_color import shared_melanin
from reconstruction.facial_color.perfusion_curves import DiscMeans, average_discs, disc_pixels
from reconstruction.pipeline.flash import stages as flash_stages

LIGHT_RADII, LEAST_LIGHT_PX = 3.0, 6.0
"""Correlation length of illumination changes between frames: in radii of a disc, and in px."""
POSE_STDERR_FRACTION = 0.10
"""Relative standard error, in addition to noise, of the blood of a moved face against that at rest:
illumination, shadows and the skin under a pixel change with the pose. Maximum likelihood value for
the cheeks, where the expression moves skin most, of 19 smiles of seeds 0 to 18, 192 px across; of
noses 0.03, of sites that hardly move less than 0.02."""
MIN_VALID_FRAME_FRACTION = 0.9
"""Minimum fraction of the frames in which a pixel must be valid."""


@dataclass(frozen=True, slots=True)
class SkinColorModel:
    """Model of skin colors that images are inverted with."""

    table: ColorTable
    prior: ShadingPrior
    model_error: FloatArray
    """Relative covariance of the table's colors."""
    has_white: bool
    """Whether a white reference fixes the exposure."""

    @staticmethod
    def of(rig: flash_stages.FlashRig) -> SkinColorModel:
        """Return the model of a session."""
        has_white = rig.white is not None
        colors = flash_stages.load_skin_colors(rig.camera, rig.illuminant, has_white=has_white)
        return SkinColorModel(*colors, np.asarray(model_error.load_covariance()), has_white)

    def of_face(self, image: SkinMap) -> tuple[SkinColorModel, FloatArray, float]:
        """Return the model with exact optics, and what a face's optics add to it.

        These are the factor of the face's colors that leads to the model, and the 68 % half-width
        of its blood, relative.

        Parameters
        ----------
        image
            Diffuse reflectance of the whole face.
        """
        rgb = np.where(image.mask[..., None], image.values, np.nan)
        common = estimate_face_optics(rgb, self.table, prior=self.prior, has_white=self.has_white)
        log_color = np.zeros(3) if common is None else common.log_color
        exact = replace(self, table=with_exact_optics(self.table))
        half_width = 0.0 if common is None else common.blood_half_width
        return exact, np.exp(-log_color).astype(np.float32), half_width


@dataclass(frozen=True, slots=True, eq=False)
class SiteBlood:
    """Blood volume fraction of P sites in N frames."""

    means: DiscMeans
    """Means and standard errors from frame to frame."""
    stderr_of_pose: Float64Array
    """(P,): standard error that all frames of a moved face share, against those at rest; 0 where
    the face has not moved."""
    moved: BoolArray
    """(N,): frames in which the face has moved."""
    common_half_width: float
    """Relative 68 % half-width of all blood, by optics of the face."""


def average_disc_blood(
    maps: Sequence[SkinMap],
    positions: Mapping[str, tuple[float, float]],
    radius_px: float,
    light: SkinColorModel,
    *,
    moved: BoolArray,
) -> SiteBlood:
    """Average blood over discs in each frame.

    Parameters
    ----------
    maps
        Diffuse reflectance of each frame, on the face at rest.
    positions
        Centers of the discs, px.
    radius_px
        Their radius, px.
    light
        Model of skin colors.
    moved
        (N,): frames in which the face has moved.
    """
    # a disc alone hardly determines the optics, which are those of the face
    exact, factor, common_half_width = light.of_face(maps[0])
    found = [
        _of_place(maps, factor, (name, place), radius_px, exact, moved)
        for name, place in positions.items()
    ]
    parts = zip(*((one.mean, one.stderr, one.pixels) for one, _ in found), strict=True)
    joined = DiscMeans(*map(np.concatenate, parts))
    return SiteBlood(joined, np.array([of_pose for _, of_pose in found]), moved, common_half_width)


def _of_place(
    maps: Sequence[SkinMap],
    factor: FloatArray,
    position: tuple[str, tuple[float, float]],
    radius_px: float,
    light: SkinColorModel,
    moved: BoolArray,
) -> tuple[DiscMeans, float]:
    name, place = position
    shape = maps[0].values.shape[:2]
    window_px = max(LIGHT_RADII * radius_px, LEAST_LIGHT_PX)
    rows, columns = disc_pixels(shape, name, place, radius_px)
    top, left = (max(0, int(p.min() - 2 * window_px)) for p in (rows, columns))
    bottom, right = (int(p.max() + 2 * window_px) + 1 for p in (rows, columns))
    patch = np.s_[top:bottom, left:right]
    valid = np.array([m.mask[patch] for m in maps])
    rgb = np.array([factor * m.values[patch] for m in maps])
    variance = np.square([factor * flash_stages.map_stderr(m)[patch] for m in maps])
    at = {name: (place[0] - left, place[1] - top)}

    def weighed(frames: BoolArray, smooth_px: float | None) -> DiscMeans:
        blood = shared_melanin.estimate_shared_melanin(
            np.where(valid[frames][..., None], rgb[frames], np.nan),
            light.table,
            prior=light.prior,
            variance=variance[frames],
            model_error=light.model_error,
            valid=valid[frames],
            shading_window_px=smooth_px,
        )
        good = blood.valid_states & ~blood.is_misfit & np.isfinite(blood.hemoglobin)
        # a pixel counts in nearly all frames or in none, else the changing set would shift the mean
        good &= good.mean(axis=0) >= MIN_VALID_FRAME_FRACTION
        return average_discs(
            blood.hemoglobin, at, radius_px, stderr=blood.noise_stderr_hemoglobin, valid=good
        )

    every = np.ones(len(maps), bool)
    if not moved.any() or moved.all():
        return weighed(every, window_px), 0.0
    by_color = weighed(every, None)
    mean, stderr = by_color.mean[0].copy(), by_color.stderr[0].copy()
    variances = []
    for pose in (~moved, moved):
        by_light = weighed(pose, window_px)
        both = np.isfinite(by_light.mean[0]) & by_color.valid[0, pose]
        if both.sum() < 2:
            mean[pose] = np.nan
            continue
        # brightness gives the precise curve within a pose, color the level between poses
        level = float(by_color.mean[0, pose][both].mean() - by_light.mean[0][both].mean())
        mean[pose] = by_light.mean[0] + level
        stderr[pose] = by_light.stderr[0]
        variances.append(float(np.square(by_color.stderr[0, pose][both]).sum()) / both.sum() ** 2)
    counted = np.where(np.isfinite(mean), by_color.pixels[0], 0)
    found = DiscMeans(mean[None], stderr[None], counted[None])
    if len(variances) < 2:  # a single pose needs no combination
        return found, 0.0
    of_light = POSE_STDERR_FRACTION * float(np.nanmean(mean))
    return found, float(np.sqrt(np.sum(variances) + of_light**2))
