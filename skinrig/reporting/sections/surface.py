"""Report section on a surface: maps projected to the front, with their ground truth."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.skin import SkinAppearance, SkinMap
from skinrig.appearances.front_view import FRONT_VIEW_WIDTH_PX, FrontView
from skinrig.arrays import BoolArray, Float64Array, FloatArray
from skinrig.evaluating import reflection
from skinrig.evaluating import surface as evaluation
from skinrig.evaluating.surface import Banded, errors_by_band
from skinrig.reporting import map_images, page
from skinrig.reporting.map_names import map_heading, map_title
from skinrig.unit_format import format_unit

SMALL_WIDTH_PX = 110
"""Width of half-vector normals, weights, samples and residuals."""
BACKGROUND_CODE = 0.5
OWN_PIXELS = ("_", "patch_", "microrelief_")
"""Prefixes of maps that are not on the texture of the positions."""
Box = tuple[FloatArray, FloatArray]
Index = NDArray[np.intp]
RELATIVE_ERROR_MAPS = ("r_d",)
"""Maps with uncertainties in percent of the estimate."""
FIRST_MAPS = ("r_d", "normals_refined", "normals", "half_vector_normals")
SKIN_MAPS = ("melanin", "hemoglobin", "translucency")
"""Maps of a fused person."""


def section(subject: page.ReportedAppearance) -> Iterator[page.Block]:
    """Yield the maps of an appearance on a mesh, with their ground truth where given.

    Parameters
    ----------
    subject
        Appearance with a map "position". Its ground truth is of the same subject, on another
        atlas; None: only uncertainties are reported.
    """
    appearance, truth = subject.appearance, subject.truth
    place = appearance.maps["position"]
    rows, columns = np.nonzero(place.mask)
    points = place.values[rows, columns].astype(np.float64)
    if not len(points):
        yield page.build_note("No texel of these maps is valid.")
        return
    box = points.min(axis=0), points.max(axis=0)
    view = FrontView.of(points, box)
    true_view, known = None, np.zeros(0, np.intp)
    if truth is not None:
        pairs = evaluation.match_texels(appearance, truth)
        true_place = truth.maps["position"]
        usable = true_place.mask
        if "mask" in truth.maps:
            usable = usable & (truth.maps["mask"].values > 0.5)
        known = np.flatnonzero(usable)
        true_view = FrontView.of(true_place.values.reshape(-1, 3)[known].astype(float), box)
    best = next((key for key in FIRST_MAPS[1:] if key in appearance.maps), "")
    large = {"r_d", "melanin", "hemoglobin", best}
    shown_truths: set[str] = set()
    # main maps first, then by name
    keys = [key for key in (*FIRST_MAPS, *SKIN_MAPS) if key in appearance.maps]
    keys += sorted(set(appearance.maps) - set(keys))
    minor = []
    for key in keys:
        skin_map = appearance.maps[key]
        if key == "position" or key.startswith(OWN_PIXELS):
            continue
        values = skin_map.values[rows, columns]
        good = skin_map.mask[rows, columns]
        width = FRONT_VIEW_WIDTH_PX if key in large else SMALL_WIDTH_PX
        figures = []
        true_name = "normals" if key in evaluation.NORMAL_MAPS else key
        known_truth = truth is not None and true_name in truth.maps
        if truth is not None and true_view is not None and known_truth:
            if true_name not in shown_truths:  # of all estimates of normals there is one truth
                flat = truth.maps[true_name].values
                flat = flat.reshape(-1, *flat.shape[2:])[known]
                figures.append(_shown("ground truth", key, *true_view.rasterize(flat), width=width))
                shown_truths.add(true_name)
        figures.append(_shown("estimate", key, *view.rasterize(values, valid=good), width=width))
        if truth is not None and known_truth:
            figures.append(_error(key, (appearance, truth), pairs, box, width))
        if skin_map.stderr is not None:
            stderr = skin_map.stderr[rows, columns]
            figures.append(_stderr_image(key, skin_map, stderr, view, (rows, columns), width))
        if key in (*FIRST_MAPS, *SKIN_MAPS):
            yield page.Heading(map_heading(key))
            yield page.Images(figures, small=key not in large)
        else:
            minor += figures
    if minor:
        yield page.Heading("Basis BRDFs, samples and residuals")
        yield page.Images(minor, small=True)
    if truth is not None:
        yield from _errors(subject, truth)
        yield from _reflection(subject, truth)


def _shown(
    title: str, key: str, image: Float64Array, valid: BoolArray, *, width: int
) -> page.Image:
    drawing = map_images.MapDrawing(map_title(key), "", valid, width)
    if image.ndim == 2:
        inside = image[valid & np.isfinite(image)]
        low, high = np.percentile(inside, [1, 99]) if inside.size else (0.0, 1.0)
        return drawing.draw_scalar(_title(title, key), image, low, high)
    if "normals" in key:
        return drawing.normals(title, image)
    return map_images.draw_color_image(
        title,
        np.where(valid[..., None], image, BACKGROUND_CODE**2.2),
        of=f"{map_title(key)}, linear sRGB",
    )


def _title(title: str, key: str) -> str:
    """Return the caption of an image, with its map where several share a heading."""
    return title if key in (*FIRST_MAPS, *SKIN_MAPS) else f"{map_title(key)}, {title}"


def _error(
    key: str,
    both: tuple[SkinAppearance, SkinAppearance],
    pairs: evaluation.TexelMatch,
    box: Box,
    width: int,
) -> page.Image:
    error = evaluation.matched_errors(key, *both, pairs)
    points = both[0].maps["position"].values[pairs.rows, pairs.columns].astype(np.float64)
    good = np.isfinite(error)
    image, valid = FrontView.of(points, box).rasterize(np.nan_to_num(error), valid=good)
    reach = map_images.compute_percentile_reach(error, good, 95)
    if key in evaluation.NORMAL_MAPS:
        return map_images.MapDrawing(map_title(key), "°", valid, width).size("error", image, reach)
    return map_images.MapDrawing(map_title(key), "%", valid, width).draw_signed(
        "estimate − ground truth", image, reach
    )


def _stderr_image(
    key: str,
    skin_map: SkinMap,
    stderr: FloatArray,
    view: FrontView,
    texels: tuple[Index, Index],
    width: int,
) -> page.Image:
    unit = page.format_short_unit(skin_map.unit)
    good = skin_map.mask[texels]
    if key in RELATIVE_ERROR_MAPS:  # as its errors
        size = np.abs(skin_map.values[texels].astype(np.float64))
        good = good & (size > 0.0).reshape(len(good), -1).all(axis=-1)
        stderr, unit = 100.0 * stderr / np.where(size > 0.0, size, 1.0), "%"
    if stderr.ndim == 2:
        stderr = stderr.mean(axis=-1)
    if key in evaluation.NORMAL_MAPS:
        stderr, unit = np.degrees(stderr), "°"
    image, valid = view.rasterize(stderr, valid=good)
    reach = map_images.compute_percentile_reach(image, valid, 98)
    drawing = map_images.MapDrawing(map_title(key), unit, valid, width)
    return drawing.size(_title("standard uncertainty", key), image, reach)


def _errors(subject: page.ReportedAppearance, truth: SkinAppearance) -> Iterator[page.Block]:
    appearance = subject.appearance
    found = evaluation.compare(appearance, truth, rng=np.random.default_rng(0))
    banded = errors_by_band(appearance, truth)
    registration = appearance.parameters.get("registration")
    pixel_mm = registration.get("pixel_mm", 0.0) if isinstance(registration, dict) else 0.0
    coarse = float(pixel_mm) > evaluation.MAX_EVALUATED_PIXEL_MM
    for row in found:
        if row.name == "half_vector_normals":
            continue  # the published baseline has no limit
        if row.unit == "deg" and coarse:
            continue
        what, got, bound = row.limit_check
        unit = format_unit(row.unit)
        where, worst_got = _worst(row.name, banded)
        more: dict[str, Any] = {
            "masked": row.masked,
            "coverage": row.coverage.fraction,
            "worst": where,
        }
        name = f"{map_title(row.name)}, {what}"
        subject.check(name, got, bound, unit, worst_got=worst_got, **more)
    bounds = evaluation.MAX_NORMAL_ERROR_DEG, evaluation.MAX_EVALUATED_PIXEL_MM
    pixel = pixel_mm if coarse else None
    yield page.build_view(
        "surface_errors", errors=found, banded=banded, pixel_mm=pixel, bounds=bounds
    )


def _worst(name: str, banded: list[Banded]) -> tuple[str, float]:
    """Return the skin color with the largest error, and that error."""
    own = [row for row in banded if row[0] == name.split()[0]]
    worst = page.find_worst(own, lambda row: row[5])
    if worst is None:
        return "", float("nan")
    return f"{worst[2]} skin: {worst[5]:.3g} {worst[1]}", worst[5]


def _reflection(subject: page.ReportedAppearance, truth: SkinAppearance) -> Iterator[page.Block]:
    """Compare the fitted reflectance with the true one, in held-out directions and on spheres."""
    held_out = reflection.compare(subject.appearance, truth, rng=np.random.default_rng(0))
    if held_out is None:
        return
    subject.check_fraction(
        "reflectance in held-out directions, median error",
        held_out.median,
        reflection.MAX_HELD_OUT_ERROR,
        f"{held_out.points} points × {held_out.directions} directions",
    )
    yield page.build_view("reflection", found=held_out)
    figures = []
    for site, true_image, image in reflection.render_spheres(subject.appearance, truth):
        bright = float(np.percentile(true_image.max(axis=-1), 99.5)) or 1.0
        figures.append(map_images.draw_color_image(f"{site}: ground truth", true_image / bright))
        if image is not None:
            figures.append(map_images.draw_color_image(f"{site}: estimate", image / bright))
    if figures:
        yield page.Heading("Reflectance on spheres")
        yield page.Images(figures)
