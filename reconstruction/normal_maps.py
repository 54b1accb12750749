"""Normal maps with errors and masks, the result of every estimator of normals."""

from dataclasses import dataclass, field

import numpy as np

from reconstruction.arrays import BoolArray, FloatArray, Int32Array


class PhotometricStereoError(ValueError):
    """Images, lights or masks that normals cannot be computed from."""


@dataclass(frozen=True, slots=True)
class NormalMaps:
    """Normals with albedo, errors and masks; every array has the points' shape.

    Where `valid` is False, normals and albedo are 0 and the standard error is pi; nothing is NaN.

    Attributes
    ----------
    normals : ndarray, shape (..., 3)
        Unit vectors, outward, in the frame of the light directions.
    albedo : ndarray, shape (...)
        In the unit of intensity over that of `light_intensity`; 1 for a white Lambertian surface
        if light intensities are calibrated. Above 1 is possible.
    residual : ndarray, shape (...)
        Root mean square of intensity over light intensity, less the fit, over the samples used.
    valid : ndarray of bool, shape (...)
        At least three samples from directions that span space, and a signal above its noise.
    stderr_rad : ndarray, shape (...)
        Root mean square angle between estimate and ground truth due to noise, rad, at most pi,
        the value if three samples leave no residual and no variance is given.
    stderr_albedo : ndarray, shape (...)
        Standard error of `albedo`; infinite in the same case.
    used : ndarray of int, shape (...)
        Number of samples with weight.
    """

    normals: FloatArray
    albedo: FloatArray
    residual: FloatArray
    valid: BoolArray
    stderr_rad: FloatArray
    stderr_albedo: FloatArray = field(default_factory=lambda: np.zeros(0))
    used: Int32Array = field(default_factory=lambda: np.zeros(0, np.int32))
