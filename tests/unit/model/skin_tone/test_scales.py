import numpy as np
import pytest

from capture.calibration.color.colorimetry import delta_e_2000
from model import skin_tone

MONK_LAB = (
    (94.211, 1.503, 5.422),
    (92.275, 2.061, 7.28),
    (93.091, 0.216, 14.205),
    (87.573, 0.459, 17.748),
    (77.902, 3.471, 23.136),
    (55.142, 7.783, 26.74),
    (42.47, 12.325, 20.53),
    (30.678, 11.667, 13.335),
    (21.069, 2.69, 5.964),
    (14.61, 1.482, 3.525),
)
"""CIE Lab of the ten tones as their author publishes it (skintone.google)."""


def test_angle_follows_the_definition():
    lab = np.array([[65.0, 9.0, 15.0], [50.0, 9.0, 15.0], [40.0, 9.0, 10.0]])
    expected = np.degrees(np.arctan((lab[:, 0] - 50.0) / lab[:, 2]))
    np.testing.assert_allclose(skin_tone.ita(lab), expected)


@pytest.mark.parametrize("lab", [(69.0, 6.0, 12.0), (52.0, 10.0, 18.0), (36.0, 9.0, 12.0)])
def test_angle_stderr_equals_the_scatter(lab):
    rng = np.random.default_rng(5)
    covariance = np.array([[0.25, 0.05, 0.1], [0.05, 0.2, 0.0], [0.1, 0.0, 0.3]])
    draws = rng.multivariate_normal(lab, covariance, 40_000)
    found = float(skin_tone.ita_stderr(lab, covariance))
    scatter = float(np.std(skin_tone.ita(draws)))
    assert found == pytest.approx(scatter, rel=0.03)
    without = float(skin_tone.ita_stderr(lab, np.diag(np.diagonal(covariance))))
    assert without != pytest.approx(scatter, rel=0.03) or abs(lab[0] - 50.0) < 5.0


def test_angle_without_information_has_bounded_stderr():
    found = skin_tone.ita_stderr([50.0, 0.0, 0.0], np.eye(3))
    assert float(found) == pytest.approx(360.0 / np.sqrt(12.0))


def test_bands_split_at_the_published_edges():
    inside = [70.0, 48.0, 35.0, 19.0, -10.0, -50.0]
    assert skin_tone.ita_band(inside).tolist() == [1, 2, 3, 4, 5, 6]
    assert skin_tone.ita_band(skin_tone.ITA_EDGES_DEG).tolist() == [2, 3, 4, 5, 6]
    assert skin_tone.ita_band([[np.nan, 70.0]]).tolist() == [[0, 1]]


def test_monk_colors_equal_the_published_ones():
    # published from unrounded whites: within 0.02
    np.testing.assert_allclose(skin_tone.monk_colors(), MONK_LAB, atol=0.02)


def test_monk_finds_each_reference_and_missing_pixels():
    image = skin_tone.monk_colors().reshape(2, 5, 3) + 0.3
    image[1, 4] = np.nan
    found = skin_tone.monk(image, delta_e_2000)
    assert found.tolist() == [[1, 2, 3, 4, 5], [6, 7, 8, 9, 0]]


def test_monk_uses_the_difference_it_is_given():
    color = [[66.0, 9.0, 18.0]]
    assert skin_tone.monk(color, delta_e_2000).tolist() == [6]
    lightest = skin_tone.monk(color, lambda a, b: -b[:, 0])
    assert lightest.tolist() == [1]
