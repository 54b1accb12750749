"""Learn trait vectors from labeled samples and edit samples by them (lotion, tan, age).

A trait vector is the difference of the means of samples with and without a user-assigned label. An
edit adds such vectors to a sample, or mixes it with the means of groups, and projects the result to
the feasible set. The part of a sample outside the reduced space is kept, so an edit of amount 0
changes nothing.

References
----------
Weyrich et al. 2005, "Measuring and modeling human skin reflectance", section 11.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from model.arrays import Float64Array, FloatArray
from model.checks import Checks
from model.traits import feasible_sets, reduced_spaces
from model.traits import vectors as trait_vectors
from model.traits.feasible_sets import FeasibleSet
from model.traits.reduced_spaces import Reduction, SpaceKind
from model.traits.vectors import Contrast, Trait, TraitError, TraitVector

Mode = Literal["linear", "convex"]
Source = Literal["simulated", "measured"]

NO_TRAITS: Mapping[str, ArrayLike] = MappingProxyType({})


@dataclass(frozen=True, slots=True, eq=False)
class EditOutcome:
    """An edited sample, and the part of the edit that was not possible.

    Attributes
    ----------
    sample : ndarray, shape (..., d)
    moved : ndarray, shape (...)
        Length of the requested change, under the space's metric.
    clipped : ndarray, shape (...)
        Length of its part outside the feasible set.
    return_bound : ndarray, shape (...)
        Bound of the distance to the source, under the metric, after the linear edit by the opposite
        amounts: a projection onto a convex set never increases distances.
    """

    sample: FloatArray
    moved: Float64Array
    clipped: Float64Array
    return_bound: Float64Array

    @property
    def clipped_fraction(self) -> Float64Array:
        """Return the fraction of the change that was not possible; 0 for a change of 0."""
        asked = np.where(self.moved > 0.0, self.moved, 1.0)
        return np.where(self.moved > 0.0, self.clipped / asked, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class TraitSpace:
    """Trait vectors of a population in a reduced space; make one with `fit`.

    Attributes
    ----------
    kind : {"pca", "nmf"}
    center : ndarray of float64, shape (d,)
        Mean of the samples.
    basis : ndarray of float64, shape (K, d)
        See `model.traits.reduced_spaces.Reduction`.
    traits : mapping of str to TraitVector
    feasible : FeasibleSet
        Feasible set of the samples.
    metric : ndarray, shape (d,) or (d, d), or None
        Metric of differences of samples; None: the sum of squares.
    samples : int
        n.
    lost : float
        Fraction of the samples' differences outside the reduced space, RMS.
    seed : int
        Seed of all random numbers in the fit.
    names : tuple of str
        Names of the d numbers; may be empty.
    """

    kind: SpaceKind
    center: Float64Array
    basis: Float64Array
    traits: Mapping[str, TraitVector]
    feasible: FeasibleSet
    metric: Float64Array | None
    samples: int
    lost: float
    seed: int
    names: tuple[str, ...] = ()
    notes: Mapping[str, str] = field(default_factory=dict)
    """Further properties of the samples."""
    storage_error: Mapping[str, float] = field(default_factory=dict)
    """Relative error of each trait's vector by storage; empty in a new space."""

    def __post_init__(self) -> None:
        """Raise for arrays that do not fit each other."""
        d = len(self.center)
        check = Checks(TraitError).shape
        check("basis", self.basis, (None, d))
        for name, trait in self.traits.items():
            check(f"vector of {name!r}", trait.vector, (d,))
            check(f"coordinates of {name!r}", trait.coordinates, (len(self.basis),))
        if self.names and len(self.names) != d:
            raise TraitError(f"names: got {len(self.names)}, expected {d} or none")

    @classmethod
    def fit(
        cls,
        samples: ArrayLike,
        labels: Mapping[str, ArrayLike],
        *,
        space: SpaceKind = "pca",
        continuous: Mapping[str, ArrayLike] = NO_TRAITS,
        basis: ArrayLike | None = None,
        components: int | None = None,
        metric: ArrayLike | None = None,
        feasible: FeasibleSet | None = None,
        contrast: Contrast = "means",
        names: tuple[str, ...] = (),
        seed: int = 0,
    ) -> TraitSpace:
        """Learn trait vectors from labeled samples.

        Parameters
        ----------
        samples : array_like, shape (n, d)
            One sample per face: a histogram vector (d = 23,808), or a mean mixture of materials.
        labels : mapping of str to array_like of bool, shape (n,)
            Whether each face has the trait; any name is allowed.
        space : {"pca", "nmf"}
            Principal components of the samples, or non-negative mixtures of `basis`.
        continuous : mapping of str to array_like, shape (n,)
            Values such as an age; their vectors are changes per unit.
        basis : array_like, shape (K, d)
            For "nmf": non-negative mixtures, from `reconstruction.brdf_basis.reduce`.
        components : int, optional
            For "pca"; by default all, or fewer where their vectors generalize better, see
            `model.traits.reduced_spaces.choose_component_count`.
        metric : array_like, shape (d,) or (d, d), optional
            Metric of differences. For mixtures of materials give their products over directions
            (`brdf_products`): differences of weights do not measure visible differences.
        feasible : FeasibleSet, optional
            Feasible set; by default the smallest one that contains all samples, out of histograms
            of 256 bins, values of at least 0 and all finite values.
        contrast : {"means", "regression"}
            "means": differences of complement means, the paper's. "regression": a trait's effect
            with all other traits as covariates.
        names : tuple of str
            Names of the d numbers.
        seed : int
            Seed of the halvings, permutations and resamplings.

        Raises
        ------
        TraitError
            For a trait nobody or everybody has, more components than the samples differ in,
            samples that are all the same, and shapes that do not fit.

        Examples
        --------
        >>> samples = [[1.0, 0.0], [1.0, 0.2], [3.0, 0.1], [3.0, 0.3]]
        >>> space = TraitSpace.fit(samples, {"oily": [False, False, True, True]})
        >>> space.trait("oily").vector.round(6).tolist()
        [2.0, 0.1]
        >>> space.edit([2.0, 0.5], {"oily": 0.5}).round(6).tolist()
        [3.0, 0.55]
        """
        x = Checks(TraitError).numbers("samples", samples, ("n", "d"))
        Checks(TraitError).choice("space", space, ("pca", "nmf"))
        traits = trait_vectors.parse_traits(labels, continuous, len(x), contrast=contrast)
        g = reduced_spaces.check_metric(metric, x.shape[1])
        inside = feasible_sets.smallest_feasible_set(x) if feasible is None else feasible
        if not inside.contains(x).all():
            bad = int(np.count_nonzero(~inside.contains(x)))
            raise TraitError(f"samples: {bad} of {len(x)} are not in the set {inside}")
        rng = np.random.default_rng(seed)
        with threadpool_limits(limits=1, user_api="blas"):  # many small matrices
            if space == "pca":
                reduced = reduced_spaces.principal_components(
                    x, traits, components=components, metric=g, rng=rng
                )
            else:
                reduced = reduced_spaces.fit_mixtures(x, basis, metric=g)
            found = _vectors(x, traits, reduced, inside, contrast, rng)
        return cls(
            kind=space,
            center=reduced.center,
            basis=reduced.basis,
            traits=found,
            feasible=inside,
            metric=g,
            samples=len(x),
            lost=reduced.lost,
            seed=seed,
            names=names,
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return the warnings of all traits, one sentence each."""
        return tuple(w for trait in self.traits.values() for w in trait.warnings)

    def trait(self, name: str) -> TraitVector:
        """Return a trait's vector; raise `TraitError` for an unknown trait."""
        if name not in self.traits:
            raise TraitError(f"trait: got {name!r}, expected one of {', '.join(self.traits)}")
        return self.traits[name]

    def mean_with(self, name: str) -> Float64Array:
        """Return the mean sample of those with a binary trait, (d,), projected to the space.

        The nearest sample of the feasible set if that projection is outside it.
        """
        trait = self.trait(name)
        if trait.kind != "binary":
            raise TraitError(f"trait: got {name!r}, a continuous one, expected one with a group")
        share = trait.others / (trait.members + trait.others)
        return self.feasible.project(self.center + share * trait.vector, self._products())

    def cosine(self, name: str, direction: ArrayLike) -> float:
        """Return the cosine between a trait's vector and a direction (d,), under the metric."""
        return cosine(self.trait(name).vector, direction, self.metric)

    def coordinates(self, samples: ArrayLike) -> Float64Array:
        """Return samples (..., d) in the reduced space, (..., K).

        Principal components are relative to the center; weights of a basis are at least 0.
        """
        s = self._checked(samples)
        if self.kind == "pca":
            return np.asarray(
                reduced_spaces.times_metric(s - self.center, self.metric) @ self.basis.T
            )
        flat = s.reshape(-1, s.shape[-1])
        found = reduced_spaces.mixture_coordinates(flat, self.basis, self.metric)
        return found.reshape(*s.shape[:-1], -1)

    def reduced(self, samples: ArrayLike) -> Float64Array:
        """Return samples (..., d) projected to the reduced space, (..., d)."""
        inside = self.coordinates(samples) @ self.basis
        return np.asarray(inside + self.center if self.kind == "pca" else inside)

    def edit(
        self, sample: ArrayLike, amounts: Mapping[str, float], *, mode: Mode = "linear"
    ) -> FloatArray:
        """Return samples with more or less of some traits; see `edit_with_outcome`.

        Examples
        --------
        >>> space = TraitSpace.fit([[0.2, 1.0], [0.6, 1.0]], {"red": [False, True]})
        >>> space.edit([0.5, 1.0], {"red": -2.0}).tolist()
        [0.0, 1.0]
        """
        return self.edit_with_outcome(sample, amounts, mode=mode).sample

    def edit_with_outcome(
        self, sample: ArrayLike, amounts: Mapping[str, float], *, mode: Mode = "linear"
    ) -> EditOutcome:
        """Edit samples by traits and report the part that was not possible.

        Parameters
        ----------
        sample : array_like, shape (..., d)
            In the feasible set.
        amounts : mapping of str to float
            "linear": factor of the added trait vector; 1 changes a face without the trait to the
            mean of those with it, negative amounts reduce it; continuous traits in their unit.
            "convex": weight of the mean of those with the trait, at least 0 and together at most 1,
            the rest being the sample; only for traits with a group.
        mode : {"linear", "convex"}

        Returns
        -------
        EditOutcome
            Its sample has the floating type of the given one. All amounts 0: exactly as given.

        Raises
        ------
        TraitError
            For unknown traits, amounts that are not finite or make no convex combination, and
            samples outside the feasible set.
        """
        Checks(TraitError).choice("mode", mode, ("linear", "convex"))
        given = np.asarray(sample)
        dtype = given.dtype if np.issubdtype(given.dtype, np.floating) else np.dtype(np.float64)
        s = self._checked(given)
        if not self.feasible.contains(s).all():
            raise TraitError(
                f"sample: is not in the feasible set {self.feasible}; project it first"
            )
        for name, amount in amounts.items():
            self.trait(name)
            Checks(TraitError).within(f"amount of {name}", amount)
        if mode == "convex":
            wanted = self._mixed(s, amounts)
        else:
            wanted = s + sum(
                (a * self.traits[n].vector for n, a in amounts.items()), np.zeros(s.shape[-1])
            )
        moved = reduced_spaces.metric_lengths(wanted - s, self.metric)
        if not any(amounts.values()):
            zero = np.zeros_like(moved)
            return EditOutcome(given.astype(dtype), zero, zero, zero)
        found = self.feasible.project(wanted, self._products())
        clipped = reduced_spaces.metric_lengths(found - wanted, self.metric)
        return EditOutcome(found.astype(dtype), moved, clipped, clipped)

    def _products(self) -> Float64Array | None:
        """Return the metric if it is a matrix; weights alone do not change a projection."""
        return self.metric if self.metric is not None and self.metric.ndim == 2 else None

    def _mixed(self, s: Float64Array, amounts: Mapping[str, float]) -> Float64Array:
        total = sum(amounts.values())
        if min(amounts.values(), default=0.0) < 0.0 or total > 1.0 + 1e-12:
            raise TraitError(
                f"amounts: got {dict(amounts)}, expected shares of at least 0, together at most 1"
            )
        mixed = (1.0 - total) * s
        for name, amount in amounts.items():
            mixed = mixed + amount * self.mean_with(name)
        return np.asarray(mixed)

    def _checked(self, samples: ArrayLike) -> Float64Array:
        return Checks(TraitError).numbers("sample", samples, ("...", len(self.center)))


def cosine(a: ArrayLike, b: ArrayLike, metric: Float64Array | None = None) -> float:
    """Return the cosine between two directions (d,) under a metric; 0 when one has no length.

    Examples
    --------
    >>> cosine([1.0, 1.0], [2.0, 0.0])
    0.7071067811865475
    """
    x, y = np.asarray(a, np.float64), np.asarray(b, np.float64)
    Checks(TraitError).shape("directions", x, ("d",))
    Checks(TraitError).shape("directions", y, x.shape)
    size = float(
        reduced_spaces.metric_lengths(x, metric) * reduced_spaces.metric_lengths(y, metric)
    )
    return float(x @ reduced_spaces.times_metric(y, metric)) / size if size > 0.0 else 0.0


def _vectors(
    x: Float64Array,
    traits: tuple[Trait, ...],
    reduced: Reduction,
    inside: FeasibleSet,
    contrast: Contrast,
    rng: np.random.Generator,
) -> dict[str, TraitVector]:
    """Return the vectors of traits in a reduced space, with their confidence."""
    related = trait_vectors.correlations(traits)
    found = {}
    for k, trait in enumerate(traits):
        covariates = tuple(t for t in traits if t is not trait) if contrast == "regression" else ()
        sure = trait_vectors.direction_confidence(
            trait, reduced.scores, whole=reduced.whole, covariates=covariates, rng=rng
        )
        left = trait_vectors.residuals(trait, x, covariates=covariates)
        weights = trait_vectors.error_weights(trait, left[:, -1], 2 + len(covariates))
        others = [
            (t.name, float(r))
            for t, r in zip(traits, related[k], strict=True)
            if t is not trait and abs(r) > trait_vectors.MAX_CORRELATION
        ]
        confounded = tuple(sorted(others, key=lambda other: -abs(other[1])))
        along = trait.contrast @ reduced.coordinates
        found[trait.name] = TraitVector(
            name=trait.name,
            kind=trait.kind,
            vector=inside.tangent(along @ reduced.basis),
            stderr=np.sqrt(weights @ left[:, :-1] ** 2),
            coordinates=along,
            members=trait.members,
            others=len(x) - trait.members,
            confidence=sure,
            confounded=confounded,
            warnings=trait_vectors.list_warnings(trait, sure, confounded),
        )
    return found
