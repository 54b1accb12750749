"""Errors of whatever kind of appearance against its truth, as rows that two runs share."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from model.skin import SkinAppearance
from skinrig.evaluating import flash, microrelief, subsurface
from skinrig.evaluating import surface as surface_evaluation
from skinrig.evaluating.surface import errors_by_band
from skinrig.written_units import unit_sign


@dataclass(frozen=True, slots=True)
class TruthError:
    """One error against the truth.

    Attributes
    ----------
    quantity, skin
        What is in error, and on which skin: a band, a state, or "all".
    unit
        Of the error.
    error
        Median, or what the quantity names.
    interval
        68 % bootstrap interval; NaN where none is known.
    coverage
        Share of truths inside the 68 % intervals; NaN where it is not told.
    """

    quantity: str
    skin: str
    unit: str
    error: float
    interval: tuple[float, float] = (float("nan"), float("nan"))
    coverage: float = float("nan")


def of(appearance: SkinAppearance, truth: SkinAppearance) -> list[TruthError]:
    """Return the errors of an appearance by quantity and skin.

    Parameters
    ----------
    appearance
        Of a flash camera, a dome, a gradient sphere or a fibre probe.
    truth
        Of the same session.
    """
    rows: list[TruthError] = []
    if "position" in appearance.maps:
        rows += _surface(appearance, truth)
    elif microrelief.states_of(appearance):
        rows += _microrelief(appearance, truth)
    elif "melanin" in truth.maps:
        rows += _chromophores(appearance, truth)
    if subsurface.true_profiles(truth):
        rows += _subsurface(appearance, truth)
    return rows


def _chromophores(appearance: SkinAppearance, truth: SkinAppearance) -> Iterator[TruthError]:
    for row in flash.compare(appearance, truth, rng=np.random.default_rng(0)):
        name = f"{row.name}, median relative error against the {row.against} truth"
        interval = 100 * row.interval[0], 100 * row.interval[1]
        got = 100 * row.median_relative
        yield TruthError(name, row.band_name, "%", got, interval, row.coverage.share)


def _surface(appearance: SkinAppearance, truth: SkinAppearance) -> Iterator[TruthError]:
    for row in surface_evaluation.compare(appearance, truth, rng=np.random.default_rng(0)):
        name, unit = f"{row.name}, median error", unit_sign(row.unit)
        yield TruthError(name, "all", unit, row.median, row.interval, row.coverage.share)
    for name, unit, band, _, _, middle, _ in errors_by_band(appearance, truth):
        yield TruthError(f"{name}, median error", f"{band} skin", unit, middle)


def _microrelief(appearance: SkinAppearance, truth: SkinAppearance) -> Iterator[TruthError]:
    for one in microrelief.compare(appearance, truth, rng=np.random.default_rng(0)):
        angles = one.median_deg, one.interval_deg, one.coverage
        yield TruthError("normals, median error", one.state, "°", *angles)
        if np.isfinite(one.height_um):
            name, got = "height, rms error of relief", 100 * one.height_relative
            yield TruthError(name, one.state, "%", got, coverage=one.height_coverage)


def _subsurface(appearance: SkinAppearance, truth: SkinAppearance) -> Iterator[TruthError]:
    fits = subsurface.compare_fits(appearance, truth)
    for kind in dict.fromkeys(row.kind for row in fits):
        for one in subsurface.by_method([row for row in fits if row.kind == kind]):
            name, skin = f"sigma_tr by {one.method}, median relative error", f"{kind} tissue"
            yield TruthError(name, skin, "%", 100 * one.median, coverage=one.coverage)
