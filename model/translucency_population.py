"""Population of sigma_tr over people and facial sites: table 2 of Weyrich et al. 2005.

The table gives a mean and a "Var." of sigma_tr for three facial sites and three channels. Read as
variances these numbers contradict the extremes that the same paper prints, so they are taken as
standard deviations here (decision 10); ``reading="variance"`` takes them literally.

All values are sigma_tr, in 1/mm. Translucency is 1/sigma_tr, so the subject of smallest sigma_tr is
the *most* translucent one. The captions of the paper's figures 17 and 18 call the subject of
smallest sigma_tr that of "minimum translucency": either the captions or the numbers in the text are
swapped; the text's definition of translucency is used here.

The paper gives no distribution and no correlations. sigma_tr is positive, so its logarithm is
assumed normal, with both moments matched exactly. Correlations of the logarithms,
`SITE_CORRELATION` and `CHANNEL_CORRELATION`, are assumed.

References
----------
Weyrich et al. 2005, A Measurement-Based Skin Reflectance Model for Face Rendering and Editing,
MERL TR2005-071, section 10.3. Published as doi:10.1145/1141911.1141987
"""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import BoolArray, Float64Array, Int64Array
from model.checks import Checks

Reading: TypeAlias = Literal["deviation", "variance"]

SITE_NAMES = ("cheek", "forehead", "neck")
"""Sites of table 2, in its order; its neck is measured below the chin."""
CHANNEL_NAMES = ("red", "green", "blue")
SITE_OF_LABEL: Mapping[str, str] = {"chin": "neck", "below the chin": "neck"}
"""Session labels of the table's sites under other names."""
SITE_CORRELATION = 0.25
"""Correlation of log sigma_tr between two sites of a face, one channel. Not in the paper: assumed,
such that the extremes of 87 faces (means over their sites) are close to those of figure 17."""
CHANNEL_CORRELATION = ((1.0, 0.8, 0.5), (0.8, 1.0, 0.7), (0.5, 0.7, 1.0))
"""Correlation of log sigma_tr between channels at a site: assumed. From the subject of smallest to
that of greatest sigma_tr (figure 17) all three rise, blue by little."""


class TranslucencyPopulationError(ValueError):
    """Error for moments, correlations or measurements that do not make a population."""


@dataclass(frozen=True, slots=True)
class TranslucencyPopulation:
    """A lognormal population of sigma_tr over sites and channels.

    Attributes
    ----------
    mean_per_mm, deviation_per_mm : ndarray of float64, shape (S, C)
        Mean and standard deviation of sigma_tr over people, 1/mm, above 0.
    sites, channels : tuple of str
        Names along both axes.
    site_correlation : float
        Correlation of log sigma_tr between any two sites, 0 to 1, below 1.
    channel_correlation : tuple of tuples of float
        Correlation matrix of log sigma_tr over channels, positive definite.
    source : str
        Source of the moments and their reading.
    """

    mean_per_mm: Float64Array
    deviation_per_mm: Float64Array
    sites: tuple[str, ...] = SITE_NAMES
    channels: tuple[str, ...] = CHANNEL_NAMES
    site_correlation: float = SITE_CORRELATION
    channel_correlation: tuple[tuple[float, ...], ...] = CHANNEL_CORRELATION
    source: str = ""

    def __post_init__(self) -> None:
        """Raise for moments that are not positive, and for impossible correlations."""
        shape = (len(self.sites), len(self.channels))
        for name in ("mean_per_mm", "deviation_per_mm"):
            values = np.array(getattr(self, name), np.float64)
            Checks(TranslucencyPopulationError).numbers(name, values, shape, interval="(0, inf)")
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        Checks(TranslucencyPopulationError).within(
            "site_correlation", self.site_correlation, "[0, 1)"
        )
        matrix = np.array(self.channel_correlation, np.float64)
        if matrix.shape != (shape[1], shape[1]) or not np.array_equal(matrix, matrix.T):
            raise TranslucencyPopulationError(
                f"channel_correlation: got {matrix.tolist()}, expected a symmetric matrix over "
                f"{shape[1]} channels"
            )
        if not (np.diagonal(matrix) == 1).all() or np.linalg.eigvalsh(matrix)[0] <= 0:
            raise TranslucencyPopulationError(
                f"channel_correlation: got {matrix.tolist()}, expected ones on the diagonal and "
                "positive eigenvalues"
            )

    @property
    def log_deviation(self) -> Float64Array:
        """Return the standard deviation of log sigma_tr, (S, C)."""
        return np.sqrt(np.log1p((self.deviation_per_mm / self.mean_per_mm) ** 2))

    @property
    def log_mean(self) -> Float64Array:
        """Return the mean of log sigma_tr, sigma_tr in 1/mm, (S, C)."""
        return np.asarray(np.log(self.mean_per_mm) - 0.5 * self.log_deviation**2)

    def log_covariance(self) -> Float64Array:
        """Return the covariance of log sigma_tr, (S C, S C), channels running fastest."""
        count = len(self.sites)
        between = np.full((count, count), self.site_correlation)
        np.fill_diagonal(between, 1.0)
        correlation = np.kron(between, np.array(self.channel_correlation))
        scale = self.log_deviation.reshape(-1)
        return np.asarray(correlation * np.outer(scale, scale))

    def sample(self, n: int, *, rng: np.random.Generator) -> Float64Array:
        """Draw sigma_tr of people.

        Parameters
        ----------
        n : int
            Number of people, at least 1.
        rng
            Draws them.

        Returns
        -------
        ndarray of float64, shape (n, S, C)
            sigma_tr, 1/mm.

        Examples
        --------
        >>> people = weyrich_2005().sample(1000, rng=np.random.default_rng(1))
        >>> people.shape, bool((people > 0).all()), round(float(people[:, 1, 0].mean()), 2)
        ((1000, 3, 3), True, 0.54)
        """
        Checks(TranslucencyPopulationError).within("n", n, "[1, inf)")
        normal = rng.standard_normal((n, self.log_mean.size))
        logs = self.log_mean.reshape(-1) + normal @ np.linalg.cholesky(self.log_covariance()).T
        return np.asarray(np.exp(logs).reshape(n, *self.log_mean.shape))


@cache
def weyrich_2005(*, reading: Reading = "deviation") -> TranslucencyPopulation:
    """Return the population of table 2 of Weyrich et al. 2005.

    Parameters
    ----------
    reading : {"deviation", "variance"}
        Meaning of the column "Var.": standard deviations (decision 10), or, as printed, variances.

    Examples
    --------
    >>> weyrich_2005().deviation_per_mm[:, 0].tolist()
    [0.1727, 0.0756, 0.2351]
    >>> weyrich_2005(reading="variance").deviation_per_mm[:, 0].round(3).tolist()
    [0.416, 0.275, 0.485]
    """
    Checks(TranslucencyPopulationError).choice("reading", reading, ("deviation", "variance"))
    text = resources.files("model").joinpath("data/weyrich2005_table2.csv").read_text("utf-8")
    rows = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    mean, printed = np.zeros((2, len(SITE_NAMES), len(CHANNEL_NAMES)))
    for row in rows:
        at = SITE_NAMES.index(row["site"]), CHANNEL_NAMES.index(row["channel"])
        mean[at], printed[at] = float(row["mean"]), float(row["var"])
    return TranslucencyPopulation(
        mean,
        np.sqrt(printed) if reading == "variance" else printed,
        source=f'Weyrich et al. 2005, table 2; "Var." read as {reading}',
    )


@dataclass(frozen=True, slots=True)
class SiteMeasurement:
    """Fitted sigma_tr of one person at one site.

    Attributes
    ----------
    subject, site : str
    sigma_tr_per_mm : tuple of float
        One per channel, 1/mm.
    stderr_per_mm : tuple of float
        Their standard errors, 1/mm.
    valid : tuple of bool
        Channels that count; empty: all that are finite and above 0.
    """

    subject: str
    site: str
    sigma_tr_per_mm: tuple[float, ...]
    stderr_per_mm: tuple[float, ...]
    valid: tuple[bool, ...] = ()

    def __post_init__(self) -> None:
        """Raise for lengths that differ."""
        for name in ("sigma_tr_per_mm", "stderr_per_mm"):
            object.__setattr__(self, name, tuple(float(v) for v in getattr(self, name)))
        object.__setattr__(self, "valid", tuple(bool(v) for v in self.valid))
        count = len(self.sigma_tr_per_mm)
        if not count:
            raise TranslucencyPopulationError(
                "sigma_tr_per_mm: got none, expected one value per channel"
            )
        if len(self.stderr_per_mm) != count or (self.valid and len(self.valid) != count):
            raise TranslucencyPopulationError(
                f"stderr_per_mm, valid: got {len(self.stderr_per_mm)}, {len(self.valid)} values, "
                f"expected {count} as of sigma_tr_per_mm"
            )


@dataclass(frozen=True, slots=True)
class PopulationTable:
    """Mean and standard deviation of sigma_tr over people, by site and channel, as in table 2.

    All arrays have shape (S, C), in 1/mm unless stated otherwise.

    Attributes
    ----------
    sites, channels : tuple of str
    count : ndarray of int
        People in each cell. Means are 0 where it is 0, deviations and errors 0 where it is below
        2: they are undefined there.
    mean_per_mm, deviation_per_mm : ndarray
        Over people; the deviation with n - 1.
    mean_stderr_per_mm, deviation_stderr_per_mm : ndarray
        Standard errors from the variance over people; the deviation's does not assume normality.
    noise_per_mm : ndarray
        Root mean square standard error of the measurements behind each person's value; 0 where
        nothing was measured, as in a simulated population.
    """

    sites: tuple[str, ...]
    channels: tuple[str, ...]
    count: Int64Array
    mean_per_mm: Float64Array
    deviation_per_mm: Float64Array
    mean_stderr_per_mm: Float64Array
    deviation_stderr_per_mm: Float64Array
    noise_per_mm: Float64Array

    @property
    def deviation_without_noise_per_mm(self) -> Float64Array:
        """Return the deviation over people in excess of measurement errors; 0 without excess."""
        deviation, noise = self.deviation_per_mm, self.noise_per_mm
        return np.sqrt(np.maximum(deviation - noise, 0.0)) * np.sqrt(deviation + noise)

    def rows(self) -> list[tuple[str, tuple[tuple[float, float], ...]]]:
        """Return table 2's rows: a channel, and for each site mean and deviation, 1/mm."""
        return [
            (
                channel,
                tuple(
                    (float(self.mean_per_mm[s, c]), float(self.deviation_per_mm[s, c]))
                    for s in range(len(self.sites))
                ),
            )
            for c, channel in enumerate(self.channels)
        ]

    def text(self) -> str:
        """Return the table for a terminal, one row per channel: mean and deviation with errors.

        Examples
        --------
        >>> population = weyrich_2005()
        >>> people = population.sample(149, rng=np.random.default_rng(0))
        >>> print(table(people, sites=population.sites).text())
        sigma_tr, 1/mm  cheek                          forehead                       neck
                        mean           deviation       mean           deviation       mean           deviation
        red             0.540 ± 0.013  0.159 ± 0.013   0.533 ± 0.006  0.073 ± 0.005   0.633 ± 0.018  0.217 ± 0.018
        green           0.966 ± 0.017  0.205 ± 0.013   0.966 ± 0.014  0.173 ± 0.012   1.192 ± 0.027  0.329 ± 0.018
        blue            1.561 ± 0.016  0.191 ± 0.011   1.521 ± 0.021  0.255 ± 0.018   1.898 ± 0.036  0.439 ± 0.023
        """  # noqa: E501
        lines = [
            "sigma_tr, 1/mm  " + "".join(f"{name:31s}" for name in self.sites),
            " " * 16 + f"{'mean':15s}{'deviation':16s}" * len(self.sites),
        ]
        for c, channel in enumerate(self.channels):
            cells = ""
            for s in range(len(self.sites)):
                n = self.count[s, c]
                mean = f"{self.mean_per_mm[s, c]:.3f}" if n else "-"
                deviation = "-"
                if n > 1:
                    mean += f" ± {self.mean_stderr_per_mm[s, c]:.3f}"
                    deviation = f"{self.deviation_per_mm[s, c]:.3f}"
                    deviation += f" ± {self.deviation_stderr_per_mm[s, c]:.3f}"
                cells += f"{mean:15s}{deviation:16s}"
            lines.append(f"{channel:16s}{cells}")
        return "\n".join(line.rstrip() for line in lines)


def table(
    sigma_tr_per_mm: ArrayLike,
    *,
    sites: Sequence[str] = SITE_NAMES,
    channels: Sequence[str] = CHANNEL_NAMES,
    stderr_per_mm: ArrayLike | None = None,
    valid: ArrayLike | None = None,
) -> PopulationTable:
    """Tabulate people in table 2's layout.

    Parameters
    ----------
    sigma_tr_per_mm : array_like, shape (n, S, C)
        sigma_tr of n people at S sites in C channels, 1/mm.
    sites, channels : sequence of str
        Names along the last two axes.
    stderr_per_mm : array_like, shape (n, S, C), optional
        Standard errors of measured values, 1/mm; none for a simulated population.
    valid : array_like of bool, shape (n, S, C), optional
        Values that count; the others are ignored.

    Returns
    -------
    PopulationTable

    Raises
    ------
    TranslucencyPopulationError
        For shapes that do not fit, or a counted value that is not finite and above 0.
    """
    values = np.asarray(sigma_tr_per_mm, np.float64)
    check = Checks(TranslucencyPopulationError)
    check.shape("sigma_tr_per_mm", values, ("n", len(sites), len(channels)))
    good = np.ones(values.shape, bool) if valid is None else np.array(valid, bool)
    noise = np.zeros(values.shape)
    if stderr_per_mm is not None:
        noise = np.asarray(stderr_per_mm, np.float64)
    check.shape("valid", good, values.shape)
    check.shape("stderr_per_mm", noise, values.shape)
    check.within("sigma_tr_per_mm, counted", values[good], "(0, inf)")
    check.within("stderr_per_mm, counted", noise[good], "[0, inf)")
    n = good.sum(axis=0)
    some = np.maximum(n, 1)
    # scaled so that squares and fourth powers neither underflow nor overflow
    values, noise = np.where(good, values, 0.0), np.where(good, noise, 0.0)
    unit, noise_unit = (int(np.frexp(of.max(initial=0.0))[1]) for of in (values, noise))
    values, noise = np.ldexp(values, -unit), np.ldexp(noise, -noise_unit)
    mean = values.sum(axis=0) / some
    off = np.where(good, values - mean, 0.0)
    variance = np.where(n > 1, (off**2).sum(axis=0) / np.maximum(n - 1, 1), 0.0)
    fourth = (off**4).sum(axis=0) / some
    # Variance of a sample variance for any distribution, Cramer 1946, section 27.4
    of_variance = np.maximum(fourth - variance**2 * (n - 3) / np.maximum(n - 1, 1), 0.0) / some
    of_variance = np.where(n > 1, of_variance, 0.0)
    deviation = np.sqrt(variance)
    return PopulationTable(
        sites=tuple(sites),
        channels=tuple(channels),
        count=np.asarray(n, np.int64),
        mean_per_mm=np.ldexp(mean, unit),
        deviation_per_mm=np.ldexp(deviation, unit),
        mean_stderr_per_mm=np.ldexp(deviation / np.sqrt(some), unit),
        deviation_stderr_per_mm=np.ldexp(
            np.sqrt(of_variance) / np.where(deviation > 0, 2.0 * deviation, 1.0), unit
        ),
        noise_per_mm=np.ldexp(np.sqrt((noise**2).sum(axis=0) / some), noise_unit),
    )


def summarize(
    measurements: Iterable[SiteMeasurement],
    *,
    sites: Sequence[str] | None = None,
    channels: Sequence[str] = CHANNEL_NAMES,
) -> PopulationTable:
    """Tabulate measured people in table 2's layout.

    Repeats of a person at a site are averaged first, weighted by their errors, so that every person
    counts once; labels are translated by `SITE_OF_LABEL`.

    Parameters
    ----------
    measurements : iterable of SiteMeasurement
        In any order.
    sites : sequence of str, optional
        Sites to list; by default the measured ones of the table, in its order, then others by name.
    channels : sequence of str

    Raises
    ------
    TranslucencyPopulationError
        Without a measurement at these sites, for another number of channels, or a counted
        standard error that is not finite and above 0.

    Examples
    --------
    >>> made = [SiteMeasurement(who, "chin", (0.7, 1.2, 1.9), (0.02, 0.02, 0.04)) for who in "ab"]
    >>> summarize(made).sites, summarize(made).count.tolist()
    (('neck',), [[2, 2, 2]])
    """
    by_person: dict[str, dict[str, list[SiteMeasurement]]] = {}
    for one in measurements:
        if len(one.sigma_tr_per_mm) != len(channels):
            raise TranslucencyPopulationError(
                f"sigma_tr_per_mm: got {len(one.sigma_tr_per_mm)} channels of {one.subject!r}, "
                f"expected {len(channels)}"
            )
        place = SITE_OF_LABEL.get(one.site, one.site)
        by_person.setdefault(one.subject, {}).setdefault(place, []).append(one)
    found = {place for places in by_person.values() for place in places}
    if sites is None:
        sites = [s for s in SITE_NAMES if s in found] + sorted(found - set(SITE_NAMES))
    if not found & set(sites):
        raise TranslucencyPopulationError(
            f"measurements: got none at {', '.join(sites) or 'any site'}, expected at least one"
        )
    shape = (len(by_person), len(sites), len(channels))
    values, errors, good = np.zeros(shape), np.zeros(shape), np.zeros(shape, bool)
    for k, places in enumerate(by_person.values()):
        for s, site in enumerate(sites):
            if site in places:
                values[k, s], errors[k, s], good[k, s] = _averaged(places[site])
    return table(values, sites=sites, channels=channels, stderr_per_mm=errors, valid=good)


def _averaged(repeats: list[SiteMeasurement]) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Return the error-weighted mean of repeats, its standard error, and the mask of channels."""
    values = np.array([one.sigma_tr_per_mm for one in repeats])
    errors = np.array([one.stderr_per_mm for one in repeats])
    counted = np.array([one.valid or (True,) * values.shape[1] for one in repeats])
    counted &= np.isfinite(values) & (values > 0)
    whose = f"stderr_per_mm of {repeats[0].subject!r}"
    Checks(TranslucencyPopulationError).within(whose, errors[counted], "(0, inf)")
    some = np.asarray(counted.any(axis=0), np.bool_)
    # relative to the smallest error: squares of tiny errors underflow
    least = np.where(some, np.where(counted, errors, np.inf).min(axis=0), 1.0)
    weights = np.where(counted, (least / np.where(counted, errors, 1.0)) ** 2, 0.0)
    total = np.where(some, weights.sum(axis=0), 1.0)
    mean = (np.where(counted, values, 0.0) * (weights / total)).sum(axis=0)
    return mean, least / np.sqrt(total), some
