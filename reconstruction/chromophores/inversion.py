"""Invert linear camera RGB to melanin, hemoglobin and shading, with standard errors.

Each pixel is fitted with the color table of the two-layer skin model (Jimenez et al. 2010,
doi:10.1145/1866158.1866167, eq. 7), in the cube roots of both volume fractions. Thickness,
oxygenation and scattering are nuisance parameters: their effect is part of each color's covariance
(`model.tissue_optics.uncertainty`). A color determines the product of melanin's volume fraction and
the thickness of the epidermis, the melanin optical depth.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from model.checks import Checks
from model.color_table import ColorTable
from reconstruction.arrays import BoolArray, Float32Array, Float64Array
from reconstruction.chromophores.model_error import add_brightness_variance, model_covariance
from reconstruction.chromophores.pixel_checks import (
    ChromophoreError,
    broadcast_to_pixels,
    check_colors,
    check_mask,
)
from reconstruction.chromophores.start import (
    MIN_AXIS_FRACTION,
    InverseColorTable,
    evaluate_table,
    inverse_table_for,
)
from reconstruction.chromophores.table_fit import kernels
from reconstruction.chromophores.table_fit.fitting import MAX_IDENTIFIABLE_STDERR, fit_colors

Shading = Literal["known"] | ArrayLike | None


@dataclass(frozen=True, slots=True)
class ChromophoreMaps:
    """Result of the chromophore fit; every map has the pixels' shape."""

    melanin: Float32Array
    """Volume fraction of melanin in an epidermis of the table's thickness, 3e-5 to 0.5; NaN where
    the input is unusable. See `melanin_optical_depth`."""
    hemoglobin: Float32Array
    """Volume fraction of blood in the dermis, 2e-5 to 0.32; NaN where the input is unusable."""
    shading: Float32Array
    """Factor between the table's color and the pixel: fitted when free, else as given, times the
    most probable factor where the model error has a part common to the channels."""
    stderr_melanin: Float32Array
    """Standard error of `melanin`: Fisher information of noise, model error and unknown optics.
    With known shading it has a factor, see `chromophores.table_fit.interval_factors`."""
    stderr_hemoglobin: Float32Array
    """Standard error of `hemoglobin`."""
    residual: Float32Array
    """Root of the weighted square sum of the fit's residuals, in standard errors. A free shading
    makes three unknowns for three channels: it is 0 unless the color is outside the table."""
    valid: BoolArray
    """Usable input, converged, and not `outside`."""
    gamut_distance: Float32Array
    """Distance to the table's nearest color: root mean square relative difference."""
    outside: BoolArray
    """The color does not belong to the table: more than 4 standard errors and 2 percent away."""
    melanin_identifiable: BoolArray
    """The standard error is within the limit and no second solution exists."""
    hemoglobin_identifiable: BoolArray
    """The same for hemoglobin."""
    ambiguous: BoolArray
    """Darker skin under more light has the same color, with the shading free."""
    depth_factor: float
    """Melanin optical depth over `melanin`: thickness times melanin's absorption at 550 nm."""

    @property
    def melanin_optical_depth(self) -> Float32Array:
        """Optical depth of melanin at 550 nm, which a color determines whatever the thickness."""
        return np.asarray(np.float32(self.depth_factor) * self.melanin)

    @property
    def stderr_melanin_optical_depth(self) -> Float32Array:
        """Standard error of `melanin_optical_depth`."""
        return np.asarray(np.float32(self.depth_factor) * self.stderr_melanin)

    def interval(
        self, name: Literal["melanin", "hemoglobin"], probability: float
    ) -> tuple[Float64Array, Float64Array]:
        """Return the ends of an interval, symmetric in the cube root, in which errors are even.

        Parameters
        ----------
        name
            Chromophore.
        probability
            Nominal coverage, above 0 and below 1.
        """
        Checks(ChromophoreError).choice("name", name, ("melanin", "hemoglobin"))
        Checks(ChromophoreError).within("probability", probability, "(0, 1)")
        value = np.asarray(getattr(self, name), dtype=np.float64)
        root = np.cbrt(value)
        sigmas = float(special.ndtri(0.5 + 0.5 * probability))
        half = sigmas * getattr(self, f"stderr_{name}") / (3.0 * np.square(root))
        return np.maximum(root - half, 0.0) ** 3, (root + half) ** 3

    @property
    def identifiable(self) -> BoolArray:
        """Pixels where both chromophores are identifiable."""
        return np.asarray(self.melanin_identifiable & self.hemoglobin_identifiable)


def invert(
    rgb: ArrayLike,
    table: ColorTable,
    *,
    shading: Shading = None,
    variance: ArrayLike | None = None,
    model_error: ArrayLike | None = None,
    valid: ArrayLike | None = None,
    shading_max: float | None = None,
    limit: float = MAX_IDENTIFIABLE_STDERR,
) -> ChromophoreMaps:
    """Estimate melanin and hemoglobin of every pixel.

    Parameters
    ----------
    rgb
        Shape (..., 3): diffuse reflectance as white-balanced linear camera RGB (radiance times pi
        over irradiance, a perfect white is 1). With the shading free any positive factor per
        pixel may be left in. Fitted in float32, whatever its type. Not modified.
    table
        Color table of the camera and the illumination of the image. Its `optics_covariance`, by
        unknown optics at the color's first estimate, is added to the noise.
    shading
        None: a free factor per pixel. "known": the factor is 1. Array of shape (...) or number:
        the known factor.
    variance
        Noise variance of `rgb`, broadcast to its shape. None: 1 percent of each channel.
    model_error
        Further relative error, such as a rig's, added to the noise: a standard error, one per
        channel, or a (3, 3) covariance. A covariance with s^2 in all its cells limits the knowledge
        of the shading to the relative standard error s; where s is above some 10 percent, skin has
        two solutions, which `reconstruction.chromophores.posterior` weights. None: 0.
    valid
        Shape (...): False where a pixel is saturated or masked otherwise. None: all may be used.
    shading_max
        Largest possible shading, if known; it rules out second solutions. None: any.
    limit
        Relative standard error up to which a chromophore counts as identifiable.

    Returns
    -------
    ChromophoreMaps
        Estimates and standard errors, float32, and masks, of the pixels' shape.

    Raises
    ------
    ChromophoreError
        When shapes do not match, or the model error is not a covariance.

    Notes
    -----
    NaN, infinite, zero and negative colors are masked. Colors outside the table end at its edge or,
    with the shading known, at the nearest color; `gamut_distance` gives the distance. With the
    shading free, skin of more than a few percent melanin has the colors of lighter skin:
    `ambiguous` marks both, and the estimate is the lighter one. Errors are those of the linearized
    fit; at a relative error of half and above they are rough.

    With unknown optics and known shading, priors of both cube roots over people are added, see
    `chromophores.table_fit.fitting.POPULATION_LOG_SD`. They move what a color leaves open toward
    the population: a color of the table at C_m 0.03, C_hd 0.02 comes out 1 and 7 percent off, one
    of very pale or blood-rich skin (0.01, 0.1) by 33 and 43 percent, up to 1.6 standard errors.
    Colors of the table come back
    exactly with a table built with ``exact_optics=True``.

    Maps are float32 for float64 input too: rounding changes them by less than 1e-4 of a standard
    error, with the shading known and with it free, where noise is 1 percent.

    Examples
    --------
    >>> from model import color_table
    >>> table = color_table.build("Nikon 5100 (NPL)", "D65", exact_optics=True)
    >>> maps = invert(0.8 * table.lookup([[0.02, 0.03]], [[0.05, 0.02]]), table)
    >>> [f"{value:.4f}" for value in maps.melanin[0]]
    ['0.0200', '0.0300']
    >>> [f"{value:.4f}" for value in maps.hemoglobin[0]]
    ['0.0500', '0.0200']
    >>> [f"{value:.3f}" for value in maps.shading[0]]
    ['0.800', '0.800']
    """
    colors = check_colors(rgb)
    shape = colors.shape[:-1]
    free, known = _shading(shading, shape)
    covariance = model_covariance(model_error, variance is None)
    covariance = add_brightness_variance(covariance) if free else covariance
    brightest = np.inf if shading_max is None else shading_max
    Checks(ChromophoreError).within("shading_max", brightest, "(0, inf]")
    maps, masks = fit_colors(
        np.ascontiguousarray(colors).reshape(-1, 3),
        _variance(variance, shape),
        (free, known, _usable(valid, shape)),
        covariance,
        table,
        (np.float32(np.log(brightest)), np.float32(limit)),
    )
    named = dict(zip(kernels.INVERSION_MAPS, maps.reshape(len(maps), *shape), strict=True))
    flags = dict(zip(kernels.INVERSION_MASKS, masks.reshape(len(masks), *shape), strict=True))
    return ChromophoreMaps(**named, **flags, depth_factor=table.constants.melanin_depth_factor)


@dataclass(frozen=True, slots=True)
class Identifiability:
    """Cramer-Rao bounds of melanin and hemoglobin over the table, for a camera and a light."""

    c_m: Float64Array
    """Volume fractions of melanin, shape (n,)."""
    c_hd: Float64Array
    """Volume fractions of dermal blood, shape (n,)."""
    stderr_melanin: Float64Array
    """Smallest possible relative standard error of melanin, shape (n, n): [c_m, c_hd]."""
    stderr_hemoglobin: Float64Array
    """The same for hemoglobin."""
    ambiguous: BoolArray
    """Another pair of chromophores has the same color (with the shading free)."""

    @property
    def melanin_identifiable(self) -> BoolArray:
        """Where the relative standard error of melanin is up to `MAX_IDENTIFIABLE_STDERR`."""
        return np.asarray((self.stderr_melanin <= MAX_IDENTIFIABLE_STDERR) & ~self.ambiguous)

    @property
    def hemoglobin_identifiable(self) -> BoolArray:
        """Where the relative standard error of hemoglobin is up to `MAX_IDENTIFIABLE_STDERR`."""
        return np.asarray((self.stderr_hemoglobin <= MAX_IDENTIFIABLE_STDERR) & ~self.ambiguous)


def compute_identifiability(
    table: ColorTable,
    *,
    shading: Literal["known"] | float | None = None,
    variance: ArrayLike | Callable[[Float64Array], ArrayLike] | None = None,
    model_error: ArrayLike | None = None,
    size: int = 64,
) -> Identifiability:
    """Return the Cramer-Rao bounds of both chromophores over the table.

    Parameters
    ----------
    table
        Color table of the camera and the light, with its covariance by unknown optics.
    shading
        None: free, around 1. "known": 1. A number: known, the light's level.
    variance
        Noise variance of a pixel's RGB: (3,), or a function from RGB (..., 3) to it. None: 1
        percent of each channel.
    model_error
        As in `invert`.
    size
        Points along each axis, evenly spaced in the cube roots.

    Returns
    -------
    Identifiability
        Minimum relative standard errors of an unbiased estimate, and where estimates are
        ambiguous.

    Examples
    --------
    >>> from model import color_table
    >>> table = color_table.build("Nikon 5100 (NPL)", "D65", exact_optics=True)
    >>> bounds = compute_identifiability(table, shading="known")
    >>> darker = np.searchsorted(bounds.c_m, 0.4), np.searchsorted(bounds.c_hd, 0.002)
    >>> bool(bounds.stderr_melanin[darker] < 0.1), bool(bounds.hemoglobin_identifiable[darker])
    (True, False)
    """
    Checks(ChromophoreError).require(size >= 2, "size", size, "at least 2 points")
    level = shading if isinstance(shading, int | float) else 1.0
    fraction = np.linspace(MIN_AXIS_FRACTION, 1.0, size)
    a, b = np.meshgrid(fraction, fraction, indexing="ij")
    color, by_a, by_b = evaluate_table(table, a, b)
    seen = level * color
    noise = variance(seen) if callable(variance) else variance
    noise = np.zeros(3) if noise is None else np.asarray(noise, dtype=np.float64)
    covariance = model_covariance(model_error, variance is None)
    covariance = add_brightness_variance(covariance) if shading is None else covariance
    fractions = table.c_m_max * a**3, table.c_hd_max * b**3
    weights = _weights(
        np.broadcast_to(noise, seen.shape) / seen**2,
        covariance + table.log_covariance(*fractions),
        free=shading is None,
    )
    gradient = np.stack([by_a / color, by_b / color], axis=-1)
    fisher = np.swapaxes(gradient, -1, -2) @ weights @ gradient
    aa, ab, bb = fisher[..., 0, 0], fisher[..., 0, 1], fisher[..., 1, 1]
    det = np.maximum(aa * bb - ab**2, 1e-12 * aa * bb)
    ambiguous = np.zeros(a.shape, dtype=np.bool_)
    if shading is None:
        ambiguous = _second_solution(inverse_table_for(table, True), color, gradient)
    return Identifiability(
        c_m=table.c_m_max * fraction**3,
        c_hd=table.c_hd_max * fraction**3,
        stderr_melanin=3.0 * np.sqrt(bb / det) / a,
        stderr_hemoglobin=3.0 * np.sqrt(aa / det) / b,
        ambiguous=ambiguous,
    )


def _weights(
    relative_variance: Float64Array, covariance: Float64Array, *, free: bool
) -> Float64Array:
    """Return the inverse covariance of relative errors, with a free shading projected out."""
    # minimizing (e - t 1)' W (e - t 1) over the shading t leaves W - W 1 1' W / (1' W 1)
    total = relative_variance[..., None] * np.eye(3) + covariance
    weights = np.linalg.inv(total)
    if free:
        row = weights.sum(axis=-1)
        common = row[..., :, None] * row[..., None, :] / row.sum(axis=-1)[..., None, None]
        weights = weights - common
    return np.asarray(weights)


def _second_solution(
    start: InverseColorTable, color: Float64Array, gradient: Float64Array
) -> BoolArray:
    """Return where a color at shading 1 also belongs to other chromophores."""
    log_color = np.log(color)
    place = np.rint(log_color @ start.projection[:, :3].T + start.projection[:, 3])
    i, j = np.clip(place, 0, start.twin_log.shape[0] - 1).astype(np.intp).transpose(2, 0, 1)
    darker = np.isfinite(start.twin_log[i, j])
    facing = np.cross(gradient[..., 0], gradient[..., 1]).sum(axis=-1) * start.side
    return np.asarray((facing <= 0.0) | darker)


def _shading(shading: Shading, shape: tuple[int, ...]) -> tuple[bool, Float32Array]:
    if isinstance(shading, str):
        Checks(ChromophoreError).choice("shading", shading, ("known", "None", "an array"))
    if shading is None or isinstance(shading, str):
        return shading is None, np.ones(1, dtype=np.float32)
    known = np.asarray(shading, dtype=np.float32)
    if known.ndim:
        known = broadcast_to_pixels("shading", known, shape)
    return False, np.ascontiguousarray(known).reshape(-1)


def _variance(variance: ArrayLike | None, shape: tuple[int, ...]) -> Float32Array:
    """Return the variance of each pixel (n, 3), or one for all (1, 3)."""
    values = np.zeros(3) if variance is None else np.asarray(variance)
    if values.shape != (3,):
        values = broadcast_to_pixels("variance", values, (*shape, 3))
    return np.ascontiguousarray(values, np.float32).reshape(-1, 3)


def _usable(valid: ArrayLike | None, shape: tuple[int, ...]) -> BoolArray:
    """Return which pixels are usable (n,), or one flag for all (1,)."""
    usable = np.ones(1, np.bool_) if valid is None else check_mask(valid, shape)
    return np.ascontiguousarray(usable).reshape(-1)
