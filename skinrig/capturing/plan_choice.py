"""The plan of a capture: a file's, or the rig's own for a target or a subject."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from capture.plan import Plan, flash_calibration_plan, flash_plan
from capture.plan.dome import DomeTarget, dome_calibration_plan, dome_plan
from capture.plan.gradient import (
    GradientTarget,
    gradient_calibration_plan,
    gradient_plan,
    strain_state,
)
from capture.plan.probe import PROBE_SITES, ProbeTarget, probe_calibration_plan, probe_plan
from capture.rig import Rig
from skinrig.capturing.sequences import SequenceOrder, sequence_plan
from skinrig.errors import UsageError, one_of

FLASH_CALIBRATION_TARGETS = ("dark", "flat", "chart", "malus")


class CaptureError(ValueError):
    """A capture that cannot start as asked."""


def read_plan(file: Path) -> Plan:
    """Return the plan in a JSON file, as ``--plan-out`` and `skinrig plan` write it."""
    return Plan.from_json(file.read_bytes(), where=str(file))


@dataclass(frozen=True, slots=True, kw_only=True)
class DefaultPlan:
    """What a rig's own plan is of.

    Raises
    ------
    CaptureError
        For a target that the rig has not, when the plan is made.
    """

    target: str | None = None
    """What stands in the rig; None: a subject."""
    angles: Sequence[float] | None = None
    """Of a caliper; None: all. Of a probe one number, of directions."""
    steps: tuple[int, int] | None = None
    """Of a caliper: first and last; None: all."""
    sites: Sequence[str] | None = None
    """Of a probe; None: the usual ones."""
    repeats: int = 1
    """Of a probe's placements, or of a subject's states before the flash rig, all in turn."""
    states: Sequence[str] = ()
    """Of a subject before the flash rig; none: neutral."""

    def of(self, rig: Rig) -> Plan:
        """Return the plan of a rig."""
        if "gradient_sphere" in rig.boxes:
            if self.target is None:
                return gradient_plan(rig, angles=self.angles, steps=self.steps)
            return gradient_calibration_plan(rig, self._check_target(get_args(GradientTarget)))
        if "dome" in rig.boxes:
            if self.target is None:
                return dome_plan(rig)
            return dome_calibration_plan(rig, self._check_target(get_args(DomeTarget)))
        repeats = self.repeats
        if rig.probe is not None:
            if self.target is None:
                sites, angles = self.sites or PROBE_SITES, parse_direction_count(self.angles)
                return probe_plan(rig, sites=sites, repeats=repeats, angles=angles)
            target = self._check_target(get_args(ProbeTarget))
            return probe_calibration_plan(rig, target, repeats=repeats)
        if self.target is None:
            states = self.states or ("neutral",)
            return flash_plan(rig, states=states, repeats=repeats, interleave=True)
        if self.target == "white":
            return flash_plan(rig, states=("white",), repeats=max(4, repeats))
        target = self._check_target(("white", *FLASH_CALIBRATION_TARGETS))
        return flash_calibration_plan(rig, target)

    def _check_target(self, targets: Sequence[str]) -> Any:
        return one_of("target", str(self.target), targets, CaptureError)


def choose_plan(
    rig: Rig,
    file: Path | None,
    target: str | None,
    *,
    sequence: SequenceOrder | None = None,
    **details: Any,
) -> Plan:
    """Return the plan in ``file``, or the rig's own for a target, or for a subject.

    Parameters
    ----------
    rig
    file
        A plan, JSON.
    target
        What stands in the rig; None: a subject.
    sequence
        In time, of the flash rig.
    details
        Further fields of `DefaultPlan`.

    Raises
    ------
    CaptureError
        For an unknown target.
    UsageError
        For what the rig does not know, or that a plan in a file has already.
    """
    asked = DefaultPlan(target=target, **details)
    own = file is None and target is None
    if sequence is not None:
        if not own or "flash" not in rig.boxes:
            raise UsageError("--sequence: is for the flash rig's own plan of a subject")
        return sequence_plan(rig, sequence)
    turns = rig.caliper or (rig.probe and not asked.steps)
    if (asked.angles or asked.steps) and not (own and turns):
        raise UsageError(
            "--angles, --steps: are for the gradient rig's own plan of skin, --angles for the "
            "probe's, too"
        )
    if asked.sites and not (own and rig.probe):
        raise UsageError("--sites: is for the probe's own plan of skin")
    flash = own and "flash" in rig.boxes
    if asked.states and not flash:
        raise UsageError("--state: is for the flash rig's own plan of a subject")
    if asked.repeats != 1 and not flash and (file is not None or rig.probe is None):
        raise UsageError("--repeats: is for the probe's own plans and the flash rig's states")
    return asked.of(rig) if file is None else read_plan(file)


def parse_direction_count(angles: Sequence[float] | None) -> int:
    """Return how many directions of the probe's head ``--angles N`` asks for; 1 for None.

    Raises
    ------
    UsageError
        For anything but one whole number.

    Examples
    --------
    >>> parse_direction_count((16.0,)), parse_direction_count(None)
    (16, 1)
    """
    if angles is None:
        return 1
    if len(angles) != 1 or not float(angles[0]).is_integer():
        text = ",".join(f"{angle:g}" for angle in angles)
        raise UsageError(
            f"--angles: got {text!r}, expected how many directions of the probe's head, such as 16"
        )
    return int(angles[0])


def needed_boxes(rig: Rig, plan: Plan) -> tuple[str, ...]:
    """Return the boxes of a rig that a plan uses: a caliper only where it holds skin."""
    skin = any(strain_state(step) is not None for step in plan.steps)
    return tuple(name for name in rig.boxes if skin or name != "caliper")


def write_plan(plan: Plan, file: Path) -> None:
    """Write a plan as ``--plan`` takes it; a file that exists may hold somebody's changes.

    Raises
    ------
    CaptureError
        Where `file` exists.
    """
    text = json.dumps(plan.to_json(), indent=1) + "\n"
    try:
        with file.open("x", encoding="utf-8") as stream:
            stream.write(text)
    except FileExistsError as exc:
        raise CaptureError(f"{file}: exists; choose a new name for the plan") from exc
