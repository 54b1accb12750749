"""Estimate the distribution of one person's melanin and blood from the colors of the face.

`reconstruction.chromophores.face_distribution` defines and fits the distribution.
`reconstruction.chromophores.posterior` uses it as the prior of each pixel;
`reconstruction.chromophores.dark_spots` finds the pixels that may be a mole, shade, lip or eyelid.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from model.checks import Checks
from model.color_table import ColorTable, with_exact_optics
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from reconstruction.chromophores import dark_spots, shading_prior
from reconstruction.chromophores import face_kernels as kernels
from reconstruction.chromophores import model_error as color_errors
from reconstruction.chromophores import posterior as chromophore_posterior
from reconstruction.chromophores.common_optics import CommonOptics, estimate_common_optics
from reconstruction.chromophores.face_distribution import (
    FaceDistribution,
    add_systematic_errors,
    fit_distribution,
)
from reconstruction.chromophores.pixel_checks import (
    ChromophoreError,
    broadcast_to_pixels,
    check_colors,
    is_usable_color,
)
from reconstruction.chromophores.posterior import ChromophorePosterior, add_optics_errors
from reconstruction.chromophores.shading_prior import ShadingPrior
from reconstruction.chromophores.start import MIN_AXIS_FRACTION, evaluate_table

N_SAMPLE_PIXELS: Final = 1500
"""Sampled evenly over the face. They determine the mean to a thirtieth of the standard deviation,
less than the errors common to all pixels."""
MIN_FACE_PIXELS: Final = 200
"""With fewer pixels, each is estimated alone."""
LOG_MELANIN_STEP: Final = 0.02
"""Grid step in log melanin."""
N_BLOOD_NODES: Final = 96
_N_BLOOD_NODES_SUMMED: Final = 3
MIN_COLOR_ERROR: Final = 0.003
"""Relative color error below which the grid is too coarse; smaller errors are raised to it. In
light skin it corresponds to 3 % of melanin, where a face scatters by 10 to 20 %."""
LOG_MELANIN_MARGIN: Final = 0.7
"""Margin in log melanin beyond the central 98 % of the single-pixel estimates."""


def fit_face_distribution(
    rgb: ArrayLike,
    table: ColorTable,
    *,
    prior: ShadingPrior,
    common_light: float,
    common_color: ArrayLike | None = None,
    variance: ArrayLike | None = None,
    model_error: ArrayLike | None = None,
    valid: ArrayLike | None = None,
) -> FaceDistribution | None:
    """Fit the distribution of melanin and blood over a face; None with fewer than 200 pixels.

    Parameters
    ----------
    rgb
        Shape (..., 3): light of the pixels over that of a white reference, linear camera RGB; all
        skin of one person in one image. Not modified.
    table
        Color table of the camera and the illumination of the image. Its optics count as exact: see
        `reconstruction.chromophores.common_optics` for those of a face.
    prior
        Distribution of the pixels' shading, without the error common to all pixels.
    common_light
        Standard error of log light common to all pixels, above 0: from the face's distance to the
        white reference's position, or from the uncertainty of the exposure.
    common_color
        (3, 3): covariance of relative color errors common to all pixels. None: 0.
    variance
        Noise variance of `rgb`, broadcast to its shape. None: 1 percent of each channel.
    model_error
        Covariance of the pixels' relative errors without noise, shape (3, 3) or (..., 3, 3).
        None: 0.
    valid
        Shape (...): False where a pixel is masked. None: all may be used.

    Raises
    ------
    reconstruction.chromophores.ChromophoreError
        When shapes or numbers do not fit.

    Examples
    --------
    >>> from model import color_table
    >>> from reconstruction.chromophores.shading_prior import lognormal_prior
    >>> rng = np.random.default_rng(0)
    >>> table = color_table.build("Nikon 5100 (NPL)", "D65")
    >>> melanin = 0.05 * np.exp(0.15 * rng.standard_normal(1000))
    >>> light = 0.7 * np.exp(0.3 * rng.standard_normal((1000, 1)))
    >>> seen = light * table.lookup(melanin, 0.02) * (1 + 3e-3 * rng.standard_normal((1000, 3)))
    >>> prior = lognormal_prior(0.7, 0.3)
    >>> found = fit_face_distribution(seen, table, prior=prior, common_light=0.1,
    ...                   variance=(3e-3 * seen) ** 2).melanin
    >>> bool(abs(np.exp(found.mean) - 0.05) < 0.003), bool(0.1 < found.sd < 0.2)
    (True, True)
    """
    Checks(ChromophoreError).within("common_light", common_light, "(0, inf)")
    colors, noise, errors = _sampled(rgb, variance, model_error, valid)
    if len(colors) < MIN_FACE_PIXELS:
        return None
    table = with_exact_optics(table)
    alone = chromophore_posterior.estimate(
        colors, table, prior=prior, variance=noise, model_error=errors
    )
    colors, noise = colors[alone.valid].astype(np.float64), noise[alone.valid]
    errors = errors if errors.ndim == 2 else errors[alone.valid]
    if len(colors) < MIN_FACE_PIXELS:
        return None
    weights, mean = _weights(noise / np.square(colors), errors)
    melanin_ends = math.log(table.c_m_max * MIN_AXIS_FRACTION**3), math.log(table.c_m_max)
    low, high = np.quantile(np.log(alone.melanin[alone.valid]), [0.01, 0.99])
    low = max(low - LOG_MELANIN_MARGIN, melanin_ends[0])
    high = min(high + LOG_MELANIN_MARGIN, melanin_ends[1])
    rows = max(math.ceil((high - low) / LOG_MELANIN_STEP), 2)
    log_melanin = low + (np.arange(rows) + 0.5) * (high - low) / rows
    blood = (np.arange(N_BLOOD_NODES) + 0.5) * (1.0 - MIN_AXIS_FRACTION) / N_BLOOD_NODES
    blood += MIN_AXIS_FRACTION
    axis = np.cbrt(np.exp(log_melanin) / table.c_m_max)
    plane = np.log(evaluate_table(table, *np.meshgrid(axis, blood, indexing="ij"))[0])

    places = log_melanin, blood.reshape(-1, _N_BLOOD_NODES_SUMMED).mean(axis=1)
    ends = melanin_ends, (MIN_AXIS_FRACTION, 1.0)
    cost = -2.0 * np.log(prior.density)

    def fitted(
        light: float, color: Float64Array, begin: FaceDistribution | None = None
    ) -> FaceDistribution:
        probability = np.zeros((len(colors), rows, places[1].size), dtype=np.float32)
        seen = np.log(colors) + color, weights, mean, plane
        by_light = cost, prior.low + light, prior.step
        kernels.plane_probability(*seen, *by_light, _N_BLOOD_NODES_SUMMED, probability)
        return fit_distribution(probability, places, ends, initial=begin)

    still = np.zeros(3)
    usual = fitted(0.0, still)
    moved = [(fitted(-common_light, still, usual), fitted(common_light, still, usual))]
    for color in _covariance_factors(common_color):
        moved.append((fitted(0.0, -color, usual), fitted(0.0, color, usual)))
    return add_systematic_errors(usual, moved)


def fit_with_white_reference(
    rgb: ArrayLike, table: ColorTable, *, variance: ArrayLike, model_error: ArrayLike
) -> FaceDistribution | None:
    """Fit the distribution over a face before the flash rig, with a captured white reference.

    Parameters
    ----------
    rgb, table, variance, model_error
        See `fit_face_distribution`.

    Returns
    -------
    FaceDistribution or None
        Includes errors of the face's position and of the layered model common to all pixels.
    """
    return fit_face_distribution(
        rgb,
        table,
        prior=shading_prior.face_prior(softness=shading_prior.MIN_SOFTNESS),
        common_light=shading_prior.LOG_SHADING_SOFTNESS,
        common_color=color_errors.load_error_terms().transport,
        variance=variance,
        model_error=model_error,
    )


@dataclass(frozen=True, slots=True, eq=False)
class FaceEstimate:
    """Estimates of the pixels, with and without the face distribution."""

    found: ChromophorePosterior
    """Final estimate; an average of hypotheses in `spots`. Standard errors include optics."""
    by_face: ChromophorePosterior
    """Estimate with the face prior everywhere, for errors within the face: by exact optics."""
    face: FaceDistribution | None
    """None where it was not fitted."""
    spots: BoolArray
    """Of the pixels' shape: pixels that may not be usual skin."""
    common: CommonOptics | None
    """Common error of the face's colors, which the estimates are without; None: exact optics."""
    alone_shading: Float32Array
    """Shading where each pixel is estimated alone."""

    @property
    def log_color(self) -> Float32Array:
        """Common error of log color, (3,)."""
        found = np.zeros(3) if self.common is None else self.common.log_color
        return found.astype(np.float32)


def estimate_face_optics(
    rgb: FloatArray, table: ColorTable, *, prior: ShadingPrior, has_white: bool
) -> CommonOptics | None:
    """Estimate the common error of the colors of a face before the flash rig.

    Parameters
    ----------
    rgb, table, prior, has_white
        See `estimate_face`.

    Returns
    -------
    CommonOptics or None
        See `reconstruction.chromophores.common_optics.estimate_common_optics`.
    """
    # the median light is known for a whole face, not for a part of it
    known = has_white and np.count_nonzero(is_usable_color(rgb)) >= MIN_FACE_PIXELS
    usual = shading_prior.face_prior(softness=shading_prior.MIN_SOFTNESS) if known else prior
    return estimate_common_optics(
        rgb,
        table,
        prior=usual,
        common_light=shading_prior.LOG_SHADING_SOFTNESS if known else prior.sd,
        common_color=color_errors.load_error_terms().transport,
    )


def estimate_face(
    rgb: FloatArray,
    table: ColorTable,
    *,
    prior: ShadingPrior,
    variance: FloatArray,
    model_error: FloatArray,
    has_white: bool,
    compute_part: Callable[[str, Callable[[], Any]], Any] = lambda _, compute: compute(),
) -> FaceEstimate:
    """Estimate melanin and hemoglobin of every pixel of one face.

    Parameters
    ----------
    rgb, table, prior, variance, model_error
        See `reconstruction.chromophores.posterior.estimate`.
    has_white
        Whether a white reference at the face's position fixes the exposure. Without it the face
        distribution adds no information.
    compute_part
        Called with the name of each long part and a function that returns its result; returns that
        result, which may have been kept from an earlier call.
    """
    optics = partial(estimate_face_optics, rgb, table, prior=prior, has_white=has_white)
    common = compute_part("common optics", optics)
    log_color = np.zeros(3) if common is None else common.log_color
    factor = np.exp(-log_color).astype(np.float32)
    errors: dict[str, Any] = {"variance": variance * factor**2, "model_error": model_error}
    exact, plain = with_exact_optics(table), rgb * factor
    known = partial(chromophore_posterior.estimate, plain, exact, prior=prior, **errors)
    fit = partial(fit_with_white_reference, plain, exact, **errors)
    face = compute_part("face distribution", fit) if has_white else None
    found = by_face = alone = compute_part("face", lambda: known(face=face))
    spots = np.zeros(rgb.shape[:-1], bool)
    if face is not None:
        alone = compute_part("single pixels", known)
        spots = dark_spots.is_lighter_than_face_prior(by_face, alone)
        if rgb.ndim == 3:
            spots |= dark_spots.is_locally_dark(plain, variance=errors["variance"])
        found = dark_spots.average_hypotheses(by_face, alone, spots)
    if common is not None:
        found = compute_part(
            "errors by optics",
            partial(
                add_optics_errors,
                *(found, rgb, table, common),
                variance=variance,
                model_error=model_error,
            ),
        )
    return FaceEstimate(found, by_face, face, spots, common, alone.shading)


def _sampled(
    rgb: ArrayLike,
    variance: ArrayLike | None,
    model_error: ArrayLike | None,
    valid: ArrayLike | None,
) -> tuple[Float32Array, Float64Array, Float64Array]:
    """Sample pixels: colors (n, 3), noise (n, 3) and model errors (n, 3, 3) or (3, 3)."""
    colors = check_colors(rgb)
    good = is_usable_color(colors)
    if valid is not None:
        good &= np.asarray(valid, dtype=np.bool_)
    places = np.flatnonzero(good)
    count = min(N_SAMPLE_PIXELS, places.size)
    places = places[np.linspace(0, places.size, count, False).astype(np.intp)]
    chosen = colors.reshape(-1, 3)[places]
    noise = np.square(0.01 * chosen.astype(np.float64))
    if variance is not None:
        whole = broadcast_to_pixels("variance", variance, colors.shape)
        noise = whole.reshape(-1, 3)[places].astype(np.float64)
    errors = np.zeros((3, 3)) if model_error is None else np.asarray(model_error, np.float64)
    Checks(ChromophoreError).shape("model_error", errors, (3, 3), (*colors.shape, 3))
    return chosen, noise, errors if errors.ndim == 2 else errors.reshape(-1, 3, 3)[places]


def _weights(relative: Float64Array, errors: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return weights of color without brightness, and weights of the mean that gives brightness."""
    # With V = W^-1 and an unknown common log factor t, minimizing (e - t 1)' W (e - t 1) over t
    # gives t = s' e with s = W 1 / (1' W 1), and leaves the weights W - W 1 1' W / (1' W 1).
    total = (relative + MIN_COLOR_ERROR**2)[:, :, None] * np.eye(3) + errors
    weights = np.linalg.inv(color_errors.add_brightness_variance(total))
    row = weights.sum(axis=-1)
    whole = row.sum(axis=-1)
    weights -= row[:, :, None] * row[:, None, :] / whole[:, None, None]
    return np.ascontiguousarray(weights), np.ascontiguousarray(row / whole[:, None])


def _covariance_factors(covariance: ArrayLike | None) -> list[Float64Array]:
    """Return vectors whose outer products sum to a covariance."""
    if covariance is None:
        return []
    given = Checks(ChromophoreError).numbers("common_color", covariance, (3, 3))
    variances, axes = np.linalg.eigh(given)
    known = np.flatnonzero(variances > 1e-3 * max(float(variances[-1]), 0.0))
    return [np.asarray(math.sqrt(variances[k]) * axes[:, k]) for k in known]
