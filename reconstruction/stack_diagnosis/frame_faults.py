"""Find images that are empty, padded, repeated, clipped, moved or mirrored."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.stack_diagnosis.finding import Finding

MIN_BRIGHTNESS = 0.05
"""Bright samples of an image over the median image's, below which it shows no light."""
MIN_PADDED_FRACTION = 0.03
"""Fraction of an image's rows or columns with one and the same value that counts as padding."""
MIN_EDGE_BRIGHTNESS = 0.3
"""Light of the line next to padding over that of the typical image."""
MAX_CLIPPED_FRACTION = 0.02
"""Fraction of the samples of the object that may be saturated."""
BRIGHT_QUANTILE, MIN_FULL_BRIGHT = 0.8, 2.0
MAX_REPEAT_DIFFERENCE = 0.25
"""Difference of two images over the typical difference of an image to its most similar one."""
MIN_REPEAT_ANGLE_DEG = 2.0
"""Angle between listed lights up to which images may be equal."""
MIN_SHIFT_PX = 0.7
MIN_SHIFT_SIGMAS = 6.0
MIN_IMAGE_CORRELATION = 0.5
MAX_SHIFT_FRACTION = 0.25
"""Of the smaller side of an image."""
MAX_REST_AFTER_SHIFT = 0.6
"""Remaining difference over the difference without a shift."""
N_SHIFT_STEPS = 8
N_TRIMMED = 3
"""Standard deviations beyond which residuals do not enter a shift."""


def find_unlit(gray: Float64Array, inside: BoolArray) -> Iterator[Finding]:
    """Yield images without light, and images of which a part is filled with one value."""
    bright = np.array([np.quantile(image[inside], 0.99) for image in gray])
    relative = bright / max(float(np.median(bright)), 1e-12)
    for number in np.flatnonzero(relative < MIN_BRIGHTNESS):
        empty = np.ptp(gray[number]) == 0.0
        fault = "empty image" if empty else "dead light"
        light = f"has {relative[number]:.1%} of the light of the median image"
        what = "has one value everywhere" if empty else light
        yield Finding(
            fault, (int(number),), f"image {number + 1} {what}",
            1.0 - float(relative[number]), 1.0 - MIN_BRIGHTNESS,
            "take the image again, or leave its row of the list out",
        )  # fmt: skip
    lit = relative >= MIN_BRIGHTNESS
    typical = np.median(gray[lit], axis=0) if lit.any() else gray[0]
    for number in np.flatnonzero(lit):
        for axis, name in ((1, "rows"), (0, "columns")):
            padded = _constant_lines(gray[number], typical, inside, axis)
            if padded > MIN_PADDED_FRACTION:
                yield Finding(
                    "padded image", (int(number),),
                    f"{padded:.0%} of the {name} of image {number + 1} have one value",
                    padded, MIN_PADDED_FRACTION,
                    "read the image again: a part of it was lost on its way",
                )  # fmt: skip
                break


def _constant_lines(
    image: Float64Array, typical: Float64Array, inside: BoolArray, axis: int
) -> float:
    """Return the fraction of lines through the object that have one value, other images not.

    The line next to them is as bright as usual: an attached shadow grows dark by degrees.
    """
    crossed = inside.sum(axis=axis) >= 8
    if not crossed.any():
        return 0.0
    low = np.where(inside, image, np.inf).min(axis=axis)
    high = np.where(inside, image, -np.inf).max(axis=axis)
    brightest = np.where(inside, typical, 0.0).max(axis=axis)
    flat = crossed & (low == high) & (low < 0.5 * brightest) & (brightest > 0.05 * typical.max())
    usual = np.where(inside, image, 0.0).sum(axis=axis) > MIN_EDGE_BRIGHTNESS * np.where(
        inside, typical, 0.0
    ).sum(axis=axis)
    lines = np.flatnonzero(flat)
    neighbors = np.concatenate([lines - 1, lines + 1])
    neighbors = neighbors[(neighbors >= 0) & (neighbors < len(flat))]
    edge = neighbors[crossed[neighbors] & ~flat[neighbors]]
    if not edge.size or not usual[edge].any():
        return 0.0
    return float(lines.size / np.count_nonzero(crossed))


def find_full_bright(samples: Float64Array) -> Iterator[Finding]:
    """Yield images that are brighter at most points (N, P) than one light makes them."""
    bright = np.quantile(samples, BRIGHT_QUANTILE, axis=0)
    times = np.median(samples / np.maximum(bright, 1e-12), axis=1)
    for number in np.flatnonzero(times > MIN_FULL_BRIGHT):
        yield Finding(
            "full-bright image", (int(number),),
            f"most points of image {number + 1} have {times[number]:.1f} times the light of their "
            "bright images",
            float(times[number]), MIN_FULL_BRIGHT, "leave the image out: several lights are on",
        )  # fmt: skip


def find_clipped(fraction: Float64Array) -> Iterator[Finding]:
    """Yield the clipping of all images; single ones are named when others are not clipped.

    Parameters
    ----------
    fraction
        (N,), of each image's samples of the object, that are saturated.
    """
    worst = np.flatnonzero(fraction > MAX_CLIPPED_FRACTION)
    if worst.size:
        frames = () if worst.size > len(fraction) // 2 else tuple(int(k) for k in worst)
        yield Finding(
            "clipped images", frames,
            f"up to {fraction.max():.0%} of an image's samples are saturated, in {worst.size} "
            "images",
            float(fraction.max()), MAX_CLIPPED_FRACTION,
            "expose for less light; saturated samples carry no shading",
        )  # fmt: skip


def find_repeated(samples: Float64Array, directions: Float64Array) -> Iterator[Finding]:
    """Yield pairs of images that differ far less than others do whose lights are as far apart.

    Parameters
    ----------
    samples
        (N, P).
    directions
        (N, 3), listed unit vectors.
    """
    n = len(samples)
    unit = samples / np.maximum(np.linalg.norm(samples, axis=1, keepdims=True), 1e-12)
    apart = np.sqrt(np.maximum(2.0 - 2.0 * unit @ unit.T, 0.0)) + 10.0 * np.eye(n)
    typical = float(np.median(apart.min(axis=1)))
    if typical == 0.0:
        yield Finding(
            "repeated images", (), "most images have the same content", 1.0, 0.5,
            "import one image per light",
        )  # fmt: skip
        return
    angle = np.degrees(np.arccos(np.clip(directions @ directions.T, -1.0, 1.0)))
    per_degree = apart / np.maximum(angle, 1e-3)
    alike = (apart < MAX_REPEAT_DIFFERENCE * typical) & (angle > MIN_REPEAT_ANGLE_DEG)
    alike &= per_degree < MAX_REPEAT_DIFFERENCE * np.median(per_degree[angle > 0.0])
    for i, j in np.argwhere(np.triu(alike)):
        yield Finding(
            "repeated image", (int(i), int(j)),
            f"images {i + 1} and {j + 1} differ by {apart[i, j] / typical:.1%} of a typical "
            "difference",
            float(1.0 - apart[i, j] / typical), 1.0 - MAX_REPEAT_DIFFERENCE,
            "one of the two is a copy: find the missing image",
        )  # fmt: skip


def find_moved(
    gray: Float64Array,
    usable: BoolArray,
    inside: BoolArray,
    predicted: Float64Array,
    relit: Float64Array,
) -> Iterator[Finding]:
    """Yield images that are mirrored, or shifted against what the other images predict.

    Parameters
    ----------
    gray, usable
        (N, H, W), samples and whether they are usable.
    inside
        (H, W), the object.
    predicted
        (N, H, W), the matte shading of each light by normals and albedo of all images.
    relit
        The same for the directions that the images show: an image that it explains has a wrong
        light, and has not moved.
    """
    for number, (image, shading, other) in enumerate(zip(gray, predicted, relit, strict=True)):
        good = inside & usable[number] & (shading > 0.0)
        if np.count_nonzero(good) < 100:
            continue
        mirrored = max(
            _correlation(image[:, ::-1], shading, good), _correlation(image[::-1], shading, good)
        )
        straight = max(_correlation(image, one, good) for one in (shading, other))
        if mirrored > straight + 0.1 and mirrored > MIN_IMAGE_CORRELATION:
            yield Finding(
                "mirrored image", (number,),
                f"image {number + 1} mirrored correlates with the others by {mirrored:.2f}, as it "
                f"is by {straight:.2f}",
                mirrored - straight, 0.1, "mirror the image back",
            )  # fmt: skip
            continue
        shift, sigma = _shift_px(image, shading, other, good)
        size = float(np.hypot(*shift))
        if size > max(MIN_SHIFT_PX, MIN_SHIFT_SIGMAS * sigma):
            yield Finding(
                "moved image", (number,),
                f"image {number + 1} is shifted by ({shift[0]:.1f}, {shift[1]:.1f}) pixels, "
                f"standard error {sigma:.2f}",
                size, max(MIN_SHIFT_PX, MIN_SHIFT_SIGMAS * sigma),
                "align the image with the others, or leave it out",
            )  # fmt: skip


def _correlation(image: Float64Array, shading: Float64Array, good: BoolArray) -> float:
    return float(np.corrcoef(image[good], shading[good])[0, 1])


def _shift_px(
    image: Float64Array, shading: Float64Array, other: Float64Array, good: BoolArray
) -> tuple[Float64Array, float]:
    """Return the shift (x, y) of an image against its shading, px, and its standard error.

    The search starts without a shift, and at the phase correlation of both gradients. A shift that
    does not explain the difference of the two is none; nor is one where another light explains it.
    """
    import cv2

    edges = [np.hypot(*np.gradient(np.where(good, one, 0.0))) for one in (image, shading)]
    window = cv2.createHanningWindow(image.shape[::-1], cv2.CV_64F)
    coarse = np.array(cv2.phaseCorrelate(edges[1], edges[0], window)[0], np.float64)
    starts = [np.zeros(2)]
    if 1.0 < np.abs(coarse).max() < MAX_SHIFT_FRACTION * min(image.shape):
        starts.append(coarse)
    tries = [_refine_shift(image, shading, good, start) for start in starts]
    shift, sigma, rest = min(tries, key=lambda one: one[2])
    before = min(_difference(image, one, good)[1] for one in (shading, other))
    return (shift, sigma) if rest < MAX_REST_AFTER_SHIFT * before else (np.zeros(2), sigma)


def _difference(
    image: Float64Array, shading: Float64Array, good: BoolArray
) -> tuple[Float64Array, float]:
    """Return image minus shading at one gain, and its robust standard deviation."""
    lit = good & (shading > np.quantile(shading[good], 0.3))
    gain = float(np.median(image[lit] / np.maximum(shading[lit], 1e-9)))
    difference = image / max(gain, 1e-9) - shading
    return difference, 1.4826 * float(np.median(np.abs(difference[good]))) + 1e-12


def _refine_shift(
    image: Float64Array, shading: Float64Array, good: BoolArray, shift: Float64Array
) -> tuple[Float64Array, float, float]:
    """Return shift, standard error and remaining difference after Gauss-Newton steps."""
    import cv2

    down, across = (np.asarray(one, np.float64) for one in np.gradient(shading))
    size = image.shape[::-1]
    sigma = rest = np.inf
    for step in range(N_SHIFT_STEPS):
        back = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        moved = cv2.warpAffine(image, back, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        difference, rest = _difference(moved, shading, good)
        if step == N_SHIFT_STEPS - 1:
            break
        kept = good & (np.abs(difference) < N_TRIMMED * rest)
        rows = -np.stack([across[kept], down[kept]], axis=1)
        normal = rows.T @ rows + 1e-12 * np.eye(2)
        by = np.linalg.solve(normal, rows.T @ difference[kept])
        shift = np.asarray(shift + np.clip(by, -3.0, 3.0), np.float64)
        sigma = float(rest * np.sqrt(np.linalg.inv(normal).trace()))
    return shift, sigma, float(rest)
