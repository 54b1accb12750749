"""Errors of fused maps: own and common ones apart, and those of filled texels."""

import numpy as np
import pytest

from model.skin import SkinAppearance, SkinMap
from skinrig.evaluating.fusion import compare_filled, compare_fused

SIDE = 60
OWN, COMMON = 0.02, 0.05
"""Relative standard errors of a texel alone, and common to the face."""


def appearances(rng, *, common_sigmas=1.5, gap=None):
    """Return a fusion with a common error of some standard errors, a dome and the ground truth."""
    x, y = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    position = SkinMap(np.stack([x, y, 0 * x], axis=-1).astype(float), "mm")
    true = 0.3 * np.exp(0.1 * rng.standard_normal((SIDE, SIDE, 3)))
    off = COMMON * common_sigmas + OWN * rng.standard_normal(true.shape)
    values = true * np.exp(off)
    maps = {
        "position": position,
        "r_d": SkinMap(values, "1", np.hypot(OWN, COMMON) * values),
        "r_d_texel_stderr": SkinMap(OWN * values, "1"),
    }
    if gap is not None:
        maps["r_d_measured"] = SkinMap((~gap).astype(float), "1")
    dome = {"position": position, "r_d": SkinMap(1.1 * true, "1", 0.05 * true)}
    truth = {"position": position, "r_d": SkinMap(true, "1")}
    return [SkinAppearance(one, "simulated") for one in (maps, dome, truth)]


@pytest.mark.parametrize("common_sigmas", [0.0, -2.0])
def test_compare_fused_parts_own_and_common_errors(rng, common_sigmas):
    fused, dome, truth = appearances(rng, common_sigmas=common_sigmas)
    rows = compare_fused(fused, {"dome": dome}, {"dome": truth}, None)
    assert [row.quantity for row in rows] == ["r_d red", "r_d green", "r_d blue"]
    for row in rows:
        assert row.own_coverage == pytest.approx(0.683, abs=0.03)
        assert row.common_sigmas == pytest.approx(common_sigmas, abs=0.05)
        assert row.single == pytest.approx(np.log(1.1))


def test_compare_filled_counts_filled_texels_alone(rng):
    gap = np.zeros((SIDE, SIDE), bool)
    gap[:10] = True
    fused, _, truth = appearances(rng, common_sigmas=0.0, gap=gap)
    fused.maps["r_d"].values[gap] *= 1.5
    for row in compare_filled(fused, {"dome": truth}):
        assert (row.texels, row.share) == (10 * SIDE, pytest.approx(1 / 6))
        assert row.error == pytest.approx(np.log(1.5), abs=0.01)
        assert row.coverage == 0.0
    assert not compare_filled(appearances(rng)[0], {"dome": truth})
