"""What a controller controls, and what all of them have: a clock, events, an emergency stop."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

from capture.devices.wire import Code
from capture.rig import Rig
from rigsim.boxes.command import Command, Refused
from rigsim.boxes.faults import Faults

STATUS_INTERLOCK = 256


class Device(ABC):
    """What a controller controls.

    Parameters
    ----------
    rig
        What it drives.
    faults
        What is wrong with it.
    """

    kind: str
    model: str

    def __init__(self, rig: Rig, faults: Faults) -> None:
        self.rig, self.faults = rig, faults
        self.interlock = faults.interlock
        self._powered_at = 0.0
        self._events: list[tuple[str, str]] = []

    @abstractmethod
    def commands(self) -> dict[str, Command]:
        """Return the command table: the manual of the box."""

    @abstractmethod
    def capabilities(self) -> Mapping[str, Any]:
        """Return limits and counts, units in the names, as JSON values."""

    @abstractmethod
    def states(self, now: float) -> dict[int, bool]:
        """Return bits 4 and up of ``STAT?`` but `STATUS_INTERLOCK`, and whether each is set."""

    @abstractmethod
    def busy(self, now: float) -> bool:
        """Return whether something that was accepted is still going on."""

    @abstractmethod
    def go_dark(self, now: float) -> None:
        """Switch every light off at once, and let go of the skin."""

    @abstractmethod
    def advance(self, now: float) -> None:
        """Let time pass up to `now`, in s."""

    @abstractmethod
    def deadline(self) -> float:
        """Return when the device will next change by itself, in s; inf for never."""

    def reset(self, now: float, *, power_up: bool) -> None:
        """Return to the settings of power-up."""
        self.go_dark(now)
        if power_up:
            self._powered_at = now
            self._events.clear()

    def status_bits(self, now: float) -> int:
        """Return bits 4 and up of ``STAT?``."""
        states = self.states(now) | {STATUS_INTERLOCK: self.interlock}
        return sum(bit for bit, is_set in states.items() if is_set)

    def take_events(self) -> list[tuple[str, str]]:
        """Return and forget what the device has to say unasked: name and payload."""
        events = list(self._events)
        self._events.clear()
        return events

    def say(self, name: str, payload: str) -> None:
        """Have an event sent."""
        self._events.append((name, payload))

    def clock_us(self, now: float) -> int:
        """Return the time since power-up, us."""
        return round((now - self._powered_at) * 1e6)

    def _require_closed_stop(self) -> None:
        if self.interlock:
            raise Refused(Code.INTERLOCK)

    def _stop_opens_s(self) -> float:
        """Return when somebody will open the stop, s; inf where it is open."""
        return math.inf if self.interlock else self.faults.interlock_after
