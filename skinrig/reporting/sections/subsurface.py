"""The report's section on a fibre probe: profiles with fits and residuals, sigma_tr by method."""

from __future__ import annotations

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
from skinrig.evaluating.subsurface import number, numbers
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
    yield from _anisotropy(appearance)
    yield from _sites(appearance)
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
            one = entry["channels"][channel]
            value, stderr = numbers(one["reflectance_per_mm2"]), numbers(one["stderr"])
            value = np.where(np.asarray(one["valid"], bool), value, np.nan)
            series.append(
                figures.Curve(
                    f"{channel}, measured",
                    radius,
                    value.tolist(),
                    stderr.tolist(),
                    line=False,
                    color=CHANNEL_COLORS[channel],
                )
            )
            for fit in [] if found is None else found["fits"]:
                if fit["channel"] != channel or fit["method"] != evaluation.RECOMMENDED_METHOD:
                    continue
                predicted = numbers(fit["predicted_per_mm2"])
                series.append(
                    figures.Curve(
                        f"{channel}, fit",
                        radius,
                        predicted.tolist(),
                        marks=False,
                        color=CHANNEL_COLORS[channel],
                    )
                )
        plots.append(
            figures.curves(
                f"{_words(entry)}: profile and photon-table fit",
                "distance from the source, mm",
                "reflectance, 1/mm²",
                series,
                log_y=True,
            )
        )
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
            series.append(
                figures.Curve(
                    METHOD_NAMES[fit["method"]],
                    radius,
                    left.tolist(),
                    (100.0 * stderr / np.where(told, value, np.nan)).tolist(),
                )
            )
    if not series:
        return []
    title = f"{_words(entry)}, {channel}: measured less fitted"
    return [figures.curves(title, "distance from the source, mm", "% of the fit", series)]


def _fits(appearance: SkinAppearance, truth: SkinAppearance | None) -> Iterator[page.Block]:
    fitted = evaluation.document_of(appearance, SUBSURFACE_FILE)
    if fitted is None:
        return
    known = evaluation.true_profiles(truth)
    rows = []
    for entry in fitted["measurements"]:
        true = known.get(entry["name"])
        for fit in entry["fits"]:
            real = float("nan")
            if true is not None:
                real = float(true["sigma_tr_per_mm"][CHANNEL_NAMES.index(fit["channel"])])
            found = number(fit["sigma_tr_per_mm"])
            low, high = numbers(fit["interval_per_mm"])
            rows.append(
                (
                    _words(entry),
                    fit["channel"],
                    METHOD_NAMES[fit["method"]],
                    real,
                    found,
                    f"{low:.3g} – {high:.3g}",
                    100 * (found / real - 1),
                    number(fit["sigma_a_per_mm"]),
                    number(fit["sigma_s_prime_per_mm"]),
                    number(fit["correlation"]),
                    number(fit["chi2"]),
                    fit["dof"],
                    sum(fit["used"]),
                    "yes" if fit["valid"] else fit["reason"] or "no",
                )
            )
    table = page.table(
        (
            "measurement",
            "channel",
            "method",
            "true sigma_tr, 1/mm",
            "sigma_tr",
            "68 % interval",
            "error, %",
            "sigma_a",
            "sigma_s'",
            "their correlation",
            "chi²",
            "degrees of freedom",
            "fibres",
            "valid",
        ),
        rows,
        caption="Every fit, with what it says of itself",
    )
    yield page.Heading("sigma_tr by method")
    yield page.note(
        "1/sigma_tr is the translucency: the smallest sigma_tr is the most translucent skin. The "
        "true sigma_tr of layers is that of the homogeneous medium whose profile fits best."
    )
    yield page.Folded(f"{len(rows)} fits", [table])


def _errors(
    name: str, appearance: SkinAppearance, truth: SkinAppearance, checks: list[page.Check]
) -> Iterator[page.Block]:
    rows = evaluation.compare_fits(appearance, truth)
    yield page.one_skin(truth.parameters)
    for kind in dict.fromkeys(row.kind for row in rows):
        found = evaluation.by_method([row for row in rows if row.kind == kind])
        yield page.Heading(f"Error of sigma_tr against the truth, {kind} tissue")
        yield page.records(
            found,
            (
                ("method", lambda row: METHOD_NAMES[row.method]),
                ("fits", lambda row: row.fits),
                ("median |error|, %", lambda row: 100 * row.median),
                ("worst, %", lambda row: 100 * row.worst),
                ("bias, %", lambda row: 100 * row.bias),
                ("68 % interval covers, %", lambda row: 100 * row.coverage),
            ),
            caption=f"By method, {kind} tissue",
        )
        yield from _by_channel([row for row in rows if row.kind == kind])
        best = next((row for row in found if row.method == evaluation.RECOMMENDED_METHOD), None)
        if kind == "homogeneous" and best is not None:
            for word, got, bound in (
                ("median", best.median, evaluation.MAX_MEDIAN_ERROR),
                ("worst", best.worst, evaluation.MAX_WORST_ERROR),
            ):
                checks.append(
                    page.Check(f"{name}: sigma_tr, {word} error", 100 * got, 100 * bound, "<=", "%")
                )
    profiles = evaluation.compare_profiles(appearance, truth)
    if profiles:
        yield page.Heading("Profiles against the truth")
        yield page.records(
            profiles,
            (
                ("measurement", lambda row: _words_of_name(row.name)),
                ("channel", lambda row: row.channel),
                ("fibres", lambda row: row.fibres),
                ("median |error|, %", lambda row: 100 * row.median),
                ("worst, %", lambda row: 100 * row.worst),
                ("68 % interval covers, %", lambda row: 100 * row.coverage),
            ),
            caption="Over fibres whose signal is ten times its standard error",
        )


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


def _anisotropy(appearance: SkinAppearance) -> Iterator[page.Block]:
    document = evaluation.document_of(appearance, ANISOTROPY_FILE)
    if document is None or not document["sites"]:
        return
    yield page.Heading("Dependence on direction")
    yield page.records(
        document["sites"],
        (
            ("site", lambda entry: entry["site"]),
            ("repeat", lambda entry: entry["repeat"]),
            ("channel", lambda entry: entry["channel"]),
            ("directions", lambda entry: entry["directions"]),
            ("ratio", lambda entry: number(entry["ratio"])),
            ("standard error", lambda entry: number(entry["ratio_stderr"])),
            ("axis, °", lambda entry: number(entry["axis_deg"])),
            ("standard error, °", lambda entry: number(entry["axis_stderr_deg"])),
            ("chance if isotropic", lambda entry: number(entry["p_value"])),
            (
                "one direction is off by up to, %",
                lambda entry: number(entry["worst_direction_percent"]),
            ),
            ("valid", lambda entry: "yes" if entry["valid"] else entry["reason"]),
        ),
        caption="sigma_tr along the long axis over that across it",
    )


def _sites(appearance: SkinAppearance) -> Iterator[page.Block]:
    fitted = evaluation.document_of(appearance, SUBSURFACE_FILE)
    if fitted is None or not fitted.get("sites"):
        return
    yield page.Heading("Sites")
    yield page.records(
        fitted["sites"],
        (
            ("site", lambda entry: entry["site"]),
            ("channel", lambda entry: entry["channel"]),
            ("measurements", lambda entry: entry["measurements"]),
            ("sigma_tr, 1/mm", lambda entry: number(entry["sigma_tr_per_mm"])),
            ("standard error", lambda entry: number(entry["sigma_tr_stderr"])),
            ("translucency, mm", lambda entry: number(entry["translucency_mm"])),
            ("standard error", lambda entry: number(entry["translucency_stderr_mm"])),
        ),
        caption="Mean of each site's measurements; translucency is 1/sigma_tr",
    )


def _map(appearance: SkinAppearance) -> Iterator[page.Block]:
    """Yield 1/sigma_tr over the face's texture, each channel beside its standard error."""
    found = appearance.maps.get("translucency")
    if found is None:
        return
    images = []
    for c, channel in enumerate(CHANNEL_NAMES):
        values = found.values[..., c]
        inside = values if found.valid is None else values[found.valid]
        if not inside.size:
            continue
        shown = [(f"translucency, {channel}", values, inside.min(), inside.max(), "viridis")]
        if found.stderr is not None:
            spread = found.stderr[..., c]
            shown.append(("standard error", spread, 0.0, spread.max(), "magma"))
        images += [
            map_images.scalar_image(
                title,
                drawn,
                low=float(low),
                high=float(high),
                scale=scale,
                valid=found.valid,
                unit="mm",
                width=WIDTH_PX,
            )
            for title, drawn, low, high, scale in shown
        ]
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
