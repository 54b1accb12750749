"""Build the controllers of a rig from its description, with their faults."""

from collections.abc import Callable
from typing import Final, NamedTuple

from rigsim.boxes.caliper import CaliperUnit
from rigsim.boxes.controller import Controller
from rigsim.boxes.device import Device, Wiring
from rigsim.boxes.dome import DomeUnit
from rigsim.boxes.flash import FlashUnit
from rigsim.boxes.gradient_sphere import GradientSphereUnit
from rigsim.boxes.probe import ProbeUnit
from rigsim.boxes.scanner import ScannerUnit


class BoxKind(NamedTuple):
    """An emulated controller, its serial number, and the shipped rig that has it."""

    unit: Callable[[Wiring], Device]
    serial: str
    rig: str


BOXES: Final = {
    "flash": BoxKind(FlashUnit, "FL-0001", "flash"),
    "dome": BoxKind(DomeUnit, "DM-0001", "dome"),
    "gradient_sphere": BoxKind(GradientSphereUnit, "GS-0001", "gradient"),
    "caliper": BoxKind(CaliperUnit, "CA-0001", "gradient"),
    "probe": BoxKind(ProbeUnit, "PR-0001", "probe"),
    "scanner": BoxKind(ScannerUnit, "SC-0001", "dome"),
}


def make_box(name: str, wiring: Wiring) -> Controller:
    """Build a controller of the rig.

    Parameters
    ----------
    name
        Name of the controller: one of `BOXES`.
    wiring
        Its connections.

    Raises
    ------
    ValueError
        Unknown name, or the rig does not describe the hardware that the controller drives.
    """
    if name not in BOXES:
        raise ValueError(f"boxes: got {name!r}, expected one of {', '.join(BOXES)}")
    kind = BOXES[name]
    serial = wiring.faults.serial or kind.serial
    return Controller(kind.unit(wiring), serial=serial, rng=wiring.rng)
