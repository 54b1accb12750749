"""Test how near to Gaussian blood is distributed in regions of a face: figure 7 of Jimenez 2010.

Local histogram matching describes the blood in a disc by mean and deviation, as if it were normally
distributed (eqs. 1 to 3). The Anderson-Darling test with estimated mean and deviation judges this.
Its statistic grows with the sample, so that any real distribution is rejected by enough pixels:
the p-value of all pixels is listed next to that of pixels a correlation length apart.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.signal import correlate
from scipy.special import log_ndtr
from scipy.stats import norm

from model import store
from model.facial_color.rig import local_statistics
from model.skin import SkinAppearance
from reconstruction.correspondence import landmark_table
from reconstruction.facial_color import perfusion_curves
from skinrig import consent
from skinrig.analysing.brdf_space_figures import encode_figure, new_figure
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import BoolArray, Float64Array
from skinrig.atomic_file import write_atomically
from skinrig.errors import UnusableError
from skinrig.unit_format import format_csv

DEFAULT_RADIUS_DIVISOR: Final = 32.0
"""Larger side of the map over the radius of the local statistics, as in `fit facial-color`."""
MIN_PIXELS: Final = 8
"""Pixels below which a test has no power (Stephens 1974, doi:10.1080/01621459.1974.10480196)."""
REJECTION_LEVEL: Final = 0.05
REJECTION_STATISTIC: Final = 0.752
"""Modified statistic at `REJECTION_LEVEL` (D'Agostino and Stephens 1986, table 4.7, case 3)."""
OUTPUT_FILES: Final = ("figure-7.png", "regions.csv", "analysis.json")


@dataclass(frozen=True, slots=True, eq=False)
class BloodDistribution:
    """Distribution of blood in one region, and its distance from a Gaussian.

    Attributes
    ----------
    region
        Name of the region.
    values
        Blood volume fraction of the valid pixels, (n,).
    mean, deviation
        Of the values.
    skewness, excess_kurtosis
        Third and fourth standardized moments; 0 for a Gaussian.
    distance
        Largest difference of the cumulative distribution from the Gaussian's, 0 to 1.
    independent
        Effective number of independent pixels.
    statistic, p_value
        Anderson-Darling statistic and p-value of all pixels.
    spaced_statistic, spaced_p_value
        Medians over samples of pixels a correlation length apart; NaN if these are too few.
    rejected_from
        Number of independent samples of this distribution that the test would reject.
    """

    region: str
    values: Float64Array
    mean: float
    deviation: float
    skewness: float
    excess_kurtosis: float
    distance: float
    independent: float
    statistic: float
    p_value: float
    spaced_statistic: float
    spaced_p_value: float
    rejected_from: float

    def document(self) -> dict[str, Any]:
        """Return the numbers as JSON values; NaN becomes None."""
        found: dict[str, Any] = {"region": self.region, "pixels": int(self.values.size)}
        for name in self.__slots__[2:]:
            value = float(getattr(self, name))
            found[name] = value if math.isfinite(value) else None
        return found


def anderson_darling(values: Float64Array) -> tuple[float, float]:
    """Test normality with estimated mean and deviation.

    Parameters
    ----------
    values
        Sample, (n,), n >= `MIN_PIXELS`, not constant.

    Returns
    -------
    statistic, p_value : float
        The statistic modified for the size of the sample, and its p-value.

    References
    ----------
    D'Agostino and Stephens 1986, Goodness-of-fit techniques, table 4.9, case 3

    Examples
    --------
    >>> statistic, p = anderson_darling(np.linspace(0.0, 1.0, 400))
    >>> p < 0.001 < anderson_darling(norm.ppf((np.arange(400) + 0.5) / 400))[1]
    True
    """
    n = values.size
    z = np.sort((values - values.mean()) / values.std(ddof=1))
    odd = 2.0 * np.arange(1, n + 1) - 1.0
    raw = -n - float(np.mean(odd * (log_ndtr(z) + log_ndtr(-z[::-1]))))
    statistic = raw * (1.0 + 0.75 / n + 2.25 / n**2)
    a = min(statistic, 13.0)  # beyond it the published formula would rise again
    if a > 0.6:
        p = math.exp(1.2937 - 5.709 * a + 0.0186 * a**2)
    elif a > 0.34:
        p = math.exp(0.9177 - 4.279 * a - 1.38 * a**2)
    elif a > 0.2:
        p = 1.0 - math.exp(-8.318 + 42.796 * a - 59.938 * a**2)
    else:
        p = 1.0 - math.exp(-13.436 + 101.14 * a - 223.73 * a**2)
    return statistic, p


def describe_distribution(region: str, image: Float64Array, valid: BoolArray) -> BloodDistribution:
    """Describe the values of one region.

    Parameters
    ----------
    region
        Name.
    image, valid
        Map cut to the region, and its pixels, (h, w).

    Raises
    ------
    UnusableError
        If fewer than `MIN_PIXELS` pixels are valid, or all are equal.
    """
    values = np.asarray(image[valid], np.float64)
    if values.size < MIN_PIXELS or np.ptp(values) == 0.0:
        raise UnusableError(
            f"region {region}: got {values.size} valid pixels, expected {MIN_PIXELS} or more that "
            "differ; raise --radius"
        )
    mean, deviation = float(values.mean()), float(values.std())
    z = np.sort((values - mean) / deviation)
    reference = norm.cdf(z)
    ranks = np.arange(z.size + 1) / z.size
    area = _correlation_area(image - mean, valid)
    spacing = math.ceil(math.sqrt(area))
    spaced = [
        anderson_darling(sample)
        for row in range(spacing)
        for column in range(spacing)
        if (sample := _spaced(image, valid, row, column, spacing)).size >= MIN_PIXELS
        and np.ptp(sample) > 0.0
    ]
    statistic, p = anderson_darling(values)
    middle = np.median(spaced, axis=0) if spaced else np.full(2, np.nan)
    return BloodDistribution(
        region,
        values,
        mean,
        deviation,
        skewness=float(np.mean(z**3)),
        excess_kurtosis=float(np.mean(z**4) - 3.0),
        distance=float(np.maximum(reference - ranks[:-1], ranks[1:] - reference).max()),
        independent=values.size / area,
        statistic=statistic,
        p_value=p,
        spaced_statistic=float(middle[0]),
        spaced_p_value=float(middle[1]),
        rejected_from=REJECTION_STATISTIC / statistic * values.size,
    )


def analyze_blood(
    out: Path, appearance: Path, *, landmarks: Path | None = None, radius_px: float | None = None
) -> dict[str, Any]:
    """Test the blood of the regions of a face and write `OUTPUT_FILES`.

    Parameters
    ----------
    out
        Folder to write.
    appearance
        APPEARANCE/ folder with a map ``hemoglobin`` in an image's frame.
    landmarks
        Table name,x,y, px; None: the ground truth's own, else the face's outline.
    radius_px
        Radius of each region; None: that of `fit facial-color`.

    Returns
    -------
    dict
        JSON values: test, radius, origin of the regions, and one record per region.

    Raises
    ------
    UnusableError, CurveError, LandmarkError
        For a map, radius or table that has no regions.
    """
    read = store.read(appearance)
    if "hemoglobin" not in read.maps:
        names = ", ".join(read.maps) or "none"
        raise UnusableError(
            f"{appearance}: got maps {names}, expected hemoglobin; reconstruct a flash session"
        )
    blood, valid = read.maps["hemoglobin"].values, intersect_valid(read.maps["hemoglobin"])
    radius = max(blood.shape) / DEFAULT_RADIUS_DIVISOR if radius_px is None else radius_px
    if not 1.0 <= radius < max(blood.shape):
        raise UnusableError(
            f"--radius: got {radius:g}, expected pixels from 1 to the map's width; change it"
        )
    places, origin = _find_places(read, valid, landmarks)
    found = []
    for name, place in places.items():
        rows, columns = perfusion_curves.disc_pixels(valid.shape, name, place, radius)
        box = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
        inside = np.zeros(valid.shape, np.bool_)
        inside[rows, columns] = True
        good = (inside & valid)[box]
        found.append(
            describe_distribution(name, np.where(good, blood[box], 0.0).astype(np.float64), good)
        )
    document: dict[str, Any] = {
        "schema": "skinrig.blood-distribution/1",
        "source": read.source,
        consent.CONSENT_KEY: consent.merge_consent(read),
        "test": "Anderson-Darling, mean and deviation estimated",
        "radius_px": float(radius),
        "places": origin,
        "fraction_of_discs": _share_of_discs(blood, valid, radius),
        "regions": [one.document() for one in found],
    }
    contents: tuple[str | bytes, ...] = (
        _draw(np.where(valid, blood, np.nan), places, found, radius),
        format_csv([document["regions"][0], *(one.values() for one in document["regions"])]),
        json.dumps(document, indent=1),
    )
    for file, content in zip(OUTPUT_FILES, contents, strict=True):
        write_atomically(out / file, content)
    return document


def _find_places(
    read: SkinAppearance, valid: BoolArray, landmarks: Path | None
) -> tuple[Mapping[str, tuple[float, float]], str]:
    """Return the positions of the regions, px, and where they are from."""
    if landmarks is not None:
        table = landmark_table.read_landmark_table(landmarks)
        return perfusion_curves.select_sites(table), str(landmarks)
    own: Any = read.parameters.get("landmarks_px")
    if own:
        return perfusion_curves.select_sites({n: (p[0], p[1]) for n, p in own.items()}), "its own"
    return perfusion_curves.standard_positions(valid), "outline of the face"


def _correlation_area(values: Float64Array, valid: BoolArray) -> float:
    """Return the area over which pixels are correlated, px, at least 1.

    It is the integral of the autocorrelation up to the first radius at which its mean is negative.
    """
    shown = np.where(valid, values, 0.0)
    pairs = correlate(valid.astype(np.float64), valid.astype(np.float64), method="fft")
    products = correlate(shown, shown, method="fft")
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = np.where(pairs > 0.5, products / pairs, 0.0) / np.mean(values[valid] ** 2)
    rows, columns = np.indices(rho.shape)
    lag = np.hypot(rows - rho.shape[0] // 2, columns - rho.shape[1] // 2).round().astype(int)
    ring = np.bincount(lag.ravel(), rho.ravel()) / np.bincount(lag.ravel())
    below = np.flatnonzero(ring <= 0.0)
    last = below[0] if below.size else ring.size
    return max(1.0, float(rho[lag < last].sum()))


def _spaced(
    image: Float64Array, valid: BoolArray, row: int, column: int, spacing: int
) -> Float64Array:
    """Return the valid pixels of a grid with a spacing, from one corner."""
    grid = np.s_[row::spacing, column::spacing]
    return np.asarray(image[grid][valid[grid]])


def _share_of_discs(blood: Any, valid: BoolArray, radius: float) -> dict[str, float]:
    """Return how many pixels of the face lie within 1 and 2 deviations of their disc's mean."""
    mean, deviation = local_statistics(blood, radius, valid=valid)
    good = valid & (deviation > 0)
    away = np.abs(blood[good] - mean[good]) / deviation[good]
    return {"within_1_sd": float(np.mean(away < 1.0)), "within_2_sd": float(np.mean(away < 2.0))}


def _draw(
    blood: Float64Array,
    places: Mapping[str, tuple[float, float]],
    found: list[BloodDistribution],
    radius: float,
) -> bytes:
    """Draw the map with its regions, and each histogram with its Gaussian."""
    from matplotlib.patches import Circle

    figure, axes = new_figure(9.6, 5.4, 2, 3)
    face = axes[0, 0]
    shown = face.imshow(blood, cmap="gray_r", vmin=0.0, vmax=float(np.nanpercentile(blood, 99.5)))
    face.axis("off")
    bar = figure.colorbar(shown, ax=face, shrink=0.8)
    bar.set_label("blood volume fraction", fontsize=8)
    for axis, one, k in zip(axes.flat[1:], found, range(len(found)), strict=False):
        color = f"C{k}"
        face.add_patch(Circle(places[one.region], radius, fill=False, ec=color, lw=1.5))
        axis.hist(one.values, 40, density=True, color=color, alpha=0.45)
        x = one.mean + one.deviation * np.linspace(-4.0, 4.0, 200)
        axis.plot(x, norm.pdf(x, one.mean, one.deviation), color=color, lw=1.5)
        axis.set_title(f"{one.region}: distance {one.distance:.3f}", fontsize=9)
        axis.tick_params(labelsize=7)
        axis.set_yticks([])
    for axis in list(axes.flat)[1 + len(found) :]:
        axis.axis("off")
    return encode_figure(figure)
