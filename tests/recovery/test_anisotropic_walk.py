"""Photons in tissue that scatters by direction, walked one by one, against what is told of them.

Nothing here is the estimators': a walk in an unbounded half-space of matched index, scattering
``s (1 - b x^2)`` for a photon along x, and as often into a direction as out of it, so that light
tends to be even. The decay far away is known exactly, as an eigenvalue of the transport equation.
"""

import numpy as np
import pytest
from numba import njit
from scipy.optimize import brentq

from reconstruction import subsurface
from reconstruction.anisotropy import estimation as anisotropy
from reconstruction.anisotropy import profile_anisotropy
from reconstruction.anisotropy.estimation import estimate_single_direction_bias

DIRECTIONS, RADIUS_MM, PITCH_MM = 16, 0.3 + 0.25 * np.arange(28), 0.25
ANGLE = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
SIGMA_A, SCATTERING = 0.25, 2.0


@njit
def walked(photons, sigma_a, scattering, b, rng, rings, first, pitch, wedges):
    """Light that leaves through rings and wedges, and its squares."""
    light, squares = np.zeros((wedges, rings)), np.zeros((wedges, rings))
    for _ in range(photons):
        x = y = z = dx = dy = 0.0
        dz = weight = 1.0
        while weight > 1e-5:
            step = -np.log(1.0 - rng.random()) / (scattering * (1.0 - b * dx * dx))
            if dz < 0.0 and z + step * dz < 0.0:
                step = -z / dz
                x, y, weight = x + step * dx, y + step * dy, weight * np.exp(-sigma_a * step)
                ring = int(np.floor((np.hypot(x, y) - first) / pitch + 0.5))
                if 0 <= ring < rings:
                    turn = np.arctan2(y, x) / (2 * np.pi) * wedges
                    wedge = int(np.floor(turn + 0.5)) % wedges
                    light[wedge, ring] += weight
                    squares[wedge, ring] += weight * weight
                break
            x, y, z = x + step * dx, y + step * dy, z + step * dz
            weight *= np.exp(-sigma_a * step)
            while True:
                dz = 2.0 * rng.random() - 1.0
                azimuth, across = 2 * np.pi * rng.random(), np.sqrt(1.0 - dz * dz)
                dx, dy = across * np.cos(azimuth), across * np.sin(azimuth)
                if rng.random() < 1.0 - b * dx * dx:
                    break
    return light, squares


def decay(b, axis):
    """sigma_tr far away along an axis, 1/mm: the least eigenvalue of transport."""
    cosine, weight = np.polynomial.legendre.leggauss(80)
    azimuth = (np.arange(48) + 0.5) * 2 * np.pi / 48
    z, phi = (a.ravel() for a in np.meshgrid(cosine, azimuth, indexing="ij"))
    share = np.repeat(weight, 48)
    across = np.sqrt(1 - z**2)
    along = np.stack([across * np.cos(phi), across * np.sin(phi)])
    scattering = SCATTERING * (1 - b * along[0] ** 2)
    total = scattering + SIGMA_A

    def balance(kappa):
        kept = (share * scattering**2 / (total - kappa * along[axis])).sum()
        return kept / (share * scattering).sum() - 1

    return brentq(balance, 1e-3, 0.999 * (total / np.abs(along[axis])).min())


def measured(b, photons, rng):
    """Profiles (16, 28) of the walk and their variances, 1/mm^2."""
    light, squares = walked(
        photons, SIGMA_A, SCATTERING, b, rng, RADIUS_MM.size, RADIUS_MM[0], PITCH_MM, DIRECTIONS
    )
    area = 2 * np.pi * RADIUS_MM * PITCH_MM / DIRECTIONS * photons
    # a wedge averages over its width, which makes a harmonic in twice the angle sinc(1/8) less
    return light / area, squares / area**2


@pytest.mark.long
def test_directed_scattering_is_detected_by_fits_and_profiles(rng):
    settings = {"eta": 1.0, "g": 0.0}
    profiles, variance = measured(0.6, 1_500_000, rng)
    whole = subsurface.invert(
        RADIUS_MM,
        profiles.mean(axis=0),
        variance=variance.mean(axis=0) / DIRECTIONS,
        g_error=0.0,
        **settings,
    )
    each = subsurface.invert(RADIUS_MM, profiles, variance=variance, g_error=0.0, **settings)
    fits = anisotropy.estimate(ANGLE, each.sigma_tr_per_mm, each.sigma_tr_stderr, valid=each.valid)
    compared = profile_anisotropy.estimate_from_profiles(
        ANGLE,
        RADIUS_MM,
        profiles,
        variance,
        sigma_a_per_mm=whole.sigma_a_per_mm,
        sigma_s_prime_per_mm=whole.sigma_s_prime_per_mm,
        floor=0.0,
        **settings,
    )
    for found in (fits, compared):
        assert found.p_value < 1e-3
        # light goes farther along x, where it scatters less
        axis = np.abs(np.angle(np.exp(2j * found.axis_rad))) / 2
        assert axis < 4.0 * found.axis_stderr_rad
    # the profiles' ratio is that of fits, within both errors and the model's
    apart = np.log(fits.ratio / compared.ratio)
    assert abs(apart) < 4.0 * np.hypot(
        fits.ratio_stderr / fits.ratio, compared.ratio_stderr / compared.ratio
    )
    # and near that of decay far away, which the 7 mm of the probe do not quite reach
    far = np.log(decay(0.6, 1) / decay(0.6, 0)) * np.sinc(1 / 8)
    assert np.log(compared.ratio) == pytest.approx(far, rel=0.25)
    # a fit along one direction is off from the mean by more than its own standard error
    bias = estimate_single_direction_bias(compared, [0.0, np.pi / 2])
    assert (np.abs(bias.bias) > 5 * bias.stderr).all()
    assert bias.bias[0] < -0.05
    assert bias.bias[1] > 0.05
    single = each.sigma_tr_per_mm / fits.mean_per_mm - 1.0
    assert single[[0, 8]].mean() == pytest.approx(bias.bias[0], abs=0.04)
    assert single[[4, 12]].mean() == pytest.approx(bias.bias[1], abs=0.04)


@pytest.mark.long
def test_isotropic_walks_are_not_flagged(rng):
    settings = {"eta": 1.0, "g": 0.0, "sigma_a_per_mm": SIGMA_A, "sigma_s_prime_per_mm": SCATTERING}
    p_values = [
        profile_anisotropy.estimate_from_profiles(
            ANGLE, RADIUS_MM, *measured(0.0, 60_000, rng), floor=0.0, **settings
        ).p_value
        for _ in range(20)
    ]
    # of 20, more than 4 below 0.01 once in ten million
    assert np.count_nonzero(np.array(p_values) < 0.01) <= 4


def test_direction_independent_eigenvalue_is_isotropic_scattering():
    # albedo a: 1 = a / (2 k) ln((1 + k) / (1 - k)), k in units of the total (Case and Zweifel)
    total = SIGMA_A + SCATTERING
    k = decay(0.0, 0) / total
    assert SCATTERING / total / (2 * k) * np.log((1 + k) / (1 - k)) == pytest.approx(1, abs=1e-4)
    assert decay(0.0, 0) == pytest.approx(decay(0.0, 1), rel=1e-6)
