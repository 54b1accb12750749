"""Build the comparison page of two runs: checks, maps and settings that differ."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skinrig.appearances.front_view import FrontView
from skinrig.reporting import first_screen, map_images, page, provenance
from skinrig.reporting.comparison import images as image_comparison
from skinrig.reporting.comparison import maps as comparison_maps
from skinrig.reporting.comparison import runs
from skinrig.reporting.comparison.maps import MapDifference
from skinrig.reporting.comparison.runs import ComparedRun, MapsPair, list_unpaired
from skinrig.reporting.map_names import map_heading, map_title, split_melanin_bands
from skinrig.unit_format import format_quantity

IMAGE_WIDTH_PX = 200
MAX_NAMED_MAPS = 10
"""Maps named in the lead."""
MAX_DRAWN_MAPS = 4
"""Maps of a pair that are drawn: those with the largest differences over their uncertainties."""
MAX_SHOWN_SIGMAS = 5.0
"""End of the scale of differences in combined standard uncertainties."""


def build_lead(a: ComparedRun, b: ComparedRun, found: Sequence[MapsPair]) -> Iterator[page.Block]:
    """Yield the verdict on the differences, and the checks of both runs."""
    rows = match_checks(a, b)
    changed = [row for row in rows if row.verdict_change]
    disagree = [(pair.name, one) for pair in found for one in pair.differences if one.disagree]
    compared = sum(bool(one.beyond) for pair in found for one in pair.differences)
    same = compared and not any(one.high > 0.0 for pair in found for one in pair.differences)
    verdicts = [pair.agreement for pair in found if pair.agreement is not None]
    sentences = [str(one) for one in verdicts]
    if rows:
        worse = sum(row.verdict_change == "worse" for row in changed)
        common = sum(row.a is not None and row.b is not None for row in rows)
        sentences.append(
            f"{len(changed)} of {common} checks changed their verdict"
            + (f", {worse} from kept to missed." if changed else ".")
        )
    if same:
        sentences.append(f"All {compared} maps with uncertainties are equal.")
    elif compared:
        sentences.append(f"{len(disagree)} of {compared} maps differ significantly.")
    drawn = image_comparison.summarize_images(a, b)
    if drawn:
        sentences.append(drawn)
    if not sentences:
        sentences.append("The runs have neither checks nor maps with uncertainties in common.")
    bad = any(row.verdict_change == "worse" for row in changed)
    bad = bad or not all(one.same for one in verdicts)
    yield page.Paragraph(" ".join(sentences), f"verdict {'bad' if bad else ''}")
    yield from first_screen.compare_first_screens(
        [(pair.name, pair.a, pair.b) for pair in found], (a.label, b.label)
    )
    yield page.Paragraph(
        f"{a.label} is {_format_run_path(a)}; {b.label} is {_format_run_path(b)}. Differences are"
        f" B minus A."
    )
    worst = sorted(disagree, key=lambda item: -item[1].beyond[-1])
    if worst:
        yield page.Heading("Largest differences", level=2)
        yield page.build_note(
            "Fraction of pixels with a difference above three combined standard uncertainties; "
            f"0.27 % is expected by chance. {min(len(worst), MAX_NAMED_MAPS)} of {len(worst)} maps."
        )
        yield page.Bullets(
            [f"{name}: {_describe_difference(one)}" for name, one in worst[:MAX_NAMED_MAPS]]
        )
    yield from build_check_table(a, b, rows)


def _describe_difference(difference: MapDifference) -> str:
    by = page.format_number(difference.median if difference.unit == "°" else difference.bias)
    return (
        f"{map_title(difference.name)}, median difference {format_quantity(by, difference.unit)}, "
        f"{100 * difference.beyond[-1]:.3g} % of pixels"
    )


def _format_run_path(run: ComparedRun) -> str:
    """Return the last two parts of the path of a run, as the rest is private."""
    return "/".join(run.path.resolve().parts[-2:])


def build_sections(
    a: ComparedRun, b: ComparedRun, found: Sequence[MapsPair]
) -> Iterator[page.Block]:
    """Yield maps, errors against ground truth, settings and times of both runs."""
    for pair in found:
        yield from _pair(a, b, pair)
    yield from runs.compare_benchmarks(a, b)
    yield from runs.compare_seconds(a, b)
    yield from runs.compare_calibrations(a, b)
    yield from image_comparison.section(a, b)
    if missing := list_unpaired(a, b):
        yield page.Heading("Only in one run", level=2)
        yield page.build_table(
            ("folder", "run"),
            missing,
            caption="Folders of maps or images without a partner of the same name",
        )
    yield from provenance.consent_section([a.found, b.found])


def _pair(a: ComparedRun, b: ComparedRun, pair: MapsPair) -> Iterator[page.Block]:
    yield page.Heading(f"Maps: {pair.name}", level=2)
    common = pair.a.inputs.get("session") == pair.b.inputs.get("session")
    if common and "session" in pair.a.inputs:
        yield page.build_note(
            "Both estimates are from the same frames. Differences are due to processing, and the "
            "combined standard uncertainties are too large because both share the noise."
        )
    yield from _agreement(pair)
    yield page.build_view("compared_maps", maps=sorted(pair.differences, key=_sort_key))
    if pair.refused:
        yield page.build_table(
            ("map", "reason"), pair.refused, caption="Maps that were not subtracted"
        )
    yield from _images(a, b, pair)
    yield from _by_band(pair)
    yield from _errors(a, b, pair)
    yield from runs.compare_settings(a, b, pair)


def _agreement(pair: MapsPair) -> Iterator[page.Block]:
    """Yield the table behind the verdict on person and state."""
    if pair.agreement is None:
        yield page.build_note(f"No verdict on person and state: {pair.not_agreed}.")
        return
    rows = [
        (
            one.name,
            f"{one.change:+.3g} {one.unit if one.unit != '1' else ''}".strip(),
            one.place,
            one.sigmas,
            one.ratio,
            one.p_value,
            "yes" if one.changed else "no",
        )
        for one in pair.agreement.quantities
    ]
    optics = "the same" if pair.agreement.shared_optics else "different"
    yield page.Heading("Same person, same state?")
    yield page.build_table(
        (
            "quantity",
            "largest change",
            "where",
            "in standard uncertainties",
            "rms difference over the stated",
            "p-value",
            "changed",
        ),
        rows,
        caption=f"Samples are paired {pair.agreement.registered}; camera and light are {optics}",
    )


def _sort_key(difference: MapDifference) -> tuple[float, str]:
    return (-difference.beyond[-1] if difference.beyond else 1.0, difference.name)


def _images(a: ComparedRun, b: ComparedRun, pair: MapsPair) -> Iterator[page.Block]:
    """Yield A | B | difference | difference over the combined standard uncertainty."""
    known = [one for one in pair.differences if one.sigmas is not None and one.name != "position"]
    order = sorted((one for one in known if one.high > 0.0), key=_sort_key)
    for one in order[:MAX_DRAWN_MAPS]:
        yield page.Heading(map_heading(one.name))
        yield page.Images(list(_difference_images(a, b, pair, one)))
    if len(order) > MAX_DRAWN_MAPS:
        names = "; ".join(map_title(one.name) for one in order[MAX_DRAWN_MAPS:])
        yield page.build_note(f"Maps with smaller differences are not drawn: {names}.")


def _difference_images(
    a: ComparedRun, b: ComparedRun, pair: MapsPair, difference: MapDifference
) -> Iterator[page.Image]:
    maps = pair.a.maps[difference.name], pair.b.maps[difference.name]
    both = ~np.isnan(difference.difference)
    place = pair.a.maps.get("position")

    def laid(values: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return values as an image, projected to the front for a mesh."""
        if place is None:
            return np.nan_to_num(values), both
        rows, columns = np.nonzero(both & place.mask)
        points = place.values[rows, columns].astype(np.float64)
        view = FrontView.of(points, (points.min(axis=0), points.max(axis=0)))
        return view.rasterize(np.nan_to_num(values[rows, columns].astype(np.float64)))

    if not both.any():
        return
    values = np.concatenate([m.values[both].ravel() for m in maps]).astype(np.float64)
    low, high = np.percentile(values[np.isfinite(values)], [1, 99])
    for label, skin_map in zip((a.label, b.label), maps, strict=True):
        image, mask = laid(skin_map.values)
        shown = map_images.MapDrawing(
            map_title(difference.name), difference.unit, mask, IMAGE_WIDTH_PX
        )
        if difference.unit == "°":
            yield shown.normals(label, image)
        elif image.ndim == 3:
            yield map_images.draw_color_image(
                label,
                np.where(mask[..., None], image, 0.2),
                width=IMAGE_WIDTH_PX,
                of=map_title(difference.name),
            )
        else:
            yield shown.draw_scalar(label, image, low, high)
    image, mask = laid(difference.difference)
    reach = map_images.compute_percentile_reach(image, mask, 98) or 1.0
    drawing = map_images.MapDrawing(
        map_title(difference.name), difference.unit, mask, IMAGE_WIDTH_PX
    )
    if difference.unit == "°":
        yield drawing.size("angle between them", image, reach)
    else:
        yield drawing.draw_signed("B − A", image, reach)
    if difference.sigmas is not None:
        image, mask = laid(difference.sigmas)
        drawing = map_images.MapDrawing(
            f"{map_title(difference.name)}, difference", "", mask, IMAGE_WIDTH_PX
        )
        draw = drawing.size if difference.unit == "°" else drawing.draw_signed
        yield draw("in combined standard uncertainties", image, MAX_SHOWN_SIGMAS)


def _by_band(pair: MapsPair) -> Iterator[page.Block]:
    """Yield differences of chromophores by band of the mean melanin of both."""
    melanin = [side.maps.get("melanin") for side in (pair.a, pair.b)]
    if melanin[0] is None or melanin[1] is None:
        return
    if melanin[0].values.shape != melanin[1].values.shape:
        return
    level = 0.5 * (melanin[0].values + melanin[1].values)
    rows: list[tuple[object, ...]] = []
    for one in pair.differences:
        if one.sigmas is None or one.difference.shape != level.shape:
            continue
        known = ~np.isnan(one.difference) & ~np.isnan(one.sigmas)
        for band, inside in split_melanin_bands(level, known):
            off, sigmas = one.difference[inside], np.abs(one.sigmas[inside])
            rows.append((map_title(one.name), band, one.unit, off, sigmas))
    if rows:
        yield page.build_view("compared_bands", bands=rows)


def _errors(a: ComparedRun, b: ComparedRun, pair: MapsPair) -> Iterator[page.Block]:
    """Yield errors of both against ground truth, where both are given."""
    truths = a.found.find_truth(pair.a), b.found.find_truth(pair.b)
    if truths[0] is None or truths[1] is None:
        lacking = " and ".join(
            run.label for run, truth in zip((a, b), truths, strict=True) if truth is None
        )
        yield page.build_note(f"No ground truth is given for {lacking}; errors are unknown.")
        return
    found_a, found_b = (
        {(row.quantity, row.skin): row for row in comparison_maps.list_truth_errors(side, truth)}
        for side, truth in ((pair.a, truths[0]), (pair.b, truths[1]))
    )
    rows = [(one, found_b[key]) for key, one in found_a.items() if key in found_b]
    if not rows:
        return
    differ = any(
        not np.array_equal(one.values, truths[1].maps[key].values)
        for key, one in truths[0].maps.items()
        if key in truths[1].maps
    )
    yield page.build_view("compared_errors", errors=rows, truths_differ=differ)


@dataclass(frozen=True, slots=True)
class CheckRow:
    """A check of one or both runs."""

    name: str
    a: page.Check | None
    b: page.Check | None

    @property
    def verdict_change(self) -> str:
        """Return "better" or "worse" where the verdict changed."""
        if self.a is None or self.b is None or self.a.passed == self.b.passed:
            return ""
        return "better" if self.b.passed else "worse"

    @property
    def describe_outcome(self) -> str:
        """Change of the verdict, in words."""
        return self.verdict_change or ("no" if self.a and self.b else "only in one run")

    @property
    def difference(self) -> float:
        """Value of B minus that of A; NaN where one is missing."""
        return float("nan") if self.a is None or self.b is None else self.b.got - self.a.got


def match_checks(a: ComparedRun, b: ComparedRun) -> list[CheckRow]:
    """Return the checks of two runs by name, verdicts that changed first."""
    by_a = {_common_name(check, a, b): check for check in a.checks}
    by_b = {_common_name(check, b, a): check for check in b.checks}
    rows = [CheckRow(name, by_a.get(name), by_b.get(name)) for name in {**by_a, **by_b}]
    return sorted(
        rows, key=lambda row: (row.verdict_change != "worse", row.verdict_change != "better")
    )


def _common_name(check: page.Check, run: ComparedRun, other_run: ComparedRun) -> str:
    """Return the name of a check, without folder names that differ."""
    name = check.name
    if len(run.appearances) == len(other_run.appearances) == 1:
        name = name.removeprefix(f"{next(iter(run.appearances))}: ")
    if len(run.found.pictures) == len(other_run.found.pictures) == 1:
        name = name.removeprefix(f"{run.found.pictures[0].name}: ")
    return name


def build_check_table(
    a: ComparedRun, b: ComparedRun, rows: Sequence[CheckRow]
) -> Iterator[page.Block]:
    """Yield the section on checks of both; empty without any."""
    if not rows:
        return

    def measured(check: page.Check | None) -> str:
        if check is None:
            return "not checked"
        return format_quantity(page.format_number(check.got), check.unit) + (
            ", kept" if check.passed else ", missed"
        )

    def limit(row: CheckRow) -> str:
        bounds = [
            f"{'≤' if check.sense == '<=' else '≥'} "
            f"{format_quantity(page.format_number(check.bound), check.unit)}"
            for check in (row.a, row.b)
            if check is not None
        ]
        return " and ".join(dict.fromkeys(bounds))

    yield page.Heading("Checks of both runs", level=2)
    yield page.build_table(
        ("check", a.label, b.label, "difference", "limit", "changed"),
        [
            (
                row.name,
                measured(row.a),
                measured(row.b),
                row.difference,
                limit(row),
                row.describe_outcome,
            )
            for row in rows
        ],
        caption="Changed verdicts first; limits that depend on a Cramér-Rao bound may differ",
    )
