"""Find and measure the ends of the detection fibers in the camera's image, in order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from capture.arrays import BoolArray, Float64Array, FloatArray, Int64Array
from capture.calibration.fiber.discs import (
    DiscFit,
    drop_duplicate_fits,
    find_candidates,
    fit_disc,
    gray_image,
    warn_of_unfinished_fits,
)
from capture.calibration.fiber.merge import MergedSeries
from capture.calibration.record import CalibrationError, freeze_arrays

MAX_SPOT_OFFSET_PITCH: Final = 0.35
"""Largest distance of a spot from its position in the row."""
MAX_ROW_SHIFT_PITCH: Final = 0.5
"""Beyond half the distance of neighbors a spot cannot be assigned to a fiber."""
MIN_SPOT_FRACTION: Final = 0.5
"""Smallest fraction of the fibers with a spot in an image of this probe."""
APERTURE_EDGE_WIDTHS: Final = 2.5
"""Extent of an aperture beyond the radius, in widths of the blurred edge."""


class FiberSpotError(CalibrationError):
    """Raised when the spots in the image are not those of the probe's fibers."""


@dataclass(frozen=True, slots=True, eq=False)
class FiberSpots:
    """Position of each fiber's end in the image.

    Attributes
    ----------
    names : tuple of str
        Names of the F fibers, in the probe's order.
    center_px, center_stderr_px : ndarray of float64, shape (F, 2)
        x right, y down, pixel (0, 0)'s center at (0, 0). For a fiber without a spot: extrapolated
        from the others.
    radius_px, radius_stderr_px : ndarray of float64, shape (F,)
        Radius at half brightness; the mean of the others for a fiber without a spot.
    edge_px : ndarray of float64, shape (F,)
        Standard deviation of the edge's blur.
    found : ndarray of bool, shape (F,)
    aperture_px : float
        Radius of the disc over which a spot's light is summed, common to all.
    shift_px : tuple of (float, float)
        Mean of the positions minus the nominal ones.
    rotation_rad : float
        Rotation of the row, from x to y.
    findings : tuple of str
        Faults: fibers that are dark, spots that overlap.
    """

    names: tuple[str, ...]
    center_px: Float64Array
    center_stderr_px: Float64Array
    radius_px: Float64Array
    radius_stderr_px: Float64Array
    edge_px: Float64Array
    found: BoolArray
    aperture_px: float
    shift_px: tuple[float, float] = (0.0, 0.0)
    rotation_rad: float = 0.0
    findings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Convert and check the arrays against each other."""
        count = len(self.names)
        freeze_arrays(self, (count, 2), "center_px", "center_stderr_px")
        freeze_arrays(self, (count,), "radius_px", "radius_stderr_px", "edge_px")
        freeze_arrays(self, (count,), "found", kind=np.bool_)
        if not (self.aperture_px > 0 and (self.radius_px > 0).all()):
            raise ValueError("FiberSpots: got a radius or an aperture <= 0, expected pixels > 0")

    @property
    def overlapping(self) -> BoolArray:
        """Whether a fiber's aperture overlaps another one, shape (F,)."""
        apart = np.linalg.norm(self.center_px[:, None] - self.center_px[None], axis=-1)
        np.fill_diagonal(apart, np.inf)
        return np.asarray(apart.min(axis=1) < 2.0 * self.aperture_px)

    def mask(self, fiber: int, shape: tuple[int, ...]) -> BoolArray:
        """Return the pixels whose centers are in a fiber's aperture, shape (H, W)."""
        return _within(shape, self.center_px[fiber], self.aperture_px)

    def track(self, merged: MergedSeries, pattern: str) -> tuple[FiberSpots, Float64Array]:
        """Return the spots in another series, and their shift.

        Parameters
        ----------
        merged : MergedSeries
            A later series; half of the row or more must have light.
        pattern : str
            Color filter pattern.

        Returns
        -------
        spots : FiberSpots
            Shifted as one, by the mean of the spots above the noise, weighted by their errors.
        shift_px : ndarray of float64, shape (2,)
            0 when too few spots are above the noise.
        """
        image = gray_image(merged, pattern)
        pitch = _pitch(self.center_px)
        used: list[DiscFit] = []
        away, errors = [], []
        for i in np.flatnonzero(self.found & ~self.overlapping):
            fit = fit_disc(merged, image, pattern, self.center_px[i], pitch)
            if fit is not None and np.hypot(*(fit[0][:2] - self.center_px[i])) < 0.5 * pitch:
                used.append(fit)
                away.append(fit[0][:2] - self.center_px[i])
                errors.append(max(float(fit[1][:2].max()), 0.02))
        if len(away) < 3:
            return self, np.zeros(2)
        warn_of_unfinished_fits(used)
        weight = 1.0 / np.array(errors) ** 2
        shift = (weight[:, None] * np.array(away)).sum(axis=0) / weight.sum()
        return replace(self, center_px=self.center_px + shift), shift


def find_fiber_spots(
    merged: MergedSeries,
    nominal_px: FloatArray,
    *,
    names: Sequence[str],
    pattern: str,
    masks: Mapping[int, MergedSeries] | None = None,
) -> FiberSpots:
    """Find the fibers' ends in the image of a bright target.

    Parameters
    ----------
    merged : MergedSeries
        Series of the phantom, all fibers uncovered.
    nominal_px : array_like, shape (F, 2)
        Nominal positions, in the probe's order; the row as a whole may be shifted by up to half the
        distance of neighbors, and slightly rotated.
    names : sequence of F str
    pattern : str
        Color filter pattern.
    masks : mapping of int to MergedSeries, optional
        Series with one fiber uncovered, by its number: they separate fibers whose spots touch, and
        check the order.

    Returns
    -------
    FiberSpots
        Fibers without a spot are reported, not an error.

    Raises
    ------
    SpotError
        When there are more spots than fibers, spots away from any fiber, or fewer than half.
    """
    nominal = np.asarray(nominal_px, np.float64)
    count = len(nominal)
    pitch = _pitch(nominal)
    image = gray_image(merged, pattern)
    fits = []
    for place in find_candidates(image, pitch):
        fit = fit_disc(merged, image, pattern, place, pitch)
        if fit is not None:
            fits.append(fit)
    fits = drop_duplicate_fits(fits, 0.25 * pitch)
    if not fits:
        raise FiberSpotError(
            f"fiber spots: found none in the image, expected {count} in a row {pitch:.0f} px "
            "apart; check that the light was on, the head on the phantom, and the exposures "
            "[SR-CAL-015]"
        )
    typical = float(np.median([fit[2] for fit in fits]))
    whole = [fit for fit in fits if 0.5 * typical < fit[2] < 2.5 * typical]
    places = np.array([fit[0][:2] for fit in whole])
    spot, model = _assign(places, nominal, pitch)
    between = _between(places, spot, model, pitch)
    stray = [k for k in range(len(whole)) if k not in spot and k not in between]
    if stray:
        where = "; ".join(f"x {places[k][0]:.0f}, y {places[k][1]:.0f} px" for k in stray[:6])
        raise FiberSpotError(
            f"fiber spots: found {len(whole)} spots, of which {len(stray)} are where none of "
            f"the {count} fibers ends ({where}); check the orientation of the image, that no "
            "other light enters the camera, and the positions in the rig's file"
        )
    found = spot >= 0
    if found.sum() < max(MIN_SPOT_FRACTION * count, 2):
        where = ", ".join(f"{x:.0f}" for x in sorted(places[:, 0]))
        raise FiberSpotError(
            f"fiber spots: found {int(found.sum())} (at x {where} px), expected {count}, at "
            f"least {int(np.ceil(MIN_SPOT_FRACTION * count))}; check the phantom's contact, the "
            "light and the exposures"
        )
    best: list[DiscFit | None] = [whole[k] if k >= 0 else None for k in spot]
    findings = [
        f"{names[i]} and {names[j]} end in one spot, x {places[k][0]:.0f}, y {places[k][1]:.0f} px"
        for k, (i, j) in between.items()
    ]
    _consult_masks(best, masks or {}, model, names, pattern, pitch, findings)
    warn_of_unfinished_fits(fit for fit in best if fit is not None)
    return _table(best, model, nominal, names, findings)


def _consult_masks(
    best: list[DiscFit | None],
    masks: Mapping[int, MergedSeries],
    model: Float64Array,
    names: Sequence[str],
    pattern: str,
    pitch: float,
    findings: list[str],
) -> None:
    """Measure touching or missing fibers in their own frames, and check the order."""
    known = np.array([model[i] if fit is None else fit[0][:2] for i, fit in enumerate(best)])
    size = float(np.median([fit[2] for fit in best if fit is not None]))
    apart = np.linalg.norm(known[:, None] - known[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    for i in sorted(masks):
        series = masks[i]
        fit = best[i]
        doubtful = fit is None or apart[i].min() < 2.2 * size or not 0.8 < fit[2] / size < 1.25
        image = gray_image(series, pattern)
        alone = find_candidates(image, pitch)
        if len(alone) == 0:
            continue  # too faint to measure
        brightest = alone[0]
        nearest = int(np.argmin(np.linalg.norm(model - brightest, axis=1)))
        if (
            nearest != i
            and np.linalg.norm(model[nearest] - brightest) < MAX_SPOT_OFFSET_PITCH * pitch
        ):
            if best[i] is None:
                continue  # dark: the spot is a neighbor's leak
            raise FiberSpotError(
                f"fiber spots: with only {names[i]} uncovered the brightest spot is that of "
                f"{names[nearest]} (x {brightest[0]:.0f}, y {brightest[1]:.0f} px); check the "
                "cover, and the order of the fibers in the rig's file"
            )
        fit = fit_disc(series, image, pattern, brightest, pitch) if doubtful else None
        if fit is not None and np.linalg.norm(fit[0][:2] - model[i]) < 0.5 * pitch:
            best[i] = fit
            findings.append(f"{names[i]}: its position is from the frames with it alone uncovered")


def _table(
    best: list[DiscFit | None],
    model: Float64Array,
    nominal: Float64Array,
    names: Sequence[str],
    findings: list[str],
) -> FiberSpots:
    found = np.array([fit is not None for fit in best])
    fits = [fit for fit in best if fit is not None]
    size, edge = (float(np.median([fit[0][k] for fit in fits])) for k in (2, 3))
    off = [np.hypot(*(fit[0][:2] - model[i])) for i, fit in enumerate(best) if fit is not None]
    scatter = max(float(np.median(off)), 0.1)
    value = np.array(
        [[*model[i], size, edge] if fit is None else fit[0] for i, fit in enumerate(best)]
    )
    unknown = [scatter, scatter, 0.1 * size, 0.0]
    error = np.array([unknown if fit is None else fit[1] for fit in best])
    radius = np.where(found, value[:, 2], size)
    pitch = _pitch(value[:, :2])
    reach = size + APERTURE_EDGE_WIDTHS * edge
    aperture = min(reach, 0.5 * pitch)
    touching = " ".join(findings)
    for i in np.flatnonzero(~found).tolist():
        if names[i] in touching:
            continue
        findings.append(
            f"{names[i]}: no spot at x {model[i, 0]:.0f}, y {model[i, 1]:.0f} px: the fiber is "
            "dark, or its light too faint"
        )
    shift = (value[found, :2] - nominal[found]).mean(axis=0)
    turn = np.polyfit(value[found, 0], value[found, 1] - nominal[found, 1], 1)[0]
    centers, radii = (value[:, :2], error[:, :2]), (radius, error[:, 2])
    moved = float(shift[0]), float(shift[1])
    turned = float(np.arctan(turn))
    table = FiberSpots(
        tuple(names), *centers, *radii, value[:, 3], found, float(aperture), moved, turned
    )
    for i in np.flatnonzero(table.overlapping).tolist():
        gaps = np.linalg.norm(table.center_px - table.center_px[i], axis=1)
        gaps[i] = np.inf
        other = int(np.argmin(gaps))
        if other > i:
            findings.append(
                f"{names[i]} and {names[other]}: their spots overlap, {gaps[other]:.1f} px apart"
            )
    return replace(table, findings=tuple(findings))


def _assign(
    positions: Float64Array, nominal: Float64Array, pitch: float
) -> tuple[Int64Array, Float64Array]:
    """Return the spot of each fiber (-1: none), and each fiber's expected position."""
    offset = (positions[:, None] - nominal[None]).reshape(-1, 2)
    offset = offset[(np.abs(offset) <= MAX_ROW_SHIFT_PITCH * pitch).all(axis=1)]
    spot = np.full(len(nominal), -1)
    if len(offset) == 0:
        return spot, nominal.copy()
    near = np.linalg.norm(offset[:, None] - offset[None], axis=-1) < 0.15 * pitch
    # the shift with the most matches; of two, the smaller
    votes = near.sum(axis=1) - 1e-3 * np.linalg.norm(offset, axis=1) / pitch
    model = nominal + offset[near[int(np.argmax(votes))]].mean(axis=0)
    for _ in range(4):
        distance = np.linalg.norm(positions[:, None] - model[None], axis=-1)
        spot = np.full(len(nominal), -1)
        for i in range(len(nominal)):
            k = int(np.argmin(distance[:, i]))
            if distance[k, i] < MAX_SPOT_OFFSET_PITCH * pitch and int(np.argmin(distance[k])) == i:
                spot[i] = k
        seen = np.flatnonzero(spot >= 0)
        if len(seen) < 4:
            break
        model = _fit_similarity(nominal, seen, positions[spot[seen]])
    return spot, model


def _between(
    positions: Float64Array, spot: Int64Array, model: Float64Array, pitch: float
) -> dict[int, tuple[int, int]]:
    """Return the spots between two neighbors of which neither has a spot of its own."""
    found = {}
    for k in set(range(len(positions))) - set(spot.tolist()):
        for i in np.flatnonzero((spot[:-1] < 0) & (spot[1:] < 0)).tolist():
            if np.linalg.norm(0.5 * (model[i] + model[i + 1]) - positions[k]) < 0.3 * pitch:
                found[k] = (i, i + 1)
    return found


def _fit_similarity(
    nominal: Float64Array, observed: Int64Array, found: Float64Array
) -> Float64Array:
    """Return the nominal positions rotated, scaled and shifted onto those found (least squares)."""
    one, two = nominal[observed] @ np.array([1, 1j]), found @ np.array([1, 1j])
    centered = one - one.mean()
    factor = (centered.conj() @ (two - two.mean())) / (centered.conj() @ centered)
    every = factor * (nominal @ np.array([1, 1j]) - one.mean()) + two.mean()
    return np.stack([every.real, every.imag], axis=1)


def _pitch(positions: Float64Array) -> float:
    """Return the median distance of neighbors, px."""
    if len(positions) < 2:
        return 40.0
    return float(np.median(np.linalg.norm(np.diff(positions, axis=0), axis=1)))


def _within(shape: tuple[int, ...], center: Float64Array, radius: float) -> BoolArray:
    mask = np.zeros(shape[:2], np.bool_)
    low = np.maximum(np.floor(center - radius).astype(int), 0)
    high = np.minimum(np.ceil(center + radius).astype(int) + 1, [shape[1], shape[0]])
    if (high <= low).any():
        return mask
    y, x = np.mgrid[low[1] : high[1], low[0] : high[0]]
    mask[low[1] : high[1], low[0] : high[0]] = (x - center[0]) ** 2 + (
        y - center[1]
    ) ** 2 <= radius**2
    return mask
