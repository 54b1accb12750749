"""The report's section on a fibre probe: profiles with fits and residuals, sigma_tr by method."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
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
from skinrig.reporting import map_images as map_pictures
from skinrig.reporting import page

WIDTH_PX = 200
SHOWN = 3
"""Measurements drawn; the tables list all."""
COLORS = {"red": "#c8402f", "green": "#3f8f4f", "blue": "#2a78b8"}
_NAME = re.compile(r"(.+)_r(\d+)_a(\d+\.\d)")
"""Of a measurement in documents: site, repeat, angle in degrees."""
METHOD_NAMES = {"photon_table": "photon table", "diffusion": "diffusion", "dipole": "dipole"}


def is_probe(appearance: SkinAppearance) -> bool:
    """Return whether an appearance holds profiles of a fibre probe."""
    return PROFILE_FILE in appearance.files or SUBSURFACE_FILE in appearance.files


def section(
    name: str, appearance: SkinAppearance, truth: SkinAppearance | None, checks: list[page.Check]
) -> str:
    """Return profiles with fits and residuals, sigma_tr by method, and their errors.

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
    body = _plots(appearance)
    body += _fits(appearance, truth)
    if truth is not None:
        body += _errors(name, appearance, truth, checks)
    body += _anisotropy(appearance)
    body += _sites(appearance)
    body += _map(appearance)
    return body


def _plots(appearance: SkinAppearance) -> str:
    measured = evaluation.document_of(appearance, PROFILE_FILE)
    fitted = evaluation.document_of(appearance, SUBSURFACE_FILE)
    if measured is None:
        return ""
    by_name = {} if fitted is None else {entry["name"]: entry for entry in fitted["measurements"]}
    radius = measured["radius_mm"]
    plots = ""
    for entry in _one_of_each_site(measured["measurements"])[:SHOWN]:
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
                    color=COLORS[channel],
                )
            )
            for fit in [] if found is None else found["fits"]:
                if fit["channel"] != channel or fit["method"] != evaluation.RECOMMENDED:
                    continue
                predicted = numbers(fit["predicted_per_mm2"])
                series.append(
                    figures.Curve(
                        f"{channel}, fit",
                        radius,
                        predicted.tolist(),
                        marks=False,
                        color=COLORS[channel],
                    )
                )
        plots += figures.curves(
            f"{_words(entry)}: profile and photon-table fit",
            "distance from the source, mm",
            "reflectance, 1/mm²",
            series,
            log_y=True,
        )
        plots += _residuals(entry, found, radius)
    return f"<h3>Radial profiles</h3><div class='plots'>{plots}</div>"


def _residuals(
    entry: Mapping[str, Any], found: Mapping[str, Any] | None, radius: Sequence[float]
) -> str:
    """Draw what each method leaves of the green channel, in percent of the reading."""
    channel = "green"
    one = entry["channels"][channel]
    value, stderr = numbers(one["reflectance_per_mm2"]), numbers(one["stderr"])
    told = np.asarray(one["valid"], bool) & (value > evaluation.SIGNAL_TO_NOISE * stderr)
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
        return ""
    return figures.curves(
        f"{_words(entry)}, {channel}: measured less fitted",
        "distance from the source, mm",
        "% of the fit",
        series,
    )


def _fits(appearance: SkinAppearance, truth: SkinAppearance | None) -> str:
    fitted = evaluation.document_of(appearance, SUBSURFACE_FILE)
    if fitted is None:
        return ""
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
    note = page.note(
        "1/sigma_tr is the translucency: the smallest sigma_tr is the most translucent skin. The "
        "true sigma_tr of layers is that of the homogeneous medium whose profile fits best."
    )
    return f"<h3>sigma_tr by method</h3>{note}" + page.folded(f"{len(rows)} fits", table)


def _errors(
    name: str, appearance: SkinAppearance, truth: SkinAppearance, checks: list[page.Check]
) -> str:
    rows = evaluation.compare_fits(appearance, truth)
    body = page.one_skin(truth.parameters)
    for kind in dict.fromkeys(row.kind for row in rows):
        found = evaluation.by_method([row for row in rows if row.kind == kind])
        body += f"<h3>Error of sigma_tr against the truth, {page.escape(kind)} tissue</h3>"
        body += page.table(
            (
                "method",
                "fits",
                "median |error|, %",
                "worst, %",
                "bias, %",
                "68 % interval covers, %",
            ),
            [
                (
                    METHOD_NAMES[row.method],
                    row.fits,
                    100 * row.median,
                    100 * row.worst,
                    100 * row.bias,
                    100 * row.coverage,
                )
                for row in found
            ],
            caption=f"By method, {kind} tissue",
        )
        body += _by_channel([row for row in rows if row.kind == kind])
        best = next((row for row in found if row.method == evaluation.RECOMMENDED), None)
        if kind == "homogeneous" and best is not None:
            for word, got, bound in (
                ("median", best.median, evaluation.MEDIAN_LIMIT),
                ("worst", best.worst, evaluation.WORST_LIMIT),
            ):
                checks.append(
                    page.Check(f"{name}: sigma_tr, {word} error", 100 * got, 100 * bound, "<=", "%")
                )
    profiles = evaluation.compare_profiles(appearance, truth)
    if profiles:
        body += "<h3>Profiles against the truth</h3>" + page.table(
            (
                "measurement",
                "channel",
                "fibres",
                "median |error|, %",
                "worst, %",
                "68 % interval covers, %",
            ),
            [
                (
                    _words_of_name(row.name),
                    row.channel,
                    row.fibres,
                    100 * row.median,
                    100 * row.worst,
                    100 * row.coverage,
                )
                for row in profiles
            ],
            caption="Over fibres whose signal is ten times its standard error",
        )
    return body


def _by_channel(rows: Sequence[evaluation.FitError]) -> str:
    labels = [f"{name}, {c}" for name in dict.fromkeys(r.name for r in rows) for c in CHANNEL_NAMES]
    if len(labels) > 4 * len(CHANNEL_NAMES):
        return ""
    series = {}
    for method, words in METHOD_NAMES.items():
        errors = {f"{r.name}, {r.channel}": r.relative for r in rows if r.method == method}
        series[words] = [100.0 * errors.get(label, float("nan")) for label in labels]
    parts = [label.rpartition(", ") for label in labels]
    short = [f"{_words_of_name(name)}\n{channel}" for name, _, channel in parts]
    return f"<div class='plots'>{figures.bars('error of sigma_tr', short, series, unit='%')}</div>"


def _anisotropy(appearance: SkinAppearance) -> str:
    document = evaluation.document_of(appearance, ANISOTROPY_FILE)
    if document is None or not document["sites"]:
        return ""
    rows = [
        (
            entry["site"],
            entry["repeat"],
            entry["channel"],
            entry["directions"],
            number(entry["ratio"]),
            number(entry["ratio_stderr"]),
            number(entry["axis_deg"]),
            number(entry["axis_stderr_deg"]),
            number(entry["p_value"]),
            number(entry["worst_direction_percent"]),
            "yes" if entry["valid"] else entry["reason"],
        )
        for entry in document["sites"]
    ]
    return "<h3>Dependence on direction</h3>" + page.table(
        (
            "site",
            "repeat",
            "channel",
            "directions",
            "ratio",
            "standard error",
            "axis, °",
            "standard error, °",
            "chance if isotropic",
            "one direction is off by up to, %",
            "valid",
        ),
        rows,
        caption="sigma_tr along the long axis over that across it",
    )


def _sites(appearance: SkinAppearance) -> str:
    fitted = evaluation.document_of(appearance, SUBSURFACE_FILE)
    if fitted is None or not fitted.get("sites"):
        return ""
    rows = [
        (
            entry["site"],
            entry["channel"],
            entry["measurements"],
            number(entry["sigma_tr_per_mm"]),
            number(entry["sigma_tr_stderr"]),
            number(entry["translucency_mm"]),
            number(entry["translucency_stderr_mm"]),
        )
        for entry in fitted["sites"]
    ]
    return "<h3>Sites</h3>" + page.table(
        (
            "site",
            "channel",
            "measurements",
            "sigma_tr, 1/mm",
            "standard error",
            "translucency, mm",
            "standard error",
        ),
        rows,
        caption="Mean of each site's measurements; translucency is 1/sigma_tr",
    )


def _map(appearance: SkinAppearance) -> str:
    """Show 1/sigma_tr over the face's texture, each channel beside its standard error."""
    found = appearance.maps.get("translucency")
    if found is None:
        return ""
    pictures = ""
    for c, channel in enumerate(CHANNEL_NAMES):
        values = found.values[..., c]
        inside = values if found.valid is None else values[found.valid]
        if not inside.size:
            continue
        pictures += map_pictures.scalar_picture(
            f"translucency, {channel}",
            values,
            low=float(inside.min()),
            high=float(inside.max()),
            valid=found.valid,
            unit="mm",
            width=WIDTH_PX,
        )
        if found.stderr is not None:
            spread = found.stderr[..., c]
            pictures += map_pictures.scalar_picture(
                "standard error",
                spread,
                low=0.0,
                high=float(spread.max()),
                scale="magma",
                valid=found.valid,
                unit="mm",
                width=WIDTH_PX,
            )
    note = page.note(
        "1/sigma_tr over the face's texture, between the measured sites by kriging; away from "
        "them the error grows to what people differ by."
    )
    return f"<h3>Translucency map</h3>{note}<div class='maps'>{pictures}</div>"


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
    found = _NAME.fullmatch(name)
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
