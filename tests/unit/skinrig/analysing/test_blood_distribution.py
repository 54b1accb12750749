"""The test of near-Gaussian blood accepts Gaussian regions and rejects others, by sample size."""

import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.stats import kstest

from model import store
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig.analysing.blood import anderson_darling, describe_distribution
from skinrig.cli import main


def test_p_values_of_gaussian_samples_are_uniform():
    rng = np.random.default_rng(1)
    p = [anderson_darling(rng.standard_normal(200))[1] for _ in range(400)]
    assert kstest(p, "uniform").pvalue > 0.01


def test_p_value_of_skewed_values_falls_with_pixels():
    rng = np.random.default_rng(2)
    p = [anderson_darling(rng.gamma(20.0, size=n))[1] for n in (20, 200, 2000, 20_000)]
    assert p[0] > 0.05
    assert p[-1] < p[-2] < 1e-6


def _region(image):
    return describe_distribution("cheek", image, np.ones(image.shape, np.bool_))


def test_correlated_gaussian_region_passes_with_spaced_pixels():
    rng = np.random.default_rng(3)
    drawn = [_region(gaussian_filter(rng.standard_normal((96, 96)), 2.0)) for _ in range(20)]
    # pixels within 2 sd of a blur by sigma have an area of correlation of 4 pi sigma^2 = 50
    assert 30 < np.median([96**2 / one.independent for one in drawn]) < 80
    assert np.mean([one.p_value < 0.05 for one in drawn]) > 0.5
    assert np.mean([one.spaced_p_value < 0.05 for one in drawn]) < 0.2


def test_bimodal_region_is_rejected_with_independent_pixels():
    rng = np.random.default_rng(4)
    found = _region(np.where(rng.random((40, 40)) < 0.5, -2.0, 2.0) + rng.standard_normal((40, 40)))
    assert found.independent > 1000
    assert found.distance > 0.05
    assert found.spaced_p_value < 1e-6
    assert found.rejected_from < 200


def test_analyse_blood_writes_figure_and_regions(tmp_path, capsys):
    rng = np.random.default_rng(5)
    shape = (64, 64)
    blood = np.float32(0.03 + 0.003 * rng.standard_normal(shape))
    maps = {
        "hemoglobin": SkinMap(
            blood, MAP_UNITS["hemoglobin"], None, np.ones(shape, np.bool_), "drawn"
        )
    }
    marks = {"forehead": [32.0, 10.0], "nose tip": [32.0, 32.0], "chin": [32.0, 56.0]}
    store.write(tmp_path / "a", SkinAppearance(maps, "simulated", {"landmarks_px": marks}))
    argv = ["analyse", "blood", str(tmp_path / "a"), "--out", str(tmp_path / "b")]
    assert main([*argv, "--radius", "8", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [row["region"] for row in document["regions"]] == ["forehead", "nose", "chin"]
    assert all(row["p_value"] > 1e-3 for row in document["regions"])
    assert document["fraction_of_discs"]["within_1_sd"] == pytest.approx(0.683, abs=0.03)
    names = ["analysis.json", "figure-7.png", "regions.csv"]
    assert sorted(path.name for path in (tmp_path / "b").iterdir()) == names
    assert main([*argv, "--radius", "1.5"]) == 0
    assert main([*argv, "--radius", "0"]) == 3
