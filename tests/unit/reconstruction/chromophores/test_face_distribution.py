"""The distribution of a face's melanin and blood: closed forms, and skin that does not belong."""

import numpy as np
import pytest

from reconstruction.chromophores import face_kernels as kernels
from reconstruction.chromophores.face_distribution import (
    MIN_CONTAMINATION,
    MIN_SIGMAS,
    ContaminatedNormal,
    FaceDistribution,
    add_systematic_errors,
    fit_distribution,
)

MELANIN_ENDS = (-10.0, -0.69)
BLOOD_ENDS = (0.04, 1.0)
MELANIN = np.linspace(-5.5, -1.0, 226)
BLOOD = np.linspace(0.055, 0.985, 32)


def seen(melanin, melanin_errors, blood, blood_errors, rng):
    """Return what pixels tell whose melanin and blood are measured with normal errors."""
    m = melanin + melanin_errors * rng.standard_normal(melanin.size)
    b = blood + blood_errors * rng.standard_normal(blood.size)
    of_melanin = np.exp(-0.5 * np.square((MELANIN - m[:, None]) / melanin_errors[:, None]))
    of_blood = np.exp(-0.5 * np.square((BLOOD - b[:, None]) / blood_errors[:, None]))
    return of_melanin[:, :, None] * of_blood[:, None, :]


def fitted(probability):
    return fit_distribution(probability, (MELANIN, BLOOD), (MELANIN_ENDS, BLOOD_ENDS))


@pytest.mark.long
@pytest.mark.parametrize("spread", [0.1, 0.3])
def test_means_and_deviations_are_recovered_under_pixel_errors(spread, rng):
    count = 3000
    errors, blood_errors = rng.choice([0.05, 0.2, 0.5], count), rng.choice([0.05, 0.15], count)
    truth, blood = rng.normal(-3.0, spread, count), rng.normal(0.42, 0.08, count)
    found = fitted(seen(truth, errors, blood, blood_errors, rng))
    for bell, mean, wide, err in (
        (found.melanin, -3.0, spread, errors),
        (found.blood, 0.42, 0.08, blood_errors),
    ):
        # Fisher's information of pixels of variance spread^2 + error^2; 4 standard errors, and
        # the least part that is taken for unexpected
        variance = wide**2 + err**2
        assert abs(bell.mean - mean) < 4.0 / np.sqrt((1.0 / variance).sum())
        of_spread = 4.0 / np.sqrt((2.0 * wide**2 / variance**2).sum())
        assert abs(bell.sd - wide) < of_spread + 0.05 * wide
        assert bell.contamination < 0.04


def test_outlier_skin_is_identified_without_widening_the_rest(rng):
    count = 2000
    truth, blood = rng.normal(-3.5, 0.15, count), rng.normal(0.4, 0.06, count)
    truth[:200] = rng.uniform(*MELANIN_ENDS, 200).clip(MELANIN[0], MELANIN[-1])
    blood[-160:] = rng.uniform(*BLOOD_ENDS, 160)
    found = fitted(seen(truth, np.full(count, 0.1), blood, np.full(count, 0.03), rng))
    assert abs(found.melanin.mean + 3.5) < 0.03
    assert abs(found.melanin.sd - 0.15) < 0.03
    assert 0.06 < found.melanin.contamination < 0.2
    assert abs(found.blood.mean - 0.4) < 0.01
    assert 0.04 < found.blood.contamination < 0.12


def test_pixels_differing_by_errors_alone_have_least_deviations(rng):
    count = 3000
    found = fitted(
        seen(
            np.full(count, -2.0),
            np.full(count, 0.1),
            np.full(count, 0.4),
            np.full(count, 0.05),
            rng,
        )
    )
    assert MIN_SIGMAS[0] <= found.melanin.sd < 0.04
    assert found.blood.sd == pytest.approx(MIN_SIGMAS[1], rel=1e-3)
    assert found.melanin.contamination == pytest.approx(MIN_CONTAMINATION, abs=0.005)


def test_densities_average_to_unity_even_in_wide_cells():
    for mean in (-3.0, -0.75):
        bell = ContaminatedNormal(mean, 0.02, 0.05, *MELANIN_ENDS, stderr=0.01)
        edges = np.linspace(*MELANIN_ENDS, 101)
        assert bell.cell_densities(edges).mean() == pytest.approx(1.0, rel=1e-6)
        fine = np.linspace(*MELANIN_ENDS, 200_001)
        assert bell.relative_density(fine).mean() == pytest.approx(1.0, rel=1e-3)
        assert bell.relative_density(fine).min() >= 0.05


def test_common_errors_widen_by_root_sum_of_squares():
    def face(melanin, blood):
        return FaceDistribution(
            ContaminatedNormal(melanin, 0.3, 0.01, *MELANIN_ENDS),
            ContaminatedNormal(blood, 0.05, 0.01, *BLOOD_ENDS),
        )

    known = add_systematic_errors(
        face(-3.0, 0.4), [(face(-3.3, 0.4), face(-2.7, 0.4)), (face(-2.6, 0.38), face(-3.4, 0.42))]
    )
    assert known.melanin.stderr == pytest.approx(0.5)
    assert known.blood.stderr == pytest.approx(0.02)
    assert known.melanin.total_sd == pytest.approx(np.hypot(0.3, 0.5))


def test_mean_at_range_end_has_inward_uncertainty():
    """A mean that moves by 0.08 to each side, as far as the end at -0.69 lets it."""

    def face(melanin):
        held = min(melanin, MELANIN_ENDS[1] - 0.01)
        bell = ContaminatedNormal(held, 0.02, 0.01, *MELANIN_ENDS)
        return FaceDistribution(bell, ContaminatedNormal(0.4, 0.05, 0.01, *BLOOD_ENDS))

    for mean in (-1.0, -0.75, -0.70):
        known = add_systematic_errors(face(mean), [(face(mean - 0.08), face(mean + 0.08))])
        assert known.melanin.stderr == pytest.approx(0.08), mean


@pytest.mark.parametrize(("mean", "told"), [(0.055, False), (0.2, True), (0.99, True)])
def test_blood_that_ends_at_none_may_be_any(mean, told):
    """The darkest skin has one color with any blood: its face's ended at a hundredth of it."""
    skin = FaceDistribution(
        ContaminatedNormal(-3.0, 0.3, 0.01, -9.0, -0.7),
        ContaminatedNormal(mean, 0.05, 0.1, 0.04, 1.0),
    )
    known = add_systematic_errors(skin, [(skin, skin)])
    density = known.blood.relative_density(np.array([mean, 0.5]))
    assert (np.ptp(density) > 0.5) == told
    assert known.blood.contamination == (0.1 if told else 1.0)
    assert known.melanin == skin.melanin


def test_invalid_probability_or_bell_is_refused():
    with pytest.raises(ValueError, match="shape"):
        fitted(np.ones((3, 5, 2)))
    with pytest.raises(ValueError, match="probability: got"):
        fitted(np.zeros((3, MELANIN.size, BLOOD.size)))
    with pytest.raises(ValueError, match="sd"):
        ContaminatedNormal(0.0, 0.0, 0.1, -1.0, 1.0)


def test_plane_kernel_sum_matches_plain_numpy(rng):
    pixels, rows, columns, summed = 7, 11, 12, 3
    log_rgb = rng.normal(-1.0, 0.1, (pixels, 3))
    plane = rng.normal(-1.0, 0.1, (rows, columns, 3))
    half = rng.normal(size=(pixels, 3, 3)) * 5.0
    weights = half @ half.transpose(0, 2, 1)
    mean = rng.dirichlet(np.ones(3), pixels)
    prior = rng.uniform(0.0, 4.0, 9)
    found = np.zeros((pixels, rows, columns // summed), np.float32)
    kernels.plane_probability(log_rgb, weights, mean, plane, prior, -0.4, 0.1, summed, found)
    away = log_rgb[:, None, None] - plane
    cost = np.einsum("nijc,ncd,nijd->nij", away, weights, away)
    shading = np.einsum("nijc,nc->nij", away, mean)
    cost += np.interp(shading, -0.4 + 0.1 * np.arange(9), prior)
    density = np.exp(-0.5 * (cost - cost.min(axis=(1, 2), keepdims=True)))
    slow = density.reshape(pixels, rows, columns // summed, summed).sum(axis=3)
    assert np.abs(shading).max() < 0.4
    np.testing.assert_allclose(found, slow, rtol=1e-5, atol=2e-7)
