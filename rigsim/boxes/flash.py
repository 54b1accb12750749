"""Emulate the flash controller: two heads fired together, modelling lamps, analyzer, camera line.

Its manual is its command table (`FlashUnit.commands`) and these rules. A pop takes its fraction of
the capacitor's energy; the charger restores it. ``FLAS:FIRE`` pulses the camera line and pops. It
is refused while the analyzer turns (-213), before the tube has recovered (103: the recycle time is
proportional to the last power), beyond the pops per minute (101), before the charge suffices
(-213), and with the emergency stop open (107). It fails with -240 when the tube does not ignite;
the camera line has pulsed by then, so that frame is dark. ``FLAS:SYNC`` sets the delay from the
camera line to the pop, for cameras whose shutters take time to open. ``FLAS:LED`` replaces the
tube by a narrow-band LED of the heads for the next pop, with the same energy, charge and timing;
after that pop, or when made dark, the tube is back. The answer follows the pop;
any command that makes dark before the pop prevents it (-240 too). Modelling lamps include their own
end and go out before a pop; their driver trips when too hot (102).
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from capture.devices.wire import Code
from rigsim.boxes.command import (
    Command,
    CommandHandler,
    CommandRefused,
    PendingReply,
    add_us,
    build_command_table,
    ceil_ms,
    elapsed_s,
    elapsed_us,
    parse_choice,
    parse_decimal,
    parse_token,
    rotation_us,
)
from rigsim.boxes.device import Device, Wiring

Polarizer = Literal["parallel", "crossed"]

MIN_POWER = 1.0 / 256.0
LAMP_RANGE_MS = (1.0, 500.0)
ANALYZER_RANGE_DEG = (0.0, 180.0)
SYNC_RANGE_US = (0.0, 50_000.0)
"""Delay from camera line to pop; an answer must not block the line for longer."""
LED_CENTER_RANGE_NM = (420.0, 680.0)
LED_WIDTH_RANGE_NM = (5.0, 50.0)
"""LEDs of the emulated heads, which have one of each center and width."""
POP_WINDOW_US = 60_000_000
POLARIZER_READING_DEG: dict[Polarizer, float] = {"parallel": 0.0, "crossed": 90.0}

CHARGER_HEADROOM = 1.05
"""Target voltage of the charger relative to full; charging stops at full."""
CHARGE_TIME_FRACTION = 0.9
"""Time from empty to full as a fraction of the recycle time."""
LAMP_TAU_S = 20.0
"""Time constant of the lamp driver's temperature, s."""
HEAT_TRIP, HEAT_CLEAR = 0.8, 0.5
"""Temperatures at which the lamp's driver trips and recovers; 1 is its steady state."""
HEAT_TOLERANCE = 1e-6
"""Error of a temperature that a controller computes in single precision."""
POWER_STEPS = 100_000_000
"""Steps of the power from zero to full."""


@dataclass(frozen=True, slots=True)
class FlashPop:
    """A pop of the flash that was emitted."""

    token: str
    """Name given by the host."""
    t_s: float
    """World time, s."""
    power: float
    """Energy relative to a full pop, 0 to 1."""
    polarizer: Polarizer
    """Analyzer at its parallel (0 degrees) or crossed (90 degrees) stop."""
    analyzer_deg: float | None
    """Reading of the rotator in degrees when it is not at a requested stop."""
    led: str = ""
    """Name of the LED's spectrum in `model.spectra`; empty: the flash tube."""


@dataclass(slots=True)
class _Lamp:
    lit: bool = False
    end_s: float = math.inf
    heat: float = 0.0
    hot: bool = False


class FlashUnit(Device):
    """State of the flash device behind its controller.

    Parameters
    ----------
    wiring
        Its recycling, pops per minute and analyzer; each pop is passed on as a `FlashPop`.
    """

    kind = "flash"
    model = "FLASH2"

    def __init__(self, wiring: Wiring) -> None:
        super().__init__(wiring)
        rig, faults = self.rig, self.faults
        self._pops_per_min = math.floor(rig.max_pops_per_min)
        self._s_per_deg = rig.polarizer_move_s / 90.0
        self._quarter_turn_us = round(1e6 * rig.polarizer_move_s)
        self._recycle_us = round(1e6 * rig.recycle_s)
        headroom = math.log(CHARGER_HEADROOM / (CHARGER_HEADROOM - 1.0))
        self._charge_tau_s = faults.slow_charge * CHARGE_TIME_FRACTION * rig.recycle_s / headroom
        self._now = 0.0
        # state that survives the loss of power: the count, heat, charge and the last pops
        self.count = 0
        self.lamp_times: deque[tuple[float, float]] = deque(maxlen=10_000)
        self._lamp = _Lamp(heat=faults.heat, hot=faults.heat >= HEAT_TRIP)
        self._lamp_since = 0.0
        self._pops: deque[float] = deque(maxlen=max(1, self._pops_per_min))
        self._volt = 1.0  # relative to full, at `_volt_at`; initially charged
        self._volt_at = 0.0
        self._recycled_at = 0.0
        self._coming: tuple[float, str] | None = None  # time of the next pop, and its token
        self._answer_at = 0.0  # of the last delayed pop, even if it was prevented
        self._outcome: str | CommandRefused = ""
        self.angle_deg = 0.0
        self._settled_at = 0.0
        self.reset(0.0, power_up=True)

    # settings ---------------------------------------------------------------------------------

    def reset(self, now: float, *, power_up: bool) -> None:
        """Restore the power-up settings: parallel, full power, dark."""
        super().reset(now, power_up=power_up)
        self.power_steps = POWER_STEPS
        self.sync_us = 0
        self.polarizer: Polarizer = "parallel"
        self.analyzer_deg: float | None = None
        self.last_report = ""
        self.led = ""
        self._answer_at = now if power_up else self._answer_at
        self._turn(POLARIZER_READING_DEG["parallel"], now)

    def capabilities(self) -> Mapping[str, Any]:
        """Return limits and counts; the names include the units."""
        return {
            "power_min": MIN_POWER,
            "power_max": 1.0,
            "analyser_min_deg": ANALYZER_RANGE_DEG[0],
            "analyser_max_deg": ANALYZER_RANGE_DEG[1],
            "sync_min_us": SYNC_RANGE_US[0],
            "sync_max_us": SYNC_RANGE_US[1],
            "led_min_nm": LED_CENTER_RANGE_NM[0],
            "led_max_nm": LED_CENTER_RANGE_NM[1],
            "lamp_min_ms": LAMP_RANGE_MS[0],
            "lamp_max_ms": LAMP_RANGE_MS[1],
            "recycle_s": self.rig.recycle_s,
            "pops_per_min": self._pops_per_min,
            "move_s_per_deg": round(self._s_per_deg, 6),
        }

    def commands(self) -> dict[str, Command]:
        """Return the command table, which is the controller's manual."""
        acts: dict[str, CommandHandler] = {
            "FLAS:POL": self._set_polarizer,
            "FLAS:POL?": self._get_polarizer,
            "FLAS:POL:ANG": self._set_angle,
            "FLAS:POL:ANG?": self._get_angle,
            "FLAS:POW": self._set_power,
            "FLAS:POW?": self._get_power,
            "FLAS:SYNC": self._set_sync,
            "FLAS:SYNC?": lambda *_: str(self.sync_us),
            "FLAS:LED": self._set_led,
            "FLAS:LED?": lambda *_: self.led or "TUBE",
            "FLAS:CHAR?": self._get_charge,
            "FLAS:FIRE": self._fire,
            "FLAS:LAST?": lambda *_: self.last_report or "NONE",
            "FLAS:COUN?": lambda *_: str(self.count),
            "FLAS:LAMP": self._set_lamp,
            "FLAS:LAMP?": lambda *_: str(int(self._lamp.lit)),
            "CAM:TRIG": self._trigger_camera,
        }
        return build_command_table("flash", acts)

    # time -------------------------------------------------------------------------------------

    def deadline(self) -> float:
        """Return the time of the next change of its own, in s; inf for never."""
        pop = math.inf if self._coming is None else self._coming[0]
        return min(self._stop_changes_at_s(), pop, self._lamp_out())

    def _lamp_out(self) -> float:
        if not self._lamp.lit:
            return math.inf
        span = (1.0 - self._lamp.heat) / (1.0 - HEAT_TRIP)
        trips_us = math.ceil(1e6 * LAMP_TAU_S * math.log(max(span, 1.0)))
        return min(self._lamp.end_s, add_us(self._now, trips_us))

    def advance(self, now: float) -> None:
        """Advance time to `now`, in s."""
        while (due := self.deadline()) <= now:
            self._follow_stop(due)
            lamp_ends = self._lamp_out() <= due
            self._heat_until(due)
            if self._coming is not None and self._coming[0] <= due:
                self._pop(due)
            if lamp_ends:
                if self._lamp.heat >= HEAT_TRIP - HEAT_TOLERANCE:
                    self._lamp.hot = True
                self._lamps_out(due)
        self._heat_until(now)
        if self._lamp.heat < HEAT_CLEAR:
            self._lamp.hot = False

    def _heat_until(self, now: float) -> None:
        lamp = self._lamp
        goal = 1.0 if lamp.lit else 0.0
        passed_s = max(0.0, elapsed_s(self._now, now))
        lamp.heat = goal + (lamp.heat - goal) * math.exp(-passed_s / LAMP_TAU_S)
        self._now = max(now, self._now)

    def go_dark(self, now: float) -> None:
        """Switch the lamps off, prevent a pending pop, and return to the tube."""
        self._lamps_out(now)
        self.led = ""
        if self._coming is not None:
            self._coming = None
            self._outcome = CommandRefused(Code.HARDWARE, "made dark before the pop")

    def _lamps_out(self, now: float) -> None:
        if self._lamp.lit:
            self._lamp.lit = False
            self._lamp.end_s = math.inf
            self.lamp_times.append((self._lamp_since, now))

    @property
    def lit(self) -> bool:
        """Whether a modelling lamp is on."""
        return self._lamp.lit

    def is_busy(self, now: float) -> bool:
        """Return whether the analyzer is turning."""
        return now < self._settled_at

    def states(self, now: float) -> dict[int, bool]:
        """Return bits 16 turning, 32 no pop possible yet, 64 lamp on, 128 too hot."""
        waits = self._wait_for_fire(now)[0] > 0
        return {16: self.is_busy(now), 32: waits, 64: self._lamp.lit, 128: self._lamp.hot}

    # analyzer ---------------------------------------------------------------------------------

    def _turn(self, reading_deg: float, now: float) -> None:
        turn_mdeg = round(1e3 * (reading_deg - self.angle_deg))
        turn_us = rotation_us(turn_mdeg, self._quarter_turn_us)
        self._settled_at = add_us(max(now, self._settled_at), turn_us)
        self.angle_deg = reading_deg

    def _set_polarizer(self, arguments: str, now: float) -> None:
        stop = parse_choice(arguments, ("PAR", "CROS"))
        self.polarizer = "parallel" if stop == "PAR" else "crossed"
        self.analyzer_deg = None
        self._turn(POLARIZER_READING_DEG[self.polarizer], now)

    def _get_polarizer(self, _: str, now: float) -> str:
        return "PAR" if self.polarizer == "parallel" else "CROS"

    def _set_angle(self, arguments: str, now: float) -> None:
        reading_mdeg = parse_decimal(arguments, *ANALYZER_RANGE_DEG, "degrees", digits=3)
        self.analyzer_deg = reading_mdeg / 1e3
        self._turn(self.analyzer_deg, now)

    def _get_angle(self, _: str, now: float) -> str:
        return f"{self.angle_deg:.3f}"

    # flash ------------------------------------------------------------------------------------

    def _set_power(self, arguments: str, now: float) -> None:
        self.power_steps = parse_decimal(arguments, MIN_POWER, 1.0, "of full power", digits=8)

    @property
    def power(self) -> float:
        """Power of the next pops relative to full."""
        return self.power_steps / POWER_STEPS

    @property
    def sync_s(self) -> float:
        """Time from the camera line to the pop, s."""
        return self.sync_us / 1e6

    def _get_power(self, _: str, now: float) -> str:
        return f"{self.power:.8f}"

    def _set_sync(self, arguments: str, now: float) -> None:
        self.sync_us = parse_decimal(arguments, *SYNC_RANGE_US, "us", digits=0)

    def _set_led(self, arguments: str, now: float) -> None:
        center, comma, width = arguments.partition(",")
        CommandRefused.raise_if(not comma, Code.SYNTAX, "expected center,width in nm")
        center_nm = parse_decimal(center, *LED_CENTER_RANGE_NM, "nm", digits=0)
        width_nm = parse_decimal(width, *LED_WIDTH_RANGE_NM, "nm", digits=0)
        self.led = f"LED-{center_nm}-{width_nm}"

    def charge(self, now: float) -> float:
        """Return the energy in the capacitor at `now`, 0 to 1 of a full pop."""
        return self._voltage(now) ** 2

    def _voltage(self, now: float) -> float:
        # V(t) = V_end - (V_end - V_0) exp(-t / tau), cut at full; the energy is V^2.
        gap = CHARGER_HEADROOM - self._volt
        passed_s = elapsed_s(self._volt_at, now)
        return min(1.0, CHARGER_HEADROOM - gap * math.exp(-passed_s / self._charge_tau_s))

    def _wait_for_fire(self, now: float) -> tuple[int, Code, str]:
        """Return the time until FIRE is accepted, in us, with the code and text of the refusal."""
        # The charge suffices from V = sqrt(power) on: t = tau ln((V_end - V) / (V_end -
        # sqrt(power))).
        need = math.sqrt(self.power)
        gap = (CHARGER_HEADROOM - self._voltage(now)) / (CHARGER_HEADROOM - need)
        full = len(self._pops) == self._pops_per_min
        charging_us = 1e6 * self._charge_tau_s * math.log(max(gap, 1.0))
        window_us = POP_WINDOW_US - elapsed_us(self._pops[0], now) if full else 0
        waits = [
            (elapsed_us(now, self._answer_at), Code.IGNORED, "about to pop"),
            (elapsed_us(now, self._settled_at), Code.IGNORED, "analyzer turning"),
            (elapsed_us(now, self._recycled_at), Code.RECYCLE, "tube"),
            (window_us, Code.DUTY, "pops per minute"),
            (math.floor(charging_us + 0.5), Code.IGNORED, "charging"),
        ]
        return max(waits, key=lambda wait: wait[0])

    def _get_charge(self, _: str, now: float) -> str:
        wait_ms = ceil_ms(max(0, self._wait_for_fire(now)[0]))
        return f"{self.charge(now):.4f},{int(wait_ms == 0)},{wait_ms}"

    def _fire(self, arguments: str, now: float) -> str | PendingReply:
        token = parse_token(arguments)
        self._require_closed_stop()
        wait_us, code, why = self._wait_for_fire(now)
        if wait_us > 0:
            raise CommandRefused(code, f"{why}, {ceil_ms(wait_us)} ms")
        self._lamps_out(now)
        self._on_trigger(now)
        at_s = add_us(now, self.sync_us)
        self._coming = (at_s, token)
        self._answer_at = at_s
        if self.sync_us > 0:
            return PendingReply(at_s, lambda: self._outcome)
        self._pop(now)
        if isinstance(self._outcome, CommandRefused):
            raise self._outcome
        return self._outcome

    def _pop(self, now: float) -> None:
        """Fire the tube as scheduled and record the outcome."""
        token = "" if self._coming is None else self._coming[1]
        self._coming = None
        self._lamps_out(now)
        if self._rng.random() < self.faults.misfire:
            self._outcome = CommandRefused(Code.HARDWARE, "the tube did not ignite")
            return
        self._volt = math.sqrt(max(0.0, self._voltage(now) ** 2 - self.power))
        self._volt_at = now
        recycle_us = (2 * self._recycle_us * self.power_steps + POWER_STEPS) // (2 * POWER_STEPS)
        self._recycled_at = add_us(now, recycle_us)
        self._pops.append(now)
        self.count += 1
        pop = FlashPop(token, now, self.power, self.polarizer, self.analyzer_deg, self.led)
        self._on_light(pop)
        self.last_report = ",".join(
            (
                token,
                str(self.clock_us(now)),
                self._get_power("", now),
                self._get_polarizer("", now),
                self._get_angle("", now),
                str(self.count),
                *([self.led] if self.led else []),
            )
        )
        self.led = ""
        self._outcome = self.last_report

    # lamps ------------------------------------------------------------------------------------

    def _set_lamp(self, arguments: str, now: float) -> None:
        what, _, length = arguments.partition(",")
        if parse_choice(what, ("ON", "OFF")) == "OFF":
            CommandRefused.raise_if(length, Code.SYNTAX, "expected OFF")
            self._lamps_out(now)
            return
        span_us = parse_decimal(length, *LAMP_RANGE_MS, "ms", digits=3)
        self._require_closed_stop()
        CommandRefused.raise_if(self._lamp.hot, Code.THERMAL, f"wait until below {HEAT_CLEAR:g}")
        CommandRefused.raise_if(self.faults.lamp_dead, Code.HARDWARE, "the lamp draws no current")
        if not self._lamp.lit:
            self._lamp.lit = True
            self._lamp_since = now
        self._lamp.end_s = add_us(now, span_us)
