"""Check by shading whether a list of lights belongs to its images: order, dead lights, strengths.

A matte object under N lights spans a space of three images; a list in the wrong order does not
explain it. A common rotation or reflection of all directions (a mirrored axis) explains the shading
equally well and is not detected.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.checks import Checks
from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.normal_maps import PhotometricStereoError
from reconstruction.photometric_stereo.estimation import estimate_normals

SAMPLE_POINTS = 1500
MIN_LIGHT_STRENGTH = 0.05
"""Strength, relative to the median light, below which a light is dead."""
ORDER_MISFIT_RATIO = 0.7
"""Ratio of misfits below which another order is reported instead of the listed one."""
MAX_SHADING_MISFIT = 0.15
"""Misfit over mean brightness up to which shading counts as explained."""


@dataclass(frozen=True, slots=True)
class LightCheck:
    """Evidence of shading about a list of lights.

    Attributes
    ----------
    order : str
        "as listed", or the name of the order that fits clearly better, or "unknown" if none of
        those tried explains the shading.
    permutation : ndarray of int, shape (N,)
        Row of the list for each image under that order.
    misfit : dict of str to float
        Mean absolute residual over mean brightness, per order tried.
    strength : ndarray, shape (N,)
        Of each light, relative to their median, under that order; 0 for a dead one.
    dead : ndarray of bool, shape (N,)
    points : int
        Number of points used.
    """

    order: str
    permutation: NDArray[np.intp]
    misfit: dict[str, float]
    strength: Float64Array
    dead: BoolArray
    points: int


def check_lights(
    intensity: FloatArray,
    light_directions: ArrayLike,
    *,
    valid: BoolArray | None = None,
    rng: np.random.Generator,
) -> LightCheck:
    """Compare a list of directions with the shading it should explain.

    Parameters
    ----------
    intensity : ndarray, shape (N, ...)
        Linear samples of one channel.
    light_directions : array_like, shape (N, 3)
        In the order to be checked.
    valid : ndarray of bool, shape (N, ...) or (...), optional
        Samples or points to use.
    rng : Generator
        Chooses the points.

    Returns
    -------
    LightCheck

    Raises
    ------
    PhotometricStereoError
        If fewer than four lights gave light, or no point is lit by enough of them.
    """
    stack = np.asarray(intensity)
    lights = stack.shape[0]
    directions = np.asarray(light_directions, np.float64)
    Checks(PhotometricStereoError).shape("light_directions", directions, (lights, 3))
    samples, usable = _chosen(stack, valid, rng)
    # a light from the side leaves most points dark, a dead one all of them
    top = np.array(
        [
            np.quantile(row[ok], 0.99) if ok.any() else 0.0
            for row, ok in zip(samples, usable, strict=True)
        ]
    )
    dead = ~(top > MIN_LIGHT_STRENGTH * float(np.median(top)))
    if np.count_nonzero(~dead) < 4:
        raise PhotometricStereoError(
            f"intensity: got light from {np.count_nonzero(~dead)} of {lights} lights, expected at"
            " least 4 to compare an order with the shading; check the lights and the exposure"
        )
    evidence = _ShadingSamples(samples, usable, dead)
    orders = _orders(lights)
    misfit = {name: evidence.misfit(directions[order]) for name, order in orders.items()}
    best = min(misfit, key=lambda name: misfit[name])
    listed = misfit["as listed"]
    order = best if misfit[best] < ORDER_MISFIT_RATIO * listed else "as listed"
    permutation = orders[order]
    strength = evidence.strength(directions[permutation])
    if misfit[order] > MAX_SHADING_MISFIT:
        order = "unknown"
    return LightCheck(order, permutation, misfit, strength, dead, samples.shape[1])


def _chosen(
    stack: FloatArray, valid: BoolArray | None, rng: np.random.Generator
) -> tuple[Float64Array, BoolArray]:
    """Return samples (N, P) of points of middling to full brightness, and which are usable."""
    lights, shape = stack.shape[0], stack.shape[1:]
    flat = stack.reshape(lights, -1)
    mask = np.ones(flat.shape[1], bool)
    each = None
    if valid is not None:
        given = np.asarray(valid)
        if given.shape == shape:
            mask = given.reshape(-1)
        elif given.shape == (lights, *shape):
            each = given.reshape(lights, -1)
            mask = np.count_nonzero(each, axis=0) * 2 > lights
        else:
            raise PhotometricStereoError(
                f"valid: got shape {given.shape}, expected {shape} or {(lights, *shape)}; "
                "give a mask of points, or of lights and points"
            )
    places = np.flatnonzero(mask)
    if places.size > 20 * SAMPLE_POINTS:
        places = np.sort(rng.choice(places, 20 * SAMPLE_POINTS, replace=False))
    level = np.median(flat[:, places].astype(np.float64), axis=0)
    level = np.where(np.isfinite(level), level, 0.0)
    seen = level > 0
    if not seen.any():
        raise PhotometricStereoError(
            "intensity: got no point lit by half of the lights, expected some; check the exposure"
        )
    places = places[seen & (level >= np.quantile(level[seen], 0.3))]
    if places.size > SAMPLE_POINTS:
        places = np.sort(rng.choice(places, SAMPLE_POINTS, replace=False))
    samples = flat[:, places].astype(np.float64)
    usable = np.isfinite(samples)
    if each is not None:
        usable &= each[:, places]
    return np.where(usable, samples, 0.0), usable


def _orders(lights: int) -> dict[str, NDArray[np.intp]]:
    """Return orders that lists are commonly mistaken for, each the list's row for every image."""
    index = np.arange(lights, dtype=np.intp)
    text = np.array(sorted(range(lights), key=str), np.intp)
    inverse = np.empty_like(text)
    inverse[text] = index
    orders = {
        "as listed": index,
        "reversed": index[::-1].copy(),
        "shifted by one": np.roll(index, 1),
        "shifted by one backwards": np.roll(index, -1),
        "sorted as text": text,
        "sorted as numbers": inverse,
        "every second one first": np.concatenate([index[::2], index[1::2]]),
        "the halves exchanged": np.roll(index, lights // 2),
    }
    distinct: dict[str, NDArray[np.intp]] = {}
    for name, order in orders.items():
        if not any(np.array_equal(order, known) for known in distinct.values()):
            distinct[name] = order
    return distinct


@dataclass(frozen=True, slots=True)
class _ShadingSamples:
    """Samples (L, P) of some points, which of them are usable, and dead lights."""

    samples: Float64Array
    usable: BoolArray
    dead: BoolArray

    def shading(self, directions: Float64Array) -> tuple[Float64Array, BoolArray]:
        """Return the shading of a matte surface under lights of these directions, and where."""
        alive = ~self.dead
        found = estimate_normals(
            self.samples[alive], directions[alive], valid=self.usable[alive], robust=True
        )
        matte = unit_vectors(directions) @ (found.normals * found.albedo[:, None]).T
        return np.maximum(matte, 0.0), found.valid

    def misfit(self, directions: Float64Array) -> float:
        """Return the mean absolute residual of a matte surface, over the mean sample."""
        shading, valid = self.shading(directions)
        counted = self.usable & ~self.dead[:, None]
        size = float(np.mean(self.samples[counted]))
        # at a point without a fit the whole sample is residual
        residual = np.where(valid[None], np.abs(self.samples - shading), self.samples)
        return float(np.mean(residual[counted])) / size

    def strength(self, directions: Float64Array) -> Float64Array:
        """Return each light's strength over the median one's; 0 for dead lights."""
        shading, valid = self.shading(directions)
        strength = np.zeros(len(self.samples))
        for light in np.flatnonzero(~self.dead):
            seen = valid & self.usable[light] & (shading[light] > 0.2 * np.max(shading, axis=0))
            if seen.any():
                strength[light] = np.median(self.samples[light, seen] / shading[light, seen])
        middle = np.median(strength[strength > 0]) if (strength > 0).any() else 1.0
        return strength / middle
