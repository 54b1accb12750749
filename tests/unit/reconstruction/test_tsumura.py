import numpy as np
import pytest

from model import color_table
from model.tissue_optics import ANISOTROPY_SKIN
from reconstruction.tsumura import UnmixingError, tsumura_ica


@pytest.fixture
def skin(rng):
    """Skin with independent pigments, patchy, under uneven light."""
    shape = (60, 80)
    melanin = 0.03 * np.exp(0.5 * rng.laplace(size=shape))
    hemoglobin = 0.03 * np.exp(0.4 * rng.laplace(size=shape))
    table = color_table.build("Nikon 5100 (NPL)", "D55", anisotropy=ANISOTROPY_SKIN)
    light = rng.uniform(0.2, 1.0, shape)
    color = table.lookup(np.clip(melanin, 0, 0.4), np.clip(hemoglobin, 0, 0.3))
    return melanin, hemoglobin, color * light[..., None]


def test_each_map_follows_its_own_pigment_and_not_the_other(skin):
    melanin, hemoglobin, rgb = skin
    found = tsumura_ica(rgb, np.ones(rgb.shape[:2], bool))

    def agreement(a, b):
        return np.corrcoef(np.log(a).ravel(), b.ravel())[0, 1]

    # the unmixing is linear and skin is not, so that some of the other pigment stays in
    for own, other, unmixed in (
        (melanin, hemoglobin, found.melanin),
        (hemoglobin, melanin, found.hemoglobin),
    ):
        assert agreement(own, unmixed) > 2 * abs(agreement(other, unmixed))
        assert agreement(own, unmixed) > 0.5


def test_brightness_does_not_matter(skin, rng):
    _, _, rgb = skin
    whole = np.ones(rgb.shape[:2], bool)
    first = tsumura_ica(rgb, whole)
    second = tsumura_ica(rgb * rng.uniform(0.5, 2.0, rgb.shape[:2])[..., None], whole)
    np.testing.assert_allclose(first.melanin, second.melanin, atol=1e-6)


def test_masked_pixels_stay_out(skin):
    _, _, rgb = skin
    rgb = rgb.copy()
    rgb[:5] = np.nan
    rgb[5, 5] = 0.0
    found = tsumura_ica(rgb, np.ones(rgb.shape[:2], bool))
    assert not found.valid[:5].any()
    assert not found.valid[5, 5]
    assert np.isfinite(found.melanin).all()


@pytest.mark.parametrize("rgb", [np.full((20, 20, 3), 0.5), np.zeros((20, 20, 3))])
def test_colors_without_two_components_are_refused(rgb):
    with pytest.raises(UnmixingError):
        tsumura_ica(rgb, np.ones((20, 20), bool))
