"""The boxes of a rig, made as its drawing says, with what is wrong with them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from capture.rig import Rig
from rigsim.boxes.caliper import CaliperUnit
from rigsim.boxes.controller import Controller
from rigsim.boxes.device import Device
from rigsim.boxes.dome import DomeUnit
from rigsim.boxes.faults import Faults
from rigsim.boxes.flash import FlashUnit
from rigsim.boxes.gradient_sphere import GradientSphereUnit
from rigsim.boxes.probe import ProbeUnit
from rigsim.world.light_record import LightRecord
from rigsim.world.suction import SuckedHead
from rigsim.world.taped_skin import TapedSkin

SERIAL_NUMBERS: Final = {
    "flash": "FL-0001",
    "dome": "DM-0001",
    "gradient_sphere": "GS-0001",
    "caliper": "CA-0001",
    "probe": "PR-0001",
}
RIG_OF_BOX: Final = {
    "flash": "flash",
    "dome": "dome",
    "gradient_sphere": "gradient",
    "caliper": "gradient",
    "probe": "probe",
}
"""Which rig that ships has a box."""


@dataclass(frozen=True, slots=True)
class Wiring:
    """What a rig's boxes are wired to."""

    rig: Rig
    faults: Faults
    light: LightRecord
    """Where their light goes."""
    trigger: Callable[..., None]
    """Pulses the cameras' lines: at a world time in s, those of a mask's bits or all."""
    note_grip: Callable[[float], None]
    """Called when the caliper's grip may have changed, at a world time in s."""
    skin: TapedSkin | None
    """What the caliper acts upon; None where the rig has none."""
    head: SuckedHead | None
    """The contact probe's head; None where the rig has none."""


def make_box(name: str, wiring: Wiring, *, rng: np.random.Generator) -> Controller:
    """Return a box of the rig.

    Parameters
    ----------
    name
        Which: one of `SERIAL_NUMBERS`.
    wiring
        What it is wired to.
    rng
        Its chance, for as long as it lives.

    Raises
    ------
    ValueError
        Unknown name, or the rig does not describe what the box moves.
    """
    if name not in SERIAL_NUMBERS:
        raise ValueError(f"boxes: got {name!r}, expected one of {', '.join(SERIAL_NUMBERS)}")
    faults = wiring.faults
    return Controller(
        _make_unit(name, wiring, rng),
        serial=faults.serial or SERIAL_NUMBERS[name],
        protocol=faults.protocol,
        rng=rng,
    )


def _make_unit(name: str, wiring: Wiring, rng: np.random.Generator) -> Device:
    rig, faults, light, trigger = wiring.rig, wiring.faults, wiring.light, wiring.trigger
    if name == "flash":
        return FlashUnit(rig, faults, on_pop=light.pops.append, on_trigger=trigger, rng=rng)
    if name == "dome":
        dome = DomeUnit(rig, faults, on_pulse=light.pulses.append, on_trigger=trigger)
        light.pulses_now = dome.light_now
        return dome
    if name == "gradient_sphere":
        sphere = GradientSphereUnit(
            rig, faults, on_pattern=light.patterns.append, on_trigger=trigger
        )
        light.patterns_now = sphere.light_now
        return sphere
    if name == "caliper":
        return CaliperUnit(rig, wiring.skin, faults, on_change=wiring.note_grip, rng=rng)
    probe = ProbeUnit(
        rig, wiring.head, faults, on_light=light.sources.append, on_trigger=trigger, rng=rng
    )
    light.sources_now = probe.light_now
    return probe
