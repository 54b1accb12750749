"""Estimate one melanin map for all states of a face, and each state's blood given it.

Expressions change the blood of skin, not its melanin (Jimenez et al. 2010, section 3.1). From one
image, the errors of melanin and blood are anticorrelated. Estimated jointly, the states have one
melanin, whose noise decreases with their number, and changes of blood no longer contain the
difference of two melanin estimates.

Method. The shading of each state is free, so that a color has two degrees of freedom left. All
colors of a pixel, each transformed to the states' mean blood, are averaged. The posterior of that
color (`reconstruction.chromophores.posterior`) uses the prior of the light and the model error
once. Given melanin, each state's blood is fitted to its own color. Where the light changes smoothly
between states, the colors of many pixels determine the change, and a pixel's brightness then
constrains its blood. The model error is nearly the same in all states of a pixel: averaging does
not reduce it, and it nearly cancels in differences. Standard errors include both.

References
----------
Jimenez et al. 2010, doi:10.1145/1866158.1866167, section 3.1
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from model.checks import Checks
from model.color_table import ColorTable, with_exact_optics
from model.threads import run_in_blocks
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from reconstruction.chromophores import (
    ChromophoreError,
    add_brightness_variance,
    invert,
    model_covariance,
)
from reconstruction.chromophores.face import estimate_face
from reconstruction.chromophores.model_error import DEFAULT_RELATIVE_NOISE
from reconstruction.chromophores.pixel_checks import (
    broadcast_to_pixels,
    check_mask,
    is_usable_color,
)
from reconstruction.chromophores.posterior import (
    MIN_RELATIVE_NOISE,
    ChromophorePosterior,
    errors_within_face,
)
from reconstruction.chromophores.shading_prior import ShadingPrior
from reconstruction.chromophores.start import MIN_AXIS_FRACTION
from reconstruction.facial_color import light_change
from reconstruction.facial_color import shared_melanin_kernels as kernels

STATE_VARIANCE_FRACTION = 0.01
"""Fraction of the model error's variance that is independent between states: 0.0001 to 0.007 in
simulated images of the same unmoved face in neutral, smile, fear and exercise, seeds 0 to 3."""
SHADING_WINDOW_PX = 3.0
"""Window for changes of light on moving faces: wider ones blur the shadows that move with the face,
narrower ones average less."""
MISFIT_SIGMAS = 4.0
"""Standard errors above which a state's color does not belong to the pixel's melanin."""
_TASK_PIXELS = 2048


@dataclass(frozen=True, slots=True, eq=False)
class SharedMelanin:
    """One melanin and S blood fractions; maps have the pixels' shape (...), of states (S, ...)."""

    melanin: Float32Array
    """Volume fraction of melanin in the epidermis; NaN where no state is usable."""
    stderr_melanin: Float32Array
    """Its 68 % credible half-width, with noise, model error, second solutions and optics."""
    optics_stderr_melanin: Float32Array
    """Part by optics that are unknown but common to all pixels."""
    noise_stderr_melanin: Float32Array
    """Part by noise alone: the difference to be expected in another set of images."""
    hemoglobin: Float32Array
    """(S, ...): volume fraction of blood in the dermis; NaN where the state is not usable."""
    stderr_hemoglobin: Float32Array
    """(S, ...): its standard error."""
    optics_stderr_hemoglobin: Float32Array
    """(S, ...): part of it by unknown optics, a factor common to all pixels and states."""
    noise_stderr_hemoglobin: Float32Array
    """(S, ...): part by noise alone."""
    change: Float32Array
    """(S, ...): blood minus that of the reference state."""
    stderr_change: Float32Array
    """(S, ...): its standard error, without errors common to both states."""
    shading: Float32Array
    """(S, ...): light on the pixel over that on a white reference."""
    residual: Float32Array
    """(S, ...): root of the weighted square sum of the color's residuals, in standard errors of the
    state's own noise: one degree of freedom with free light, two with smoothly changing light."""
    valid: BoolArray
    """At least one state is usable, and the mean color belongs to the table."""
    valid_states: BoolArray
    """(S, ...): usable, and `valid`."""
    reference: int
    """State that changes refer to."""

    @property
    def is_misfit(self) -> BoolArray:
        """(S, ...): the color is outside the pixel's melanin line: misregistered, or specular."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.valid_states & (self.residual > MISFIT_SIGMAS))


def estimate_shared_melanin(
    rgb: ArrayLike,
    table: ColorTable,
    *,
    prior: ShadingPrior,
    variance: ArrayLike | None = None,
    model_error: ArrayLike | None = None,
    valid: ArrayLike | None = None,
    reference: int = 0,
    shading_window_px: float | None = None,
    state_variance_fraction: float = STATE_VARIANCE_FRACTION,
    state_covariance: ArrayLike | None = None,
    one_face: bool = False,
) -> SharedMelanin:
    """Estimate one melanin and the blood of every state, pixel by pixel.

    Parameters
    ----------
    rgb : array_like, shape (S, ..., 3)
        Diffuse light of S states over that of a white reference, linear camera RGB, aligned.
    table : ColorTable
        Color table of the camera and the illumination of the images.
    prior : ShadingPrior
        Distribution of a pixel's mean shading over the states.
    variance : array_like, optional
        Noise variance of `rgb`, broadcast to its shape. None: 1 percent. A misregistered pixel
        differs in brightness more than in color, which the free light absorbs.
    model_error : array_like, optional
        Relative error of the table's colors, see `reconstruction.chromophores.invert`; or a
        covariance for each pixel, shape (..., 3, 3).
    valid : array_like of bool, shape (S, ...), optional
        Where each state is usable; others are omitted.
    reference : int
        State that changes refer to, such as neutral.
    shading_window_px : float, optional
        Correlation length of the light's changes between states, px, best `SHADING_WINDOW_PX`:
        changes are estimated from colors, averaged by a Gaussian; a pixel may deviate by as much as
        its color and its neighbors indicate. Pixels must be (H, W) then. None: the light is free in
        each pixel and state.
    state_variance_fraction : float
        Fraction of the model error's variance that is independent between states, 0...1.
    state_covariance : array_like, shape (S, ..., 3, 3), optional
        Covariance of each state's further relative color errors, such as those by registration
        (`reconstruction.facial_color.registration_error`). None: 0.
    one_face : bool
        Whether the pixels are one person's skin whose light is known from a white reference, except
        for the face's position: the prior of each is then the distribution of melanin and blood
        over all of them (`reconstruction.chromophores.face`).

    Returns
    -------
    SharedMelanin

    Raises
    ------
    reconstruction.chromophores.ChromophoreError
        When shapes do not match.

    Examples
    --------
    >>> from model import color_table
    >>> from reconstruction.chromophores.shading_prior import lognormal_prior
    >>> table = color_table.build("Nikon 5100 (NPL)", "D65", exact_optics=True)
    >>> color = 0.8 * table.lookup([[0.02], [0.02]], [[0.03], [0.05]])
    >>> given = {"prior": lognormal_prior(0.7, 0.6), "variance": (2e-3 * color) ** 2}
    >>> found = estimate_shared_melanin(color, table, **given)
    >>> f"{found.melanin[0]:.3f}", f"{found.change[1, 0]:.3f}"
    ('0.020', '0.020')
    """
    colors = np.asarray(rgb, np.float32)
    check = Checks(ChromophoreError)
    good = colors.ndim >= 2 and colors.shape[-1] == 3 and colors.shape[0]
    check.require(good, "rgb", f"shape {colors.shape}", "(S, ..., 3)")
    states, shape = colors.shape[0], colors.shape[1:-1]
    check.within("reference", reference, f"[{-states}, {states})")
    if shading_window_px is not None:
        check.within("shading_window_px", shading_window_px, "(0, inf]")
        check.require(len(shape) == 2, "shading_window_px", f"rgb {colors.shape}", "(S, H, W, 3)")
    check.within("state_variance_fraction", state_variance_fraction, "[0, 1]")
    seen = _States.of(colors, variance, valid)
    exact = with_exact_optics(table)
    each_error, usual = _model_errors(model_error, shape, seen.usable)
    common = each_error * (1.0 - state_variance_fraction)
    least = state_variance_fraction * usual + MIN_RELATIVE_NOISE**2
    owns = _state_covariances(state_covariance, least, (states, *shape), seen.usable)
    mean, mean_variance = _mean_color(seen, exact, owns)
    mean_rgb = np.exp(mean)
    error = _mean_color_covariance(owns, seen, common)
    whole = estimate_face(
        mean_rgb.reshape(*shape, 3),
        table,
        prior=prior,
        variance=(mean_variance * mean_rgb**2).reshape(*shape, 3),
        model_error=error if error.ndim == 2 else error.reshape(*shape, 3, 3),
        has_white=one_face,
    )
    found, usable = whole.found, seen.usable[..., None]
    plain = replace(seen, log_rgb=np.where(usable, seen.log_rgb - whole.log_color, 0.0))
    mean -= whole.log_color

    fit = _BloodFit(plain, mean, _within_face(found), exact, (common, owns), reference % states)
    free = np.zeros(seen.usable.shape, np.float32)
    of_pixels, of_states = fit(free, free)
    if shading_window_px is not None and states > 1:
        good = fit.good & (of_states["residual"] < MISFIT_SIGMAS)
        light = of_states["log_shading"], of_states["log_shading_variance"]
        log_change, stiffness = light_change.smooth_light_changes(
            *light, good, shape, shading_window_px
        )
        stiffness = np.where(fit.good, stiffness, 0.0).astype(np.float32)
        of_pixels, of_states = fit(log_change, stiffness)
    named = {name: values.reshape(states, *shape) for name, values in of_states.items()}
    shading = np.exp(named.pop("log_shading"))
    del named["log_shading_variance"]
    factor = found.optics_stderr_hemoglobin / found.hemoglobin
    by_optics = factor * named["hemoglobin"]
    named["stderr_hemoglobin"] = np.hypot(named["stderr_hemoglobin"], by_optics)
    named["stderr_change"] = np.hypot(named["stderr_change"], factor * np.abs(named["change"]))
    return SharedMelanin(
        melanin=found.melanin,
        stderr_melanin=found.stderr_melanin,
        optics_stderr_melanin=found.optics_stderr_melanin,
        optics_stderr_hemoglobin=by_optics,
        noise_stderr_melanin=of_pixels[0].reshape(shape),
        **named,
        shading=shading,
        valid=found.valid,
        valid_states=seen.usable.reshape(states, *shape) & found.valid,
        reference=reference % states,
    )


def _within_face(found: ChromophorePosterior) -> ChromophorePosterior:
    """Return an estimate with the error of melanin without that of common optics."""
    within = errors_within_face(found.stderr_melanin, found.optics_stderr_melanin)
    return replace(found, stderr_melanin=within)


@dataclass(frozen=True, slots=True, eq=False)
class _States:
    """Log colors of S states of n pixels."""

    log_rgb: Float32Array
    """(S, n, 3): 0 where not usable."""
    relative: Float32Array
    """(S, n, 3): relative variance by noise; 1 where not usable."""
    usable: BoolArray
    """(S, n)"""

    @staticmethod
    def of(colors: Float32Array, variance: ArrayLike | None, valid: ArrayLike | None) -> _States:
        usable = is_usable_color(colors)
        if valid is not None:
            usable &= check_mask(valid, usable.shape)
        relative: FloatArray = np.full(colors.shape, DEFAULT_RELATIVE_NOISE**2, np.float32)
        if variance is not None:
            values = broadcast_to_pixels("variance", np.asarray(variance, np.float32), colors.shape)
            negative = np.nan_to_num(values[usable]).min(initial=0.0) < 0.0
            Checks(ChromophoreError).require(not negative, "variance", "a negative one", ">= 0")
            relative = values / np.square(np.where(usable[..., None], colors, 1.0))
        usable &= np.isfinite(relative).all(axis=-1)
        keep = usable[..., None]
        log_rgb = np.log(np.where(keep, colors, 1.0), dtype=np.float32)
        relative = np.where(keep, relative, 1.0).astype(np.float32)
        n = len(colors)
        return _States(log_rgb.reshape(n, -1, 3), relative.reshape(n, -1, 3), usable.reshape(n, -1))


class _BloodFit:
    """Fits the blood of every state under the melanin of the mean colors."""

    def __init__(
        self,
        seen: _States,
        mean: Float32Array,
        found: ChromophorePosterior,
        table: ColorTable,
        errors: tuple[Float64Array, Float64Array],
        reference: int,
    ) -> None:
        melanin, stderr = found.melanin.reshape(-1), found.stderr_melanin.reshape(-1)
        self._seen, self._mean, self._reference = seen, mean, reference
        self.good: BoolArray = np.asarray(seen.usable & np.isfinite(melanin))
        ends = np.array([table.c_m_max, table.c_hd_max])
        begin = _fractions(np.stack([melanin, found.hemoglobin.reshape(-1)], axis=-1), ends)
        # m = end a^3, hence dm = 3 end a^2 da
        stderr = stderr / (3.0 * ends[0] * np.maximum(begin[:, 0], MIN_AXIS_FRACTION) ** 2)
        self._fixed = (
            np.ascontiguousarray(begin, np.float32),
            np.where(np.isfinite(stderr), stderr, 0.0).astype(np.float32),
            np.ascontiguousarray(add_brightness_variance(errors[0])),
            errors[1],
            np.ascontiguousarray(table.cells, np.float64),
            *ends.tolist(),
        )

    def __call__(
        self, log_change: Float32Array, stiffness: Float32Array
    ) -> tuple[Float32Array, dict[str, Float32Array]]:
        """Return maps of pixels (1, n), and those of states (S, n) by name.

        Parameters
        ----------
        log_change, stiffness
            (S, n): log light of each state, up to a factor, and one over its variance; 0: free.
        """
        states, pixels = self.good.shape
        of_pixels = np.empty((len(kernels.PIXEL_MAPS), pixels), np.float32)
        of_states = np.empty((len(kernels.STATE_MAPS), states, pixels), np.float32)
        seen = self._seen.log_rgb, self._seen.relative, self.good, self._mean
        run_in_blocks(
            kernels.fit_state_blood,
            pixels,
            _TASK_PIXELS,
            *(*seen, log_change, stiffness, *self._fixed, self._reference, of_pixels, of_states),
        )
        return of_pixels, dict(zip(kernels.STATE_MAPS, of_states, strict=True))


def _model_errors(
    model_error: ArrayLike | None, shape: tuple[int, ...], usable: BoolArray
) -> tuple[Float64Array, Float64Array]:
    """Return covariances of the pixels (n or 1, 3, 3), and the usual variances of channels (3,).

    The usual variance is the median: detail below the pixel size makes errors many times as large.
    """
    given = np.asarray(0.0 if model_error is None else model_error, np.float64)
    if given.ndim < 3:
        one = model_covariance(model_error, default_noise=False)
        return one[None], np.diag(one)
    Checks(ChromophoreError).shape("model_error", given, (*shape, 3, 3))
    flat = given.reshape(-1, 3, 3)
    seen = flat[usable.any(axis=0)]
    usual = np.median(np.einsum("nii->ni", seen), axis=0) if len(seen) else np.zeros(3)
    return flat, usual


_UPPER_TRIANGLE = np.triu_indices(3)


def _state_covariances(
    state_covariance: ArrayLike | None,
    min_variance: Float64Array,
    shape: tuple[int, ...],
    usable: BoolArray,
) -> Float64Array:
    """Return upper triangles of the states' own covariances, (S, n or 1, 6)."""
    diagonal = np.diag(min_variance)[_UPPER_TRIANGLE]
    if state_covariance is None:
        return np.ascontiguousarray(np.broadcast_to(diagonal, (shape[0], 1, 6)))
    given = np.asarray(state_covariance, np.float64)
    Checks(ChromophoreError).shape("state_covariance", given, (*shape, 3, 3))
    flat = given.reshape(shape[0], -1, 3, 3)[..., _UPPER_TRIANGLE[0], _UPPER_TRIANGLE[1]]
    Checks(ChromophoreError).within("state_covariance", flat[usable])
    Checks(ChromophoreError).within(
        "variances of own_error", flat[usable][:, [0, 3, 5]], "[0, inf)"
    )
    return np.ascontiguousarray(np.where(usable[..., None], flat, 0.0) + diagonal)


def _mean_color_covariance(owns: Float64Array, seen: _States, common: Float64Array) -> Float64Array:
    """Return the error covariance of the states' mean color without noise, (3, 3) or (n, 3, 3)."""
    if owns.shape[1] == 1:
        own = np.zeros((3, 3))
        own[_UPPER_TRIANGLE] = owns[0, 0]
        most = max(int(seen.usable.sum(axis=0).max(initial=0)), 1)
        return np.asarray((common if len(common) > 1 else common[0]) + own / most)
    # weight of each state in the mean, as in `shared_melanin_kernels.average_state_colors`
    share = seen.usable / (seen.relative.sum(axis=-1) + owns[..., [0, 3, 5]].sum(axis=-1))
    share /= np.maximum(share.sum(axis=0), 1e-300)
    mean = (np.square(share)[..., None] * owns).sum(axis=0)
    whole = np.empty((len(mean), 3, 3))
    whole[(slice(None), *_UPPER_TRIANGLE)] = mean
    whole[(slice(None), *_UPPER_TRIANGLE[::-1])] = mean
    return np.asarray(whole + common)


def _mean_color(
    seen: _States, table: ColorTable, owns: Float64Array
) -> tuple[Float32Array, Float32Array]:
    """Return the states' mean log color, transformed to their mean blood, and its variance."""
    count = np.maximum(seen.usable.sum(axis=0), 1)[:, None]
    keep = seen.usable[..., None]
    plain = np.where(keep, seen.log_rgb, 0.0).sum(axis=0) / count
    noise = np.where(keep, seen.relative, 0.0).sum(axis=0) / count**2
    known = np.asarray(seen.usable.any(axis=0))[:, None]
    rgb = np.where(known, np.exp(plain), np.nan).astype(np.float32)
    first = invert(rgb, table, variance=noise * rgb**2)
    ends = np.array([table.c_m_max, table.c_hd_max])
    begin = _fractions(np.stack([first.melanin, first.hemoglobin], axis=-1), ends)
    mean, variance = np.empty((2, *plain.shape), np.float32)
    given = seen.log_rgb, seen.relative, seen.usable, begin.astype(np.float32), owns
    cells = np.ascontiguousarray(table.cells, np.float64)
    written = mean, variance
    run_in_blocks(kernels.average_state_colors, len(mean), _TASK_PIXELS, *given, cells, *written)
    return mean, variance


def _fractions(values: Float32Array, ends: Float64Array) -> Float64Array:
    """Return volume fractions as fractions of the table's axes; NaN as a tenth of the ends."""
    known = np.where(np.isfinite(values), values, 0.001 * ends)
    return np.asarray(np.clip(np.cbrt(known / ends), MIN_AXIS_FRACTION, 1.0), np.float64)
