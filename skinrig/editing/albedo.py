"""R_d with other statistics: the albedo map matched to the histograms that a trait asks for.

The map is laid out without seams, its statistics are changed, and it is matched to them after the
method of Heeger and Bergen, starting from itself with a little noise added. By what factor the
matching changed each place, each texel is changed: nothing becomes negative, and finer detail than
the common map shows is kept.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from model import texture_statistics
from reconstruction.correspondence.charts import TexelChart
from reconstruction.surface import texture_fill
from skinrig.arrays import BoolArray, Float32Array, Float64Array
from skinrig.traits import albedo_vectors
from skinrig.traits.albedo_vectors import AlbedoTraits, VectorKind

MATCHING_NOISE: Final = 0.05
"""Standard deviation of the noise added before matching, in each channel's own."""
MIN_ALBEDO_FACTOR: Final = 0.02
"""Least factor by which an edit darkens, and the inverse of the most by which it lightens."""


class AlbedoEditError(ValueError):
    """An albedo map that cannot be edited as asked."""


@dataclass(frozen=True, slots=True, eq=False)
class AlbedoEdit:
    """What an edit does to R_d at each texel.

    Attributes
    ----------
    factor
        (H, W, 3), `MIN_ALBEDO_FACTOR` to its inverse; 1 where nothing changes.
    clipped
        Share of the change of statistics that was not possible.
    before, after
        Mean distance of the informative histograms from the target ones, before and after
        matching.
    """

    factor: Float32Array
    clipped: float
    before: float
    after: float

    def apply(
        self, r_d: ArrayLike, mask: ArrayLike | None = None
    ) -> tuple[Float32Array, BoolArray]:
        """Return R_d edited, and which texels had to be held at a perfect white's.

        Parameters
        ----------
        r_d
            (H, W, 3).
        mask
            (H, W), 0 to 1; where it is 0 every bit stays.

        Returns
        -------
        r_d : ndarray of float32, shape (H, W, 3)
            No lighter than 1, or than it was where it was lighter already.
        held : ndarray of bool, shape (H, W)
        """
        given = np.asarray(r_d, np.float32)
        share = np.float32(1.0) if mask is None else np.asarray(mask, np.float32)[..., None]
        factor = np.float32(1.0) + share * (self.factor - np.float32(1.0))
        wanted = given * factor
        most = np.maximum(given, np.float32(1.0))
        held = np.any(wanted > most, axis=-1)
        return np.where(factor == 1.0, given, np.minimum(wanted, most)), held


def edit_albedo(
    r_d: ArrayLike,
    valid: ArrayLike,
    chart: TexelChart,
    space: AlbedoTraits,
    amounts: Mapping[str, float],
    *,
    region: BoolArray,
    weight: Float64Array,
    iterations: int = 5,
    noise: float = MATCHING_NOISE,
    rng: np.random.Generator,
) -> AlbedoEdit:
    """Find what some traits do to an albedo map.

    Parameters
    ----------
    r_d
        (H, W, 3).
    valid
        (H, W): texels that were measured; the others take part in no statistic.
    chart
        Where texels lie in the common map.
    space
        Traits of this region.
    amounts
        Trait to amount.
    region
        (N, N), pixels of the common map whose statistics change.
    share
        (N, N), 0 to 1: how much of the change each place of the map gets; the change goes on
        smoothly beyond the region.
    iterations
        Of matching.
    noise
        See `MATCHING_NOISE`.
    rng
        Draws the noise.
    """
    image, known = chart.gather(albedo_vectors.encode_albedo(r_d, space.kind), valid)
    used = region & known
    if not used.any():
        raise AlbedoEditError("r_d: no valid texel lies in the region that is edited")
    if space.kind == "quantiles":
        # the same factor for any skin: bring one darker or lighter than all to where the bins are
        image = image - (image[used].mean(axis=0) - space.texture.mean)
    start = _noisy(image, used, space, noise, rng)
    vector = texture_statistics.describe(start, space=space.texture, valid=known, region=used)
    target, texture, clipped = space.target(vector, amounts)
    found = texture_statistics.match(
        start, target, space=texture, iterations=iterations, valid=known, region=used
    )
    change = _log_ratio(np.asarray(found.image, np.float64), start, space.kind, used)
    change[~used] = 0.0
    filled = texture_fill.push_pull(change, used.astype(np.float32)).values
    filled = filled * np.asarray(weight, np.float32)[..., None]
    texels, _ = chart.read(filled)
    spread = texture_fill.push_pull(texels, chart.on_surface.astype(np.float32)).values  # gutters
    most = -np.log(MIN_ALBEDO_FACTOR)
    informative = albedo_vectors.informative_responses(space.texture)
    return AlbedoEdit(
        np.exp(np.clip(spread, -most, most)).astype(np.float32),
        clipped,
        float(found.before[informative].mean()),
        float(found.after[informative].mean()),
    )


def _log_ratio(
    new: Float64Array, old: Float64Array, kind: VectorKind, used: BoolArray
) -> Float64Array:
    """Return the logarithm of the factor from one encoded map to another."""
    if kind == "quantiles":
        return new - old
    least = max(MIN_ALBEDO_FACTOR * float(np.median(old[used])), albedo_vectors.MIN_REFLECTANCE)
    return np.asarray(np.log(np.maximum(new, least) / np.maximum(old, least)))


def _noisy(
    image: Float32Array,
    used: BoolArray,
    space: AlbedoTraits,
    noise: float,
    rng: np.random.Generator,
) -> Float64Array:
    """Return a map with noise in its decorrelated channels."""
    channels = space.texture.to_channels(np.asarray(image, np.float64))
    for channel in channels:
        channel += noise * float(channel[used].std()) * rng.standard_normal(channel.shape)
    return np.asarray(space.texture.to_colors(channels))
