"""Run a plan on the flash rig: one pop a step, its frame believed or the step shot again."""

from collections.abc import Mapping
from typing import Any

from capture.acquire.flash.sequence import run_sequence
from capture.acquire.flash.shot import Moment, shoot
from capture.acquire.outcome import (
    MAX_ATTEMPTS,
    Acquired,
    AcquisitionError,
    CaptureRun,
    refuse_step,
)
from capture.devices.flash import FlashBox
from capture.plan import Plan, Step
from capture.rig import Rig


def run_flash(run: CaptureRun, box: FlashBox) -> Acquired:
    """Capture what the session still lacks of a plan of the flash rig; see `run_plan`."""
    operator = run.operator
    _check_limits(run.plan, box.limits)
    lag_s = _sync_delay_s(run.rig, box.limits)
    missing = run.steps_to_do()
    state: str | None = None
    try:
        box.dark()  # whatever was going on before
        if "sync_max_us" in box.limits:
            box.set_sync_delay(lag_s)
        untimed = [step for step in missing if "start_s" not in step.settings]
        for number, step in enumerate(untimed, start=1):
            operator.stop_if_asked()
            wanted = step.index.get("state")
            if wanted is not None and wanted != state:
                state = str(wanted)
                operator.prompt(state)
            index = " ".join(f"{name}={value}" for name, value in step.index.items())
            operator.progress(f"{number}/{len(missing)} {step.id} {step.kind} {index}")
            _take(run, box, step, f"{operator.run_id}.{number}")
        if timed := [step for step in missing if "start_s" in step.settings]:
            run_sequence(run, box, timed)
    finally:
        run.tear_down(box)
    return run.account()


def _take(run: CaptureRun, box: FlashBox, step: Step, prefix: str) -> None:
    """Take one step; it is shot again where it failed."""
    why = ""
    for attempt in range(1, MAX_ATTEMPTS + 1):
        why = shoot(run, Moment(step, box), prefix, attempt)
        if not why:
            return
    raise run.given_up(f"step {step.id}", why)


def _check_limits(plan: Plan, limits: Mapping[str, Any]) -> None:
    """Raise when a step asks for more than the box allows, before anything is sent."""
    low, high = float(limits.get("power_min", 0.0)), float(limits.get("power_max", 1.0))
    first = float(limits.get("analyser_min_deg", 0.0))
    last = float(limits.get("analyser_max_deg", 360.0))
    for step in plan.steps:
        power = float(step.settings.get("power", 1.0))
        if step.kind == "dark" or power == 0.0:
            continue
        if not low <= power <= high:
            what = f"got power {power:g}, the box allows {low:g} to {high:g}"
            raise refuse_step(step, what, done="fired")
        angle_deg = float(step.settings.get("analyser_deg", first))
        if not first <= angle_deg <= last:
            what = f"got analyser_deg {angle_deg:g}, the box allows {first:g} to {last:g}"
            raise refuse_step(step, what, done="fired")


def _sync_delay_s(rig: Rig, limits: Mapping[str, Any]) -> float:
    """Return how long after the camera line the box must pop: when the last shutter is open."""
    lag_s = max((view.shutter_lag_s for view in rig.views), default=0.0)
    most_s = float(limits.get("sync_max_us", 0.0)) / 1e6
    if lag_s > most_s:
        raise AcquisitionError(
            f"shutter_lag_s: got {lag_s:g} s in the rig file, the box waits {most_s:g} s at most "
            "from camera line to pop; nothing was fired: every lit frame would be dark"
        )
    return lag_s
