"""Maps without a truth: their own errors, and no claim beyond them."""

import numpy as np

from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig.reporting import page, verdict


def maps(**extra):
    melanin = np.full((20, 30), 0.01)
    melanin[:, 15:] = 0.15
    stderr = np.where(melanin > 0.1, 0.03, 0.0005)
    return SkinAppearance(
        {"melanin": SkinMap(melanin, MAP_UNITS["melanin"], stderr), **extra}, "measured"
    )


def test_standard_errors_are_reported_by_estimated_band():
    body = page.render_fragment(verdict.build_uncertainty_blocks(maps()))
    assert '<td class="k">melanin 0–0.02</td><td class="n">300</td><td class="n">5</td>' in body
    assert '<td class="k">melanin 0.1–0.2</td><td class="n">300</td><td class="n">20</td>' in body


def test_coverage_is_not_claimed_and_residuals_are_reported():
    residual = SkinMap(np.full((20, 30), 0.25), "1")
    body = page.render_fragment(verdict.build_uncertainty_blocks(maps(residual=residual)))
    assert "errors and coverage are unknown" in body
    assert "coverage, %" not in body
    assert "Residuals of the models" in body
    assert '<th scope="row" class="k">residual</th>' in body


def test_pixels_without_a_value_are_counted():
    valid = np.zeros((20, 30), bool)
    valid[:5] = True
    one = SkinMap(np.ones((20, 30)), "mm", np.full((20, 30), 0.1), valid)
    body = page.render_fragment(
        verdict.build_uncertainty_blocks(SkinAppearance({"thickness": one}, "measured"))
    )
    assert '<td class="n">25</td>' in body


def test_maps_without_errors_report_no_numbers():
    picture = SkinMap(np.ones((4, 4, 3)), "1")
    body = page.render_fragment(
        verdict.build_uncertainty_blocks(SkinAppearance({"image": picture}, "measured"))
    )
    assert "<table" not in body
