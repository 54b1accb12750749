"""Extremes of the gathered dipole: coefficients of the model, and lateral scattering."""

import itertools

import numpy as np

from model.dipole.gather import GatherError, exitance
from model.dipole.maps import DipoleMaps
from skinrig.extremes.expectations import (
    ExpectationError,
    expect_error,
    expect_near,
    expect_rising,
    expect_valid_fraction,
    expect_within,
)
from skinrig.extremes.inputs import InputPrecision


def _patch(real: InputPrecision, *, step_mm: float = 0.5, count: int = 20):  # type: ignore[no-untyped-def]
    """Return positions and areas of a curved patch."""
    at = (np.arange(count) - 0.5 * (count - 1)) * step_mm
    x, y = np.meshgrid(at, at)
    place = np.stack([x, y, 0.05 * x * y], axis=-1).reshape(-1, 3)
    return real(place), real(np.full(count**2, step_mm**2))


def _even(real: InputPrecision) -> str:
    place, area = _patch(real)
    light = real(np.full((len(area), 3), 3.0))
    count = 0
    ends = itertools.product((0.0, 1e-6, 0.5, 1.0 - 1e-9, 1.0), (0.01, 1.0, 100.0))
    for r_d, length in ends:
        got = exitance(place, area, light, place[::9], r_d, length)
        expect_near(got, np.full(got.shape, 3.0 * r_d), relative=1e-5)
        count += 1
    return f"R_d times the irradiance, for {count} pairs"


def _coarse(real: InputPrecision) -> str:
    place, area = _patch(real, step_mm=5.0)
    light = real(1.0 + np.sin(place.astype(np.float64)))
    got = exitance(place, area, light, place, 0.5, 0.01, entered_at=light)
    return expect_near(got.sum() / (0.5 * light.astype(np.float64).sum()), 1.0, relative=0.01)


def _above_one(real: InputPrecision) -> str:
    found = DipoleMaps.of(real([[[1.2, 1.0, 0.5]]]), real(2.0), eta=1.4)
    if found.outlier.tolist() != [[[True, False, False]]]:
        raise ExpectationError(f"outlier: got {found.outlier.tolist()}, expected the first alone")
    place, area = _patch(real)
    light = real(np.ones((len(area), 3)))
    expect_near(
        exitance(place, area, light, place[:5], 1.2, 1.0), np.full((5, 3), 1.2), relative=1e-5
    )
    return (
        expect_valid_fraction(found.valid, fraction_range=(0.3, 0.4))
        + ", marked as an outlier; 1.2 times the irradiance"
    )


def _inverse(real: InputPrecision) -> str:
    lost = np.geomspace(1e-6 if real.single else 1e-9, 0.999999, 60)
    found = DipoleMaps.of((1.0 - real(lost))[:, None], [1.0], eta=1.4)
    expect_valid_fraction(found.valid, fraction_range=(1.0, 1.0))
    return expect_rising(found.deficit[:, 0], label="1 - alpha'")


def _single(real: InputPrecision) -> str:
    one = real([[1.0, 2.0, 3.0]])
    return expect_near(
        exitance(one, real([0.1]), one, one, 0.5, 1.0), [[0.5, 1.0, 1.5]], relative=1e-6
    )


def _empty(real: InputPrecision) -> str:
    shape = (2, 2, 3)
    found = DipoleMaps.of(
        real(np.full(shape, 0.5)), real(np.ones(shape)), eta=1.4, valid=np.zeros((2, 2), bool)
    )
    none = real(np.zeros((0, 3)))
    expect_near(exitance(none, none[:, 0], none, real(np.zeros((2, 3))), 0.5, 1.0), 0.0)
    return expect_valid_fraction(found.valid) + ", nothing leaves"


def _folded(real: InputPrecision) -> str:
    place, area = _patch(real)
    both = np.concatenate([place, place + real([0.0, 0.0, 1e-3])])
    light = np.zeros((len(both), 3), real.dtype)
    light[: len(place)] = 1.0
    got = exitance(both, np.tile(area, 2), light, both, 1.0, (0.05, 1.0, 50.0))
    return expect_within(got, -1e-3, 1.0 + 1e-3, label="exitance over the largest")


def _opaque(real: InputPrecision) -> str:
    place, area = _patch(real)
    light = real(np.ones((len(area), 3)))
    return expect_error(
        lambda: exitance(place, area, light, place, 0.5, 0.0), GatherError, "translucency_mm"
    )
