"""Pair the samples of two sessions' maps: by texture, surface, image structure or site."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from skimage.registration import phase_cross_correlation

from reconstruction.correspondence import expression_alignment
from reconstruction.registration import RegistrationError, dense_flow
from skinrig.arrays import BoolArray, Float64Array, Int64Array
from skinrig.evaluating.session_maps import SessionMaps

MAX_TEXTURE_DISTANCE_MM: Final = 5.0
"""Maximum median distance of equal texels, after rigid registration, of one parameterization."""
MAX_TURN_RAD: Final = np.pi / 4.0
"""Maximum rotation between two sessions, whose heads both face +z."""
MAX_PAIR_DISTANCE_MM: Final = 1.0
"""Maximum distance of paired points of two surfaces of different parameterizations."""
SCAN_ERROR_MM: Final = 0.5
"""Standard uncertainty of a scanned point along the normal, after a rigid fit."""
MIN_REGISTERED_FRACTION: Final = 0.1
"""Minimum fraction of A's skin that a registration of images must place."""
N_SURFACE_STEPS: Final = 20
MAX_FIT_POINTS: Final = 5_000
KEPT_FRACTION: Final = 0.8
"""Fraction of nearest pairs of a rigid step; the others have no partner."""


@dataclass(frozen=True, slots=True, eq=False)
class ComparedShape:
    """Deformation of the skin between two sessions, beyond rotation, shift and, of images, size.

    Attributes
    ----------
    moved
        (M, C): displacement of each pair, px in an image, mm along the normal on a surface.
    stderr
        (M,): standard uncertainty along each axis.
    unit
        "px" or "mm".
    """

    moved: Float64Array
    stderr: Float64Array
    unit: str


@dataclass(frozen=True, slots=True, eq=False)
class Pairing:
    """Samples of A and B that are the same skin.

    Attributes
    ----------
    rows, others
        (M,): indices of samples of A and B.
    rotation
        (3, 3): rotates directions of B into the frame of A.
    how
        How they were found, in words.
    moved
        B, with images resampled at the pixels of A; `others` are its samples.
    shape
        Deformation from A to B; None where it is not known.
    """

    rows: Int64Array
    others: Int64Array
    rotation: Float64Array
    how: str
    moved: SessionMaps
    shape: ComparedShape | None = None


def pair_samples(a: SessionMaps, b: SessionMaps) -> Pairing:
    """Pair the samples of two sessions of one kind of rig.

    Parameters
    ----------
    a, b
        Sessions of the same kind.
    """
    if a.kind == "sites":
        common = [(k, b.sites.index(site)) for k, site in enumerate(a.sites) if site in b.sites]
        rows, others = np.array(common, np.int64).reshape(-1, 2).T
        return Pairing(rows, others, np.eye(3), "by site", b)
    if a.kind == "surface":
        return _pair_surfaces(a, b)
    return _pair_images(a, b)


def _pair_surfaces(a: SessionMaps, b: SessionMaps) -> Pairing:
    """Pair texels of one parameterization, or nearest points of two surfaces."""
    if a.shape == b.shape:
        both = np.flatnonzero(
            a.seen
            & b.seen
            & np.isfinite(a.position_mm).all(axis=1)
            & np.isfinite(b.position_mm).all(axis=1)
        )
        if len(both) >= 3:
            rotation, shift = _fit_rigid(b.position_mm[both], a.position_mm[both])
            apart = b.position_mm[both] @ rotation.T + shift - a.position_mm[both]
            along = np.sum(apart * a.normals[both], axis=1, keepdims=True)
            known = np.isfinite(along[:, 0])
            shape = ComparedShape(
                np.where(known[:, None], along, 0.0), np.full(len(both), SCAN_ERROR_MM), "mm"
            )
            turn_rad = Rotation.from_matrix(rotation).magnitude()
            near = np.median(np.linalg.norm(apart, axis=1)) <= MAX_TEXTURE_DISTANCE_MM
            if near and turn_rad <= MAX_TURN_RAD:
                how = "by their common texture, after a rigid fit"
                return Pairing(both, both, rotation, how, b, shape)
    known = [np.flatnonzero(one.seen & np.isfinite(one.position_mm).all(axis=1)) for one in (a, b)]
    if min(len(index) for index in known) < 3:
        none = np.zeros(0, np.int64)
        return Pairing(none, none, np.eye(3), "not at all: a surface has no texels", b)
    fixed, moving = a.position_mm[known[0]], b.position_mm[known[1]]
    tree = cKDTree(fixed)
    some = moving[:: -(-len(moving) // MAX_FIT_POINTS)]
    rotation, shift = np.eye(3), fixed.mean(axis=0) - moving.mean(axis=0)
    for _ in range(N_SURFACE_STEPS):
        distance, nearest = tree.query(some @ rotation.T + shift)
        kept = distance <= np.quantile(distance, KEPT_FRACTION)
        rotation, shift = _fit_rigid(some[kept], fixed[nearest[kept]])
    distance, nearest = tree.query(moving @ rotation.T + shift)
    near = distance <= MAX_PAIR_DISTANCE_MM
    how = "by their nearest points, after a rigid fit"
    return Pairing(known[0][nearest[near]], known[1][near], rotation, how, b)


def _fit_rigid(
    source_mm: Float64Array, target_mm: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return rotation and shift that take points of a source to a target, least squares."""
    middle, goal = source_mm.mean(axis=0), target_mm.mean(axis=0)
    fit, _ = Rotation.align_vectors(target_mm - goal, source_mm - middle)
    rotation = fit.as_matrix()
    return rotation, goal - rotation @ middle


def _pair_images(a: SessionMaps, b: SessionMaps) -> Pairing:
    """Pair pixels by image structure, or else by the outline of the skin."""
    seen = [one.seen.reshape(one.shape) for one in (a, b)]
    source: Float64Array | None = None
    error: Float64Array | None = None
    good: BoolArray = seen[0]
    how = ""
    for marks, name in ((None, "structure"), (_shifted_corners(a, b), "shift and structure")):
        try:
            found = expression_alignment.align(
                b.structure,
                a.structure,
                landmarks_moving=None if marks is None else marks[1],
                landmarks_neutral=None if marks is None else marks[0],
                valid_moving=seen[1],
                valid_neutral=seen[0],
            )
        except (RegistrationError, ValueError, cv2.error):
            continue
        if found.valid.sum() >= MIN_REGISTERED_FRACTION * seen[0].sum():
            source, good = found.source_px.astype(np.float64), found.valid & seen[0]
            error, how = found.error_px.astype(np.float64), f"by the {name} of the skin"
            break
    if source is None:
        source, good = _by_outline(*seen)
        how = "by the outline of the skin: its structure does not match"
    moved = _warp(b, source)
    rows = np.flatnonzero(good & moved.seen.reshape(a.shape))
    shape = None
    if error is not None:
        away = _beyond_similarity(a, source.reshape(-1, 2), rows)
        shape = ComparedShape(away, error.reshape(-1)[rows] / np.sqrt(2.0), "px")
    return Pairing(rows, rows, np.eye(3), how, moved, shape)


def _beyond_similarity(a: SessionMaps, source_px: Float64Array, rows: Int64Array) -> Float64Array:
    """Return the displacement of pixels that no shift, rotation and size explains, (M, 2), px."""
    line, column = np.divmod(rows, a.shape[1])
    place = column + 1j * line
    goal = source_px[rows, 0] + 1j * source_px[rows, 1]
    design = np.stack([place, np.ones_like(place)], axis=1)
    factors, *_ = np.linalg.lstsq(design, goal, rcond=None)
    rest = goal - design @ factors
    return np.stack([rest.real, rest.imag], axis=1)


def _shifted_corners(
    a: SessionMaps, b: SessionMaps
) -> tuple[dict[str, tuple[float, float]], dict[str, tuple[float, float]]] | None:
    """Return corners of A, and where they are in B if it is only shifted; None for two sizes."""
    if a.structure.shape != b.structure.shape:
        return None
    flat = []
    for one in (a, b):
        seen = one.seen.reshape(one.shape)
        image = one.structure if one.structure.ndim == 2 else one.structure.mean(axis=-1)
        flat.append(np.where(seen, image - image[seen].mean(), 0.0) if seen.any() else 0.0 * image)
    if not all(np.ptp(image) > 0.0 for image in flat):
        return None
    down, across = phase_cross_correlation(flat[1], flat[0], normalization=None)[0]
    height, width = a.shape
    places = {
        f"{x} {y}": (x * (width - 1), y * (height - 1)) for x in (0.2, 0.8) for y in (0.2, 0.8)
    }
    return places, {name: (x + across, y + down) for name, (x, y) in places.items()}


def _warp(maps: SessionMaps, source_px: Float64Array) -> SessionMaps:
    """Return maps resampled at positions (H, W, 2), column and row, px; errors of the nearest."""
    at = source_px.astype(np.float32)
    nearest = np.rint(at).astype(np.int64)
    last = np.array([maps.shape[1] - 1, maps.shape[0] - 1])
    inside = ((nearest >= 0) & (nearest <= last)).all(axis=-1)
    columns, lines = np.moveaxis(np.clip(nearest, 0, last), -1, 0)
    index = (lines * maps.shape[1] + columns).reshape(-1)
    moved = {}
    for name, one in maps.quantities.items():
        width = one.values.shape[1]
        known = np.where(one.valid[:, None], one.values, 0.0).astype(np.float32)
        unknown = (~one.valid).astype(np.float32).reshape(maps.shape)
        image = known.reshape(*maps.shape, width)
        values = dense_flow.sample_image(image, at).reshape(-1, width).astype(np.float64)
        whole = dense_flow.sample_image(unknown, at).reshape(-1) <= 0.0
        moved[name] = dataclasses.replace(
            one,
            values=values,
            stderr=one.stderr[index],
            noise=one.noise[index],
            valid=whole & inside.reshape(-1),
        )
    seen = np.any([one.valid for one in moved.values()], axis=0)
    return dataclasses.replace(maps, shape=at.shape[:2], quantities=moved, seen=seen)


def _by_outline(one: BoolArray, other: BoolArray) -> tuple[Float64Array, BoolArray]:
    """Return where each pixel of one mask is in the other when their bounding boxes are matched."""
    rows, columns = np.indices(one.shape)
    source = np.zeros((*one.shape, 2))
    for k, index in enumerate((columns, rows)):
        spans = [np.flatnonzero(mask.any(axis=k)) for mask in (one, other)]
        if not all(len(span) for span in spans):
            return source, np.zeros_like(one)
        (low, high), (start, end) = ((span[0], span[-1]) for span in spans)
        source[..., k] = start + (index - low) * (end - start) / max(high - low, 1)
    return source, one
