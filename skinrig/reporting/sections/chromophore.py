"""Report section on chromophores: errors by melanin band, and identifiability."""

from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from typing import Literal

import numpy as np

from model import color_table
from model.skin import SkinAppearance, SkinMap
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction import chromophores
from reconstruction.chromophores import model_error
from reconstruction.pipeline.flash.stages import NOISE_STDERR_SUFFIX
from skinrig.arrays import BoolArray
from skinrig.drawing import figures
from skinrig.evaluating import flash
from skinrig.reporting import map_images, map_names, page

IDENTIFIABILITY_NOISE = 0.005
"""Relative noise of each channel that the identifiability plots are drawn for."""
SMALL_WIDTH_PX = 200
"""Largest width of maps without ground truth and uncertainty."""
MAX_ROUNDING_ERROR = 1e-6
"""Fractions below this are rounding errors."""
VECTOR_MAPS = ("normals", "albedo")
"""Maps of three channels that are drawn."""


def draw_panels(appearance: SkinAppearance, truth: SkinAppearance | None) -> Iterator[page.Block]:
    """Yield each map of one channel with its ground truth, to one color scale; normals, albedo."""
    alone = []
    for key, skin_map in sorted(appearance.maps.items()):
        if key in VECTOR_MAPS and skin_map.values.ndim == 3:
            yield from _vectors(key, skin_map)
        if skin_map.values.ndim != 2 or key.startswith("_") or key.endswith(NOISE_STDERR_SUFFIX):
            continue
        true_map = truth.maps.get(key) if truth is not None else None
        if true_map is None and skin_map.stderr is None:
            alone.append(_single_image(key, skin_map))
            continue
        yield from map_images.draw_map_panel(
            map_names.map_heading(key),
            page.format_short_unit(skin_map.unit),
            estimate=skin_map.values,
            standard_error=skin_map.stderr,
            truth=None if true_map is None else true_map.values,
            valid=_shown(skin_map, true_map),
            uncertainty=map_names.uncertainty_title(key),
        )
    if alone:
        yield page.Heading("Maps without uncertainties")
        yield page.Images(alone, small=True)


def _vectors(key: str, skin_map: SkinMap) -> Iterator[page.Block]:
    """Yield the colors of a map of three channels, and its uncertainty."""
    normals, unit = key == "normals", page.format_short_unit(skin_map.unit)
    drawing = map_images.MapDrawing(
        map_names.map_title(key), "°" if normals else unit, skin_map.mask
    )
    if normals:
        images = [drawing.normals("estimate", skin_map.values)]
    else:
        bright = (
            map_images.compute_percentile_reach(skin_map.values.max(axis=-1), skin_map.mask, 99.5)
            or 1.0
        )
        shown = np.where(skin_map.mask[..., None], skin_map.values / bright, map_images.GRAY_LINEAR)
        images = [map_images.draw_color_image("estimate", shown, of=map_names.map_title(key))]
    if skin_map.stderr is not None:
        stderr = skin_map.stderr.reshape(*skin_map.mask.shape, -1).mean(axis=-1)
        stderr = np.degrees(stderr) if normals else stderr
        reach = map_images.compute_percentile_reach(stderr, skin_map.mask, 98)
        images.append(drawing.size(map_names.uncertainty_title(key), stderr, reach))
    yield page.Heading(map_names.map_heading(key))
    yield page.Images(images)


def _single_image(key: str, skin_map: SkinMap) -> page.Image:
    """Return the image of a map without ground truth and uncertainty."""
    mask = _shown(skin_map, None)
    inside = skin_map.values[np.isfinite(skin_map.values) if mask is None else mask]
    low, high = np.percentile(inside, [1, 99]) if inside.size else (0.0, 1.0)
    if max(abs(low), abs(high)) < MAX_ROUNDING_ERROR:
        low, high = 0.0, 1.0  # rounding errors would look like structure
    drawing = map_images.MapDrawing("", page.format_short_unit(skin_map.unit), mask, SMALL_WIDTH_PX)
    return drawing.draw_scalar(map_names.map_heading(key), skin_map.values, low, high)


def _shown(estimate: SkinMap, truth: SkinMap | None) -> BoolArray | None:
    masks = [m.valid for m in (estimate, truth) if m is not None and m.valid is not None]
    return np.logical_and.reduce(masks) if masks else None


def list_errors(subject: page.ReportedAppearance, truth: SkinAppearance) -> Iterator[page.Block]:
    """Yield the errors of melanin and blood against their ground truth, by melanin band.

    Parameters
    ----------
    subject, truth
        Maps of the same size.
    """
    rows = flash.compare(subject.appearance, truth, rng=np.random.default_rng(0))
    blurred = [row for row in rows if row.against == "blurred"]
    for row in blurred:
        if row.band is None:
            worst, worst_got = _worst([r for r in blurred if r.name == row.name and r.band])
            subject.check_fraction(
                f"{map_names.map_title(row.name)}, median error",
                row.median_relative,
                flash.limit(row),
                f"Cramér-Rao bound {100 * flash.bound(row):.1f} %",
                masked=row.masked,
                coverage=row.coverage.fraction,
                worst=worst,
                worst_got=worst_got,
            )
    yield page.build_view("chromophore_errors", errors=rows)
    limits = {
        map_names.map_title(row.name): 100 * flash.limit(row) for row in blurred if row.band is None
    }
    yield from _bars([row for row in blurred if row.band is not None], limits)


def _worst(banded: Iterable[flash.MapAccuracy]) -> tuple[str, float]:
    """Return the melanin band of the largest error and its lower end, where there are several."""
    worst = page.find_worst(banded, lambda row: row.median_relative)
    if worst is None:
        return "", float("nan")
    low, high = (100 * end for end in worst.interval)
    text = f"{worst.band_name}: {100 * worst.median_relative:.3g} % ({low:.3g} – {high:.3g} %)"
    return text, low


def _bars(banded: list[flash.MapAccuracy], limits: Mapping[str, float]) -> Iterator[page.Block]:
    labels = list(dict.fromkeys(row.band_name for row in banded))
    if not labels:
        return
    found = {(row.name, row.band_name): 100 * row.median_relative for row in banded}
    series = {
        map_names.map_title(key): [found.get((key, label), float("nan")) for label in labels]
        for key in dict.fromkeys(row.name for row in banded)
    }
    title = "median error by melanin band; dashed: limit over all bands"
    yield page.Plots([figures.draw_bars(title, labels, series, unit="%", limits=limits)])


def draw_identifiability(appearances: Iterable[SkinAppearance]) -> Iterator[page.Block]:
    """Draw the Cramér-Rao bound of each chromophore.

    Parameters
    ----------
    appearances
        Each color table that one of them was inverted with is drawn once.
    """
    tables = {
        (str(built["camera"]), str(built["illuminant"]))
        for appearance in appearances
        if "melanin" in appearance.maps
        and isinstance(built := appearance.parameters.get("color_table"), dict)
    }
    if not tables:
        return
    yield page.Heading("Identifiability of chromophores", level=2)
    yield page.build_note(
        "Cramér-Rao bound on the relative standard uncertainty of an unbiased estimator, for "
        f"{100 * IDENTIFIABILITY_NOISE:g} % noise per channel, the model error, and unknown optics."
    )
    for camera, illuminant in sorted(tables):
        yield page.Heading(f"{camera}, {illuminant}")
        yield page.Plots(_plots_of_table(camera, illuminant))


@cache
def _plots_of_table(camera: str, illuminant: str) -> tuple[str, ...]:
    table = color_table.build(camera, illuminant, anisotropy=ANISOTROPY_SKIN)
    plots = []
    choices: tuple[tuple[Literal["known"] | None, str], ...] = (
        (None, "shading free"),
        ("known", "shading known"),
    )
    for shading, words in choices:
        found = chromophores.compute_identifiability(
            table,
            shading=shading,
            variance=lambda rgb: np.square(IDENTIFIABILITY_NOISE * rgb),
            model_error=model_error.load_covariance(),
            size=48,
        )
        errors = {"melanin": found.stderr_melanin, "blood": found.stderr_hemoglobin}
        plots += [
            figures.draw_sensitivity(f"{name}, {words}", found.c_m, found.c_hd, 100 * relative)
            for name, relative in errors.items()
        ]
    return tuple(plots)
