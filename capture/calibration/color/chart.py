"""Find a ColorChecker Classic in an image and measure its 24 patches."""

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import label

from capture.arrays import BoolArray, Float64Array
from capture.calibration.color.colorimetry import chart_reference, xyz_to_linear_srgb
from capture.calibration.record import CalibrationError

logger = logging.getLogger(__name__)


CHART_ROWS, CHART_COLUMNS = 4, 6
PATCH_SIDE_PITCH = 0.87  # side of a patch over the distance of neighbors, ColorChecker Classic
MAX_DETECTION_PX = 2000  # longer sides are reduced for detection only
MIN_CLIPPED_FRACTION = 0.1  # of a patch's pixels at the image's largest value
MIN_FLAT_FRACTION = 0.5  # the same: from it a patch is clipped, whatever the range of the type
MAX_AFFINE_MISFIT = 0.35  # largest residual of an affine map, over the span of the colors


class ChartError(CalibrationError):
    """Raised for an image without a usable color chart; the message states what to do."""


@dataclass(frozen=True, slots=True)
class Patches:
    """Mean colors of the patches of a chart.

    Attributes
    ----------
    rgb : ndarray of float64, shape (24, 3)
        Mean camera RGB in the image's unit; NaN where not `valid`.
    stderr : ndarray of float64, shape (24, 3)
        Standard error of the mean; NaN where not `valid`.
    valid : ndarray of bool, shape (24,)
        Patches without saturated or masked pixels, inside the image.
    """

    rgb: Float64Array
    stderr: Float64Array
    valid: BoolArray


def find_chart(image: NDArray, *, corners: ArrayLike | None = None) -> Float64Array:
    """Find a ColorChecker Classic and return the centers of its 24 patches.

    Parameters
    ----------
    image : ndarray of uint8, uint16 or float, shape (H, W, 3)
        RGB in any linear or display scale, white-balanced or not.
    corners : array_like, shape (4, 2), optional
        x, y of the centers of the patches dark skin, bluish green, black and white (the chart's
        corner patches, clockwise), to skip detection.

    Returns
    -------
    ndarray of float64, shape (24, 2)
        x (right) and y (down) in pixels, pixel (0, 0)'s center at (0, 0); row-major from dark
        skin, whatever the chart's orientation in the image.

    Raises
    ------
    ChartError
        If no chart is found, or its colors are not the chart's.
    """
    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise ChartError(f"image: got shape {pixels.shape}, expected (H, W, 3)")
    if min(pixels.shape[:2]) < 16:
        raise ChartError(f"image: got {pixels.shape[1]} x {pixels.shape[0]} px, too small")
    unit = _to_unit(pixels)
    if corners is not None:
        centers = _grid_from_corners(np.asarray(corners, dtype=np.float64))
    else:
        centers = _detect(unit)
    return _check_order(unit, _refine(unit, _refine(unit, centers)))


def measure_patches(
    image: NDArray, centers: Float64Array, *, valid: BoolArray | None = None, fraction: float = 0.5
) -> Patches:
    """Average the pixels in the middle of every patch.

    Parameters
    ----------
    image : ndarray of float, shape (H, W, 3)
        Linear camera RGB.
    centers : ndarray of float64, shape (24, 2)
        From `find_chart`.
    valid : ndarray of bool, shape (H, W) or (H, W, 3), optional
        False where a pixel is saturated or must not be used; None: patches are left out where many
        pixels have the largest value of the type, or that of several patches, and where most
        pixels have the largest value of the image: patches without noise count as clipped.
    fraction : float
        Side of the averaged square over the distance of neighboring patches, at most 0.6 so that a
        chart at 45 degrees stays inside its patches.

    Returns
    -------
    Patches
    """
    if not 0 < fraction <= 0.6:
        raise ValueError(f"fraction: got {fraction}, expected 0 < fraction <= 0.6")
    half = max(0.5 * fraction * _pitch(centers), 0.5)
    usable = np.logical_and.reduce(np.isfinite(image), axis=-1)
    if valid is not None:
        usable &= valid if valid.ndim == 2 else np.logical_and.reduce(valid, axis=-1)
    rgb = np.full((len(centers), 3), np.nan)
    stderr = np.full((len(centers), 3), np.nan)
    ok = np.zeros(len(centers), dtype=bool)
    top = np.nanmax(np.where(np.isfinite(image), image, np.nan), axis=(0, 1))
    clipped = np.zeros((len(centers), 3), dtype=bool)
    flat = np.zeros((len(centers), 3), dtype=bool)
    for i, (x, y) in enumerate(centers):
        window = _window(x, y, half, image.shape[:2])
        if window is None or not usable[window].all():
            continue
        values = np.asarray(image[window], dtype=np.float64).reshape(-1, 3)
        if len(values) < 2:
            continue
        rgb[i] = values.mean(axis=0)
        stderr[i] = values.std(axis=0, ddof=1) / np.sqrt(len(values))
        ok[i] = True
        at_top = (values == top).mean(axis=0)
        clipped[i] = at_top > MIN_CLIPPED_FRACTION
        flat[i] = at_top > MIN_FLAT_FRACTION
    if valid is None:
        kind = np.asarray(image).dtype
        full = top == np.iinfo(kind).max if kind.kind in "ui" else np.zeros(3, dtype=bool)
        ok &= ~(flat | (clipped & (full | (clipped.sum(axis=0) > 1)))).any(axis=1)
    return Patches(np.where(ok[:, None], rgb, np.nan), np.where(ok[:, None], stderr, np.nan), ok)


def _to_unit(pixels: NDArray) -> Float64Array:
    """Scale by the bright end of the image to about [0, 1], finite and not negative."""
    image = np.nan_to_num(np.asarray(pixels, dtype=np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    top = float(np.quantile(image, 0.995))
    if not top > 0:
        raise ChartError("image: it is black, no chart can be found; expose longer")
    return np.maximum(image / top, 0.0)


def _renderings(unit: Float64Array) -> list[tuple[str, Float64Array]]:
    """Yield renderings of the image for the detector, the most promising first."""
    balanced = unit / np.maximum(unit.mean(axis=(0, 1)), 1e-9) * float(unit.mean())
    return [
        ("as it is", unit),
        ("brightened", unit**0.45),
        ("white-balanced", balanced),
        ("white-balanced and brightened", balanced**0.45),
        ("shadows", np.minimum(4.0 * unit, 1.0) ** 0.45),
    ]


def _detect(unit: Float64Array) -> Float64Array:
    import cv2

    height, width = unit.shape[:2]
    scale = min(1.0, MAX_DETECTION_PX / max(height, width))
    for name, rendering in _renderings(unit):
        shown = np.ascontiguousarray(
            np.rint(255.0 * np.clip(rendering[..., ::-1], 0.0, 1.0)).astype(np.uint8)
        )
        if scale < 1.0:
            shown = cv2.resize(shown, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        detector = cv2.mcc.CCheckerDetector.create()
        detector.setColorChartType(cv2.mcc.MCC24)
        try:
            found = detector.process(shown, 1)
        except cv2.error as exc:
            raise ChartError(f"image: the chart detector failed on it ({exc.err})") from exc
        if found:
            corners = np.asarray(detector.getBestColorChecker().getColorCharts(), dtype=np.float64)
            logger.debug("chart found in the image %s", name)
            # pixel centers: resizing maps x to (x + 1/2) scale - 1/2
            centers: Float64Array = (corners.reshape(24, 4, 2).mean(axis=1) + 0.5) / scale - 0.5
            return centers
    raise ChartError(
        "image: no ColorChecker Classic found; show the whole chart, evenly lit, in focus and "
        "larger than about 60 pixels; or give the centers of its corner patches [SR-CAL-002]"
    )


def _grid() -> Float64Array:
    """Return model coordinates (column, row) of the 24 patches."""
    return np.array(
        [(c, r) for r in range(CHART_ROWS) for c in range(CHART_COLUMNS)], dtype=np.float64
    )


def _homography(model: Float64Array, points: Float64Array, weight: Float64Array) -> Float64Array:
    """Return the plane projective map by weighted direct linear transform, shape (3, 3)."""
    mean, spread = points.mean(axis=0), max(float(points.std()), 1e-9)
    q = (points - mean) / spread
    rows = []
    for (x, y), (u, v), w in zip(model, q, weight, strict=True):
        rows.append(w * np.array([x, y, 1, 0, 0, 0, -u * x, -u * y, -u]))
        rows.append(w * np.array([0, 0, 0, x, y, 1, -v * x, -v * y, -v]))
    h = np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3)
    return np.array([[spread, 0, mean[0]], [0, spread, mean[1]], [0, 0, 1]]) @ h


def _project(h: Float64Array, model: Float64Array) -> Float64Array:
    p = np.column_stack([model, np.ones(len(model))]) @ h.T
    return p[:, :2] / p[:, 2:]


def _grid_from_corners(corners: Float64Array) -> Float64Array:
    if corners.shape != (4, 2) or not np.isfinite(corners).all():
        raise ChartError(f"corners: got shape {corners.shape}, expected four points x, y")
    model = np.array(
        [(0, 0), (CHART_COLUMNS - 1, 0), (CHART_COLUMNS - 1, CHART_ROWS - 1), (0, CHART_ROWS - 1)],
        float,
    )
    return _project(_homography(model, corners, np.ones(4)), _grid())


def _pitch(centers: Float64Array) -> float:
    """Return the smallest distance of neighboring patches, pixels."""
    grid = centers.reshape(CHART_ROWS, CHART_COLUMNS, 2)
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
    return float(min(steps))


def _window(x: float, y: float, half: float, shape: tuple[int, ...]) -> tuple[slice, slice] | None:
    """Return the pixels whose centers are within `half` of (x, y); None outside the image."""
    x0, x1 = int(np.ceil(x - half)), int(np.floor(x + half))
    y0, y1 = int(np.ceil(y - half)), int(np.floor(y + half))
    if x0 < 0 or y0 < 0 or x1 >= shape[1] or y1 >= shape[0] or x1 < x0 or y1 < y0:
        return None
    return slice(y0, y1 + 1), slice(x0, x1 + 1)


def _refine(unit: Float64Array, centers: Float64Array) -> Float64Array:
    """Move centers to the middle of the even areas found around them, constrained by a homography.

    A patch counts only where its color differs from the frame around it; dark patches on the black
    frame do not, and follow from the others.
    """
    pitch = _pitch(centers)
    if pitch < 8:
        return centers
    found, weight = centers.copy(), np.zeros(len(centers))
    for i, (x, y) in enumerate(centers):
        core = _window(x, y, 0.15 * pitch, unit.shape)
        area = _window(x, y, 0.62 * pitch, unit.shape)
        if core is None or area is None:
            continue
        color = np.median(unit[core].reshape(-1, 3), axis=0)
        noise = float(np.linalg.norm(unit[core].reshape(-1, 3).std(axis=0)))
        distance = np.linalg.norm(unit[area] - color, axis=-1)
        rim = np.concatenate([distance[0], distance[-1], distance[:, 0], distance[:, -1]])
        contrast = float(np.median(rim))
        if contrast < max(6.0 * noise, 0.02):
            continue
        parts, _ = label(distance < 0.5 * contrast)
        inside = parts == parts[round(y) - area[0].start, round(x) - area[1].start]
        if not distance[inside].max() < 0.5 * contrast:
            continue
        share = inside.mean() * (1.24**2)  # of a patch cell
        if not 0.6 < share / PATCH_SIDE_PITCH**2 < 1.3:
            continue
        rows, columns = np.nonzero(inside)
        shift = np.array([columns.mean() + area[1].start - x, rows.mean() + area[0].start - y])
        if np.abs(shift).max() < 0.3 * pitch:
            found[i] += shift
            weight[i] = 1.0
    if weight.sum() < 10:
        return centers
    for _ in range(5):  # reweighted, so that one outlier does not distort the grid
        fitted = _project(_homography(_grid(), found, np.sqrt(weight)), _grid())
        miss = np.linalg.norm(fitted - found, axis=1)
        scale = max(float(np.median(miss[weight > 0])), 0.02 * pitch)
        weight = np.where(weight > 0, 1.0 / (1.0 + (miss / (2.0 * scale)) ** 2), 0.0)
    return fitted


def _check_order(unit: Float64Array, centers: Float64Array) -> Float64Array:
    """Return the centers in the chart's order; reject a mirrored chart or foreign colors."""
    height, width = unit.shape[:2]
    inside = (centers >= 0).all() and (centers <= [width - 1, height - 1]).all()
    if not inside:
        raise ChartError("image: the chart is cut by the edge of the image; show it whole")
    half = max(0.2 * _pitch(centers), 0.6)
    colors = np.empty((24, 3))
    for i, (x, y) in enumerate(centers):
        window = _window(x, y, half, unit.shape)
        if window is None:
            raise ChartError("image: the chart is cut by the edge of the image; show it whole")
        colors[i] = np.median(unit[window].reshape(-1, 3), axis=0)
    target = np.cbrt(np.maximum(xyz_to_linear_srgb(chart_reference("D50"), illuminant="D50"), 0.0))
    design = np.column_stack([np.cbrt(colors), np.ones(24)])
    order = np.arange(24).reshape(CHART_ROWS, CHART_COLUMNS)
    layouts = {
        "upright": order,
        "upside down": order[::-1, ::-1],
        "mirrored": order[:, ::-1],
        "mirrored upside down": order[::-1],
    }
    misfit = {}
    for name, layout in layouts.items():
        chosen = design[layout.ravel()]
        rest = target - chosen @ np.linalg.lstsq(chosen, target, rcond=None)[0]
        misfit[name] = float(np.sqrt((rest**2).mean() / target.var(axis=0).mean()))
    best = min(misfit, key=misfit.__getitem__)
    if misfit[best] > MAX_AFFINE_MISFIT:
        raise ChartError(
            "image: what looks like a chart has not the colors of a ColorChecker Classic (an "
            f"affine map leaves {100 * misfit[best]:.0f} % of their spread); use that chart, "
            "unobstructed"
        )
    centers = centers[layouts[best].ravel()]
    (ax, ay), (bx, by) = (
        centers[CHART_COLUMNS - 1] - centers[0],
        centers[-CHART_COLUMNS] - centers[0],
    )
    if ax * by - ay * bx < 0:  # x right, y down: columns turn clockwise into rows
        raise ChartError("image: the chart is mirrored; turn off mirroring in the camera program")
    return centers
