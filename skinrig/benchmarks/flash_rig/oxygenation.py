"""Benchmark of oxygenation from colors and narrow-band LEDs, on people that set no constant.

The people are simulated by Monte Carlo spectra of `rigsim.tissue`, with drawn properties of skin:
as the population's, or over the whole published ranges. Skin of each type has its typical melanin
and blood; shading is drawn and unknown to the estimator.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import exp
from typing import Final

import numpy as np

from model import spectra
from model.tissue_optics import uncertainty
from model.tissue_optics.band_signals import gray_weights
from reconstruction.narrow_bands.band_fit import BandFit, SignalTable, fit_bands, signal_table
from rigsim.subject.person_skin import draw_tissue
from rigsim.tissue.skin_layers import PROPERTY_RANGES, TYPICAL_SKIN, TissueProperties
from rigsim.tissue.skin_table import SkinTable
from skinrig.arrays import BoolArray, Float64Array
from skinrig.benchmarks.resampling import median_error
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.planning.camera_separability import TYPICAL_CAMERA
from skinrig.planning.camera_separability import TYPICAL_SKIN as TYPICAL_FRACTIONS

FLASH_LIGHT: Final = "D55"
LED_SETS: Final[Mapping[str, tuple[str, ...]]] = {
    "none": (),
    "500:20,560:20,590:20,630:20": ("LED-500-20", "LED-560-20", "LED-590-20", "LED-630-20"),
    "450:20,580:20,600:20": ("LED-450-20", "LED-580-20", "LED-600-20"),
}
JUDGED_LEDS: Final = "450:20,580:20,600:20"
SKIN_TYPES: Final = ("I", "III", "V")
FIRST_SEED: Final = 5000
"""First seed of the people; no constant was selected on them."""
SIGNAL_NOISE: Final = 0.002
"""Relative noise of a signal averaged over the reconstruction's window, small images."""
LOG_SHADING: Final = (-0.5, 0.4)
_TISSUE_FIELDS: Final = {"baseline_factor": "baseline_amplitude"}


@dataclass(frozen=True, slots=True, eq=False)
class DrawnPeople:
    """Signals and ground truth of people, n of each type."""

    signals: Float64Array
    """(types, n, 3 + leds) with noise and shading."""
    oxygenation: Float64Array
    """(n,) ground truth."""


def draw_published_tissue(seed: int) -> TissueProperties:
    """Draw properties of skin over their published ranges, +-2 standard deviations.

    Examples
    --------
    >>> draw_published_tissue(1).epidermis_mm != draw_published_tissue(2).epidermis_mm
    True
    """
    rng = np.random.default_rng([seed, 0x6F78])
    drawn = {}
    for one in uncertainty.NUISANCE_PARAMETERS:
        name = _TISSUE_FIELDS.get(one.name, one.name)
        step = one.sd * float(np.clip(rng.standard_normal(), -2.0, 2.0))
        value = getattr(TYPICAL_SKIN, name)
        value = value * exp(step) if one.is_log else value + step
        drawn[name] = float(np.clip(value, *PROPERTY_RANGES[name]))
    return replace(TYPICAL_SKIN, **drawn)


TISSUE_DRAWS: Final[Mapping[str, Callable[[int], TissueProperties]]] = {
    "population": draw_tissue,
    "published": draw_published_tissue,
}


def draw_people(population: str, leds: Sequence[str], count: int) -> DrawnPeople:
    """Simulate the signals of people.

    Parameters
    ----------
    population
        Key of `TISSUE_DRAWS`.
    leds
        Names of the LEDs.
    count
        Number of people of each type.
    """
    rng = np.random.default_rng(11)
    tissues = [TISSUE_DRAWS[population](FIRST_SEED + k) for k in range(count)]
    weights = [spectra.band_weights(TYPICAL_CAMERA, FLASH_LIGHT)]
    weights += [gray_weights(TYPICAL_CAMERA, led)[:, None] for led in leds]
    tables = [
        [SkinTable.load(tissue, spectra.sampling(name)) for name in (FLASH_LIGHT, *leds)]
        for tissue in tissues
    ]
    signals = np.empty((len(SKIN_TYPES), count, 3 + len(leds)))
    for i, kind in enumerate(SKIN_TYPES):
        c_m, blood = TYPICAL_FRACTIONS[kind]
        for k, own in enumerate(tables):
            parts = [t.spectra(c_m, blood) @ w for t, w in zip(own, weights, strict=True)]
            signals[i, k] = np.concatenate(parts)
    shading = np.exp(rng.normal(*LOG_SHADING, signals.shape[:2]))
    noise = 1.0 + SIGNAL_NOISE * rng.standard_normal(signals.shape)
    oxygenation = np.array([tissue.oxygenation for tissue in tissues])
    return DrawnPeople(signals * shading[..., None] * noise, oxygenation)


def measure_oxygenation(stage: BenchmarkStage) -> None:
    """Measure error, seconds, coverage and valid fraction by LEDs, population and skin type."""
    count, pixels = (12, 4096) if stage.toy else (100, 384 * 256)
    for population in TISSUE_DRAWS:
        errors: dict[str, Float64Array] = {}
        for label, leds in LED_SETS.items():
            people = draw_people(population, leds, count)
            table = signal_table(TYPICAL_CAMERA, FLASH_LIGHT, leds)
            flat = people.signals.reshape(-1, people.signals.shape[-1])
            tiled = flat[np.arange(pixels) % len(flat)]
            timing, _ = stage.time(partial(_fit, table, tiled), repeats=1)
            found = _fit(table, flat)
            shape = people.signals.shape[:2]
            off = found.oxygenation.reshape(shape) - people.oxygenation
            covered = np.abs(off) <= found.stderr[:, 2].reshape(shape)
            valid = found.valid.reshape(shape)
            errors[label] = off
            stage.add(
                {"people": population, "LEDs": label, "pixels": pixels},
                timing,
                median_error(100.0 * np.abs(off)),
                _by_type(covered, "coverage") | _by_type(valid, "valid"),
            )
            if label == JUDGED_LEDS:
                for kind, part in zip(SKIN_TYPES, covered, strict=True):
                    stage.limits["coverage", kind, population] = float(part.mean())
                stage.limits["seconds"] = timing.seconds
            if label == "none":
                stage.limits["determined", population] = float(valid.mean())
        for i, kind in enumerate(SKIN_TYPES):
            alone, added = (np.sqrt(np.mean(errors[n][i] ** 2)) for n in ("none", JUDGED_LEDS))
            stage.limits["gain", kind, population] = float(alone / added)


def _fit(table: SignalTable, light: Float64Array) -> BandFit:
    return fit_bands(light, np.square(SIGNAL_NOISE * light), table, log_shading=LOG_SHADING)


def _by_type(flags: BoolArray, name: str) -> dict[str, float]:
    return {
        f"{name}, {kind}": round(float(part.mean()), 2)
        for kind, part in zip(SKIN_TYPES, flags, strict=True)
    }
