"""The report's section on a fibre probe: profiles with fits and residuals, sigma_tr by method."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from model.skin import SkinAppearance
from reconstruction.pipeline.probe.stages import (
    ANISOTROPY_FILE,
    CHANNEL_NAMES,
    PROFILE_FILE,
    SUBSURFACE_FILE,
)
from skinrig.drawing import figures
from skinrig.evaluating import subsurface as evaluation
from skinrig.evaluating.subsurface import numbers
from skinrig.reporting import map_images, page

WIDTH_PX = 200
MAX_PLOTTED_MEASUREMENTS = 3
"""Measurements drawn; the tables list all."""
CHANNEL_COLORS = {"red": "#c8402f", "green": "#3f8f4f", "blue": "#2a78b8"}
_MEASUREMENT_NAME = re.compile(r"(.+)_r(\d+)_a(\d+\.\d)")
"""Of a measurement in documents: site, repeat, angle in degrees."""
METHOD_NAMES = {"photon_table": "photon table", "diffusion": "diffusion", "dipole": "dipole"}


def is_probe(appearance: SkinAppearance) -> bool:
    """Return whether an appearance holds profiles of a fibre probe."""
    return PROFILE_FILE in appearance.files or SUBSURFACE_FILE in appearance.files


def section(
    name: str, appearance: SkinAppearance, truth: SkinAppearance | None, checks: list[page.Check]
) -> Iterator[page.Block]:
    """Yield profiles with fits and residuals, sigma_tr by method, and their errors.

    Parameters
    ----------
    name
        For headings.
    appearance
        With the documents of `reconstruction.pipeline.probe.stages`.
    truth
        Of the same session; None: standard errors only.
    checks
        Judgements are added to it.
    """
    yield from _plots(appearance)
    yield from _fits(appearance, truth)
    if truth is not None:
        yield from _errors(name, appearance, truth, checks)
    anisotropy = evaluation.document_of(appearance, ANISOTROPY_FILE)
    if anisotropy is not None and anisotropy["sites"]:
        yield page.view("anisotropy", sites=anisotropy["sites"])
    fitted = evaluation.document_of(appearance, SUBSURFACE_FILE)
    if fitted is not None and fitted.get("sites"):
        yield page.view("sites", sites=fitted["sites"])
    yield from _map(appearance)


def _plots(appearance: SkinAppearance) -> Iterator[page.Block]:
    measured = evaluation.document_of(appearance, PROFILE_FILE)
    fitted = evaluation.document_of(appearance, SUBSURFACE_FILE)
    if measured is None:
        return
    by_name = {} if fitted is None else {entry["name"]: entry for entry in fitted["measurements"]}
    radius = measured["radius_mm"]
    plots = []
    for entry in _one_of_each_site(measured["measurements"])[:MAX_PLOTTED_MEASUREMENTS]:
        found = by_name.get(entry["name"])
        series = []
        for channel in CHANNEL_NAMES:
            one, color = entry["channels"][channel], CHANNEL_COLORS[channel]
            value, stderr = numbers(one["reflectance_per_mm2"]), numbers(one["stderr"])
            value = np.where(np.asarray(one["valid"], bool), value, np.nan)
            name = f"{channel}, measured"
            series.append(figures.Curve(name, radius, value, stderr, line=False, color=color))
            for fit in [] if found is None else found["fits"]:
                if fit["channel"] == channel and fit["method"] == evaluation.RECOMMENDED_METHOD:
                    predicted, name = numbers(fit["predicted_per_mm2"]), f"{channel}, fit"
                    series.append(figures.Curve(name, radius, predicted, marks=False, color=color))
        title = f"{_words(entry)}: profile and photon-table fit"
        axes = "distance from the source, mm", "reflectance, 1/mm²"
        plots.append(figures.curves(title, *axes, series, log_y=True))
        plots += _residuals(entry, found, radius)
    yield page.Heading("Radial profiles")
    yield page.Plots(plots)


def _residuals(
    entry: Mapping[str, Any], found: Mapping[str, Any] | None, radius: Sequence[float]
) -> list[str]:
    """Draw what each method leaves of the green channel, in percent of the reading."""
    channel = "green"
    one = entry["channels"][channel]
    value, stderr = numbers(one["reflectance_per_mm2"]), numbers(one["stderr"])
    told = np.asarray(one["valid"], bool) & (value > evaluation.MIN_SIGNAL_TO_NOISE * stderr)
    series = []
    for fit in [] if found is None else found["fits"]:
        if fit["channel"] == channel and fit["valid"]:
            left = 100.0 * np.where(told, value / numbers(fit["predicted_per_mm2"]) - 1.0, np.nan)
            spread = 100.0 * stderr / np.where(told, value, np.nan)
            series.append(figures.Curve(METHOD_NAMES[fit["method"]], radius, left, spread))
    if not series:
        return []
    title = f"{_words(entry)}, {channel}: measured less fitted"
    return [figures.curves(title, "distance from the source, mm", "% of the fit", series)]


def _fits(appearance: SkinAppearance, truth: SkinAppearance | None) -> Iterator[page.Block]:
    fitted = evaluation.document_of(appearance, SUBSURFACE_FILE)
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
    yield page.view("fits", fits=fits, truths=true, methods=METHOD_NAMES)


def _errors(
    name: str, appearance: SkinAppearance, truth: SkinAppearance, checks: list[page.Check]
) -> Iterator[page.Block]:
    rows = evaluation.compare_fits(appearance, truth)
    yield page.one_skin(truth.parameters)
    for kind in dict.fromkeys(row.kind for row in rows):
        found = evaluation.by_method([row for row in rows if row.kind == kind])
        yield page.Heading(f"Error of sigma_tr against the truth, {kind} tissue")
        yield page.view("methods", errors=found, methods=METHOD_NAMES, kind=kind)
        yield from _by_channel([row for row in rows if row.kind == kind])
        best = next((row for row in found if row.method == evaluation.RECOMMENDED_METHOD), None)
        if kind == "homogeneous" and best is not None:
            for word, got, bound in (
                ("median", best.median, evaluation.MAX_MEDIAN_ERROR),
                ("worst", best.worst, evaluation.MAX_WORST_ERROR),
            ):
                checks.append(page.Check.of_shares(f"{name}: sigma_tr, {word} error", got, bound))
    if profiles := evaluation.compare_profiles(appearance, truth):
        yield page.view("profiles", errors=profiles, measurement=_words_of_name)


def _by_channel(rows: Sequence[evaluation.FitError]) -> Iterator[page.Block]:
    labels = [f"{name}, {c}" for name in dict.fromkeys(r.name for r in rows) for c in CHANNEL_NAMES]
    if len(labels) > 4 * len(CHANNEL_NAMES):
        return
    series = {}
    for method, words in METHOD_NAMES.items():
        errors = {f"{r.name}, {r.channel}": r.relative for r in rows if r.method == method}
        series[words] = [100.0 * errors.get(label, float("nan")) for label in labels]
    parts = [label.rpartition(", ") for label in labels]
    short = [f"{_words_of_name(name)}\n{channel}" for name, _, channel in parts]
    yield page.Plots([figures.bars("error of sigma_tr", short, series, unit="%")])


def _map(appearance: SkinAppearance) -> Iterator[page.Block]:
    """Yield 1/sigma_tr over the face's texture, each channel beside its standard error."""
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
        images.append(drawing.scalar(f"translucency, {channel}", values, low, high))
        if found.stderr is not None:
            spread = found.stderr[..., c]
            images.append(drawing.size("standard error", spread, float(spread.max())))
    yield page.Heading("Translucency map")
    yield page.note(
        "1/sigma_tr over the face's texture, between the measured sites by kriging; away from "
        "them the error grows to what people differ by."
    )
    yield page.Images(images)


def _one_of_each_site(measurements: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    first: dict[str, Mapping[str, Any]] = {}
    for entry in measurements:
        first.setdefault(entry["site"], entry)
    return list(first.values())


def _words_of_name(name: str) -> str:
    """Return a measurement in words, from its name in documents.

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
    """Return a measurement in words.

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
