"""Estimate how much of a relief's slopes occlusion hides from normals by gradient light.

The opposite wall of a groove occludes the lights that the mirror direction of a steep wall needs.
The moments then point to the lights that are left, and the slope is estimated too small. Images
alone do not determine this. The estimated relief does: its horizons give each light's visibility,
and the table's own sum over the lights, with and without the hidden ones, gives the shift.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from model.checks import Checks
from model.fresnel import ETA_SKIN
from reconstruction.arrays import Float64Array, FloatArray
from reconstruction.gradient_normals.lobe_response import direction_from_moments, specular_sums
from reconstruction.gradient_normals.patterns import GradientError
from reconstruction.gradient_normals.sphere_lights import (
    SphereLights,
    disc_from_normal,
    normal_from_disc,
    view_frame,
)

MAX_SAMPLES: Final = 8192
"""Pixels of a map for which the shift is computed: their ratio of variances is enough."""
HORIZON_DIRECTIONS: Final = 24
HORIZON_STEP_RATIO: Final = 1.25
HORIZON_REACH_UM: Final = 600.0
"""Distances of a horizon grow by the ratio from one pixel to the reach: grooves are narrower."""
HORIZON_SOFTNESS_RAD: Final = 0.03
"""Half width of a shadow's edge in elevation: the lens blurs it over some pixels."""


MIN_NORMAL_VARIANCE: Final = 1e-8
"""Variance of normals below which a relief counts as flat: nothing of it is hidden."""


@dataclass(frozen=True, slots=True)
class OcclusionRatios:
    """Variances of normals without occlusion over those with it.

    Attributes
    ----------
    along, across : float
        For the component along and across the jaws, 1 where nothing is hidden.
    visible_fraction : float
        Mean fraction of the specular reflection whose lights the relief does not hide.
    """

    along: float
    across: float
    visible_fraction: float


def find_horizons(
    height: FloatArray, rows: ArrayLike, columns: ArrayLike, *, pixel_um: float
) -> Float64Array:
    """Return the tangent of the horizon's elevation around some pixels of a relief.

    Parameters
    ----------
    height : ndarray, shape (H, W)
        Finite, um; row 0 is the top. Beyond the border it stays as at the border.
    rows, columns : array_like of int, shape (P,)
    pixel_um : float
        Side of a pixel.

    Returns
    -------
    ndarray of float64, shape (P, HORIZON_DIRECTIONS)
        At least 0, the plane; directions counterclockwise from the image's right.

    Examples
    --------
    A wall of 2 um that begins two pixels to the right of the first pixel:

    >>> relief = np.where(np.arange(9) < 6, 0.0, 2.0) * np.ones((9, 1))
    >>> float(find_horizons(relief, [4], [4], pixel_um=1.0)[0, 0])
    1.0
    """
    Checks(GradientError).within("height", height)
    Checks(GradientError).within("pixel_um", pixel_um, "(0, inf)")
    row, column = np.asarray(rows, np.float64), np.asarray(columns, np.float64)
    count = max(1, math.ceil(math.log(max(HORIZON_REACH_UM / pixel_um, 1.0), HORIZON_STEP_RATIO)))
    steps = np.unique(np.round(HORIZON_STEP_RATIO ** np.arange(count + 1)))
    here = height[row.astype(int), column.astype(int)]
    found = np.zeros((row.size, HORIZON_DIRECTIONS))
    for k in range(HORIZON_DIRECTIONS):
        angle = 2.0 * math.pi * k / HORIZON_DIRECTIONS
        for step in steps:
            there = [row - step * math.sin(angle), column + step * math.cos(angle)]
            there_height = ndimage.map_coordinates(height, there, order=1, mode="nearest")
            found[:, k] = np.maximum(found[:, k], (there_height - here) / (step * pixel_um))
    return found


def estimate_occlusion_ratios(
    height: FloatArray,
    valid: ArrayLike,
    *,
    pixel_um: float,
    lights: SphereLights,
    alpha: float,
    angle_rad: float = 0.0,
    counted: ArrayLike | None = None,
    eta: float = ETA_SKIN,
) -> OcclusionRatios:
    """Estimate by which factor occlusion lowers the variances of a relief's normals.

    Parameters
    ----------
    height : ndarray, shape (H, W)
        Estimated relief, um, whose slopes lack what occlusion hides; finite where valid.
    valid : array_like of bool, shape (H, W)
    pixel_um : float
        Side of a pixel.
    lights : SphereLights
    alpha : float
        GGX roughness of the facets within a pixel.
    angle_rad : float
        Axis of the jaws, counterclockwise from +x.
    counted : array_like of bool, shape (H, W), optional
        Pixels whose normals have the variances; those that are not cast shadows only. None: all.
    eta : float
        Refractive index of the surface.

    Returns
    -------
    OcclusionRatios
        To first order in the shift; light between walls and masking by the lens are not included.

    Raises
    ------
    GradientError
        Without two such pixels, and for shapes and numbers out of range.
    """
    mask = np.asarray(valid, bool)
    Checks(GradientError).shape("height", height, mask.shape)
    relief = np.where(mask, height, 0.0).astype(np.float64)
    inside = ndimage.binary_erosion(mask)
    if counted is not None:
        Checks(GradientError).mask("counted", np.asarray(counted), mask.shape)
        inside &= np.asarray(counted)
    picked = np.flatnonzero(inside)
    if picked.size < 2:
        raise GradientError("valid: got fewer than 2 pixels with neighbors; check the mask")
    if picked.size > MAX_SAMPLES:  # even steps would alias with the map's width
        chance = np.random.default_rng(0)
        picked = np.sort(chance.choice(picked, MAX_SAMPLES, replace=False))
    rows, columns = np.unravel_index(picked, mask.shape)
    slope_y, slope_x = np.gradient(relief, pixel_um)
    normals = np.stack(
        [-slope_x.ravel()[picked], slope_y.ravel()[picked], np.ones(picked.size)], axis=-1
    )
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    horizon = np.arctan(find_horizons(relief, rows, columns, pixel_um=pixel_um))
    way = lights.directions
    elevation = np.arctan2(way[:, 2], np.hypot(way[:, 0], way[:, 1]))
    turn = np.arctan2(way[:, 1], way[:, 0]) / (2.0 * math.pi) * HORIZON_DIRECTIONS
    before = np.floor(turn).astype(int)
    part = turn - before
    edge = (1.0 - part) * horizon[:, before % HORIZON_DIRECTIONS]
    edge += part * horizon[:, (before + 1) % HORIZON_DIRECTIONS]
    seen = np.clip(0.5 + 0.5 * (elevation - edge) / HORIZON_SOFTNESS_RAD, 0.0, 1.0)
    frame = view_frame((0.0, 0.0, 1.0))
    each = specular_sums(lights, frame, alpha, eta)(normals, np.zeros(3))
    axes = lights.programmed if len(lights.programmed) else lights.directions
    whole, _ = direction_from_moments(each @ axes, True)
    occluded, _ = direction_from_moments((each * seen) @ axes, True)
    place = disc_from_normal(normals)
    restored = normal_from_disc(place - (occluded - whole))
    axis = np.array([math.cos(angle_rad), math.sin(angle_rad)])
    ratios = [
        float(np.var(restored[:, :2] @ one) / variance)
        if (variance := float(np.var(normals[:, :2] @ one))) > MIN_NORMAL_VARIANCE
        else 1.0
        for one in (axis, np.array([-axis[1], axis[0]]))
    ]
    fraction = float((each * seen).sum() / max(float(each.sum()), 1e-300))
    return OcclusionRatios(ratios[0], ratios[1], fraction)
