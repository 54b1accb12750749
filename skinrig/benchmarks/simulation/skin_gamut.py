"""Benchmark of simulated skin: its color against percentiles of measured skin."""

from collections.abc import Sequence
from functools import partial
from typing import Final

import numpy as np

from model import skin_tone
from rigsim.population.files import load_subject
from rigsim.population.population import draw_population
from rigsim.subject.person_skin import PersonSkin
from rigsim.subject.pigment import MELANIN_PRESETS
from rigsim.tissue.skin_table import WAVELENGTH_NM, interpolate_spectra
from skinrig.arrays import Float64Array
from skinrig.benchmarks.resampling import mean_error
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.evaluating.skin_bands import MELANIN_BANDS

FACE_SITES: Final = ("forehead", "cheek", "chin")
COLOR_QUANTITIES: Final = ("lightness", "chroma", "hue_deg")
MIN_PERCENTILE: Final = 5.0
"""Skin below this percentile of measured skin, or above 100 less it, is unlike measured skin."""


def measure_gamut(stage: BenchmarkStage) -> None:
    """Measure the distance of people's skin from the median of measured skin of their band."""
    seeds = range(2 if stage.toy else 10)
    inside: list[float] = []
    for preset in MELANIN_PRESETS:
        people = [PersonSkin.of_preset(preset, seed=seed) for seed in seeds]
        inside.append(_add_people(stage, preset, people))
    drawn = [load_subject(preset).skin(seed=seed) for preset in MELANIN_PRESETS for seed in seeds]
    of_drawn = _add_people(stage, "presets with drawn optics", drawn)
    members = [member.skin for member in draw_population()[: 8 if stage.toy else None]]
    share = _add_people(stage, "population", members)
    stage.limits = {
        "presets": 100.0 * min(inside),
        "drawn": 100.0 * of_drawn,
        "population": 100.0 * share,
    }
    for name, band in MELANIN_BANDS.items():
        stage.by_band[name] = mean_error(_distances([PersonSkin.of_preset(band.preset)]))


def _add_people(stage: BenchmarkStage, name: str, people: Sequence[PersonSkin]) -> float:
    """Add one point, and return the fraction of people inside the percentiles."""
    timing, ranks = stage.time(partial(percentile_ranks, people), repeats=1)
    distance = np.abs(ranks - 50.0)
    low, high = ranks.min(axis=0), ranks.max(axis=0)
    extra = {
        f"{quantity} {end}": round(float(value), 1)
        for quantity, ends in zip(COLOR_QUANTITIES, zip(low, high, strict=True), strict=True)
        for end, value in zip(("lowest", "highest"), ends, strict=True)
    }
    stage.add({"people": name}, timing, mean_error(distance.ravel().tolist()), extra)
    return float((distance <= 50.0 - MIN_PERCENTILE).all(axis=-1).mean())


def _distances(people: Sequence[PersonSkin]) -> list[float]:
    ranks: list[float] = np.abs(percentile_ranks(people) - 50.0).ravel().tolist()
    return ranks


def measure_face(person: PersonSkin) -> Float64Array:
    """Return the mean spectrum of `FACE_SITES` as a sphere measures it, at `WAVELENGTH_NM`."""
    sites = [person.at(site) for site in FACE_SITES]
    spectra = [
        interpolate_spectra(np.array([s.c_m]), np.array([s.c_hd]), s.tissue, WAVELENGTH_NM)[0]
        for s in sites
    ]
    return np.asarray(np.mean(spectra, axis=0) + skin_tone.sphere_specular())


def percentile_ranks(people: Sequence[PersonSkin]) -> Float64Array:
    """Return the percentiles of skin among measured skin of its band of the typology angle.

    Parameters
    ----------
    people
        The people; the color of each is the mean over `FACE_SITES`.

    Returns
    -------
    ndarray
        Shape (people, 3): percentiles of lightness, chroma and hue, 0 to 100.
    """
    measured = skin_tone.measured_skin()
    ranks = []
    for person in people:
        lab = skin_tone.lab_of_spectra(measure_face(person), WAVELENGTH_NM)
        hue, chroma = skin_tone.hue_chroma(lab)
        band = skin_tone.ITA_BANDS[int(skin_tone.ita_band(skin_tone.ita(lab))) - 1]
        values = zip(COLOR_QUANTITIES, (lab[0], chroma, hue), strict=True)
        ranks.append([float(measured.rank(band, name, value)) for name, value in values])
    return np.array(ranks)
