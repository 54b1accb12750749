"""Run a plan on the flash rig: one flash per step; a step without a valid frame is repeated."""

import logging
import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

from capture.acquire.flash.shot import ShotTiming, flash_power, set_light, shoot, step_led
from capture.acquire.outcome import (
    MAX_ATTEMPTS,
    AcquisitionError,
    AcquisitionResult,
    CaptureRun,
    Operator,
    step_limit_error,
)
from capture.devices.flash import FlashBox, FlashReport
from capture.plan import Plan, Step, Value
from capture.plan.led_bands import parse_led
from capture.rig import Rig

log = logging.getLogger(__name__)

MAX_SLEEP_S = 1.0
"""Longest sleep between two checks for a stop by the operator, s."""
PROMPT_LEAD_S = 0.05
"""Time before a frame is due until which prompts are given, s; then the frame is awaited."""
COMMAND_LEAD_S = 0.1
"""Minimum time between a prompt and the commands that set the light, s."""
TIME_ROUNDING_S = 1e-6
"""Rounding of times that are sums of periods."""


def run_sequence(run: CaptureRun, box: FlashBox, steps: Sequence[Step]) -> None:
    """Capture the missing timed steps of a session; see `acquire`.

    Each frame's ``actual`` gets ``time_s`` (s, sequence time of the flash), ``late_s`` (s after its
    planned time), ``time_error_s`` (s, uncertainty of the comparison of host and controller
    clocks), ``block`` (0, and one more each time that the sequence is resumed); and for a prompted
    step ``phase_s`` (s since the last prompt of the expression), ``prompt`` (last prompt).
    """
    limits = run.plan.limits
    period_s = float(limits.get("prompt_period_s", 0.0))
    if period_s > 0:
        rhythm: _ShotSchedule = _PromptedSchedule(run, steps, period_s)
    else:
        rhythm = _EventSchedule(run, steps)
    spacing_s = float(limits.get("shot_period_s", 0.0))
    waiting = deque((step, 1) for step in rhythm.feasible_steps(steps))
    free_s = -math.inf
    if waiting:
        set_light(waiting[0][0], box)
        rhythm.begin()
    number = 0
    while waiting:
        run.operator.stop_if_asked()
        step, attempt = waiting.popleft()
        number += 1
        due_s = rhythm.due_s(step, free_s)
        free_s = due_s + spacing_s
        count = f"{number}/{number + len(waiting)}"
        run.operator.progress(f"{count} {step.id} {step.kind} t={due_s:g} s")
        moment = _ScheduledShot(run, box, step, rhythm, due_s, waiting[0][0] if waiting else None)
        why = shoot(run, moment, f"{run.operator.run_id}.t{number}", attempt)
        if why:
            if attempt == MAX_ATTEMPTS:
                raise run.retry_limit_error(f"step {step.id}", why)
            waiting.extend(rhythm.reschedule(step, attempt, why))
            if waiting:
                set_light(waiting[0][0], box)


class _ShotSchedule:
    """Schedule of a sequence: its clock, its shots, and the events between them."""

    block = 0
    """Number of times that the sequence was started before."""

    def __init__(self, run: CaptureRun) -> None:
        self._run = run
        self.operator: Operator = run.operator
        self._zero = 0.0

    def feasible_steps(self, steps: Sequence[Step]) -> list[Step]:
        """Return the steps that can still be taken."""
        return list(steps)

    def begin(self) -> None:
        """Start the clock."""

    def now_s(self) -> float:
        """Return the sequence's time, s."""
        return self.operator.timer.monotonic() - self._zero

    def to_sequence_time_s(self, timer_s: float) -> float:
        """Convert a reading of the timer to the sequence's time, s."""
        return timer_s - self._zero

    def due_s(self, step: Step, free_s: float) -> float:
        """Return the time at which a step is due, s; not before ``free_s`` if possible."""
        return float(step.settings["start_s"])

    def reschedule(self, step: Step, attempt: int, why: str) -> list[tuple[Step, int]]:
        """Return the step and its next attempt when it can be taken later, else nothing."""
        raise NotImplementedError

    def wait(self, until_s: float) -> None:
        """Wait, and stop in good order when the operator asks for it."""
        while (rest_s := until_s - self.now_s()) > TIME_ROUNDING_S:
            self.operator.timer.sleep(min(rest_s, MAX_SLEEP_S))
            self.operator.stop_if_asked()

    def wait_for_gap(self, span_s: float) -> None:
        """Wait until nothing is due for a while, s."""

    def journal_entries(self, time_s: float) -> dict[str, Value]:
        """Return the journal entries of a shot at a time, s."""
        return {"time_s": time_s, "block": self.block}


class _PromptedSchedule(_ShotSchedule):
    """Schedule of a subject who changes expression with every prompt."""

    def __init__(self, run: CaptureRun, steps: Sequence[Step], period_s: float) -> None:
        super().__init__(run)
        plan, session = run.plan, run.session
        self._period_s = period_s
        shown = {
            float(s.index["phase_s"]) < period_s: str(s.index["state"])
            for s in plan.steps
            if "start_s" in s.settings
        }
        self._states = (shown.get(True, "expression"), shown.get(False, "neutral"))
        first_s = min(float(step.settings["start_s"]) for step in steps)
        cycle_s = 2 * period_s
        # a resumed run begins with the cycle of its first shot
        self._first_s = cycle_s * math.floor(first_s / cycle_s + TIME_ROUNDING_S)
        self._lead_s = float(plan.limits.get("lead_s", 0.0))
        self._next = 0
        self._given: list[tuple[float, str]] = []
        blocks = [int(r.line.actual["block"]) for r in session.frames() if "block" in r.line.actual]
        self.block = max(blocks, default=-1) + 1

    def begin(self) -> None:
        self.operator.prompt(f"{self._states[1]}, then change at each sound")
        start_s = self._first_s - self._lead_s
        self._zero = self.operator.timer.monotonic() - start_s
        self._next = round(start_s / self._period_s)
        self.wait(start_s)

    def due_s(self, step: Step, free_s: float) -> float:
        due_s = float(step.settings["start_s"])
        cycle_s = 2 * self._period_s
        behind_s = max(free_s, self._first_s) - due_s
        return due_s + cycle_s * max(0, math.ceil(behind_s / cycle_s - TIME_ROUNDING_S))

    def reschedule(self, step: Step, attempt: int, why: str) -> list[tuple[Step, int]]:
        return [(step, attempt + 1)]

    def wait(self, until_s: float) -> None:
        while (prompt_s := self._next * self._period_s) <= until_s + TIME_ROUNDING_S:
            super().wait(prompt_s)
            state = self._states[self._next % 2]
            self.operator.signal(state)
            self._given.append((self.now_s(), state))
            self._next += 1
        super().wait(until_s)

    def wait_for_gap(self, span_s: float) -> None:
        if (prompt_s := self._next * self._period_s) <= self.now_s() + span_s:
            self.wait(prompt_s)

    def journal_entries(self, time_s: float) -> dict[str, Value]:
        before = [entry for entry in self._given if entry[0] <= time_s]
        onsets = [given_s for given_s, state in before if state == self._states[0]]
        noted = super().journal_entries(time_s)
        if onsets:
            noted |= {"phase_s": time_s - onsets[-1], "prompt": before[-1][1]}
        return noted


class _EventSchedule(_ShotSchedule):
    """Schedule of shots after an event that happens once."""

    def __init__(self, run: CaptureRun, steps: Sequence[Step]) -> None:
        super().__init__(run)
        self._state = str(steps[0].index.get("state", "event"))
        self._elapsed_s = 0.0
        # only the host's clock covers the time of an interruption
        for record in run.session.frames("subject"):
            if "time_s" in record.line.actual:
                zero = record.line.t_host_s - float(record.line.actual["time_s"])
                self._elapsed_s = self.operator.clock() - zero
                self.block = max(self.block, int(record.line.actual["block"]) + 1)

    def feasible_steps(self, steps: Sequence[Step]) -> list[Step]:
        if self.block == 0:
            return list(steps)
        passed = [s.id for s in steps if float(s.settings["start_s"]) < self._elapsed_s]
        self._omit_steps(passed, "its time passed while the capture was interrupted")
        return [step for step in steps if step.id not in passed]

    def begin(self) -> None:
        if self.block == 0:
            self.operator.prompt(self._state)
        self._zero = self.operator.timer.monotonic() - self._elapsed_s

    def reschedule(self, step: Step, attempt: int, why: str) -> list[tuple[Step, int]]:
        self._omit_steps([step.id], f"failed at its time, which does not come again: {why}")
        return []

    def _omit_steps(self, ids: Sequence[str], why: str) -> None:
        if ids:
            log.warning("steps %s: %s", ", ".join(ids), why)
            self._run.omit_steps(ids, why, {})


class _ScheduledShot(ShotTiming):
    """Timing of one shot: wait for it, and compare its time with the controller's."""

    def __init__(
        self,
        run: CaptureRun,
        box: FlashBox,
        step: Step,
        rhythm: _ShotSchedule,
        due_s: float,
        then: Step | None,
    ) -> None:
        super().__init__(step, box)
        self._rhythm, self._due_s, self._then = rhythm, due_s, then
        views = [run.rig.view(name) for name in step.cameras]
        self._charged_s = run.rig.recycle_s * flash_power(step)
        self._busy_s = float(step.settings["exposure_s"])
        self._busy_s += max(view.shutter_lag_s + view.readout_s for view in views)

    def prepare(self) -> None:
        """Do nothing: the light was set during the readout of the previous shot."""

    def wait(self) -> None:
        """Wait until the shot is due."""
        self._rhythm.wait(self._due_s)

    def use_readout_time(self, report: FlashReport | None) -> None:
        """Compute the time of the flash and prepare the light of the next shot, on schedule."""
        timer = self._rhythm.operator.timer
        before = timer.monotonic()
        box_s = self.box.ping()
        after = timer.monotonic()
        popped_s = before if report is None else 0.5 * (before + after) - box_s + report.t_box_s
        time_s = self._rhythm.to_sequence_time_s(popped_s)
        self.noted = {
            **self._rhythm.journal_entries(time_s),
            "late_s": time_s - self._due_s,
            "time_error_s": 0.5 * (after - before),
        }
        if self._then is not None:
            # waiting for the charge, or sending commands, would delay a prompt
            self._rhythm.wait(time_s + self._charged_s)
            self._rhythm.wait_for_gap(COMMAND_LEAD_S)
            set_light(self._then, self.box)
        self._rhythm.wait(time_s + self._busy_s - PROMPT_LEAD_S)


def acquire(run: CaptureRun, boxes: Mapping[str, Any]) -> AcquisitionResult:
    """Capture the missing steps of a plan on the flash rig; see `run_plan`."""
    box: FlashBox = boxes["flash"]
    operator = run.operator
    _check_limits(run.plan, box.limits)
    lag_s = _sync_delay_s(run.rig, box.limits)
    missing = run.pending_steps()
    state: str | None = None
    try:
        box.dark()  # stop any activity of before
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
            _take_step(run, box, step, f"{operator.run_id}.{number}")
        if timed := [step for step in missing if "start_s" in step.settings]:
            run_sequence(run, box, timed)
    finally:
        run.tear_down(box)
    return run.summarize()


def _take_step(run: CaptureRun, box: FlashBox, step: Step, prefix: str) -> None:
    """Take one step, and repeat it when it fails."""
    why = ""
    for attempt in range(1, MAX_ATTEMPTS + 1):
        why = shoot(run, ShotTiming(step, box), prefix, attempt)
        if not why:
            return
    raise run.retry_limit_error(f"step {step.id}", why)


def _check_limits(plan: Plan, limits: Mapping[str, Any]) -> None:
    """Raise an error when a step exceeds the controller's limits, before anything is sent."""
    low, high = float(limits.get("power_min", 0.0)), float(limits.get("power_max", 1.0))
    first = float(limits.get("analyser_min_deg", 0.0))
    last = float(limits.get("analyser_max_deg", 360.0))
    for step in plan.steps:
        power = float(step.settings.get("power", 1.0))
        if step.kind == "dark" or power == 0.0:
            continue
        if not low <= power <= high:
            what = f"got power {power:g}, the controller allows {low:g} to {high:g}"
            raise step_limit_error(step, what, action="fired")
        if led := step_led(step):
            _check_led(step, led, limits)
        angle_deg = float(step.settings.get("analyzer_deg", first))
        if not first <= angle_deg <= last:
            what = f"got analyzer_deg {angle_deg:g}, the controller allows {first:g} to {last:g}"
            raise step_limit_error(step, what, action="fired")


def _check_led(step: Step, led: str, limits: Mapping[str, Any]) -> None:
    center_nm, _ = parse_led(led)
    low, high = (float(limits.get(f"led_{end}_nm", 0.0)) for end in ("min", "max"))
    if not high:
        raise step_limit_error(step, f"got light {led}, the controller has no LEDs", action="fired")
    if not low <= center_nm <= high:
        what = f"got light {led}, the controller has LEDs of {low:g} to {high:g} nm"
        raise step_limit_error(step, what, action="fired")


def _sync_delay_s(rig: Rig, limits: Mapping[str, Any]) -> float:
    """Return the delay from camera line to flash until the last shutter is open, s."""
    lag_s = max((view.shutter_lag_s for view in rig.views), default=0.0)
    most_s = float(limits.get("sync_max_us", 0.0)) / 1e6
    if lag_s > most_s:
        raise AcquisitionError(
            f"shutter_lag_s: got {lag_s:g} s in the rig file, the controller waits {most_s:g} s "
            "at most from camera line to flash; nothing was fired: every lit frame would be "
            "dark; use a faster camera [SR-CAP-014]"
        )
    return lag_s
