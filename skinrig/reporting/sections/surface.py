"""The report's section on a surface: maps seen from the front beside their truth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from model.skin import SkinAppearance
from skinrig.appearances.front_view import FRONT_VIEW_WIDTH_PX, FrontView
from skinrig.arrays import BoolArray, Float64Array, FloatArray
from skinrig.evaluating import reflection
from skinrig.evaluating import surface as evaluation
from skinrig.evaluating.surface import Banded, errors_by_band
from skinrig.reporting import map_images, page
from skinrig.reporting.map_images import valid_of
from skinrig.reporting.map_names import heading, words
from skinrig.written_units import unit_sign

SMALL_WIDTH_PX = 110
"""Of earlier normals, lobes, samples and residuals: every second pixel of the others."""
BACKGROUND_CODE = 0.5
RELATIVE_ERROR_MAPS = ("r_d",)
"""Maps whose standard errors are shown in percent of the estimate."""
FIRST_MAPS = ("r_d", "normals_refined", "normals", "half_vector_normals")


def section(
    name: str, appearance: SkinAppearance, truth: SkinAppearance | None, checks: list[page.Check]
) -> Iterator[page.Block]:
    """Yield the maps of an appearance on a mesh, beside their truth where there is one.

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
    place = appearance.maps["position"]
    rows, columns = np.nonzero(valid_of(place))
    points = place.values[rows, columns].astype(np.float64)
    if not len(points):
        yield page.note("No texel of these maps is valid.")
        return
    box = points.min(axis=0), points.max(axis=0)
    view = FrontView.of(points, box)
    true_view, known = None, np.zeros(0, np.intp)
    if truth is not None:
        pairs = evaluation.match(appearance, truth)
        true_place = truth.maps["position"]
        usable = valid_of(true_place)
        if "mask" in truth.maps:
            usable = usable & (truth.maps["mask"].values > 0.5)
        known = np.flatnonzero(usable)
        true_view = FrontView.of(true_place.values.reshape(-1, 3)[known].astype(float), box)
    best = next((key for key in FIRST_MAPS[1:] if key in appearance.maps), "")
    large = {"r_d", best}
    shown_truths: set[str] = set()
    minor = []
    for key, skin_map in sorted(appearance.maps.items(), key=lambda item: _rank(item[0])):
        if key == "position" or key.startswith("_"):
            continue
        values = skin_map.values[rows, columns]
        good = valid_of(skin_map)[rows, columns]
        width = FRONT_VIEW_WIDTH_PX if key in large else SMALL_WIDTH_PX
        figures = []
        true_name = "normals" if key in evaluation.NORMAL_MAPS else key
        known_truth = truth is not None and true_name in truth.maps
        if truth is not None and true_view is not None and known_truth:
            if true_name not in shown_truths:  # of all estimates of normals there is one truth
                flat = truth.maps[true_name].values
                flat = flat.reshape(-1, *flat.shape[2:])[known]
                figures.append(_shown("truth", key, *true_view.picture(flat), width=width))
                shown_truths.add(true_name)
        figures.append(_shown("estimate", key, *view.picture(values, valid=good), width=width))
        if truth is not None and known_truth:
            figures.append(_error(key, appearance, truth, pairs, box, width=width))
        if skin_map.stderr is not None:
            stderr = skin_map.stderr[rows, columns]
            figures.append(_spread(key, skin_map.unit, values, stderr, view, good, width=width))
        if key in FIRST_MAPS:
            yield page.Heading(heading(key))
            yield page.Images(figures, small=key not in large)
        else:
            minor += figures
    if minor:
        yield page.Heading("Lobes, samples and residuals")
        yield page.Images(minor, small=True)
    if truth is not None:
        yield from _errors(name, appearance, truth, checks)
        yield from _reflection(name, appearance, truth, checks)


def _rank(key: str) -> tuple[int, str]:
    """Order maps: what people look for first, then by name."""
    return (FIRST_MAPS.index(key) if key in FIRST_MAPS else len(FIRST_MAPS), key)


def _shown(
    title: str, key: str, image: Float64Array, valid: BoolArray, *, width: int
) -> page.Image:
    if image.ndim == 2:
        inside = image[valid & np.isfinite(image)]
        low, high = np.percentile(inside, [1, 99]) if inside.size else (0.0, 1.0)
        return map_images.scalar_image(
            _title(title, key), image, low=low, high=high, valid=valid, of=key, width=width
        )
    if "normals" in key:
        return map_images.normal_image(title, image, valid=valid, of=key, width=width)
    return map_images.color_image(
        title, np.where(valid[..., None], image, BACKGROUND_CODE**2.2), of=f"{key}, linear sRGB"
    )


def _title(title: str, key: str) -> str:
    """Return what stands below a picture: of maps that share a heading, which one it is."""
    return title if key in FIRST_MAPS else f"{words(key)}, {title}"


def _error(
    key: str,
    appearance: SkinAppearance,
    truth: SkinAppearance,
    pairs: evaluation.Match,
    box: tuple[FloatArray, FloatArray],
    *,
    width: int,
) -> page.Image:
    error = evaluation.errors_at(key, appearance, truth, pairs)
    points = appearance.maps["position"].values[pairs.rows, pairs.columns].astype(np.float64)
    good = np.isfinite(error)
    image, valid = FrontView.of(points, box).picture(np.nan_to_num(error), valid=good)
    reach = map_images.reach_of(error, good, 95)
    if key in evaluation.NORMAL_MAPS:
        return map_images.scalar_image(
            "error",
            image,
            low=0.0,
            high=reach,
            scale="magma",
            valid=valid,
            unit="°",
            of=key,
            width=width,
        )
    return map_images.scalar_image(
        "estimate − truth",
        image,
        low=-reach,
        high=reach,
        scale="RdBu_r",
        valid=valid,
        unit="%",
        of=key,
        width=width,
    )


def _spread(
    key: str,
    unit: str,
    values: FloatArray,
    stderr: FloatArray,
    view: FrontView,
    good: BoolArray,
    *,
    width: int,
) -> page.Image:
    stderr, unit = stderr.astype(np.float64), page.short_unit(unit)
    if key in RELATIVE_ERROR_MAPS:  # as errors are told, beside which it stands
        size = np.abs(values.astype(np.float64))
        good = good & (size > 0.0).reshape(len(good), -1).all(axis=-1)
        stderr, unit = 100.0 * stderr / np.where(size > 0.0, size, 1.0), "%"
    if stderr.ndim == 2:
        stderr = stderr.mean(axis=-1)
    if key in evaluation.NORMAL_MAPS:
        stderr, unit = np.degrees(stderr), "°"
    image, valid = view.picture(stderr, valid=good)
    reach = map_images.reach_of(image, valid, 98)
    return map_images.scalar_image(
        _title("standard error", key),
        image,
        low=0.0,
        high=reach,
        scale="magma",
        valid=valid,
        unit=unit,
        of=key,
        width=width,
    )


def _errors(
    name: str, appearance: SkinAppearance, truth: SkinAppearance, checks: list[page.Check]
) -> Iterator[page.Block]:
    found = evaluation.compare(appearance, truth, rng=np.random.default_rng(0))
    banded = errors_by_band(appearance, truth)
    registration = appearance.parameters.get("registration")
    pixel_mm = registration.get("pixel_mm", 0.0) if isinstance(registration, dict) else 0.0
    coarse = float(pixel_mm) > evaluation.MAX_EVALUATED_PIXEL_MM
    for row in found:
        if row.name == "half_vector_normals":
            continue  # the published baseline, shown beside ours and held to nothing
        if row.unit == "deg" and coarse:
            continue
        what, got, bound = row.judged
        unit = unit_sign(row.unit)
        where, worst_got = _worst(row.name, banded)
        checks.append(
            page.Check(
                f"{name}: {words(row.name)}, {what}",
                got,
                bound,
                "<=",
                unit,
                masked=row.masked,
                coverage=row.coverage.share,
                worst=where,
                worst_got=worst_got,
            )
        )
    yield page.Heading("Errors on the surface")
    if coarse:
        yield page.note(
            f"A pixel of these images is {pixel_mm:.1f} mm wide on the face; the "
            f"limit of {evaluation.MAX_NORMAL_ERROR_DEG:g}° is promised for "
            f"{evaluation.MAX_EVALUATED_PIXEL_MM:g} mm and finer, so normals are shown but not "
            "judged."
        )
    yield page.records(
        found,
        (
            ("map", lambda row: words(row.name)),
            ("unit", lambda row: unit_sign(row.unit)),
            ("points", lambda row: row.points),
            ("masked, %", lambda row: 100 * row.masked),
            ("mean |error|", lambda row: row.mean),
            ("median", lambda row: row.median),
            ("68 % interval", lambda row: f"{row.interval[0]:.3g} – {row.interval[1]:.3g}"),
            ("95th percentile", lambda row: row.high),
            ("bias", lambda row: row.bias),
            ("68 % coverage, %", lambda row: 100 * row.coverage.share),
            ("median standard error", lambda row: row.median_stderr),
        ),
        caption="Texel by texel against the nearest true point; angles in degrees",
    )
    yield page.table(
        ("map", "unit", "skin", "points", "masked, %", "median |error|", "95th percentile"),
        [(words(row[0]), *row[1:]) for row in banded],
        caption="By skin color: the individual typology angle of the true reflectance "
        "(Chardon et al. 1991)",
    )


def _worst(name: str, banded: list[Banded]) -> tuple[str, float]:
    """Return the skin color of the largest error and that error, where there are several."""
    own = [row for row in banded if row[0] == name.split()[0]]
    if len(own) < 2:
        return "", float("nan")
    worst = max(own, key=lambda row: row[5])
    return f"{worst[2]} skin: {worst[5]:.3g} {worst[1]}", worst[5]


def _reflection(
    name: str, appearance: SkinAppearance, truth: SkinAppearance, checks: list[page.Check]
) -> Iterator[page.Block]:
    """Compare the fitted reflection with the true one, in held-out directions and on spheres."""
    held_out = reflection.compare(appearance, truth, rng=np.random.default_rng(0))
    if held_out is None:
        return
    checks.append(
        page.Check(
            f"{name}: reflection in held-out directions, median error",
            100 * held_out.median,
            100 * reflection.MAX_HELD_OUT_ERROR,
            "<=",
            "%",
            f"{held_out.points} points × {held_out.directions} directions",
        )
    )
    low, high = held_out.interval
    yield page.Heading("Reflection in directions that no light of the capture had")
    yield page.table(
        ("points", "directions", "median error, %", "68 % interval", "in highlights, %"),
        [
            (
                held_out.points,
                held_out.directions,
                100 * held_out.median,
                f"{100 * low:.3g} – {100 * high:.3g}",
                100 * held_out.highlights,
            )
        ],
        caption="Against the true reflection at points of the surface",
    )
    figures = []
    for site, true_image, image in reflection.spheres(appearance, truth):
        bright = float(np.percentile(true_image.max(axis=-1), 99.5)) or 1.0
        figures.append(map_images.color_image(f"{site}: truth", true_image / bright))
        if image is not None:
            figures.append(map_images.color_image(f"{site}: estimate", image / bright))
    if figures:
        yield page.Heading("Reflection on spheres")
        yield page.Images(figures)
