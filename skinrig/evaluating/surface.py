"""Evaluate maps on a mesh against ground truth on another mesh, at the same points.

The truth is interpolated between its texels: relief turns normals by a good part of their error
from one texel to the next.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model import metrics
from model.skin import SkinAppearance, SkinMap
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import BoolArray, Float32Array, Float64Array
from skinrig.evaluating import skin_bands

MAX_MATCH_DISTANCE_MM = 3.0
"""Maximum distance of an evaluated point from the true surface, mm."""
MAX_TEXEL_STRETCH = 5.0
"""Maximum distance of neighboring texels of the truth over their median distance; farther ones are
of different charts."""
CHANNEL_NAMES = ("red", "green", "blue")
NORMAL_MAPS = ("half_vector_normals", "normals", "normals_refined")

MAX_NORMAL_ERROR_DEG = 1.0
MAX_EVALUATED_PIXEL_MM = 1.1
"""Maximum size of a pixel on the face, mm, for the limit of normals: larger pixels average over
eyelids, nostrils and lips."""
MAX_ALBEDO_ERROR = 0.03

Banded = tuple[str, str, str, int, float, float, float]
"""Map, unit, band, points, masked %, median and 95th percentile of the absolute error."""
MIN_POINTS = 20
"""Minimum number of points of a reported band."""
MIN_BAND_FRACTION = 0.002
"""Minimum fraction of the points in a reported band; fewer are nevi that pixels do not resolve."""

# An error with independent Gaussian components of equal standard deviation s in two directions has
# Rayleigh-distributed length: P(length < r) = 1 - exp(-r^2 / 2 s^2) = 0.6827 at r = RAYLEIGH_68 s.
RAYLEIGH_68 = math.sqrt(-2.0 * math.log(1.0 - 0.6827))


class SurfaceTruthError(ValueError):
    """An appearance and a ground truth that cannot be compared."""


@dataclass(frozen=True, slots=True)
class TexelMatch:
    """Place in the ground truth's texture of each texel of an estimate.

    Attributes
    ----------
    rows, columns
        Texels of the estimate, shape (N,).
    corners
        Flat indices of four texels of the truth, the nearest one first, shape (N, 4).
    weights
        Their weights, shape (N, 4), of sum 1; that of the nearest is 1 where the others are not
        all usable.
    distance_mm
        Distance to the nearest one, mm, shape (N,).
    """

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    corners: NDArray[np.intp]
    weights: Float64Array
    distance_mm: Float64Array

    def interpolate(self, truth: SkinMap) -> Float64Array:
        """Return the values of a map of the truth at the estimate's texels, shape (N, ...)."""
        flat = truth.values.reshape(-1, *truth.values.shape[2:])
        return np.asarray(np.einsum("nk,nk...->n...", self.weights, flat[self.corners]))


@dataclass(frozen=True, slots=True)
class SurfaceAccuracy:
    """Accuracy of one map of a surface, or of one of its channels.

    Attributes
    ----------
    name
        Name of the map, with its channel.
    unit
        "deg", or "%" of the truth.
    points, masked
        Texels with ground truth, and the fraction of them without a valid estimate.
    mean, median, interval, high
        Absolute error: mean, median with its 68 % bootstrap interval, 95th percentile.
    bias
        Median of the signed error; NaN for angles.
    coverage
        Fraction of true values in the 68 % region of the estimate.
    median_stderr
        Median of the standard error, in ``unit``.
    """

    name: str
    unit: str
    points: int
    masked: float
    mean: float
    median: float
    interval: tuple[float, float]
    high: float
    bias: float
    coverage: metrics.Coverage
    median_stderr: float

    @property
    def limit_check(self) -> tuple[str, float, float]:
        """Quantity with a limit: its name, value and limit, in ``unit``."""
        if self.unit == "deg":
            return "mean error", self.mean, MAX_NORMAL_ERROR_DEG
        return "median error", self.median, 100.0 * MAX_ALBEDO_ERROR


def match_texels(
    appearance: SkinAppearance,
    truth: SkinAppearance,
    *,
    max_distance_mm: float = MAX_MATCH_DISTANCE_MM,
) -> TexelMatch:
    """Find the place of each texel of an estimate between the texels of the truth.

    Parameters
    ----------
    appearance, truth
        Both with a map "position", mm, in the rig's frame.
    max_distance_mm
        Texels farther from every true one are omitted.

    Raises
    ------
    SurfaceTruthError
        If a position map is missing, or no texel is within this distance.
    """
    from scipy.spatial import cKDTree

    for name, side in (("appearance", appearance), ("truth", truth)):
        if "position" not in side.maps:
            raise SurfaceTruthError(f"{name}: has no map 'position'; compare maps of the dome")
    rows, columns = np.nonzero(intersect_valid(appearance.maps["position"]))
    place = appearance.maps["position"].values[rows, columns]
    true_place = truth.maps["position"]
    usable = intersect_valid(true_place)
    if "mask" in truth.maps:
        usable = usable & (truth.maps["mask"].values > 0.5)
    # masked true texels take part in the search: a texel nearest to one, such as under an
    # eyebrow, has no truth
    known = np.flatnonzero(usable | np.any(true_place.values != 0.0, axis=-1))
    if not usable.any():
        raise SurfaceTruthError("truth: got no valid texel, expected some; check its mask")
    tree = cKDTree(true_place.values.reshape(-1, 3)[known])
    distance, index = tree.query(place, workers=1)
    near = (distance <= max_distance_mm) & usable.reshape(-1)[known[index]]
    if not near.any():
        raise SurfaceTruthError(
            f"position: no texel lies within {max_distance_mm:g} mm of the true surface; nearest "
            f"{distance.min() if len(distance) else math.nan:.1f} mm; register the scan"
        )
    corners, weights = _interpolation(
        true_place.values.astype(np.float64), usable, known[index[near]], place[near]
    )
    return TexelMatch(rows[near], columns[near], corners, weights, distance[near])


def _interpolation(
    true_mm: Float64Array, usable: BoolArray, nearest: NDArray[np.intp], place_mm: Float32Array
) -> tuple[NDArray[np.intp], Float64Array]:
    """Return four texels around each place, (N, 4), and their bilinear weights.

    The nearest texel alone counts where the others are not usable, or far from it: at the border of
    a chart the next texel can be elsewhere on the surface.
    """
    height, width = usable.shape
    row, column = np.divmod(nearest, width)
    away = place_mm - true_mm[row, column]
    ways, lengths, inside = [], [], np.ones(len(nearest), np.bool_)
    for i, j, here, size in ((1, 0, row, height), (0, 1, column, width)):
        there = (here > 0) & (here < size - 1)
        ahead = row + i * there, column + j * there
        behind = row - i * there, column - j * there
        inside &= there & usable[ahead] & usable[behind]
        ways.append(0.5 * (true_mm[ahead] - true_mm[behind]))
        for side in (ahead, behind):
            lengths.append(np.linalg.norm(true_mm[side] - true_mm[row, column], axis=-1))
    slopes = np.stack(ways, axis=1)
    gram = np.einsum("nak,nbk->nab", slopes, slopes) + 1e-9 * np.eye(2)
    along = np.linalg.solve(gram, np.einsum("nak,nk->na", slopes, away)[..., None])[..., 0]
    a, b = np.clip(np.abs(along), 0.0, 1.0).T
    steps = np.where(along < 0.0, -1, 1).T * inside
    rows = np.stack([row, row + steps[0], row, row + steps[0]], axis=1)
    columns = np.stack([column, column, column + steps[1], column + steps[1]], axis=1)
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], axis=1)
    lengths.append(
        np.linalg.norm(true_mm[rows[:, 3], columns[:, 3]] - true_mm[row, column], axis=-1)
    )
    apart = np.array(lengths)
    together = (apart < MAX_TEXEL_STRETCH * np.median(apart)).all(axis=0)
    good = (inside & usable[rows, columns].all(axis=1) & together)[:, None]
    # values of texels that are not usable are undefined: they must not be read at all
    corners = np.where(good, rows * width + columns, nearest[:, None])
    return corners, np.where(good, weights, np.array([1.0, 0.0, 0.0, 0.0]))


def compare(
    appearance: SkinAppearance, truth: SkinAppearance, *, rng: np.random.Generator
) -> list[SurfaceAccuracy]:
    """Compare normals and albedo with the ground truth.

    Parameters
    ----------
    appearance
        Any of the maps :data:`NORMAL_MAPS` and "r_d". A normal's standard error is the angle in
        each of two perpendicular directions, rad, the same in all three channels.
    truth
        With "position", "normals", "r_d" and optionally "mask".
    rng
        For the bootstrap intervals.
    """
    pairs = match_texels(appearance, truth)
    rows = []
    for name in NORMAL_MAPS:
        if name in appearance.maps and "normals" in truth.maps:
            rows.append(_angles(name, appearance.maps[name], truth, pairs, rng))
    if "r_d" in appearance.maps and "r_d" in truth.maps:
        rows += _channels("r_d", appearance.maps["r_d"], truth, pairs, rng)
    return rows


def matched_errors(
    name: str, appearance: SkinAppearance, truth: SkinAppearance, pairs: TexelMatch
) -> Float64Array:
    """Return a map's error at each matched texel; NaN if the estimate is not valid.

    Errors of normals are angles, degrees; others are relative to the truth, %, averaged over
    channels.
    """
    estimate = appearance.maps[name]
    values = estimate.values[pairs.rows, pairs.columns].astype(np.float64)
    good = intersect_valid(estimate)[pairs.rows, pairs.columns]
    true_name = "normals" if name in NORMAL_MAPS else name
    true_values = pairs.interpolate(truth.maps[true_name])
    if name in NORMAL_MAPS:
        error = np.degrees(metrics.angular_error_rad(values, true_values))
    else:
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = (values - true_values) / true_values
        error = 100.0 * (relative.mean(axis=-1) if relative.ndim == 2 else relative)
    return np.where(good, error, np.nan)


def errors_by_band(appearance: SkinAppearance, truth: SkinAppearance) -> list[Banded]:
    """Return errors of normals and R_d (mean of channels) by skin color, from light to dark.

    Parameters
    ----------
    appearance, truth
        See `compare`; a truth without "r_d" has no skin color, and the result is empty.
    """
    if "r_d" not in truth.maps:
        return []
    pairs = match_texels(appearance, truth)
    true_color = pairs.interpolate(truth.maps["r_d"])
    bands = skin_bands.classify_typology(skin_bands.typology_angle_deg(true_color))
    rows: list[Banded] = []
    for key in ("r_d", *NORMAL_MAPS):
        if key not in appearance.maps or (key != "r_d" and "normals" not in truth.maps):
            continue
        error = np.abs(matched_errors(key, appearance, truth, pairs))
        for band in skin_bands.TYPOLOGY_NAMES:
            own = error[bands == band]
            finite = own[np.isfinite(own)]
            few = len(own) < max(MIN_POINTS, MIN_BAND_FRACTION * len(error))
            if few or not len(finite):
                continue
            unit = "%" if key == "r_d" else "°"
            masked = 100.0 * (1.0 - len(finite) / len(own))
            middle, high = np.percentile(finite, [50, 95])
            rows.append((key, unit, band, len(own), masked, float(middle), float(high)))
    return rows


def _angles(
    name: str, estimate: SkinMap, truth: SkinAppearance, pairs: TexelMatch, rng: np.random.Generator
) -> SurfaceAccuracy:
    good = intersect_valid(estimate)[pairs.rows, pairs.columns]
    normals = estimate.values[pairs.rows, pairs.columns][good].astype(np.float64)
    angle = metrics.angular_error_rad(normals, pairs.interpolate(truth.maps["normals"])[good])
    stderr = None
    if estimate.stderr is not None:
        stderr = estimate.stderr[pairs.rows, pairs.columns][good][:, 0].astype(np.float64)
    held = (
        metrics.coverage([], [], [])
        if stderr is None
        else metrics.coverage(angle, RAYLEIGH_68 * stderr, np.zeros(len(angle)))
    )
    spread = math.nan if stderr is None or not len(stderr) else math.degrees(np.median(stderr))
    return _row(name, "deg", np.degrees(angle), good, held, spread, math.nan, rng)


def _channels(
    name: str, estimate: SkinMap, truth: SkinAppearance, pairs: TexelMatch, rng: np.random.Generator
) -> list[SurfaceAccuracy]:
    good = intersect_valid(estimate)[pairs.rows, pairs.columns]
    values = estimate.values[pairs.rows, pairs.columns][good].astype(np.float64)
    true_values = pairs.interpolate(truth.maps[name])[good]
    rows = []
    for channel, color in enumerate(CHANNEL_NAMES):
        value, true_value = values[:, channel], true_values[:, channel]
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = (value - true_value) / true_value
        held, spread = metrics.coverage([], [], []), math.nan
        if estimate.stderr is not None:
            stderr = estimate.stderr[pairs.rows, pairs.columns][good][:, channel]
            held = metrics.coverage(value, stderr.astype(np.float64), true_value)
            with np.errstate(divide="ignore", invalid="ignore"):
                spread = float(100.0 * np.median(stderr / np.abs(value))) if len(value) else spread
        bias = float(100.0 * np.median(relative)) if len(relative) else math.nan
        rows.append(
            _row(f"{name} {color}", "%", 100.0 * np.abs(relative), good, held, spread, bias, rng)
        )
    return rows


def _row(
    name: str,
    unit: str,
    error: Float64Array,
    valid: BoolArray,
    coverage: metrics.Coverage,
    stderr: float,
    bias: float,
    rng: np.random.Generator,
) -> SurfaceAccuracy:
    median, interval = metrics.median_with_interval(error, rng=rng)
    return SurfaceAccuracy(
        name=name,
        unit=unit,
        points=len(valid),
        masked=1.0 - float(valid.mean()) if len(valid) else math.nan,
        mean=float(error.mean()) if len(error) else math.nan,
        median=median,
        interval=interval,
        high=float(np.percentile(error, 95)) if len(error) else math.nan,
        bias=bias,
        coverage=coverage,
        median_stderr=stderr,
    )
