"""Report section on a fiber probe: profiles with fits and residuals, sigma_tr by method."""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from model import store
from model.skin import SkinAppearance
from model.translucency_population import PopulationTable, summarize, weyrich_2005
from reconstruction.pipeline.probe.stages import (
    ANISOTROPY_FILE,
    CHANNEL_NAMES,
    PROFILE_FILE,
    SUBSURFACE_FILE,
)
from skinrig.drawing import figures
from skinrig.evaluating import subsurface as evaluation
from skinrig.evaluating.subsurface import parse_numbers, read_document, site_measurements
from skinrig.reporting import map_images, page

WIDTH_PX = 200
MAX_PLOTTED_MEASUREMENTS = 3
"""Measurements drawn; the tables list all."""
CHANNEL_COLORS = {"red": "#c8402f", "green": "#3f8f4f", "blue": "#2a78b8"}
_MEASUREMENT_NAME = re.compile(r"(.+)_r(\d+)_a(\d+\.\d)")
"""Of a measurement in documents: site, repeat, angle in degrees."""
METHOD_NAMES = {"photon_table": "photon table", "diffusion": "diffusion", "dipole": "dipole"}


def is_probe(appearance: SkinAppearance) -> bool:
    """Return whether an appearance has profiles of a fiber probe."""
    return PROFILE_FILE in appearance.files or SUBSURFACE_FILE in appearance.files


def section(subject: page.ReportedAppearance) -> Iterator[page.Block]:
    """Yield profiles with fits and residuals, sigma_tr by method, and their errors.

    Parameters
    ----------
    subject
        With the documents of `reconstruction.pipeline.probe.stages`.
        Its truth is of the same session; None: uncertainties only.
    """
    appearance = subject.appearance
    yield from _plots(appearance)
    yield from _fits(appearance, subject.truth)
    yield from _errors(subject)
    anisotropy = evaluation.read_document(appearance, ANISOTROPY_FILE)
    if anisotropy is not None and anisotropy["sites"]:
        yield page.build_view("anisotropy", sites=anisotropy["sites"])
    fitted = evaluation.read_document(appearance, SUBSURFACE_FILE)
    if fitted is not None and fitted.get("sites"):
        yield page.build_view("sites", sites=fitted["sites"])
    if is_homogeneous(subject.truth):
        if "translucency" in appearance.maps:
            yield page.build_note("A homogeneous medium has no map over a face; none is drawn.")
    else:
        yield from _map(appearance)


def _plots(appearance: SkinAppearance) -> Iterator[page.Block]:
    measured = evaluation.read_document(appearance, PROFILE_FILE)
    if measured is None:
        return
    fits = _fits_by_name(appearance)
    radius = measured["radius_mm"]
    plots = []
    for entry in _first_per_site(measured["measurements"])[:MAX_PLOTTED_MEASUREMENTS]:
        found = fits.get(entry["name"])
        title = f"{_words(entry)}: profile and photon-table fit"
        plots.append(_profile(title, entry, found, radius))
        plots += _residuals(entry, found, radius)
    yield page.Heading("Radial profiles")
    yield page.Plots(plots)


def draw_first_profile(appearance: SkinAppearance) -> str:
    """Return the plot of a probe's first radial profile as SVG; empty without profiles."""
    measured = evaluation.read_document(appearance, PROFILE_FILE)
    if measured is None or not measured["measurements"]:
        return ""
    entry = measured["measurements"][0]
    found = _fits_by_name(appearance).get(entry["name"])
    return _profile(_words(entry), entry, found, measured["radius_mm"])


def _fits_by_name(appearance: SkinAppearance) -> Mapping[str, Mapping[str, Any]]:
    fitted = evaluation.read_document(appearance, SUBSURFACE_FILE)
    return {} if fitted is None else {entry["name"]: entry for entry in fitted["measurements"]}


def _profile(
    title: str, entry: Mapping[str, Any], found: Mapping[str, Any] | None, radius: Sequence[float]
) -> str:
    """Draw the measured profile of each channel and its fit by the recommended method."""
    series = []
    for channel in CHANNEL_NAMES:
        one, color = entry["channels"][channel], CHANNEL_COLORS[channel]
        value, stderr = parse_numbers(one["reflectance_per_mm2"]), parse_numbers(one["stderr"])
        value = np.where(np.asarray(one["valid"], bool), value, np.nan)
        name = f"{channel}, measured"
        series.append(figures.PlotSeries(name, radius, value, stderr, line=False, color=color))
        for fit in [] if found is None else found["fits"]:
            if fit["channel"] == channel and fit["method"] == evaluation.RECOMMENDED_METHOD:
                predicted, name = parse_numbers(fit["predicted_per_mm2"]), f"{channel}, fit"
                series.append(figures.PlotSeries(name, radius, predicted, marks=False, color=color))
    axes = "distance from the source, mm", "reflectance, 1/mm²"
    return figures.draw_curves(title, *axes, series, log_y=True)


def _residuals(
    entry: Mapping[str, Any], found: Mapping[str, Any] | None, radius: Sequence[float]
) -> list[str]:
    """Draw the residuals of each method in the green channel, in percent."""
    channel = "green"
    one = entry["channels"][channel]
    value, stderr = parse_numbers(one["reflectance_per_mm2"]), parse_numbers(one["stderr"])
    clear = np.asarray(one["valid"], bool) & (value > evaluation.MIN_SIGNAL_TO_NOISE * stderr)
    series = []
    for fit in [] if found is None else found["fits"]:
        if fit["channel"] == channel and fit["valid"]:
            left = 100.0 * np.where(
                clear, value / parse_numbers(fit["predicted_per_mm2"]) - 1.0, np.nan
            )
            spread = 100.0 * stderr / np.where(clear, value, np.nan)
            series.append(figures.PlotSeries(METHOD_NAMES[fit["method"]], radius, left, spread))
    if not series:
        return []
    title = f"{_words(entry)}, {channel}: measured minus fitted"
    return [figures.draw_curves(title, "distance from the source, mm", "% of the fit", series)]


def _fits(appearance: SkinAppearance, truth: SkinAppearance | None) -> Iterator[page.Block]:
    fitted = evaluation.read_document(appearance, SUBSURFACE_FILE)
    if fitted is None:
        return
    true = {
        (name, channel): float(one["sigma_tr_per_mm"][c])
        for name, one in evaluation.true_profiles(truth).items()
        for c, channel in enumerate(CHANNEL_NAMES)
    }
    fits = [
        (entry["name"], _words(entry), fit)
        for entry in fitted["measurements"]
        for fit in entry["fits"]
    ]
    yield page.build_view("fits", fits=fits, truths=true, methods=METHOD_NAMES)


def _errors(subject: page.ReportedAppearance) -> Iterator[page.Block]:
    appearance, truth = subject.appearance, subject.truth
    if truth is None:
        return
    rows = evaluation.compare_fits(appearance, truth)
    yield page.build_single_subject_note(truth.parameters)
    for kind in dict.fromkeys(row.kind for row in rows):
        found = evaluation.summarize_methods([row for row in rows if row.kind == kind])
        yield page.Heading(f"Error of sigma_tr against the ground truth, {kind} tissue")
        yield page.build_view("methods", errors=found, methods=METHOD_NAMES, kind=kind)
        yield from _by_channel([row for row in rows if row.kind == kind])
        best = next((row for row in found if row.method == evaluation.RECOMMENDED_METHOD), None)
        if kind == "homogeneous" and best is not None:
            for word, got, bound in (
                ("median", best.median, evaluation.MAX_MEDIAN_ERROR),
                ("largest", best.worst, evaluation.MAX_WORST_ERROR),
            ):
                subject.check_fraction(f"sigma_tr, {word} error", got, bound)
    if profiles := evaluation.compare_profiles(appearance, truth):
        yield page.build_view("profiles", errors=profiles, measurement=_words_of_name)


def _by_channel(rows: Sequence[evaluation.FitAccuracy]) -> Iterator[page.Block]:
    labels = [f"{name}, {c}" for name in dict.fromkeys(r.name for r in rows) for c in CHANNEL_NAMES]
    if len(labels) > 4 * len(CHANNEL_NAMES):
        return
    series = {}
    for method, words in METHOD_NAMES.items():
        errors = {f"{r.name}, {r.channel}": r.relative for r in rows if r.method == method}
        series[words] = [100.0 * errors.get(label, float("nan")) for label in labels]
    parts = [label.rpartition(", ") for label in labels]
    short = [f"{_words_of_name(name)}\n{channel}" for name, _, channel in parts]
    yield page.Plots([figures.draw_bars("error of sigma_tr", short, series, unit="%")])


def is_homogeneous(truth: SkinAppearance | None) -> bool:
    """Return whether a ground truth is that of homogeneous media only."""
    kinds = {str(one["kind"]) for one in evaluation.true_profiles(truth).values()}
    return kinds == {"homogeneous"}


def _map(appearance: SkinAppearance) -> Iterator[page.Block]:
    """Yield the diffuse mean free path over the face texture, with its uncertainty."""
    found = appearance.maps.get("translucency")
    if found is None:
        return
    images = []
    drawing = map_images.MapDrawing("", "mm", found.valid, WIDTH_PX)
    for c, channel in enumerate(CHANNEL_NAMES):
        values = found.values[..., c]
        inside = values[found.mask]
        if not inside.size:
            continue
        low, high = float(inside.min()), float(inside.max())
        images.append(drawing.draw_scalar(f"diffuse mean free path, {channel}", values, low, high))
        if found.stderr is not None:
            spread = found.stderr[..., c]
            images.append(drawing.size("standard uncertainty", spread, float(spread.max())))
    yield page.Heading("Map of the diffuse mean free path")
    yield page.build_note(
        "1/sigma_tr over the face texture, interpolated between the measured sites by kriging. "
        "Far from the sites, the uncertainty is the variation between people."
    )
    yield page.Images(images)


def _first_per_site(measurements: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    first: dict[str, Mapping[str, Any]] = {}
    for entry in measurements:
        first.setdefault(entry["site"], entry)
    return list(first.values())


def _words_of_name(name: str) -> str:
    """Return the label of a measurement, from its name in documents.

    Examples
    --------
    >>> _words_of_name("forehead_r0_a000.0"), _words_of_name("cheek_r1_a022.5")
    ('forehead', 'cheek, repeat 1, 22.5°')
    >>> _words_of_name("cheek, as published")
    'cheek, as published'
    """
    found = _MEASUREMENT_NAME.fullmatch(name)
    if found is None:
        return name
    site, repeat, angle = found.groups()
    return _words({"site": site, "repeat": int(repeat), "angle_deg": float(angle)})


def _words(entry: Mapping[str, Any]) -> str:
    """Return the label of a measurement.

    Examples
    --------
    >>> _words({"site": "cheek", "repeat": 1, "angle_deg": 22.5})
    'cheek, repeat 1, 22.5°'
    """
    words = str(entry["site"])
    if entry["repeat"]:
        words += f", repeat {entry['repeat']}"
    if entry["angle_deg"]:
        words += f", {entry['angle_deg']:g}°"
    return words


MEDIUM_PREFIXES = ("homogeneous:", "anisotropic:")
"""Prefixes of the names of simulated media."""


def compare_people(
    appearances: Mapping[str, SkinAppearance], truths: Mapping[str, Path] | None = None
) -> Iterator[page.Block]:
    """Yield the tables of sigma_tr over people; empty where nobody's skin was probed.

    Parameters
    ----------
    appearances
        By name; each with fits of a fiber probe counts as a person, unless its ground truth is
        a medium.
    truths
        Folders of ground truths by name.
    """
    people = {
        name: fits
        for name, appearance in appearances.items()
        if (fits := read_document(appearance, SUBSURFACE_FILE)) is not None
        and not _is_medium(appearance, truths or {})
    }
    if not people:
        return
    published = weyrich_2005()
    yield page.Heading("sigma_tr by person, 1/mm", level=2)
    yield page.build_note(
        "Standard deviations are over people. The second column of the published table has the "
        "heading “Var.”. Variances would contradict the published extremes, so these values are "
        "used as standard deviations."
    )
    rows: list[tuple[object, ...]] = []
    for c, channel in enumerate(CHANNEL_NAMES):
        pairs = zip(published.mean_per_mm[:, c], published.deviation_per_mm[:, c], strict=True)
        cells = (float(one) for pair in pairs for one in pair)
        rows.append(("published (Weyrich et al. 2005, table 2)", channel, *cells))
    measured = [one for name, fits in people.items() for one in site_measurements(name, fits)]
    if measured:
        found = summarize(measured)
        many = "session" if len(people) == 1 else "sessions"
        rows += _people_rows(f"this report, {len(people)} {many}", found, published.sites)
    columns = [f"{site}, {word}" for site in published.sites for word in ("mean", "deviation")]
    head = ("population", "channel", *columns)
    yield page.build_table(
        head, rows, caption="Mean and standard deviation over people, red, green and blue light"
    )


def _is_medium(appearance: SkinAppearance, truths: Mapping[str, Path]) -> bool:
    """Return whether an appearance is of a simulated medium."""
    folder = truths.get(str(appearance.parameters.get("truth", "")))
    if folder is None:
        return False
    subject = str(store.read_document(folder).parameters.get("subject", ""))
    return subject.startswith(MEDIUM_PREFIXES)


def _people_rows(
    who: str, found: PopulationTable, sites: tuple[str, ...]
) -> list[tuple[object, ...]]:
    rows: list[tuple[object, ...]] = []
    for c, channel in enumerate(found.channels):
        row: list[object] = [who, channel]
        for site in sites:
            s = found.sites.index(site) if site in found.sites else None
            count = 0 if s is None else int(found.count[s, c])
            row.append(float(found.mean_per_mm[s, c]) if count else float("nan"))
            row.append(float(found.deviation_per_mm[s, c]) if count > 1 else float("nan"))
        rows.append(tuple(row))
    return rows
