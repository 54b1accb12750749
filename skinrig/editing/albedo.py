"""Edit R_d by traits: match the albedo map to the histograms of the edited statistics.

The albedo is resampled to the seamless common map. Its statistics are edited, and the map is
matched to them by the method of Heeger and Bergen, starting from the map itself with slight noise.
The result is applied to the texels as a factor. Thus no value becomes negative, and detail finer
than the common map is kept.
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
"""Noise added before matching, as a fraction of each channel's standard deviation."""
MIN_ALBEDO_FACTOR: Final = 0.02
"""Minimum factor of an edit; its inverse is the maximum."""


class AlbedoEditError(ValueError):
    """An albedo map without the texels that the edit needs."""


@dataclass(frozen=True, slots=True, eq=False)
class AlbedoEdit:
    """Factor of R_d per texel, with the residual of the matching.

    Attributes
    ----------
    factor
        (H, W, 3), `MIN_ALBEDO_FACTOR` to its inverse; 1: unchanged.
    clipped
        Fraction of the change of statistics that was clipped.
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
        """Return the edited R_d, and the texels that were clipped at 1.

        Parameters
        ----------
        r_d
            (H, W, 3).
        mask
            (H, W), 0 to 1; texels of 0 stay bit-identical.

        Returns
        -------
        r_d : ndarray of float32, shape (H, W, 3)
            At most 1, or the original value where that exceeds 1.
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
    """Compute the factor by which traits change an albedo map.

    Parameters
    ----------
    r_d
        (H, W, 3).
    valid
        (H, W): measured texels; others are excluded from the statistics.
    chart
        Positions of the texels in the common map.
    space
        Traits of this region.
    amounts
        Amount by trait.
    region
        (N, N), pixels of the common map whose statistics change.
    weight
        (N, N), 0 to 1: weight of the change per pixel of the common map; it may extend smoothly
        beyond the region.
    iterations
        Number of iterations of the matching.
    noise
        See `MATCHING_NOISE`.
    rng
        Draws the noise.
    """
    image, known = chart.gather(albedo_vectors.encode_albedo(r_d, space.kind), valid)
    used = region & known
    if not used.any():
        raise AlbedoEditError(
            "r_d: got no valid texel in the edited region, expected some; choose another --region"
        )
    if space.kind == "quantiles":
        # shift the mean to that of the training data, where the histogram bins are; the log factor
        # of the edit is the same for skin that is darker or lighter than all training data
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
    """Return the log ratio of two encoded maps."""
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
    """Add noise to the decorrelated channels of a map."""
    channels = space.texture.to_channels(np.asarray(image, np.float64))
    for channel in channels:
        channel += noise * float(channel[used].std()) * rng.standard_normal(channel.shape)
    return np.asarray(space.texture.to_colors(channels))
