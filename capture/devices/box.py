"""What every box answers: who it is, its limits, arming, lease, status and errors."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self, TypeVar

from capture.devices import wire
from capture.devices.port import BadAnswer, DeviceError, Hello, Port, PortTimeout, WrongDevice

log = logging.getLogger(__name__)


T = TypeVar("T")


class StatusBit:
    """One bit of a status, as a property of it.

    Parameters
    ----------
    place
        Of the bit; 0 is worth 1.
    """

    def __init__(self, place: int) -> None:
        self._worth = 1 << place

    def __get__(self, status: BoxStatus, kind: object = None) -> bool:
        return bool(status.bits & self._worth)


@dataclass(frozen=True, slots=True)
class BoxStatus:
    """The bits of ``STAT?`` that all boxes share."""

    bits: int
    """Their sum."""

    armed = StatusBit(0)
    """Whether light is allowed."""
    tripped = StatusBit(1)
    """Whether the lease ran out since the box was last armed."""
    errors_waiting = StatusBit(2)
    """Whether `Box.errors` would find something."""
    lit = StatusBit(6)
    """Whether a lamp is on."""
    stopped = StatusBit(8)
    """Whether the emergency stop is open."""


class Box:
    """Driver of the commands that all boxes share.

    Parameters
    ----------
    port
        Open; owned by the driver from now on.
    serial
        Serial number that the box must have; empty: any.

    Raises
    ------
    WrongDevice
        When the box is of another kind, or another one.
    """

    kind: ClassVar[str]
    """What the box must say it is."""

    def __init__(self, port: Port, *, serial: str = "") -> None:
        self._port = port
        try:
            self.hello(serial=serial)
        except BaseException:
            port.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # identity ---------------------------------------------------------------------------------

    def hello(self, *, serial: str = "") -> Hello:
        """Introduce the host, learn the epoch and read the limits."""
        hello = self._port.hello()
        if hello.kind != self.kind:
            raise WrongDevice(
                f"{self._port.url}: got a {hello.kind!r} box with serial {hello.serial}, expected "
                f"a {self.kind!r} box; exchange the addresses"
            )
        if serial and hello.serial != serial:
            raise WrongDevice(
                f"{self._port.url}: got the {self.kind} box {hello.serial}, expected {serial}; "
                "exchange the addresses"
            )
        self._identity = hello
        self._limits = self._port.capabilities()
        return hello

    @property
    def port(self) -> Port:
        """The port, for its statistics and events."""
        return self._port

    @property
    def identity(self) -> Hello:
        """Who answered the last hello."""
        return self._identity

    @property
    def limits(self) -> Mapping[str, Any]:
        """What the box allows (``SYST:CAP?``), units in the names; read at hello."""
        return self._limits

    def identify(self) -> str:
        """Return maker, model, serial number and firmware."""
        return self._port.ask("*IDN?")

    # arming -----------------------------------------------------------------------------------

    def arm(self) -> None:
        """Allow light; the lease begins."""
        self._port.ask("SYST:ARM")

    def dark(self) -> None:
        """Put all light out and disarm, at once."""
        self._port.ask("SAFE")

    def is_armed(self) -> bool:
        """Tell whether light is allowed."""
        return self._flag("SYST:ARM?")

    def set_lease(self, lease_s: float) -> None:
        """Set after how much silence, in s, the box goes dark (0.3 to 5)."""
        self._port.ask(f"SYST:WDOG {round(lease_s * 1e3)}")

    def lease_s(self) -> float:
        """Return after how much silence, in s, the box goes dark."""
        return self._number("SYST:WDOG?") / 1e3

    def ping(self) -> float:
        """Return the box's clock, in s since its power-up; renews the lease."""
        return self._number("SYST:PING?") / 1e6

    def reset(self) -> None:
        """Go dark, disarm, and return to the settings of power-up."""
        self._port.ask("*RST")

    def errors(self) -> list[tuple[int, str]]:
        """Return and remove the queued errors, oldest first."""
        found: list[tuple[int, str]] = []
        for _ in range(64):
            payload = self._port.ask("SYST:ERR?")
            code, comma, text = payload.partition(",")
            if not comma or not code.removeprefix("-").isdecimal():
                raise self._bad_answer("SYST:ERR?", payload, 'code,"text"')
            if int(code) == 0:
                break
            found.append((int(code), text.strip('"')))
        return found

    def clear_errors(self) -> None:
        """Empty the error queue."""
        self._port.ask("*CLS")

    def close(self) -> None:
        """Go dark if the box still answers, and close the port."""
        try:
            if self._port.boot != wire.UNKNOWN_BOOT:
                self.dark()
        except DeviceError as exc:
            log.warning("%s; the lease of the box puts its light out", exc)
        finally:
            self._port.close()

    # answers ----------------------------------------------------------------------------------

    def _bad_answer(self, text: str, payload: str, expected: str) -> BadAnswer:
        return BadAnswer(
            f"{self._port.url}: {text!r} was answered with {payload!r}, expected {expected}"
        )

    def _read(self, text: str, decode: Callable[[str], T], expected: str, *, shown: str = "") -> T:
        """Ask and decode the answer; a ValueError or KeyError of ``decode`` is a bad answer.

        Parameters
        ----------
        text
            The command.
        decode
            Of the payload.
        expected
            What the payload should have been, in words.
        shown
            The command as an error shows it, where not as it is.
        """
        payload = self._port.ask(text)
        try:
            return decode(payload)
        except (ValueError, KeyError) as exc:
            raise self._bad_answer(shown or text, payload, expected) from exc

    def _read_or_none(
        self, text: str, decode: Callable[[str], T], expected: str, *, shown: str = ""
    ) -> T | None:
        """Ask and decode the answer; None where the box says that there is nothing."""
        return self._read(
            text, lambda got: None if got == "NONE" else decode(got), expected, shown=shown
        )

    def _number(self, text: str) -> float:
        payload, value = self._read(text, lambda got: (got, float(got)), "a number")
        if not math.isfinite(value):
            raise self._bad_answer(text, payload, "a finite number")
        return value

    def _flag(self, text: str) -> bool:
        return self._read(text, {"0": False, "1": True}.__getitem__, "0 or 1")

    def _count(self, text: str, expected: str, *, shown: str) -> int:
        return self._read(text, parse_whole_number, expected, shown=shown)

    def _token_time(self, command: str, token: str, *, shown: str = "") -> float:
        """Give a command with a token; return the box's time at which it was done, s."""

        def time_s(payload: str) -> float:
            name, _, t_us = payload.partition(",")
            if name != token:
                raise ValueError(payload)
            return parse_whole_number(t_us) / 1e6

        return self._read(f"{command} {token}", time_s, "token,us", shown=shown or command)

    def _wait_settled(
        self, timeout_s: float, poll_s: float, listen: Callable[[float], object], fault: str
    ) -> None:
        """Wait until all acts are over, by the box's time whatever the box is."""
        waited_s = 0.0
        while not self._flag("*OPC?"):
            if waited_s >= timeout_s:
                raise PortTimeout(f"{self._port.url}: {fault}")
            listen(poll_s)
            waited_s += poll_s

    def _keep_lease(self, seconds: float, every_s: float) -> None:
        """Let time pass and renew the lease."""
        left_s = seconds
        while left_s > 0.0:
            self._port.listen(min(left_s, every_s))
            self.ping()
            left_s -= every_s


def parse_whole_number(text: str) -> int:
    """Return a number that is written in digits only; raise ValueError otherwise."""
    if not text.isdecimal():
        raise ValueError(text)
    return int(text)


def format_decimal(field: str, value: float, digits: int) -> str:
    """Return a finite number in as few digits as it needs, at most ``digits`` after the point.

    Examples
    --------
    >>> format_decimal("seconds", 0.25, 6), format_decimal("angle_deg", -0.0, 3)
    ('0.25', '0')
    """
    if not math.isfinite(value):
        raise ValueError(f"{field}: got {value}, expected a finite number")
    text = f"{value:.{digits}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text
