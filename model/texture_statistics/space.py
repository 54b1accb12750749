"""Texture space of a population: common color axes and bin edges of texture statistics.

A texture is described by one row vector: 256-bin histograms of the image itself and of the 30
responses of its steerable pyramid, in each of three decorrelated channels: 23,808 numbers,

    vector[((channel * 31) + response) * 256 + bin],

where response 0 is the image, 1 the high-pass, 2 + 4 l + k the band of level l (0 the finest) and
orientation k, and 30 the low-pass. (Weyrich et al. call the vectors columns and give 87 x 23,808
as the size of their matrix; here they are the rows of (n, 23808).)

References
----------
Heeger, Bergen 1995, doi:10.1145/218380.218446, section 3.5 (the decorrelated color space).
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 10.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import BoolArray, Float64Array, FloatArray
from model.checks import Checks
from model.checks.files import read_arrays
from model.texture_statistics import steerable_pyramid
from model.texture_statistics.bins import OPPONENT_AXES, make_bin_edges, principal_axes
from model.texture_statistics.histograms import HISTOGRAM_BINS
from model.texture_statistics.masks import fill_smoothly, response_weights
from model.texture_statistics.steerable_pyramid import LEVELS, ORIENTATIONS

_N_QUANTILES = 2049


class TextureError(ValueError):
    """Error for a texture, mask, vector or file without valid texture statistics."""


@dataclass(frozen=True, slots=True, eq=False)
class TextureSpace:
    """Color axes and bin edges; vectors of one space can be compared, averaged and edited."""

    mean: Float64Array
    """(C,): the population's mean color, unit of the images."""
    axes: Float64Array
    """(C, C): orthonormal rows, by decreasing variance; channel = axes @ (color - mean)."""
    edges: Float64Array
    """(C, responses, 257): increasing; responses as in the vector, 31 at full depth."""
    levels: int
    orientations: int
    images: int
    """Number of images it was fitted to; 0: the standard space."""

    def __post_init__(self) -> None:
        """Check shapes, axes and edges."""
        C = len(self.mean)
        R = self.levels * self.orientations + 3
        check = Checks(TextureError)
        check.settings(self, levels="[1, inf)", orientations="[1, inf)")
        shapes = (("mean", (C,)), ("axes", (C, C)), ("edges", (C, R, HISTOGRAM_BINS + 1)))
        for name, shape in shapes:
            array = getattr(self, name)
            check.choice(f"TextureSpace.{name}", array.dtype, (np.dtype(np.float64),))
            check.numbers(f"TextureSpace.{name}", array, shape)
        if np.abs(self.axes @ self.axes.T - np.eye(C)).max() > 1e-9:
            raise TextureError("TextureSpace.axes: got rows that are not orthonormal")
        if not (np.diff(self.edges, axis=-1) > 0.0).all():
            raise TextureError("TextureSpace.edges: got edges that do not increase")

    @property
    def channels(self) -> int:
        """Return the number of channels C."""
        return len(self.mean)

    @property
    def responses(self) -> tuple[str, ...]:
        """Return the names of a channel's histograms in the vector's order."""
        bands = [
            f"level {level} orientation {k}"
            for level in range(self.levels)
            for k in range(self.orientations)
        ]
        return ("image", "high-pass", *bands, "low-pass")

    @property
    def size(self) -> int:
        """Return the length of a vector."""
        return self.channels * len(self.responses) * HISTOGRAM_BINS

    def part(self, channel: int, response: int | str) -> slice:
        """Return the slice of one histogram in a vector.

        Parameters
        ----------
        channel : int
            0 to C - 1, by decreasing variance.
        response : int or str
            Index or name out of `responses`.

        Examples
        --------
        >>> TextureSpace.opponent().part(2, "low-pass")
        slice(23552, 23808, None)
        """
        names = self.responses
        number = response
        if isinstance(number, str):
            number = names.index(number) if number in names else -1
        if not (0 <= channel < self.channels and 0 <= number < len(names)):
            raise TextureError(
                f"part: got channel {channel}, response {response!r}, expected 0 to "
                f"{self.channels - 1} and 0 to {len(names) - 1} or one of {', '.join(names)}"
            )
        begin = (channel * len(names) + number) * HISTOGRAM_BINS
        return slice(begin, begin + HISTOGRAM_BINS)

    def histograms(self, vector: ArrayLike) -> Float64Array:
        """Return vectors (..., n) as histograms (..., C, responses, 256)."""
        v = np.asarray(vector, np.float64)
        Checks(TextureError).shape("vector", v, ("...", self.size))
        return v.reshape(*v.shape[:-1], self.channels, len(self.responses), HISTOGRAM_BINS)

    def check(self, vector: ArrayLike) -> Float64Array:
        """Return a vector as histograms (C, responses, 256) after checking each.

        Raises
        ------
        TextureError
            For a wrong length, negative fractions, or histograms that do not sum to 1 within 1e-6:
            `model.texture_statistics.histograms.project_to_histograms` makes edited ones valid.
        """
        Checks(TextureError).shape("vector", vector, (self.size,))
        h = self.histograms(vector)
        Checks(TextureError).within("vector (see project_to_histograms)", h, "[0, inf)")
        off = np.abs(h.sum(axis=-1) - 1.0)
        if off.max() > 1e-6:
            c, r = np.unravel_index(int(off.argmax()), off.shape)
            raise TextureError(
                f"vector: got shares that sum to {h[c, r].sum():.6g} in channel {c}, "
                f"{self.responses[r]}, expected 1; see project_to_histograms"
            )
        return h

    def to_channels(self, image: FloatArray) -> FloatArray:
        """Return (C, H, W) decorrelated channels of an image (H, W, C), in its precision."""
        rows = image.reshape(-1, self.channels) - self.mean.astype(image.dtype)
        turned = self.axes.astype(image.dtype) @ rows.T
        return np.ascontiguousarray(turned).reshape(self.channels, *image.shape[:2])

    def to_colors(self, channels: FloatArray) -> FloatArray:
        """Return the image (H, W, C) of decorrelated channels (C, H, W)."""
        rows = channels.reshape(self.channels, -1).T @ self.axes.astype(channels.dtype)
        return np.asarray(
            (rows + self.mean.astype(channels.dtype)).reshape(*channels.shape[1:], self.channels)
        )

    @classmethod
    def opponent(cls, channels: int = 3) -> TextureSpace:
        """Return the standard space for reflectances 0...1 without a population.

        Channels are brightness, red less green and yellow less blue (RGB), or the image itself
        (1 channel). Bins of the image and low-pass are uniform; those of the bands grow
        exponentially away from 0. A fitted space describes a population much better.
        """
        if channels not in (1, 3):
            raise TextureError(
                f"channels: got {channels}; the standard space has 1 or 3: fit one to the images"
            )
        even = np.linspace(0.0, 1.0, HISTOGRAM_BINS + 1)
        grown = np.sinh(8.0 * (2.0 * even - 1.0)) / np.sinh(8.0)
        count = LEVELS * ORIENTATIONS + 3
        edges = np.empty((channels, count, HISTOGRAM_BINS + 1))
        for c in range(channels):
            edges[c] = grown
            top = 1.25 * np.sqrt(channels)
            edges[c, [0, -1]] = top * even if c == 0 else 1.5 * grown
        axes = OPPONENT_AXES if channels == 3 else np.eye(1)
        return cls(np.zeros(channels), axes.copy(), edges, LEVELS, ORIENTATIONS, 0)

    @classmethod
    def fit(
        cls,
        images: Sequence[ArrayLike],
        *,
        valid: Sequence[BoolArray | None] | None = None,
        levels: int = LEVELS,
        orientations: int = ORIENTATIONS,
        workers: int | None = None,
    ) -> TextureSpace:
        """Fit color axes and bin edges to a population, with equal weights of the images.

        Parameters
        ----------
        images : sequence of array_like, each (H, W) or (H, W, C)
            In one color space and unit; sizes may differ. Read twice, one at a time.
        valid : sequence of ndarray of bool (H, W) or None
            Texels that count.
        levels, orientations : int
            7 and 4 give the vector of 23,808.
        workers : int or None
            Threads; None: one a core, 4 at most.

        Returns
        -------
        TextureSpace

        Raises
        ------
        TextureError
            For no image, channels that differ, an empty mask, valid texels that are not finite.

        Notes
        -----
        Axes are the principal axes of the mean covariance of the images' colors about the common
        mean; directions without variance are set to brightness and opponent colors. Half of the
        bins of a response are uniform over its range in the population (and 5 % more), half follow
        the frequency of values, so that neither rare extremes nor the many values at 0 fall into a
        few bins. A response without variance gets narrow bins about its value.
        """
        count = len(images)
        if not count or (valid is not None and len(valid) != count):
            raise TextureError(
                f"images, valid: got {count} images and "
                f"{'no' if valid is None else len(valid)} masks, expected at least 1, as many"
            )
        masks = [None] * count if valid is None else list(valid)
        moments = []
        unit = 0.0
        for image, mask in zip(images, masks, strict=True):
            colors, inside = check_image(image, mask)
            rows = colors[inside].astype(np.float64)
            unit = max(unit, float(np.abs(rows).max()))
            center = rows.mean(axis=0)
            moments.append((center, (rows - center).T @ (rows - center) / len(rows)))
        channels = {len(center) for center, _ in moments}
        if len(channels) != 1:
            raise TextureError(f"images: got {sorted(channels)} channels, expected one number")
        centers = np.array([center for center, _ in moments])
        mean = centers.mean(axis=0)
        spread = np.mean([c for _, c in moments], axis=0)
        spread = spread + (centers - mean).T @ (centers - mean) / count
        axes = principal_axes(spread, unit or 1.0)
        even = np.linspace(0.0, 1.0, HISTOGRAM_BINS + 1)
        even = np.tile(even, (len(mean), levels * orientations + 3, 1))
        plain = cls(mean, axes, even, levels, orientations, count)
        pairs = zip(images, masks, strict=True)
        pooled = np.stack([_quantiles(plain, *pair, workers) for pair in pairs])
        edges = np.empty_like(plain.edges)
        for c in range(pooled.shape[1]):
            for r in range(pooled.shape[2]):
                edges[c, r] = make_bin_edges(pooled[:, c, r], unit or 1.0)
        return cls(mean, axes, edges, levels, orientations, count)

    def save(self, path: str | Path) -> None:
        """Write the space as npz without loss; ``path`` is used unchanged."""
        with Path(path).open("wb") as file:
            np.savez_compressed(
                file,
                mean=self.mean,
                axes=self.axes,
                edges=self.edges,
                counts=np.array([self.levels, self.orientations, self.images]),
            )

    @classmethod
    def load(cls, path: str | Path) -> TextureSpace:
        """Read a file of `save`; raise TextureError for any other file."""
        try:
            stored = read_arrays(path)
            mean, axes, edges = (stored[name] for name in ("mean", "axes", "edges"))
            levels, orientations, images = (int(n) for n in stored["counts"])
        except (OSError, KeyError, ValueError, TypeError) as error:
            raise TextureError(f"{path}: got no texture space ({error})") from error
        return cls(mean, axes, edges, levels, orientations, images)


def check_image(image: ArrayLike, valid: ArrayLike | None) -> tuple[FloatArray, BoolArray]:
    """Return an image as (H, W, C), in float64 if given so, else in float32, and its mask."""
    values = np.asarray(image)
    values = values.astype(np.float64 if values.dtype == np.float64 else np.float32, copy=False)
    if values.ndim == 2:
        values = values[..., None]
    Checks(TextureError).shape("image", image, ("H", "W"), ("H", "W", "C"))
    mask = np.ones(values.shape[:2], bool) if valid is None else np.asarray(valid)
    Checks(TextureError).mask("valid", mask, values.shape[:2])
    if not mask.any():
        raise TextureError(f"valid: got no valid texel of {mask.size}, expected at least one")
    Checks(TextureError).within("image (mark others in valid)", values[mask])
    return values, mask


def _quantiles(
    space: TextureSpace, image: ArrayLike, valid: BoolArray | None, workers: int | None
) -> FloatArray:
    """Return even quantiles of the valid samples of all responses, (C, R, quantiles) float32."""
    colors, mask = check_image(image, valid)
    weights = None if mask.all() else response_weights(mask, None, space.levels)
    out = np.empty((space.channels, len(space.responses), _N_QUANTILES), colors.dtype)
    for c, channel in enumerate(space.to_channels(fill_smoothly(colors, mask))):
        pyramid = steerable_pyramid.analyze(
            channel, levels=space.levels, orientations=space.orientations, workers=workers
        )
        for r, values in enumerate((channel, *pyramid)):
            if weights is not None:
                values = values[response_weight(weights, r, space.orientations) > 0.0]
            ordered = np.sort(values, axis=None)
            ranks = np.linspace(0.0, ordered.size - 1.0, _N_QUANTILES)
            out[c, r] = ordered[np.rint(ranks).astype(np.int64)]
    return out


def response_weight(
    weights: tuple[FloatArray, tuple[FloatArray, ...]], response: int, orientations: int
) -> FloatArray:
    """Return the weights of a response's samples out of those of all levels."""
    texels, samples = weights
    return texels if response == 0 else samples[max(response - 2, 0) // orientations]
