"""The albedo of a face as a vector that traits can be learned from and added to.

Two kinds: histograms of R_d, as published, or quantiles of its logarithm, in which a darker skin
lies between a light and a dark one and not half on each, and pigment is a factor on every skin.
Vectors of quantiles are in units of each response's spread in the population, so that all count.
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
from skinrig.errors import UnusableError, one_of

VectorKind = Literal["quantiles", "histograms"]

VECTOR_KINDS: Final = ("quantiles", "histograms")
MIN_RELATIVE_SCALE: Final = 1e-3
"""Spread of a response, over that of the first channel of the image, that tells nothing."""
MIN_REFLECTANCE: Final = 1e-3
"""Reflectance below which a logarithm is taken of this; no skin is as dark."""


@dataclass(frozen=True, slots=True, eq=False)
class AlbedoTraits:
    """Traits of the albedo in one region.

    Attributes
    ----------
    kind
        What the vectors of `traits` hold.
    texture
        Color space and bin edges of the population, for R_d (histograms) or its logarithm.
    traits
        Learned on vectors of that kind.
    """

    kind: VectorKind
    texture: TextureSpace
    traits: TraitSpace

    def __post_init__(self) -> None:
        """Refuse another kind, and vectors of another length."""
        one_of("vectors", self.kind, VECTOR_KINDS)
        if len(self.traits.center) != self.texture.size:
            raise UnusableError(
                f"vectors: got {len(self.traits.center)} numbers, expected {self.texture.size}"
            )

    def target(
        self, histograms: ArrayLike, amounts: Mapping[str, float]
    ) -> tuple[Float64Array, TextureSpace, float]:
        """Return a histogram vector with more or less of some traits.

        Parameters
        ----------
        histograms
            (23808,), as `model.texture_statistics.describe` gives it of `encode_albedo` albedo.
        amounts
            Trait to amount.

        Returns
        -------
        vector : ndarray, shape (23808,)
            A valid one. All amounts 0: as given.
        texture : TextureSpace
            What its bins are: the population's, with edges as far apart as the edit needs them.
        clipped : float
            Share of the change that was not possible.
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
    """Return what statistics are taken of: R_d for histograms, its logarithm for quantiles."""
    given = np.asarray(r_d, np.float64)
    if one_of("vectors", kind, VECTOR_KINDS) == "histograms":
        return given
    return np.asarray(np.log(np.maximum(given, MIN_REFLECTANCE)))


def response_scale(texture: TextureSpace) -> Float64Array:
    """Return the scale of each response in a population, (C, responses): middle half its edges.

    Edges lie half evenly and half by how often values occur, so that the middle half of them spans
    what is common. Responses of next to no spread (rounding errors, levels larger than the
    face) get `MIN_RELATIVE_SCALE` of the first, so that they count for nothing.
    """
    e = texture.edges
    bins = e.shape[-1] - 1
    middle = e[..., bins - bins // 4] - e[..., bins // 4]
    return np.maximum(middle, MIN_RELATIVE_SCALE * float(middle[0, 0]))


def informative_responses(texture: TextureSpace) -> BoolArray:
    """Return the responses of more than negligible spread, (C, responses)."""
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
    """One face's albedo in the common map."""

    r_d: Float32Array
    """(N, N, 3)."""
    valid: BoolArray
    """(N, N)."""
