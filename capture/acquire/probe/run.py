"""Run a plan on the fiber probe: dark frames, then series of exposures per placement."""

from collections.abc import Mapping
from typing import Any

from capture.acquire.outcome import (
    AcquisitionError,
    AcquisitionResult,
    CaptureRun,
    require_trigger_line,
    step_limit_error,
)
from capture.acquire.probe.bracket_series import BracketSeries
from capture.devices.camera import CameraError
from capture.devices.probe import ProbeBox
from capture.plan import Plan
from capture.plan.dose import source_energy_ws
from capture.rig import Rig


def check_probe(plan: Plan, rig: Rig, limits: Mapping[str, Any]) -> None:
    """Raise an error when the controller is not the rig file's, or its limits are exceeded.

    Raises
    ------
    AcquisitionError
        With the value found, the value expected, and the change to make.
    """
    probe = rig.probe
    if probe is None:
        raise AcquisitionError("probe: the rig file has none; use that of this rig")
    if int(limits.get("fibres", 0)) != len(probe.fibers):
        raise AcquisitionError(
            f"fibers: the controller has {limits.get('fibres')}, the rig {len(probe.fibers)}; "
            "nothing was lit: use the rig file of this controller"
        )
    low_s = float(limits["shutter_min_ms"]) / 1e3
    high_s = float(limits["shutter_max_ms"]) / 1e3
    most_mbar = float(limits["suction_max_mbar"])
    for step in plan.steps:
        exposure_s = float(step.settings["exposure_s"])
        if not low_s <= exposure_s <= high_s and step.kind != "dark":
            opens = f"the shutter opens for {low_s:g} to {high_s:g} s"
            raise step_limit_error(step, f"got exposure_s {exposure_s:g}, {opens}")
        mbar = float(step.settings.get("suction_mbar", probe.suction_mbar))
        if abs(mbar - probe.suction_mbar) > 1e-6:
            raise AcquisitionError(
                f"step {step.id}: got suction_mbar {mbar:g}, the rig holds its head at "
                f"{probe.suction_mbar:g} mbar; nothing was lit: change the plan, or the rig file"
            )
        fiber = step.settings.get("fiber")
        if fiber is not None and not int(fiber) < len(probe.fibers):
            has = f"the rig has {len(probe.fibers)}, counted from 0"
            raise step_limit_error(step, f"got fiber {fiber}, {has}")
    if probe.suction_mbar > most_mbar:
        raise AcquisitionError(
            f"suction_mbar: the rig file has {probe.suction_mbar:g}, the controller allows at "
            f"most {most_mbar:g}; no suction was applied: change the rig file"
        )
    if probe.max_suction_s > float(limits["suction_max_ms"]) / 1e3 + 1e-6:
        raise AcquisitionError(
            f"max_suction_s: the rig file has {probe.max_suction_s:g}, the controller applies "
            f"suction for at most {float(limits['suction_max_ms']) / 1e3:g} s; no suction was "
            "applied: change the rig file"
        )
    given_ws, most_ws = source_energy_ws(plan, rig), float(limits["dose_ws"])
    if given_ws > most_ws:
        raise AcquisitionError(
            f"light dose: the plan gives {given_ws:.3g} Ws, the controller allows {most_ws:g} "
            "Ws per subject; nothing was lit: plan fewer sites, repeats or angles"
        )


def check_cameras(run: CaptureRun) -> None:
    """Raise an error when the probe cannot release a camera, or its shutter opens too late."""
    for view in run.rig.views:
        why = "probe's trigger line; an exposure of its own would miss the shutter's light"
        require_trigger_line(view.name, run.cameras[view.name], why)
        if view.shutter_lag_s > 0.0:
            raise CameraError(
                f"view {view.name!r}: opens {view.shutter_lag_s:g} s after it is released, when "
                "the shutter's light has begun; use a camera with an electronic shutter"
            )


PROBE_LEASE_S = 5.0
"""Silence after which the controller shuts down, s: a frame may keep the host busy."""


def acquire(run: CaptureRun, boxes: Mapping[str, Any]) -> AcquisitionResult:
    """Capture the missing steps of a plan on the fiber probe; see `run_plan`.

    All checks are made before anything is lit or suction is applied. The dark frames come first,
    under a cap; then a person is prompted to place the head, once per series on skin. In every case
    the shutter ends closed, the LED off and the head vented.

    Raises
    ------
    AcquisitionError
        When the suction cannot be held at a placement, three times; when the camera does not reach
        its temperature; or when a frame fails three times.
    """
    box: ProbeBox = boxes["probe"]
    check_probe(run.plan, run.rig, box.limits)
    check_cameras(run)
    series = BracketSeries(run, box)
    try:
        box.dark()  # stop any activity of before
        box.set_lease(PROBE_LEASE_S)
        if not run.session.frames():
            box.new_subject(run.session.id[:32])
        series.darks()
        series.run()
    finally:
        run.tear_down(box)
    return run.summarize()
