"""Fit a camera matrix to the patches of a chart, with its Delta E."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias, Unpack

import numpy as np
from numpy.typing import ArrayLike

from capture.arrays import Float64Array
from capture.calibration.color.colorimetry import (
    chart_reference,
    delta_e_2000,
    lab_from_xyz,
    lab_jacobian,
    white_point,
    xyz_to_linear_srgb,
)
from capture.calibration.record import (
    Calibration,
    Provenance,
    Quantity,
    make_single_device_calibration,
)

Method: TypeAlias = Literal["linear", "root_polynomial"]

EXPOSURE_NOTE = "exposure_s_iso"
"""Note of a calibration by photographs: exposure time in seconds times ISO speed."""
EXPOSURE_UNKNOWN = "unknown"
NEUTRAL_PATCHES = slice(18, 23)  # white to neutral 3.5; the black patch is too specular


@dataclass(frozen=True, slots=True)
class ColorMatrix:
    """Map from camera RGB to XYZ, fitted to a chart.

    Attributes
    ----------
    matrix : ndarray of float64, shape (3, 3) or (3, 6)
        XYZ (perfect diffuser: Y = 1) per camera RGB; (3, 6) for the root polynomial, whose terms
        are r, g, b, sqrt(rg), sqrt(gb), sqrt(rb).
    delta_e : ndarray of float64, shape (N,)
        CIEDE2000 of every patch when the matrix is fitted to the others (leave one out); NaN for
        unused patches.
    stderr : ndarray of float64, shape of ``matrix``
        Standard errors by the jackknife over patches: they include the misfit of the model, which
        is larger than the noise.
    method : {"linear", "root_polynomial"}
    illuminant : str
        Illuminant of XYZ.
    fitted_delta_e : ndarray of float64, shape (N,)
        CIEDE2000 of the patches in the fit itself; smaller, and not a measure of quality.
    """

    matrix: Float64Array
    delta_e: Float64Array
    stderr: Float64Array
    method: Method
    illuminant: str
    fitted_delta_e: Float64Array

    @property
    def mean_delta_e(self) -> float:
        """Mean CIEDE2000 of held-out patches."""
        return float(np.nanmean(self.delta_e))

    @property
    def max_delta_e(self) -> float:
        """Largest CIEDE2000 of held-out patches."""
        return float(np.nanmax(self.delta_e))

    def apply(self, rgb: ArrayLike) -> Float64Array:
        """Return XYZ (Y of the perfect diffuser = 1) of linear camera RGB, shape (..., 3).

        The root polynomial takes square roots of products; where noise makes a product negative
        its root counts as zero.
        """
        return _terms(np.asarray(rgb, dtype=np.float64), self.method) @ self.matrix.T

    def to_linear_srgb(self, rgb: ArrayLike) -> Float64Array:
        """Return linear sRGB (D65, Bradford adaptation) of linear camera RGB, shape (..., 3)."""
        return xyz_to_linear_srgb(self.apply(rgb), illuminant=self.illuminant)


def fit_matrix(
    camera_rgb: ArrayLike,
    reference: ArrayLike,
    *,
    method: Method = "linear",
    illuminant: str = "D50",
    white: ArrayLike | None = None,
    valid: ArrayLike | None = None,
) -> ColorMatrix:
    """Fit the map from camera RGB to XYZ that comes closest to a chart's colors.

    The least squares are done in Lab, linearized around the reference, so that dark and light
    patches have perceptual weights.

    Parameters
    ----------
    camera_rgb : array_like, shape (N, 3)
        Linear camera RGB of the patches, black-subtracted, not white-balanced, any scale.
    reference : array_like, shape (N, 3)
        XYZ of the patches under `illuminant`, perfect diffuser Y = 1 (not linear sRGB), for
        example from `chart_reference`.
    method : {"linear", "root_polynomial"}
        A 3 x 3 matrix, or the root polynomial of degree 2, which does not change with exposure
        either (Finlayson, Mackiewicz and Hurlbert 2015).
    illuminant : str
        Illuminant of the reference: "D50", "D55", "D65", "A" or "E".
    white : array_like, shape (3,), optional
        Camera RGB of the perfect diffuser; when given, it is mapped to the illuminant's white
        exactly.
    valid : array_like of bool, shape (N,), optional
        Patches to use.

    Returns
    -------
    ColorMatrix

    Raises
    ------
    ValueError
        If there are too few usable patches or they do not span the colors.

    References
    ----------
    doi 10.1109/TIP.2015.2405336 (root polynomials); CIE 142-2001 (CIEDE2000).
    """
    rgb = np.asarray(camera_rgb, dtype=np.float64)
    xyz = np.asarray(reference, dtype=np.float64)
    if rgb.ndim != 2 or rgb.shape[1:] != (3,) or xyz.shape != rgb.shape:
        raise ValueError(
            f"camera_rgb, reference: got shapes {rgb.shape} and {xyz.shape}, expected (N, 3) both"
        )
    if method not in ("linear", "root_polynomial"):
        raise ValueError(f"method: got {method!r}, expected 'linear' or 'root_polynomial'")
    white_xyz = white_point(illuminant)
    use = np.isfinite(rgb).all(axis=1) & np.isfinite(xyz).all(axis=1)
    if valid is not None:
        use &= np.asarray(valid, dtype=bool)
    if np.abs(xyz[use]).max(initial=0.0) > 3.0:
        raise ValueError(
            f"reference: got values up to {np.abs(xyz[use]).max():.3g}, expected XYZ with Y = 1 for"
            " the perfect diffuser"
        )
    terms = _terms(rgb, method)
    unknowns = terms.shape[1]
    if use.sum() < unknowns + 3:
        raise ValueError(
            f"camera_rgb: got {int(use.sum())} usable patches, expected at least {unknowns + 3};"
            " expose the chart without saturation"
        )
    white_terms = None
    if white is not None:
        white_terms = _terms(np.asarray(white, dtype=np.float64), method)
    index = np.nonzero(use)[0]
    matrix = _solve(terms[index], xyz[index], white_xyz, white_terms)
    lab = lab_from_xyz(xyz, white_xyz)
    held_out = np.full(len(rgb), np.nan)
    fitted = np.full(len(rgb), np.nan)
    fitted[index] = delta_e_2000(lab_from_xyz(terms[index] @ matrix.T, white_xyz), lab[index])
    without = []
    for i in index:
        others = index[index != i]
        partial = _solve(terms[others], xyz[others], white_xyz, white_terms)
        without.append(partial)
        held_out[i] = delta_e_2000(lab_from_xyz(terms[i] @ partial.T, white_xyz), lab[i])
    spread = np.array(without) - np.mean(without, axis=0)
    n = len(index)
    stderr = np.sqrt((n - 1) / n * (spread**2).sum(axis=0))
    return ColorMatrix(matrix, held_out, stderr, method, illuminant, fitted)


def neutral_white(
    camera_rgb: ArrayLike, *, reference: ArrayLike | None = None, valid: ArrayLike | None = None
) -> Quantity:
    """Estimate the camera RGB of a perfect diffuser from the chart's neutral patches.

    Parameters
    ----------
    camera_rgb : array_like, shape (24, 3)
        Linear camera RGB of the patches of a ColorChecker Classic.
    reference : array_like, shape (24, 3), optional
        XYZ of the patches; only Y of the neutral ones is used. Default: the published values.
    valid : array_like of bool, shape (24,), optional
        Patches to use.

    Returns
    -------
    Quantity
        Shape (3,), in the unit of `camera_rgb`; the error is from the scatter of the patches.
    """
    rgb = np.asarray(camera_rgb, dtype=np.float64)[NEUTRAL_PATCHES]
    y = np.asarray(chart_reference() if reference is None else reference)[NEUTRAL_PATCHES, 1]
    use = np.isfinite(rgb).all(axis=1) & (rgb > 0).all(axis=1)
    if valid is not None:
        use &= np.asarray(valid, dtype=bool)[NEUTRAL_PATCHES]
    if use.sum() < 2:
        raise ValueError(
            f"camera_rgb: got {int(use.sum())} usable neutral patches, expected at least 2; expose"
            " the chart without saturation"
        )
    ratio = rgb[use] / y[use, None]
    return Quantity(ratio.mean(axis=0), ratio.std(axis=0, ddof=1) / np.sqrt(use.sum()))


def describe_exposure(settings: Mapping[str, object]) -> str:
    """Return exposure time times ISO speed of a photograph, or `EXPOSURE_UNKNOWN`.

    Parameters
    ----------
    settings
        "exposure_s" in seconds and "iso".

    Examples
    --------
    >>> describe_exposure({"exposure_s": 0.01, "iso": 200}), describe_exposure({"iso": 200})
    ('2', 'unknown')
    """
    found = settings.get("exposure_s"), settings.get("iso")
    if None in found:
        return EXPOSURE_UNKNOWN
    return f"{float(str(found[0])) * float(str(found[1])):.6g}"


def to_calibration(
    fit: ColorMatrix, white: Quantity, *, exposure: str | None = None, **about: Unpack[Provenance]
) -> Calibration:
    """Return a fit as a `Calibration` of kind "color" for one camera.

    Parameters
    ----------
    fit
        Matrix of the chart.
    white
        Camera RGB of a white surface, from the chart.
    exposure
        `describe_exposure` of the photographs of the chart, whose white is then that of other
        photographs; None: the rig's, which other calibrations describe.
    about
        Provenance.
    """
    return make_single_device_calibration(
        "color",
        {
            "camera_to_xyz": Quantity(fit.matrix, fit.stderr),
            "white_rgb": white,
            "delta_e_mean": Quantity(np.array(fit.mean_delta_e)),
            "delta_e_max": Quantity(np.array(fit.max_delta_e)),
            "delta_e_fitted_mean": Quantity(np.array(float(np.nanmean(fit.fitted_delta_e)))),
            "patches": Quantity(np.array(float(np.isfinite(fit.delta_e).sum()))),
        },
        {
            "method": fit.method,
            "illuminant": fit.illuminant,
            "delta_e": "CIEDE2000, each patch held out of its fit",
            **({} if exposure is None else {EXPOSURE_NOTE: exposure}),
        },
        **about,
    )


def from_calibration(calibration: Calibration, serial: str) -> ColorMatrix:
    """Return the color matrix of one camera; the per-patch Delta E are not stored."""
    matrix = calibration.quantity(serial, "camera_to_xyz")
    method: Method = "linear" if matrix.value.shape == (3, 3) else "root_polynomial"
    mean = calibration.quantity(serial, "delta_e_mean").value
    fitted = calibration.quantity(serial, "delta_e_fitted_mean").value
    held_out, illuminant = mean.reshape(1), calibration.notes["illuminant"]
    errors = matrix.stderr_or_zero
    return ColorMatrix(matrix.value, held_out, errors, method, illuminant, fitted.reshape(1))


def _terms(rgb: Float64Array, method: Method) -> Float64Array:
    if method == "linear":
        return rgb
    r, g, b = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    roots = np.sqrt(np.maximum(np.stack([r * g, g * b, r * b], axis=-1), 0.0))
    return np.concatenate([rgb, roots], axis=-1)


def _solve(
    terms: Float64Array,
    xyz: Float64Array,
    white_xyz: Float64Array,
    white_terms: Float64Array | None,
) -> Float64Array:
    """Solve least squares in linearized Lab for vec(M); optionally M white_terms = white_xyz."""
    jacobian = lab_jacobian(xyz, white_xyz)
    unknowns = terms.shape[1]
    # Lab residual of one patch: J (M t - x), linear in the rows of M
    design = np.einsum("nij,nk->nijk", jacobian, terms).reshape(-1, 3 * unknowns)
    target = np.einsum("nij,nj->ni", jacobian, xyz).ravel()
    scale = np.linalg.norm(design, axis=0)
    if not (scale > 0).all():
        raise ValueError("camera_rgb: a channel is zero in all patches; check the frame")
    design = design / scale
    if white_terms is None:
        solution, _, rank, _ = np.linalg.lstsq(design, target, rcond=1e-10)
        if rank < design.shape[1]:
            raise ValueError("camera_rgb: the patches do not span the colors; use the whole chart")
        return np.asarray((solution / scale).reshape(3, unknowns), dtype=np.float64)
    constraint = np.kron(np.eye(3), white_terms) / scale
    q, r = np.linalg.qr(constraint.T, mode="complete")
    fixed = q[:, :3] @ np.linalg.solve(r[:3].T, white_xyz)
    free, _, rank, _ = np.linalg.lstsq(design @ q[:, 3:], target - design @ fixed, rcond=1e-10)
    if rank < design.shape[1] - 3:
        raise ValueError("camera_rgb: the patches do not span the colors; use the whole chart")
    return np.asarray(((fixed + q[:, 3:] @ free) / scale).reshape(3, unknowns), dtype=np.float64)
