"""Run a plan on the fibre probe: darks, then series of exposures, placement by placement."""

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
    """Raise where the box is another one than the rig file's, or is asked for more than it allows.

    Raises
    ------
    AcquisitionError
        With what was found, what was expected, and what to change.
    """
    probe = rig.probe
    if probe is None:
        raise AcquisitionError("probe: the rig file has none; use that of this rig")
    if int(limits.get("fibres", 0)) != len(probe.fibres):
        raise AcquisitionError(
            f"fibres: the box has {limits.get('fibres')}, the rig {len(probe.fibres)}; nothing "
            "was lit: use the rig file of this box"
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
        fibre = step.settings.get("fibre")
        if fibre is not None and not int(fibre) < len(probe.fibres):
            has = f"the rig has {len(probe.fibres)}, counted from 0"
            raise step_limit_error(step, f"got fibre {fibre}, {has}")
    if probe.suction_mbar > most_mbar:
        raise AcquisitionError(
            f"suction_mbar: the rig file says {probe.suction_mbar:g}, the box draws at most "
            f"{most_mbar:g}; nothing was sucked at: change the rig file"
        )
    if probe.max_suction_s > float(limits["suction_max_ms"]) / 1e3 + 1e-6:
        raise AcquisitionError(
            f"max_suction_s: the rig file says {probe.max_suction_s:g}, the box sucks for at most "
            f"{float(limits['suction_max_ms']) / 1e3:g} s; nothing was sucked at: change the rig "
            "file"
        )
    given_ws, most_ws = source_energy_ws(plan, rig), float(limits["dose_ws"])
    if given_ws > most_ws:
        raise AcquisitionError(
            f"light dose: the plan gives {given_ws:.3g} Ws, the box allows {most_ws:g} Ws a "
            "subject; nothing was lit: plan fewer sites, repeats or angles"
        )


def check_cameras(run: CaptureRun) -> None:
    """Raise where a camera cannot be released by the probe, or opens after the light has begun."""
    for view in run.rig.views:
        why = "probe's trigger line; an exposure of its own would miss the shutter's light"
        require_trigger_line(view.name, run.cameras[view.name], why)
        if view.shutter_lag_s > 0.0:
            raise CameraError(
                f"view {view.name!r}: opens {view.shutter_lag_s:g} s after it is released, when "
                "the shutter's light has begun; use a camera with an electronic shutter"
            )


PROBE_LEASE_S = 5.0
"""A frame may keep the host busy for a while; after this silence the box lets go."""


def acquire(run: CaptureRun, boxes: Mapping[str, Any]) -> AcquisitionResult:
    """Capture what the session still lacks of a plan of the fibre probe; see `run_plan`.

    Everything that can be refused is, before anything is lit or sucked at. The dark frames come
    first, under a cap; then a person is asked to place the head, once per series on
    skin. Whatever happens, the shutter ends up shut, the LED out and the head vented.

    Raises
    ------
    AcquisitionError
        Where the suction cannot be held at a placement, three times; where the camera does not come
        to its temperature; or where a frame fails three times.
    """
    box: ProbeBox = boxes["probe"]
    check_probe(run.plan, run.rig, box.limits)
    check_cameras(run)
    series = BracketSeries(run, box)
    try:
        box.dark()  # whatever was going on before
        box.set_lease(PROBE_LEASE_S)
        if not run.session.frames():
            box.new_subject(run.session.id[:32])
        series.darks()
        series.run()
    finally:
        run.tear_down(box)
    return run.summarize()
