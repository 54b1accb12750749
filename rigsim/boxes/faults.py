"""Faults of wire, controllers and cameras: seeded switches with values.

`Faults` has one switch per fault; all are off by default and each can be set in a ``sim://`` URL.
`FAULT_CATALOG` lists the twenty kinds of fault that a rig must survive, the switches that provoke
each, and the guaranteed response.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, TypeAlias

from capture.documents import suggest_key
from rigsim.package_data import package_table

Probability: TypeAlias = float
"""From 0 to 1."""
Seconds: TypeAlias = float
"""0 or more, s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Faults:
    """Fault switches; each probability is per byte, line or frame as stated, times in s.

    Examples
    --------
    >>> Faults(drop=0.001, unplug_after=3.0).drop
    0.001
    >>> Faults.from_text({"dorp": "0.001"})
    Traceback (most recent call last):
        ...
    ValueError: dorp: no such switch; did you mean drop?
    """

    drop: Probability = 0.0
    """Probability that a byte is lost, either way."""
    flip: Probability = 0.0
    """Probability that one bit of a byte is flipped, either way."""
    glue: Probability = 0.0
    """Probability that the newline of a line is lost, so that two lines become one."""
    cut: Probability = 0.0
    """Probability that a line is cut at random; its rest, newline included, is lost."""
    late: Probability = 0.0
    """Probability that an answer is late (with all that follow it: the line keeps its order)."""
    late_s: Seconds = 0.6
    """Delay of a late answer, s."""
    lose_answer: Probability = 0.0
    """Probability that an answer is lost after the command was carried out."""
    duplicate: Probability = 0.0
    """Probability that a line arrives twice, either way."""
    babble: Probability = 0.0
    """Probability that the controller prints a line of its own before an answer."""
    latency: Seconds = 0.0
    """Delay of the line one way, s."""
    baud: float = 115_200.0
    """Bits per second at ten bits per byte; 0: bytes take no time."""
    reset_on_open: bool = False
    """Opening the port resets the controller, as the DTR line of many boards does."""
    boot_s: Seconds = 0.8
    """Time for which the controller is deaf after a reset, s."""
    reset_after: Seconds = math.inf
    """The controller resets silently, once, at this time after power-up, s."""
    brownout: Probability = 0.0
    """Probability that a line to the controller coincides with a supply dip: a silent reset."""
    unplug_after: Seconds = math.inf
    """The cable is pulled at this time after the port was first opened, s."""
    replug_after: Seconds = math.inf
    """The cable is reconnected at this time after it was pulled, s."""
    stall_after: Seconds = math.inf
    """The controller stops taking bytes at this time after the port was first opened, s."""
    stall_s: Seconds = 2.0
    """Duration of that stall, s."""
    serial: str = ""
    """Serial number of a different controller behind the same name."""
    protocol: int = 1
    """Protocol version of the firmware."""
    lamp_dead: bool = False
    """The modelling lamp draws no current."""
    heat: float = 0.0
    """Heat of the drivers of lamps and LEDs at power-up, 0 to 1; the flash's trips at 0.8."""
    led_dead: str = ""
    """Numbers of LEDs that draw no current, joined by +."""
    led_dead_after: Seconds = 0.0
    """These LEDs fail when they are first switched on at this time after power-up, or later, s."""
    led_weak: str = ""
    """LEDs that emit less light than they are driven for: number=fraction, joined by +."""
    misfire: Probability = 0.0
    """Probability that the tube does not ignite."""
    slow_charge: float = 1.0
    """Charging time of the capacitor relative to normal."""
    slow_judgment: Seconds = 0.0
    """Time that a controller of LEDs takes to judge a table, s; the answer comes afterwards."""
    interlock: bool = False
    """The emergency-stop line is open."""
    interlock_after: Seconds = math.inf
    """The emergency stop opens at this time after power-up, s."""
    jaw_stall: Probability = 0.0
    """Probability that the motor of a caliper stalls in a move."""
    home_missed: bool = False
    """The home mark of a caliper is never detected."""
    force_dead: bool = False
    """The force sensor of a caliper draws no current."""
    skin_stiff: float = 1.0
    """Stiffness of the skin between a caliper's jaws relative to normal."""
    pump_leak: float = 0.0
    """Leak under a probe's head relative to the intake of its pump's regulator: the suction settles
    at no more than 1 / (1 + leak) of the requested one."""
    pump_dead: bool = False
    """The motor of a probe's pump does not turn."""
    gauge_dead_after: Seconds = math.inf
    """The pressure gauge of a probe draws no current from this time after power-up on, s."""
    head_lifts_after: Seconds = math.inf
    """A probe's head detaches, once, at this time after its pump was first switched on, s."""
    shutter_stuck: Probability = 0.0
    """Probability that a probe's shutter does not open."""
    shutter_jam: Probability = 0.0
    """Probability that a probe's shutter, once open, does not close."""
    camera_warms_after: Seconds = math.inf
    """The cooling of a probe's camera fails at this time after power-up, s."""
    stale: Probability = 0.0
    """Probability that a camera returns its previous frame first."""
    drop_frame: Probability = 0.0
    """Probability that a frame is lost."""
    late_frame: Probability = 0.0
    """Probability that a frame is late; it comes even if the camera was armed again meanwhile."""
    repeat_frame: Probability = 0.0
    """Probability that a frame comes a second time, late."""
    late_frame_s: Seconds = 6.0
    """Largest delay of a late frame after its read-out, s."""
    wrong_camera: Probability = 0.0
    """Probability that a frame carries another camera's serial number."""
    wrong_exposure: Probability = 0.0
    """Probability that a frame was taken one stop off."""
    drift_ppm: float = 0.0
    """Error of the camera's clock, microseconds per second."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.type == "Probability" and not 0.0 <= value <= 1.0:
                raise ValueError(f"{field.name}: got {value}, expected a probability from 0 to 1")
            if field.type == "Seconds" and not value >= 0.0:
                raise ValueError(f"{field.name}: got {value}, expected seconds >= 0")
        if not 0.0 <= self.baud < math.inf:
            raise ValueError(f"baud: got {self.baud}, expected 0 or bits per second")
        if not 0.0 <= self.heat < 1.0:
            raise ValueError(f"heat: got {self.heat}, expected 0 <= heat < 1")
        if not 0.0 < self.slow_charge < math.inf:
            raise ValueError(f"slow_charge: got {self.slow_charge}, expected more than 0")
        if not 0.0 <= self.pump_leak < math.inf:
            raise ValueError(f"pump_leak: got {self.pump_leak}, expected 0 or more")
        if not 0.0 < self.skin_stiff < math.inf:
            raise ValueError(f"skin_stiff: got {self.skin_stiff}, expected more than 0")
        if not abs(self.drift_ppm) < 1e5:
            raise ValueError(f"drift_ppm: got {self.drift_ppm}, expected less than 1e5")
        if not all(0.0 <= share <= 1.0 for share in self.weak_leds.values()):
            raise ValueError(f"led_weak: got {self.led_weak!r}, expected fractions from 0 to 1")
        _ = self.dead_leds  # raises ValueError unless it is a list of numbers

    @property
    def dead_leds(self) -> frozenset[int]:
        """Numbers of the dead LEDs."""
        return frozenset(_led_number("led_dead", part) for part in self.led_dead.split("+") if part)

    def is_led_dead(self, led: int, now_s: float) -> bool:
        """Return whether an LED that is switched on at a time, in s, draws no current.

        Examples
        --------
        >>> broken = Faults(led_dead="3", led_dead_after=5.0)
        >>> broken.is_led_dead(3, 4.9), broken.is_led_dead(3, 5.0), broken.is_led_dead(4, 5.0)
        (False, True, False)
        """
        return now_s >= self.led_dead_after and led in self.dead_leds

    @property
    def weak_leds(self) -> dict[int, float]:
        """Light of the weak LEDs relative to a new one, by number.

        Examples
        --------
        >>> Faults(led_weak="3=0.5+17=0.25").weak_leds
        {3: 0.5, 17: 0.25}
        """
        found = {}
        for part in filter(None, self.led_weak.split("+")):
            number, _, share = part.partition("=")
            found[_led_number("led_weak", number)] = float(_value("led_weak", share, float))
        return found

    @classmethod
    def from_text(cls, switches: Mapping[str, str]) -> Faults:
        """Parse switches from the texts of a URL query.

        Raises
        ------
        ValueError
            For an unknown switch, with the nearest known one, or a value out of range.
        """
        fields = {field.name: field for field in dataclasses.fields(cls)}
        values: dict[str, float | int | bool | str] = {}
        for name, text in switches.items():
            if name not in fields:
                hint = suggest_key(name, list(fields)) or f"one of {', '.join(fields)}"
                raise ValueError(f"{name}: no such switch; {hint}")
            values[name] = _value(name, text, type(fields[name].default))
        return cls(**values)  # type: ignore[arg-type]


def _led_number(name: str, text: str) -> int:
    if not (text.isascii() and text.isdecimal()):
        raise ValueError(f"{name}: got {text!r}, expected the number of an LED")
    return int(text)


def _value(name: str, text: str, kind: type) -> float | int | bool | str:
    if kind is str:
        return text
    if kind is bool:
        if text not in ("0", "1"):
            raise ValueError(f"{name}: got {text!r}, expected 0 or 1")
        return text == "1"
    try:
        return int(text) if kind is int else float(text)
    except ValueError as exc:
        raise ValueError(f"{name}: got {text!r}, expected a number") from exc


NO_FAULTS = Faults()


@dataclass(frozen=True, slots=True)
class FaultKind:
    """One of the kinds of fault that a rig must survive."""

    number: int
    """1 to 20."""
    what: str
    """Description of the fault."""
    switches: tuple[str, ...]
    """Fields of `Faults` that provoke it; empty where a test provokes it from outside."""
    promise: str
    """Guaranteed response."""


FAULT_CATALOG: Final = tuple(FaultKind(**kind) for kind in package_table("faults")["faults"])
