"""Find mirrored and moved images, whose texture has another position than in the other images.

Shading alone does not show this: a mirrored image of a ball looks like another light. So every
image is compared under the light that fits it best, straight, mirrored and shifted, and only in
its fine structure. That is albedo and relief, which no light moves. An image that fits worse than
the others is compared with the surface of the others alone: it would else pull the surface along.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.stack_diagnosis.finding import Finding

FINE_PX = 4.0
"""Standard deviation of the filter whose result is subtracted: what is left is fine structure."""
MIN_SHADING = 0.15
"""Light over that of an image's bright samples, below which a sample carries no structure."""
MAX_MIRROR_COSINE, MIN_MATTE_FRACTION = 0.85, 0.3
"""Cosine between normal and half vector from which a highlight is possible; such samples are left
out if this fraction of the lit ones remains."""
TUKEY_CONSTANT, MAX_RESIDUAL = 4.7, 4.0
"""Residual in standard deviations beyond which a sample fits no matte light, and is left out."""
N_FIT_STEPS, N_SHIFT_STEPS = 8, 6
MIN_SAMPLES = 100
MIN_MISFIT = 0.03
"""Robust deviation from the best matte light, over its median, below which nothing has moved: a
smooth surface of one albedo has no fine structure but noise."""
MIN_OUTLIER_RATIO = 1.5
"""Misfit over the median image's, from which a shift is searched all over its range."""
MAX_ALIGNED_MISFIT = 0.5
"""Misfit of an aligned image from which it is not of this surface, wherever it is: grazing light
that leaves most samples in cast shadow fits nothing."""
MIN_CORRELATION, MIN_GAIN = 0.5, 0.1
"""Correlation of the fine structure of a mirrored image, and its gain over the straight one."""
MIN_SHIFT_PX, MAX_STEP_PX = 0.7, 2.0
MAX_SHIFT_FRACTION = 0.25
"""Largest shift over the smaller side of an image."""
FIRST_RING_PX, N_RING_DIRECTIONS = 1.5, 8
"""Radius of the inmost ring of trial shifts, and shifts per ring; each ring is twice as wide."""
MAX_UNEXPLAINED = 0.7
"""Variance of the fine structure that a shift leaves unexplained, over that without it."""
MIN_SHIFT_GAIN = 0.02


class FineStructure(NamedTuple):
    """Fine structure of an image and of its prediction, (H, W), their correlation and misfit."""

    image: Float64Array
    predicted: Float64Array
    weights: Float64Array
    correlation: float
    misfit: float


def find_moved(
    gray: Float64Array,
    usable: BoolArray,
    inside: BoolArray,
    scaled_normals: Float64Array,
    *,
    fit_without: Callable[[int], Float64Array],
    step: int = 1,
) -> Iterator[Finding]:
    """Yield images whose fine structure fits the other images mirrored or shifted.

    Parameters
    ----------
    gray, usable
        (N, H, W), samples and whether they are usable.
    inside
        (H, W), the object.
    scaled_normals
        (H, W, 3), normals times albedo, of all images; 0 where they are not valid.
    fit_without
        Returns the same of all images but one, by its number.
    step
        Pixels of the images per pixel of these arrays, in which shifts are stated.
    """
    compared = [
        _compare(image, inside & good, scaled_normals)
        for image, good in zip(gray, usable, strict=True)
    ]
    typical = float(np.median([one.misfit for one in compared])) if compared else 0.0
    for number, (image, straight) in enumerate(zip(gray, compared, strict=True)):
        if straight.misfit < MIN_MISFIT:
            continue
        surface, good = scaled_normals, inside & usable[number]
        outlier = straight.misfit > MIN_OUTLIER_RATIO * typical
        if outlier:
            surface = fit_without(number)
            good = good & surface.any(axis=-1)
            straight = _compare(image, good, surface)
        mirrored = straight.correlation
        if mirrored < 1.0 - MIN_GAIN:
            mirrored = max(
                _compare(image[turn], good[turn], surface, inside).correlation
                for turn in (np.s_[:, ::-1], np.s_[::-1])
            )
        gain = mirrored - straight.correlation
        if gain > MIN_GAIN and mirrored > MIN_CORRELATION:
            yield Finding(
                "mirrored image", (number,),
                f"image {number + 1}: correlation with the other images: {mirrored:.2f} mirrored, "
                f"{straight.correlation:.2f} unmirrored",
                gain, MIN_GAIN, "mirror the image back",
            )  # fmt: skip
            continue
        pair = _Pair(image, good, surface)
        shift, aligned = _find_shift(pair, straight, everywhere=outlier)
        unexplained = (1.0 - aligned.correlation**2) / max(1.0 - straight.correlation**2, 1e-12)
        shift, limit_px = step * shift, step * MIN_SHIFT_PX
        size = float(np.hypot(*shift))
        fits = aligned.misfit < MAX_ALIGNED_MISFIT
        if size > limit_px and unexplained < MAX_UNEXPLAINED and fits:
            yield Finding(
                "moved image", (number,),
                f"image {number + 1} is shifted by ({shift[0]:.1f}, {shift[1]:.1f}) pixels: its "
                f"fine structure then differs {1.0 / max(unexplained, 1e-3):.1f} times less",
                size, limit_px, "align the image with the others, or leave it out",
            )  # fmt: skip


def _compare(
    image: Float64Array,
    good: BoolArray,
    scaled_normals: Float64Array,
    inside: BoolArray | None = None,
) -> FineStructure:
    """Compare an image with the surface under the light that fits it best."""
    good = good if inside is None else good & inside
    nothing = FineStructure(image, image, np.zeros(image.shape), 0.0, 0.0)
    if np.count_nonzero(good) < MIN_SAMPLES:
        return nothing
    predicted, mirrors = _relight(image, good, scaled_normals)
    lit = good & (predicted > MIN_SHADING * np.quantile(predicted[good], 0.95))
    if np.count_nonzero(lit & ~mirrors) > MIN_MATTE_FRACTION * np.count_nonzero(lit):
        lit &= ~mirrors
    if np.count_nonzero(lit) < MIN_SAMPLES:
        return nothing
    residual = image - predicted
    spread = 1.4826 * float(np.median(np.abs(residual[lit]))) + 1e-12
    weights = (lit & (np.abs(residual) < MAX_RESIDUAL * spread)).astype(np.float64)
    own, other = _fine(image, weights), _fine(predicted, weights)
    size = float(np.sqrt(np.sum(own**2) * np.sum(other**2)))
    correlation = float(np.sum(own * other)) / max(size, 1e-30)
    misfit = spread / max(float(np.median(image[lit])), 1e-12)
    return FineStructure(own, other, weights, correlation, misfit)


def _relight(
    image: Float64Array, good: BoolArray, scaled_normals: Float64Array
) -> tuple[Float64Array, BoolArray]:
    """Return the shading under the light that fits an image, and where it may have highlights."""
    light = fit_light(image, good, scaled_normals)
    if not light.any():
        return np.zeros(image.shape), np.zeros(image.shape, bool)
    towards = light / max(float(np.linalg.norm(light)), 1e-12) + np.array([0.0, 0.0, 1.0])
    length = max(float(np.linalg.norm(towards)), 1e-12)
    albedo = np.linalg.norm(scaled_normals, axis=-1)
    mirrors = scaled_normals @ towards > MAX_MIRROR_COSINE * albedo * length
    return np.asarray(np.maximum(scaled_normals @ light, 0.0)), np.asarray(mirrors)


def fit_light(image: Float64Array, good: BoolArray, scaled_normals: Float64Array) -> Float64Array:
    """Return the light, (3,), that fits an image by Tukey's biweight; 0 for too few lit samples.

    Parameters
    ----------
    image, good
        (H, W), and which of its samples are usable.
    scaled_normals
        (H, W, 3), normals times albedo.
    """
    lit = good & (image > MIN_SHADING * np.quantile(image[good], 0.95)) if good.any() else good
    light: Float64Array = np.zeros(3)
    if np.count_nonzero(lit) < MIN_SAMPLES:
        return light
    values, rows = image[lit], scaled_normals[lit]
    weights: Float64Array = np.ones(len(values))
    for _ in range(N_FIT_STEPS):
        scaled = rows * weights[:, None]
        normal = rows.T @ scaled + 1e-9 * np.eye(3)
        light = np.asarray(np.linalg.solve(normal, scaled.T @ values), np.float64)
        residual = values - rows @ light
        spread = 1.4826 * float(np.median(np.abs(residual))) + 1e-12
        weights = np.maximum(1.0 - (residual / (TUKEY_CONSTANT * spread)) ** 2, 0.0) ** 2
    return light


def _fine(values: Float64Array, weights: Float64Array) -> Float64Array:
    """Return values without what a wide filter leaves, 0 where they have no weight."""
    import cv2

    def blur(array: Float64Array) -> Float64Array:
        return np.asarray(
            cv2.GaussianBlur(array, (0, 0), FINE_PX, borderType=cv2.BORDER_CONSTANT), np.float64
        )

    return (values - blur(values * weights) / np.maximum(blur(weights), 1e-6)) * weights


class _Pair(NamedTuple):
    """An image (H, W), its valid samples, and the surface (H, W, 3) with which it is compared."""

    image: Float64Array
    good: BoolArray
    surface: Float64Array

    def compare_at(self, shift: Float64Array) -> FineStructure:
        """Compare the image, shifted back by (x, y) px, with the surface."""
        import cv2

        back = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
        size = self.image.shape[::-1]
        # linear interpolation blurs noise most at half pixels, where shifts would then end
        flags = cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP
        moved = cv2.warpAffine(self.image, back, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        flags, good = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, self.good.astype(np.float64)
        clear = cv2.warpAffine(good, back, size, flags=flags, borderMode=cv2.BORDER_CONSTANT)
        return _compare(np.asarray(moved, np.float64), self.good & (clear > 0.99), self.surface)


def _find_shift(
    pair: _Pair, straight: FineStructure, *, everywhere: bool
) -> tuple[Float64Array, FineStructure]:
    """Return the shift (x, y) of an image, px, and how it then compares; 0 where none is found.

    The search starts from the gradient's step and the phase correlation, and, if `everywhere`,
    from the best shift on rings: a smooth object under another light looks aligned.
    """
    import cv2

    nothing = np.zeros(2), straight
    if straight.correlation > 1.0 - MIN_SHIFT_GAIN:
        return nothing
    shape = pair.image.shape
    max_px = MAX_SHIFT_FRACTION * min(shape)
    window = cv2.createHanningWindow(shape[::-1], cv2.CV_64F)
    found = cv2.phaseCorrelate(straight.predicted, straight.image, window)[0]
    coarse = np.array(found, np.float64)
    starts = [_step(straight)]
    if 1.0 < np.abs(coarse).max() < max_px:
        starts.append(coarse)
    if everywhere:
        starts.append(max(_list_rings(max_px), key=lambda one: pair.compare_at(one).correlation))
    best, shift = straight, np.zeros(2)
    for start in starts:
        if np.hypot(*start) < 0.5 * MIN_SHIFT_PX:
            continue
        tried = start
        for _ in range(N_SHIFT_STEPS):
            aligned = pair.compare_at(tried)
            if aligned.correlation > best.correlation:
                best, shift = aligned, tried
            by = _step(aligned)
            tried = np.asarray(tried + by, np.float64)
            if np.hypot(*by) < 0.02 or np.abs(tried).max() > max_px:
                break
    if best.correlation < max(straight.correlation + MIN_SHIFT_GAIN, MIN_CORRELATION):
        return nothing
    return shift, best


def _list_rings(max_px: float) -> list[Float64Array]:
    """Return shifts (x, y) on rings around 0, up to a radius, px."""
    angles = 2.0 * np.pi * np.arange(N_RING_DIRECTIONS) / N_RING_DIRECTIONS
    radii = FIRST_RING_PX * 2.0 ** np.arange(max(int(np.log2(max_px / FIRST_RING_PX)), 0) + 1)
    return [
        radius * np.array([np.cos(angle), np.sin(angle)]) for radius in radii for angle in angles
    ]


def _step(fine: FineStructure) -> Float64Array:
    """Return the shift (x, y) that explains the difference of both structures best, px."""
    down, across = (np.asarray(one, np.float64) for one in np.gradient(fine.predicted))
    kept = fine.weights > 0.0
    rows = np.stack([fine.predicted[kept], -across[kept], -down[kept]], axis=1)
    if len(rows) < MIN_SAMPLES:
        return np.zeros(2)
    normal = rows.T @ rows
    normal += 1e-9 * np.trace(normal) * np.eye(3)
    found = np.linalg.solve(normal, rows.T @ fine.image[kept])
    return np.asarray(np.clip(found[1:] / max(found[0], 0.3), -MAX_STEP_PX, MAX_STEP_PX))
