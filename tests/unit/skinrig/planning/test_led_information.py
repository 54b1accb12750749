"""Cramer-Rao bounds of LEDs: more light or LEDs never lose, colors alone leave the prior."""

from dataclasses import replace

import numpy as np
import pytest

from capture.plan import flash_plan
from capture.plan.led_bands import parse_bands
from capture.rig import load_rig
from reconstruction.narrow_bands.band_fit import OXYGENATION_SD
from skinrig.planning.led_information import SKIN_TYPES, assess_leds, format_information

LEDS = parse_bands("450,580,600")


@pytest.fixture(scope="module")
def rig():
    return load_rig("flash")


def stderr(rows, person, leds, name="oxygenation"):
    return next(r.stderr[name] for r in rows if (r.person, r.leds) == (person, leds))


def test_each_led_lowers_every_bound(rig):
    rows = assess_leds(rig, flash_plan(rig, leds=LEDS), LEDS)
    for person in SKIN_TYPES:
        sets = [(), LEDS[:1], LEDS[:2], LEDS]
        for name in rows[0].stderr:
            series = [stderr(rows, person, leds, name) for leds in sets]
            assert (np.diff(series) < 1e-12).all()


def test_oxygenation_is_determined_by_leds_only(rig):
    rows = assess_leds(rig, flash_plan(rig, leds=LEDS), LEDS)
    for person in ("light", "medium"):
        assert stderr(rows, person, ()) > 0.99 * OXYGENATION_SD
        assert stderr(rows, person, LEDS) < 0.6 * OXYGENATION_SD
        (row,) = (r for r in rows if (r.person, r.leds) == (person, LEDS))
        assert "oxygenation" in row.determined
    assert stderr(rows, "dark", LEDS) > stderr(rows, "light", LEDS)


def test_dim_flashes_raise_bounds(rig):
    plan = flash_plan(rig, leds=LEDS)
    dim = flash_plan(rig, leds=LEDS, power=1.0 / 256.0)
    bright, dark = (assess_leds(rig, one, LEDS) for one in (plan, dim))
    for person in SKIN_TYPES:
        assert stderr(dark, person, LEDS) > stderr(bright, person, LEDS)


def test_plan_without_frame_of_led_is_refused(rig):
    plan = flash_plan(rig, leds=LEDS)
    steps = tuple(s for s in plan.steps if s.index.get("light") != LEDS[1])
    with pytest.raises(ValueError, match="no crossed frame under LED-580-20"):
        assess_leds(rig, replace(plan, steps=steps), LEDS)


def test_table_has_row_per_person_and_led_set(rig):
    rows = assess_leds(rig, flash_plan(rig, leds=LEDS), LEDS)
    lines = format_information(rows)
    assert len(lines) == len(SKIN_TYPES) * (1 + 1 + 3 + 2) + 1
    assert sum("450:20, 580:20, 600:20" in line for line in lines) == len(SKIN_TYPES)
