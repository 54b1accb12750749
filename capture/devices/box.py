"""Base driver of all controllers: identity, limits, arming, lease, status and errors."""

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
    """Expose one bit of a status word as a property.

    Parameters
    ----------
    place
        Position of the bit; bit 0 has the value 1.
    """

    def __init__(self, place: int) -> None:
        self._worth = 1 << place

    def __get__(self, status: BoxStatus, kind: object = None) -> bool:
        return bool(status.bits & self._worth)


@dataclass(frozen=True, slots=True)
class BoxStatus:
    """Bits of ``STAT?`` that all controllers share."""

    bits: int
    """Sum of the set bits."""

    armed = StatusBit(0)
    """Whether light is allowed."""
    tripped = StatusBit(1)
    """Whether the lease has expired since the controller was last armed."""
    errors_waiting = StatusBit(2)
    """Whether the error queue of the controller holds entries (`Box.errors`)."""
    lit = StatusBit(6)
    """Whether a lamp is on."""
    stopped = StatusBit(8)
    """Whether the emergency stop is open."""


class Box:
    """Driver of the commands that all controllers share.

    Parameters
    ----------
    port
        Open port; the driver closes it.
    serial
        Expected serial number of the controller; empty: any.

    Raises
    ------
    WrongDevice
        When the controller is of another kind or has another serial number.
    """

    kind: ClassVar[str]
    """Kind that the controller must report."""

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
        """Introduce the host, then read the controller's boot epoch and limits."""
        hello = self._port.hello()
        if hello.kind != self.kind:
            raise WrongDevice(
                f"{self._port.url}: got a {hello.kind!r} controller with serial {hello.serial}, "
                f"expected a {self.kind!r} controller; exchange the addresses [SR-CAP-003]"
            )
        if serial and hello.serial != serial:
            raise WrongDevice(
                f"{self._port.url}: got the {self.kind} controller {hello.serial}, expected "
                f"{serial}; exchange the addresses"
            )
        self._identity = hello
        self._limits = self._port.capabilities()
        return hello

    @property
    def port(self) -> Port:
        """The port, with its statistics and events."""
        return self._port

    @property
    def identity(self) -> Hello:
        """Identity of the controller, from the last hello."""
        return self._identity

    @property
    def limits(self) -> Mapping[str, Any]:
        """Limits of the controller (``SYST:CAP?``), units in the keys; read at hello."""
        return self._limits

    def identify(self) -> str:
        """Return manufacturer, model, serial number and firmware."""
        return self._port.ask("*IDN?")

    # arming -----------------------------------------------------------------------------------

    def arm(self) -> None:
        """Allow light and start the lease."""
        self._port.ask("SYST:ARM")

    def dark(self) -> None:
        """Switch all light off and disarm, at once."""
        self._port.ask("SAFE")

    def is_armed(self) -> bool:
        """Return whether light is allowed."""
        return self._flag("SYST:ARM?")

    def set_lease(self, lease_s: float) -> None:
        """Set the lease, the silence in s after which the controller goes dark (0.3 to 5)."""
        self._port.ask(f"SYST:WDOG {round(lease_s * 1e3)}")

    def lease_s(self) -> float:
        """Return the lease: the silence, in s, after which the controller goes dark."""
        return self._number("SYST:WDOG?") / 1e3

    def ping(self) -> float:
        """Return the controller's clock, in s since power-up, and renew the lease."""
        return self._number("SYST:PING?") / 1e6

    def reset(self) -> None:
        """Go dark, disarm, and restore the settings of power-up."""
        self._port.ask("*RST")

    def errors(self) -> list[tuple[int, str]]:
        """Return the queued errors, oldest first, and empty the queue."""
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
        """Empty the error queue of the controller."""
        self._port.ask("*CLS")

    def close(self) -> None:
        """Go dark if the controller still answers, then close the port."""
        try:
            if self._port.boot != wire.UNKNOWN_BOOT:
                self.dark()
        except DeviceError as exc:
            log.warning("%s; the lease of the controller switches its light off", exc)
        finally:
            self._port.close()

    # answers ----------------------------------------------------------------------------------

    def _bad_answer(self, text: str, payload: str, expected: str) -> BadAnswer:
        return BadAnswer(
            f"{self._port.url}: {text!r} was answered with {payload!r}, expected {expected}"
        )

    def _read(self, text: str, decode: Callable[[str], T], expected: str, *, shown: str = "") -> T:
        """Send a query and decode its answer; ValueError or KeyError mean `BadAnswer`.

        Parameters
        ----------
        text
            Query to send.
        decode
            Function that decodes the payload.
        expected
            Description of the expected payload, for the error message.
        shown
            Form of the query in error messages, where it differs from ``text``.
        """
        payload = self._port.ask(text)
        try:
            return decode(payload)
        except (ValueError, KeyError) as exc:
            raise self._bad_answer(shown or text, payload, expected) from exc

    def _read_or_none(
        self, text: str, decode: Callable[[str], T], expected: str, *, shown: str = ""
    ) -> T | None:
        """Send a query and decode its answer; None when the controller reports no value."""
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
        """Send a command with a token and return the controller's time of execution, s."""

        def time_s(payload: str) -> float:
            name, _, t_us = payload.partition(",")
            if name != token:
                raise ValueError(payload)
            return parse_whole_number(t_us) / 1e6

        return self._read(f"{command} {token}", time_s, "token,us", shown=shown or command)

    def _wait_settled(
        self, timeout_s: float, poll_s: float, listen: Callable[[float], object], fault: str
    ) -> None:
        """Wait until all movements are over, in the controller's time, real or simulated."""
        waited_s = 0.0
        while not self._flag("*OPC?"):
            if waited_s >= timeout_s:
                raise PortTimeout(f"{self._port.url}: {fault}")
            listen(poll_s)
            waited_s += poll_s

    def _keep_lease(self, seconds: float, every_s: float) -> None:
        """Wait for a time while renewing the lease."""
        left_s = seconds
        while left_s > 0.0:
            self._port.listen(min(left_s, every_s))
            self.ping()
            left_s -= every_s


def parse_whole_number(text: str) -> int:
    """Return a number written in digits only; raise ValueError otherwise."""
    if not text.isdecimal():
        raise ValueError(text)
    return int(text)


def format_decimal(field: str, value: float, digits: int) -> str:
    """Format a finite number in as few digits as needed, at most ``digits`` after the point.

    Examples
    --------
    >>> format_decimal("seconds", 0.25, 6), format_decimal("angle_deg", -0.0, 3)
    ('0.25', '0')
    """
    if not math.isfinite(value):
        raise ValueError(f"{field}: got {value}, expected a finite number")
    text = f"{value:.{digits}f}"
    text = text.rstrip("0").rstrip(".") if digits else text  # else 100 loses its zeros
    return "0" if text == "-0" else text
