"""The boxes of a rig, made as its drawing says, with what is wrong with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from capture.rig import LedLimits, Rig
from rigsim.boxes.caliper import CaliperUnit
from rigsim.boxes.controller import Controller, Device
from rigsim.boxes.dome import DomeUnit
from rigsim.boxes.flash import FlashUnit
from rigsim.boxes.gradient_sphere import GradientSphereUnit
from rigsim.boxes.probe import ProbeUnit
from rigsim.world.faults import Faults
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
    if name not in _BOX_MAKERS:
        raise ValueError(f"boxes: got {name!r}, expected one of {', '.join(_BOX_MAKERS)}")
    return Controller(
        _BOX_MAKERS[name](wiring, rng),
        serial=wiring.faults.serial or SERIAL_NUMBERS[name],
        protocol=wiring.faults.protocol,
        rng=rng,
    )


def _flash(wiring: Wiring, rng: np.random.Generator) -> Device:
    rig, faults = wiring.rig, wiring.faults
    return FlashUnit(
        on_pop=wiring.light.pops.append,
        on_trigger=wiring.trigger,
        recycle_s=rig.recycle_s,
        pops_per_min=rig.max_pops_per_min,
        move_s=rig.polarizer_move_s,
        misfire=faults.misfire,
        slow_charge=faults.slow_charge,
        lamp_dead=faults.lamp_dead,
        heat=faults.heat,
        interlock=faults.interlock,
        rng=rng,
    )


def _dome(wiring: Wiring, rng: np.random.Generator) -> Device:
    rig, faults = wiring.rig, wiring.faults
    unit = DomeUnit(
        rig.lights,
        rig.leds or LedLimits(),
        cameras=len(rig.views),
        on_pulse=wiring.light.pulses.append,
        on_trigger=wiring.trigger,
        dead=faults.dead_leds,
        weak=faults.weak_leds,
        heat=faults.heat,
        interlock=faults.interlock,
    )
    wiring.light.pulses_now = unit.light_now
    return unit


def _gradient_sphere(wiring: Wiring, rng: np.random.Generator) -> Device:
    rig, faults = wiring.rig, wiring.faults
    unit = GradientSphereUnit(
        rig.lights,
        rig.leds or LedLimits(),
        cameras=len(rig.views),
        move_s=rig.polarizer_move_s,
        on_pattern=wiring.light.patterns.append,
        on_trigger=wiring.trigger,
        dead=faults.dead_leds,
        weak=faults.weak_leds,
        heat=faults.heat,
        interlock=faults.interlock,
    )
    wiring.light.patterns_now = unit.light_now
    return unit


def _caliper(wiring: Wiring, rng: np.random.Generator) -> Device:
    rig, faults = wiring.rig, wiring.faults
    if rig.caliper is None or wiring.skin is None:
        raise ValueError(f"caliper: got none in rig {rig.name!r}, expected its description")
    return CaliperUnit(
        rig.caliper,
        wiring.skin,
        on_change=wiring.note_grip,
        stall=faults.jaw_stall,
        home_missed=faults.home_missed,
        sensor_dead=faults.force_dead,
        interlock=faults.interlock,
        interlock_after=faults.interlock_after,
        rng=rng,
    )


def _probe(wiring: Wiring, rng: np.random.Generator) -> Device:
    rig, faults = wiring.rig, wiring.faults
    if rig.probe is None or wiring.head is None:
        raise ValueError(f"probe: got none in rig {rig.name!r}, expected its description")
    unit = ProbeUnit(
        rig.probe,
        rig.lights[0],
        rig.leds or LedLimits(),
        wiring.head,
        on_light=wiring.light.sources.append,
        on_trigger=wiring.trigger,
        shutter_stuck=faults.shutter_stuck,
        shutter_jam=faults.shutter_jam,
        gauge_dead_after=faults.gauge_dead_after,
        interlock=faults.interlock,
        interlock_after=faults.interlock_after,
        dead=0 in faults.dead_leds,
        weak=faults.weak_leds.get(0, 1.0),
        rng=rng,
    )
    wiring.light.sources_now = unit.light_now
    return unit


_BOX_MAKERS: Final[dict[str, Callable[[Wiring, np.random.Generator], Device]]] = {
    "flash": _flash,
    "dome": _dome,
    "gradient_sphere": _gradient_sphere,
    "caliper": _caliper,
    "probe": _probe,
}
