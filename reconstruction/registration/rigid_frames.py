"""Find tracking frames in which the face moves as a rigid body.

Typical residuals of tracks are noise, larger ones an expression.
"""

import numpy as np

from reconstruction.arrays import BoolArray, Float64Array

TRACK_OUTLIER_SIGMAS, TRACK_OUTLIER_PX = 4.0, 0.3
"""Residual above which a track is nonrigid: in the median scale of frames of like light; in px."""
MAX_EXCESS_NONRIGID_FRACTION = 0.05
"""Excess of a frame's fraction of nonrigid tracks above their median that makes it unusable."""
MAX_NONRIGID_FRACTION = 0.3
MAX_LIGHT_RATIO, MIN_PEERS = 2.0, 4
"""Frames within this ratio of light have like noise; fewer are compared with all frames."""
MAX_NONRIGID_FRAME_FRACTION = 1 / 3
"""Fraction of frames above which a track that is nonrigid is not on the skin."""
FACE_PART_MM = 15.0
MAX_PART_RESIDUAL_RATIO = 2.5
"""Residual of the worst part of a face over the median one of frames of like light, and over the
median relative to the frame's own residuals: an expression exceeds both."""
_MIN_RESIDUAL_PX = 1e-6
RAYLEIGH_MEDIAN = 1.1774100225154747
"""Median length of a unit normal vector in two dimensions."""


def residual_scales(residual_px: Float64Array) -> Float64Array:
    """Return the scale of each frame's residuals, px, (T,): standard deviations of a coordinate."""
    return np.array([_middle(row) / RAYLEIGH_MEDIAN for row in residual_px])


def find_rigid_frames(
    residual_px: Float64Array,
    points_mm: Float64Array,
    determined: BoolArray,
    light: Float64Array,
    reference: int,
) -> BoolArray:
    """Return the frames whose tracks follow one rigid motion.

    Parameters
    ----------
    residual_px
        (T, K): length of each track's residual from the rigid motion, infinite for a lost track.
    points_mm
        (K, 3): tracked points.
    determined
        (T,): whether the tracks determine the motion.
    light
        (T,): of the frames, positive, any unit.
    reference
        Frame with residuals of 0.

    Returns
    -------
    ndarray of bool, shape (T,)
    """
    frames = len(residual_px)
    known, scales = np.isfinite(residual_px), residual_scales(residual_px)
    others = determined & (np.arange(frames) != reference)
    peers = _peers(light, others)
    usual_scale = _middles(scales, peers)[:, None]
    far = residual_px > np.maximum(TRACK_OUTLIER_SIGMAS * usual_scale, TRACK_OUTLIER_PX)
    # a track that is nonrigid in many frames is at an occluding edge, not in an expression
    steady = np.ones(len(points_mm), bool)
    if np.count_nonzero(others) >= MIN_PEERS:
        steady = np.mean(far[others], axis=0) <= MAX_NONRIGID_FRAME_FRACTION
    share = np.mean(far[:, steady], axis=1) if steady.any() else np.ones(frames)
    used = zip(residual_px, known & steady, strict=True)
    worst = np.array([_worst_part(points_mm[use], row[use]) for row, use in used])
    usual_share = _middles(share, peers)
    most = np.minimum(usual_share + MAX_EXCESS_NONRIGID_FRACTION, MAX_NONRIGID_FRACTION)
    rigid = determined & (share <= most)
    # residuals grow as the head turns under the lights, also those of the worst part
    own = worst / np.maximum(scales, _MIN_RESIDUAL_PX)
    usual = np.minimum(_middles(worst, peers), _middles(own, peers) * scales)
    rigid &= worst <= np.fmax(MAX_PART_RESIDUAL_RATIO * usual, TRACK_OUTLIER_PX)
    rigid[reference] = True
    return np.asarray(rigid)


def _peers(light: Float64Array, others: BoolArray) -> list[BoolArray]:
    """Return for each frame those of `others` that have like light."""
    found = []
    for own in light:
        near = others & (np.abs(np.log(light / own)) < np.log(MAX_LIGHT_RATIO))
        found.append(near if np.count_nonzero(near) >= MIN_PEERS else others)
    return found


def _worst_part(points: Float64Array, length: Float64Array) -> float:
    """Return the largest median residual of parts that overlap by half; 0 without three tracks."""
    worst = 0.0
    for shift in (0.0, 0.5):
        cell = np.floor(points / FACE_PART_MM + shift).astype(np.intp)
        _, part, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
        part = part.reshape(-1)
        for number in np.flatnonzero(count >= 3):
            worst = max(worst, float(np.median(length[part == number])))
    return worst


def _middles(values: Float64Array, peers: list[BoolArray]) -> Float64Array:
    return np.array([_middle(values[each]) for each in peers])


def _middle(values: Float64Array) -> float:
    """Return the median of the finite values, 0 without any."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else 0.0
