"""The report on two runs: what changed, where estimates disagree, and what made the difference."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skinrig.appearances.front_view import FrontView
from skinrig.reporting import consents, page
from skinrig.reporting import map_images as map_pictures
from skinrig.reporting.comparison import checks as check_comparison
from skinrig.reporting.comparison import conditions, truth_errors
from skinrig.reporting.comparison import images as picture_comparison
from skinrig.reporting.comparison.maps import MapDifference
from skinrig.reporting.comparison.runs import Pair, Run, alone
from skinrig.reporting.map_names import heading, melanin_band, words
from skinrig.written_units import written

WIDTH_PX = 200
MOST_NAMED = 10
"""Maps that are named first."""
MOST_SHOWN = 4
"""Maps of a pair that are drawn: of those with standard errors the ones that disagree most."""
SIGMAS_SHOWN = 5.0
"""End of the scale of differences in combined standard errors."""


def lead(a: Run, b: Run, found: Sequence[Pair]) -> str:
    """Return what changed in sentences, and the checks of both."""
    rows = check_comparison.rows_of(a, b)
    changed = [row for row in rows if row.changed]
    disagree = [(pair.name, one) for pair in found for one in pair.differences if one.disagree]
    told = sum(bool(one.beyond) for pair in found for one in pair.differences)
    same = told and not any(one.high > 0.0 for pair in found for one in pair.differences)
    sentences = []
    if rows:
        worse = sum(row.changed == "worse" for row in changed)
        common = sum(row.a is not None and row.b is not None for row in rows)
        sentences.append(
            f"{len(changed)} of {common} checks of both changed their verdict"
            + (f", {worse} for the worse." if changed else ".")
        )
    if same:
        sentences.append(f"All {told} maps with standard errors are equal.")
    elif told:
        sentences.append(
            f"{len(disagree)} of {told} maps differ beyond their combined standard errors."
        )
    drawn = picture_comparison.sentence(a, b)
    if drawn:
        sentences.append(drawn)
    if not sentences:
        sentences.append("Nothing that both have can be judged; see the tables.")
    bad = any(row.changed == "worse" for row in changed)
    body = (
        f'<p class="verdict {"bad" if bad else ""}">{page.escape(" ".join(sentences))}</p>'
        f"<p>{page.escape(a.label)} is {page.escape(_where(a))}; {page.escape(b.label)} is "
        f"{page.escape(_where(b))}. Differences are B less A.</p>"
    )
    worst = sorted(disagree, key=lambda item: -item[1].beyond[-1])
    if worst:
        items = "".join(
            f"<li>{page.escape(f'{name}: {_in_words(one)}')}</li>"
            for name, one in worst[:MOST_NAMED]
        )
        body += "<h2>Where they disagree</h2>" + page.note(
            "Shares of pixels that lie more than three combined standard errors apart; chance "
            f"leaves 0.27 %. The {min(len(worst), MOST_NAMED)} farthest of {len(worst)}."
        )
        body += f'<ul class="worst">{items}</ul>'
    return body + check_comparison.table(a, b, rows)


def _in_words(one: MapDifference) -> str:
    by = page.number(one.median if one.unit == "°" else one.bias)
    return (
        f"{words(one.name)} by {written(by, one.unit)} in the median, "
        f"{100 * one.beyond[-1]:.3g} % of pixels"
    )


def _where(run: Run) -> str:
    """Return a run by the end of its path: the whole of it is nobody else's business."""
    return "/".join(run.path.resolve().parts[-2:])


def sections(a: Run, b: Run, found: Sequence[Pair]) -> str:
    """Return maps, errors against the truths, settings and times of both."""
    body = "".join(_pair(a, b, pair) for pair in found)
    body += conditions.benchmarks(a, b) + conditions.seconds(a, b)
    body += conditions.moved_calibrations(a, b)
    body += picture_comparison.section(a, b)
    missing = [*alone(a, b), *picture_comparison.alone(a, b)]
    if missing:
        body += "<h2>Only in one</h2>" + page.table(
            ("folder", "in"),
            missing,
            caption="Folders of maps or pictures without one of the same name",
        )
    return body + consents.section([a.found, b.found])


def _pair(a: Run, b: Run, pair: Pair) -> str:
    body = f"<h2>Maps: {page.escape(pair.name)}</h2>"
    common = pair.a.inputs.get("session") == pair.b.inputs.get("session")
    if common and "session" in pair.a.inputs:
        body += page.note(
            "Both were made of the same frames: they share the frames' noise, so that every "
            "difference is the processing's, and combined standard errors are too large for it."
        )
    body += page.table(
        (
            "map",
            "verdict",
            "beyond 3 σ, %",
            "2 σ, %",
            "1 σ, %",
            "median A",
            "median B",
            "median B − A",
            "median |B − A|",
            "95th percentile",
            "σ",
            "unit",
            "pixels",
            "only A",
            "only B",
        ),
        [_difference_row(one) for one in sorted(pair.differences, key=_farthest_first)],
        caption="Pixel by pixel; σ: the two standard errors combined, median; beyond: share of "
        "pixels that far apart, by chance 0.27, 4.6 and 31.7 %; only: pixels without a partner",
    )
    if pair.refused:
        table = page.table(("map", "why"), pair.refused, caption="Maps that were not subtracted")
        body += page.folded(f"{len(pair.refused)} maps not subtracted", table)
    body += _pictures(a, b, pair) + _by_band(pair) + _errors(a, b, pair)
    return body + conditions.settings(a, b, pair)


def _farthest_first(one: MapDifference) -> tuple[float, str]:
    return (-one.beyond[-1] if one.beyond else 1.0, one.name)


def _difference_row(one: MapDifference) -> tuple[object, ...]:
    shares = [100 * share for share in one.beyond] or [float("nan")] * 3
    verdict = "no standard errors"
    if one.beyond:
        verdict = "disagree" if one.disagree else "equal" if one.high == 0.0 else "agree"
    return (
        words(one.name),
        verdict,
        *shares[::-1],
        one.median_a,
        one.median_b,
        one.bias,
        one.median,
        one.high,
        one.combined,
        one.unit,
        one.pixels,
        one.only_a,
        one.only_b,
    )


def _pictures(a: Run, b: Run, pair: Pair) -> str:
    """Draw A | B | difference | difference over the combined standard error."""
    told = [one for one in pair.differences if one.sigmas is not None and one.name != "position"]
    order = sorted((one for one in told if one.high > 0.0), key=_farthest_first)
    body = ""
    for one in order[:MOST_SHOWN]:
        body += f"<h3>{page.escape(heading(one.name))}</h3><div class='maps'>"
        body += "".join(_four(a, b, pair, one)) + "</div>"
    if len(order) > MOST_SHOWN:
        names = "; ".join(words(one.name) for one in order[MOST_SHOWN:])
        body += page.note(f"Not drawn, since they disagree less: {names}.")
    return body


def _four(a: Run, b: Run, pair: Pair, one: MapDifference) -> Iterator[str]:
    maps = pair.a.maps[one.name], pair.b.maps[one.name]
    both = ~np.isnan(one.difference)
    place = pair.a.maps.get("position")

    def laid(values: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return values as a picture, from the front where they lie on a mesh."""
        if place is None:
            return np.nan_to_num(values), both
        rows, columns = np.nonzero(both if place.valid is None else both & place.valid)
        points = place.values[rows, columns].astype(np.float64)
        view = FrontView.of(points, (points.min(axis=0), points.max(axis=0)))
        return view.picture(np.nan_to_num(values[rows, columns].astype(np.float64)))

    if not both.any():
        return
    shown = np.concatenate([m.values[both].ravel() for m in maps]).astype(np.float64)
    low, high = np.percentile(shown[np.isfinite(shown)], [1, 99])
    for label, skin_map in zip((a.label, b.label), maps, strict=True):
        image, mask = laid(skin_map.values)
        if one.unit == "°":
            yield map_pictures.normal_picture(label, image, valid=mask, width=WIDTH_PX, of=one.name)
        elif image.ndim == 3:
            yield map_pictures.color_picture(
                label, np.where(mask[..., None], image, 0.2), width=WIDTH_PX, of=one.name
            )
        else:
            yield map_pictures.scalar_picture(
                label,
                image,
                low=low,
                high=high,
                valid=mask,
                unit=one.unit,
                width=WIDTH_PX,
                of=one.name,
            )
    image, mask = laid(one.difference)
    reach = map_pictures.reach_of(image, mask, 98) or 1.0
    signed = one.unit != "°"
    yield map_pictures.scalar_picture(
        "B − A" if signed else "angle between them",
        image,
        low=-reach if signed else 0.0,
        high=reach,
        scale="RdBu_r" if signed else "magma",
        valid=mask,
        unit=one.unit,
        width=WIDTH_PX,
        of=one.name,
    )
    if one.sigmas is not None:
        image, mask = laid(one.sigmas)
        yield map_pictures.scalar_picture(
            "in combined standard errors",
            image,
            low=-SIGMAS_SHOWN if signed else 0.0,
            high=SIGMAS_SHOWN,
            scale="RdBu_r" if signed else "magma",
            valid=mask,
            width=WIDTH_PX,
            of=f"{one.name}, difference",
        )


def _by_band(pair: Pair) -> str:
    """Return differences of chromophores by band of the melanin that both find on average."""
    from skinrig.evaluating.flash import MELANIN_RANGES

    melanin = [side.maps.get("melanin") for side in (pair.a, pair.b)]
    if melanin[0] is None or melanin[1] is None:
        return ""
    if melanin[0].values.shape != melanin[1].values.shape:
        return ""
    level = 0.5 * (melanin[0].values + melanin[1].values)
    rows: list[tuple[object, ...]] = []
    for one in pair.differences:
        if one.sigmas is None or one.difference.shape != level.shape:
            continue
        for low, high in MELANIN_RANGES:
            inside = (level >= low) & (level < high) & ~np.isnan(one.difference)
            inside &= ~np.isnan(one.sigmas)
            if np.count_nonzero(inside) < 20:
                continue
            sigmas = np.abs(one.sigmas[inside])
            rows.append(
                (
                    words(one.name),
                    melanin_band(low, high),
                    one.unit,
                    int(inside.sum()),
                    float(np.median(one.difference[inside])),
                    float(np.median(np.abs(one.difference[inside]))),
                    float(np.median(sigmas)),
                    100 * float(np.mean(sigmas > 3.0)),
                )
            )
    if not rows:
        return ""
    table = page.table(
        (
            "map",
            "band",
            "unit",
            "pixels",
            "median difference",
            "median |difference|",
            "median of combined standard errors",
            "beyond 3 %",
        ),
        rows,
        caption="By band of the melanin fraction C_m that both find on average",
    )
    return "<h3>By melanin band</h3>" + table


def _errors(a: Run, b: Run, pair: Pair) -> str:
    """Return errors of both against their truths, where both truths are known."""
    truths = a.found.truth_of(pair.a), b.found.truth_of(pair.b)
    if truths[0] is None or truths[1] is None:
        lacking = " and ".join(
            run.label for run, truth in zip((a, b), truths, strict=True) if truth is None
        )
        return page.note(
            f"No truth lies beside {lacking}: what differs can be told, what is right cannot."
        )
    found_a, found_b = (
        {(row.quantity, row.skin): row for row in truth_errors.of(side, truth)}
        for side, truth in ((pair.a, truths[0]), (pair.b, truths[1]))
    )
    rows = []
    for key, one in found_a.items():
        other = found_b.get(key)
        if other is None:
            continue
        apart = one.interval[1] < other.interval[0] or other.interval[1] < one.interval[0]
        known = np.isfinite([*one.interval, *other.interval]).all()
        rows.append(
            (
                one.quantity,
                one.skin,
                one.unit,
                one.error,
                other.error,
                other.error - one.error,
                ("yes" if apart else "no") if known else "not known",
                100 * one.coverage,
                100 * other.coverage,
            )
        )
    if not rows:
        return ""
    body = "<h3>Errors against the truths</h3>"
    if any(
        not np.array_equal(one.values, truths[1].maps[key].values)
        for key, one in truths[0].maps.items()
        if key in truths[1].maps
    ):
        body += page.note(
            "The truths differ, too: part of what differs between the maps is the skin's own."
        )
    return body + page.table(
        (
            "error",
            "skin",
            "unit",
            "A",
            "B",
            "difference",
            "68 % intervals apart",
            "68 % coverage % A",
            "B",
        ),
        rows,
        caption="Each against its own truth",
    )
