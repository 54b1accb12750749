"""The report's table of kernels: what was fitted, and how surely."""

import json
import re

import pytest

from model.skin import SkinAppearance
from reconstruction.pipeline.gradient.stages import KERNEL_FILE
from skinrig.reporting import page
from skinrig.reporting.sections import microrelief

FIT = {
    "name": "a000_m1",
    "angle_deg": 0.0,
    "stretch_s": 0.9,
    "alpha": -0.17,
    "alpha_stderr": 0.12,
    "alpha_95": 0.69,
    "sigma_um": 41.5,
    "sigma_stderr_um": 19.5,
    "sigma_95_um": 38.2,
    "distance": 0.06,
    "distance_before": 0.3,
    "noise_floor": 0.1,
    "near_best_count": 439,
    "valid": True,
}


def table_of(fit):
    text = json.dumps({"fits": [fit], "tables": []}).encode()
    appearance = SkinAppearance({}, "simulated", files={KERNEL_FILE: text})
    html = page.render_fragment(
        microrelief.draw_kernels(page.ReportedAppearance("gradient", appearance, None, []))
    )
    head = re.findall(r"<th scope=\"col\"[^>]*>(.*?)</th>", html)
    cells = re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", html.split("<tbody>")[1])
    return list(zip(head, cells, strict=False))


def test_kernels_are_reported_with_stderr_and_half_widths():
    assert table_of(FIT)[2:8] == [
        ("alpha", "-0.17"),
        ("standard uncertainty", "0.12"),
        ("95 % half-width", "0.69"),
        ("sigma, um", "41.5"),
        ("standard uncertainty, um", "19.5"),
        ("95 % half-width, um", "38.2"),
    ]


@pytest.mark.parametrize("missing", ["alpha_95", "sigma_95_um"])
def test_kernels_fitted_without_half_widths_show_dash(missing):
    row = table_of({key: value for key, value in FIT.items() if key != missing})
    assert row[4 if missing == "alpha_95" else 7][1] == "–"
