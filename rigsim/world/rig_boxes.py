"""The boxes of a rig, made as its drawing says, with what is wrong with them."""

from collections.abc import Callable
from typing import Final

from rigsim.boxes.caliper import CaliperUnit
from rigsim.boxes.controller import Controller
from rigsim.boxes.device import Device, Wiring
from rigsim.boxes.dome import DomeUnit
from rigsim.boxes.flash import FlashUnit
from rigsim.boxes.gradient_sphere import GradientSphereUnit
from rigsim.boxes.probe import ProbeUnit

_UNITS: Final[dict[str, tuple[Callable[[Wiring], Device], str]]] = {
    "flash": (FlashUnit, "FL-0001"),
    "dome": (DomeUnit, "DM-0001"),
    "gradient_sphere": (GradientSphereUnit, "GS-0001"),
    "caliper": (CaliperUnit, "CA-0001"),
    "probe": (ProbeUnit, "PR-0001"),
}
"""What each kind of box is, and its serial number."""

RIG_OF_BOX: Final = {
    "flash": "flash",
    "dome": "dome",
    "gradient_sphere": "gradient",
    "caliper": "gradient",
    "probe": "probe",
}
"""Which rig that ships has a box."""


def make_box(name: str, wiring: Wiring) -> Controller:
    """Return a box of the rig.

    Parameters
    ----------
    name
        Which: flash, dome, gradient_sphere, caliper or probe.
    wiring
        What it is wired to.

    Raises
    ------
    ValueError
        Unknown name, or the rig does not describe what the box moves.
    """
    if name not in _UNITS:
        raise ValueError(f"boxes: got {name!r}, expected one of {', '.join(_UNITS)}")
    unit, serial = _UNITS[name]
    return Controller(unit(wiring), serial=wiring.faults.serial or serial, rng=wiring.rng)
