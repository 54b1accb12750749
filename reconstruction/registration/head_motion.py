"""Estimate the motion of the head during a capture from tracking frames of all cameras.

Points of the scan are tracked from a reference frame to every other in each camera; one rigid
motion per frame is fitted to all cameras' tracks together. Large residuals are an expression,
and a frame with many of them is not usable.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.checks import Checks
from model.solver_outcome import UNKNOWN_CONDITION, SolverOutcome, StopReason, estimate_condition
from reconstruction.arrays import BoolArray, Float64Array, FloatArray, UInt8Array
from reconstruction.registration import tracking as registration
from reconstruction.registration.rigid_frames import (
    RAYLEIGH_MEDIAN,
    find_rigid_frames,
    residual_scales,
)

_log = logging.getLogger(__name__)
NO_STEPS = SolverOutcome(0, 0.0, UNKNOWN_CONDITION, "tolerance")

MIN_TRACK_COSINE = 0.4
"""Cosine between normal and view below which a point is not tracked."""
MIN_TRACKS = 12
"""Fewest tracks from which a frame's motion is estimated."""
TRACK_TUKEY_SIGMAS = 4.685
BLOCK_PX = 32
"""Side of the parts of an image within which errors of tracks are correlated."""
SMALL_MOVE = np.repeat([1e-8, 1e-6], 3)
"""Step at which the search ends: rotations in rad, translations in mm."""
MAX_LAST_MOVE_SIGMAS = 0.1
"""Last step, in standard errors, from which a usable frame's motion is reported as unfinished."""
_DIFFERENCE_MM = 0.01


class HeadMotionError(ValueError):
    """Frames, cameras or points from which motion cannot be estimated."""


class TrackingCamera(Protocol):
    """Camera interface for tracking."""

    @property
    def center_mm(self) -> Float64Array:
        """Center of projection, (3,)."""

    def project(self, points_mm: Float64Array) -> Float64Array:
        """Return column and row (N, 2) of points (N, 3)."""


@dataclass(frozen=True, slots=True)
class HeadMotion:
    """Rigid motion of the head: a point x of the scan moves to R x + t.

    Attributes
    ----------
    times_s : ndarray, shape (T,)
        Times of the tracking frames, increasing.
    rotation_rad : ndarray, shape (T, 3)
        Rotation vectors about the rig's origin.
    translation_mm : ndarray, shape (T, 3)
    stderr : ndarray, shape (T, 6)
        Of rotation (rad) and translation (mm); 0 for the reference frame, infinite where a frame
        does not determine the motion.
    usable : ndarray of bool, shape (T,)
        Enough tracks, and a rigid motion of the face.
    residual_px : ndarray, shape (T,)
        Scale of the tracks' residuals from the rigid motion.
    tracks : ndarray of int, shape (T,)
    """

    times_s: Float64Array
    rotation_rad: Float64Array
    translation_mm: Float64Array
    stderr: Float64Array
    usable: BoolArray
    residual_px: Float64Array
    tracks: NDArray[np.intp]

    def interpolate(self, times_s: ArrayLike) -> tuple[Float64Array, Float64Array]:
        """Interpolate the motion: rotation vectors (K, 3) and translations (K, 3).

        Linear between usable frames, constant before the first and after the last.

        Raises
        ------
        HeadMotionError
            If no frame is usable.
        """
        when = np.atleast_1d(np.asarray(times_s, np.float64))
        if not self.usable.any():
            raise HeadMotionError(
                "usable: got no frame that determines the motion, expected one or more; "
                "check the tracking frames"
            )
        known = self.times_s[self.usable]
        turn, shift = (
            np.stack([np.interp(when, known, row) for row in values[self.usable].T], axis=-1)
            for values in (self.rotation_rad, self.translation_mm)
        )
        return turn, shift

    def matrices(self, times_s: ArrayLike) -> Float64Array:
        """Return the motion as (K, 4, 4) matrices that move points from the scan to the frame."""
        turn, shift = self.interpolate(times_s)
        out = np.tile(np.eye(4), (len(turn), 1, 1))
        out[:, :3, :3] = rotation_matrix(turn)
        out[:, :3, 3] = shift
        return out

    def is_covered(self, times_s: ArrayLike) -> BoolArray:
        """Return which times are between two consecutive usable frames, (K,)."""
        when = np.atleast_1d(np.asarray(times_s, np.float64))
        after = np.searchsorted(self.times_s, when, side="left")
        exact = (after < len(self.times_s)) & (
            self.times_s[np.minimum(after, len(self.times_s) - 1)] == when
        )
        low = np.where(exact, after, after - 1)
        inside = (low >= 0) & (after < len(self.times_s))
        low, high = np.maximum(low, 0), np.minimum(after, len(self.times_s) - 1)
        return inside & self.usable[low] & self.usable[high]

    def displacement_mm(self, points_mm: ArrayLike) -> Float64Array:
        """Return the root mean square displacement of points from the scan, (T,)."""
        points = np.asarray(points_mm, np.float64).reshape(-1, 3)
        moved = points @ np.swapaxes(rotation_matrix(self.rotation_rad), -1, -2)
        moved = moved + self.translation_mm[:, None] - points
        return np.sqrt(np.mean(np.sum(moved**2, axis=-1), axis=-1))


def rotation_matrix(vector_rad: ArrayLike) -> Float64Array:
    """Convert rotation vectors (..., 3) to matrices (..., 3, 3) by Rodrigues' formula.

    Examples
    --------
    >>> (rotation_matrix([0, 0, np.pi / 2]) @ [1, 0, 0]).round(6).tolist()
    [0.0, 1.0, 0.0]
    """
    v = np.asarray(vector_rad, np.float64)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    zero = np.zeros_like(x)
    K = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
    small = angle < 1e-8
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0, np.sin(safe) / safe)
    b = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    return np.asarray(np.eye(3) + a * K + b * (K @ K))


def estimate(
    frames: Sequence[Sequence[FloatArray]] | FloatArray,
    cameras: Sequence[TrackingCamera],
    points_mm: ArrayLike,
    normals: ArrayLike,
    times_s: ArrayLike,
    *,
    light: ArrayLike = 1.0,
    reference: int = 0,
    tracks_per_camera: int = 300,
    iterations: int = 12,
) -> HeadMotion:
    """Estimate the rigid motion of the head in every tracking frame.

    Parameters
    ----------
    frames : sequence or ndarray, shape (T, C, H, W)
        Linear images of one channel, all under the same lights; sizes may differ between cameras.
    cameras : sequence of C cameras
        With ``project(points_mm)`` and ``center_mm``.
    points_mm, normals : array_like, shape (P, 3)
        The scan's points and outward normals with the head as in the reference frame; some
        thousands suffice.
    times_s : array_like, shape (T,)
        Of the frames, increasing, s.
    light : array_like, shape (T,) or ()
        Of the frames, positive, any unit. Darker frames lose more tracks to noise, so that frames
        of like light are compared.
    reference : int
        Frame in which the head has the scan's pose.
    tracks_per_camera : int
        Largest number of points to track in each camera.
    iterations : int
        Largest number of Gauss-Newton steps.

    Returns
    -------
    HeadMotion

    Raises
    ------
    HeadMotionError
        For shapes that do not fit, times that do not increase, or too few points with texture.

    Notes
    -----
    Standard errors take parts of an image as independent; errors common to all tracks, such as
    the noise of the reference frame, are not included.
    """
    points, outward, times = _checked(frames, cameras, points_mm, normals, times_s, reference)
    lights = np.asarray(light, np.float64)
    lights = np.full(times.shape, lights) if lights.ndim == 0 else lights
    Checks(HeadMotionError).shape("light", lights, times.shape)
    Checks(HeadMotionError).within("light", lights, "(0, inf)")
    chosen, evened = [], []
    for number, camera in enumerate(cameras):
        even = registration.normalize_local_contrast(np.asarray(frames[reference][number]))
        seen = _facing(points, outward, np.asarray(camera.center_mm, np.float64))
        places = np.full((len(points), 2), np.nan)
        places[seen] = camera.project(points[seen])
        chosen.append(registration.select_textured_points(even, places, count=tracks_per_camera))
        evened.append(even)
    total = sum(len(rows) for rows in chosen)
    if total < MIN_TRACKS:
        raise HeadMotionError(
            f"points_mm: got {total} points with texture in the reference frame, expected at least "
            f"{MIN_TRACKS}; light the tracking frames better or check the cameras' poses"
        )
    found = []
    for time, pictures in enumerate(frames):
        if time == reference:
            found.append(_Pose(np.zeros(6), np.zeros(6), np.zeros(total)))
            continue
        found.append(_pose(pictures, cameras, points, chosen, evened, iterations))
    left = np.array([pose.residual_px for pose in found])
    stderr = np.array([pose.stderr for pose in found])
    tracked = np.concatenate([points[rows] for rows in chosen])
    determined = np.isfinite(stderr).all(axis=1)
    moved = np.array([pose.motion for pose in found])
    motion = HeadMotion(
        times_s=times,
        rotation_rad=moved[:, :3],
        translation_mm=moved[:, 3:],
        stderr=stderr,
        usable=find_rigid_frames(left, tracked, determined, lights, reference),
        residual_px=residual_scales(left),
        tracks=np.count_nonzero(np.isfinite(left), axis=1),
    )
    used = [pose.outcome for pose, usable in zip(found, motion.usable, strict=True) if usable]
    max(used, key=lambda one: one.residual).warn_unless_converged("head motion", _log)
    return motion


@dataclass(frozen=True, slots=True)
class _Pose:
    """Rotation vector and translation of one frame, with the tracks' residuals."""

    motion: Float64Array
    stderr: Float64Array
    residual_px: Float64Array
    """Length of each track's residual, infinite for a lost track."""
    outcome: SolverOutcome = NO_STEPS
    """Its residual is the last step over its standard error."""


def _checked(
    frames: Sequence[Sequence[FloatArray]] | FloatArray,
    cameras: Sequence[TrackingCamera],
    points_mm: ArrayLike,
    normals: ArrayLike,
    times_s: ArrayLike,
    reference: int,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    points, outward = np.asarray(points_mm, np.float64), np.asarray(normals, np.float64)
    times = np.asarray(times_s, np.float64)
    check = Checks(HeadMotionError)
    check.shape("points_mm", points, (None, 3))
    check.shape("normals", outward, points.shape)
    check.shape("times_s", times, (len(frames),))
    check.within("steps of times_s", np.diff(times), "(0, inf)")
    if any(len(pictures) != len(cameras) for pictures in frames) or not len(cameras):
        raise HeadMotionError(
            f"frames: got another number of images per frame, expected {len(cameras)}, one per "
            "camera, at least one; check the frames"
        )
    check.within("reference", reference, f"[0, {len(frames)})")
    good = np.isfinite(points).all(axis=1) & np.isfinite(outward).all(axis=1)
    return points[good], outward[good], times


def _facing(points: Float64Array, normals: Float64Array, center: Float64Array) -> BoolArray:
    towards = center - points
    length = np.linalg.norm(towards, axis=1) * np.linalg.norm(normals, axis=1)
    return np.asarray(np.sum(towards * normals, axis=1) > MIN_TRACK_COSINE * length)


def _pose(
    pictures: Sequence[FloatArray] | FloatArray,
    cameras: Sequence[TrackingCamera],
    points: Float64Array,
    chosen: Sequence[NDArray[np.intp]],
    evened: Sequence[UInt8Array],
    iterations: int,
) -> _Pose:
    seen: list[tuple[TrackingCamera, Float64Array, Float64Array]] = []
    kept = []
    for picture, camera, rows, even in zip(pictures, cameras, chosen, evened, strict=True):
        start = np.asarray(camera.project(points[rows])) if len(rows) else np.zeros((0, 2))
        tracks = registration.track_points(
            even, registration.normalize_local_contrast(np.asarray(picture)), start
        )
        kept.append(tracks.valid)
        if tracks.valid.any():
            seen.append((camera, points[rows][tracks.valid], tracks.points_px[tracks.valid]))
    found = np.concatenate(kept)
    left = np.full(found.size, np.inf)
    if np.count_nonzero(found) < MIN_TRACKS:
        return _Pose(np.zeros(6), np.full(6, np.inf), left)
    motion, move, condition = np.zeros(6), np.full(6, np.inf), np.nan
    for step in range(iterations + 1):
        r, J = _residuals(seen, motion)
        length = np.linalg.norm(r, axis=1)
        scale = max(float(np.median(length)) / RAYLEIGH_MEDIAN, 1e-6)
        u2 = (length / (TRACK_TUKEY_SIGMAS * scale)) ** 2
        if (np.abs(move) < SMALL_MOVE).all() or step == iterations:
            break
        w = np.maximum(1.0 - u2, 0.0) ** 2
        A = np.einsum("n,nki,nkj->ij", w, J, J)
        size = np.sqrt(np.maximum(np.diag(A), 1e-300))
        A = A / np.outer(size, size) + 1e-9 * np.eye(6)
        move = np.linalg.solve(A, np.einsum("n,nki,nk->i", w, J, r) / size) / size
        motion = motion + move
        condition = estimate_condition(A)
    stderr = _stderr(r, J, u2, _blocks(seen))
    residual = float(np.max(np.abs(move) / np.maximum(stderr, SMALL_MOVE / MAX_LAST_MOVE_SIGMAS)))
    motion = motion if np.isfinite(stderr).all() else np.zeros(6)
    left[found] = length
    stop: StopReason = "tolerance" if residual < MAX_LAST_MOVE_SIGMAS else "limit"
    return _Pose(motion, stderr, left, SolverOutcome(step, residual, condition, stop))


def _blocks(seen: Sequence[tuple[TrackingCamera, Float64Array, Float64Array]]) -> NDArray[np.intp]:
    """Return for each track the number of its camera's part of the image."""
    names = [
        np.stack([np.full(len(at), k), *(at // BLOCK_PX).T.astype(np.intp)], axis=1)
        for k, (_, _, at) in enumerate(seen)
    ]
    _, block = np.unique(np.concatenate(names), axis=0, return_inverse=True)
    return np.asarray(block.reshape(-1), np.intp)


def _stderr(
    r: Float64Array, J: Float64Array, u2: Float64Array, block: NDArray[np.intp]
) -> Float64Array:
    """Return the standard errors (6,), infinite where the tracks do not determine the motion.

    Errors of tracks in one part of an image are correlated: their windows overlap, with the same
    foreshortening. So the gradient is summed over each part (cluster-robust; Liang and Zeger 1986,
    doi 10.1093/biomet/73.1.13), and errors are at least those of independent tracks.
    """
    kept = u2 < 1
    w = np.where(kept, (1 - u2) ** 2, 0.0)
    A = np.einsum("n,nki,nkj->ij", w, J, J)
    size = np.sqrt(np.maximum(np.diag(A), 1e-300))
    scaled = A / np.outer(size, size)
    if np.linalg.eigvalsh(scaled)[0] < 1e-8:
        return np.full(6, np.inf)
    inverse = np.linalg.inv(scaled) / np.outer(size, size)
    pull = np.einsum("n,nki,nk->ni", w, J, r)
    together = np.zeros((int(block.max()) + 1, 6))
    np.add.at(together, block, pull)
    parts = np.unique(block[kept]).size
    few = parts / (parts - 6) if parts > 7 else float(parts)
    clustered = few * np.diag(inverse @ (together.T @ together) @ inverse)
    # Huber (1981), section 7.6, with both coordinates of a track as samples
    psi2 = float(np.sum(w[kept] ** 2 * np.sum(r[kept] ** 2, axis=1)))
    slope = max(float(np.mean((1 - u2[kept]) * (1 - 3 * u2[kept]))), 0.1)
    variance = psi2 / max(2 * int(np.count_nonzero(kept)) - 6, 1) / slope**2
    plain = np.linalg.inv(np.einsum("nki,nkj->ij", J[kept] / size, J[kept] / size))
    alone = variance * np.diag(plain) / size**2
    return np.asarray(np.sqrt(np.maximum(clustered, alone)))


def _residuals(
    seen: Sequence[tuple[TrackingCamera, Float64Array, Float64Array]], motion: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return residuals of the tracks (n, 2) and their derivatives by the motion (n, 2, 6)."""
    rows, slopes = [], []
    R = rotation_matrix(motion[:3])
    for camera, points, tracked in seen:
        turned = points @ R.T
        moved = turned + motion[3:]
        rows.append(tracked - camera.project(moved))
        by_place = np.empty((len(points), 2, 3))
        for axis in range(3):
            step = np.zeros(3)
            step[axis] = _DIFFERENCE_MM
            ahead, behind = camera.project(moved + step), camera.project(moved - step)
            by_place[:, :, axis] = (ahead - behind) / (2 * _DIFFERENCE_MM)
        # a small further rotation w moves R x by w x (R x): columns e_k x (R x)
        cross = np.cross(np.eye(3)[None], turned[:, None, :])
        slopes.append(
            np.concatenate([np.einsum("nij,nkj->nik", by_place, cross), by_place], axis=-1)
        )
    r, J = np.concatenate(rows), np.concatenate(slopes)
    known = np.isfinite(r).all(axis=1) & np.isfinite(J).all(axis=(1, 2))
    # a point that a step moved behind its camera has no gradient
    return np.where(known[:, None], r, 1e6), np.where(known[:, None, None], J, 0.0)
