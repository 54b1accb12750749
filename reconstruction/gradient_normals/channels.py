"""Keep pattern images with variances and masks: by channel, and sorted by polarization.

Channels are summed where the reflection has no color, otherwise taken separately.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from model.checks import Checks
from reconstruction.arrays import BoolArray, FloatArray
from reconstruction.gradient_normals.noise import SensorNoise
from reconstruction.gradient_normals.patterns import (
    PATTERN_NAMES,
    POLARIZER_NAMES,
    GradientError,
    Key,
    PatternStack,
)
from reconstruction.normal_maps import NormalMaps

Variance = float | SensorNoise | Mapping[Key, ArrayLike] | None
Valid = BoolArray | Mapping[Key, BoolArray] | None


@dataclass(frozen=True, slots=True, eq=False)
class PatternSamples:
    """Pattern images with variances, masks and saturation, as given to `from_patterns`."""

    patterns: Mapping[Key, ArrayLike]
    variance: Variance
    valid: Valid
    saturation: float | None

    @property
    def channels(self) -> int | None:
        """Number of channels on the images' last axis; None where they are (H, W)."""
        shapes = {np.shape(image) for image in self.patterns.values()}
        if len(shapes) == 1 and len(shape := shapes.pop()) == 3:
            return int(shape[2])
        return None  # the check of each image reports a mismatch by its key

    def channel(self, number: int) -> PatternSamples:
        """Return one channel of images, variances and masks; keep those without channels."""

        def sliced(given: Any) -> Any:
            if isinstance(given, Mapping):
                return {key: sliced(value) for key, value in given.items()}
            if given is None or isinstance(given, SensorNoise) or np.ndim(given) != 3:
                return given
            return np.asarray(given)[..., number]

        given = sliced(self.patterns), sliced(self.variance), sliced(self.valid)
        return PatternSamples(*given, self.saturation)

    def sum_channels(self) -> PatternSamples:
        """Sum the channels of images; NaN where one of them is not valid or saturated."""
        out: dict[Key, FloatArray] = {}
        for key, given in self.patterns.items():
            image = np.asarray(given)
            kind = np.float64 if image.dtype == np.float64 else np.float32
            whole = image.sum(axis=-1, dtype=kind)
            mask: Any = self.valid.get(key) if isinstance(self.valid, Mapping) else self.valid
            if mask is not None:
                Checks(GradientError).mask("valid", mask, image.shape[:2], image.shape)
                whole[~(mask if np.ndim(mask) == 2 else np.all(mask, axis=-1))] = np.nan
            if self.saturation is not None:
                with np.errstate(invalid="ignore"):
                    whole[(image >= self.saturation).any(axis=-1)] = np.nan
            out[key] = whole
        return PatternSamples(out, self._summed_variance(), None, None)

    def _summed_variance(self) -> Variance:
        count, variance = self.channels or 1, self.variance

        def total(of_channels: ArrayLike) -> Any:
            values = np.asarray(of_channels, np.float64)
            return values.sum(axis=-1) if values.ndim == 3 else count * values

        if variance is None:
            return None
        if isinstance(variance, SensorNoise):
            return SensorNoise(variance.gain, count * variance.read_variance)
        if isinstance(variance, Mapping):
            return {key: total(value) for key, value in variance.items()}
        return total(variance)


def stack_channels(maps: Sequence[NormalMaps]) -> NormalMaps:
    """Stack the maps of channels to one, channels on the points' last axis."""
    return NormalMaps(
        np.stack([m.normals for m in maps], axis=-2),
        *(
            np.stack([getattr(m, name) for m in maps], axis=-1)
            for name in ("albedo", "residual", "valid", "stderr_rad", "stderr_albedo", "used")
        ),
    )


def sort_by_polarization(samples: PatternSamples) -> dict[str, PatternStack]:
    """Check the images and sort them by polarization.

    Returns
    -------
    dict of str to PatternStack
        By polarization, of those with images.
    """
    check = Checks(GradientError)
    check.require(samples.patterns, "patterns", "none", "images keyed (pattern, polarizer)")
    shape: tuple[int, ...] = ()
    stacks: dict[str, PatternStack] = {}
    for key, picture in samples.patterns.items():
        name, polarizer = _known_key(key)
        image = np.asarray(picture)
        where, got = f"patterns[{name!r}, {polarizer!r}]", f"{image.dtype} of shape {image.shape}"
        good = image.dtype.kind in "fui" and image.ndim == 2 and image.size
        check.require(good, where, got, "linear numbers (H, W) or (H, W, C)")
        shape = shape or image.shape
        check.shape(where, image, shape)
        stack = stacks.setdefault(polarizer, PatternStack({}, None, {}))
        stack.images[name] = image
        mask = _mask(samples.valid, (name, polarizer), shape)
        if samples.saturation is not None:
            with np.errstate(invalid="ignore"):
                clear = ~(image >= samples.saturation)
            mask = clear if mask is None else mask & clear
        if mask is not None and not mask.all():
            stack.valid[name] = mask
    variance = samples.variance
    if variance is None or isinstance(variance, SensorNoise):
        return stacks
    return {
        polarizer: _with_variance(stack, polarizer, variance, shape)
        for polarizer, stack in stacks.items()
    }


def _known_key(key: Any) -> Key:
    if not (isinstance(key, tuple) and len(key) == 2 and all(isinstance(k, str) for k in key)):
        raise GradientError(f"patterns: got key {key!r}, expected (pattern, polarizer)")
    for word, known, kind in (
        (key[0], PATTERN_NAMES, "pattern"),
        (key[1], POLARIZER_NAMES, "polarizer"),
    ):
        if word not in known:
            near = difflib.get_close_matches(word, known, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise GradientError(
                f"patterns: got {kind} {word!r}, expected one of {', '.join(known)}{hint}"
            )
    return key[0], key[1]


def _mask(valid: Valid, key: Key, shape: tuple[int, ...]) -> BoolArray | None:
    given = valid.get(key) if isinstance(valid, Mapping) else valid
    if given is None:
        return None
    Checks(GradientError).mask("valid", given, shape)
    return np.asarray(given)


def _with_variance(
    stack: PatternStack, polarizer: str, variance: Any, shape: tuple[int, ...]
) -> PatternStack:
    found: dict[str, FloatArray] = {}
    check = Checks(GradientError)
    for name in stack.images:
        key, where = (name, polarizer), f"variance[{name!r}, {polarizer!r}]"
        own = variance
        if isinstance(variance, Mapping):
            check.require(key in variance, "variance", f"none of {key}", "one of every image")
            own = variance[key]
        values = np.asarray(own, np.float64)
        check.shape(where, values, (), shape)
        if values.ndim == 0:
            check.within(where, float(values), "(0, inf)")
        with np.errstate(invalid="ignore"):
            good = np.isfinite(values) & (values > 0)
        if not good.all():  # samples of unknown variance are not used
            before = stack.valid.get(name)
            stack.valid[name] = good if before is None else before & good
            values = np.where(good, values, 1.0)
        found[name] = values
    return PatternStack(stack.images, found, stack.valid)
