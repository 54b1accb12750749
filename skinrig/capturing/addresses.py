"""Parse the NAME=URL addresses of controllers and cameras, and open the devices at them."""

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
"""Retry period, s, of a device that another program holds or that still reads out a frame."""
RETRY_PAUSE_S = 0.5
"""Pause between two attempts, s."""

_T = TypeVar("_T")


def parse_addresses(pairs: Sequence[str], option: str) -> dict[str, str]:
    """Parse NAME=URL pairs into addresses by name.

    Raises
    ------
    UsageError
        For a pair of another form, or a name given twice.

    Examples
    --------
    >>> parse_addresses(["flash=/dev/ttyUSB0"], "--port")
    {'flash': '/dev/ttyUSB0'}
    """
    found: dict[str, str] = {}
    for text in pairs:
        name, equals, url = text.partition("=")
        if not (equals and name and url):
            raise UsageError(f"{option}: got {text!r}, expected NAME=URL, such as flash=URL")
        if name in found:
            raise UsageError(f"{option}: {name!r} is given twice; remove one of them")
        found[name] = url
    return found


def require_addresses(
    rig: Rig,
    boxes: Mapping[str, str],
    cameras: Mapping[str, str],
    *,
    needed: Sequence[str] | None = None,
) -> None:
    """Raise unless each controller and camera has an address of a known scheme.

    The message lists every missing address.

    Parameters
    ----------
    rig
    boxes, cameras
        Addresses by name.
    needed
        Controllers that are used; None: all of the rig.

    Raises
    ------
    UsageError
        For a missing address, or a camera address of an unknown scheme.
    """
    from capture.devices.camera import CameraUrlError, check_address

    missing = [f"--port {name}=URL" for name in needed or rig.boxes if name not in boxes]
    missing += [f"--camera {v.name}=URL" for v in rig.all_views if v.name not in cameras]
    if missing:
        raise UsageError(
            f"the rig {rig.name!r} needs {' '.join(missing)}; --dry-run needs none, and "
            "skinrig serve prints those of a simulation [SR-CAP-033]"
        )
    for view in rig.all_views:  # checked before a controller is opened, which switches its light
        try:
            check_address(cameras[view.name])
        except CameraUrlError as error:
            raise UsageError(f"--camera {view.name}: {error}") from error


def open_box(kind: str, address: str, **settings: Any) -> Box:
    """Return the driver of a controller at an address: its module's ``DRIVER``.

    Parameters
    ----------
    kind
        Module of `capture.devices`, such as "flash".
    address
        URL or name of its port.
    **settings
        Settings of the port.
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
    """Open a device, retrying for a few seconds while another program holds it.

    A process that was killed a moment ago may still hold its ports.

    Raises
    ------
    CameraBusy, PortBusy
        If the device is still held after `retry_s`.
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
