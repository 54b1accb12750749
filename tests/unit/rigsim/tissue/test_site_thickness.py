"""Reflectance of skin with a map of thickness."""

import dataclasses

import numpy as np
import pytest

from rigsim.light.observed_skin import ObservedSkin
from rigsim.population.files import load_subject
from rigsim.tissue.site_thickness import interpolate_thickness
from rigsim.tissue.skin_layers import TYPICAL_SKIN
from rigsim.tissue.skin_table import SkinTable

RATIOS = np.array([0.83, 0.94, 1.0, 1.07, 1.19])


@pytest.mark.parametrize(("c_m", "bound"), [(0.01, 3e-4), (0.04, 6e-4), (0.23, 1.5e-3)])
def test_interpolated_thickness_agrees_with_its_own_table(c_m, bound):
    blood = np.full(len(RATIOS), 0.013)
    found = interpolate_thickness(
        TYPICAL_SKIN,
        RATIOS,
        lambda tissue: SkinTable.load(tissue).spectra(np.full(len(RATIOS), c_m), blood),
    )
    direct = [
        SkinTable.load(TYPICAL_SKIN.with_thickness_ratio(ratio)).spectra(c_m, 0.013)
        for ratio in RATIOS
    ]
    np.testing.assert_allclose(found, direct, rtol=bound)
    even = SkinTable.load(TYPICAL_SKIN).spectra(c_m, 0.013)
    assert np.abs(even / direct[0] - 1.0).max() > 20.0 * bound


def test_even_thickness_is_evaluated_once():
    calls = []

    def evaluate(tissue):
        calls.append(tissue)
        return np.ones((3, 2))

    assert (interpolate_thickness(TYPICAL_SKIN, np.ones(3), evaluate) == 1.0).all()
    assert calls == [TYPICAL_SKIN]


@pytest.fixture(scope="module")
def skin():
    """Return a face with drawn thickness."""
    face = load_subject("IV").face(seed=2, size=96)
    return ObservedSkin(face, "neutral", "Nikon 5100 (NPL)", "D55")


def test_fractions_of_own_color_are_own_fractions(skin):
    covered = skin.subject.atlas.covered
    melanin, blood = skin.fractions_of(skin.reflectance())
    np.testing.assert_allclose(melanin[covered], skin.subject.melanin[covered], rtol=2e-3)
    np.testing.assert_allclose(blood[covered], skin.blood_volume_fraction[covered], rtol=2e-2)


def test_reflectance_is_that_of_the_sites(skin):
    """The forehead is thicker than the lids, so that it is brighter than in an even face."""
    even = dataclasses.replace(skin.subject.tissue, site_contrast=0.0)
    flat = dataclasses.replace(skin, subject=dataclasses.replace(skin.subject, tissue=even))
    change = (skin.reflectance() / flat.reflectance())[..., 2]
    regions = skin.subject.perfusion.regions
    assert change[regions["forehead"] > 0.9].min() > 1.005
    assert change[regions["lids"] > 0.9].max() < 0.99
