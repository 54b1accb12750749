"""Draw maps for the report; each alternative text lists the map's numbers."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skinrig.arrays import BoolArray, Float64Array, FloatArray, UInt8Array
from skinrig.drawing import png
from skinrig.reporting import map_names, page
from skinrig.reporting.page import format_number
from skinrig.unit_format import format_quantity

GRAY_LINEAR = ((png.INVALID_GRAY / 255.0 + 0.055) / 1.055) ** 2.4
"""Linear value of the gray of pixels without a value, by the sRGB curve."""
WHITE_PERCENTILE = 99.5
"""Percentile of the valid values of an image that is drawn as white."""
OUTER_FENCE = 3.0
"""Interquartile ranges from the quartiles to Tukey's outer fences (Tukey 1977)."""
SCALE_COLORS = 128
"""Colors of a map's image: it resolves 1/128 of its scale."""


def shrink(image: NDArray[np.generic], width: int) -> NDArray[np.generic]:
    """Take every n-th pixel so that the image is at most ``width`` wide.

    Pixels are omitted, not averaged, so that the noise keeps its size.
    """
    step = max(1, -(-image.shape[1] // width))
    return image[step // 2 :: step, step // 2 :: step]


@dataclass(frozen=True, slots=True)
class MapDrawing:
    """How images of values on the pixels of one map are drawn.

    Attributes
    ----------
    of
        Quantity, for the alt texts.
    unit
        Unit of the values.
    valid
        (H, W); other pixels are gray.
    width
        Pixels across; larger maps are subsampled.
    lossy
        Store colors as JPEG, for previews of images that the page holds in full.
    """

    of: str = ""
    unit: str = ""
    valid: BoolArray | None = None
    width: int = 280
    lossy: bool = False

    def draw_scalar(
        self, title: str, values: FloatArray, low: float, high: float, scale: str = "viridis"
    ) -> page.Image:
        """Return an image of values, (H, W), by a color scale between its ends.

        ``scale`` is a key of `skinrig.drawing.png.SCALE_CLASSES`.
        """
        small = shrink(values, self.width).astype(float)
        mask = None if self.valid is None else shrink(self.valid, self.width).astype(bool)
        data = png.Scale(low, high, scale).encode(small, mask, levels=SCALE_COLORS)
        named = f"{self.of}, {title}" if self.of else title
        scale_words = (
            f"color scale {format_number(low)} to {format_quantity(format_number(high), self.unit)}"
        )
        alt = f"{named}: {_summary(small, mask, self.unit)}; {scale_words}"
        bar = page.ColorScale(
            png.SCALE_CLASSES[scale], format_number(low), format_number(high), self.unit
        )
        return _build_image(title, png.to_webp_url(data), alt, small.shape, bar)

    def size(self, title: str, values: FloatArray, reach: float) -> page.Image:
        """Return an image of values from 0 on, such as sizes of errors and uncertainties."""
        return self.draw_scalar(title, values, 0.0, reach, "magma")

    def draw_signed(self, title: str, values: FloatArray, reach: float) -> page.Image:
        """Return an image of values around 0, such as differences."""
        return self.draw_scalar(title, values, -reach, reach, "RdBu_r")

    def normals(self, title: str, normals: FloatArray) -> page.Image:
        """Return an image of unit normals, (H, W, 3), as colors: x red, y green, z blue."""
        small = shrink(normals, self.width).astype(float)
        every = np.ones(normals.shape[:2], bool)
        mask = shrink(every if self.valid is None else self.valid, self.width).astype(bool)
        codes = np.rint(255.0 * np.clip(0.5 + 0.5 * np.nan_to_num(small), 0.0, 1.0))
        image = _coarsen(codes.astype(np.uint8))
        image[~mask] = png.INVALID_GRAY
        alt = f"{self.of or 'normals'}, {title}: x, y, z as red, green, blue"
        if mask.any():
            length = np.linalg.norm(small[mask], axis=-1)
            tilt = np.degrees(np.arccos(np.clip(small[mask][:, 2] / np.fmax(length, 1e-9), -1, 1)))
            alt += f"; median tilt from the view {format_number(float(np.median(tilt)))}°"
        return _build_image(
            title, _address(image, self.lossy), alt + _describe_missing(mask), image.shape[:2]
        )


def _describe_missing(mask: BoolArray) -> str:
    """Return the masked fraction of an image in words; empty below half a percent."""
    missing = 1.0 - mask.mean()
    return f", {100 * missing:.0f} % masked" if missing >= 0.005 else ""


def _summary(values: Float64Array, mask: BoolArray | None, unit: str) -> str:
    """Return the median of a map, its middle 90 % and its masked fraction."""
    shown = np.isfinite(values) if mask is None else mask & np.isfinite(values)
    if not shown.any():
        return "all pixels are masked"
    low, median, high = np.percentile(values[shown], [5, 50, 95])
    within = f"90 % of pixels within {format_number(low)} to {format_number(high)}"
    return (
        f"median {format_quantity(format_number(median), unit)}, {within}{_describe_missing(shown)}"
    )


def find_white(linear: FloatArray, valid: BoolArray) -> float:
    """Return the value that is drawn as white; ``valid``, (H, W), holds a pixel at least."""
    return max(float(np.percentile(linear[valid], WHITE_PERCENTILE)), 1e-9)


def expose(linear: FloatArray, valid: BoolArray, white: float) -> Float64Array:
    """Return an image, (H, W, 3), with ``white`` at 1; pixels that are not valid are gray."""
    return np.where(valid[..., None], linear / white, GRAY_LINEAR)


def draw_color_image(
    title: str, linear: FloatArray, *, width: int = 320, of: str = "", lossy: bool = False
) -> page.Image:
    """Return a linear sRGB image, (H, W, 3), for the page; ``lossy``: as JPEG."""
    small = shrink(np.asarray(linear), width).astype(float)
    finite = np.isfinite(small).all(axis=2)
    level = ""
    if finite.any():
        middle = np.median(small[finite], axis=0)
        level = (
            f": median linear red, green, blue {', '.join(format_number(float(v)) for v in middle)}"
        )
    alt = (f"{of}, {title}" if of else title) + level
    image = png.encode_srgb8(small)
    address = _address(image if lossy else _coarsen(image), lossy)
    return _build_image(title, address, alt, small.shape[:2])


def draw_plain_image(title: str, image: UInt8Array, *, alt: str = "") -> page.Image:
    """Return an 8-bit image, (H, W) or (H, W, 3), for the page as it is."""
    return _build_image(title, _address(image), alt or title, image.shape[:2])


def _coarsen(codes: UInt8Array) -> UInt8Array:
    """Return colors in 128 steps, as in a color scale; gray and white stay."""
    return np.where(codes < 255, codes & np.uint8(0xFE), codes)


def _address(image: UInt8Array, lossy: bool = False) -> str:
    # the PNG file is only an intermediate
    return png.encode_jpeg_url(image) if lossy else png.to_webp_url(png.encode(image, quick=True))


def _build_image(
    title: str, address: str, alt: str, shape: tuple[int, ...], scale: page.ColorScale | None = None
) -> page.Image:
    return page.Image(title, address, alt, (shape[1], shape[0]), scale)


def compute_percentile_reach(values: FloatArray, mask: BoolArray, percentile: float) -> float:
    """Return that percentile of the shown |values|, as the end of a color scale."""
    inside = np.abs(values[mask & np.isfinite(values)])
    return float(np.percentile(inside, percentile)) if inside.size else 1.0


def compute_shared_range(maps: Sequence[FloatArray]) -> tuple[float, float]:
    """Return the ends of a color scale for all finite values of several maps.

    They are the 1st and 99th percentile, within Tukey's outer fences: a small part of very
    different values, such as the lips of a face, does not set the scale of the rest.

    Examples
    --------
    >>> face, lips = np.linspace(0.01, 0.02, 1000), np.full(30, 0.05)
    >>> [round(end, 4) for end in compute_shared_range([np.concatenate([face, lips])])]
    [0.0101, 0.0332]
    """
    joined = np.concatenate([one[np.isfinite(one)] for one in maps])
    if not joined.size:
        return 0.0, 1.0
    low, first, third, high = np.percentile(joined, [1, 25, 75, 99]).tolist()
    reach = OUTER_FENCE * (third - first)
    if reach > 0.0:
        low, high = max(low, first - reach), min(high, third + reach)
    return low, high


def draw_map_panel(
    name: str,
    unit: str,
    *,
    estimate: FloatArray,
    standard_error: FloatArray | None = None,
    truth: FloatArray | None = None,
    valid: BoolArray | None = None,
    uncertainty: str = map_names.STANDARD_UNCERTAINTY,
) -> Iterator[page.Block]:
    """Yield ground truth | estimate | error | uncertainty; the first two share a color scale.

    Parameters
    ----------
    name, unit
        Of the map, for headings and scales.
    estimate, standard_error, truth
        (H, W); None is omitted from the row.
    valid
        (H, W); other pixels are gray.
    uncertainty
        Label of the standard error.
    """
    mask = np.isfinite(estimate) if valid is None else np.asarray(valid, bool)
    low, high = compute_shared_range([one[mask] for one in (estimate, truth) if one is not None])
    shown = MapDrawing(name, unit, mask)
    parts = [shown.draw_scalar("estimate", estimate, low, high)]
    if truth is not None:
        error = estimate - truth
        parts.insert(0, shown.draw_scalar("ground truth", truth, low, high))
        parts.append(
            shown.draw_signed(
                "estimate − ground truth", error, compute_percentile_reach(error, mask, 98)
            )
        )
    if standard_error is not None:
        reach = compute_percentile_reach(standard_error, mask, 98)
        parts.append(shown.size(uncertainty, standard_error, reach))
    yield page.Heading(name)
    yield page.Images(parts)
