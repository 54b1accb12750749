"""Pictures of maps for the report: what each shows is also told in numbers, as its alt text."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skinrig.arrays import BoolArray, Float64Array, FloatArray, UInt8Array
from skinrig.drawing import png
from skinrig.reporting import page
from skinrig.reporting.page import number
from skinrig.unit_format import format_quantity

SCALE_COLORS = 128
"""Colors of a map's picture: it tells a value to 1/128 of its scale."""


def shrink(image: NDArray[np.generic], width: int) -> NDArray[np.generic]:
    """Take every n-th pixel so that the image is at most ``width`` wide.

    Pixels are left out, not averaged, so that noise is shown as large as it is.
    """
    step = max(1, -(-image.shape[1] // width))
    return image[step // 2 :: step, step // 2 :: step]


@dataclass(frozen=True, slots=True)
class MapDrawing:
    """How pictures of values on one map's pixels are drawn.

    Attributes
    ----------
    of
        What they are of, for the alt texts: a title alone rarely says it.
    unit
        Of values.
    valid
        (H, W); other pixels are gray.
    width
        Pixels across; larger maps are thinned out.
    """

    of: str = ""
    unit: str = ""
    valid: BoolArray | None = None
    width: int = 280

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
        scale_words = f"color scale {number(low)} to {format_quantity(number(high), self.unit)}"
        alt = f"{named}: {_describe_values(small, mask, self.unit)}; {scale_words}"
        bar = page.ColorScale(png.SCALE_CLASSES[scale], number(low), number(high), self.unit)
        return _build_image(title, data, alt, small.shape, bar)

    def size(self, title: str, values: FloatArray, reach: float) -> page.Image:
        """Return an image of values from 0 on, such as errors and standard errors."""
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
        image = codes.astype(np.uint8)
        image[~mask] = png.INVALID_GRAY
        alt = f"{self.of or 'normals'}, {title}: x, y, z as red, green, blue"
        if mask.any():
            length = np.linalg.norm(small[mask], axis=-1)
            tilt = np.degrees(np.arccos(np.clip(small[mask][:, 2] / np.fmax(length, 1e-9), -1, 1)))
            alt += f"; median tilt from the view {number(float(np.median(tilt)))}°"
        return _build_image(
            title, png.encode(image), alt + _describe_missing(mask), image.shape[:2]
        )


def _describe_missing(mask: BoolArray) -> str:
    """Return how much of a picture has no value, in words; nothing where that is next to none."""
    missing = 1.0 - mask.mean()
    return f", {100 * missing:.0f} % without a value" if missing >= 0.005 else ""


def _describe_values(values: Float64Array, mask: BoolArray | None, unit: str) -> str:
    """Return a map's median, its middle 90 %, and how much of it has no value."""
    shown = np.isfinite(values) if mask is None else mask & np.isfinite(values)
    if not shown.any():
        return "no pixel has a value"
    low, median, high = np.percentile(values[shown], [5, 50, 95])
    within = f"90 % of pixels within {number(low)} to {number(high)}"
    return f"median {format_quantity(number(median), unit)}, {within}{_describe_missing(shown)}"


def color_image(title: str, linear: FloatArray, *, width: int = 320, of: str = "") -> page.Image:
    """Return a linear sRGB image, (H, W, 3), for the page."""
    small = shrink(np.asarray(linear), width).astype(float)
    finite = np.isfinite(small).all(axis=2)
    seen = ""
    if finite.any():
        middle = np.median(small[finite], axis=0)
        seen = f": median linear red, green, blue {', '.join(number(float(v)) for v in middle)}"
    return plain_image(title, png.srgb8(small), alt=(f"{of}, {title}" if of else title) + seen)


def plain_image(title: str, image: UInt8Array, *, alt: str = "") -> page.Image:
    """Return an 8-bit image, (H, W) or (H, W, 3), for the page as it is."""
    return _build_image(title, png.encode(image), alt or title, image.shape[:2])


def _build_image(
    title: str, data: bytes, alt: str, shape: tuple[int, ...], scale: page.ColorScale | None = None
) -> page.Image:
    return page.Image(title, png.to_data_url(data), alt, (shape[1], shape[0]), scale)


def percentile_reach(values: FloatArray, mask: BoolArray, percentile: float) -> float:
    """Return how far a color scale must reach for that percentage of shown |values|."""
    inside = np.abs(values[mask & np.isfinite(values)])
    return float(np.percentile(inside, percentile)) if inside.size else 1.0


def map_panel(
    name: str,
    unit: str,
    *,
    estimate: FloatArray,
    standard_error: FloatArray | None = None,
    truth: FloatArray | None = None,
    valid: BoolArray | None = None,
) -> Iterator[page.Block]:
    """Yield truth | estimate | error | standard error of a map, truth and estimate to one scale.

    Parameters
    ----------
    name, unit
        Of the map, for headings and scales.
    estimate, standard_error, truth
        (H, W); what is None is left out of the row.
    valid
        (H, W); other pixels are gray.
    """
    mask = np.isfinite(estimate) if valid is None else np.asarray(valid, bool)
    of_scale = [estimate[mask & np.isfinite(estimate)]]
    if truth is not None:
        of_scale.append(truth[mask & np.isfinite(truth)])
    joined = np.concatenate(of_scale)
    low, high = np.percentile(joined, [1, 99]) if joined.size else (0.0, 1.0)
    shown = MapDrawing(name, unit, mask)
    parts = [shown.draw_scalar("estimate", estimate, low, high)]
    if truth is not None:
        error = estimate - truth
        parts.insert(0, shown.draw_scalar("truth", truth, low, high))
        parts.append(
            shown.draw_signed("estimate − truth", error, percentile_reach(error, mask, 98))
        )
    if standard_error is not None:
        reach = percentile_reach(standard_error, mask, 98)
        parts.append(shown.size("standard error", standard_error, reach))
    yield page.Heading(name)
    yield page.Images(parts)
