"""Draw the faults of a simulated day, and those of one run of a host."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from rigsim.boxes.faults import Faults
from skinrig.soaking.storage import DISK_FAULTS, LOST_SYNC

HOST_FAULTS: Final = (
    *("none", "none", "none", "none", "kill", "interrupt", "abort", "second client"),
    *("clock jump", "reset", "power cut", LOST_SYNC, *DISK_FAULTS),
)
"""What may happen in one run of a host: "kill" and "interrupt" strike at a line to the controller,
"abort" is the operator's, "reset" the controller's, "power cut" the host's computer's.
"""
MAX_STRUCK_LINE = 250
MAX_STRUCK_OPERATION = 60
MAX_CLOCK_JUMP_S = 7200.0
WEAK_LED_SHARE = 0.3
"""Days of a rig with an LED that emits less than requested, relative to all."""

DYING_LED_SHARE = 0.5
"""Dead LEDs that have worked before, relative to all."""
MAX_LED_LIFE_S = 7200.0

LATE_FRAME_SHARE = 0.1
"""Days of a rig with late and repeated frames, relative to all."""
MAX_LATE_FRAME_S = 12.0
"""Largest delay, s; hosts wait for a frame for 3 or 5 s beyond its read-out."""


@dataclass(frozen=True, slots=True)
class HostFault:
    """Fault of one run of a host.

    Attributes
    ----------
    kind
        One of `HOST_FAULTS`.
    strike
        Number of the line, of the disk's operation, or of the question whether to stop, from 1.
    jump_s
        Step of the host's clock, s.
    """

    kind: str = "none"
    strike: int = 0
    jump_s: float = 0.0


NO_HOST_FAULT: Final = HostFault()


def draw_host_fault(rng: np.random.Generator) -> HostFault:
    """Draw the fault of one run of a host."""
    kind = str(rng.choice(HOST_FAULTS))
    on_disk = kind in (*DISK_FAULTS, "power cut", LOST_SYNC)
    most = MAX_STRUCK_OPERATION if on_disk else MAX_STRUCK_LINE
    strike = 1 + int(most * rng.random() ** 2)
    jump_s = float(rng.uniform(-MAX_CLOCK_JUMP_S, MAX_CLOCK_JUMP_S))
    return HostFault(kind, strike, jump_s if kind == "clock jump" else 0.0)


def draw_rig_faults(rng: np.random.Generator, lights: int) -> Faults:
    """Draw the faults of line, controllers and cameras for one day of a rig.

    Parameters
    ----------
    rng
        Source of chance.
    lights
        Number of the rig's lights.
    """
    drawn: dict[str, Any] = {"baud": float(rng.choice([0.0, 0.0, 115_200.0]))}
    if rng.random() < 0.3:
        drawn["latency"] = float(rng.choice([0.001, 0.002]))
    rare: dict[str, Any] = {
        "drop": 2e-4,
        "flip": 2e-4,
        "glue": 0.005,
        "cut": 0.005,
        "late": 0.01,
        "lose_answer": 0.02,
        "duplicate": 0.02,
        "babble": 0.02,
        "brownout": 0.002,
        "stale": 0.1,
        "drop_frame": 0.02,
        "wrong_camera": 0.01,
        "wrong_exposure": 0.01,
        "misfire": 0.05,
        "jaw_stall": 0.02,
        "shutter_stuck": 0.02,
        "drift_ppm": float(rng.uniform(-60.0, 60.0)),
        "slow_charge": float(rng.uniform(1.0, 3.0)),
        "slow_judgment": float(rng.uniform(0.0, 0.5)),
        "skin_stiff": float(rng.uniform(0.7, 1.3)),
        "pump_leak": float(rng.uniform(0.0, 0.05)),
        "reset_on_open": True,
        "led_dead": str(rng.integers(lights)),
        "interlock_after": float(rng.uniform(0.0, 86_400.0)),
    }
    shares = {"interlock_after": 0.03, "led_dead": 0.1}
    drawn |= {name: v for name, v in rare.items() if rng.random() < shares.get(name, 0.15)}
    # chance of its own, so that the other faults of a seed stay what they were
    own = rng.spawn(1)[0]
    if own.random() < WEAK_LED_SHARE:
        drawn["led_weak"] = f"{own.integers(lights)}={own.integers(2, 10) / 10}"
    if own.random() < LATE_FRAME_SHARE:
        drawn |= {"late_frame": 0.1, "repeat_frame": 0.1}
        drawn["late_frame_s"] = float(own.uniform(1.0, MAX_LATE_FRAME_S))
    if "led_dead" in drawn and own.random() < DYING_LED_SHARE:
        drawn["led_dead_after"] = float(own.uniform(0.0, MAX_LED_LIFE_S))
    return Faults(**drawn)
