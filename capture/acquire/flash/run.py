"""Run a plan on the flash rig: one pop a step, its frame believed or the step shot again."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from capture.acquire.flash.sequence import run_sequence
from capture.acquire.flash.shot import Flash, expose, keep, let_go, set_light, token_of
from capture.acquire.outcome import (
    MAX_ATTEMPTS,
    Acquired,
    AcquisitionError,
    Operator,
    attempts_so_far,
    given_up,
    steps_to_do,
    tear_down,
)
from capture.devices.camera import Camera, FrameRefused, FrameTimeout
from capture.devices.port import CommandRefused
from capture.devices.wire import Code
from capture.plan import Plan, Step
from capture.rig import Rig
from capture.session import Session

log = logging.getLogger(__name__)


def run_flash(
    plan: Plan,
    rig: Rig,
    *,
    box: Flash,
    cameras: Mapping[str, Camera],
    session: Session,
    operator: Operator,
) -> Acquired:
    """Capture what the session still lacks of a plan of the flash rig; see `run_plan`."""
    _check_limits(plan, box.limits)
    lag_s = _sync_delay_s(rig, box.limits)
    missing = steps_to_do(session)
    steps = [step for step in missing if "start_s" not in step.settings]
    timed = [step for step in missing if "start_s" in step.settings]
    taken = attempts_so_far(session)
    counts = {"steps": 0, "frames": 0, "stale": 0, "retakes": 0}
    state: str | None = None
    try:
        box.dark()  # whatever was going on before
        if "sync_max_us" in box.limits:
            box.set_sync_delay(lag_s)
        for number, step in enumerate(steps, start=1):
            operator.stop_if_asked()
            wanted = step.index.get("state")
            if wanted is not None and wanted != state:
                state = str(wanted)
                operator.prompt(state)
            operator.progress(f"{number}/{len(missing)} {step.id} {step.kind} {_index_text(step)}")
            prefix = f"{operator.run_id}.{number}"
            _take(step, rig, box, cameras, session, taken, operator, counts, prefix)
        if timed:
            run_sequence(
                timed,
                plan,
                rig,
                box=box,
                cameras=cameras,
                session=session,
                operator=operator,
                taken=taken,
                counts=counts,
            )
    finally:
        tear_down(box, cameras)
    return Acquired(counts["steps"], counts["frames"], counts["stale"], counts["retakes"])


def _index_text(step: Step) -> str:
    return " ".join(f"{name}={value}" for name, value in step.index.items())


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
            raise AcquisitionError(
                f"step {step.id}: got power {power:g}, the box allows {low:g} to {high:g}; "
                "nothing was fired: change the plan"
            )
        angle_deg = float(step.settings.get("analyser_deg", first))
        if not first <= angle_deg <= last:
            raise AcquisitionError(
                f"step {step.id}: got analyser_deg {angle_deg:g}, the box allows {first:g} to "
                f"{last:g}; nothing was fired: change the plan"
            )


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


def _take(
    step: Step,
    rig: Rig,
    box: Flash,
    cameras: Mapping[str, Camera],
    session: Session,
    taken: Mapping[tuple[str, str], int],
    operator: Operator,
    counts: dict[str, int],
    prefix: str,
) -> None:
    """Take one step with all its cameras, or none: a step with one bad frame is shot again."""
    refusals: list[str] = []
    for attempt in range(1, MAX_ATTEMPTS + 1):
        try:
            token = token_of(prefix, attempt, step)
            set_light(step, box)
            report, frames, stale = expose(step, rig, box, cameras, operator, token)
        except (FrameRefused, FrameTimeout, CommandRefused) as error:
            if isinstance(error, CommandRefused) and error.code != Code.HARDWARE:
                raise
            log.warning("step %s, attempt %d: %s", step.id, attempt, error)
            refusals.append(str(error))
            counts["retakes"] += 1
            let_go(step, rig, cameras, error)
            continue
        counts["stale"] += stale
        keep(
            step,
            rig,
            cameras,
            session,
            frames,
            report=report,
            tries=attempt,
            taken=taken,
            t_host_s=operator.clock(),
        )
        counts["frames"] += len(frames)
        counts["steps"] += 1
        return
    raise given_up(f"step {step.id}", refusals[-1], session)
