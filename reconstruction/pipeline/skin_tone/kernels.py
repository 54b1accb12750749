"""Lab of camera RGB with its covariance, per pixel, compiled."""

import math

import numpy as np
from numba import njit, prange

from reconstruction.compiled import PIXEL_KERNEL_OPTIONS

CHUNK_PIXELS = 4096
"""Pixels of one parallel task."""
MIN_RELATIVE_XYZ = 1e-4
"""Relative XYZ below which a color counts as black."""
_CUBE_ROOT_START = (6.0 / 29.0) ** 3  # CIE 15:2004, threshold of the cube root
_LINEAR_SLOPE = 1.0 / (3.0 * (6.0 / 29.0) ** 2)  # below it


@njit(inline="always")
def _fill_terms(r, g, b, terms, slopes):  # type: ignore[no-untyped-def]
    """Fill the terms of a color matrix and their derivatives by channel."""
    terms[0], terms[1], terms[2] = r, g, b
    slopes[:, :] = 0.0
    slopes[0, 0] = slopes[1, 1] = slopes[2, 2] = 1.0
    if terms.size > 3:
        rg, gb, rb = (
            math.sqrt(max(r * g, 0.0)),
            math.sqrt(max(g * b, 0.0)),
            math.sqrt(max(r * b, 0.0)),
        )
        terms[3], terms[4], terms[5] = rg, gb, rb
        if rg > 0.0:
            slopes[3, 0], slopes[3, 1] = 0.5 * g / rg, 0.5 * r / rg
        if gb > 0.0:
            slopes[4, 1], slopes[4, 2] = 0.5 * b / gb, 0.5 * g / gb
        if rb > 0.0:
            slopes[5, 0], slopes[5, 2] = 0.5 * b / rb, 0.5 * r / rb


@njit(inline="always")
def _fill_row_variance(terms, white_terms, variance, found):  # type: ignore[no-untyped-def]
    """Fill the variance of XYZ by a matrix whose rows map the white without error."""
    for row in range(3):
        free = fixed = total = 0.0
        for k in range(terms.size):
            free += variance[row, k] * terms[k] ** 2
            fixed += variance[row, k] * terms[k] * white_terms[k]
            total += variance[row, k] * white_terms[k] ** 2
        found[row] = max(free - fixed * fixed / total, 0.0) if total > 0.0 else 0.0


@njit(inline="always")
def _correct(log_xyz, coefficients, slope):  # type: ignore[no-untyped-def]
    """Correct log XYZ in place, and fill d(corrected) / d(given)."""
    y = log_xyz[1]
    x, z = log_xyz[0] - y, log_xyz[2] - y
    c = coefficients
    for k in range(3):
        by_x = c[1, k] + 2.0 * x * c[3, k] + z * c[4, k]
        by_z = c[2, k] + x * c[4, k] + 2.0 * z * c[5, k]
        slope[k, 0], slope[k, 1], slope[k, 2] = by_x, c[6, k] - by_x - by_z, by_z
        slope[k, k] += 1.0
        change = c[0, k] + x * c[1, k] + z * c[2, k] + c[6, k] * y
        log_xyz[k] += change + x * x * c[3, k] + x * z * c[4, k] + z * z * c[5, k]


@njit(inline="always")
def _root(ratio):  # type: ignore[no-untyped-def]
    """Return the nonlinear function of CIE 1976 and its derivative by the logarithm."""
    if ratio > _CUBE_ROOT_START:
        root = ratio ** (1.0 / 3.0)
        return root, root / 3.0
    return _LINEAR_SLOPE * ratio + 4.0 / 29.0, _LINEAR_SLOPE * ratio


@njit(**PIXEL_KERNEL_OPTIONS)
def fill_lab(  # type: ignore[no-untyped-def]
    rgb, variance, scaled, white, matrices, coefficients, nodes, lab, covariance
):
    """Fill Lab and its covariance, (n, 3) and (n, 3, 3).

    Parameters: light (n, 3) in the matrix's camera RGB and its variance; of the errors that scale
    all channels together, the light that they scale (n, 3) and their relative variance (n,); white
    (3,);
    the matrix, the variances of its elements, both (3, k), the map of its XYZ to XYZ under D65
    (3, 3) and that white (3,); the correction (7, 3); log Y (m,) and the covariances of the
    corrected log XYZ there (m, 3, 3).
    """
    matrix, matrix_variance, to_xyz, white_xyz = matrices
    scaled_rgb, scale_variance = scaled
    log_y, log_covariance = nodes
    n, terms_count = rgb.shape[0], matrix.shape[1]
    for chunk in prange((n + CHUNK_PIXELS - 1) // CHUNK_PIXELS):
        terms, white_terms = np.empty(terms_count), np.empty(terms_count)
        slopes, by_terms = np.empty((terms_count, 3)), np.empty((3, 3))
        by_row, log_xyz = np.empty(3), np.empty(3)
        change, by_input = np.empty((3, 3)), np.empty((3, 7))
        inputs, to_lab = np.empty(7), np.empty((3, 3))
        total = np.empty((3, 3))
        _fill_terms(white[0], white[1], white[2], white_terms, slopes)
        for i in range(chunk * CHUNK_PIXELS, min((chunk + 1) * CHUNK_PIXELS, n)):
            _fill_terms(rgb[i, 0], rgb[i, 1], rgb[i, 2], terms, slopes)
            _fill_row_variance(terms, white_terms, matrix_variance, by_row)
            for row in range(3):
                inputs[row], inputs[3 + row] = variance[i, row], by_row[row]
                for channel in range(3):
                    by_terms[row, channel] = 0.0
                    for k in range(terms_count):
                        by_terms[row, channel] += matrix[row, k] * slopes[k, channel]
            inputs[6] = scale_variance[i]
            # d log XYZ by noise of the channels, by errors of the matrix, and by a common factor
            for row in range(3):
                value = 0.0
                for k in range(terms_count):
                    for other in range(3):
                        value += to_xyz[row, other] * matrix[other, k] * terms[k]
                value = max(value, MIN_RELATIVE_XYZ)
                log_xyz[row] = math.log(value)
                by_input[row, 6] = 0.0
                for channel in range(3):
                    by_input[row, 3 + channel] = to_xyz[row, channel] / value
                    by_input[row, channel] = 0.0
                    for other in range(3):
                        by_input[row, channel] += (
                            to_xyz[row, other] * by_terms[other, channel] / value
                        )
                    by_input[row, 6] += by_input[row, channel] * scaled_rgb[i, channel]
            _correct(log_xyz, coefficients, change)
            place = np.interp(log_xyz[1], log_y, np.arange(log_y.size) * 1.0)
            low = min(int(place), log_y.size - 2)
            part = place - low
            x, by_x = _root(math.exp(log_xyz[0]) / white_xyz[0])
            y, by_y = _root(math.exp(log_xyz[1]) / white_xyz[1])
            z, by_z = _root(math.exp(log_xyz[2]) / white_xyz[2])
            lab[i, 0], lab[i, 1], lab[i, 2] = 116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)
            to_lab[:, :] = 0.0
            to_lab[0, 1], to_lab[1, 0], to_lab[1, 1] = 116.0 * by_y, 500.0 * by_x, -500.0 * by_y
            to_lab[2, 1], to_lab[2, 2] = 200.0 * by_y, -200.0 * by_z
            for a in range(3):
                for b in range(3):
                    found = (1.0 - part) * log_covariance[low, a, b]
                    found += part * log_covariance[low + 1, a, b]
                    for k in range(7):
                        one = other_one = 0.0
                        for c in range(3):
                            one += change[a, c] * by_input[c, k]
                            other_one += change[b, c] * by_input[c, k]
                        found += one * other_one * inputs[k]
                    total[a, b] = found
            for a in range(3):
                for b in range(3):
                    found = 0.0
                    for c in range(3):
                        for d in range(3):
                            found += to_lab[a, c] * total[c, d] * to_lab[b, d]
                    covariance[i, a, b] = found
