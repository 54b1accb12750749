"""Statistics of quantities over simulated people: estimates from sessions against ground truth."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from rigsim.population.population import POPULATION_GROUPS, Member, draw_population
from skinrig.arrays import BoolArray, Float64Array
from skinrig.benchmarks.resampling import median_error
from skinrig.benchmarks.results import ErrorEstimate, Knob

FALSE_ALARM_RATE: Final = 1e-3
"""Probability that correct standard errors miss the limit of `PeopleValues.largest_pull`."""
N_EXCHANGES: Final = 9_999
"""Random exchanges of people for `PeopleValues.exchange_probability`."""
MIN_TREND_FREEDOM: Final = 2
"""Minimum number of people beyond the number of trends; fewer leave no standard error."""


def choose_members(per_group: int) -> tuple[Member, ...]:
    """Return members of each group of the population, evenly spaced over the group.

    Parameters
    ----------
    per_group
        Members of each of the six groups of table 1 of Weyrich et al. 2006, 1 or 2.

    Examples
    --------
    >>> [member.name for member in choose_members(1)]
    ['P26', 'P53', 'P59', 'P72', 'P84', 'P87']
    """
    people = draw_population()
    chosen = []
    for group in POPULATION_GROUPS:
        members = [one for one in people if one.group == group.name]
        even = (np.arange(per_group) + 0.5) / per_group * len(members)
        chosen += [members[int(k)] for k in even]
    return tuple(chosen)


@dataclass(frozen=True, slots=True, eq=False)
class PeopleValues:
    """Quantities of people, estimated from sessions and in truth.

    All arrays have shape (n, K): n people, K quantities.

    Attributes
    ----------
    members : tuple of Member
        The n people.
    estimated : ndarray of float64
        Estimates; NaN where a session gives none.
    stderr : ndarray of float64
        Standard errors that the estimator states; NaN where it states none.
    true : ndarray of float64
        Ground truth, above 0.
    """

    members: tuple[Member, ...]
    estimated: Float64Array
    stderr: Float64Array
    true: Float64Array

    def relative_errors(self) -> Float64Array:
        """Return estimated over true values, minus 1."""
        return self.estimated / self.true - 1.0

    def error(self, k: int) -> ErrorEstimate:
        """Return the median absolute error of a quantity over people, % of the truth."""
        return median_error(100.0 * np.abs(self.relative_errors()[:, k]))

    def largest_pull(self) -> tuple[float, float]:
        """Return the largest mean error over people in stated standard errors, and its bound.

        One calibration serves all people, so that their errors may be common. The standard error
        of their mean is then that of one person, not smaller. The bound is exceeded with
        probability `FALSE_ALARM_RATE` at most (Bonferroni over quantities) if the stated standard
        errors are correct.
        """
        known = np.isfinite(self.stderr).any(axis=0)
        errors, stderr = (
            np.nanmean(values[:, known], axis=0)
            for values in (self.estimated - self.true, self.stderr)
        )
        bound = float(stats.norm.isf(FALSE_ALARM_RATE / (2 * np.count_nonzero(known))))
        return float(np.abs(errors / stderr).max()), bound

    def exchange_probability(self, columns: ArrayLike) -> float:
        """Return the probability that exchanged people agree with the truth as well.

        Parameters
        ----------
        columns
            Indices of quantities, which are pooled.

        Returns
        -------
        float
            p value of a permutation test on the sum of correlations over people. Estimates that do
            not follow the people have a uniform p value.
        """
        pick = np.asarray(columns, np.intp)
        known = np.isfinite(self.estimated[:, pick]).all(axis=1)
        found, true = (_standardize(v[known][:, pick]) for v in (self.estimated, self.true))
        rng = np.random.default_rng(0)
        orders = rng.permuted(np.tile(np.arange(len(found)), (N_EXCHANGES, 1)), axis=1)
        products = found @ true.T  # sums over quantities, of every pair of people
        exchanged = products[orders, np.arange(len(found))].sum(axis=1)
        # equal sums differ by rounding
        as_good = np.count_nonzero(exchanged >= np.trace(products) * (1.0 - 1e-12))
        return (1 + int(as_good)) / (1 + N_EXCHANGES)

    def describe(self, k: int, *, digits: int = 5) -> dict[str, Knob]:
        """Return mean and standard deviation over people of a quantity, for a benchmark's point.

        Standard errors are those of people drawn from a population, for a normal distribution.
        """
        known = np.isfinite(self.estimated[:, k])
        found, true = self.estimated[known, k], self.true[known, k]
        n = len(found)
        if n < 2:
            return {"people": n}
        deviation = float(found.std(ddof=1))
        values = {
            "mean": float(found.mean()),
            "mean, standard error": deviation / np.sqrt(n),
            "true mean": float(true.mean()),
            "deviation": deviation,
            "deviation, standard error": deviation / np.sqrt(2 * (n - 1)),
            "true deviation": float(true.std(ddof=1)),
        }
        bias = 100.0 * float(np.mean(found / true - 1.0))
        rounded: dict[str, Knob] = {key: round(float(v), digits) for key, v in values.items()}
        return {"people": n, **rounded, "bias, %": round(bias, 2)}

    def trends(self, k: int, *, digits: int = 5) -> dict[str, Knob]:
        """Return differences of a quantity between groups of people, and its change with age.

        Least squares on sex, ethnicity, products and age together; the same for the true values.
        Empty with too few people.
        """
        found, true = self.estimated[:, k], self.true[:, k]
        known = np.isfinite(found)
        traits = {name: values[known] for name, values in label_traits(self.members).items()}
        design = np.stack([np.ones(int(known.sum())), *traits.values()], axis=1)
        freedom = len(design) - design.shape[1]
        if freedom < MIN_TREND_FREEDOM or np.linalg.matrix_rank(design) < design.shape[1]:
            return {}
        solve = np.linalg.pinv(design)
        effects, true_effects = solve @ found[known], solve @ true[known]
        residual = found[known] - design @ effects
        scale = float(np.sqrt(residual @ residual / freedom))
        stderr = scale * np.sqrt(np.diag(solve @ solve.T))
        out: dict[str, Knob] = {}
        for row, name in enumerate(traits, 1):
            out[name] = round(float(effects[row]), digits)
            out[f"{name}, standard error"] = round(float(stderr[row]), digits)
            out[f"{name}, true"] = round(float(true_effects[row]), digits)
        return out


def label_traits(members: tuple[Member, ...]) -> Mapping[str, Float64Array]:
    """Return the traits of members as regressors, each of shape (n,).

    Examples
    --------
    >>> {name: values.tolist() for name, values in label_traits(choose_members(1)[1:3]).items()}
    {'women': [1.0, 1.0], 'asian': [0.0, 0.0], 'lotion or makeup': [0.0, 1.0], '10 years': [2.6, 4.0]}
    """  # noqa: E501
    flags: dict[str, BoolArray] = {
        "women": np.array([one.sex == "female" for one in members]),
        "asian": np.array([one.ethnicity == "asian" for one in members]),
        "lotion or makeup": np.array([bool(one.conditions) for one in members]),
    }
    ages = np.array([one.age_years / 10.0 for one in members])
    return {**{name: flag.astype(np.float64) for name, flag in flags.items()}, "10 years": ages}


def _standardize(values: Float64Array) -> Float64Array:
    """Return columns with mean 0 and standard deviation 1; constant columns become 0."""
    off = values - values.mean(axis=0)
    size = off.std(axis=0)
    return np.asarray(off / np.where(size > 0.0, size, 1.0))
