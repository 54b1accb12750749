"""Draw the first screen of a report: each quantity and its ground truth on one color scale."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from model.skin import SkinAppearance, SkinMap
from skinrig.appearances.front_view import FrontView
from skinrig.arrays import BoolArray, Float64Array, FloatArray
from skinrig.evaluating import microrelief
from skinrig.fusing.filled_normals import MEASURED_SUFFIX
from skinrig.reporting import map_images, map_names, page
from skinrig.reporting.sections import subsurface

MAX_PANELS: Final = 4
"""Quantities on the first screen; the sections below show all of them."""
WIDTH_PX: Final = 280
MARGIN_PX: Final = 3
"""Around the valid pixels of a map, to which its image is cropped."""
CAPTURED_IMAGE: Final = "captured image"
KEYS_BY_QUANTITY: Final = {
    CAPTURED_IMAGE: r"image|crossed_a\d+_n0",
    "melanosome volume fraction": "melanin",
    "blood volume fraction": "hemoglobin",
    "surface normals": r"normals_refined|normals|normals_a\d+_n0",
    "surface height": r"height_a\d+_n0|microrelief_.+",
    "diffuse reflectance": "r_d|albedo|diffuse_albedo",
    "diffuse mean free path, green": "translucency",
}
"""Quantities in the order of the first screen, with patterns of their maps, the best first."""
GRAY_MEANS: Final = (
    "Gray pixels are masked: background, hair, eyes, or no valid estimate. Values beyond a color "
    "scale have the color of its end."
)
NORMAL_LEGEND: Final = "x red, y green, z blue: −1 to 1"
Box = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True)
class Panel:
    """One quantity of the first screen."""

    title: str
    source: str
    """Folder of the estimate."""
    images: tuple[page.Image, ...] = ()
    scale: page.ColorScale | None = None
    """Common color scale of its images; None: each has its own, or none."""
    legend: str = ""
    plot: str = ""
    """SVG drawing instead of images."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A map that may be displayed for a quantity, with a second one on its color scale."""

    name: str
    key: str
    estimate: SkinMap
    place: SkinMap | None
    """Surface points of the map's texels; None without a mesh."""
    other: SkinMap | None
    """Ground truth, or the map of a second run; None where neither is given."""
    other_place: SkinMap | None
    labels: tuple[str, str]

    @staticmethod
    def of(name: str, key: str, found: SkinAppearance, truth: SkinAppearance | None) -> Candidate:
        """Return a map with its ground truth, where one is given."""
        estimate = found.maps[key]
        maps = {} if truth is None else truth.maps
        other = maps.get(key, maps.get("normals") if "normals" in key else None)
        if key == "image" and "diffuse_radiance" in maps:
            other = _balanced(maps["diffuse_radiance"], estimate)
        elif truth is not None and other is not None and key.startswith("height_"):
            relief = microrelief.true_relief(found, truth, key.removeprefix("height_"))
            other = replace(other, values=relief)
        label = "captured" if re.fullmatch(KEYS_BY_QUANTITY[CAPTURED_IMAGE], key) else "estimate"
        measured = found.maps.get(f"{key}{MEASURED_SUFFIX}")
        if measured is not None and measured.mask.any():
            filled = 1.0 - float(measured.values[measured.mask].mean())
            label += f", {100.0 * filled:.1f} % filled"
        places = found.maps.get("position"), maps.get("position")
        return Candidate(name, key, estimate, places[0], other, places[1], (label, "ground truth"))


def draw_first_screen(
    appearances: Mapping[str, SkinAppearance], truths: Mapping[str, SkinAppearance | None]
) -> Iterator[page.Block]:
    """Yield the images of the first screen; nothing where no map can be drawn.

    Parameters
    ----------
    appearances
        Appearances by name. Each quantity is drawn from the first one with a ground truth of it,
        else from the first one that has it.
    truths
        Ground truth by the name of the appearance; None: not given.
    """
    panels: list[Panel] = []
    for title, pattern in KEYS_BY_QUANTITY.items():
        found = [
            Candidate.of(name, key, appearance, truths.get(name))
            for name, appearance in appearances.items()
            for key in _keys(appearance, pattern)
            if key != "translucency" or not subsurface.is_homogeneous(truths.get(name))
        ]
        best = next((one for one in found if one.other is not None), found[0] if found else None)
        if best is not None and len(panels) < MAX_PANELS:
            panels.append(_panel(title, best))
    for name, appearance in appearances.items():
        if len(panels) < MAX_PANELS and (plot := subsurface.draw_first_profile(appearance)):
            panels.append(Panel("radial profile", name, plot=plot))
            break
    yield from _view(panels)


def compare_first_screens(
    pairs: Iterable[tuple[str, SkinAppearance, SkinAppearance]], labels: tuple[str, str]
) -> Iterator[page.Block]:
    """Yield the images of two runs, each quantity from the first pair that has it in both."""
    panels: list[Panel] = []
    found = list(pairs)
    for title, pattern in KEYS_BY_QUANTITY.items():
        for name, a, b in found:
            key = next((key for key in _keys(a, pattern) if key in _keys(b, pattern)), None)
            if key is not None and len(panels) < MAX_PANELS:
                places = a.maps.get("position"), b.maps.get("position")
                maps = a.maps[key], places[0], b.maps[key], places[1]
                panels.append(_panel(title, Candidate(name, key, *maps, labels)))
                break
    yield from _view(panels)


def _view(panels: Sequence[Panel]) -> Iterator[page.Block]:
    if panels:
        masked = any("masked" in image.alt for one in panels for image in one.images)
        yield page.build_view("first_screen", panels=panels, note_text=GRAY_MEANS if masked else "")


def _keys(appearance: SkinAppearance, pattern: str) -> list[str]:
    """Return the maps of a quantity with valid pixels, the best first."""
    return [
        key
        for one in pattern.split("|")
        for key in appearance.maps
        if re.fullmatch(one, key) and appearance.maps[key].mask.any()
    ]


def _panel(title: str, chosen: Candidate) -> Panel:
    estimate, other, box = chosen.estimate, chosen.other, _box(chosen.place)
    values, valid = _image(estimate.values, estimate.mask, chosen.place, box)
    shown = [(chosen.labels[0], values, valid)]
    if other is not None:
        other_values, other_valid = _image(other.values, other.mask, chosen.other_place, box)
        if other_values.shape == values.shape:
            shown.append((chosen.labels[1], other_values, other_valid))
    crop = _crop(valid)
    shown = [(label, image[crop], mask[crop]) for label, image, mask in shown]
    unit = page.format_short_unit(estimate.unit)
    images, legend = _drawn(title, shown, unit, normals="normals" in chosen.key)
    if len(images) == 1 and estimate.stderr is not None:
        images.append(_uncertainty(title, chosen, box, crop))
    scales = {image.scale for image in images}
    shared = scales.pop() if len(scales) == 1 else None
    if shared is not None:
        images = [replace(image, scale=None) for image in images]
    return Panel(title, chosen.name, tuple(images), shared, legend)


def _drawn(
    title: str, shown: list[tuple[str, Float64Array, BoolArray]], unit: str, *, normals: bool
) -> tuple[list[page.Image], str]:
    """Return the images of a quantity on one scale, and a legend if it is not a color bar."""
    if normals:
        draw = [
            map_images.MapDrawing(title, "", mask, WIDTH_PX, lossy=True).normals(label, image)
            for label, image, mask in shown
        ]
        return draw, NORMAL_LEGEND
    if title.endswith("green"):
        shown = [(label, image[..., 1], mask) for label, image, mask in shown]
    if shown[0][1].ndim == 3:
        white = map_images.find_white(*shown[0][1:])
        draw = [
            map_images.draw_color_image(
                label, map_images.expose(image, mask, white), width=WIDTH_PX, of=title, lossy=True
            )
            for label, image, mask in shown
        ]
        return draw, f"linear RGB, white: {white:.2g}"
    ends = map_images.compute_shared_range([image[mask] for _, image, mask in shown])
    low, high = (float(f"{end:.2g}") for end in ends)
    colors = "gray" if title == CAPTURED_IMAGE else "viridis"
    draw = [
        map_images.MapDrawing(title, unit, mask, WIDTH_PX).draw_scalar(
            label, image, low, high, colors
        )
        for label, image, mask in shown
    ]
    return draw, "relative radiance" if title == CAPTURED_IMAGE else ""


def _uncertainty(
    title: str, chosen: Candidate, box: Box | None, crop: tuple[slice, slice]
) -> page.Image:
    """Return the image of an estimate's uncertainty, in the unit of the estimate."""
    stderr = np.asarray(chosen.estimate.stderr, np.float64)
    unit = page.format_short_unit(chosen.estimate.unit)
    if stderr.ndim == 3:
        stderr = stderr[..., 1] if title.endswith("green") else stderr.mean(axis=-1)
    if "normals" in chosen.key:
        stderr, unit = np.degrees(stderr), "°"
    image, valid = _image(stderr, chosen.estimate.mask, chosen.place, box)
    image, valid = image[crop], valid[crop]
    reach = float(f"{map_images.compute_percentile_reach(image, valid, 98):.2g}")
    drawing = map_images.MapDrawing(title, unit, valid, WIDTH_PX)
    return drawing.size(map_names.uncertainty_title(chosen.key), image, reach)


def _box(place: SkinMap | None) -> Box | None:
    """Return two corners around the points of a mesh; None without one."""
    if place is None:
        return None
    points = place.values[place.mask].astype(np.float64)
    return points.min(axis=0), points.max(axis=0)


def _image(
    values: FloatArray, mask: BoolArray, place: SkinMap | None, box: Box | None
) -> tuple[Float64Array, BoolArray]:
    """Return a map as an image; maps of a mesh are projected to its front."""
    if place is None or box is None:
        return np.nan_to_num(np.asarray(values, np.float64)), mask
    rows, columns = np.nonzero(place.mask)
    view = FrontView.of(place.values[rows, columns].astype(np.float64), box)
    flat = np.nan_to_num(np.asarray(values[rows, columns], np.float64))
    return view.rasterize(flat, valid=mask[rows, columns])


def _crop(valid: BoolArray) -> tuple[slice, slice]:
    """Return the rows and columns that hold valid pixels, with a margin."""
    ends = []
    for axis in (1, 0):
        inside = np.flatnonzero(valid.any(axis=axis))
        ends.append(slice(max(int(inside[0]) - MARGIN_PX, 0), int(inside[-1]) + 1 + MARGIN_PX))
    return ends[0], ends[1]


def _balanced(true: SkinMap, captured: SkinMap) -> SkinMap | None:
    """Return the true radiance with the captured image's gain in each channel."""
    both = true.mask & captured.mask if true.values.shape == captured.values.shape else None
    if both is None or not both.any():
        return None
    level = [np.median(one.values[both].astype(np.float64), axis=0) for one in (captured, true)]
    gain = level[0] / np.where(level[1] > 0.0, level[1], 1.0)
    return replace(true, values=(true.values * gain).astype(np.float32))
