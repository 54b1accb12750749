"""Generate the melanin of a face: base, slow variation, sun, freckles, moles."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from rigsim.arrays import Float32Array, FloatArray
from rigsim.geometry.surface_noise import random_spots, smooth_noise
from rigsim.subject.face_regions import soft_step

MAX_MELANIN: Final = 0.5
"""Largest volume fraction, Jimenez et al. 2010, table 1."""

MELANIN_PRESETS: Final[Mapping[str, float]] = {
    "palest": 0.0075,
    "I": 0.0093,
    "II": 0.016,
    "III": 0.0255,
    "IV": 0.0395,
    "V": 0.066,
    "VI": 0.16,
    "darkest": 0.23,
}
"""Volume fraction of melanosomes of each preset, for the epidermis of
`rigsim.tissue.skin_layers.TYPICAL_SKIN`. I to VI have the median color of measured skin in the
bands of the individual typology angle (`model/data/skin_percentiles.csv`)."""

_BLOOD_PRESETS: Final = (0.0065, 0.0080, 0.0110, 0.0125, 0.0130, 0.0145, 0.018, 0.020)
"""Volume fraction of blood in the dermis of each preset, between the regions of the face; likewise.
"""


def typical_blood(melanin: float) -> float:
    """Return the blood volume fraction of measured skin of a pigment, between the face's regions.

    Parameters
    ----------
    melanin
        Volume fraction of melanosomes, > 0; beyond the presets the nearest one's blood is returned.

    Examples
    --------
    >>> typical_blood(MELANIN_PRESETS["III"])
    0.0125
    """
    at = np.log(list(MELANIN_PRESETS.values()))
    return float(np.interp(np.log(melanin), at, _BLOOD_PRESETS))


def nearest_preset(melanin: float) -> str:
    """Return the name of the preset with the nearest melanin, by its logarithm.

    Examples
    --------
    >>> nearest_preset(0.06)
    'V'
    """
    return min(MELANIN_PRESETS, key=lambda name: abs(np.log(MELANIN_PRESETS[name] / melanin)))


def draw_melanin_map(
    points_mm: Float32Array,
    regions: Mapping[str, Float32Array],
    base: float,
    *,
    seed: int,
    freckles: float | None = None,
) -> Float32Array:
    """Draw the melanin of a face.

    Parameters
    ----------
    points_mm
        Points on the mean head, shape (..., 3).
    regions
        Masks of `rigsim.subject.face_regions.region_masks`.
    base
        Volume fraction of melanosomes around which the map varies, 0.0005 to 0.45.
    seed
        Any integer; it also determines the areas without sun.
    freckles
        Amount of freckles, 0 to 1, fewer on dark skin; ``None`` draws it, 0.2 to 0.8.

    Returns
    -------
    ndarray of float32
        Volume fraction of melanosomes in the epidermis, shape (...), 0.0005 to 0.5.
    """
    if not 0.0005 <= base <= 0.45:
        raise ValueError(f"base: got {base}, expected a melanin fraction from 0.0005 to 0.45")
    if freckles is not None and not 0.0 <= freckles <= 1.0:
        raise ValueError(f"freckles: got {freckles}, expected 0 to 1")
    rng = np.random.default_rng([seed, 1])
    # Variations are steps of log-odds against the limit: factors for pale skin, bounded for dark.
    step = 0.10 * smooth_noise(points_mm, (40.0, 18.0), seed=seed + 11)
    step += 0.05 * smooth_noise(points_mm, (7.0, 3.0, 1.4), seed=seed + 12)
    step += 0.12 * regions["forehead"] + 0.14 * regions["lids"] + 0.06 * regions["temples"]
    step += 0.10 * regions["neck"]
    step -= 0.55 * regions["lips"]
    step += _suntan(points_mm, base, rng)
    step += _freckles(points_mm, regions, base, seed=seed, rng=rng, amount=freckles)
    step += _moles(points_mm, base, seed=seed, rng=rng)
    odds = base / (MAX_MELANIN - base) * np.exp(step)
    return np.asarray(MAX_MELANIN * odds / (1.0 + odds), np.float32)


def _suntan(points: Float32Array, base: float, rng: np.random.Generator) -> FloatArray:
    """Return the lack of suntan under a cap or behind glasses; the base is tanned skin.

    Borders are 13 to 20 mm wide (10 to 90 %): neither stays in one place for the days that a suntan
    takes.
    """
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    gain = float(rng.uniform(0.25, 0.5)) * (0.4 + 0.6 * float(np.exp(-base / 0.1)))
    if rng.random() < 0.5:
        edge = float(rng.uniform(56.0, 70.0))  # lower edge of a cap
        hidden = soft_step((y - edge - 0.0025 * x * x) / 7.0)
    else:
        half_width, half_height = rng.uniform(22.0, 25.0), rng.uniform(13.0, 17.0)
        q = ((np.abs(x) - 34.0) / half_width) ** 2 + ((y - 21.0) / half_height) ** 2
        hidden = soft_step((1.0 - q) * 1.2) * soft_step((z + 40.0) / 8.0)
    return -gain * hidden


def _freckles(
    points: Float32Array,
    regions: Mapping[str, Float32Array],
    base: float,
    *,
    seed: int,
    rng: np.random.Generator,
    amount: float | None,
) -> FloatArray:
    where = 0.9 * regions["cheeks"] + 0.9 * regions["nose"] + 0.25 * regions["forehead"] + 0.03
    where = where * (1.0 - regions["lips"])
    # Freckles fade on dark skin.
    drawn = float(rng.uniform(0.2, 0.8))  # drawn in every case, so that moles keep their positions
    density = (drawn if amount is None else amount) * float(np.exp(-base / 0.05))
    spots = random_spots(
        points, density * where, cell_mm=3.6, radius_mm=(0.4, 1.1), seed=seed + 21, softness=5.0
    )
    return 0.9 * spots


def _moles(points: Float32Array, base: float, *, seed: int, rng: np.random.Generator) -> FloatArray:
    spots = random_spots(
        points,
        np.full(points.shape[:-1], 0.16),
        cell_mm=26.0,
        radius_mm=(0.7, 2.2),
        seed=seed + 31,
        softness=8.0,
    )
    # Nevi have several times the melanin of the surrounding skin.
    return float(rng.uniform(1.4, 2.0)) * (1.0 + 0.6 * float(np.exp(-base / 0.05))) * spots
