"""Serial ports by URL: handlers, names, and advice for a port that does not open."""

import errno
import importlib
import importlib.metadata
from functools import cache

import serial

from capture.devices.errors import PortBusy

URL_HANDLERS = "capture.urlhandlers"


def serial_ports() -> list[str]:
    """Return the names of this machine's serial ports, sorted."""
    from serial.tools import list_ports

    return sorted(str(port.device) for port in list_ports.comports())


def load_url_handler(url: str) -> None:
    """Register the entry point that serves the scheme of `url` with pyserial."""
    scheme, separator, _ = url.partition("://")
    if not separator:
        return
    for entry_point in _handlers(scheme.lower()):
        # pyserial hides an ImportError of its handlers; this import raises it
        importlib.import_module(f"{entry_point.value}.protocol_{entry_point.name}")
        if entry_point.value not in serial.protocol_handler_packages:
            serial.protocol_handler_packages.append(entry_point.value)


@cache  # each call reads the metadata of all installed packages
def _handlers(scheme: str) -> tuple[importlib.metadata.EntryPoint, ...]:
    return tuple(importlib.metadata.entry_points(group=URL_HANDLERS, name=scheme))


def opening_advice(url: str, kind: type[Exception], number: int | None) -> str:
    """Return advice for a port that does not open."""
    if kind is PortBusy:
        return "another program uses it; close that program"
    if number == errno.EACCES:
        return "join the group that may use it (dialout on Debian), then log in again"
    if "://" in url:
        return "does a server listen there? Start it, or correct the address"
    return "is it plugged in? Check its cable, or correct the address"
