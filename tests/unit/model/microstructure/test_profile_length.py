"""Lengths of stretched and compressed profiles, and kernels that keep them (Nagano2015 fig. 4)."""

import numpy as np
import pytest
from scipy.special import ellipe

from model import microstructure
from model.microstructure import profile_length
from model.microstructure.profile_length import SurfaceProfileError
from rigsim.skin_patch.microrelief import make_micro_skin

SPACING_UM = 5.0


@pytest.fixture(scope="module")
def profiles():
    """Three-millimetre sections of forearm-like skin, across its furrows."""
    skin = make_micro_skin("chin", seed=2, size_mm=3.0, texel_um=SPACING_UM)
    return skin.height_um[:, ::150].T.astype(np.float64)


def test_sine_length_is_its_elliptic_integral():
    """Arc length of a sin(k x) over a period: 4 sqrt(1 + a^2 k^2) E(m) / k, m = a^2 k^2 over 1 +
    a^2 k^2. The polygon is shorter by the square of the spacing: 1e-5 at 2,000 points."""
    amplitude, k = 30.0, 2 * np.pi / 400.0
    x = np.linspace(0.0, 400.0, 2001)
    found = profile_length.surface_length(amplitude * np.sin(k * x), spacing_um=0.2)
    m = (amplitude * k) ** 2
    assert found == pytest.approx(4 * np.sqrt(1 + m) * ellipe(m / (1 + m)) / k, rel=1e-5)


def test_leading_profile_axes_are_independent_profiles(profiles):
    together = profile_length.surface_length(profiles, spacing_um=SPACING_UM)
    alone = [profile_length.surface_length(p, spacing_um=SPACING_UM) for p in profiles]
    np.testing.assert_allclose(together, alone, rtol=1e-13)


def test_unchanged_heights_shorten_compressed_and_lengthen_stretched(profiles):
    """The surface changes less than the ground below it: relief is a reserve."""
    for profile in profiles:
        for stretch in (0.75, 1.35):
            ratio = profile_length.length_change(
                profile, spacing_um=SPACING_UM, stretch=stretch, alpha=0.0, sigma_um=10.0
            ).unchanged_ratio
            assert min(1.0, stretch) < ratio < max(1.0, stretch)


def reserve_of(profile):
    ground_um = (profile.size - 1) * SPACING_UM
    return profile_length.surface_length(profile, spacing_um=SPACING_UM) / ground_um


@pytest.mark.parametrize("used", [-8.0, -4.0, -1.0, 0.2, 0.5])
def test_a_kernel_is_found_that_keeps_the_length(profiles, used):
    """It sharpens under compression and smooths under stretch, here by half of the reserve."""
    for profile in profiles:
        stretch = 1.0 + used * (reserve_of(profile) - 1.0)
        found = profile_length.find_length_preserving_kernel(
            profile, spacing_um=SPACING_UM, stretch=stretch, sigma_um=60.0
        )
        assert found.is_preserved
        assert found.change.convolved_um == pytest.approx(found.change.neutral_um, rel=1e-10)
        assert abs(found.change.unchanged_ratio - 1.0) > 1e-4
        assert (found.change.alpha < 0) == (stretch < 1)


def test_stronger_strain_needs_stronger_kernels(profiles):
    alphas = [
        profile_length.find_length_preserving_kernel(
            profiles[0], spacing_um=SPACING_UM, stretch=r, sigma_um=25.0
        ).change.alpha
        for r in (0.7, 0.8, 0.9, 1.0, 1.01, 1.02)
    ]
    assert (np.diff(alphas) > 0).all()
    assert alphas[3] == 0.0


def test_stretch_beyond_reserve_is_reported(profiles):
    """No surface is shorter than the ground it stands on."""
    profile = profiles[0]
    stretch = 1.05 * reserve_of(profile)
    found = profile_length.find_length_preserving_kernel(
        profile, spacing_um=SPACING_UM, stretch=stretch, sigma_um=25.0
    )
    assert not found.is_preserved
    assert 1.0 < found.change.convolved_ratio < found.change.unchanged_ratio


def test_a_flat_profile_has_no_reserve():
    for stretch in (0.8, 1.2):
        found = profile_length.find_length_preserving_kernel(
            np.full(50, 3.0), spacing_um=1.0, stretch=stretch, sigma_um=5.0
        )
        assert not found.is_preserved
        assert found.change.alpha == 0.0
        assert found.change.convolved_ratio == pytest.approx(stretch)


def test_strength_beyond_kernel_range_is_reported(profiles):
    weak = profile_length.find_length_preserving_kernel(
        profiles[0], spacing_um=SPACING_UM, stretch=0.6, sigma_um=SPACING_UM
    )
    strong = profile_length.find_length_preserving_kernel(
        profiles[0], spacing_um=SPACING_UM, stretch=0.97, sigma_um=60.0
    )
    assert weak.is_preserved
    assert not weak.within_limits
    assert strong.within_limits


@pytest.mark.parametrize("stretch", [0.75, 0.85, 1.15, 1.25])
def test_the_papers_kernels_bring_lengths_nearer_to_neutral(profiles, stretch):
    """They were fitted to slopes, not to lengths, yet go the way of fig. 4."""
    alpha, sigma_um = microstructure.kernel_parameters(stretch)
    for profile in profiles:
        change = profile_length.length_change(
            profile,
            spacing_um=SPACING_UM,
            stretch=stretch,
            alpha=float(alpha),
            sigma_um=float(sigma_um),
        )
        assert abs(change.convolved_ratio - 1.0) < abs(change.unchanged_ratio - 1.0)


def test_kernel_is_plain_sum_of_eq_6(rng):
    height = rng.standard_normal(60)
    half = microstructure.gaussian_weights(2.0)
    padded = np.pad(height, half.size - 1, mode="symmetric")
    blurred = np.convolve(padded, np.concatenate([half[:0:-1], half]), mode="valid")
    found = profile_length.convolve_profile(height, -0.7, 8.0, spacing_um=4.0)
    np.testing.assert_allclose(found, 1.7 * height - 0.7 * blurred, atol=1e-13)


WAVE = np.sin(np.arange(50.0))


@pytest.mark.parametrize(
    ("height", "changes", "message"),
    [
        (WAVE[:1], {}, "heights of height_um: got"),
        (np.append(WAVE, np.nan), {}, "finite"),
        (WAVE.reshape(5, 10), {}, r"expected \(N,\)"),
        (WAVE, {"spacing_um": 0.0}, "spacing_um"),
        (WAVE, {"stretch": -1.0}, "stretch"),
        (WAVE, {"sigma_um": 0.0}, "sigma_um"),
    ],
)
def test_invalid_profile_length_input_is_refused_by_name(height, changes, message):
    given = {"spacing_um": 1.0, "stretch": 1.1, "sigma_um": 2.0, **changes}
    with pytest.raises(SurfaceProfileError, match=message):
        profile_length.find_length_preserving_kernel(height, **given)
