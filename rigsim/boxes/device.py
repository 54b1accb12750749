"""What a controller controls, and what all of them have: a clock, events, an emergency stop."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from capture.devices.wire import Code
from capture.rig import Rig
from rigsim.boxes.command import Command, CommandRefused, parse_token
from rigsim.boxes.faults import NO_FAULTS, Faults

STATUS_INTERLOCK = 256


class JawLoad(Protocol):
    """What the jaws act upon."""

    @property
    def force_n(self) -> float:
        """Force on the jaws, N; > 0 pulls them together."""

    def attach(self, angle_deg: float) -> None:
        """Be held, at the jaws' present distance, from now on."""

    def turn(self, angle_deg: float) -> None:
        """Have the jaws turned while they hold nothing."""

    def move(self, aperture_mm: float) -> None:
        """Have the jaws moved to a distance."""

    def release(self) -> None:
        """Be let go."""


class SuctionLoad(Protocol):
    """What the pump acts upon."""

    def place(self, site: str, angle_deg: float, now: float) -> None:
        """Be put somewhere by a person."""

    def remove(self, now: float) -> None:
        """Be taken off."""

    def start_suction(self, target_mbar: float, now: float) -> None:
        """Have the vent closed and the pump switched on."""

    def vent(self, now: float) -> None:
        """Have the pump switched off and the vent opened."""

    def suction_mbar(self, now: float) -> float:
        """Return the suction now, mbar."""

    def camera_c(self, now: float) -> float:
        """Return the temperature of the camera behind it, degrees Celsius."""


def _ignore(*_: object) -> None:
    """Do nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Wiring:
    """What a box is wired to."""

    rig: Rig
    """What it drives: lights and what they may do, cameras, caliper or probe."""
    rng: np.random.Generator
    """Its chance, for as long as it lives: noise, misfires, what sticks and where jaws stand."""
    faults: Faults = NO_FAULTS
    """What is wrong with it."""
    on_light: Callable[[Any], None] = _ignore
    """Called with each pop, and with each stretch of other light when it has ended."""
    on_trigger: Callable[..., None] = _ignore
    """Called with the world time in s of each pulse on the camera line, and, where each camera has
    a line of its own, the mask of those that are pulsed."""
    on_grip: Callable[[float], None] = _ignore
    """Called with the world time in s after whatever has changed what the caliper's jaws hold."""
    skin: JawLoad | None = None
    """What is between the caliper's jaws; None where the rig has no caliper."""
    head: SuctionLoad | None = None
    """The contact probe's head and what it sits on; None where the rig has no probe."""


class Device(ABC):
    """What a controller controls.

    Parameters
    ----------
    wiring
        What it drives, what is wrong with it, and who notices what it does.
    """

    kind: str
    model: str

    def __init__(self, wiring: Wiring) -> None:
        self.rig, self.faults, self._rng = wiring.rig, wiring.faults, wiring.rng
        self._on_light, self._on_trigger = wiring.on_light, wiring.on_trigger
        self.interlock = self.faults.interlock
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
    def is_busy(self, now: float) -> bool:
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

    def queue_event(self, name: str, payload: str) -> None:
        """Have an event sent."""
        self._events.append((name, payload))

    def clock_us(self, now: float) -> int:
        """Return the time since power-up, us."""
        return round((now - self._powered_at) * 1e6)

    def light_now(self, now: float) -> Sequence[Any]:
        """Return the stretches of light that have not ended, as given so far."""
        return ()

    def _trigger_camera(self, arguments: str, now: float) -> str:
        token = parse_token(arguments)
        self._on_trigger(now)
        return f"{token},{self.clock_us(now)}"

    def _require_closed_stop(self) -> None:
        CommandRefused.raise_if(self.interlock, Code.INTERLOCK)

    def _stop_opens_s(self) -> float:
        """Return when somebody will open the stop, s; inf where it is open."""
        return math.inf if self.interlock else self.faults.interlock_after
