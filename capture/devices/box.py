"""What every box answers: who it is, its limits, arming, lease, status and errors."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from capture.devices import wire
from capture.devices.port import BadAnswer, DeviceError, Hello, Port, WrongDevice

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class BoxStatus:
    """The bits of ``STAT?`` that all boxes share."""

    bits: int
    """Their sum."""

    @property
    def armed(self) -> bool:
        """Whether light is allowed."""
        return bool(self.bits & 1)

    @property
    def tripped(self) -> bool:
        """Whether the lease ran out since the box was last armed."""
        return bool(self.bits & 2)

    @property
    def errors_waiting(self) -> bool:
        """Whether `Box.errors` would find something."""
        return bool(self.bits & 4)

    @property
    def lit(self) -> bool:
        """Whether a lamp is on."""
        return bool(self.bits & 64)

    @property
    def too_hot(self) -> bool:
        """Whether a lamp's driver has tripped."""
        return bool(self.bits & 128)

    @property
    def stopped(self) -> bool:
        """Whether the emergency stop is open."""
        return bool(self.bits & 256)


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
                raise self._bad("SYST:ERR?", payload, 'code,"text"')
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

    def _bad(self, text: str, payload: str, expected: str) -> BadAnswer:
        return BadAnswer(
            f"{self._port.url}: {text!r} was answered with {payload!r}, expected {expected}"
        )

    def _number(self, text: str) -> float:
        payload = self._port.ask(text)
        try:
            value = float(payload)
        except ValueError as exc:
            raise self._bad(text, payload, "a number") from exc
        if not math.isfinite(value):
            raise self._bad(text, payload, "a finite number")
        return value

    def _flag(self, text: str) -> bool:
        payload = self._port.ask(text)
        if payload not in ("0", "1"):
            raise self._bad(text, payload, "0 or 1")
        return payload == "1"
