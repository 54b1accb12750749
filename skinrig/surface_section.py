"""The report's section on a surface: maps seen from the front beside their truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from model.skin import SkinAppearance, SkinMap
from skinrig import page, reflection_evaluation
from skinrig import surface_evaluation as evaluation

WIDTH_PX = 220
GRAY = 0.5
FIRST = ("r_d", "normals_refined", "normals", "half_vector_normals")


@dataclass(frozen=True, slots=True)
class FrontView:
    """Points of a surface as they lie in a picture from the front, without perspective.

    Attributes
    ----------
    shape
        Rows and columns of the picture.
    rows, columns
        Where each point falls, shape (N,); -1 outside the picture.
    order
        Points from the back to the front, shape (N,).
    """

    shape: tuple[int, int]
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    order: NDArray[np.intp]

    @staticmethod
    def of(
        position_mm: NDArray[np.floating], box: tuple[NDArray[np.floating], NDArray[np.floating]]
    ) -> FrontView:
        """Look along -z at points, shape (N, 3), inside a box given by its two corners."""
        low, high = box
        pixel = max(float(high[0] - low[0]) / WIDTH_PX, 1e-9)
        height = max(int(np.ceil(float(high[1] - low[1]) / pixel)), 1)
        columns = np.floor((position_mm[:, 0] - low[0]) / pixel).astype(np.intp)
        rows = np.floor((high[1] - position_mm[:, 1]) / pixel).astype(np.intp)
        inside = (columns >= 0) & (columns < WIDTH_PX) & (rows >= 0) & (rows < height)
        return FrontView(
            (height, WIDTH_PX),
            np.where(inside, rows, -1),
            np.where(inside, columns, -1),
            np.argsort(position_mm[:, 2], kind="stable"),
        )

    def picture(
        self, values: NDArray[np.floating], *, valid: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the picture of a value at each point, (N,) or (N, 3), and where there is one.

        The frontmost point of a pixel is shown; gaps of up to two pixels between points take the
        nearest one's value.
        """
        chosen = self.order[(self.rows[self.order] >= 0)]
        image = np.zeros((*self.shape, *values.shape[1:]))
        hit = np.zeros(self.shape, bool)
        good = np.zeros(self.shape, bool)
        at = self.rows[chosen], self.columns[chosen]
        image[at] = values[chosen]
        hit[at] = True
        good[at] = True if valid is None else valid[chosen]
        distance, nearest = ndimage.distance_transform_edt(~hit, return_indices=True)
        image, good = image[tuple(nearest)], good[tuple(nearest)]
        return image, good & (distance <= 2.0)


def section(
    name: str, appearance: SkinAppearance, truth: SkinAppearance | None, checks: list[page.Check]
) -> str:
    """Return the maps of an appearance on a mesh, beside their truth where there is one.

    Parameters
    ----------
    name
        For headings.
    appearance
        With a map "position".
    truth
        Of the same subject, on an atlas of its own; None: standard errors only.
    checks
        Judgements are added to it.
    """
    body = ""
    place = appearance.maps["position"]
    rows, columns = np.nonzero(_valid(place))
    points = place.values[rows, columns].astype(np.float64)
    if not len(points):
        return "<p class=note>No texel of these maps is valid.</p>"
    box = points.min(axis=0), points.max(axis=0)
    view = FrontView.of(points, box)
    true_view, known = None, np.zeros(0, np.intp)
    if truth is not None:
        pairs = evaluation.match(appearance, truth)
        true_place = truth.maps["position"]
        usable = _valid(true_place)
        if "mask" in truth.maps:
            usable = usable & (truth.maps["mask"].values > 0.5)
        known = np.flatnonzero(usable)
        true_view = FrontView.of(true_place.values.reshape(-1, 3)[known].astype(float), box)
    for key, skin_map in sorted(appearance.maps.items(), key=lambda item: _rank(item[0])):
        if key == "position" or key.startswith("_"):
            continue
        values = skin_map.values[rows, columns]
        good = _valid(skin_map)[rows, columns]
        figures = []
        true_name = "normals" if key in evaluation.NORMAL_MAPS else key
        if truth is not None and true_view is not None and true_name in truth.maps:
            flat = truth.maps[true_name].values
            flat = flat.reshape(-1, *flat.shape[2:])[known]
            figures.append(_shown("truth", true_name, *true_view.picture(flat)))
        figures.append(_shown("estimate", key, *view.picture(values, valid=good)))
        if truth is not None and (true_name in truth.maps):
            figures.append(_error(key, appearance, truth, pairs, box))
        if skin_map.stderr is not None:
            figures.append(_spread(key, skin_map, rows, columns, view, good))
        body += f"<h3>{page.escape(key)}</h3><div class=maps>{''.join(figures)}</div>"
    if truth is not None:
        body += _errors(name, appearance, truth, checks)
        body += _reflection(name, appearance, truth, checks)
    return body


def _rank(key: str) -> tuple[int, str]:
    """Order maps: what people look for first, then by name."""
    return (FIRST.index(key) if key in FIRST else len(FIRST), key)


def _shown(title: str, key: str, image: NDArray[np.float64], valid: NDArray[np.bool_]) -> str:
    if image.ndim == 2:
        inside = image[valid & np.isfinite(image)]
        low, high = np.percentile(inside, [1, 99]) if inside.size else (0.0, 1.0)
        return page.scalar_picture(title, image, low=low, high=high, valid=valid)
    if "normals" in key:
        picture = np.rint(255.0 * np.clip(0.5 + 0.5 * image, 0.0, 1.0)).astype(np.uint8)
        picture[~valid] = 128
        return page.plain_picture(title, picture)
    return page.color_picture(title, np.where(valid[..., None], image, GRAY**2.2))


def _error(
    key: str,
    appearance: SkinAppearance,
    truth: SkinAppearance,
    pairs: evaluation.Match,
    box: tuple[NDArray[np.floating], NDArray[np.floating]],
) -> str:
    error = evaluation.errors_at(key, appearance, truth, pairs)
    points = appearance.maps["position"].values[pairs.rows, pairs.columns].astype(np.float64)
    good = np.isfinite(error)
    image, valid = FrontView.of(points, box).picture(np.nan_to_num(error), valid=good)
    reach = float(np.percentile(np.abs(error[good]), 95)) if good.any() else 1.0
    if key in evaluation.NORMAL_MAPS:
        return page.scalar_picture(
            "error", image, low=0.0, high=reach, scale="magma", valid=valid, unit="°"
        )
    return page.scalar_picture(
        "estimate − truth", image, low=-reach, high=reach, scale="RdBu_r", valid=valid, unit="%"
    )


def _spread(
    key: str,
    skin_map: SkinMap,
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    view: FrontView,
    good: NDArray[np.bool_],
) -> str:
    if skin_map.stderr is None:
        return ""
    stderr = skin_map.stderr[rows, columns].astype(np.float64)
    if stderr.ndim == 2:
        stderr = stderr.mean(axis=-1)
    unit = "" if skin_map.unit == "1" else skin_map.unit
    if key in evaluation.NORMAL_MAPS:
        stderr, unit = np.degrees(stderr), "°"
    image, valid = view.picture(stderr, valid=good)
    inside = image[valid & np.isfinite(image)]
    reach = float(np.percentile(inside, 98)) if inside.size else 1.0
    return page.scalar_picture(
        "standard error", image, low=0.0, high=reach, scale="magma", valid=valid, unit=unit
    )


def _errors(
    name: str, appearance: SkinAppearance, truth: SkinAppearance, checks: list[page.Check]
) -> str:
    found = evaluation.compare(appearance, truth, rng=np.random.default_rng(0))
    registration = appearance.parameters.get("registration")
    pixel_mm = registration.get("pixel_mm", 0.0) if isinstance(registration, dict) else 0.0
    coarse = float(pixel_mm) > evaluation.JUDGED_PIXEL_MM
    for row in found:
        if row.name == "half_vector_normals":
            continue  # the published baseline, shown beside ours and held to nothing
        if row.unit == "deg" and coarse:
            continue
        what, got, bound = row.judged
        unit = "°" if row.unit == "deg" else row.unit
        remark = f"{100 * row.masked:.0f} % masked"
        checks.append(page.Check(f"{name}: {row.name}, {what}", got, bound, "<=", unit, remark))
    note = ""
    if coarse:
        note = (
            f"<p class=note>A pixel of these images is {pixel_mm:.1f} mm wide on the face; the "
            f"limit of {evaluation.NORMAL_LIMIT_DEG:g}° is promised for "
            f"{evaluation.JUDGED_PIXEL_MM:g} mm and finer, so normals are shown but not judged."
            "</p>"
        )
    return "<h3>Errors on the surface</h3>" + note + page.table(
        ("map", "unit", "points", "masked %", "mean |error|", "median", "68 % interval", "95th %",
         "bias", "68 % coverage %", "median standard error"),
        [
            (
                row.name, "°" if row.unit == "deg" else row.unit, row.points, 100 * row.masked,
                row.mean, row.median, f"{row.interval[0]:.3g} – {row.interval[1]:.3g}", row.high,
                row.bias, 100 * row.coverage.share, row.median_stderr,
            )
            for row in found
        ],
    )  # fmt: skip


def _reflection(
    name: str, appearance: SkinAppearance, truth: SkinAppearance, checks: list[page.Check]
) -> str:
    """Compare the fitted reflection with the true one, in held-out directions and on spheres."""
    held_out = reflection_evaluation.compare(appearance, truth, rng=np.random.default_rng(0))
    if held_out is None:
        return ""
    checks.append(
        page.Check(
            f"{name}: reflection in held-out directions, median error",
            100 * held_out.median,
            100 * reflection_evaluation.HELD_OUT_LIMIT,
            "<=",
            "%",
            f"{held_out.points} points x {held_out.directions} directions",
        )
    )
    low, high = held_out.interval
    body = "<h3>Reflection in directions that no light of the capture had</h3>" + page.table(
        ("points", "directions", "median error %", "68 % interval", "in highlights %"),
        [(held_out.points, held_out.directions, 100 * held_out.median,
          f"{100 * low:.3g} – {100 * high:.3g}", 100 * held_out.highlights)],
    )  # fmt: skip
    figures = []
    for site, true_image, image in reflection_evaluation.spheres(appearance, truth):
        bright = float(np.percentile(true_image.max(axis=-1), 99.5)) or 1.0
        figures.append(page.color_picture(f"{site}: truth", true_image / bright))
        if image is not None:
            figures.append(page.color_picture(f"{site}: estimate", image / bright))
    if figures:
        body += f"<h3>Reflection on spheres</h3><div class=maps>{''.join(figures)}</div>"
    return body


def _valid(skin_map: SkinMap) -> NDArray[np.bool_]:
    shape = skin_map.values.shape[:2]
    return np.ones(shape, bool) if skin_map.valid is None else skin_map.valid
