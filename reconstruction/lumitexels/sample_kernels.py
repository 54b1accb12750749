"""Compiled passes over the samples of many points, one for each step of the estimators.

In NumPy each step needs a dozen passes over arrays of millions of samples, with sums over a last
axis of three. Arrays are (P, M) or (P, M, 3) for P points with M samples; cosines and sums are
float64 within a sample. Each point is written by one thread, so that results do not depend on
their number.
"""

import math

import numpy as np
from numba import njit, prange

from reconstruction.lumitexels.boundary_kernels import boundary_reflectance

BLOCK_POINTS = 16
"""Points that a thread transposes at once: 64 bytes of float32."""


@njit(cache=True, parallel=True, error_model="numpy")
def reproject(samples, normals, known, least_cosine, out):  # type: ignore[no-untyped-def]
    """Convert samples from the normals of their cosines to others.

    ``samples``: f, variance, directions of light and view, cosines to light and view, valid.
    ``out``: f, variance, both cosines, valid. Invalid samples have f 0, infinite variance, and the
    given cosines.
    """
    f, variance, light_dir, view_dir, cos_light, cos_view, valid = samples
    f_out, variance_out, light_out, view_out, valid_out = out
    points, count, channels = f.shape
    for p in prange(points):
        for m in range(count):
            cl = cv = 0.0
            for c in range(3):
                cl += light_dir[p, m, c] * normals[p, c]
                cv += view_dir[p, m, c] * normals[p, c]
            good = known[p] and valid[p, m] and cl > least_cosine
            valid_out[p, m] = good
            if not good:
                light_out[p, m], view_out[p, m] = cos_light[p, m], cos_view[p, m]
                for c in range(channels):
                    f_out[p, m, c], variance_out[p, m, c] = 0.0, np.inf
                continue
            light_out[p, m], view_out[p, m] = cl, cv
            ratio = cos_light[p, m] / cl
            for c in range(channels):
                f_out[p, m, c] = f[p, m, c] * ratio
                variance_out[p, m, c] = variance[p, m, c] * ratio * ratio


@njit(cache=True, parallel=True, error_model="numpy")
def shade(samples, normals, limits, eta, out):  # type: ignore[no-untyped-def]
    """Return R_d n.l of each sample and its variance for photometric stereo, as (M, P).

    ``samples``: f, variance, directions of light and view, the cosine f was computed with, valid.
    ``limits``: least cosines of light and view, and the cosine of the half vector above which a
    sample is not used. ``out``: signal, variance, used.
    """
    f, variance, light_dir, view_dir, cos_light, valid = samples
    least_light, least_view, most_half = limits
    signal, spread, used = out
    points, count, channels = f.shape
    for block in prange((points + BLOCK_POINTS - 1) // BLOCK_POINTS):
        for m in range(count):
            for p in range(block * BLOCK_POINTS, min(points, (block + 1) * BLOCK_POINTS)):
                cl = cv = length2 = 0.0
                for c in range(3):
                    cl += light_dir[p, m, c] * normals[p, c]
                    cv += view_dir[p, m, c] * normals[p, c]
                    length2 += (np.float64(light_dir[p, m, c]) + view_dir[p, m, c]) ** 2
                half = (cl + cv) / max(math.sqrt(length2), 1e-6)
                good = valid[p, m] and cl > least_light and cv > least_view and half < most_half
                used[m, p] = good
                if not good:
                    signal[m, p], spread[m, p] = 0.0, 1.0
                    continue
                gray = noise = 0.0
                for c in range(channels):
                    gray += f[p, m, c]
                    noise += variance[p, m, c]
                passed = 1.0 - boundary_reflectance(cl, eta)
                passed *= 1.0 - boundary_reflectance(cv, eta)
                # f was computed from the radiance with the cosine of other normals
                scale = math.pi * cos_light[p, m] / max(passed, 1e-3)
                signal[m, p] = gray / channels * scale
                # variance of the mean of independent channels
                spread[m, p] = noise / channels**2 * scale * scale


@njit(cache=True, parallel=True, error_model="numpy")
def subtract_diffuse(  # type: ignore[no-untyped-def]
    f, variance, directions, normals, r_d, valid, eta, least_cosine, out
):
    """Subtract the diffuse part, average the channels by inverse variance, and times the cosine.

    ``directions``: of light and view. ``variance`` has no channel where it is not known: channels
    are then averaged evenly, and the variance is 0. ``out``: value, variance, used; value 0 and
    variance 1 where a sample is not used.
    """
    light_dir, view_dir = directions
    value_out, variance_out, used = out
    points, count, channels = f.shape
    known = variance.shape[2] > 0
    for p in prange(points):
        for m in range(count):
            cl = cv = 0.0
            for c in range(3):
                cl += light_dir[p, m, c] * normals[p, c]
                cv += view_dir[p, m, c] * normals[p, c]
            # False for NaN
            good = valid[p, m] and cl >= least_cosine and cv >= least_cosine
            total = above = 0.0
            if good:
                through = 1.0 - boundary_reflectance(cl, eta)
                through *= 1.0 - boundary_reflectance(cv, eta)
                for c in range(channels):
                    rest = f[p, m, c] - through * r_d[p, c] / math.pi
                    weight = 1.0 / variance[p, m, c] if known else 1.0
                    good &= math.isfinite(rest) and math.isfinite(weight) and weight > 0.0
                    total += weight
                    above += weight * rest
            used[p, m] = good
            value_out[p, m] = above / total * cl if good else 0.0
            variance_out[p, m] = (cl * cl / total if known else 0.0) if good else 1.0
