"""Pictures of several channels: added up where the reflection has no color, one by one else."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import FloatArray
from reconstruction.gradient_normals.noise import SensorNoise
from reconstruction.gradient_normals.patterns import GradientError, Key
from reconstruction.normal_maps import NormalMaps


def channel_count(patterns: Mapping[Key, ArrayLike]) -> int | None:
    """Return the number of channels on the pictures' last axis; None where they are (H, W)."""
    shapes = {np.shape(image) for image in patterns.values()}
    if len(shapes) == 1 and len(shape := shapes.pop()) == 3:
        return int(shape[2])
    return None  # what does not fit is told later, by name


def sliced(given: Any, channel: int) -> Any:
    """Return one channel of pictures, variances or masks; what has no channels stays."""
    if isinstance(given, Mapping):
        return {key: sliced(value, channel) for key, value in given.items()}
    if given is None or isinstance(given, SensorNoise) or np.ndim(given) != 3:
        return given
    return np.asarray(given)[..., channel]


def summed(
    patterns: Mapping[Key, ArrayLike], *, variance: Any, valid: Any, saturation: float | None
) -> tuple[dict[Key, FloatArray], Any]:
    """Add the channels of pictures up; NaN where one of them is not valid or saturated.

    Returns
    -------
    pictures : dict
        (H, W).
    variance
        Of the sums.
    """
    out: dict[Key, FloatArray] = {}
    for key, given in patterns.items():
        image = np.asarray(given)
        kind = np.float64 if image.dtype == np.float64 else np.float32
        whole = image.sum(axis=-1, dtype=kind)
        mask = valid.get(key) if isinstance(valid, Mapping) else valid
        if mask is not None:
            mask = np.asarray(mask)
            if mask.dtype != np.bool_ or mask.shape not in (image.shape, image.shape[:2]):
                raise GradientError(
                    f"valid: got {mask.dtype} of shape {mask.shape}, expected bool"
                    f" {image.shape[:2]} or {image.shape}"
                )
            whole[~(mask if mask.ndim == 2 else mask.all(axis=-1))] = np.nan
        if saturation is not None:
            with np.errstate(invalid="ignore"):
                whole[(image >= saturation).any(axis=-1)] = np.nan
        out[key] = whole
    if variance is None:
        return out, None
    channels = next(iter(patterns.values()))
    count = np.shape(channels)[-1]
    if isinstance(variance, SensorNoise):
        return out, SensorNoise(variance.gain, count * variance.read_variance)
    if isinstance(variance, Mapping):
        return out, {key: _sum_variance(value, count) for key, value in variance.items()}
    return out, _sum_variance(variance, count)


def _sum_variance(variance: ArrayLike, count: int) -> FloatArray:
    values = np.asarray(variance, np.float64)
    return np.asarray(values.sum(axis=-1) if values.ndim == 3 else count * values)


def joined(maps: Sequence[NormalMaps]) -> NormalMaps:
    """Return the maps of channels as one, channels on the points' last axis."""
    return NormalMaps(
        np.stack([m.normals for m in maps], axis=-2),
        *(
            np.stack([getattr(m, name) for m in maps], axis=-1)
            for name in ("albedo", "residual", "valid", "stderr_rad", "stderr_albedo", "used")
        ),
    )
