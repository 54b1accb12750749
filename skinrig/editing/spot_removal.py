"""Detect small dark spots in the common map and fill them from the surrounding skin.

A spot is brightened by a morphological closing with a disc, as it is darker than its surroundings
at the disc's scale. Elongated regions, such as brows and folds, are not spots. The fill is a
membrane (harmonic) interpolation from the surrounding skin, without texture of its own.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from reconstruction.correspondence.charts import TexelChart
from reconstruction.surface import texture_fill
from skinrig.arrays import BoolArray, Float32Array

DEPTH_SIGMAS: Final = 5.0
"""Minimum depth of a spot in units of the skin texture's typical depth."""
MIN_SPOT_DEPTH: Final = 0.03
"""Minimum depth of a spot, natural logarithm of brightness; less is not visible."""
MAX_ELONGATION: Final = 3.0
"""Maximum ratio of length to width of a spot."""


@dataclass(frozen=True, slots=True, eq=False)
class SpotRemoval:
    """Detected spots and R_d without them.

    Attributes
    ----------
    fill
        (H, W, 3) R_d, filled from the surrounding skin.
    share
        (H, W), 0 to 1: weight of the fill per texel.
    spots
        Number of detected spots.
    """

    fill: Float32Array
    share: Float32Array
    spots: int


def fill_spots(
    r_d: ArrayLike,
    valid: ArrayLike,
    chart: TexelChart,
    *,
    pixel_mm: float,
    range_mm: tuple[float, float],
) -> SpotRemoval:
    """Detect the spots of a face and fill them.

    Parameters
    ----------
    r_d
        (H, W, 3).
    valid
        (H, W): measured texels.
    chart
        Positions of the texels in the seamless common map.
    pixel_mm
        Pixel size of the common map.
    range_mm
        Minimum and maximum diameter.
    """
    image, known = chart.gather(r_d, valid)
    spots, count = detect_dark_spots(image, known, pixel_mm=pixel_mm, range_mm=range_mm)
    filled = texture_fill.push_pull(image, (known & ~spots).astype(np.float32))
    soft = ndimage.gaussian_filter(spots.astype(np.float64), 0.7)
    share, inside = chart.read(np.minimum(1.0, 2.0 * soft))
    fill, _ = chart.read(filled.values)
    use = inside & chart.outermost
    return SpotRemoval(fill, np.where(use, np.clip(share, 0.0, 1.0), 0.0).astype(np.float32), count)


def detect_dark_spots(
    image: ArrayLike, valid: ArrayLike, *, pixel_mm: float, range_mm: tuple[float, float]
) -> tuple[BoolArray, int]:
    """Return the pixels of small dark spots with their rims, (N, N), and the number of spots.

    Parameters
    ----------
    image
        (N, N, 3), above 0 where valid.
    valid
        (N, N) mask.
    pixel_mm
        Side of a pixel.
    range_mm
        Minimum and maximum diameter.
    """
    good = np.asarray(valid, np.bool_)
    color = np.asarray(image, np.float64)
    floor = 1e-3 * max(float(np.median(color[good])), 1e-9) if good.any() else 1.0
    light = np.log(np.maximum(color, floor)).mean(axis=-1)
    small, large = (0.5 * d / pixel_mm for d in range_mm)
    smooth = ndimage.gaussian_filter(light, max(0.5 * small, 0.5))
    closed = ndimage.grey_closing(smooth, footprint=_disc(max(large, 1.5)))
    depth = np.where(good, closed - smooth, 0.0)
    grain = float(np.median(depth[good])) if good.any() else 0.0
    least = max(DEPTH_SIGMAS * grain, MIN_SPOT_DEPTH)
    seeds = np.zeros(good.shape, np.bool_)
    found = 0
    # high thresholds separate spots that touch; low ones detect faint spots
    for threshold in least * np.array([8.0, 4.0, 2.0, 1.0]):
        label = ndimage.label(depth > threshold)[0]
        for number, window in enumerate(ndimage.find_objects(label), start=1):
            part = label[window] == number
            if (seeds[window] & part).any():
                continue
            rows, columns = np.nonzero(part)
            width = np.sqrt(len(rows) / np.pi)
            slim = _longest(rows, columns) > MAX_ELONGATION * width
            if not slim and max(0.4 * small, 0.5) <= width <= 1.2 * large:
                seeds[window] |= part
                found += 1
    rim = max(1, round(0.35 * (small + large) / 2))
    spots = ndimage.binary_dilation(
        seeds, _disc(1.0), iterations=rim, mask=(depth > 0.2 * least) | seeds
    )
    return ndimage.binary_dilation(spots, _disc(1.0)) & good, found


def _longest(rows: NDArray[np.intp], columns: NDArray[np.intp]) -> float:
    """Return the major semi-axis of the ellipse with the same second moments as some pixels."""
    if len(rows) < 3:
        return 1.0
    spread = np.cov(np.stack([rows, columns]).astype(np.float64))
    return float(2.0 * np.sqrt(max(np.linalg.eigvalsh(spread)[-1], 0.0)))


def _disc(radius: float) -> BoolArray:
    reach = max(1, int(np.ceil(radius)))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.asarray(x * x + y * y <= radius * radius + 0.5, np.bool_)
