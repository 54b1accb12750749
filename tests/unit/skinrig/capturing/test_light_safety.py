"""Figures of the LEDs' light, as tables tell them."""

import re

import pytest

from capture.plan.dome import dome_plan
from capture.plan.gradient import gradient_plan
from capture.plan.probe import probe_plan
from capture.rig import load_rig
from skinrig.capturing.light_safety import light_figures, light_rows


@pytest.mark.parametrize(
    ("name", "plan_of"), [("dome", dome_plan), ("gradient", gradient_plan), ("probe", probe_plan)]
)
def test_every_figure_is_described_with_percent(name, plan_of):
    rig = load_rig(name)
    figures = light_figures(plan_of(rig), rig)
    rows = light_rows(figures)
    assert len(rows) == len(figures) >= 6
    assert not [words for words, _ in rows if re.search(r"[a-z]_[a-z]", words)]
    told = dict(rows)
    assert told["energy from that LED, Ws"] == figures["led_ws"]
    if "blue_share" in figures:
        share = "fraction of the blue-light limit, staring into that LED, %"
        assert told[share] == 100 * figures["blue_share"]
