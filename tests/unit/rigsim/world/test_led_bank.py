"""The bank of LEDs: its stored deadline is that of its light and heat."""

import numpy as np

from capture.rig import load_rig
from rigsim.boxes.faults import NO_FAULTS
from rigsim.boxes.led_bank import LedBank


def test_stored_deadline_follows_light_and_heat(rng):
    """Random light of eight LEDs: what `deadline` stored is what it would find, at each step."""
    bank = LedBank(load_rig("dome"), NO_FAULTS, lambda pulse: None)
    now_us = 0
    for _ in range(2000):
        led, now_us = int(rng.integers(8)), now_us + int(rng.choice([0, 1, 777, 5_000, 200_000]))
        now = now_us / 1e6
        step = rng.integers(8)
        if step < 5:
            bank.advance(now)
        elif step == 5:
            bank.switch_off(led, now)
        else:
            level = float(rng.choice([0.2, 0.9, 1.0]))
            bank.switch_on(led, level, now, end_s=now + float(rng.choice([0.01, 0.3, np.inf])))
        assert bank.deadline() == bank._find_due()
