"""Estimate trait vectors from people with and without a trait, and their confidence.

A trait vector is a weighted sum of the samples, its *contrast* c: the mean of those with the trait
minus the mean of those without, or the slope over a continuous trait (one formula: the contrast is
t - mean(t) over the sum of its squares). Its confidence is computed from the contrast and the n
samples in an orthonormal frame of at most n coordinates, for samples of any length.

References
----------
Weyrich et al. 2005, "Measuring and modeling human skin reflectance", section 11.
MacKinnon and White 1985, doi:10.1016/0304-4076(85)90158-7 (standard errors, HC2: for two groups
they are those of Welch). Phipson and Smyth 2010, doi:10.2202/1544-6115.1585 (p-values).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import Float64Array
from model.checks import Checks

Kind = Literal["binary", "continuous"]
Contrast = Literal["means", "regression"]

MIN_GROUP_SIZE = 5
"""Smallest group without a warning."""
IDENTITY_CORRELATION = 1.0 - 1e-9
"""Correlation above which two traits count as identical."""
MAX_CORRELATION = 0.5
"""Correlation above which two traits get a warning."""
MAX_P_VALUE = 0.05
MIN_COSINE = 0.95
_CHUNK_TRAITS = 64


class TraitError(ValueError):
    """Error for invalid traits, samples or amounts."""


@dataclass(frozen=True, slots=True)
class Confidence:
    """Confidence in the direction of a trait vector in the reduced space.

    Attributes
    ----------
    p_value : float
        Fraction of random permutations of the labels with a difference of whole samples at least as
        long: uniform over (0, 1] without a trait. 1 where nothing can be permuted. (In a space that
        was chosen for these labels it would not be uniform.)
    expected_cosine : float
        Expected cosine between this vector and the true one of the whole samples, corrected for the
        noise in both lengths: sqrt(1 - noise^2 / length^2) in a complete space, reduced by the part
        outside the space. 0 where the noise exceeds the length, or is unknown.
    bootstrap_cosine : (float, float, float)
        16th, 50th and 84th percentile of the cosine to vectors with resampled residuals; zeros
        without residuals.
    relative_noise : float
        noise / length; inf where the length is 0 or the noise unknown.
    """

    p_value: float
    expected_cosine: float
    bootstrap_cosine: tuple[float, float, float]
    relative_noise: float


@dataclass(frozen=True, slots=True, eq=False)
class TraitVector:
    """Change of a sample by one trait.

    Attributes
    ----------
    name : str
    kind : {"binary", "continuous"}
    vector : ndarray of float64, shape (d,)
        Change of a sample by the trait (binary), or per unit of it (continuous).
    stderr : ndarray of float64, shape (d,)
        Standard error of each number before the reduction; 0 where `confidence.relative_noise` is
        inf.
    coordinates : ndarray of float64, shape (K,)
        The vector in the reduced space.
    members, others : int
        People with the trait and without; for a continuous one all people and 0.
    confidence : Confidence
    confounded : tuple of (str, float)
        Other traits with a correlation beyond 0.5, largest first.
    warnings : tuple of str
    """

    name: str
    kind: Kind
    vector: Float64Array
    stderr: Float64Array
    coordinates: Float64Array
    members: int
    others: int
    confidence: Confidence
    confounded: tuple[tuple[str, float], ...] = ()
    warnings: tuple[str, ...] = ()

    def opposite(self, name: str) -> TraitVector:
        """Return the trait of those without this binary one, such as "male" of "female"."""
        if self.kind != "binary":
            raise TraitError(f"trait: got {self.name!r}, a continuous one, which has no opposite")
        return replace(
            self,
            name=name,
            vector=-self.vector,
            coordinates=-self.coordinates,
            members=self.others,
            others=self.members,
            confounded=tuple((other, -r) for other, r in self.confounded),
            warnings=tuple(w.replace(f"{self.name}:", f"{name}:", 1) for w in self.warnings),
        )

    @property
    def warning(self) -> str:
        """Return all warnings, one sentence each; empty without any."""
        return "; ".join(self.warnings)


@dataclass(frozen=True, slots=True, eq=False)
class Trait:
    """A trait of n people, as given."""

    name: str
    kind: Kind
    values: Float64Array
    """(n,); 0 and 1 for a binary trait, else in the trait's unit."""
    contrast: Float64Array
    """(n,) weights of the samples in the trait's vector; they sum to 0."""

    @property
    def members(self) -> int:
        """Return the number of people with the trait; all for a continuous one."""
        return int(self.values.sum()) if self.kind == "binary" else len(self.values)


def parse_traits(
    labels: Mapping[str, ArrayLike],
    continuous: Mapping[str, ArrayLike],
    count: int,
    *,
    contrast: Contrast = "means",
) -> tuple[Trait, ...]:
    """Check labels and return the traits.

    Parameters
    ----------
    labels : mapping of str to array_like of bool, shape (n,)
        User-assigned: whether each person has the trait.
    continuous : mapping of str to array_like, shape (n,)
        Values such as an age; finite.
    count : int
        n, at least 2.
    contrast : {"means", "regression"}
        "means": differences of complement means, without correction for other differences of the
        groups. "regression": a trait's effect with all other traits as covariates, by least
        squares.

    Returns
    -------
    tuple of Trait

    Raises
    ------
    TraitError
        For a trait that nobody or everybody has, a value that does not vary, or shapes that do not
        fit; by regression also for traits that are linearly dependent.

    Examples
    --------
    >>> parse_traits({"lotion": [True, False, False]}, {}, 3)[0].contrast.round(6).tolist()
    [1.0, -0.5, -0.5]
    """
    Checks(TraitError).choice("contrast", contrast, ("means", "regression"))
    both = set(labels) & set(continuous)
    if both or not (labels or continuous):
        raise TraitError(
            f"traits: got {', '.join(sorted(both))} both as label and as continuous value"
            if both
            else "traits: got none, expected at least one label or continuous value"
        )
    Checks(TraitError).within("samples", count, "[2, inf)")
    values: list[tuple[str, Kind, Float64Array]] = []
    for name, given in labels.items():
        values.append((name, "binary", _label(name, given, count)))
    for name, given in continuous.items():
        values.append((name, "continuous", _value(name, given, count)))
    if contrast == "means":
        rows = [v - v.mean() for _, _, v in values]
        found = [row / (row @ row) for row in rows]
    else:
        scale = np.array([np.std(v) for _, _, v in values])
        design = np.column_stack(
            [
                np.ones(count),
                *((v - v.mean()) / s for (_, _, v), s in zip(values, scale, strict=True)),
            ]
        )
        if np.linalg.matrix_rank(design) < design.shape[1]:
            raise TraitError(
                f"traits: {', '.join(name for name, _, _ in values)} of {count} people cannot be "
                "separated by regression; omit those that follow from the others, or use "
                "differences of means"
            )
        found = list(np.linalg.pinv(design)[1:] / scale[:, None])
    return tuple(Trait(name, kind, v, c) for (name, kind, v), c in zip(values, found, strict=True))


def _label(name: str, given: ArrayLike, count: int) -> Float64Array:
    label = np.asarray(given)
    Checks(TraitError).shape(f"label {name!r}", label, (count,))
    if label.dtype != np.bool_ and not np.isin(label, (0, 1)).all():
        raise TraitError(f"label {name!r}: got {label.dtype} values, expected True and False")
    value = label.astype(np.float64)
    if value.min() == value.max():
        who = "everybody" if value[0] else "nobody"
        raise TraitError(
            f"label {name!r}: {who} of {count} has it, expected some with and some without; label "
            "other faces, or omit the trait"
        )
    return value


def _value(name: str, given: ArrayLike, count: int) -> Float64Array:
    value = Checks(TraitError).numbers(name, given, (count,))
    spread = value - value.mean()
    if not spread @ spread > (1e-12 * np.abs(value).max()) ** 2 * count:
        raise TraitError(f"{name}: got {value[0]:g} for all of {count}, expected values that vary")
    return value


def scale_exponent(*values: Float64Array) -> int:
    """Return the power of two that scales numbers to sizes up to 1; 0 where all are 0.

    Unit-independent results are computed from ``numpy.ldexp(values, -exponent)``: exactly the same
    numbers in another unit, whose squares neither overflow nor underflow.

    Parameters
    ----------
    *values : ndarray
        Finite, of any shape.

    Raises
    ------
    TraitError
        For NaN and infinity.

    Examples
    --------
    >>> scale_exponent(np.array([0.3, -5.0])), scale_exponent(np.zeros(3))
    (3, 0)
    """
    for each in values:
        Checks(TraitError).within("samples", each)
    largest = max((float(np.abs(v).max()) for v in values if v.size), default=0.0)
    return int(np.frexp(largest)[1])


def correlations(traits: tuple[Trait, ...]) -> Float64Array:
    """Return the correlations of the traits' values, (t, t)."""
    centered = np.array([t.values - t.values.mean() for t in traits])
    size = np.sqrt((centered**2).sum(axis=1, keepdims=True))
    centered /= size
    return np.asarray(centered @ centered.T)


def residuals(
    trait: Trait, samples: Float64Array, *, covariates: tuple[Trait, ...] = ()
) -> Float64Array:
    """Return the residuals of samples (n, d), with each one's leverage in a last column.

    Parameters
    ----------
    covariates
        Other traits in the same regression; none for a difference of means.
    """
    columns = [np.ones(len(samples)), *(t.values - t.values.mean() for t in (trait, *covariates))]
    q = np.linalg.qr(np.column_stack(columns))[0]
    left = samples - q @ (q.T @ samples)
    return np.column_stack([left, np.minimum((q**2).sum(axis=1), 1.0)])


def error_weights(trait: Trait, leverage: Float64Array, parameters: int) -> Float64Array:
    """Return the weights of squared residuals in the vector's squared standard errors, (n,).

    HC2 weights c_i^2 / (1 - leverage_i); the only person of a group has leverage 1 and residual 0
    and gets the mean squared residual of the others instead. All 0 where no residual is free.
    """
    free = leverage < 1.0 - 1e-9
    count = int(np.count_nonzero(free))
    squared = trait.contrast**2
    weight = np.where(free, squared / np.where(free, 1.0 - leverage, 1.0), 0.0)
    alone = float(squared[~free].sum())
    freedom = len(leverage) - parameters
    if count == 0 or freedom < 1:
        return np.zeros(len(leverage))
    return np.asarray(weight + np.where(free, alone / freedom, 0.0))


def direction_confidence(
    trait: Trait,
    scores: Float64Array,
    *,
    whole: Float64Array | None = None,
    covariates: tuple[Trait, ...] = (),
    permutations: int = 999,
    resamples: int = 400,
    rng: np.random.Generator,
) -> Confidence:
    """Return the confidence in a trait's direction.

    Parameters
    ----------
    trait
        See `parse_traits`.
    scores : ndarray, shape (n, r)
        The samples projected to the reduced space, in an orthonormal frame; finite.
    whole : ndarray, shape (n, r), optional
        The samples in the same frame; as `scores` by default.
    covariates
        Other traits in the same regression.
    permutations, resamples : int
        Numbers of random permutations of labels and of resamplings of residuals, at least 1.
    rng
        Draws permutations and resamplings.

    Notes
    -----
    Permutation tests are exact for a difference of means. By regression, the residuals of the
    samples under the other traits are permuted (Freedman and Lane 1983,
    doi:10.1080/07350015.1983.10509354); otherwise the other traits' effects would count as noise.
    """
    n = len(scores)
    c = trait.contrast
    if whole is None:
        whole = scores
    exponent = scale_exponent(scores, whole)
    scores, whole = (np.ldexp(values, -exponent) for values in (scores, whole))
    vector, true = c @ scores, c @ whole
    base = (
        whole
        if not covariates
        else residuals(covariates[0], whole, covariates=covariates[1:])[:, :-1]
    )
    length, far = float(np.linalg.norm(vector)), float(np.linalg.norm(true))
    beyond = 0
    for start in range(0, permutations, _CHUNK_TRAITS):
        many = min(_CHUNK_TRAITS, permutations - start)
        mixed = rng.permuted(np.broadcast_to(c, (many, n)), axis=1)
        beyond += int(np.count_nonzero(np.linalg.norm(mixed @ base, axis=1) >= far * (1.0 - 1e-12)))
    p = (1 + beyond) / (1 + permutations)
    left = residuals(trait, scores, covariates=covariates)
    off, leverage = left[:, :-1], left[:, -1]
    weights = error_weights(trait, leverage, 2 + len(covariates))
    noise = float(np.sqrt(weights @ (off**2).sum(axis=1)))
    if not weights.any() or length == 0.0:
        return Confidence(p, 0.0, (0.0, 0.0, 0.0), float("inf"))
    all_left = residuals(trait, whole, covariates=covariates)[:, :-1]
    squared = float(far**2 - weights @ (all_left**2).sum(axis=1))
    along = float(vector @ true - weights @ (off * all_left).sum(axis=1))
    expected = max(along, 0.0) / (length * np.sqrt(squared)) if squared > 0.0 else 0.0
    free = leverage < 1.0 - 1e-9
    pool = off[free] / np.sqrt(1.0 - leverage[free])[:, None]
    cosines = np.empty(resamples)
    for k in range(resamples):
        drawn = np.bincount(rng.integers(0, len(pool), n), weights=c, minlength=len(pool))
        other = vector + drawn @ pool
        cosines[k] = vector @ other / max(length * float(np.linalg.norm(other)), 1e-300)
    low, middle, high = (float(v) for v in np.quantile(cosines, (0.16, 0.5, 0.84)))
    return Confidence(p, float(min(expected, 1.0)), (low, middle, high), noise / length)


def list_warnings(
    trait: Trait, confidence: Confidence, confounded: tuple[tuple[str, float], ...]
) -> tuple[str, ...]:
    """Return the warnings of a trait, one sentence each."""
    warnings = []
    if trait.kind == "binary":
        others = len(trait.values) - trait.members
        for count, which in ((trait.members, "with"), (others, "without")):
            if count < MIN_GROUP_SIZE:
                warnings.append(
                    f"{trait.name}: only {count} faces {which} it, expected "
                    f"{MIN_GROUP_SIZE} or more"
                )
    elif len(trait.values) < MIN_GROUP_SIZE:
        warnings.append(
            f"{trait.name}: only {len(trait.values)} faces, expected {MIN_GROUP_SIZE} or more"
        )
    if np.isinf(confidence.relative_noise):
        warnings.append(f"{trait.name}: its error is unknown, too few faces")
    elif confidence.p_value > MAX_P_VALUE:
        warnings.append(
            f"{trait.name}: random labels do as well (p = {confidence.p_value:.2g}); it may"
            f" be noise"
        )
    elif confidence.expected_cosine < MIN_COSINE:
        warnings.append(
            f"{trait.name}: noisy, its cosine to the true direction is about "
            f"{confidence.expected_cosine:.2f}"
        )
    for other, r in confounded:
        warnings.append(
            f"{trait.name}: the same faces as {other}, cannot be separated"
            if abs(r) > IDENTITY_CORRELATION
            else f"{trait.name}: goes along with {other} (correlation {r:+.2f})"
        )
    return tuple(warnings)
