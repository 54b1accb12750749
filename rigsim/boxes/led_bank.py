"""Model the LEDs and their driver: switching, heat, duty and dose (sans-I/O)."""

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from capture.devices.wire import Code
from capture.rig import LedLimits, Rig
from rigsim.boxes.command import CommandRefused, add_us, elapsed_s, whole_us
from rigsim.boxes.faults import Faults
from rigsim.boxes.led_table import LedPulse

TRIP_RESET_FRACTION = 0.5
"""Temperature below which a hot LED may be lit again, relative to the trip temperature."""
HEAT_TOLERANCE = 1e-6
"""Error of a temperature that a controller computes in single precision."""


class _LightGiven:
    """Light of one LED's intervals given until a time, in level times s; times in us."""

    def __init__(self, on: Sequence[int], off: Sequence[int], level: Sequence[float]) -> None:
        steps = [*zip(on, level, strict=True), *((t, -v) for t, v in zip(off, level, strict=True))]
        steps.sort(key=lambda step: step[0])
        self._times, self._given = [steps[0][0]], [0.0]
        rate, given = steps[0][1], 0.0
        for time, change in steps[1:]:
            given += rate * ((time - self._times[-1]) / 1e6)
            rate += change
            self._times.append(time)
            self._given.append(given)

    def until(self, at: int) -> float:
        """Return the light given until a time."""
        times, given = self._times, self._given
        if at <= times[0] or at >= times[-1]:
            return given[0] if at <= times[0] else given[-1]
        place = bisect_right(times, at) - 1
        slope = (given[place + 1] - given[place]) / (times[place + 1] - times[place])
        return slope * (at - times[place]) + given[place]


class LedBank:
    """Switching state of the LEDs and the history that their driver keeps.

    Parameters
    ----------
    rig
        Rig of the LEDs, with their limits.
    on_light
        Called with each interval of light when it ends: LED, level, start and end in s.
    faults
        Dead LEDs; weak LEDs, which the driver does not detect; and the heat of all at power-up.

    Attributes
    ----------
    failed : set of int
        Numbers of the LEDs that have been found to draw no current since the last reset; they are
        not driven again.
    """

    def __init__(self, rig: Rig, faults: Faults, on_light: Callable[[LedPulse], None]) -> None:
        lights, limits = rig.lights, rig.leds or LedLimits()
        self.limits = limits
        self.failed: set[int] = set()
        self._dead, self._dead_from_s = faults.dead_leds, faults.led_dead_after
        self.count = len(lights)
        self._power_w = np.array([light.power_w or 0.0 for light in lights])
        self._weak = faults.weak_leds
        self._on_light = on_light
        # number -> (level, since, end); an interval of light in progress
        self._lit: dict[int, tuple[float, float, float]] = {}
        self._past: dict[int, deque[LedPulse]] = {}
        self._heat = np.full(self.count, faults.heat)
        self._hot = self._heat >= limits.thermal_trip
        self._heat_at = 0.0
        self._due: float | None = None  # of `deadline`; None: heat or light have changed since
        self._dose_ws = np.zeros(self.count)

    # now --------------------------------------------------------------------------------------

    @property
    def lit(self) -> tuple[int, ...]:
        """Numbers of the LEDs that are on, sorted."""
        return tuple(sorted(self._lit))

    @property
    def has_tripped(self) -> bool:
        """Whether the driver has tripped for an LED."""
        return bool(self._hot.any())

    def dose_ws(self, led: int) -> float:
        """Return the energy that an LED has emitted toward this subject, Ws."""
        return float(self._dose_ws[led])

    def new_subject(self) -> None:
        """Restart the dose count."""
        self._dose_ws[:] = 0.0

    # time -------------------------------------------------------------------------------------

    def deadline(self) -> float:
        """Return when an LED goes off or its driver trips, in s; inf for never."""
        if self._due is None:
            self._due = self._find_due()
        return self._due

    def _find_due(self) -> float:
        due = math.inf
        trip, tau = self.limits.thermal_trip, self.limits.thermal_tau_s
        for led, (level, _, end_s) in self._lit.items():
            due = min(due, end_s)
            if level > trip:
                ratio = (level - float(self._heat[led])) / (level - trip)
                trips_us = math.ceil(1e6 * tau * math.log(max(ratio, 1.0)))
                due = min(due, add_us(self._heat_at, trips_us))
        return due

    def advance(self, now: float) -> list[int]:
        """Advance time to `now`, at most one deadline; return LEDs that have tripped."""
        self._heat_until(now)
        trip = self.limits.thermal_trip - HEAT_TOLERANCE
        tripped = [k for k in self._lit if self._heat[k] >= trip]
        for led in tripped:
            self._hot[led] = True
        for led in [k for k, (_, _, end_s) in self._lit.items() if end_s <= now]:
            self.switch_off(led, now)
        self._hot &= self._heat >= TRIP_RESET_FRACTION * self.limits.thermal_trip
        return tripped

    def _heat_until(self, now: float) -> None:
        if now <= self._heat_at:
            return
        # dT/dt = (level - T) / tau: each temperature relaxes exponentially toward its LED's level.
        goal = np.zeros(self.count)
        for led, (level, _, _) in self._lit.items():
            goal[led] = level
        fade = math.exp(-elapsed_s(self._heat_at, now) / self.limits.thermal_tau_s)
        self._heat = goal + (self._heat - goal) * fade
        self._heat_at = now
        self._due = None

    # switching --------------------------------------------------------------------------------

    def draws_current(self, led: int, now: float) -> bool:
        """Return whether an LED would be lit by `switch_on`."""
        return led not in self.failed and not (led in self._dead and now >= self._dead_from_s)

    def switch_on(self, led: int, level: float, now: float, *, end_s: float = math.inf) -> bool:
        """Light an LED until `end_s`; return False when it is newly found to draw no current."""
        self.switch_off(led, now)
        if led in self.failed:
            return True
        if level <= 0.0:
            return True  # a board measures no current without driving the LED
        if not self.draws_current(led, now):
            self.failed.add(led)
            return False
        self._heat_until(now)
        self._lit[led] = (level, now, end_s)
        self._due = None
        return True

    def switch_off(self, led: int, now: float) -> None:
        """Put an LED out."""
        if led not in self._lit:
            return
        self._heat_until(now)
        level, since, _ = self._lit.pop(led)
        self._due = None
        if now <= since:
            return
        self._dose_ws[led] += self._power_w[led] * level * elapsed_s(since, now)
        self._past.setdefault(led, deque(maxlen=256)).append(LedPulse(led, level, since, now))
        self._on_light(LedPulse(led, level * self._weak.get(led, 1.0), since, now))

    def all_off(self, now: float) -> None:
        """Put every LED out."""
        for led in list(self._lit):
            self.switch_off(led, now)

    def ongoing_pulses(self, now: float) -> list[LedPulse]:
        """Return the intervals of light that have not ended, as emitted so far."""
        return [
            LedPulse(led, level * self._weak.get(led, 1.0), since, max(now, since))
            for led, (level, since, _) in self._lit.items()
        ]

    # what is asked for ------------------------------------------------------------------------

    def pulses_since(self, start_s: float) -> list[LedPulse]:
        """Return light driven after `start_s`, and intervals in progress to their end."""
        past = [pulse for row in self._past.values() for pulse in row if pulse.t_off_s > start_s]
        still = [LedPulse(led, level, on, end) for led, (level, on, end) in self._lit.items()]
        return past + [pulse for pulse in still if math.isfinite(pulse.t_off_s)]

    def require_within_limits(
        self, requested: Iterable[LedPulse], now: float
    ) -> tuple[float, float, float]:
        """Return the maximum duty, heat and dose (Ws) with `requested` light, or refuse it."""
        limits = self.limits
        rows: dict[int, list[LedPulse]] = {}
        for pulse in requested:
            rows.setdefault(pulse.led, []).append(pulse)
        most_duty = most_heat = most_dose = 0.0
        self._heat_until(now)
        for led, new in rows.items():
            CommandRefused.raise_if(
                self._hot[led], Code.THERMAL, f"LED {led}, wait until it has cooled"
            )
            duty = self._duty(led, new, now)
            if duty > limits.max_duty + 1e-9:
                raise CommandRefused(
                    Code.DUTY, f"LED {led}, {duty:.3f} over {limits.duty_window_s:g} s"
                )
            heat = self._heat_after(led, new, now)
            if heat >= limits.thermal_trip:
                raise CommandRefused(Code.THERMAL, f"LED {led} would reach {heat:.2f}")
            give = sum(pulse.level * elapsed_s(pulse.t_on_s, pulse.t_off_s) for pulse in new)
            dose = float(self._dose_ws[led] + self._power_w[led] * give)
            if dose > limits.dose_ws:
                raise CommandRefused(
                    Code.LIGHT_DOSE, f"LED {led}, {dose:.2f} of {limits.dose_ws:g} Ws"
                )
            most_duty, most_heat = max(most_duty, duty), max(most_heat, heat)
            most_dose = max(most_dose, dose)
        return most_duty, most_heat, most_dose

    def _duty(self, led: int, new: Sequence[LedPulse], now: float) -> float:
        """Return the maximum mean level of an LED over all windows that end in `new` light."""
        window = self.limits.duty_window_s
        past = [pulse for pulse in self._past.get(led, ()) if pulse.t_off_s > now - window]
        if led in self._lit and self._lit[led][1] < now:
            # the request replaces light in progress, but its energy so far counts
            past.append(LedPulse(led, self._lit[led][0], self._lit[led][1], now))
        pulses = [*past, *new]
        # whole microseconds: equal windows have equal means, whatever the time of day
        window_us, now_us = round(1e6 * window), whole_us(now)
        on = [whole_us(pulse.t_on_s) - now_us for pulse in pulses]
        off = [whole_us(pulse.t_off_s) - now_us for pulse in pulses]
        light = _LightGiven(on, off, [pulse.level for pulse in pulses])
        # the mean is greatest where light ends, or where a window's far edge leaves darkness
        first, last, old = min(on[len(past) :]), max(off[len(past) :]), len(past)
        ends = [*off[old:], *(t + window_us for t in on), *(t + window_us for t in off[:old])]
        return (
            max(
                light.until(end) - light.until(end - window_us)
                for end in ends
                if first < end <= last
            )
            / window
        )

    def _heat_after(self, led: int, new: Sequence[LedPulse], now: float) -> float:
        """Return the highest temperature that an LED will reach."""
        heat, at, most = float(self._heat[led]), now, 0.0
        for pulse in sorted(new, key=lambda pulse: pulse.t_on_s):
            dark_s = max(0.0, elapsed_s(at, pulse.t_on_s))
            lit_s = elapsed_s(pulse.t_on_s, pulse.t_off_s)
            heat *= math.exp(-dark_s / self.limits.thermal_tau_s)
            fade = math.exp(-lit_s / self.limits.thermal_tau_s)
            heat = pulse.level + (heat - pulse.level) * fade
            at, most = pulse.t_off_s, max(most, heat)
        return most
