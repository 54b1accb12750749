"""Kernel for the likelihood of each pixel's color over a plane of chromophores."""

import math

import numpy as np
from numba import float32, float64, int64, njit, prange, void

from reconstruction.compiled import PIXEL_KERNEL_OPTIONS, readonly_array_type

NEGLIGIBLE_DEVIANCE = 36.0
"""-2 log p above the pixel's minimum beyond which probability is neglected."""


@njit(
    void(
        readonly_array_type(float64, 2),  # log rgb (n, 3)
        readonly_array_type(
            float64, 3
        ),  # weights of its errors, brightness projected out (n, 3, 3)
        readonly_array_type(
            float64, 2
        ),  # weights of the mean that gives log shading (n, 3), their sum is 1
        readonly_array_type(float64, 3),  # log color of the plane (m, b, 3)
        readonly_array_type(float64, 1),  # -2 log probability of log shading
        float64,  # log shading at the first node of it
        float64,  # and its step
        int64,  # places in blood that are summed
        float32[:, :, ::1],  # probability (n, m, b / summed), 0 before
    ),
    **PIXEL_KERNEL_OPTIONS,
)
def plane_probability(  # type: ignore[no-untyped-def]
    log_rgb, weights, mean, plane, prior, prior_low, prior_step, summed, probability
):
    """Sum each pixel's likelihood over the plane; its maximum is 1."""
    # -2 log p = e' W e - 2 log prior(s' e): e are residuals of log color, W has brightness
    # projected out, s' e is the log shading, whose prior is interpolated linearly
    rows, columns = plane.shape[0], plane.shape[1]
    for n in prange(log_rgb.shape[0]):
        cost = np.empty((rows, columns))
        w = weights[n]
        lowest = np.inf
        for i in range(rows):
            for j in range(columns):
                e0 = log_rgb[n, 0] - plane[i, j, 0]
                e1 = log_rgb[n, 1] - plane[i, j, 1]
                e2 = log_rgb[n, 2] - plane[i, j, 2]
                value = w[0, 0] * e0 * e0 + w[1, 1] * e1 * e1 + w[2, 2] * e2 * e2
                value += 2.0 * (w[0, 1] * e0 * e1 + w[0, 2] * e0 * e2 + w[1, 2] * e1 * e2)
                y = mean[n, 0] * e0 + mean[n, 1] * e1 + mean[n, 2] * e2
                y = (y - prior_low) / prior_step
                k = min(max(math.floor(y), 0), prior.shape[0] - 2)
                value += prior[k] + (y - k) * (prior[k + 1] - prior[k])
                cost[i, j] = value
                lowest = min(lowest, value)
        for i in range(rows):
            for j in range(columns):
                more = cost[i, j] - lowest
                if more < NEGLIGIBLE_DEVIANCE:
                    probability[n, i, j // summed] += np.float32(math.exp(-0.5 * more))
