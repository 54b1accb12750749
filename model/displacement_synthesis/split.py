"""Split a surface into mesoscale and relief, and keep both spectra where they meet.

A mesoscale surface, from a scan, carries the waves above a cut-off; relief grown from patches
carries those below. Patches are leveled with the gain 1 - G, where G is the Gaussian filter of
ISO 16610-21. Both parts are independent, so that their powers add, not their amplitudes. The
mesoscale's gain is thus ``sqrt(1 - (1 - G)^2)``: the squares of both gains sum to 1.

Maps grown by cuts have more long waves than their patches: a wave ends at a cut, which spreads its
power by about one wave per cell. Leveled patches have little power above the cut-off, so that the
spread power exceeds theirs. Windows with cheap cuts are a little flatter than patches.
:func:`match_spectrum` measures both spectra and filters the map by the root of their ratio.

References
----------
ISO 16610-21:2011, Geometrical product specifications, filtration: linear profile filters.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike
from scipy import fft, ndimage, signal

from model.arrays import Float64Array, Int64Array
from model.checks import Checks
from model.displacement_synthesis.sources import SPLIT_UM, SynthesisError

BAND_EDGES_PER_MM: Final = tuple(2.0 ** (k / 3.0) for k in range(-3, 4))
"""Bands in which spectra are matched, a third of an octave each, waves per mm."""
WINDOW_MM: Final = 4.0
"""Side of the windows whose spectra are compared, at most."""
MIN_WAVES_PER_WINDOW: Final = 2.0
COARSE_TEXEL_UM: Final = 140.0
"""Texels of the coarse map that is filtered, at most, um."""
SCALE_RATIO: Final = 1.1
"""Ratio of neighboring scales at which a map of varying texels is filtered."""
N_MATCH_PASSES: Final = 6
"""Passes, since windows smear a spectrum and hide a part of its excess."""
GAIN_LIMITS: Final = (0.1, 1.25)
FINE_EDGES_PER_MM: Final = (2.0, 4.0, 8.0, 16.0)
"""Octaves that set one gain of all finer waves; windows with cheap cuts are a little flat."""
MIN_PIXELS_PER_WAVE: Final = 4.0
FINE_WINDOWS_PER_SIDE: Final = 12
MAX_MESOSCALE_TEXEL_UM: Final = 0.25 * SPLIT_UM
FLAT_TAPER: Final = 0.25
"""Fraction of a window over which it fades, for the fine band, whose pixels count evenly."""
ROWS_PER_BAND: Final = 512

Gain = Callable[[Float64Array], Float64Array]


def relief_gain(waves_per_mm: ArrayLike, *, cutoff_um: float = SPLIT_UM) -> Float64Array:
    """Return the gain of relief at spatial frequencies: that of leveled patches, 0 to 1.

    Examples
    --------
    >>> relief_gain([0.0, 1.0, 4.0]).round(3).tolist()
    [0.0, 0.5, 1.0]
    """
    waves = np.asarray(waves_per_mm, np.float64) * 1e-3 * cutoff_um
    return np.asarray(-np.expm1(-math.log(2.0) * waves**2))


def mesoscale_gain(waves_per_mm: ArrayLike, *, cutoff_um: float = SPLIT_UM) -> Float64Array:
    """Return the gain of the mesoscale, whose square and that of `relief_gain` sum to 1.

    Examples
    --------
    >>> waves = np.array([0.0, 0.5, 1.0, 3.0])
    >>> (mesoscale_gain(waves) ** 2 + relief_gain(waves) ** 2).round(12).tolist()
    [1.0, 1.0, 1.0, 1.0]
    """
    return np.asarray(np.sqrt(1.0 - relief_gain(waves_per_mm, cutoff_um=cutoff_um) ** 2))


@dataclass(frozen=True, slots=True, eq=False)
class SpectrumMatch:
    """Filter by which a map's spectrum was matched.

    Attributes
    ----------
    edges_per_mm : (B + 1,)
        Edges of the bands that the patches resolve, waves per mm.
    gains : (B,)
        Gain of the filter per band; lower waves have the first one, higher ones have 1.
    before, after : (B,)
        RMS amplitude of the map over that of the patches.
    fine_gain : float
        Gain of finer waves.
    """

    edges_per_mm: Float64Array
    gains: Float64Array
    before: Float64Array
    after: Float64Array
    fine_gain: float

    def to_json(self) -> dict[str, Any]:
        """Return numbers and lists by name, for a record."""
        return {name: np.asarray(getattr(self, name)).tolist() for name in self.__slots__}


def match_spectrum(
    height_um: Any,
    patches: Sequence[tuple[ArrayLike, float]],
    shares: Sequence[float],
    pixel_um: ArrayLike,
) -> SpectrumMatch:
    """Filter a grown map in place so that its waves around the split have the patches' power.

    Parameters
    ----------
    height_um : (H, W) float32
        Heights, um; an array or a memory map. Written.
    patches : sequence of ((h, w), float)
        Leveled patches, um, NaN: hole; and the side of their pixels, um. Narrow holes spread power:
        0.2 mm wide, over 30 % of a patch, they lower the gain by 6 %.
    shares : sequence of float
        Mean square weight of each patch in the map; they are divided by their sum.
    pixel_um : float or (h, w)
        Side of the map's pixels on the skin, um, at any resolution.

    Returns
    -------
    SpectrumMatch
        Without bands, and with an unchanged map, for patches that resolve none of them.

    Raises
    ------
    SynthesisError
        If shapes or numbers are invalid.
    """
    check = Checks(SynthesisError)
    check.shape("height_um", height_um, ("H", "W"))
    weights = np.asarray(shares, np.float64)
    check.shape("shares", weights, (len(patches),))
    check.within("sum of shares", float(weights.sum()), "(0, inf)")
    sizes_um = np.atleast_2d(
        check.numbers("pixel_um", pixel_um, (), ("h", "w"), interval="(0, inf)")
    )
    side_um = min(1e3 * WINDOW_MM, *(pixel * min(np.shape(one)) for one, pixel in patches))
    edges = np.array(BAND_EDGES_PER_MM)
    edges = edges[edges >= MIN_WAVES_PER_WINDOW * 1e3 / side_um * (1.0 - 1e-6)]
    step = max(1, int(COARSE_TEXEL_UM / float(np.median(sizes_um))))
    coarse = _CoarseMap.of(height_um, step, sizes_um)
    empty = np.empty(0)
    if len(edges) < 2 or min(coarse.height_um.shape) * coarse.sizes_um.min() < side_um:
        return SpectrumMatch(empty, empty, empty, empty, 1.0)
    measured = [(np.asarray(one, np.float64), pixel) for one, pixel in patches]
    weights /= weights.sum()
    fine_gain = _fine_gain(height_um, measured, weights, sizes_um, side_um)
    for top in range(0, len(height_um), ROWS_PER_BAND):
        height_um[top : top + ROWS_PER_BAND] *= np.float32(fine_gain)
    coarse.height_um[:] *= fine_gain
    # each level has windows of whole texels; a steep spectrum needs the same side for the patches
    counts = coarse.count_windows(side_um)
    sides = [(count, texels * float(size)) for size, texels, count in counts]
    target = np.zeros(len(edges) - 1)
    for count, side in sides:
        target += count * _target_density(measured, weights, side, edges)
    target /= max(sum(count for count, _ in sides), 1)
    gains = np.ones(len(target))
    change = np.zeros_like(coarse.height_um)
    ratios = []
    for _ in range(N_MATCH_PASSES):
        found = coarse.density(coarse.height_um + change, side_um, edges)
        ratios.append(np.sqrt(found / np.maximum(target, 1e-30)))
        gains = np.clip(gains / np.clip(ratios[-1], 0.5, 2.0), *GAIN_LIMITS)
        change = coarse.filter(partial(_gain_change, edges=edges, gains=gains), restore=False)
    found = coarse.density(coarse.height_um + change, side_um, edges)
    add_coarse(height_um, coarse.filter(partial(_gain_change, edges=edges, gains=gains)), step)
    return SpectrumMatch(
        edges, gains, ratios[0], np.sqrt(found / np.maximum(target, 1e-30)), fine_gain
    )


def add_mesoscale(
    height_um: Any, mesoscale_um: ArrayLike, valid: ArrayLike, pixel_um: ArrayLike
) -> None:
    """Add the waves of a mesoscale surface that relief lacks to a relief, in place.

    Parameters
    ----------
    height_um : (N, N) float32
        Relief, um; an array or a memory map. Written.
    mesoscale_um : (M, M)
        Displacement of the mesoscale surface over the same texture, um, M <= N; texels of at most
        `MAX_MESOSCALE_TEXEL_UM`.
    valid : (M, M) bool
        Texels of the surface; others are filled with the nearest one.
    pixel_um : float or (h, w)
        Side of the mesoscale's texels on the skin, um, at any resolution.

    Raises
    ------
    SynthesisError
        If shapes do not fit, no texel is valid, or texels are too coarse.
    """
    check = Checks(SynthesisError)
    given, mask = np.asarray(mesoscale_um, np.float64), np.asarray(valid)
    for name, one in (("height_um", height_um), ("mesoscale_um", given)):
        check.shape(name, one, (max(np.shape(one), default=0),) * 2)
    check.mask("valid", mask, given.shape)
    known = mask & np.isfinite(given)
    sizes_um = np.atleast_2d(
        check.numbers("pixel_um", pixel_um, (), ("h", "w"), interval="(0, inf)")
    )
    check.within("side of mesoscale_um", len(given), f"[1, {len(height_um)}]")
    check.within("median of pixel_um", float(np.median(sizes_um)), f"(0, {MAX_MESOSCALE_TEXEL_UM}]")
    if not known.any():
        raise SynthesisError("mesoscale_um: got no valid texel, expected some")
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    kept = _CoarseMap.of(given[tuple(nearest)], 1, sizes_um).filter(mesoscale_gain)
    add_coarse(height_um, kept, len(height_um) / len(kept))


def _gain_change(waves: Float64Array, *, edges: Float64Array, gains: Float64Array) -> Float64Array:
    """Return gains less 1, linear over the frequency's logarithm between the bands' middles."""
    middles = np.sqrt(edges[1:] * edges[:-1])
    ends = [*np.log(middles), math.log(edges[-1] * edges[-1] / middles[-1])]
    return np.interp(np.log(np.maximum(waves, 1e-9)), ends, [*gains, 1.0]) - 1.0


@dataclass(frozen=True, slots=True, eq=False)
class _CoarseMap:
    """Means of a map over blocks of pixels, with the size of blocks on the skin."""

    height_um: Float64Array
    """(h, w)."""
    sizes_um: Float64Array
    """(h, w) side of the blocks."""
    levels_um: Float64Array
    """(L,) sizes at which the map is filtered, ascending."""
    sinc_power: int
    """Power of sinc by which bilinear interpolation, and means over blocks, weaken waves."""

    @classmethod
    def of(cls, height_um: Any, step: int, pixel_um: Float64Array) -> "_CoarseMap":
        """Take means over ``step x step`` pixels."""
        coarse = _block_means(height_um, step)
        places = [
            (np.arange(n) + 0.5) * m / n - 0.5
            for n, m in zip(coarse.shape, pixel_um.shape, strict=True)
        ]
        grid = np.meshgrid(*places, indexing="ij")
        sizes = step * ndimage.map_coordinates(pixel_um, grid, order=1, mode="nearest")
        low, high = float(sizes.min()), float(sizes.max())
        count = 1 + math.ceil(math.log(high / low) / math.log(SCALE_RATIO) - 1e-9)
        return cls(coarse, sizes, np.geomspace(low, high, max(count, 1)), 2 + (step > 1))

    def filter(self, gain: Gain, *, restore: bool = True) -> Float64Array:
        """Filter by a gain over waves per mm, mirrored at the borders.

        ``restore``: amplify what the means and the interpolation to pixels weaken.
        """
        rows, columns = self.height_um.shape
        spectrum = fft.dctn(self.height_um, norm="ortho")
        y, x = np.arange(rows)[:, None] / (2.0 * rows), np.arange(columns) / (2.0 * columns)
        per_texel = np.hypot(y, x)
        if restore:
            spectrum /= np.maximum(np.sinc(y) * np.sinc(x), 0.6) ** self.sinc_power
        place = np.zeros_like(self.sizes_um)
        if len(self.levels_um) > 1:
            place = np.log(self.sizes_um / self.levels_um[0])
            place /= math.log(self.levels_um[1] / self.levels_um[0])
        out = np.zeros_like(self.height_um)
        for level, size_um in enumerate(self.levels_um):
            part = np.maximum(1.0 - np.abs(place - level), 0.0)
            if part.any():
                gains = gain(1e3 * per_texel / size_um)
                out += part * fft.idctn(spectrum * gains, norm="ortho")
        return out

    def _windows(
        self, values: Float64Array, side_um: float
    ) -> Iterator[tuple[float, Float64Array]]:
        """Yield each level's size of texels and its windows, (n, side, side), with overlap."""
        nearest = np.abs(np.log(self.sizes_um[..., None] / self.levels_um)).argmin(axis=-1)
        for level, size_um in enumerate(self.levels_um):
            side = int(side_um / size_um)
            if side < 4 or side > min(values.shape):
                continue
            hop = max(side // 2, 1)
            windows = sliding_window_view(values, (side, side))[::hop, ::hop]
            middles = nearest[side // 2 :: hop, side // 2 :: hop]
            chosen = windows[middles[: windows.shape[0], : windows.shape[1]] == level]
            if len(chosen):
                yield float(size_um), chosen

    def count_windows(self, side_um: float) -> list[tuple[float, int, int]]:
        """Return texel size, um, side, texels, and number of the windows of each level."""
        return [
            (size_um, windows.shape[1], len(windows))
            for size_um, windows in self._windows(self.height_um, side_um)
        ]

    def density(self, values: Float64Array, side_um: float, edges: Float64Array) -> Float64Array:
        """Return the mean power density of bands over windows of a side, um^4."""
        total, count = np.zeros(len(edges) - 1), 0
        for size_um, windows in self._windows(values, side_um):
            total += len(windows) * _band_density(windows, size_um, edges, blocks=True)
            count += len(windows)
        return total / max(count, 1)


def _block_means(height_um: Any, step: int) -> Float64Array:
    """Return means over ``step x step`` pixels; blocks at the border repeat their last pixel."""
    rows, columns = (-(-n // step) for n in height_um.shape)
    out = np.empty((rows, columns))
    band = max(1, ROWS_PER_BAND // step)
    for first in range(0, rows, band):
        part = np.asarray(height_um[first * step : (first + band) * step], np.float64)
        high = -(-len(part) // step)
        short = [(0, high * step - len(part)), (0, columns * step - part.shape[1])]
        blocks = np.pad(part, short, mode="edge").reshape(high, step, columns, step)
        out[first : first + high] = blocks.mean(axis=(1, 3))
    return out


def add_coarse(height_um: Any, change: Float64Array, step: float) -> None:
    """Add a map of ``step x step`` pixels per texel to a map in place, bilinearly."""
    rows, columns = height_um.shape
    left, part = _between(columns, change.shape[1], step)
    for top in range(0, rows, ROWS_PER_BAND):
        upper, share = _between(min(ROWS_PER_BAND, rows - top), change.shape[0], step, first=top)
        lower = np.minimum(upper + 1, change.shape[0] - 1)
        lines = (1.0 - share)[:, None] * change[upper] + share[:, None] * change[lower]
        right = np.minimum(left + 1, change.shape[1] - 1)
        added = (1.0 - part) * lines[:, left] + part * lines[:, right]
        height_um[top : top + len(lines)] += added.astype(np.float32)


def _between(
    count: int, coarse: int, step: float, *, first: int = 0
) -> tuple[Int64Array, Float64Array]:
    """Return the coarse texel before each pixel, and the fraction of the next one."""
    at = np.clip((np.arange(first, first + count) + 0.5) / step - 0.5, 0.0, coarse - 1.0)
    before = at.astype(np.int64)
    return before, at - before


def _fine_gain(
    height_um: Any,
    patches: Sequence[tuple[Float64Array, float]],
    weights: Float64Array,
    sizes_um: Float64Array,
    side_um: float,
) -> float:
    """Return the mean gain by which the map reaches the patches in the octaves both resolve."""
    coarsest_um = max(float(sizes_um.max()), *(pixel for _, pixel in patches))
    edges = np.array(FINE_EDGES_PER_MM)
    edges = edges[edges <= 1e3 / (MIN_PIXELS_PER_WAVE * coarsest_um)]
    if len(edges) < 2:
        return 1.0
    power, count = np.zeros(len(edges) - 1), 0
    part = (np.arange(FINE_WINDOWS_PER_SIDE) + 0.5) / FINE_WINDOWS_PER_SIDE
    for y in part:
        for x in part:
            size_um = float(sizes_um[tuple((np.array([y, x]) * sizes_um.shape).astype(int))])
            side = round(side_um / size_um)
            top, left = (int(a * (n - side)) for a, n in zip((y, x), height_um.shape, strict=True))
            if min(top, left) >= 0:
                window = np.array(height_um[top : top + side, left : left + side], np.float64)
                power += _band_density(window[None], size_um, edges, taper=FLAT_TAPER)
                count += 1
    target = count * _target_density(patches, weights, side_um, edges, taper=FLAT_TAPER)
    if not (power > 0.0).all() or not (target > 0.0).all():
        return 1.0
    return float(np.clip(np.exp(0.5 * np.mean(np.log(target / power))), 0.8, 1.25))


def _target_density(
    patches: Sequence[tuple[Float64Array, float]],
    weights: Float64Array,
    side_um: float,
    edges: Float64Array,
    *,
    taper: float = 1.0,
) -> Float64Array:
    """Return the weighted mean of the patches' power density in bands, um^4."""
    return np.sum(
        [
            weight * _patch_density(one, pixel, side_um, edges, taper)
            for weight, (one, pixel) in zip(weights, patches, strict=True)
        ],
        axis=0,
    )


def _patch_density(
    patch: Float64Array, pixel_um: float, side_um: float, edges: Float64Array, taper: float
) -> Float64Array:
    """Return the mean power density of bands over windows of a patch, um^4.

    Windows with a taper over their whole side overlap by half.
    """
    side = min(round(side_um / pixel_um), *patch.shape)
    rows, columns = (
        np.unique(np.linspace(0, n - side, _count_windows(n, side, taper)).astype(int))
        for n in patch.shape
    )
    windows = [patch[y : y + side, x : x + side] for y in rows for x in columns]
    return _band_density(np.stack(windows), pixel_um, edges, taper=taper)


def _count_windows(length: int, side: int, taper: float) -> int:
    return 2 * (length // side) - 1 if taper == 1.0 else length // side


def _band_density(
    windows: Float64Array,
    texel_um: float,
    edges: Float64Array,
    *,
    taper: float = 1.0,
    blocks: bool = False,
) -> Float64Array:
    """Return the power density of bands, um^4, mean over windows (n, side, side).

    ``taper`` is the fraction of a window's side over which it fades; ``blocks`` corrects for means
    over blocks. Holes are NaN; power is divided by the squared taper over known pixels alone, since
    a hole has none.
    """
    known = np.isfinite(windows)
    heights = np.where(known, windows, 0.0)
    side = windows.shape[1]
    fade = known * np.outer(signal.windows.tukey(side, taper), signal.windows.tukey(side, taper))
    means = np.sum(heights * fade, axis=(1, 2)) / np.maximum(fade.sum(axis=(1, 2)), 1e-30)
    level = heights - means[:, None, None]
    power = np.sum(np.abs(np.fft.fft2(level * fade)) ** 2, axis=0)
    power *= texel_um**2 / max(float(np.sum(fade**2)), 1e-30)
    per_texel = np.fft.fftfreq(side)
    if blocks:  # means over blocks weaken waves
        power /= np.maximum(np.outer(np.sinc(per_texel), np.sinc(per_texel)), 0.6) ** 2
    waves = 1e3 / texel_um * np.hypot(per_texel[:, None], per_texel[None]).ravel()
    # a wave belongs to bands by the part of its resolution within them, not by its middle alone
    half = 0.5e3 / (texel_um * side)
    densities = np.empty(len(edges) - 1)
    for k, (low, high) in enumerate(pairwise(edges)):
        inside = np.minimum(waves + half, high) - np.maximum(waves - half, low)
        part = np.clip(inside, 0.0, None)
        densities[k] = part @ power.ravel() / part.sum()
    return densities
