"""Interface of controlled devices: clock, events, emergency stop, and the loads they act on."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from capture.devices.wire import Code
from capture.rig import Rig
from rigsim.boxes.command import Command, CommandRefused, elapsed_us, on_clock, parse_token
from rigsim.boxes.faults import NO_FAULTS, Faults

STATUS_INTERLOCK = 256


class JawLoad(Protocol):
    """Load on the caliper's jaws."""

    @property
    def force_n(self) -> float:
        """Force on the jaws, N; > 0 pulls them together."""

    def attach(self, angle_deg: float) -> None:
        """Attach the load at the jaws' present distance."""

    def turn(self, angle_deg: float) -> None:
        """Turn the empty jaws."""

    def move(self, aperture_mm: float) -> None:
        """Move the jaws to a distance."""

    def release(self) -> None:
        """Detach the load."""


class SuctionLoad(Protocol):
    """Load on the suction pump."""

    def place(self, site: str, angle_deg: float, now: float) -> None:
        """Place the head at a site."""

    def remove(self, now: float) -> None:
        """Take the head off."""

    def start_suction(self, target_mbar: float, now: float) -> None:
        """Close the vent and switch the pump on."""

    def vent(self, now: float) -> None:
        """Switch the pump off and open the vent."""

    def suction_mbar(self, now: float) -> float:
        """Return the suction now, mbar."""

    def camera_c(self, now: float) -> float:
        """Return the temperature of the camera behind the head, degrees Celsius."""


def _ignore(*_: object) -> None:
    """Do nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Wiring:
    """Connections of a controller: rig, loads, faults and observers."""

    rig: Rig
    """The driven rig: lights with their limits, cameras, caliper or probe."""
    rng: np.random.Generator
    """Random numbers of its whole life: noise, misfires, sticking parts, initial jaw position."""
    faults: Faults = NO_FAULTS
    """Its faults."""
    on_light: Callable[[Any], None] = _ignore
    """Called with each pop, and with each interval of other light when it has ended."""
    on_trigger: Callable[..., None] = _ignore
    """Called with the world time in s of each pulse on the camera line. Where each camera has its
    own line, the mask of the pulsed cameras is also passed."""
    on_grip: Callable[[float], None] = _ignore
    """Called with the world time in s after each change of the load that the caliper's jaws
    hold."""
    skin: JawLoad | None = None
    """Skin between the caliper's jaws; None where the rig has no caliper."""
    head: SuctionLoad | None = None
    """The contact probe's head and the skin below it; None where the rig has no probe."""


class Device(ABC):
    """Base class of controlled devices.

    Parameters
    ----------
    wiring
        The driven rig, its faults, and observers of its actions.
    """

    kind: str
    model: str

    def __init__(self, wiring: Wiring) -> None:
        self.rig, self.faults, self._rng = wiring.rig, wiring.faults, wiring.rng
        self._on_light, self._on_trigger = wiring.on_light, wiring.on_trigger
        self.interlock = self.faults.interlock
        opens_s = on_clock(self.faults.interlock_after)
        self.stop_changes_s = [] if self.interlock or opens_s == math.inf else [opens_s]
        """World times at which the emergency stop opens and closes in turn; past ones are gone."""
        self._powered_at = 0.0
        self._events: list[tuple[str, str]] = []

    @abstractmethod
    def commands(self) -> dict[str, Command]:
        """Return the command table, which is the controller's manual."""

    @abstractmethod
    def capabilities(self) -> Mapping[str, Any]:
        """Return limits and counts as JSON values; the names include the units."""

    @abstractmethod
    def states(self, now: float) -> dict[int, bool]:
        """Return the bits from 4 of ``STAT?`` except `STATUS_INTERLOCK`, each with its state."""

    @abstractmethod
    def is_busy(self, now: float) -> bool:
        """Return whether an accepted action is still in progress."""

    @abstractmethod
    def go_dark(self, now: float) -> None:
        """Switch off every light at once and release the skin."""

    @abstractmethod
    def advance(self, now: float) -> None:
        """Advance time to `now`, in s."""

    @abstractmethod
    def deadline(self) -> float:
        """Return the time of the device's next change of its own, in s; inf for never."""

    def reset(self, now: float, *, power_up: bool) -> None:
        """Restore the power-up settings."""
        self.go_dark(now)
        if power_up:
            self._powered_at = now
            self._events.clear()

    def status_bits(self, now: float) -> int:
        """Return the bits from 4 of ``STAT?``."""
        states = self.states(now) | {STATUS_INTERLOCK: self.interlock}
        return sum(bit for bit, is_set in states.items() if is_set)

    def take_events(self) -> list[tuple[str, str]]:
        """Return and clear the pending events: name and payload."""
        events = list(self._events)
        self._events.clear()
        return events

    def queue_event(self, name: str, payload: str) -> None:
        """Queue an event for sending."""
        self._events.append((name, payload))

    def clock_us(self, now: float) -> int:
        """Return the time since power-up, us."""
        return elapsed_us(self._powered_at, now)

    def light_now(self, now: float) -> Sequence[Any]:
        """Return the intervals of light that have not ended, as emitted so far."""
        return ()

    def _trigger_camera(self, arguments: str, now: float) -> str:
        token = parse_token(arguments)
        self._on_trigger(now)
        return f"{token},{self.clock_us(now)}"

    def _require_closed_stop(self) -> None:
        CommandRefused.raise_if(self.interlock, Code.INTERLOCK)

    def _stop_changes_at_s(self) -> float:
        """Return when the emergency stop opens or closes next, s; inf for never."""
        return self.stop_changes_s[0] if self.stop_changes_s else math.inf

    def _follow_stop(self, now: float) -> None:
        """Open or close the emergency stop if that is due; it makes dark each time it opens."""
        if self._stop_changes_at_s() <= now:
            self.stop_changes_s.pop(0)
            self.interlock = not self.interlock
            if self.interlock:
                self._make_dark_at_stop(now)

    def _make_dark_at_stop(self, now: float) -> None:
        self.go_dark(now)
