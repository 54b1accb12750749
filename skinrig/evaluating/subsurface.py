"""Evaluate radial profiles and sigma_tr of a fiber probe against ground truth."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from model.skin import SkinAppearance
from model.translucency_population import SiteMeasurement
from reconstruction.pipeline.probe.profile_fits import METHOD_NAMES
from reconstruction.pipeline.probe.stages import CHANNEL_NAMES, PROFILE_FILE, SUBSURFACE_FILE
from skinrig.arrays import Float64Array

MAX_MEDIAN_ERROR, MAX_WORST_ERROR = 0.03, 0.08
"""Limits of the relative error of sigma_tr on homogeneous media: median and worst."""
RECOMMENDED_METHOD = METHOD_NAMES[0]
MIN_SIGNAL_TO_NOISE = 10.0
"""Minimum ratio of a fiber's signal to its standard error for a comparison."""


@dataclass(frozen=True, slots=True)
class ProfileAccuracy:
    """Accuracy of one measured radial profile.

    Attributes
    ----------
    name, channel
        Name and channel of the measurement.
    median, worst
        Relative error over the fibers with a signal of at least ten standard errors.
    fibers
        Number of those fibers.
    coverage
        Fraction of them within one standard error, which includes the truth's statistical error.
    """

    name: str
    channel: str
    median: float
    worst: float
    fibers: int
    coverage: float


@dataclass(frozen=True, slots=True)
class FitAccuracy:
    """Accuracy of one fitted sigma_tr."""

    name: str
    channel: str
    method: str
    kind: str
    """Kind of tissue: "homogeneous", "layered" or "anisotropic"."""
    truth: float
    """True sigma_tr, 1/mm; for layers that of the best-fitting homogeneous medium."""
    found: float
    stderr: float
    interval: tuple[float, float]
    """68 % interval of the fit, 1/mm."""
    valid: bool

    @property
    def relative(self) -> float:
        """Relative error: found minus true, over true."""
        return (self.found - self.truth) / self.truth

    @property
    def covered(self) -> bool:
        """Whether the 68 % interval contains the truth."""
        return self.interval[0] <= self.truth <= self.interval[1]


def read_document(appearance: SkinAppearance, name: str) -> Mapping[str, Any] | None:
    """Return a JSON file of an appearance, or None if it is missing."""
    blob = appearance.files.get(name)
    return None if blob is None else json.loads(blob)


def true_profiles(truth: SkinAppearance | None) -> Mapping[str, Mapping[str, Any]]:
    """Return the true profiles by name of the measurement."""
    known = None if truth is None else truth.parameters.get("profiles")
    if not isinstance(known, list):
        return {}
    return {format_measurement_name(entry): entry for entry in known}


def format_measurement_name(entry: Mapping[str, Any]) -> str:
    """Return the name of a measurement from its site, repeat and angle.

    Examples
    --------
    >>> format_measurement_name({"site": "cheek", "repeat": 1, "angle_deg": 22.5})
    'cheek_r1_a022.5'
    """
    return f"{entry['site']}_r{int(entry['repeat'])}_a{float(entry['angle_deg']):05.1f}"


def compare_profiles(appearance: SkinAppearance, truth: SkinAppearance) -> list[ProfileAccuracy]:
    """Compare the profiles of all measurements and channels with the true ones."""
    measured, known = read_document(appearance, PROFILE_FILE), true_profiles(truth)
    rows: list[ProfileAccuracy] = []
    for entry in [] if measured is None else measured["measurements"]:
        true = known.get(format_measurement_name(entry))
        if true is None:
            continue
        for number, channel in enumerate(CHANNEL_NAMES):
            one = entry["channels"][channel]
            found, stderr = parse_numbers(one["reflectance_per_mm2"]), parse_numbers(one["stderr"])
            real = np.asarray(true["reflectance_per_mm2"], float)[:, number]
            noise = np.asarray(true["stderr"], float)[:, number]
            good = np.asarray(one["valid"], bool) & (found > MIN_SIGNAL_TO_NOISE * stderr)
            if not good.any():
                continue
            error = np.abs(found / real - 1.0)[good]
            inside = np.abs(found - real) <= np.hypot(stderr, noise)
            median, worst = float(np.median(error)), float(error.max())
            held = float(inside[good].mean())
            name = format_measurement_name(entry)
            rows.append(ProfileAccuracy(name, channel, median, worst, int(good.sum()), held))
    return rows


def compare_fits(appearance: SkinAppearance, truth: SkinAppearance) -> list[FitAccuracy]:
    """Compare every fitted sigma_tr with the true one."""
    fitted, known = read_document(appearance, SUBSURFACE_FILE), true_profiles(truth)
    rows: list[FitAccuracy] = []
    for entry in [] if fitted is None else fitted["measurements"]:
        true = known.get(format_measurement_name(entry))
        if true is None:
            continue
        for fit in entry["fits"]:
            sigma_tr = float(true["sigma_tr_per_mm"][CHANNEL_NAMES.index(fit["channel"])])
            low, high = parse_numbers(fit["interval_per_mm"]).tolist()
            known_by = (
                format_measurement_name(entry),
                fit["channel"],
                fit["method"],
                str(true["kind"]),
            )
            found = parse_number(fit["sigma_tr_per_mm"]), parse_number(fit["sigma_tr_stderr"])
            rows.append(FitAccuracy(*known_by, sigma_tr, *found, (low, high), bool(fit["valid"])))
    return rows


def site_measurements(name: str, fits: Mapping[str, Any]) -> list[SiteMeasurement]:
    """Return the sites of a person with a value in every channel.

    Parameters
    ----------
    name
        Name of the person.
    fits
        Document of the fits, see `reconstruction.pipeline.probe.stages.SUBSURFACE_FILE`.
    """
    by_site: dict[str, list[Mapping[str, Any]]] = {}
    for entry in fits["sites"]:
        by_site.setdefault(entry["site"], []).append(entry)
    return [
        SiteMeasurement(
            name,
            site,
            tuple(parse_number(entry["sigma_tr_per_mm"]) for entry in own),
            tuple(parse_number(entry["sigma_tr_stderr"]) for entry in own),
        )
        for site, own in by_site.items()
        if all(entry["sigma_tr_stderr"] is not None for entry in own)
    ]


@dataclass(frozen=True, slots=True)
class MethodAccuracy:
    """Accuracy of one method over many fits."""

    method: str
    fits: int
    median: float
    """Median of the absolute relative error."""
    worst: float
    bias: float
    """Mean relative error."""
    coverage: float
    """Fraction of true values in the 68 % interval."""


def summarize_methods(rows: Sequence[FitAccuracy]) -> list[MethodAccuracy]:
    """Summarize the errors of each method over its valid fits."""
    found = []
    for method in METHOD_NAMES:
        chosen = [row for row in rows if row.method == method and row.valid]
        if not chosen:
            continue
        error = np.array([row.relative for row in chosen])
        median, worst = float(np.median(np.abs(error))), float(np.abs(error).max())
        bias, held = float(error.mean()), float(np.mean([row.covered for row in chosen]))
        found.append(MethodAccuracy(method, len(chosen), median, worst, bias, held))
    return found


def parse_number(value: object) -> float:
    """Convert a number of a JSON document to float; null becomes NaN."""
    return math.nan if value is None else float(str(value))


def parse_numbers(values: Sequence[object]) -> Float64Array:
    """Convert numbers of a JSON document to float64; null becomes NaN."""
    return np.array([parse_number(value) for value in values], np.float64)
