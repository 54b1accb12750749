"""Melanin and hemoglobin by independent component analysis: the published baseline.

It uses neither a skin model nor a scale: optical density without the brightness common to the
channels is unmixed into two independent components.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from threadpoolctl import threadpool_limits

from model import color_table, spectra
from model.checks import Checks
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray

MAX_SAMPLES = 20_000
"""Pixels that determine the components; the maps then cover all pixels."""
MIN_SAMPLES = 50


class UnmixingError(ValueError):
    """Colors that do not contain two components."""


@dataclass(frozen=True, slots=True)
class PigmentMaps:
    """Relative pigment maps.

    Attributes
    ----------
    melanin, hemoglobin
        (H, W) float32, without scale: mean 0 and standard deviation 1 over the valid pixels.
    valid
        (H, W) bool.
    axes
        (2, 3): directions of melanin and hemoglobin in optical density without brightness,
        unit length.
    """

    melanin: Float32Array
    hemoglobin: Float32Array
    valid: BoolArray
    axes: Float64Array


def tsumura_ica(rgb: FloatArray, valid: BoolArray) -> PigmentMaps:
    """Unmix skin colors into two independent pigments.

    Parameters
    ----------
    rgb
        (H, W, 3) linear, of any scale for each channel.
    valid
        (H, W); colors must be above 0 there.

    Returns
    -------
    PigmentMaps

    Raises
    ------
    UnmixingError
        When there are too few pixels, or their colors differ in brightness only.

    Notes
    -----
    The increase of middling skin's density with each pigment determines the order and signs of
    the components.

    References
    ----------
    Tsumura, Haneishi, Miyake 1999, doi 10.1364/JOSAA.16.002169; brightness removed as in
    Tsumura et al. 2003, doi 10.1145/882262.882344.
    """
    from sklearn.decomposition import FastICA

    image = np.asarray(rgb, np.float64)
    Checks().shape("rgb", image, (*valid.shape[:2], 3))
    good = valid & np.isfinite(image).all(axis=-1) & (image > 0).all(axis=-1)
    count = int(np.count_nonzero(good))
    check = Checks(UnmixingError)
    check.within("number of usable pixels", count, f"[{MIN_SAMPLES}, inf)")
    density = -np.log(image[good])
    chroma = density @ _CHROMA_BASIS.T  # (N, 2)
    center = chroma.mean(axis=0)
    samples = chroma[:: max(1, count // MAX_SAMPLES)]
    spread = np.linalg.svd(samples - center, compute_uv=False, full_matrices=False)
    several = spread[1] > 1e-6 * max(spread[0], 1e-12)
    check.require(several, "rgb", "colors along one direction", "variation besides brightness")
    with threadpool_limits(1):
        unmix = FastICA(2, whiten="unit-variance", random_state=0, max_iter=1000, tol=1e-3)
        unmix.fit(samples)
    mixing = unmix.mixing_ / np.linalg.norm(unmix.mixing_, axis=0)  # columns in the plane
    expected = np.stack([_plane(v) for v in _pigments()])
    match = expected @ mixing  # (pigment, component)
    straight = abs(match[0, 0]) + abs(match[1, 1]) >= abs(match[0, 1]) + abs(match[1, 0])
    order = (0, 1) if straight else (1, 0)
    sources = unmix.transform(chroma)
    maps = []
    axes = np.zeros((2, 3))
    for pigment, component in enumerate(order):
        sign = 1.0 if match[pigment, component] >= 0 else -1.0
        values = sign * sources[:, component]
        values = (values - values.mean()) / values.std()
        full = np.zeros(image.shape[:2], np.float32)
        full[good] = values
        maps.append(full)
        axes[pigment] = sign * mixing[:, component] @ _CHROMA_BASIS
    return PigmentMaps(maps[0], maps[1], good, axes)


_CHROMA_BASIS = np.array([[1.0, 0.0, -1.0], [-0.5, 1.0, -0.5]])
_CHROMA_BASIS /= np.linalg.norm(_CHROMA_BASIS, axis=1, keepdims=True)
"""Two unit vectors orthogonal to (1, 1, 1): density without brightness."""


def _plane(vector: Float64Array) -> Float64Array:
    inside = _CHROMA_BASIS @ vector
    return np.asarray(inside / np.linalg.norm(inside))


@cache
def _pigments() -> tuple[Float64Array, Float64Array]:
    """Return the density increase of middling skin per melanin and per blood, (3,) each."""
    table = color_table.build(spectra.LINEAR_SRGB, "D65", size=32, anisotropy=ANISOTROPY_SKIN)
    growth = -table.jacobian(0.04, 0.03) / table.lookup(0.04, 0.03)[:, None]
    return growth[:, 0], growth[:, 1]
