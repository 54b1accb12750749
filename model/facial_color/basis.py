"""Fit scale and bias maps of a hemoglobin rig, and transfer them to another face."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import BoolArray, Float64Array, FloatArray
from model.checks import Checks
from model.facial_color import coarse_maps, deviation_ratio, disc_statistics
from model.facial_color.deviation_ratio import ROUNDING_ERROR
from model.facial_color.disc_statistics import DiscStatistics
from model.facial_color.state_maps import (
    GLOBAL_STATES,
    NEUTRAL,
    FacialColorError,
    RigMaps,
    StateMaps,
    check_name,
)

TRANSFER_METHODS = ("ratio", "difference", "absolute")
_MAX_TEXTURE_LINES = 256
"""Rows and columns from which the correlation area of a map's texture is estimated."""


@dataclass(frozen=True, slots=True, eq=False)
class _Neutral:
    """The neutral map of a rig, with its statistics in discs."""

    image: FloatArray
    valid: BoolArray
    stderr: Float64Array
    radius_px: float
    cells: coarse_maps.CoarseGrid
    own: DiscStatistics
    mean: Float64Array
    """Disc means, one value per cell."""
    mean_valid: BoolArray

    @classmethod
    def of(
        cls,
        images: Mapping[str, FloatArray],
        masks: Mapping[str, BoolArray],
        errors: Mapping[str, Float64Array],
        radius_px: float,
        cells: coarse_maps.CoarseGrid,
    ) -> _Neutral:
        image, valid = images[NEUTRAL], masks[NEUTRAL]
        if not valid.any():
            raise FacialColorError(f"{NEUTRAL}: got no valid pixel, expected some")
        own = disc_statistics.measure(image, radius_px, valid=valid)
        mean, mean_valid = cells.coarsen(own.mean, valid)
        return cls(image, valid, errors[NEUTRAL], radius_px, cells, own, mean, mean_valid)

    def rig(self, states: Mapping[str, StateMaps], global_states: Iterable[str]) -> RigMaps:
        """Return the rig of these states."""
        return RigMaps(
            neutral=np.where(self.valid, self.image, self.image.dtype.type(0)),
            valid=self.valid,
            neutral_stderr=np.where(self.valid, self.stderr, 0.0).astype(self.image.dtype),
            neutral_mean=self.mean,
            states=states,
            radius_px=float(self.radius_px),
            global_states=tuple(global_states),
        )


def fit_rig_maps(
    neutral: ArrayLike,
    states: Mapping[str, ArrayLike],
    *,
    radius_px: float,
    valid: BoolArray | Mapping[str, BoolArray] | None,
    stderr: Mapping[str, ArrayLike],
    global_states: Iterable[str] | None,
    stored_size: int | None,
) -> RigMaps:
    """Fit the maps of a rig to measured maps; see `HemoglobinRig.from_maps`."""
    if not states:
        raise FacialColorError("states: got none, expected at least one other than the neutral")
    for name in states:
        check_name(name)
    base = _image(NEUTRAL, neutral)
    shape = base.shape
    images = {NEUTRAL: base} | {n: _image(n, m, shape) for n, m in states.items()}
    masks = _masks(valid, images)
    errors = _errors(stderr, images)
    rest = _Neutral.of(
        images, masks, errors, radius_px, coarse_maps.coarse_grid(shape, stored_size)
    )
    texture_px = texture_area_px(base - rest.own.mean, rest.valid)
    made = {n: _state(images[n], masks[n], errors[n], rest, texture_px) for n in states}
    listed = [n for n in GLOBAL_STATES if n in states] if global_states is None else global_states
    return rest.rig(made, listed)


def _state(
    image: FloatArray, mask: BoolArray, error: Float64Array, neutral: _Neutral, texture_px: float
) -> StateMaps:
    """Compare one state with the neutral map over the pixels that both have."""
    base, held, own = neutral.image, neutral.valid, neutral.own
    radius_px, cells = neutral.radius_px, neutral.cells
    both = held & mask
    alike = bool((both == held).all())
    rest = own if alike else disc_statistics.measure(base, radius_px, valid=both)
    seen = disc_statistics.measure(image, radius_px, valid=both)
    total = disc_statistics.measure(
        np.where(both, image, 0).astype(np.float64) + np.where(both, base, 0), radius_px, valid=both
    )
    where = held & seen.valid
    covariance = 0.5 * (total.deviation**2 - seen.deviation**2 - rest.deviation**2)
    product = seen.deviation * rest.deviation
    with np.errstate(invalid="ignore", divide="ignore"):
        alikeness = np.where(product > 0.0, np.clip(covariance / product, -1.0, 1.0), 0.0)
        draws = np.maximum(seen.count / texture_px, 1.0)
    # Sampling variance of a ratio of standard deviations of correlated pairs, denominator fixed
    sampled = seen.deviation**2 * (1.0 - alikeness**2) / draws
    measured = [
        _deviation_variance(
            stats, disc_statistics.measure(e.astype(np.float32), radius_px, valid=both), draws
        )
        for stats, e in ((seen, error), (rest, neutral.stderr))
    ]
    ratio = deviation_ratio.estimate_ratio(
        seen.deviation, rest.deviation, sampled + measured[0] + measured[1], where
    )
    s = ratio.value
    # eq. (5); where masks differ, mu_n of the shared pixels is not mu_n of all
    bias = seen.mean if alike else seen.mean + s * (own.mean - rest.mean)
    # standard deviation of H_i - s H_n in the disc: var_i - 2 s cov + s^2 var_n
    misfit = np.sqrt(
        np.maximum(seen.deviation**2 - 2.0 * s * covariance + (s * rest.deviation) ** 2, 0.0)
    )
    shared = _mean_in_disc(error, radius_px, both)
    bias_stderr = np.sqrt(misfit**2 / draws + shared**2)
    stored = {}
    few: BoolArray = np.ones(cells.stored, np.bool_)
    for name, full in (
        ("scale", s),
        ("bias", bias),
        ("scale_stderr", ratio.stderr),
        ("bias_stderr", bias_stderr),
        ("misfit", misfit),
    ):
        stored[name], few = cells.coarsen(full, where)
    exact = bias + s * (base - own.mean)
    mean, _ = cells.coarsen(own.mean, where)
    up = cells.refine(stored["scale"], stored["bias"], mean, valid=few)
    lost = (up[1] + up[0] * (base - up[2]) - exact)[where]
    return StateMaps(
        **stored,
        valid=few,
        prior=ratio.prior,
        storage_rms=float(np.sqrt(np.mean(lost**2))) if lost.size else 0.0,
        storage_largest=float(np.abs(lost).max()) if lost.size else 0.0,
    )


def _mean_in_disc(error: Float64Array, radius_px: float, valid: BoolArray) -> Float64Array:
    if not error.any():
        return np.zeros(error.shape)
    found = disc_statistics.measure(error.astype(np.float32), radius_px, valid=valid)
    return np.where(found.valid, found.mean, 0.0)


def _deviation_variance(
    stats: DiscStatistics, error: DiscStatistics, draws: Float64Array
) -> Float64Array:
    """Return the variance of a measured deviation from the errors of the pixels it is of.

    A pixel error e adds up to e^2 to a squared deviation, and a random 2 sigma e/sqrt(n). The
    result is limited to the deviation's own size from above and to float32 rounding from below.
    """
    sigma = np.where(stats.valid, stats.deviation, 0.0)
    e2 = np.where(error.valid, error.mean**2 + error.deviation**2, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        own = np.where(sigma > 0.0, (0.5 * e2 / np.where(sigma > 0.0, sigma, 1.0)) ** 2, 0.0)
    own += e2 / draws
    return (
        np.minimum(own, sigma**2) + (ROUNDING_ERROR * np.where(stats.valid, stats.mean, 0.0)) ** 2
    )


def texture_area_px(base: Float64Array, valid: BoolArray) -> float:
    """Return the correlation area of a texture, px: the sum of its squared autocorrelation.

    A disc of n pixels determines a deviation as well as n/area independent pixels. The area is the
    product of the correlation lengths along rows and columns.

    Parameters
    ----------
    base
        Map without its local mean, (H, W).
    valid
        (H, W).

    Returns
    -------
    float
        At least 1.
    """
    area = 1.0
    values = np.where(valid, base, 0.0)
    for lines, mask in ((values, valid), (values.T, valid.T)):
        step = max(lines.shape[0] // _MAX_TEXTURE_LINES, 1)
        z, v = lines[::step], mask[::step].astype(np.float64)
        power = float(np.sum(z * z)) / max(float(v.sum()), 1.0)
        length = 1.0
        for lag in range(1, z.shape[1]):
            pairs = float(np.sum(v[:, lag:] * v[:, :-lag]))
            if power <= 0.0 or pairs <= 0.0:
                break
            rho = float(np.sum(z[:, lag:] * z[:, :-lag])) / pairs / power
            if rho < 0.1:
                break
            length += 2.0 * min(rho, 1.0) ** 2
        area *= length
    return area


def transfer_rig_maps(
    rig: RigMaps,
    neutral: ArrayLike,
    *,
    valid: BoolArray | None,
    stderr: ArrayLike | None,
    transfer: str,
) -> RigMaps:
    """Transfer the maps of a rig to another face; see `HemoglobinRig.transfer_to`."""
    Checks(FacialColorError).choice("transfer", transfer, TRANSFER_METHODS)
    base = _image(NEUTRAL, neutral)
    images = {NEUTRAL: base}
    masks = _masks(valid, images)
    errors = _errors({} if stderr is None else {NEUTRAL: stderr}, images)
    size = rig.neutral_mean.shape
    stored = (min(size[0], base.shape[0]), min(size[1], base.shape[1]))
    cells = coarse_maps.CoarseGrid((base.shape[0], base.shape[1]), stored)
    radius_px = float(rig.radius_px * np.sqrt(base.size / rig.neutral.size))
    rest = _Neutral.of(images, masks, errors, radius_px, cells)
    mean, here = rest.mean, rest.mean_valid
    source_mean, source_valid = _resample(rig.neutral_mean, rig.neutral_mean_valid, stored)
    made = {}
    for name, state in rig.states.items():
        maps = {
            field: _resample(getattr(state, field), state.valid, stored)[0]
            for field in ("scale", "bias", "scale_stderr", "bias_stderr", "misfit")
        }
        both = _resample(state.bias, state.valid, stored)[1] & source_valid & here
        if transfer == "difference":
            maps["bias"] = mean + maps["bias"] - source_mean
        elif transfer == "ratio":
            variance = maps["bias_stderr"] ** 2 + (ROUNDING_ERROR * maps["bias"]) ** 2
            change = deviation_ratio.estimate_ratio(maps["bias"], source_mean, variance, both)
            known = both & (source_mean > 0.0)
            maps["bias"] = mean * change.value
            maps["bias_stderr"] = np.abs(mean) * change.stderr
            per = np.where(known, mean / np.where(known, source_mean, 1.0), 1.0)
            maps["misfit"] = maps["misfit"] * np.abs(per)
        made[name] = StateMaps(
            **{field: np.where(both, values, 0.0) for field, values in maps.items()},
            valid=both,
            prior=state.prior,
            storage_rms=state.storage_rms,
            storage_largest=state.storage_largest,
        )
    return rest.rig(made, rig.global_states)


def _resample(
    values: Float64Array, valid: BoolArray, shape: tuple[int, int]
) -> tuple[Float64Array, BoolArray]:
    """Return a stored map at another size, and its mask of valid cells."""
    if values.shape == shape:
        return values, valid
    few = (min(values.shape[0], shape[0]), min(values.shape[1], shape[1]))
    if few != values.shape:
        values, valid = coarse_maps.CoarseGrid((values.shape[0], values.shape[1]), few).coarsen(
            values, valid
        )
    if few != shape:
        (values,) = coarse_maps.CoarseGrid(shape, few).refine(values, valid=valid)
        valid = np.isfinite(values)
    return np.where(valid, values, 0.0), valid


def _image(name: str, image: ArrayLike, shape: tuple[int, ...] | None = None) -> FloatArray:
    values = np.asarray(image)
    if values.dtype != np.float32:
        values = values.astype(np.float64)
    Checks(FacialColorError).shape(name, values, shape or ("H", "W"))
    return values


def _masks(
    valid: BoolArray | Mapping[str, BoolArray] | None, images: Mapping[str, FloatArray]
) -> dict[str, BoolArray]:
    given = valid if isinstance(valid, Mapping) else dict.fromkeys(images, valid)
    for name in given:
        Checks(FacialColorError).choice("valid", name, images)
    masks = {}
    for name, image in images.items():
        mask = given.get(name)
        finite = np.isfinite(image)
        if mask is not None:
            mask = np.asarray(mask)
            Checks(FacialColorError).mask(f"valid of {name}", mask, image.shape)
            finite &= mask
        masks[name] = finite
    return masks


def _errors(
    stderr: Mapping[str, ArrayLike], images: Mapping[str, FloatArray]
) -> dict[str, Float64Array]:
    for name in stderr:
        Checks(FacialColorError).choice("stderr", name, images)
    errors = {}
    for name, image in images.items():
        error = np.asarray(stderr.get(name, np.zeros(image.shape)), np.float64)
        Checks(FacialColorError).shape(f"stderr of {name}", error, image.shape)
        known = np.isfinite(error)
        Checks(FacialColorError).within(f"stderr of {name}", error[known], "[0, inf)")
        errors[name] = np.where(known, error, 0.0)
    return errors
