"""Run estimators over all points of a surface, a bounded chunk of lumitexels at a time."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from model import fresnel
from model.brdf.tables import BrdfBasis
from reconstruction import brdf_basis, diffuse_albedo, photometric_stereo
from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.lumitexels import Lumitexels, sample_kernels
from reconstruction.photometric_stereo import half_vectors as half_vector_normals
from reconstruction.surface import model_normals
from reconstruction.surface.model_normals import (
    LOBE_RELATIVE_ERROR,
    MIN_NORMAL_COS_LIGHT,
    MIN_NORMAL_COS_VIEW,
    PointLobes,
)

MIN_LIGHTS: Final = 10
MIN_VIEWS: Final = 2
"""A point with samples of fewer lights or views has no estimate."""
GRAZING_COS: Final = 0.05
"""Minimum cosine of a usable light over the estimated surface."""
MIN_STRIP_COSINE: Final = 0.05
"""Cosine at which views are clamped; the albedo's fit omits them."""
HIGHLIGHT_HALF_ANGLE_RAD: Final = np.radians(35.0)
"""Samples whose half vector is nearer to the normal contain too much of the highlight: skin's
facets have a Beckmann slope of about 0.3 (Weyrich et al. 2005), of which 98 % are below this."""
PEAK_HALF_ANGLE_RAD: Final = np.radians(25.0)
"""The same after fitted lobes are subtracted: only their peaks are omitted."""
LOBE_SCALE_ERROR_RATIO: Final = 0.65
"""Ratio of the standard error of the lobes' scale to that of one independent sample per view.

All lights of a view see a point in the same pixel: its position, its normals and the subtracted
subsurface scattering err in common. More lights therefore do not lower the error, more views do.
docs/validation/light-dome.md has the faces that set the ratio."""
LOBE_TILT_RAD: Final = np.radians(0.3)
"""Standard error, in each direction, of normals by highlights, from the error of the lobes."""


@dataclass(frozen=True, slots=True, eq=False)
class PointValues:
    """An estimate at each point of a surface.

    Attributes
    ----------
    values
        (P, C) float64; 0 where not valid.
    stderr
        (P, C); for a normal the angle in each of two tangential directions, rad, in all three.
    valid
        (P,) bool.
    """

    values: Float64Array
    stderr: Float64Array
    valid: BoolArray

    @staticmethod
    def masked(values: FloatArray, stderr: FloatArray, valid: BoolArray) -> PointValues:
        """Return estimates that are 0 where not valid."""
        keep = valid[:, None]
        return PointValues(np.where(keep, values, 0.0), np.where(keep, stderr, 0.0), valid)

    @staticmethod
    def concatenate(parts: Sequence[PointValues]) -> PointValues:
        """Return the estimates of the points of all parts, in order."""
        arrays = zip(*((p.values, p.stderr, p.valid) for p in parts), strict=True)
        return PointValues(*map(np.concatenate, arrays))

    def __getitem__(self, rows: slice | NDArray[np.integer]) -> PointValues:
        """Return the estimates of some of the points."""
        return PointValues(self.values[rows], self.stderr[rows], self.valid[rows])


def has_enough_samples(samples: Lumitexels) -> BoolArray:
    """Return which points have samples of enough lights and views, shape (P,)."""
    lights, views = (_count_kinds(samples.valid, of) for of in (samples.light, samples.view))
    return np.asarray((lights >= MIN_LIGHTS) & (views >= MIN_VIEWS))


def _count_kinds(valid: BoolArray, index: NDArray[np.integer]) -> NDArray[np.intp]:
    """Return the number of different lights or views among the valid samples, (P,)."""
    hit = np.zeros((len(valid), int(index.max(initial=-1)) + 1), bool)
    for k in range(hit.shape[1]):
        hit[:, k] = valid[:, index == k].any(axis=1)
    return np.count_nonzero(hit, axis=1)


def normals_from_half_vectors(samples: Lumitexels) -> PointValues:
    """Estimate normals as published: half vectors of each view's four brightest samples."""
    ways = samples.light_dir, samples.view_dir, samples.view
    found = half_vector_normals.estimate(samples.f.mean(axis=-1), *ways, valid=samples.valid)
    good = has_enough_samples(samples) & found.valid
    return _of_normals(found.normals, found.stderr_rad / np.sqrt(2.0), good)


def normals_from_shading(
    samples: Lumitexels,
    normals: FloatArray,
    *,
    rounds: int = 3,
    highlight_rad: float = HIGHLIGHT_HALF_ANGLE_RAD,
) -> PointValues:
    """Estimate normals by robust photometric stereo of subsurface-scattered light.

    Parameters
    ----------
    samples
        Of P points.
    normals
        (P, 3) initial normals, usually the scan's: they define the samples in highlights and the
        transmittance of the boundary.
    rounds
        Number of estimates, each with the normals of the previous one.
    highlight_rad
        Samples whose half vector is nearer to the normal are omitted.

    Notes
    -----
    Subsurface-scattered light has f_r = R_d F_t F_t / pi, so f_r cos(theta) pi / (F_t F_t) is R_d
    times n . l, linear in n.
    """
    light_dir = np.ascontiguousarray(samples.light_dir.transpose(1, 0, 2))
    start = np.ascontiguousarray(normals, np.float64)
    good = has_enough_samples(samples)
    stderr = np.full(len(start), np.pi)
    limits = MIN_NORMAL_COS_LIGHT, MIN_NORMAL_COS_VIEW, float(np.cos(highlight_rad))
    given = "f variance light_dir view_dir cos_light valid"
    shape = samples.valid.shape[::-1]
    signal, variance = np.empty(shape, np.float32), np.empty(shape, np.float32)
    used = np.empty(shape, np.bool_)
    for _ in range(rounds):
        out = signal, variance, used
        sample_kernels.shade(_arrays(samples, given), start, limits, fresnel.ETA_SKIN, out)
        found = photometric_stereo.estimate_normals(
            signal, light_dir, variance=variance, valid=used
        )
        start = np.where(found.valid[:, None], found.normals, start).astype(np.float64)
        # the angle's error; in each of two tangential directions it is smaller by sqrt(2)
        stderr = np.where(found.valid, found.stderr_rad / np.sqrt(2.0), np.pi)
        good &= found.valid
    return _of_normals(start, stderr, good)


def _of_normals(normals: FloatArray, stderr_rad: FloatArray, good: BoolArray) -> PointValues:
    spread = np.repeat(np.asarray(stderr_rad, np.float64)[:, None], 3, axis=1)
    return PointValues.masked(normals, spread, good)


def reproject_samples(samples: Lumitexels, normals: PointValues) -> Lumitexels:
    """Convert samples from the scan's normals to the given ones.

    A sample's radiance was divided by the cosine at the scan's normal, which is degrees off: its
    f_r = L / (E cos) is multiplied by cos_scan / cos_normal.

    Parameters
    ----------
    samples
        Of P points.
    normals
        Of the same points; samples of invalid normals, and of light below `GRAZING_COS`, become
        invalid.
    """
    given = "f variance light_dir view_dir cos_light cos_view valid"
    names = "f", "variance", "cos_light", "cos_view", "valid"
    made = {name: np.empty_like(getattr(samples, name)) for name in names}
    sample_kernels.reproject(
        _arrays(samples, given),
        np.ascontiguousarray(normals.values, np.float64),
        normals.valid,
        GRAZING_COS,
        tuple(made.values()),
    )
    return dataclasses.replace(samples, **made)


def _arrays(samples: Lumitexels, names: str) -> tuple[NDArray[Any], ...]:
    """Return fields of samples for a kernel."""
    return tuple(np.ascontiguousarray(getattr(samples, name)) for name in names.split())


def estimate_albedo(samples: Lumitexels, normals: PointValues, *, stderr_rad: float) -> PointValues:
    """Estimate R_d of three channels by eq. (6) of Weyrich et al. 2005, see `diffuse_albedo`.

    Parameters
    ----------
    samples
        Of P points.
    normals
        Of the same points.
    stderr_rad
        Typical standard error of the normals.

    Notes
    -----
    The standard errors contain noise alone: see `errors.add_albedo_errors` for the rest.

    A pixel in an oblique view averages a strip of surface of length 1 / cos(view), and near a rim
    also what is behind the face: its standard error is scaled by that length.
    """
    samples = reproject_samples(samples, normals)
    strip = 1.0 / np.maximum(samples.cos_view, MIN_STRIP_COSINE)[..., None]
    found = diffuse_albedo.estimate(
        samples.f,
        samples.light_dir,
        samples.view_dir,
        np.where(normals.valid[:, None], normals.values, np.nan).astype(np.float32),
        eta=fresnel.ETA_SKIN,
        variance=samples.variance * np.square(strip),
        valid=samples.valid,
        normal_stderr_rad=stderr_rad,
    )
    good = found.valid & normals.valid & np.isfinite(found.stderr).all(axis=-1)
    return PointValues.masked(found.r_d, found.stderr, good)


def specular_samples(
    samples: Lumitexels, normals: PointValues, r_d: PointValues
) -> brdf_basis.SurfaceSamples:
    """Subtract subsurface scattering from the samples; return their specular part."""
    samples = reproject_samples(samples, normals)
    return brdf_basis.surface_samples(
        samples.f,
        samples.light_dir,
        samples.view_dir,
        np.where(normals.valid[:, None], normals.values, (0.0, 0.0, 1.0)),
        np.where(r_d.valid[:, None], r_d.values, np.nan),
        eta=fresnel.ETA_SKIN,
        variance=samples.variance,
        valid=samples.valid,
    )


def fit_lobe_weights(
    samples: Lumitexels, normals: PointValues, r_d: PointValues, basis: BrdfBasis
) -> PointValues:
    """Fit a basis's weights at each point; the last column is the fit's residual.

    The weights' standard error is that of the lobe's overall scale: single weights of nearly
    dependent lobes are not determined.
    """
    shine = specular_samples(samples, normals, r_d)
    found = brdf_basis.fit_weights(shine, basis)
    good = found.valid & normals.valid & r_d.valid
    views = np.maximum(_count_kinds(shine.valid, samples.view), 1)
    per_view = np.sqrt(np.count_nonzero(shine.valid, axis=1) / views)
    known = np.isfinite(found.stderr)
    ratio = np.maximum(LOBE_SCALE_ERROR_RATIO * per_view, 1.0)
    scale = np.where(known, ratio * found.stderr, 1.0)
    residual = np.where(good, found.residual, 0.0)
    each = np.append(found.weights, residual[:, None], axis=1)
    return PointValues.masked(each, scale[:, None] * each, good)


def normals_from_remainder(
    samples: Lumitexels, normals: PointValues, r_d: PointValues, lobes: PointLobes
) -> PointValues:
    """Estimate normals by photometric stereo of the samples minus the fitted lobes.

    Without the highlights, samples near the mirror direction are usable too.

    Parameters
    ----------
    samples, normals, r_d
        Of P points.
    lobes
        Of the same points.
    """
    known = normals.valid & r_d.valid
    samples = reproject_samples(samples, normals)
    shine = lobes.where(known).evaluate(samples, normals.values)
    # the relative error of a fitted lobe adds to the variance of its samples
    bare = dataclasses.replace(
        samples,
        f=samples.f - shine[..., None],
        variance=samples.variance + np.square(LOBE_RELATIVE_ERROR * shine)[..., None],
    )
    start = np.where(known[:, None], normals.values, (0.0, 0.0, 1.0))
    found = normals_from_shading(bare, start, rounds=1, highlight_rad=PEAK_HALF_ANGLE_RAD)
    return _of_normals(found.values, found.stderr[:, 0], known & found.valid)


def normals_from_full_model(
    samples: Lumitexels,
    normals: PointValues,
    r_d: PointValues,
    lobes: PointLobes,
    *,
    initial_normals: Float64Array | None = None,
) -> PointValues:
    """Refine normals by highlights where subsurface scattering alone leaves a large error.

    Points whose standard error is below `LOBE_TILT_RAD` are kept. The others are fitted to the full
    model and averaged with the initial normals by inverse variance.

    Parameters
    ----------
    samples, r_d, lobes
        See `normals_from_remainder`.
    normals
        Estimated from subsurface-scattered light alone.
    initial_normals
        Start values, (P, 3); `normals` by default.
    """
    rows = np.flatnonzero(normals.valid & r_d.valid & (normals.stderr[:, 0] > LOBE_TILT_RAD))
    if not len(rows):
        return normals
    start = normals.values if initial_normals is None else initial_normals
    r_d_gray = r_d.values[rows].mean(axis=-1)
    found = model_normals.estimate(select_points(samples, rows), start[rows], r_d_gray, lobes[rows])
    ours = np.square(np.hypot(found.stderr_rad, LOBE_TILT_RAD))
    theirs = np.square(normals.stderr[rows, 0])
    # inverse-variance mean of the two normals: its variance is the product over the sum
    share = np.where(found.valid, theirs / (theirs + ours), 0.0)[:, None]
    between = share * found.normals + (1.0 - share) * normals.values[rows]
    values, stderr = normals.values.copy(), normals.stderr.copy()
    values[rows] = between / np.linalg.norm(between, axis=-1, keepdims=True)
    stderr[rows] = np.where(
        share > 0, np.sqrt(ours * theirs / (ours + theirs))[:, None], stderr[rows]
    )
    return PointValues(values, stderr, normals.valid)


def count_samples(samples: Lumitexels) -> PointValues:
    """Return the number of samples of each point; valid where an estimate is possible."""
    counts = samples.counts[:, None].astype(np.float64)
    return PointValues(counts, np.zeros_like(counts), has_enough_samples(samples))


def select_points(samples: Lumitexels, rows: NDArray[np.integer]) -> Lumitexels:
    """Return the samples of some of the points."""
    names = ("f", "variance", "light_dir", "view_dir", "cos_light", "cos_view", "valid")
    some = {name: getattr(samples, name)[rows] for name in names}
    return dataclasses.replace(samples, **some)
