"""Find flipped and exchanged axes of a list of lights: the normals are then of no surface."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import permutations, product

import numpy as np

from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.stack_diagnosis.finding import Axes, Finding

MIN_FACING = 0.8
"""Fraction of the normals that must face the camera."""
CURL_RATIO = 0.6
"""Ratio of curls below which other axes are reported."""
MIN_OUTWARD = 0.2
"""Mean component of the normals at the object's outline, out of the image's object."""
MIN_Z = 0.15
SMOOTHING_PX = 1.5
"""Standard deviation of the filter of the normals: curl is mostly noise from pixel to pixel."""


def find_axes(normals: Float64Array, valid: BoolArray) -> Iterator[Finding]:
    """Yield the axes of the list under which the normals are those of a surface.

    The field of slopes of a surface has no curl, its normals face the camera, and at the outline
    of an object they point outwards. A list whose axes were flipped or exchanged turns the
    normals alike.

    Parameters
    ----------
    normals
        (H, W, 3), under the list as it is; x right, y up, z towards the camera.
    valid
        (H, W).
    """
    import cv2

    outline = find_outline(valid)
    weight = cv2.GaussianBlur(valid.astype(np.float64), (0, 0), SMOOTHING_PX)
    blurred = cv2.GaussianBlur(np.where(valid[..., None], normals, 0.0), (0, 0), SMOOTHING_PX)
    normals = unit_vectors(blurred / np.maximum(weight, 1e-6)[..., None], min_length=1e-9)
    scores = {}
    for axes in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turned = normals[..., axes] * signs
            facing = float(np.mean(turned[..., 2][valid] > 0.0))
            if facing > MIN_FACING:
                outward = _outward(turned, outline)
                scores[axes, signs] = median_curl(turned, valid), outward
    listed = (0, 1, 2), (1.0, 1.0, 1.0)
    hollow = outline is not None and scores.get(listed, (0.0, 1.0))[1] < -MIN_OUTWARD
    candidates = {
        key: curl
        for key, (curl, outward) in scores.items()
        if outline is None or outward > (MIN_OUTWARD if hollow else -MIN_OUTWARD)
    }
    if not candidates:
        return
    best = min(candidates, key=lambda key: candidates[key])
    if best == listed:
        return
    if listed not in scores:
        facing = float(np.mean(normals[..., 2][valid] > 0.0))
        evidence = f"{1.0 - facing:.0%} of the normals face away from the camera"
        measured, limit = 1.0 - facing, 1.0 - MIN_FACING
    elif hollow:
        evidence = "normals at the outline point into the object: it looks hollow"
        measured, limit = -scores[listed][1], MIN_OUTWARD
    elif candidates[best] < CURL_RATIO * scores[listed][0]:
        ratio = scores[listed][0] / candidates[best]
        evidence = f"slopes have {ratio:.1f} times the curl that they have with other axes"
        measured, limit = ratio, 1.0 / CURL_RATIO
    else:
        return
    read = _name(*best)
    remedy = f"read the list as {describe_axes(list_ways(read, valid))}"
    yield Finding("axes of the list", (), evidence, measured, limit, remedy, axes=read)


def list_ways(axes: Axes, valid: BoolArray) -> list[Axes]:
    """Return axes, and without an outline (H, W) also those that lead to the hollow twin.

    Examples
    --------
    >>> list_ways(("-x", "y", "z"), np.ones((8, 8), bool))
    [('-x', 'y', 'z'), ('x', '-y', 'z')]
    """
    if find_outline(valid) is not None:
        return [axes]
    x, y = (one[1:] if one.startswith("-") else f"-{one}" for one in axes[:2])
    return [axes, (x, y, axes[2])]


def describe_axes(ways: Sequence[Axes]) -> str:
    """Return the axes of `list_ways` as a message has them."""
    shown = " or ".join(f"({', '.join(way)})" for way in ways)
    twin = ": without an outline, a surface and its hollow twin look alike"
    return shown + twin * (len(ways) > 1)


def _name(axes: tuple[int, ...], signs: tuple[float, ...]) -> Axes:
    """Return how rows are to be read, such as ("x", "-y", "z")."""
    x, y, z = (
        f"{'-' if sign < 0 else ''}{'xyz'[axis]}" for axis, sign in zip(axes, signs, strict=True)
    )
    return x, y, z


def median_curl(normals: Float64Array, valid: BoolArray) -> float:
    """Return the median absolute curl of the slopes."""
    good = valid & (normals[..., 2] > MIN_Z)
    z = np.maximum(normals[..., 2], MIN_Z)
    p, q = -normals[..., 0] / z, -normals[..., 1] / z  # dz/dx with x right, dz/dy with y up
    curl = np.abs(-np.diff(p, axis=0)[:, :-1] - np.diff(q, axis=1)[:-1])
    inner = good[:-1, :-1] & good[1:, :-1] & good[:-1, 1:]
    return float(np.median(curl[inner])) if np.count_nonzero(inner) > 20 else float("inf")


def find_outline(valid: BoolArray) -> tuple[BoolArray, Float64Array] | None:
    """Return pixels along the outline and directions out of the object; None: it has none."""
    import cv2

    height, width = valid.shape
    border = np.concatenate([valid[0], valid[-1], valid[:, 0], valid[:, -1]])
    if border.mean() > 0.5 or not valid.any():
        return None
    distance = cv2.distanceTransform(
        np.pad(valid, 1).astype(np.uint8), cv2.DIST_L2, 5
    )[1:-1, 1:-1]  # fmt: skip
    radius = np.sqrt(np.count_nonzero(valid) / np.pi)
    near = valid & (distance < max(0.15 * radius, 3.0))
    smooth = cv2.GaussianBlur(valid.astype(np.float64), (0, 0), max(0.1 * radius, 2.0))
    down, across = np.gradient(smooth)
    out = -np.stack([across, -down], axis=-1)
    length = np.linalg.norm(out, axis=-1, keepdims=True)
    out = out / np.maximum(length, 1e-9)
    # an object that the image cuts has no outline there
    margin = max(int(0.05 * min(height, width)), 1)
    near[:margin] = near[-margin:] = False
    near[:, :margin] = near[:, -margin:] = False
    return (near, out) if np.count_nonzero(near) > 20 else None


def _outward(normals: Float64Array, outline: tuple[BoolArray, Float64Array] | None) -> float:
    if outline is None:
        return 0.0
    near, out = outline
    return float(np.mean(np.sum(normals[near][:, :2] * out[near], axis=-1)))
