"""The plan of a capture: a file's, or the rig's own for a target or a subject."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from capture.plan import Plan, flash_calibration_plan, flash_plan
from capture.plan.dome import DomeTarget, dome_calibration_plan, dome_plan
from capture.plan.gradient import GradientTarget, gradient_calibration_plan, gradient_plan, state_of
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


def choose_plan(
    rig: Rig,
    file: Path | None,
    target: str | None,
    *,
    angles: Sequence[float] | None = None,
    steps: tuple[int, int] | None = None,
    sites: Sequence[str] | None = None,
    repeats: int = 1,
    sequence: SequenceOrder | None = None,
    states: Sequence[str] = (),
) -> Plan:
    """Return the plan in ``file``, or the rig's own for a target, or for a subject.

    Parameters
    ----------
    rig
    file
        A plan, JSON.
    target
        What stands in the rig; None: a subject.
    angles, steps
        Of a caliper; None: all. Of a probe one number, of directions.
    sites, repeats
        Of a probe; repeats also of a subject's states before the flash rig.
    sequence
        In time, of the flash rig.
    states
        Of a subject before the flash rig; none: neutral. Repeats go through all of them in turn.

    Raises
    ------
    CaptureError
        For an unknown target.
    UsageError
        For what the rig does not know, or that a plan in a file has already.
    """
    own = file is None and target is None
    if sequence is not None:
        if not own or "flash" not in rig.boxes:
            raise UsageError("--sequence: is for the flash rig's own plan of a subject")
        return sequence_plan(rig, sequence)
    if (angles or steps) and not (own and (rig.caliper or (rig.probe and not steps))):
        raise UsageError(
            "--angles, --steps: are for the gradient rig's own plan of skin, --angles for the "
            "probe's, too"
        )
    if sites and not (own and rig.probe):
        raise UsageError("--sites: is for the probe's own plan of skin")
    flash = own and "flash" in rig.boxes
    if states and not flash:
        raise UsageError("--state: is for the flash rig's own plan of a subject")
    if repeats != 1 and not flash and (file is not None or rig.probe is None):
        raise UsageError("--repeats: is for the probe's own plans and the flash rig's states")
    if file is not None:
        return read_plan(file)
    if "gradient_sphere" in rig.boxes:
        if target is None:
            return gradient_plan(rig, angles=angles, steps=steps)
        known = get_args(GradientTarget)
        return gradient_calibration_plan(rig, one_of("target", target, known, CaptureError))
    if "dome" in rig.boxes:
        if target is None:
            return dome_plan(rig)
        known = get_args(DomeTarget)
        return dome_calibration_plan(rig, one_of("target", target, known, CaptureError))
    if rig.probe is not None:
        if target is None:
            return probe_plan(
                rig, sites=sites or PROBE_SITES, repeats=repeats, angles=directions_of(angles)
            )
        shown = one_of("target", target, get_args(ProbeTarget), CaptureError)
        return probe_calibration_plan(rig, shown, repeats=repeats)
    if target is None:
        return flash_plan(rig, states=states or ("neutral",), repeats=repeats, interleave=True)
    if target == "white":
        return flash_plan(rig, states=("white",), repeats=4)
    one_of("target", target, ("white", *FLASH_CALIBRATION_TARGETS), CaptureError)
    return flash_calibration_plan(rig, target)  # type: ignore[arg-type]


def directions_of(angles: Sequence[float] | None) -> int:
    """Return how many directions of the probe's head ``--angles N`` asks for; 1 for None.

    Raises
    ------
    UsageError
        For anything but one whole number.

    Examples
    --------
    >>> directions_of((16.0,)), directions_of(None)
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
    skin = any(state_of(step) is not None for step in plan.steps)
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
