"""Choose the plan of a capture: from a file, or the rig's default for a target or a subject."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from capture.plan import Plan, flash_calibration_plan, flash_plan
from capture.plan.dome import DomeTarget, add_scan, dome_calibration_plan, dome_plan
from capture.plan.gradient import (
    GradientTarget,
    gradient_calibration_plan,
    gradient_plan,
    strain_state,
)
from capture.plan.probe import PROBE_SITES, ProbeTarget, probe_calibration_plan, probe_plan
from capture.rig import SCANNER_BOX, Rig
from skinrig.capturing.sequences import SequenceOrder, sequence_plan
from skinrig.errors import UsageError, require_choice

FLASH_CALIBRATION_TARGETS = ("dark", "flat", "chart", "malus")


class CaptureError(ValueError):
    """A capture that cannot start with the given options."""


def read_plan(file: Path) -> Plan:
    """Read a plan from a JSON file that ``--plan-out`` or `skinrig plan` wrote."""
    return Plan.from_json(file.read_bytes(), where=str(file))


@dataclass(frozen=True, slots=True, kw_only=True)
class DefaultPlan:
    """Options of a rig's default plan.

    Raises
    ------
    CaptureError
        By :meth:`of`, for a target that the rig does not have.
    """

    target: str | None = None
    """Calibration target in the rig; None: a subject."""
    angles: Sequence[float] | None = None
    """Caliper: angles, degrees; None: all. Probe: one number, the count of directions."""
    steps: tuple[int, int] | None = None
    """Caliper: first and last strain step; None: all."""
    sites: Sequence[str] | None = None
    """Probe: sites of the skin; None: forehead, cheek and chin."""
    repeats: int = 1
    """Repeats of the probe's placements, or of the flash rig's expressions, interleaved."""
    states: Sequence[str] = ()
    """Flash rig: expressions of the subject; empty: neutral."""
    bands: Sequence[str] = ()
    """Flash rig: narrow-band LEDs, for a subject or target white."""

    def of(self, rig: Rig) -> Plan:
        """Return the default plan of a rig for these options."""
        if "gradient_sphere" in rig.boxes:
            if self.target is None:
                return gradient_plan(rig, angles=self.angles, steps=self.steps)
            return gradient_calibration_plan(rig, self._check_target(get_args(GradientTarget)))
        if "dome" in rig.boxes:
            if self.target is None:
                return add_scan(dome_plan(rig), rig)
            target = self._check_target(get_args(DomeTarget))
            return add_scan(dome_calibration_plan(rig, target), rig)
        repeats = self.repeats
        if rig.probe is not None:
            if self.target is None:
                sites, angles = self.sites or PROBE_SITES, parse_direction_count(self.angles)
                return probe_plan(rig, sites=sites, repeats=repeats, angles=angles)
            target = self._check_target(get_args(ProbeTarget))
            return probe_calibration_plan(rig, target, repeats=repeats)
        if self.target is None:
            states = self.states or ("neutral",)
            return flash_plan(rig, states=states, repeats=repeats, interleave=True, leds=self.bands)
        if self.target == "white":
            return flash_plan(rig, states=("white",), repeats=max(4, repeats), leds=self.bands)
        target = self._check_target(("white", *FLASH_CALIBRATION_TARGETS))
        return flash_calibration_plan(rig, target)

    def _check_target(self, targets: Sequence[str]) -> Any:
        return require_choice("target", str(self.target), targets, CaptureError)


def choose_plan(
    rig: Rig,
    file: Path | None,
    target: str | None,
    *,
    sequence: SequenceOrder | None = None,
    **details: Any,
) -> Plan:
    """Return the plan in ``file``, or the rig's default for a target or a subject.

    Parameters
    ----------
    rig
    file
        A plan, JSON; None: the rig's default plan.
    target
        Calibration target in the rig; None: a subject.
    sequence
        Sequence in time (flash rig only).
    details
        Further fields of `DefaultPlan`.

    Raises
    ------
    CaptureError
        For an unknown target.
    UsageError
        For an option that is not of this rig, or that a plan in a file fixes already.
    """
    options = DefaultPlan(target=target, **details)
    default = file is None and target is None
    if sequence is not None:
        if not default or "flash" not in rig.boxes:
            raise UsageError(
                "--sequence: an option of the flash rig's default plan of a subject; remove it, or "
                "remove --plan and --target"
            )
        return sequence_plan(rig, sequence)
    has_angles = rig.caliper or (rig.probe and not options.steps)
    if (options.angles or options.steps) and not (default and has_angles):
        raise UsageError(
            "--angles, --steps: options of the gradient rig's default plan of skin, --angles of "
            "the probe's too; remove them"
        )
    if options.sites and not (default and rig.probe):
        raise UsageError("--sites: an option of the probe's default plan of skin; remove it")
    flash = default and "flash" in rig.boxes
    if options.states and not flash:
        raise UsageError(
            "--state: an option of the flash rig's default plan of a subject; remove it"
        )
    white = file is None and target == "white" and "flash" in rig.boxes
    if options.bands and not (flash or white):
        raise UsageError(
            "--bands: an option of the flash rig's default plan of a subject or of target white; "
            "remove it"
        )
    if options.repeats != 1 and not flash and (file is not None or rig.probe is None):
        raise UsageError(
            "--repeats: an option of the default plans of the probe, and of the flash rig for a "
            "subject; remove it"
        )
    return options.of(rig) if file is None else read_plan(file)


def parse_direction_count(angles: Sequence[float] | None) -> int:
    """Return the number of probe directions that ``--angles N`` requests; 1 for None.

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
            f"--angles: got {text!r}, expected the number of directions of the probe, such as 16"
        )
    return int(angles[0])


def needed_boxes(rig: Rig, plan: Plan) -> tuple[str, ...]:
    """Return the names of the controllers that a plan uses.

    The caliper is used with strain steps alone, the scanner with steps of stripes alone.
    """
    unused = set()
    if not any(strain_state(step) is not None for step in plan.steps):
        unused.add("caliper")
    if not any(step.kind == "stripes" for step in plan.steps):
        unused.add(SCANNER_BOX)
    return tuple(name for name in rig.boxes if name not in unused)


def write_plan(plan: Plan, file: Path) -> None:
    """Write a plan as JSON for ``--plan``, without replacing an existing, perhaps edited, file.

    Raises
    ------
    CaptureError
        If `file` exists.
    """
    text = json.dumps(plan.to_json(), indent=1) + "\n"
    try:
        with file.open("x", encoding="utf-8") as stream:
            stream.write(text)
    except FileExistsError as exc:
        raise CaptureError(f"{file}: exists; choose a new name for the plan") from exc
