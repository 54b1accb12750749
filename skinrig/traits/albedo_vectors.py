"""Represent the albedo of a face as a vector for learning and editing traits.

There are two kinds: histograms of R_d, as published, and quantiles of its logarithm. A mean of
quantiles is one intermediate skin, whereas a mean of histograms is a mixture of two; and pigment is
a factor on R_d, hence an offset of quantiles. Quantiles are scaled by each response's standard
range in the population, so that all responses have similar weight.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from model import texture_statistics
from model.texture_statistics.space import TextureSpace
from model.traits import TraitSpace, histogram_transport
from model.traits.feasible_sets import HistogramSet, UnconstrainedSet
from model.traits.vectors import Contrast
from skinrig.arrays import BoolArray, Float32Array, Float64Array
from skinrig.errors import UnusableError, require_choice

VectorKind = Literal["quantiles", "histograms"]

VECTOR_KINDS: Final = ("quantiles", "histograms")
MIN_RELATIVE_SCALE: Final = 1e-3
"""Range of a response, relative to the first channel's, below which it carries no information."""
MIN_REFLECTANCE: Final = 1e-3
"""Lower clip of the reflectance before the logarithm; no skin is as dark."""


@dataclass(frozen=True, slots=True, eq=False)
class AlbedoTraits:
    """Traits of the albedo in one region.

    Attributes
    ----------
    kind
        Kind of the vectors of `traits`.
    texture
        Color space and bin edges of the population, for R_d (histograms) or its logarithm.
    traits
        Learned on vectors of that kind.
    """

    kind: VectorKind
    texture: TextureSpace
    traits: TraitSpace

    def __post_init__(self) -> None:
        """Raise for an unknown kind, or vectors of another length."""
        require_choice("vectors", self.kind, VECTOR_KINDS)
        if len(self.traits.center) != self.texture.size:
            raise UnusableError(
                f"vectors: got {len(self.traits.center)} numbers, expected {self.texture.size}"
            )

    def target(
        self, histograms: ArrayLike, amounts: Mapping[str, float]
    ) -> tuple[Float64Array, TextureSpace, float]:
        """Return a histogram vector with changed amounts of traits.

        Parameters
        ----------
        histograms
            (23808,), by `model.texture_statistics.describe` of `encode_albedo` albedo.
        amounts
            Amount by trait.

        Returns
        -------
        vector : ndarray, shape (23808,)
            A valid histogram vector; the input if all amounts are 0.
        texture : TextureSpace
            Its bins: the population's, with the edges widened as the edit requires.
        clipped : float
            Fraction of the change that was not possible.
        """
        given = np.asarray(histograms, np.float64)
        if not any(amounts.values()):
            for name in amounts:
                self.traits.trait(name)
            return given, self.texture, 0.0
        if self.kind == "histograms":
            found = self.traits.edit_with_outcome(given, amounts)
            return np.asarray(found.sample, np.float64), self.texture, float(found.clipped_fraction)
        change = sum(
            (amount * self.traits.trait(name).vector for name, amount in amounts.items()),
            np.zeros(self.texture.size),
        )
        before = self.texture.histograms(given)
        scale = response_scale(self.texture)[..., None]
        by = change.reshape(before.shape) * scale
        wide = histogram_transport.widen_edges(before, self.texture.edges, by)
        after = histogram_transport.shift_quantiles(
            before, self.texture.edges, by, target_edges=wide
        )
        wanted = histogram_transport.quantiles(before, self.texture.edges) + by
        got = histogram_transport.quantiles(after, wide)
        asked = float(np.sqrt(np.mean((by / scale) ** 2)))
        missed = float(np.sqrt(np.mean(((got - wanted) / scale) ** 2)))
        space = dataclasses.replace(self.texture, edges=wide)
        return after.reshape(-1), space, min(missed / asked, 1.0) if asked > 0 else 0.0


def encode_albedo(r_d: ArrayLike, kind: VectorKind) -> Float64Array:
    """Return the values whose statistics are taken: R_d for histograms, ln R_d for quantiles."""
    given = np.asarray(r_d, np.float64)
    if require_choice("vectors", kind, VECTOR_KINDS) == "histograms":
        return given
    return np.asarray(np.log(np.maximum(given, MIN_REFLECTANCE)))


def response_scale(texture: TextureSpace) -> Float64Array:
    """Return the range of each response in a population, (C, responses): middle half of its edges.

    Half of the edges are evenly spaced and half are quantiles, so the middle half spans the common
    values. Responses with a negligible range (rounding errors, pyramid levels larger than the face)
    get at least `MIN_RELATIVE_SCALE` of the first channel's range.
    """
    e = texture.edges
    bins = e.shape[-1] - 1
    middle = e[..., bins - bins // 4] - e[..., bins // 4]
    return np.maximum(middle, MIN_RELATIVE_SCALE * float(middle[0, 0]))


def informative_responses(texture: TextureSpace) -> BoolArray:
    """Return which responses have more than a negligible range, (C, responses)."""
    scale = response_scale(texture)
    return np.asarray(scale > 1.001 * MIN_RELATIVE_SCALE * scale[0, 0], np.bool_)


def vector(
    r_d: ArrayLike, texture: TextureSpace, kind: VectorKind, *, valid: BoolArray, region: ArrayLike
) -> Float64Array:
    """Return the vector of an albedo map, (23808,); see `model.texture_statistics.describe`."""
    found = texture_statistics.describe(
        encode_albedo(r_d, kind), space=texture, valid=valid, region=region
    )
    if kind == "histograms":
        return found
    q = histogram_transport.quantiles(texture.histograms(found), texture.edges)
    return (q / response_scale(texture)[..., None]).reshape(-1)


def fit_albedo_traits(
    vectors: ArrayLike,
    labels: Mapping[str, ArrayLike],
    continuous: Mapping[str, ArrayLike],
    texture: TextureSpace,
    kind: VectorKind,
    *,
    contrast: Contrast = "means",
    seed: int = 0,
) -> AlbedoTraits:
    """Learn the traits of albedo vectors (n, 23808), see `model.traits.TraitSpace.fit`."""
    inside = UnconstrainedSet() if kind == "quantiles" else HistogramSet()
    found = TraitSpace.fit(
        vectors,
        labels,
        continuous=continuous,
        space="pca",
        feasible=inside,
        contrast=contrast,
        seed=seed,
    )
    return AlbedoTraits(kind, texture, found)


@dataclass(frozen=True, slots=True, eq=False)
class AlbedoSample:
    """Albedo of one face in the common map."""

    r_d: Float32Array
    """(N, N, 3)."""
    valid: BoolArray
    """(N, N)."""
