"""Predict the flicker of a plan of LEDs for the subject's open eyes.

Flashes at 3 Hz or more can provoke seizures in people who are sensitive to light (Harding, Wilkins,
Erba, Barkley, Fisher 2005, doi:10.1111/j.1528-1167.2005.31305.x); the band reported is 3 to about
65 Hz. The light at the eyes (`capture.plan.eye_light`) is averaged over 1/65 s, the shortest time
in which flicker is visible. Two figures are computed from it: opposing pairs of changes of a tenth
of the maximum, counted in the worst second, and the rms of its 3 to 65 Hz part over its mean. These
are planning figures, not a medical certificate.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import Float64Array
from capture.plan.eye_light import eye_irradiance
from capture.plan.rows import LedRow, led_rows, split_passes
from capture.plan.steps import Plan, Step
from capture.rig import LedLimits, Rig

FLICKER_BAND_HZ = (3.0, 65.0)
FLICKER_FUSION_HZ = 65.0
MIN_FLASH_CHANGE = 0.1
"""Smallest change of a flash, of the brightest light of the plan."""
EYE_SAMPLE_S = 1e-3
DARK_PADDING_S = 1.0
"""Dark time before and after each piece of a plan, s."""
MIN_RMS_DURATION_S = 2.0
"""Duration below which a piece is evaluated by its flashes only, s: the rms over mean of one flash
is always large.
"""


@dataclass(frozen=True, slots=True)
class FlickerReport:
    """Figures of the flicker of a plan's worst uninterrupted piece."""

    flashes_per_s: float
    """Flashes in the worst second."""
    rms: float
    """Root mean square of the light of 3 to 65 Hz over its mean; 0 when all pieces are short."""
    seconds: float
    """Duration of all pieces, s."""
    mean_w_m2: float
    """Mean irradiance at the eyes, W/m^2."""

    def within(self, limits: LedLimits) -> bool:
        """Return whether the flicker is allowed for open eyes."""
        return self.flashes_per_s < limits.max_flashes_per_s and self.rms <= limits.max_flicker_rms


def eye_signal(
    rows: Sequence[LedRow], weights: Float64Array, *, overlap_s: float = 0.0
) -> Float64Array:
    """Return the light at the eyes, averaged over each `EYE_SAMPLE_S`, with rest before and after.

    Parameters
    ----------
    rows : sequence of LedRow
    weights : ndarray
        (L,) irradiance of each light at level 1, W/m^2.
    overlap_s : float
        How long before its row each LED comes on, s.

    Returns
    -------
    ndarray
        (T,), W/m^2; none without rows.
    """
    if not rows:
        return np.zeros(0)
    light = np.array([float(row.light_levels(len(weights)) @ weights) for row in rows])
    ends = np.cumsum([row.dwell_s for row in rows])
    starts = np.concatenate([[0.0], ends[:-1] - overlap_s])
    # the integral of each row's light up to t is a ramp from its start to its end
    count = math.ceil((float(ends[-1]) + 2.0 * DARK_PADDING_S) / EYE_SAMPLE_S)
    edges = np.arange(count + 1) * EYE_SAMPLE_S - DARK_PADDING_S
    times = np.concatenate([starts, ends])
    slopes = np.concatenate([light, -light])
    order = np.argsort(times, kind="stable")
    times, rates = times[order], np.cumsum(slopes[order])
    held = np.concatenate([[0.0], np.cumsum(rates[:-1] * np.diff(times))])
    return np.asarray(np.diff(np.interp(edges, times, held)) / EYE_SAMPLE_S)


def average_over_flicker_fusion(signal: Float64Array) -> Float64Array:
    """Average a signal over 1/65 s, the flicker fusion time of the eye."""
    width = round(1.0 / FLICKER_FUSION_HZ / EYE_SAMPLE_S)
    return np.convolve(signal, np.full(width, 1.0 / width), mode="same")


def count_flashes(signal: Float64Array, *, min_change: float) -> float:
    """Return the most flashes in any second: half the turning points that differ by ``min_change``.

    Examples
    --------
    >>> on = np.r_[np.zeros(100), np.ones(100)]
    >>> count_flashes(np.tile(on, 10), min_change=0.1)
    5.0
    """
    # Turning points with hysteresis: a reversal counts once the signal has come back by min_change
    # from its last extreme. Two of them are one flash.
    turns: list[int] = []
    low = high = extreme = float(signal[0]) if signal.size else 0.0
    rising: bool | None = None
    for number, value in enumerate(signal.tolist()):
        if rising is None:
            low, high = min(low, value), max(high, value)
            if high - low < min_change:
                continue
            rising, extreme = value == high, value
            turns.append(number)
        elif (value - extreme if rising else extreme - value) > 0.0:
            extreme = value
        elif abs(value - extreme) >= min_change:
            rising, extreme = not rising, value
            turns.append(number)
    times = np.array(turns) * EYE_SAMPLE_S
    if times.size == 0:
        return 0.0
    inside = np.searchsorted(times, times + 1.0 - 0.5 * EYE_SAMPLE_S) - np.arange(times.size)
    return float(inside.max()) / 2.0


def band_rms(signal: Float64Array) -> float:
    """Return the rms of a signal's 3 to 65 Hz part over its mean; 0 for no light.

    Examples
    --------
    >>> t = np.arange(10_000) * EYE_SAMPLE_S
    >>> round(band_rms(1.0 + 0.1 * np.sin(2 * np.pi * 12.0 * t)), 6)
    0.070711
    """
    mean = float(signal.mean()) if signal.size else 0.0
    if mean <= 0.0:
        return 0.0
    power = np.abs(np.fft.rfft(signal)) ** 2
    frequency_hz = np.fft.rfftfreq(signal.size, EYE_SAMPLE_S)
    inside = (frequency_hz >= FLICKER_BAND_HZ[0]) & (frequency_hz <= FLICKER_BAND_HZ[1])
    # Parseval: the components at +f and -f together have the mean square 2 |X_f|^2 / n^2.
    return float(np.sqrt(2.0 * power[inside].sum()) / signal.size / mean)


def flicker_of_rows(
    rows: Sequence[LedRow], weights: Float64Array, *, overlap_s: float = 0.0
) -> FlickerReport:
    """Return the flicker of rows that follow one another without a pause.

    Parameters
    ----------
    rows, weights, overlap_s
        As for `eye_signal`.
    """
    signal = eye_signal(rows, weights, overlap_s=overlap_s)
    seconds = sum(row.dwell_s for row in rows)
    if not signal.size or signal.max() <= 0.0:
        return FlickerReport(0.0, 0.0, seconds, 0.0)
    rest = round(DARK_PADDING_S / EYE_SAMPLE_S)
    seen = average_over_flicker_fusion(signal)
    rms = band_rms(signal[rest:-rest]) if seconds >= MIN_RMS_DURATION_S else 0.0
    flashes = count_flashes(seen, min_change=MIN_FLASH_CHANGE * float(seen.max()))
    return FlickerReport(flashes, rms, seconds, float(signal[rest:-rest].mean()))


def flicker_report(plan: Plan, rig: Rig) -> FlickerReport:
    """Return the flicker of a plan for open eyes: the worst figures of its pieces.

    While the analyzer turns between two patterns of the gradient sphere it is dark.

    Parameters
    ----------
    plan : Plan
        Plan of the dome or the gradient sphere.
    rig : Rig
        Rig with the lights that the plan names.

    Examples
    --------
    >>> from capture.plan.dome import dome_plan
    >>> from capture.rig import load_rig
    >>> dome = load_rig("dome")
    >>> report = flicker_report(dome_plan(dome), dome)
    >>> report.flashes_per_s <= 1.0, report.within(dome.leds)
    (True, True)
    """
    weights = eye_irradiance(rig)
    overlap_s = rig.leds.overlap_s if rig.leds is not None else 0.0
    reports = [
        flicker_of_rows(_insert_analyzer_rotations(piece, rig), weights, overlap_s=overlap_s)
        for piece in split_passes([step for step in plan.steps if step.kind != "stripes"])
    ]
    seconds = sum(report.seconds for report in reports)
    mean = sum(report.mean_w_m2 * report.seconds for report in reports)
    return FlickerReport(
        max((report.flashes_per_s for report in reports), default=0.0),
        max((report.rms for report in reports), default=0.0),
        seconds,
        mean / seconds if seconds else 0.0,
    )


def _insert_analyzer_rotations(steps: Sequence[Step], rig: Rig) -> list[LedRow]:
    """Return the rows of steps, with darkness while the analyzer turns between two of them."""
    rows: list[LedRow] = []
    before: object = None
    for step, row in zip(steps, led_rows(steps, rig), strict=True):
        asked = step.settings.get("analyzer_deg", step.settings.get("polarizer"))
        if rows and "pattern" in step.settings and asked != before:
            rows.append(LedRow((), 0.0, rig.polarizer_move_s))
        before = asked
        rows.append(row)
    return rows
