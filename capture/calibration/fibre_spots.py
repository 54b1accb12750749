"""The ends of the detection fibres in the camera's image: found, measured, put in order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.optimize import least_squares
from scipy.special import erfc

from capture.calibration.fibre_merge import MergedSeries, color_masks
from capture.calibration.record import CalibrationError

__all__ = ["FibreSpots", "SpotError", "find_fibre_spots"]

FloatArray = NDArray[np.float64]

SMOOTH_PITCH: Final = 0.12
"""Blur of the search for spots, in distances between neighbors."""
SIGMAS: Final = 8.0
"""What a spot stands out of the noise by."""
CONTRAST: Final = 0.3
"""What a spot stands out of the light around it by, at least."""
GATE_PITCH: Final = 0.35
"""How far a spot may lie from its place in the row."""
SHIFT_PITCH: Final = 0.5
"""Beyond half a distance between neighbors nobody can tell whose a spot is."""
STRUCTURE: Final = 0.03
"""How far pixels of a spot scatter about a smooth disc, relative."""
UNEVEN: Final = 0.1
"""Slopes and bend of the light over a spot, relative, as large as they may well be."""
LEAST_SHARE: Final = 0.5
"""Of the fibres must show, or the image is not one of this probe."""
EDGES: Final = 2.5
"""Widths of the blurred edge that an aperture reaches beyond the radius."""


class SpotError(CalibrationError):
    """Spots in the image that are not those of the probe's fibres."""


@dataclass(frozen=True, slots=True, eq=False)
class FibreSpots:
    """Where each fibre ends in the image.

    Attributes
    ----------
    names : tuple of str
        Of the F fibres, in the probe's order.
    center_px, center_stderr_px : ndarray of float64, shape (F, 2)
        x right, y down, pixel (0, 0)'s centre at (0, 0). Of a fibre that was not found: where
        the others say that it ends.
    radius_px, radius_stderr_px : ndarray of float64, shape (F,)
        Where the brightness has fallen to half; the mean of the others where not found.
    edge_px : ndarray of float64, shape (F,)
        Standard deviation of the edge's blur.
    found : ndarray of bool, shape (F,)
    aperture_px : float
        Radius of the disc that a spot's light is summed over, one for all.
    shift_px : tuple of (float, float)
        Mean of the places less the nominal ones.
    rotation_rad : float
        Of the row, from x to y.
    findings : tuple of str
        What is wrong: fibres that are dark, spots that overlap.
    """

    names: tuple[str, ...]
    center_px: FloatArray
    center_stderr_px: FloatArray
    radius_px: FloatArray
    radius_stderr_px: FloatArray
    edge_px: FloatArray
    found: NDArray[np.bool_]
    aperture_px: float
    shift_px: tuple[float, float] = (0.0, 0.0)
    rotation_rad: float = 0.0
    findings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Convert and check the arrays against each other."""
        count = len(self.names)
        for name in ("center_px", "center_stderr_px"):
            _freeze(self, name, (count, 2), np.float64)
        for name in ("radius_px", "radius_stderr_px", "edge_px"):
            _freeze(self, name, (count,), np.float64)
        _freeze(self, "found", (count,), np.bool_)
        if not (self.aperture_px > 0 and (self.radius_px > 0).all()):
            raise ValueError("FibreSpots: got a radius or an aperture <= 0, expected pixels > 0")

    @property
    def overlapping(self) -> NDArray[np.bool_]:
        """Where a fibre's aperture meets that of another, shape (F,)."""
        apart = np.linalg.norm(self.center_px[:, None] - self.center_px[None], axis=-1)
        np.fill_diagonal(apart, np.inf)
        return np.asarray(apart.min(axis=1) < 2.0 * self.aperture_px)

    def mask(self, fibre: int, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        """Return the pixels whose centres lie in a fibre's aperture, shape (H, W)."""
        return _within(shape, self.center_px[fibre], self.aperture_px)

    def moved(self, merged: MergedSeries, pattern: str) -> tuple[FibreSpots, FloatArray]:
        """Return the spots where they lie in another series, and how far they went.

        Parameters
        ----------
        merged : MergedSeries
            A later series; half the row or more shall give light.
        pattern : str
            Color filter pattern.

        Returns
        -------
        spots : FibreSpots
            Shifted as one, by the mean of the spots that stand out, weighed by their errors.
        shift_px : ndarray of float64, shape (2,)
            0 where too few stand out to tell.
        """
        image = _gray(merged, pattern)
        pitch = _pitch(self.center_px)
        away, errors = [], []
        for i in np.flatnonzero(self.found & ~self.overlapping):
            fit = _fit(merged, image, pattern, self.center_px[i], pitch)
            if fit is not None and np.hypot(*(fit[0][:2] - self.center_px[i])) < 0.5 * pitch:
                away.append(fit[0][:2] - self.center_px[i])
                errors.append(max(float(fit[1][:2].max()), 0.02))
        if len(away) < 3:
            return self, np.zeros(2)
        weight = 1.0 / np.array(errors) ** 2
        shift = (weight[:, None] * np.array(away)).sum(axis=0) / weight.sum()
        return replace(self, center_px=self.center_px + shift), shift


def find_fibre_spots(
    merged: MergedSeries,
    nominal_px: NDArray[np.floating],
    *,
    names: Sequence[str],
    pattern: str,
    masks: Mapping[int, MergedSeries] | None = None,
) -> FibreSpots:
    """Find the fibres' ends in the image of a bright target.

    Parameters
    ----------
    merged : MergedSeries
        Of the phantom, all fibres uncovered.
    nominal_px : array_like, shape (F, 2)
        Nominal places, in the probe's order; the row as a whole may lie up to half the distance
        between neighbors away, and turned a little.
    names : sequence of F str
    pattern : str
        Color filter pattern.
    masks : mapping of int to MergedSeries, optional
        Series with one fibre uncovered, by its number: they tell fibres whose spots touch, and
        check the order.

    Returns
    -------
    FibreSpots
        Fibres without a spot are reported, not an error.

    Raises
    ------
    SpotError
        Where there are more spots than fibres, spots at places of no fibre, or fewer than half.
    """
    nominal = np.asarray(nominal_px, np.float64)
    count = len(nominal)
    pitch = _pitch(nominal)
    image = _gray(merged, pattern)
    fits = []
    for place in _candidates(image, pitch):
        fit = _fit(merged, image, pattern, place, pitch)
        if fit is not None:
            fits.append(fit)
    fits = _distinct(fits, 0.25 * pitch)
    if not fits:
        raise SpotError(
            f"fibre spots: found none in the image, expected {count} in a row {pitch:.0f} px apart;"
            " check that the light was on, the head on the phantom, and the exposures"
        )
    typical = float(np.median([fit[2] for fit in fits]))
    whole = [fit for fit in fits if 0.5 * typical < fit[2] < 2.5 * typical]
    places = np.array([fit[0][:2] for fit in whole])
    spot, model = _assign(places, nominal, pitch)
    between = _between(places, spot, model, pitch)
    stray = [k for k in range(len(whole)) if k not in spot and k not in between]
    if stray:
        where = "; ".join(f"x {places[k][0]:.0f}, y {places[k][1]:.0f} px" for k in stray[:6])
        raise SpotError(
            f"fibre spots: found {len(whole)} spots, of which {len(stray)} lie where none of the"
            f" {count} fibres ends ({where}); check which way round the image is, that nothing else"
            " shines into the camera, and the places in the rig's file"
        )
    found = spot >= 0
    if found.sum() < max(LEAST_SHARE * count, 2):
        where = ", ".join(f"{x:.0f}" for x in sorted(places[:, 0]))
        raise SpotError(
            f"fibre spots: found {int(found.sum())} (at x {where} px), expected {count}, at least"
            f" {int(np.ceil(LEAST_SHARE * count))}; check the phantom's contact, the light and the"
            " exposures"
        )
    best: list[_Fit | None] = [whole[k] if k >= 0 else None for k in spot]
    findings = [
        f"{names[i]} and {names[j]} end in one spot, x {places[k][0]:.0f}, y {places[k][1]:.0f} px"
        for k, (i, j) in between.items()
    ]
    _consult_masks(best, masks or {}, model, names, pattern, pitch, findings)
    return _table(best, model, nominal, names, findings)


_Fit = tuple[FloatArray, FloatArray, float]
"""x, y, radius, edge in pixels, their standard errors, and the radius of a disc as large as what is
brighter than half."""


def _consult_masks(
    best: list[_Fit | None],
    masks: Mapping[int, MergedSeries],
    model: FloatArray,
    names: Sequence[str],
    pattern: str,
    pitch: float,
    findings: list[str],
) -> None:
    """Measure in their own frames the fibres that touch or are missing, and check the order."""
    known = np.array([model[i] if fit is None else fit[0][:2] for i, fit in enumerate(best)])
    size = float(np.median([fit[2] for fit in best if fit is not None]))
    apart = np.linalg.norm(known[:, None] - known[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    for i in sorted(masks):
        series = masks[i]
        fit = best[i]
        doubtful = fit is None or apart[i].min() < 2.2 * size or not 0.8 < fit[2] / size < 1.25
        image = _gray(series, pattern)
        alone = _candidates(image, pitch)
        if len(alone) == 0:
            continue  # too faint to tell
        brightest = alone[0]
        nearest = int(np.argmin(np.linalg.norm(model - brightest, axis=1)))
        if nearest != i and np.linalg.norm(model[nearest] - brightest) < GATE_PITCH * pitch:
            if best[i] is None:
                continue  # dark: what shows is a neighbor's leak
            raise SpotError(
                f"fibre spots: with only {names[i]} uncovered the brightest spot is that of"
                f" {names[nearest]} (x {brightest[0]:.0f}, y {brightest[1]:.0f} px); check the"
                " cover, and the order of the fibres in the rig's file"
            )
        fit = _fit(series, image, pattern, brightest, pitch) if doubtful else None
        if fit is not None and np.linalg.norm(fit[0][:2] - model[i]) < 0.5 * pitch:
            best[i] = fit
            findings.append(f"{names[i]}: its place is from the frames with it alone uncovered")


def _table(
    best: list[_Fit | None],
    model: FloatArray,
    nominal: FloatArray,
    names: Sequence[str],
    findings: list[str],
) -> FibreSpots:
    found = np.array([fit is not None for fit in best])
    fits = [fit for fit in best if fit is not None]
    size, edge = (float(np.median([fit[0][k] for fit in fits])) for k in (2, 3))
    scatter = float(
        np.median(
            [np.hypot(*(fit[0][:2] - model[i])) for i, fit in enumerate(best) if fit is not None]
        )
    )
    value = np.array(
        [[*model[i], size, edge] if fit is None else fit[0] for i, fit in enumerate(best)]
    )
    error = np.array(
        [
            [max(scatter, 0.1), max(scatter, 0.1), 0.1 * size, 0.0] if fit is None else fit[1]
            for fit in best
        ]
    )
    radius = np.where(found, value[:, 2], size)
    pitch = _pitch(value[:, :2])
    reach = size + EDGES * edge
    aperture = min(reach, 0.5 * pitch)
    touching = " ".join(findings)
    for i in np.flatnonzero(~found).tolist():
        if names[i] in touching:
            continue
        findings.append(
            f"{names[i]}: no spot at x {model[i, 0]:.0f}, y {model[i, 1]:.0f} px: the fibre is dark"
        )
    shift = (value[found, :2] - nominal[found]).mean(axis=0)
    turn = np.polyfit(value[found, 0], value[found, 1] - nominal[found, 1], 1)[0]
    table = FibreSpots(
        tuple(names), value[:, :2], error[:, :2], radius, error[:, 2], value[:, 3], found,
        float(aperture), (float(shift[0]), float(shift[1])), float(np.arctan(turn)),
    )  # fmt: skip
    for i in np.flatnonzero(table.overlapping).tolist():
        gaps = np.linalg.norm(table.center_px - table.center_px[i], axis=1)
        gaps[i] = np.inf
        other = int(np.argmin(gaps))
        if other > i:
            findings.append(
                f"{names[i]} and {names[other]}: their spots overlap, {gaps[other]:.1f} px apart"
            )
    return replace(table, findings=tuple(findings))


def _gray(merged: MergedSeries, pattern: str) -> tuple[FloatArray, FloatArray]:
    """Return the sum of a cell's colors at every pixel, and its variance; gaps are filled."""
    values = np.where(merged.valid, merged.rate, merged.smooth)
    # saturated in every frame: brighter than what was measured anywhere near
    if merged.saturated.any():
        top = float(values.max(initial=0.0))
        values = np.where(merged.saturated, max(top, 1e-12), values)
    if pattern == "MONO":
        return values, merged.variance
    total, variance = np.zeros_like(values), np.zeros_like(values)
    padded = np.pad(values, 1, mode="edge")
    noisy = np.pad(merged.variance, 1, mode="edge")
    height, width = values.shape
    # (1 2 1) x (1 2 1) holds each color of a 2 x 2 cell with the same weight, about the pixel
    for i, a in enumerate((0.25, 0.5, 0.25)):
        for j, b in enumerate((0.25, 0.5, 0.25)):
            total += a * b * padded[i : i + height, j : j + width]
            variance += (a * b) ** 2 * noisy[i : i + height, j : j + width]
    return total, variance


def _candidates(image: tuple[FloatArray, FloatArray], pitch: float) -> FloatArray:
    """Return the tops that stand out of noise and surroundings, brightest first, shape (n, 2)."""
    gray, variance = image
    blur = SMOOTH_PITCH * pitch
    smooth = gaussian_filter(gray, blur, mode="nearest")
    # the blurred noise of a cell's sum, whose neighbors share pixels: at most 4 pixels' worth
    noise = np.sqrt(gaussian_filter(variance, blur, mode="nearest") * 4.0) / (2.0 * blur)
    side = 2 * int(0.3 * pitch) + 1
    top = smooth == maximum_filter(smooth, side, mode="nearest")
    lift = round(0.65 * pitch)
    above = np.pad(smooth, ((lift, 0), (0, 0)), mode="edge")[: smooth.shape[0]]
    below = np.pad(smooth, ((0, lift), (0, 0)), mode="edge")[lift:]
    around = np.minimum(above, below)
    stands = (smooth - around > SIGMAS * noise) & (smooth - around > CONTRAST * np.abs(around))
    rows, columns = np.nonzero(top & stands & (smooth > 0))
    order = np.argsort(-smooth[rows, columns], kind="stable")[:200]
    return np.stack([columns, rows], axis=1)[order].astype(np.float64)


def _fit(
    merged: MergedSeries,
    image: tuple[FloatArray, FloatArray],
    pattern: str,
    place: FloatArray,
    pitch: float,
) -> _Fit | None:
    """Fit a disc with a blurred edge to the raw mosaic about a place; None where none fits."""
    height, width = merged.rate.shape
    half = int(0.5 * pitch)
    x0, y0 = (round(float(v)) for v in place)
    rows = slice(max(y0 - half, 0), min(y0 + half + 1, height))
    columns = slice(max(x0 - half, 0), min(x0 + half + 1, width))
    if rows.stop - rows.start < half or columns.stop - columns.start < half:
        return None
    y, x = np.mgrid[rows, columns].astype(np.float64)
    good = merged.valid[rows, columns]
    if good.sum() < 50:
        return None
    colors = [mask[rows, columns] & good for mask in color_masks(merged.rate.shape, pattern)]
    value, spread = merged.rate[rows, columns], merged.variance[rows, columns]
    gray = image[0][rows, columns]
    top = float(np.quantile(gray, 0.98))
    bottom = float(np.quantile(gray, 0.02))
    if top <= bottom:
        return None
    area = float((gray > 0.5 * (top + bottom)).sum())
    start_radius = float(np.clip(np.sqrt(area / np.pi), 1.5, 0.5 * pitch))
    order = [np.flatnonzero(mask.ravel()) for mask in colors]
    index = np.concatenate(order)
    color = np.concatenate([np.full(len(part), c) for c, part in enumerate(order)])
    px, py, data = x.ravel()[index], y.ravel()[index], value.ravel()[index]
    levels = np.array(
        [max(float(np.quantile(data[color == c], 0.9)), 0.0) for c in range(len(colors))]
    )
    scale = max(float(levels.max()), 1e-30)
    sigma = np.sqrt(spread.ravel()[index] + (STRUCTURE * levels[color]) ** 2) / scale
    sigma = np.maximum(sigma, 1e-9)
    data = data / scale

    parts = [np.flatnonzero(color == c) for c in range(len(colors))]
    # slopes and bend of a color may be as large as UNEVEN of its level, with a normal prior
    stiff = [np.array([0.0, 1.0, 1.0, 1.0, 0.0]) / (UNEVEN * max(v / scale, 1e-3)) for v in levels]

    def split(p: FloatArray) -> tuple[list[FloatArray], list[FloatArray], FloatArray]:
        """Return residuals of each color's best linear model, and their amplitudes.

        A fibre's modes are not filled alike: light over the disc has slopes and a bend.
        """
        u, v = (px - p[0]) / p[2], (py - p[1]) / p[2]
        d = np.hypot(u, v)
        disc = 0.5 * erfc((d - 1.0) * (p[2] / (np.sqrt(2.0) * p[3])))
        bend = np.minimum(d, 1.2) ** 2 - 0.5
        design = np.stack([disc, disc * u, disc * v, disc * bend, np.ones_like(disc)])
        residuals, priors = [], []
        amplitude = np.zeros(len(parts))
        for c, at in enumerate(parts):
            rows = design[:, at] / sigma[at]
            value = data[at] / sigma[at]
            normal = rows @ rows.T + np.diag(stiff[c] ** 2)
            found = np.linalg.solve(normal + 1e-12 * np.trace(normal) * np.eye(5), rows @ value)
            residuals.append(value - found @ rows)
            priors.append((stiff[c] * found)[1:4])
            amplitude[c] = found[0]
        return residuals, priors, amplitude

    def misfit(p: FloatArray) -> FloatArray:
        residuals, priors, _ = split(p)
        return np.concatenate([*residuals, *priors])

    begin = np.array([*place, start_radius, max(0.1 * start_radius, 0.7)])
    low = np.array([place[0] - 0.5 * pitch, place[1] - 0.5 * pitch, 1.0, 0.2])
    high = np.array([place[0] + 0.5 * pitch, place[1] + 0.5 * pitch, 0.7 * pitch, 0.3 * pitch])
    begin = np.clip(begin, low + 1e-6, high - 1e-6)
    done = least_squares(misfit, begin, bounds=(low, high), x_scale=[1, 1, 1, 0.5], max_nfev=30)
    amplitude = split(done.x)[2]
    at_bound = bool(((done.x <= low + 1e-3) | (done.x >= high - 1e-3))[:2].any())
    if at_bound or amplitude.max() <= 0:
        return None
    normal = done.jac.T @ done.jac
    chi2 = 2.0 * done.cost / max(len(data) - 4 - 5 * len(colors), 1)
    try:
        covariance = np.linalg.inv(normal) * max(chi2, 1.0)
    except np.linalg.LinAlgError:
        return None
    error = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if not np.isfinite(error).all() or error[0] > 0.1 * pitch or error[1] > 0.1 * pitch:
        return None
    return done.x, error, start_radius


def _distinct(fits: list[_Fit], apart: float) -> list[_Fit]:
    """Return the fits without those that ended on an earlier one."""
    kept: list[_Fit] = []
    for fit in fits:
        if all(np.hypot(*(fit[0][:2] - other[0][:2])) > apart for other in kept):
            kept.append(fit)
    return kept


def _assign(
    places: FloatArray, nominal: FloatArray, pitch: float
) -> tuple[NDArray[np.int64], FloatArray]:
    """Return the spot of each fibre (-1: none), and where each fibre should end."""
    offset = (places[:, None] - nominal[None]).reshape(-1, 2)
    offset = offset[(np.abs(offset) <= SHIFT_PITCH * pitch).all(axis=1)]
    spot = np.full(len(nominal), -1)
    if len(offset) == 0:
        return spot, nominal.copy()
    near = np.linalg.norm(offset[:, None] - offset[None], axis=-1) < 0.15 * pitch
    # the shift that most agree to; the smaller of two
    votes = near.sum(axis=1) - 1e-3 * np.linalg.norm(offset, axis=1) / pitch
    model = nominal + offset[near[int(np.argmax(votes))]].mean(axis=0)
    for _ in range(4):
        distance = np.linalg.norm(places[:, None] - model[None], axis=-1)
        spot = np.full(len(nominal), -1)
        for i in range(len(nominal)):
            k = int(np.argmin(distance[:, i]))
            if distance[k, i] < GATE_PITCH * pitch and int(np.argmin(distance[k])) == i:
                spot[i] = k
        seen = np.flatnonzero(spot >= 0)
        if len(seen) < 4:
            break
        model = _similar(nominal, seen, places[spot[seen]])
    return spot, model


def _between(
    places: FloatArray, spot: NDArray[np.int64], model: FloatArray, pitch: float
) -> dict[int, tuple[int, int]]:
    """Return the spots that lie between two neighbors of which neither has one of its own."""
    found = {}
    for k in set(range(len(places))) - set(spot.tolist()):
        for i in np.flatnonzero((spot[:-1] < 0) & (spot[1:] < 0)).tolist():
            if np.linalg.norm(0.5 * (model[i] + model[i + 1]) - places[k]) < 0.3 * pitch:
                found[k] = (i, i + 1)
    return found


def _similar(nominal: FloatArray, seen: NDArray[np.int64], found: FloatArray) -> FloatArray:
    """Return the nominal places turned, scaled and shifted onto those found (least squares)."""
    one, two = nominal[seen] @ np.array([1, 1j]), found @ np.array([1, 1j])
    centered = one - one.mean()
    factor = (centered.conj() @ (two - two.mean())) / (centered.conj() @ centered)
    every = factor * (nominal @ np.array([1, 1j]) - one.mean()) + two.mean()
    return np.stack([every.real, every.imag], axis=1)


def _pitch(places: FloatArray) -> float:
    """Return the usual distance of neighbors, px."""
    if len(places) < 2:
        return 40.0
    return float(np.median(np.linalg.norm(np.diff(places, axis=0), axis=1)))


def _within(shape: tuple[int, ...], center: FloatArray, radius: float) -> NDArray[np.bool_]:
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


def _freeze(row: Any, name: str, shape: tuple[int, ...], kind: Any) -> None:
    array = np.array(getattr(row, name), dtype=kind)
    if array.shape != shape or (kind is np.float64 and not np.isfinite(array).all()):
        raise ValueError(
            f"{type(row).__name__}.{name}: got shape {array.shape}, expected finite numbers of"
            f" shape {shape}"
        )
    array.setflags(write=False)
    object.__setattr__(row, name, array)
