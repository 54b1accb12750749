"""Measure texture statistics as one vector, and match textures to given statistics.

Histograms of an image and of its steerable-pyramid responses, in decorrelated channels, describe a
stochastic texture; matching them in turn, from an image or noise, makes another texture with the
same statistics. `model.texture_statistics.space` documents the vector's layout and a population's
common parameters.

References
----------
Heeger, Bergen 1995, doi:10.1145/218380.218446.
Weyrich et al. 2006, doi:10.1145/1141911.1141987, sections 10.2 and 11.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal, TypedDict, TypeVar, Unpack

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import BoolArray, Float64Array, FloatArray
from model.checks import Checks
from model.texture_statistics import steerable_pyramid
from model.texture_statistics.histograms import Bins, HistogramCount, histogram_distance
from model.texture_statistics.masks import fill_smoothly, response_weights
from model.texture_statistics.space import TextureError, TextureSpace, check_image, response_weight
from model.texture_statistics.steerable_pyramid import Responses, thread_count

Weights = tuple[FloatArray, tuple[FloatArray, ...]] | None
T = TypeVar("T")
MATCH_TOL = 1e-4
"""A response within this distance of its target, in population spans, is unchanged: rounding would
only reorder its rare values."""
_MIN_PARALLEL_PIXELS = 128 * 128


@dataclass(frozen=True, slots=True, eq=False)
class TextureStatistics:
    """Statistics vector of one texture, and its uncertainty."""

    vector: Float64Array
    """(23808,) for RGB at full depth: fractions of 256 bins, histogram after histogram."""
    clipped: Float64Array
    """(C, responses): fraction of samples outside the space's edges, counted in the end bins."""
    n_effective: Float64Array
    """(C, responses): upper bound of independent samples; neighbors are correlated."""

    def stderr(self) -> Float64Array:
        """Return a lower bound of the standard error: binomial, of `n_effective` samples."""
        h = self.vector.reshape(*self.n_effective.shape, -1)
        return np.sqrt(h * (1.0 - h) / self.n_effective[..., None]).reshape(-1)


@dataclass(frozen=True, slots=True, eq=False)
class MatchedTexture:
    """Result of matching, and its convergence."""

    image: FloatArray
    """Shape and type of the given image; texels outside the mask or the region are unchanged."""
    distances: Float64Array
    """(iterations + 1, C, responses): distance of each response's histogram from the target's, in
    spans of the population (`model.texture_statistics.histograms.histogram_distance`): at the
    start, then after each iteration."""
    clipped: Float64Array
    """(C, responses): fraction of the result's samples outside the space's edges."""

    @property
    def before(self) -> Float64Array:
        """Return (C, responses): distances at the start, with noise added."""
        return self.distances[0]

    @property
    def after(self) -> Float64Array:
        """Return (C, responses): distances of the result."""
        return self.distances[-1]


class StatisticsSettings(TypedDict, total=False):
    """Region and space of the statistics of an image."""

    space: TextureSpace | None
    valid: BoolArray | None
    region: ArrayLike | None
    workers: int | None


def describe(image: ArrayLike, **sampled: Unpack[StatisticsSettings]) -> Float64Array:
    """Return the statistics of a texture as a row vector, (23808,) for RGB.

    It is the vector of `statistics`; parameters are the same.

    Examples
    --------
    >>> vector = describe(np.full((16, 16, 3), 0.4))
    >>> vector.shape, round(float(vector.sum()), 6)
    ((23808,), 93.0)
    """
    return statistics(image, **sampled).vector


def statistics(
    image: ArrayLike,
    *,
    space: TextureSpace | None = None,
    valid: BoolArray | None = None,
    region: ArrayLike | None = None,
    workers: int | None = None,
) -> TextureStatistics:
    """Count the histograms of a texture and of its responses.

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, C)
        Reflectance or any unit, that of ``space``. Filtered in float64 if it is, else in float32.
    space : TextureSpace or None
        Color space and edges of a population; None: `TextureSpace.standard`, for 0...1.
    valid : ndarray of bool, shape (H, W), or None
        Texels that are known. The others are continued smoothly before filtering and not counted;
        responses near them have lower weight (`model.texture_statistics.masks.response_weights`).
    region : array_like, shape (H, W), or None
        Bool, or weights 0...1: where to count (beard, or no beard). Filters extend over its border
        to valid texels.
    workers : int or None
        Threads; None: one a core, 4 at most.

    Returns
    -------
    TextureStatistics

    Raises
    ------
    TextureError
        For an image, mask or region of a wrong shape, an empty mask, valid texels that are not
        finite, a region without valid texels.
    """
    colors, mask = check_image(image, valid)
    used = TextureSpace.opponent(colors.shape[2]) if space is None else space
    _check_channels(colors, used)
    weights = _weights(mask, region, used.levels)
    channels = used.to_channels(fill_smoothly(colors, mask))
    counted = []
    with ThreadPoolExecutor(thread_count(workers)) as pool:
        for c, channel in enumerate(channels):
            pyramid = _analyze(channel, used, workers)
            counted.append(_count(pool, (channel, *pyramid), _bins(used, c), used, weights))
    return TextureStatistics(
        np.concatenate([one.fractions for row in counted for one in row]),
        np.array([[one.below + one.above for one in row] for row in counted]),
        np.array([[one.n_effective for one in row] for row in counted]),
    )


def match(
    image: ArrayLike,
    target: ArrayLike,
    *,
    space: TextureSpace | None = None,
    iterations: int = 5,
    noise: float = 0.0,
    valid: BoolArray | None = None,
    region: ArrayLike | None = None,
    target_valid: BoolArray | None = None,
    target_region: ArrayLike | None = None,
    start: Literal["image", "noise"] = "image",
    rng: np.random.Generator | None = None,
    workers: int | None = None,
) -> MatchedTexture:
    """Give a texture the statistics of another (Heeger and Bergen's matching).

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, C)
        The source; with ``start="noise"`` it gives only the size and the texels outside the region.
    target : array_like, shape (n,), or an image (H, W[, C])
        A vector of ``space``, or a texture to take it from.
    space : TextureSpace or None
        None: fitted to a target image (and the source), or the standard space for a vector.
    iterations : int
        At least 0; each matches the image, then all responses of its pyramid.
    noise : float
        Standard deviation of white noise added first, in each decorrelated channel's own
        standard deviation; at least 0. It lets details appear that the source lacks.
    valid, region
        As of `statistics`. Only the region changes; weights between 0 and 1 blend.
    target_valid, target_region
        The same for a target image.
    start : {"image", "noise"}
        From the source, or from white noise with the mean and deviation of the target.
    rng : numpy.random.Generator or None
        Needed for noise.
    workers : int or None
        Threads; None: one a core, 4 at most.

    Returns
    -------
    MatchedTexture
        A texture that already has the target's statistics is returned unchanged, to rounding.

    Raises
    ------
    TextureError
        As of `statistics` and `TextureSpace.check`; for ``iterations``, ``noise`` or ``start``
        out of range, and noise without ``rng``.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> rough, smooth = rng.uniform(0.2, 0.8, (32, 32)), np.linspace(0.3, 0.5, 32)[:, None]
    >>> found = match(smooth + 0.01 * rng.standard_normal((32, 32)), rough)
    >>> bool(found.after.mean() < 0.5 * found.before.mean())
    True
    """
    colors, mask = check_image(image, valid)
    Checks(TextureError).within("iterations", iterations, "[0, inf)")
    Checks(TextureError).within("noise", noise, "[0, inf)")
    Checks(TextureError).choice("start", start, ("image", "noise"))
    if (noise > 0.0 or start == "noise") and rng is None:
        raise TextureError("rng: got None, expected a generator; give one to draw noise")
    if np.ndim(target) == 1:
        used = TextureSpace.opponent(colors.shape[2]) if space is None else space
        wanted = used.check(target)
    else:
        texture, known = check_image(target, target_valid)
        if space is None:
            both = ([texture], [known]) if start == "noise" else ([texture, colors], [known, mask])
            used = TextureSpace.fit(both[0], valid=both[1], workers=workers)
        else:
            used = space
        wanted = used.histograms(
            describe(texture, space=used, valid=known, region=target_region, workers=workers)
        )
    _check_channels(colors, used)
    weights = _weights(mask, region, used.levels)
    # texels that change; other valid texels are input of the filters only
    blend = (mask if weights is None else weights[0]).astype(colors.dtype)
    channels = used.to_channels(fill_smoothly(colors, mask))
    distances = np.empty((iterations + 1, used.channels, len(used.responses)))
    clipped = np.empty(distances.shape[1:])
    with ThreadPoolExecutor(thread_count(workers)) as pool:
        for c, original in enumerate(channels):
            bins, now = _bins(used, c), original
            if rng is not None and start == "noise":
                middle, spread = _moments(bins[0], wanted[c, 0])
                grain = middle + spread * rng.standard_normal(now.shape)
                now = _blend_masked(original, grain, blend, mask)
            if rng is not None and noise > 0.0:
                grain = noise * float(now[blend > 0.0].std()) * rng.standard_normal(now.shape)
                now = _blend_masked(original, now + grain, blend, mask)
            for iteration in range(iterations + 1):
                pyramid = _analyze(now, used, workers)
                counted = _count(pool, (now, *pyramid), bins, used, weights)
                shares = np.stack([one.fractions for one in counted])
                distances[iteration, c] = histogram_distance(shares, wanted[c], used.edges[c])
                if iteration == iterations:
                    break
                far = distances[iteration, c] > MATCH_TOL
                if far[1:].any():
                    _move(pool, pyramid, counted, bins, wanted[c], far)
                    now = steerable_pyramid.synthesize(pyramid, workers=workers)
                    counted[0] = bins[0].count(now, None if weights is None else weights[0])
                if far.any():
                    now = bins[0].match(now, counted[0], wanted[c, 0])
                    now = _blend_masked(original, now, blend, mask)
            clipped[c] = [one.below + one.above for one in counted]
            channels[c] = now
    matched = np.where(blend[..., None] > 0.0, used.to_colors(channels), colors)
    return MatchedTexture(matched.reshape(np.shape(image)), distances, clipped)


def _check_channels(colors: FloatArray, space: TextureSpace) -> None:
    if colors.shape[2] != space.channels:
        raise TextureError(
            f"image: got {colors.shape[2]} channels, expected {space.channels} as in the space"
        )


def _weights(mask: BoolArray, region: ArrayLike | None, levels: int) -> Weights:
    """Return the weights of texels and samples; None: all count fully."""
    if region is not None:
        wanted = Checks(TextureError).numbers("region", region, mask.shape, interval="[0, 1]")
        if not (wanted[mask] > 0.0).any():
            raise TextureError("region: got no valid texel, expected at least one")
    elif mask.all():
        return None
    return response_weights(mask, region, levels)


def _analyze(channel: FloatArray, space: TextureSpace, workers: int | None) -> Responses:
    return steerable_pyramid.analyze(
        channel, levels=space.levels, orientations=space.orientations, workers=workers
    )


def _bins(space: TextureSpace, channel: int) -> list[Bins]:
    return [Bins.from_edges(edges) for edges in space.edges[channel]]


def _count(
    pool: ThreadPoolExecutor,
    responses: tuple[FloatArray, ...],
    bins: list[Bins],
    space: TextureSpace,
    weights: Weights,
) -> list[HistogramCount]:
    """Count all histograms of a channel."""

    def one(r: int) -> HistogramCount:
        counts = None if weights is None else response_weight(weights, r, space.orientations)
        return bins[r].count(responses[r], counts)

    return _map_in_threads(
        pool, one, range(len(bins)), large=responses[0].size > _MIN_PARALLEL_PIXELS
    )


def _move(
    pool: ThreadPoolExecutor,
    pyramid: Responses,
    counted: list[HistogramCount],
    bins: list[Bins],
    wanted: Float64Array,
    far: BoolArray,
) -> None:
    """Match the responses of a pyramid in place; the first histogram of all is the image's."""

    def one(r: int, response: FloatArray) -> None:
        if far[r]:
            bins[r].match(response, counted[r], wanted[r], out=response)

    _map_in_threads(
        pool, one, range(1, len(bins)), pyramid, large=pyramid.high.size > _MIN_PARALLEL_PIXELS
    )


def _map_in_threads(
    pool: ThreadPoolExecutor, one: Callable[..., T], *items: Iterable[Any], large: bool
) -> list[T]:
    """Process all items, in threads for large images."""
    return list((pool.map if large else map)(one, *items))


def _blend_masked(
    original: FloatArray, new: FloatArray, blend: FloatArray, mask: BoolArray
) -> FloatArray:
    """Restore the original outside the region, and continue the result past the mask."""
    if mask.all() and blend.min() >= 1.0:
        return new.astype(original.dtype, copy=False)
    mixed = (original + blend * (new - original)).astype(original.dtype, copy=False)
    return fill_smoothly(mixed[..., None], mask)[..., 0]


def _moments(bins: Bins, fractions: Float64Array) -> tuple[float, float]:
    """Return mean and standard deviation of a histogram."""
    middles = 0.5 * (bins.edges[1:] + bins.edges[:-1])
    mean = float(fractions @ middles)
    return mean, float(np.sqrt(fractions @ (middles - mean) ** 2))
