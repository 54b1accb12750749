"""Emulate the stretching caliper's controller (sans-I/O).

The device has two jaws on a motor, a force sensor and a turning ring. Its manual is its command
table (`CaliperUnit.commands`) and these rules. Motion requires an armed controller (-203), a force
limit, which has no default, and, for steps, a found home mark (-213 each). Moves are absolute and
slow: the controller accepts them at once and returns their number. They are complete when
``*OPC?`` returns 1; the event ``CAL:END`` and ``CAL:LAST?`` report the outcome. The controller
samples the force once per control period. Where the force reaches the limit, pulling or pushing,
the jaws return to their previous position, and a further move in that direction is refused with
106. A motor that has lost steps stops and must be homed. A force that drops to zero while the jaws
open means that the skin has detached. ``CAL:REL`` releases the skin, and so does everything that
makes other controllers dark: ``SAFE``, ``ABOR``, ``*RST``, a silent host, the emergency stop, and
the loss of power. After that the operator tapes the jaws to the skin again and confirms it with
``CAL:ATT``, which tares the sensor.

The controller has no model of the skin: it moves a `JawLoad` and measures its force.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from capture.devices.wire import Code
from rigsim.boxes.command import (
    Command,
    CommandHandler,
    CommandRefused,
    add_us,
    build_command_table,
    elapsed_s,
    elapsed_us,
    parse_decimal,
)
from rigsim.boxes.device import Device, Wiring

CALIPER_CONTROL_PERIOD_S = 5e-3
_PERIOD_US = 5000
"""Period in which position and force are sampled while the motor runs, s."""
MAX_CAPTURE_STEPS = 15
FORCE_LIMIT_N = (0.05, 10.0)
"""Measuring range of the sensor, N; the operator chooses the limit that the skin tolerates."""
STALL_LAG_MM = 0.05
"""Position error from which the motor counts as stalled, mm."""
ROTATION_DEG_PER_S = 90.0
FORCE_ZERO_DEVIATION_N = 0.01
"""Standard deviation of the sensor's zero before it is tared, N."""
HOMING_SPEED_FRACTION = 0.5
"""Homing speed relative to the normal speed."""
MIN_DETACHMENT_FORCE_N = 0.05
DETACHED_FORCE_FRACTION = 0.25
"""Fraction of the force that remains one control period after the skin has detached."""
RELEASE_TIME_US = 250_000
"""Time after a force trip, us; a force still beyond the limit then releases the skin."""

_STEP_PATTERN = re.compile(r"-?[0-9]{1,3}")


@dataclass(slots=True)
class _Move:
    """A move in progress."""

    number: int
    homing: bool
    start_s: float
    from_mm: float
    to_mm: float
    speed_mm_per_s: float
    stalls_at_mm: float | None
    ticks: int = 0
    tripped_s: float = math.inf  # time when the force met its limit; then the jaws return
    reading_mm: float = 0.0  # at that time
    force_n: float = 0.0
    arrives_s: float = 0.0
    next_s: float = 0.0  # time of the next sample

    def __post_init__(self) -> None:
        self.schedule()

    @property
    def direction(self) -> int:
        return 1 if self.to_mm > self.from_mm else -1

    def schedule(self) -> None:
        """Compute the times of arrival and of the next sample after a change."""
        span_us = 1e6 * (abs(self.to_mm - self.from_mm) / self.speed_mm_per_s)
        self.arrives_s = add_us(self.start_s, span_us)
        self.next_s = min(add_us(self.start_s, (self.ticks + 1) * _PERIOD_US), self.arrives_s)

    def driven_to_mm(self, now: float) -> float:
        if now >= self.arrives_s:
            return self.to_mm
        passed_s = elapsed_s(self.start_s, now)
        return self.from_mm + self.direction * self.speed_mm_per_s * passed_s


class CaliperUnit(Device):
    """State of the caliper's device behind its controller.

    Parameters
    ----------
    wiring
        The caliper's travel (at most 15 steps in either direction), angles and speed; the skin.
    """

    kind = "caliper"
    model = "CALIPER1"

    def __init__(self, wiring: Wiring) -> None:
        super().__init__(wiring)
        rig, load, rng = wiring.rig, wiring.skin, wiring.rng
        if rig.caliper is None or load is None:
            raise ValueError(f"caliper: got none in rig {rig.name!r}, expected its description")
        self._caliper = caliper = rig.caliper
        self._load = load
        self._on_change = wiring.on_grip
        self._stall = self.faults.jaw_stall
        self.step_min = max(caliper.first_step, -MAX_CAPTURE_STEPS)
        self.step_max = min(caliper.last_step, MAX_CAPTURE_STEPS)
        half = 0.5 * caliper.step_mm
        self._ends_mm = (
            caliper.reading_mm(self.step_min) - half,
            caliper.reading_mm(self.step_max) + half,
        )
        # state that survives the loss of power: jaws, ring, and the count of moves
        self.aperture_mm = float(rng.uniform(*self._ends_mm))
        self.angle_deg = caliper.angles_deg[0]
        self._offset_n = float(rng.normal(0.0, FORCE_ZERO_DEVIATION_N))
        self._zero_n = 0.0
        self.moves: list[tuple[float, float]] = []  # start time and target of each
        self._move: _Move | None = None
        self.attached = False
        load.move(self.aperture_mm)
        load.turn(self.angle_deg)
        self.reset(0.0, power_up=True)

    # settings ---------------------------------------------------------------------------------

    def reset(self, now: float, *, power_up: bool) -> None:
        """Restore the power-up settings: nothing held, no force limit, not homed."""
        super().reset(now, power_up=power_up)
        if power_up:
            self.last_report = ""
        self.homed = False
        self.limit_n: float | None = None
        self._barred: tuple[int, float] | None = None  # direction and position of a force trip
        self._turning: tuple[float, float] | None = None  # end time and target angle
        self._last_force_n = 0.0

    def capabilities(self) -> Mapping[str, Any]:
        """Return limits and counts; the names include the units."""
        return {
            "step_min": self.step_min,
            "step_max": self.step_max,
            "step_mm": self._caliper.step_mm,
            "aperture_mm": self._caliper.aperture_mm,
            "angles_deg": list(self._caliper.angles_deg),
            "speed_mm_per_s": self._caliper.speed_mm_per_s,
            "turn_deg_per_s": ROTATION_DEG_PER_S,
            "force_limit_min_n": FORCE_LIMIT_N[0],
            "force_limit_max_n": FORCE_LIMIT_N[1],
            "control_period_ms": CALIPER_CONTROL_PERIOD_S * 1e3,
        }

    def commands(self) -> dict[str, Command]:
        """Return the command table, which is the controller's manual."""
        acts: dict[str, CommandHandler] = {
            "CAL:HOME": self._home,
            "CAL:STEP:ABS": self._step,
            "CAL:POS?": lambda *_: f"{self.aperture_mm:.3f}" if self.homed else "NONE",
            "CAL:LAST?": lambda *_: self.last_report or "NONE",
            "CAL:ANG": self._turn,
            "CAL:ANG?": lambda *_: (
                f"{self.angle_deg if self._turning is None else self._turning[1]:g}"
            ),
            "CAL:ATT": self._attach,
            "CAL:ATT?": lambda *_: str(int(self.attached)),
            "CAL:REL": lambda _, now: self._release(now, "ASKED"),
            "CAL:FORC?": self._get_force,
            "CAL:FORC:LIM": self._set_limit,
            "CAL:FORC:LIM?": lambda *_: "NONE" if self.limit_n is None else f"{self.limit_n:g}",
        }
        return build_command_table("caliper", acts)

    # time -------------------------------------------------------------------------------------

    def deadline(self) -> float:
        """Return the time of the next sample of a move or other change of its own, in s."""
        due = self._stop_changes_at_s()
        if self._move is not None:
            due = min(due, self._move.next_s)
        if self._turning is not None:
            due = min(due, self._turning[0])
        return due

    def advance(self, now: float) -> None:
        """Advance time to `now`, in s."""
        while (due := self.deadline()) <= now:
            self._follow_stop(due)
            if self._turning is not None and self._turning[0] <= due:
                self.angle_deg, self._turning = self._turning[1], None
                self._load.turn(self.angle_deg)
                self._on_change(due)
            if self._move is not None and self._move.next_s <= due:
                self._control(self._move, due)

    def go_dark(self, now: float) -> None:
        """Release the skin and stop all motion."""
        self._release(now, "DARK")

    def _make_dark_at_stop(self, now: float) -> None:
        self._release(now, "INTERLOCK")

    def is_busy(self, now: float) -> bool:
        """Return whether the jaws or the ring move."""
        return self._move is not None or self._turning is not None

    def states(self, now: float) -> dict[int, bool]:
        """Return bits 16 moving, 32 homed, 512 skin held, 1024 force limit met."""
        tripped = self._barred is not None
        return {16: self.is_busy(now), 32: self.homed, 512: self.attached, 1024: tripped}

    @property
    def measured_force_n(self) -> float:
        """Force reading since the sensor was tared, N."""
        return self._load.force_n + self._offset_n - self._zero_n

    def _control(self, move: _Move, now: float) -> None:
        """Drive the jaws for one control period and check force and position."""
        driven_mm = move.driven_to_mm(now)
        stop_mm, direction = move.stalls_at_mm, move.direction
        stuck = stop_mm is not None and direction * (driven_mm - stop_mm) > 0.0
        self.aperture_mm = stop_mm if stuck and stop_mm is not None else driven_mm
        self._load.move(self.aperture_mm)
        self._on_change(now)
        move.ticks += 1
        move.schedule()
        limit_n, force_n = self.limit_n or 0.0, self.measured_force_n
        before_n, self._last_force_n = self._last_force_n, force_n
        lost = abs(driven_mm - self.aperture_mm) > STALL_LAG_MM
        if self._has_detached(direction, before_n, force_n):
            self.attached = False
            self._load.release()
            self._on_change(now)
            self._end(move, "DETACHED", now)
        elif math.isfinite(move.tripped_s):
            late = elapsed_us(move.tripped_s, now) > RELEASE_TIME_US
            if abs(force_n) >= limit_n and (lost or late):
                self._release(now, "FORCE")
            elif lost:
                self._lose_steps(move, now)
            elif now >= move.arrives_s:
                self._end(move, "FORCE", now)
        elif abs(force_n) >= limit_n:
            self._turn_back(move, now)
        elif lost:
            self._lose_steps(move, now)
        elif now >= move.arrives_s:
            self._arrive(move, now)

    def _has_detached(self, direction: int, before_n: float, force_n: float) -> bool:
        pulled = self.attached and direction > 0 and before_n >= MIN_DETACHMENT_FORCE_N
        return pulled and abs(force_n) <= DETACHED_FORCE_FRACTION * before_n

    def _turn_back(self, move: _Move, now: float) -> None:
        """Return the jaws to their previous position: the force has met its limit."""
        move.reading_mm, move.force_n, move.tripped_s = self.aperture_mm, self.measured_force_n, now
        self._barred = (move.direction, self.aperture_mm)
        self.queue_event(
            "CAL:FORC:TRIP", f"{self.aperture_mm:.3f},{move.force_n:.3f},{self.clock_us(now)}"
        )
        move.to_mm, move.from_mm = move.from_mm, self.aperture_mm
        move.start_s, move.ticks, move.stalls_at_mm = now, 0, None
        move.schedule()

    def _lose_steps(self, move: _Move, now: float) -> None:
        """End a move whose motor has lost steps: only the home mark restores the position."""
        if move.homing:
            self._end(move, "NOHOME", now)
            return
        self.homed = False
        self._end(move, "STALL", now)

    def _arrive(self, move: _Move, now: float) -> None:
        self.homed = self.homed or move.homing
        self._end(move, "REACHED", now)

    def _end(self, move: _Move, how: str, now: float) -> None:
        self._move = None
        caliper = self._caliper
        step = round((self.aperture_mm - caliper.aperture_mm) / caliper.step_mm)
        reading_mm, force_n = self.aperture_mm, self.measured_force_n
        if how == "FORCE":
            reading_mm, force_n = move.reading_mm, move.force_n
        clock_us = self.clock_us(now)
        self.last_report = f"{move.number},{how},{step},{reading_mm:.3f},{force_n:.3f},{clock_us}"
        self._events.append(("CAL:END", self.last_report))

    def _release(self, now: float, why: str) -> None:
        if self._move is not None:
            self._end(self._move, "FORCE" if why == "FORCE" else "STOPPED", now)
        self._turning = None
        self._barred = None
        if self.attached:
            self.attached = False
            self.queue_event("CAL:FREE", f"{why},{self.clock_us(now)}")
        self._last_force_n = 0.0
        self._load.release()
        self._on_change(now)

    # moves ------------------------------------------------------------------------------------

    def _require_fit(self, now: float) -> None:
        """Refuse motion with an open stop, a dead force sensor, or another move in progress."""
        self._require_closed_stop()
        CommandRefused.raise_if(self.faults.force_dead, Code.HARDWARE, "the force sensor is dead")
        CommandRefused.raise_if(self.is_busy(now), Code.IGNORED, "on the move")

    def _require_limit(self) -> None:
        if self.limit_n is None:
            raise CommandRefused(Code.IGNORED, "CAL:FORC:LIM first; it has no default")

    def _require_free(self) -> None:
        CommandRefused.raise_if(self.attached, Code.IGNORED, "skin is held; CAL:REL first")

    def _begin(self, to_mm: float, now: float, *, homing: bool) -> str:
        caliper = self._caliper
        stalls_at_mm = None
        if self._rng.random() < self._stall:
            share = float(self._rng.random())
            stalls_at_mm = self.aperture_mm + share * (to_mm - self.aperture_mm)
        speed = caliper.speed_mm_per_s * (HOMING_SPEED_FRACTION if homing else 1.0)
        self.moves.append((now, to_mm))
        self._move = _Move(
            len(self.moves), homing, now, self.aperture_mm, to_mm, speed, stalls_at_mm
        )
        self._last_force_n = self.measured_force_n
        return str(len(self.moves))

    def _home(self, _: str, now: float) -> str:
        self._require_fit(now)
        self._require_limit()
        self._require_free()
        self.homed = False
        home_mm = self._caliper.aperture_mm
        answer = self._begin(home_mm, now, homing=True)
        if self.faults.home_missed and self._move is not None:
            # the jaws continue to the end of the travel, where the motor loses its steps
            end_mm = self._ends_mm[0] if self.aperture_mm > home_mm else self._ends_mm[1]
            beyond_mm = math.copysign(2.0 * STALL_LAG_MM, end_mm - home_mm)
            self._move.to_mm, self._move.stalls_at_mm = end_mm + beyond_mm, end_mm
            self._move.schedule()
        return answer

    def _step(self, arguments: str, now: float) -> str:
        if _STEP_PATTERN.fullmatch(arguments) is None:
            raise CommandRefused(Code.SYNTAX, "expected a whole number of steps")
        step = int(arguments)
        if not self.step_min <= step <= self.step_max:
            raise CommandRefused(
                Code.OUT_OF_RANGE, f"expected {self.step_min} to {self.step_max} steps"
            )
        self._require_fit(now)
        self._require_limit()
        CommandRefused.raise_if(not self.homed, Code.IGNORED, "CAL:HOME first")
        to_mm = self._caliper.reading_mm(step)
        if self._barred is not None:
            direction, reading_mm = self._barred
            if direction * (to_mm - reading_mm) >= 0.0:
                raise CommandRefused(Code.FORCE, f"the limit was met at {reading_mm:.3f} mm")
        return self._begin(to_mm, now, homing=False)

    def _turn(self, arguments: str, now: float) -> None:
        angle_deg = parse_decimal(arguments, 0.0, 180.0, "degrees", digits=3) / 1e3
        if angle_deg not in self._caliper.angles_deg:
            known = ", ".join(f"{angle:g}" for angle in self._caliper.angles_deg)
            raise CommandRefused(Code.OUT_OF_RANGE, f"expected one of {known} degrees")
        self._require_fit(now)
        self._require_free()
        turns_s = abs(angle_deg - self.angle_deg) / ROTATION_DEG_PER_S
        self._turning = (add_us(now, 1e6 * turns_s), angle_deg)
        self.advance(now)

    # skin -------------------------------------------------------------------------------------

    def _attach(self, _: str, now: float) -> None:
        self._require_fit(now)
        self._require_free()
        home_mm = self._caliper.aperture_mm
        if not self.homed or abs(self.aperture_mm - home_mm) > 1e-6:
            raise CommandRefused(Code.IGNORED, "CAL:HOME, or step 0, first")
        self._zero_n = self._load.force_n + self._offset_n
        self._load.attach(self.angle_deg)
        self.attached = True
        self._barred = None
        self._on_change(now)

    def _get_force(self, _: str, now: float) -> str:
        CommandRefused.raise_if(self.faults.force_dead, Code.HARDWARE, "the force sensor is dead")
        return f"{self.measured_force_n:.3f}"

    def _set_limit(self, arguments: str, now: float) -> None:
        limit_n = parse_decimal(arguments, *FORCE_LIMIT_N, "N", digits=3) / 1e3
        if abs(self.measured_force_n) >= limit_n:
            raise CommandRefused(
                Code.FORCE, f"there are {self.measured_force_n:.3f} N now; CAL:REL first"
            )
        self.limit_n = limit_n
        self._barred = None
