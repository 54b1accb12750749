"""Estimators run over all points of a surface, a bounded chunk of lumitexels at a time."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from model import fresnel
from model.brdf.tables import BrdfBasis
from reconstruction import brdf_basis, diffuse_albedo, photometric_stereo
from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.lumitexels import Lumitexels, boundary_kernels
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
"""A point lit or seen by fewer has no estimate."""
GRAZING_COS: Final = 0.05
"""Light lower than this over the estimated surface is as good as none."""
MIN_STRIP_COSINE: Final = 0.05
"""Flatter views count as if they were so flat; the albedo's fit leaves them out."""
HIGHLIGHT_HALF_ANGLE_RAD: Final = np.radians(35.0)
"""Samples whose half vector lies nearer to the normal hold too much of the highlight: skin's
facets have a Beckmann slope of about 0.3 (Weyrich et al. 2005), of which 98 % lie below this."""
PEAK_HALF_ANGLE_RAD: Final = np.radians(25.0)
"""The same where the lobes are known and taken off: only their peaks are left out."""
LOBE_SCALE_ERROR_RATIO: Final = 3.8
"""Standard error of lobes' scale over what it were if every sample erred by itself. Samples of a
point err alike: by the lobes' shape, the normal and the light from inside that was taken off. On
simulated faces of seeds 0, 1 and 1 (types III, V and II) it was 3.5, 3.5 and 4.3."""
LOBE_TILT_RAD: Final = np.radians(0.3)
"""Standard error, in each direction, of normals by highlights: lobes are known no better."""


@dataclass(frozen=True, slots=True, eq=False)
class PointValues:
    """An estimate at each point of a surface.

    Attributes
    ----------
    values
        (P, C) float64; 0 where not valid.
    stderr
        (P, C); of a normal the angle in each of two directions across it, rad, in all three.
    valid
        (P,) bool.
    """

    values: Float64Array
    stderr: Float64Array
    valid: BoolArray

    @staticmethod
    def masked(values: FloatArray, stderr: FloatArray, valid: BoolArray) -> PointValues:
        """Return estimates of which only those that are valid count, others are 0."""
        keep = valid[:, None]
        return PointValues(np.where(keep, values, 0.0), np.where(keep, stderr, 0.0), valid)

    def __getitem__(self, rows: slice | NDArray[np.integer]) -> PointValues:
        """Return the estimates of some of the points."""
        return PointValues(self.values[rows], self.stderr[rows], self.valid[rows])


def has_enough_samples(samples: Lumitexels) -> BoolArray:
    """Return which points have samples of enough lights and views, shape (P,)."""

    def kinds(index: NDArray[np.integer]) -> NDArray[np.intp]:
        hit = np.zeros((len(samples.valid), int(index.max(initial=-1)) + 1), bool)
        for k in range(hit.shape[1]):
            hit[:, k] = samples.valid[:, index == k].any(axis=1)
        return np.count_nonzero(hit, axis=1)

    return np.asarray((kinds(samples.light) >= MIN_LIGHTS) & (kinds(samples.view) >= MIN_VIEWS))


def normals_from_half_vectors(samples: Lumitexels) -> PointValues:
    """Return the published estimate: half vectors of each view's four brightest samples."""
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
    """Return normals by robust photometric stereo of the light from inside the skin.

    Parameters
    ----------
    samples
        Of P points.
    normals
        (P, 3) to begin with, as a rule the scan's: they tell which samples hold highlights, and
        how much the boundary lets through.
    rounds
        Of estimating, each with the normals of the one before.
    highlight_rad
        Samples whose half vector lies nearer to the normal are left out.

    Notes
    -----
    What has been inside is f_r = R_d F_t F_t / pi, so f_r cos(theta) pi / (F_t F_t) is R_d times
    n . l, linear in n.
    """
    gray = samples.f.mean(axis=-1).astype(np.float64)
    # samples that do not count have no finite variance
    spread = np.where(samples.valid, samples.variance.mean(axis=-1), 0.0).astype(np.float64) / 3.0
    half = samples.light_dir + samples.view_dir
    half /= np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-6)
    light_dir = np.ascontiguousarray(samples.light_dir.transpose(1, 0, 2))
    start = np.asarray(normals, np.float64)
    good = has_enough_samples(samples)
    stderr = np.full(len(start), np.pi)
    for _ in range(rounds):
        cos_light = np.einsum("pmk,pk->pm", samples.light_dir, start)
        cos_view = np.einsum("pmk,pk->pm", samples.view_dir, start)
        use = (
            samples.valid
            & (cos_light > MIN_NORMAL_COS_LIGHT)
            & (cos_view > MIN_NORMAL_COS_VIEW)
            & (np.einsum("pmk,pk->pm", half, start) < np.cos(highlight_rad))
        )
        # the cosine that made f from the radiance is the scan's, not that of this round
        passed = boundary_kernels.boundary_transmittance(cos_light, cos_view)
        scale = np.pi * samples.cos_light / np.maximum(passed, 1e-3)
        found = photometric_stereo.estimate_normals(
            np.where(use, gray * scale, 0.0).T.astype(np.float32),
            light_dir,
            variance=np.where(use, spread * scale**2, 1.0).T.astype(np.float32),
            valid=np.ascontiguousarray(use.T),
        )
        start = np.where(found.valid[:, None], found.normals, start).astype(np.float64)
        # of the angle; in each of two directions across the normal it is less by the root of two
        stderr = np.where(found.valid, found.stderr_rad / np.sqrt(2.0), np.pi)
        good &= found.valid
    return _of_normals(start, stderr, good)


def _of_normals(normals: FloatArray, stderr_rad: FloatArray, good: BoolArray) -> PointValues:
    spread = np.repeat(np.asarray(stderr_rad, np.float64)[:, None], 3, axis=1)
    return PointValues.masked(normals, spread, good)


def reproject_samples(samples: Lumitexels, normals: PointValues) -> Lumitexels:
    """Return samples whose f_r is that of a surface with these normals, and not of the scan's.

    A sample's radiance was divided by the cosine at the scan's normal, degrees off the true one:
    by the cosine that the light had, f_r does not change with the light as 1 / cos does.

    Parameters
    ----------
    samples
        Of P points.
    normals
        Of the same points; samples of those not valid, and of light below `GRAZING_COS`, are not
        valid.
    """
    cos_light, cos_view = (
        np.einsum("pmk,pk->pm", way, normals.values.astype(np.float32))
        for way in (samples.light_dir, samples.view_dir)
    )
    good = samples.valid & normals.valid[:, None] & (cos_light > GRAZING_COS)
    ratio = np.where(good, samples.cos_light / np.maximum(cos_light, GRAZING_COS), 0.0)[..., None]
    return dataclasses.replace(
        samples,
        f=samples.f * ratio,
        variance=np.where(good[..., None], samples.variance, np.inf)
        * np.where(good[..., None], np.square(ratio), 1.0),
        cos_light=np.where(good, cos_light, samples.cos_light),
        cos_view=np.where(good, cos_view, samples.cos_view),
        valid=good,
    )


def estimate_albedo(samples: Lumitexels, normals: PointValues, *, stderr_rad: float) -> PointValues:
    """Return R_d of three channels by eq. (6) of Weyrich et al. 2005, see `diffuse_albedo`.

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
    The standard errors hold noise alone: see `surface_errors.of_albedo` for the rest.

    A pixel that sees the surface aslant averages a strip of it that is 1 / cos(view) long, and near
    a rim what lies behind the face as well: its deviation from the point's own light counts in
    proportion to that length.
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
    """Return what is left of the samples when the light from inside is taken off."""
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
    """Return the shares of a basis at each point, and in the last column the fit's residual.

    The standard error of the shares is that of the lobe's overall scale: single shares of nearly
    dependent lobes are not determined.
    """
    found = brdf_basis.fit_weights(specular_samples(samples, normals, r_d), basis)
    good = found.valid & normals.valid & r_d.valid
    scale = np.where(np.isfinite(found.stderr), LOBE_SCALE_ERROR_RATIO * found.stderr, 1.0)
    residual = np.where(good, found.residual, 0.0)
    each = np.append(found.weights, residual[:, None], axis=1)
    return PointValues.masked(each, scale[:, None] * each, good)


def normals_from_remainder(
    samples: Lumitexels, normals: PointValues, r_d: PointValues, lobes: PointLobes
) -> PointValues:
    """Return normals by photometric stereo of what fitted lobes leave of the samples.

    With the highlights taken off, samples near the mirror direction count too.

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
    # a lobe is known no better than a few percent: where it is strong a sample says less
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
    """Return normals that hold what highlights say, where light from inside says too little.

    Points whose standard error is below `LOBE_TILT_RAD` stay as they are. Those above it are moved
    to where the whole model fits best, and lie between the two by the weights of their errors.

    Parameters
    ----------
    samples, r_d, lobes
        As in `normals_from_remainder`.
    normals
        By the light from inside alone.
    now
        Normals to begin from, (P, 3); `normals` by default.
    """
    rows = np.flatnonzero(normals.valid & r_d.valid & (normals.stderr[:, 0] > LOBE_TILT_RAD))
    if not len(rows):
        return normals
    start = normals.values if initial_normals is None else initial_normals
    r_d_gray = r_d.values[rows].mean(axis=-1)
    found = model_normals.estimate(select_points(samples, rows), start[rows], r_d_gray, lobes[rows])
    ours = np.square(np.hypot(found.stderr_rad, LOBE_TILT_RAD))
    theirs = np.square(normals.stderr[rows, 0])
    share = np.where(found.valid, theirs / (theirs + ours), 0.0)[:, None]
    between = share * found.normals + (1.0 - share) * normals.values[rows]
    values, stderr = normals.values.copy(), normals.stderr.copy()
    values[rows] = between / np.linalg.norm(between, axis=-1, keepdims=True)
    stderr[rows] = np.where(
        share > 0, np.sqrt(ours * theirs / (ours + theirs))[:, None], stderr[rows]
    )
    return PointValues(values, stderr, normals.valid)


def count_samples(part: slice, samples: Lumitexels) -> PointValues:
    """Return how many samples each point has; valid where they are enough for an estimate."""
    counts = samples.counts[:, None].astype(np.float64)
    return PointValues(counts, np.zeros_like(counts), has_enough_samples(samples))


def select_points(samples: Lumitexels, rows: NDArray[np.integer]) -> Lumitexels:
    """Return the samples of some of the points."""
    names = ("f", "variance", "light_dir", "view_dir", "cos_light", "cos_view", "valid")
    some = {name: getattr(samples, name)[rows] for name in names}
    return dataclasses.replace(samples, **some)
