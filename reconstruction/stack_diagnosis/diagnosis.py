"""Diagnose images under listed lights from their pixels, one cause after the other."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.checks import Checks
from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.normal_maps import PhotometricStereoError
from reconstruction.photometric_stereo import estimate_normals
from reconstruction.stack_diagnosis import axis_faults, frame_faults, light_faults
from reconstruction.stack_diagnosis.finding import Finding
from reconstruction.stack_diagnosis.light_labels import find_order
from reconstruction.stack_diagnosis.moved_images import find_moved, fit_light
from reconstruction.stack_diagnosis.reduced_stack import ReducedStack, reduce_stack
from reconstruction.stack_diagnosis.shading_space import (
    MAX_POINTS,
    choose_points,
    fit_shading_space,
)

MIN_FRAMES = 6
"""Fewer images leave no redundancy to find a wrong one."""
MIN_CERTAIN_FRAMES = 12
"""Fewer images leave points with four lit samples or fewer, whose shading follows a highlight: then
the other images must confirm a wrong light."""
MIN_POINTS = 30
MIN_LEVEL, MAX_LEVEL = 1e-3, 2.0
"""Bright samples outside this range are in another unit than the white level."""
MIN_SINGULAR_RATIO = 0.01
"""Ratio of extreme singular values of the light vectors below which all images are alike."""
MIN_STRENGTH = 1e-3
MAX_CLIPPED = 0.3
"""Fraction of saturated samples above which nothing else is judged."""
MIN_MATTE, MAX_MATTE_ERROR = 0.15, 0.25
"""Shading of the samples that show near lights, and their largest error."""
STORED_WRONG = ("empty image", "dead light", "padded image")
OF_ANY_LIGHT = ("repeated image", "repeated images", "full-bright image")
"""Faults that are found without the list."""
MOVED_FAULTS = ("moved image", "mirrored image")
CLIPPED, CURVE, FOREIGN = "clipped images", "transfer curve", "foreign list"
AMBIENT, DRIFT = "ambient light", "exposure drift"
SWAPPED, WRONG = "swapped lights", "wrong light"


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Faults of a set of images, the most certain first.

    Attributes
    ----------
    findings
        Faults; empty where none was found.
    order
        (N,), row of the list for each image, as the pixels show.
    left_out
        (N,), images that no map should use.
    directions
        (N, 3), directions estimated from the images, in the frame of the list.
    strength
        (N,), of the lights over their median.
    """

    findings: tuple[Finding, ...]
    order: NDArray[np.intp]
    left_out: BoolArray
    directions: Float64Array
    strength: Float64Array


def diagnose_stack(
    gray: FloatArray,
    light_directions: FloatArray,
    *,
    usable: BoolArray | None = None,
    inside: BoolArray | None = None,
    near: bool = False,
    rng: np.random.Generator,
) -> Diagnosis:
    """Find faults of images of one object under N listed lights.

    Parameters
    ----------
    gray
        (N, H, W), linear samples over the white level, under one light each.
    light_directions
        (N, 3), towards the lights: x right, y up, z towards the camera.
    usable
        (N, H, W), False for saturated samples; None: all are usable.
    inside
        (H, W), the object; None: all pixels.
    near
        Whether the lights are near: their directions then differ from pixel to pixel, and faults
        of the list are not looked for.
    rng
        Draws points and sets of lights.

    Raises
    ------
    PhotometricStereoError
        For fewer than 6 images, or an object without light.
    """
    images = np.asanyarray(gray)  # may lie in a file, larger than memory
    checks = Checks(PhotometricStereoError)
    checks.require(len(images) >= MIN_FRAMES, "gray", f"{len(images)} images", f"{MIN_FRAMES}")
    listed = unit_vectors(np.asarray(light_directions, np.float64))
    checks.shape("light_directions", listed, (len(images), 3))
    mask = np.ones(images.shape[1:], bool) if inside is None else np.asarray(inside, bool)
    stack, unusable = reduce_stack(images, usable, mask)
    checks.require(stack.inside.any(), "inside", "no pixels", "an object of some pixels")
    level = float(np.quantile(stack.gray[stack.usable], 0.999)) if stack.usable.any() else 0.0
    checks.require(level > 0.0, "gray", "no light in any image", "positive samples")
    if not MIN_LEVEL < level < MAX_LEVEL:  # not over the white level: any unit
        stack = replace(stack, gray=stack.gray / level)
    stored = [
        *frame_faults.find_unlit(stack.gray, stack.inside),
        *frame_faults.find_clipped(unusable),
    ]
    out = np.zeros(len(images), bool)
    for one in stored:
        if one.fault in STORED_WRONG:
            out[list(one.frames)] = True
    if any(one.fault == CLIPPED and one.measured > MAX_CLIPPED for one in stored):
        order = np.arange(len(out), dtype=np.intp)  # too few samples are left to judge the light
        return Diagnosis(tuple(stored), order, out, listed, np.ones(len(out)))
    found = _diagnose_light(stack, listed, out.copy(), rng)
    curve = next((one for one in found.findings if one.fault == CURVE), None)
    if curve is not None:  # what else was found may follow from the wrong curve
        curves = light_faults.CURVES_BY_NAME
        decode = next(curves[name] for name in curves if name in curve.remedy)
        linear = replace(stack, gray=decode(stack.gray))
        again = _diagnose_light(linear, listed, out.copy(), rng)
        others = (one for one in again.findings if one.fault != CURVE)
        found = replace(again, findings=(curve, *others))
    if near:
        order = np.arange(len(out), dtype=np.intp)
        kept = tuple(one for one in found.findings if one.fault in OF_ANY_LIGHT)
        found = replace(found, findings=kept, order=order, left_out=_named_in(kept, len(out)) | out)
    every = sorted((*stored, *found.findings), key=lambda one: -one.ratio_to_limit)
    return replace(found, findings=tuple(every))


def _named_in(findings: Iterable[Finding], count: int) -> BoolArray:
    """Return which of the images findings name."""
    return np.isin(np.arange(count), [number for one in findings for number in one.frames])


def _diagnose_light(
    stack: ReducedStack, listed: Float64Array, out: BoolArray, rng: np.random.Generator
) -> Diagnosis:
    """Find faults of the list, of the light and of single images among those not left out."""
    kept = np.flatnonzero(~out)
    order = np.arange(len(out), dtype=np.intp)
    directions, strength = listed.copy(), np.ones(len(out))
    nothing = Diagnosis((), order, out, directions, strength)
    if len(kept) < MIN_FRAMES:
        return nothing
    samples, clear = choose_points(stack.gray[kept], stack.usable[kept], stack.inside, rng)
    if samples.shape[1] < MIN_POINTS:
        raise PhotometricStereoError(
            f"gray: got {samples.shape[1]} bright points, expected {MIN_POINTS}; "
            "check mask and exposure"
        )
    full = [one.renumber(kept) for one in frame_faults.find_full_bright(samples)]
    if full:
        out[[number for one in full for number in one.frames]] = True
        found = _diagnose_light(stack, listed, out, rng)
        return replace(found, findings=(*full, *found.findings))
    findings = [one.renumber(kept) for one in frame_faults.find_repeated(samples, listed[kept])]
    repeated = {number for one in findings for number in one.frames}
    space = fit_shading_space(samples, clear)
    if space.singular_ratio < MIN_SINGULAR_RATIO:
        return replace(nothing, findings=tuple(findings))
    placed, agreement, wrong = find_order(space, samples, clear, listed[kept], rng)
    suspects = [one.renumber(kept) for one in wrong]
    order[kept] = kept[placed]
    if len(kept) < MIN_CERTAIN_FRAMES:
        limit_deg = agreement.limit_deg
        suspects = _drop_refuted(suspects, stack, listed[order], kept, limit_deg)
    directions[kept] = agreement.directions
    strength[kept] = np.maximum(agreement.strength, MIN_STRENGTH)
    findings += light_faults.find_curve(samples, clear, listed[order[kept]], rng)
    if any(one.fault in (CURVE, FOREIGN) for one in (*findings, *suspects)):
        return Diagnosis((*findings, *suspects), order, out, directions, strength)
    rows = listed[order]
    swapped = {number for one in suspects if one.fault == SWAPPED for number in one.frames}
    unexplained = {n for one in suspects if one.fault == WRONG for n in one.frames}
    right = np.array([number not in unexplained for number in kept])
    lights = [one.renumber(kept) for one in light_faults.find_strengths(agreement.strength, right)]
    out[list(unexplained)] = True
    used = np.flatnonzero(~out)
    view = replace(stack, gray=stack.gray / strength[:, None, None])
    once = np.array([number for number in kept if number not in repeated], np.intp)
    of_images = _find_in_images(view, rows, used, once, rng)
    ambient = any(one.fault == AMBIENT for one in of_images)  # it changes strengths with tilt
    findings += [one for one in lights if not (ambient and one.fault == DRIFT)]
    moved = {number for one in of_images if one.fault in MOVED_FAULTS for number in one.frames}
    explained = (moved | repeated) - swapped
    findings += of_images + [one for one in suspects if not explained & set(one.frames)]
    out[list(moved)] = True
    return Diagnosis(tuple(findings), order, out, directions, strength)


def _drop_refuted(
    suspects: list[Finding],
    stack: ReducedStack,
    rows: Float64Array,
    kept: NDArray[np.intp],
    limit_deg: float,
) -> list[Finding]:
    """Drop wrong lights whose image fits its listed light on the surface of the other images."""
    confirmed = []
    for one in suspects:
        if one.fault == WRONG:
            (number,) = one.frames
            valid, normals, albedo = _fit_surface(stack, rows, kept[kept != number])
            good = valid & stack.usable[number]
            light = fit_light(stack.gray[number], good, albedo[..., None] * normals)
            length = float(np.linalg.norm(light))
            if length > 0.0 and light @ rows[number] > length * np.cos(np.radians(limit_deg)):
                continue
        confirmed.append(one)
    return confirmed


def _find_in_images(
    stack: ReducedStack,
    rows: Float64Array,
    used: NDArray[np.intp],
    kept: NDArray[np.intp],
    rng: np.random.Generator,
) -> list[Finding]:
    """Find faults that need normals: axes, ambient and near lights, moved images.

    Parameters
    ----------
    stack
        Images over the strength of their light.
    rows
        (N, 3), listed directions in the order of the images.
    used, kept
        Images for the normals, and images that may have moved.
    """
    mask = stack.inside
    valid, normals, albedo = _fit_surface(stack, rows, used)
    shading = np.maximum(np.einsum("hwi,ni->nhw", normals, rows), 0.0)
    findings = list(axis_faults.find_axes(normals, valid))
    if not findings:  # wrong axes change shading along rows
        predicted = albedo * shading[used]
        findings += light_faults.find_flicker(
            stack.gray[used], stack.usable[used], valid, predicted
        )
    findings += light_faults.find_ambient(stack.gray[used], valid, normals, albedo, rows[used])

    def fit_without(number: int) -> Float64Array:
        others = used[used != kept[number]]
        _, other_normals, other_albedo = _fit_surface(stack, rows, others)
        return other_albedo[..., None] * other_normals

    moved = find_moved(
        stack.gray[kept], stack.usable[kept], valid, albedo[..., None] * normals,
        fit_without=fit_without, step=stack.step,
    )  # fmt: skip
    findings += [one.renumber(kept) for one in moved]
    height, width = mask.shape
    places = np.argwhere(valid)
    places = places[rng.permutation(len(places))[:MAX_POINTS]]
    half = max(0.5 * np.sqrt(np.count_nonzero(mask)), 1.0)
    xy = np.stack([places[:, 1] - (width - 1) / 2, (height - 1) / 2 - places[:, 0]], axis=1) / half
    at = (slice(None), places[:, 0], places[:, 1])
    over_albedo = stack.gray[used][at] / np.maximum(albedo[at[1:]], 1e-9)
    matte = shading[used][at]
    mirror_cosine = unit_vectors(rows[used] + (0.0, 0.0, 1.0)) @ normals[at[1:]].T
    lit = (matte > MIN_MATTE) & (np.abs(over_albedo - matte) < MAX_MATTE_ERROR)
    weights = lit.astype(np.float64)
    findings += light_faults.find_near(over_albedo, weights, mirror_cosine, rows[used], xy)
    return findings


def _fit_surface(
    stack: ReducedStack, rows: Float64Array, used: NDArray[np.intp]
) -> tuple[BoolArray, Float64Array, Float64Array]:
    """Return valid pixels (H, W), normals (H, W, 3) and albedo (H, W) of some of the images."""
    usable = stack.usable[used] & stack.inside
    maps = estimate_normals(stack.gray[used], rows[used], valid=usable)
    valid = maps.valid & stack.inside
    normals = np.where(valid[..., None], maps.normals, 0.0).astype(np.float64)
    return valid, normals, np.where(valid, maps.albedo, 0.0).astype(np.float64)
