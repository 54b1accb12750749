"""Where the boxes and cameras of a capture are: NAME=URL pairs, and devices that are still held."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar

from capture.rig import Rig
from skinrig.errors import UsageError

if TYPE_CHECKING:
    from capture.devices.box import Box

RETRY_TIMEOUT_S = 10.0
"""How long a device that is held, or reads out a frame of before, is asked for again."""
RETRY_PAUSE_S = 0.5

_T = TypeVar("_T")


def parse_addresses(pairs: Sequence[str], option: str) -> dict[str, str]:
    """Return NAME=URL pairs as a mapping.

    Examples
    --------
    >>> parse_addresses(["flash=/dev/ttyUSB0"], "--port")
    {'flash': '/dev/ttyUSB0'}
    """
    found: dict[str, str] = {}
    for text in pairs:
        name, equals, url = text.partition("=")
        if not (equals and name and url):
            raise UsageError(f"{option}: got {text!r}, expected NAME=URL")
        if name in found:
            raise UsageError(f"{option}: {name!r} is given twice")
        found[name] = url
    return found


def require_addresses(
    rig: Rig,
    boxes: Mapping[str, str],
    cameras: Mapping[str, str],
    *,
    needed: Sequence[str] | None = None,
) -> None:
    """Raise, naming all that is missing, unless each box and camera has an address of a known kind.

    Parameters
    ----------
    rig
    boxes, cameras
        Addresses by name.
    needed
        Boxes that are used; None: all of the rig.

    Raises
    ------
    UsageError
    """
    from capture.devices.camera import CameraUrlError, check_address

    missing = [f"--port {name}=URL" for name in needed or rig.boxes if name not in boxes]
    missing += [f"--camera {v.name}=URL" for v in rig.views if v.name not in cameras]
    if missing:
        raise UsageError(
            f"the rig {rig.name!r} needs {' '.join(missing)}; --dry-run needs none, and "
            "skinrig serve prints those of a simulation"
        )
    for view in rig.views:  # before any box is opened, and its light switched
        try:
            check_address(cameras[view.name])
        except CameraUrlError as error:
            raise UsageError(f"--camera {view.name}: {error}") from error


def open_box(kind: str, address: str, **settings: Any) -> Box:
    """Return the driver of a box at an address: its module's ``DRIVER``.

    Parameters
    ----------
    kind
        Module of `capture.devices`, such as "flash".
    address
        URL or name of its port.
    **settings
        Of the port.
    """
    from capture.devices.port import Port

    driver: type[Box] = import_module(f"capture.devices.{kind}").DRIVER
    return driver(Port(address, **settings))


def open_with_retry(
    open_device: Callable[[], _T],
    progress: Callable[[str], None],
    *,
    retry_s: float = RETRY_TIMEOUT_S,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> _T:
    """Open a device, asking again for a few seconds while another program holds it.

    What was killed a moment ago may still hold its ports.
    """
    from capture.devices.camera import CameraBusy
    from capture.devices.port import PortBusy

    until_s = clock() + retry_s
    reported = False
    while True:
        try:
            return open_device()
        except (CameraBusy, PortBusy) as error:
            if clock() >= until_s:
                raise
            if not reported:
                progress(f"{error}; trying again for {retry_s:g} s")
            reported = True
        sleep(RETRY_PAUSE_S)
