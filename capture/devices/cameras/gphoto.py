"""Cameras supported by libgphoto2, by serial number; needs the extra ``gphoto``.

The flash controller's line releases the camera, and its file is downloaded when the camera reports
one; for frames without light the computer releases it. The module is tested against a substitute
for the library. It has not been tested with a camera.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import time
from collections.abc import Callable
from typing import Any

from capture import raw
from capture.devices.camera import (
    CameraError,
    CameraInfo,
    CameraUrlError,
    Exposure,
    Frame,
    FrameTimeout,
    Trigger,
)
from capture.devices.cameras.hot_folder import parse_camera_info

EVENT_DRAIN_MS = 50
"""Time for which old events are awaited when the camera is armed, ms."""
EVENT_TIMEOUT_MS = 500
"""Longest wait for one event, ms."""


class MissingGphoto2(CameraError, ImportError):
    """Raised when the optional library is not installed."""


def open_camera(serial: str) -> GphotoCamera:
    """Open ``gphoto2:SERIAL``."""
    try:
        import gphoto2
    except ImportError as error:
        raise MissingGphoto2(
            f"gphoto2:{serial}: needs the optional part 'gphoto': pip install 'skinrig[gphoto]' "
            "[SR-ENV-002]"
        ) from error
    return GphotoCamera(gphoto2, serial)


class GphotoCamera:
    """One tethered camera.

    Parameters
    ----------
    library
        The module ``gphoto2``.
    serial
        Serial number that the camera itself reports. Port names are not used: they change when a
        cable is plugged in again.
    clock
        Clock of the host, s; for tests.
    """

    def __init__(
        self, library: Any, serial: str, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._library = library
        self._clock = clock
        self._camera = self._find(serial)
        self._serial = serial
        self._want = Exposure(0.01, 100)
        self._seq = 0
        self._info: CameraInfo | None = None
        self._fired_s = float("-inf")
        self._trigger = Trigger.SOFTWARE
        self._last: tuple[bytes, float] = (b"", float("-inf"))

    def _find(self, serial: str) -> Any:
        found = []
        for name, address in self._library.Camera.autodetect():
            camera = self._library.Camera()
            ports = self._library.PortInfoList()
            ports.load()
            camera.set_port_info(ports[ports.lookup_path(address)])
            try:
                camera.init()
                own = camera.get_config().get_child_by_name("serialnumber").get_value()
            except self._library.GPhoto2Error as error:
                found.append(f"{name} at {address} ({error})")
                continue
            if own == serial:
                return camera
            found.append(f"{name} with serial {own}")
            camera.exit()
        raise CameraUrlError(
            f"gphoto2:{serial}: no such camera; found {', '.join(found) or 'none'}. A desktop's "
            "file manager may hold it: unmount it there [SR-CAP-022]"
        )

    @property
    def info(self) -> CameraInfo:
        """Identity and properties of the camera; the first call takes a test image."""
        if self._info is None:
            picture = raw.decode(memoryview(self._capture()), where=f"gphoto2:{self._serial}")
            self._info = parse_camera_info(picture, self._serial, Trigger.SOFTWARE, Trigger.EDGE)
        return self._info

    def clock_s(self) -> float:
        """Return the clock of the host, which stamps the frames."""
        return self._clock()

    def configure(self, want: Exposure) -> Exposure:
        """Set shutter time and ISO to the nearest values that the camera has."""
        self._want = want
        with self._translated():
            return self._configure(want)

    def _configure(self, want: Exposure) -> Exposure:
        tree = self._camera.get_config()
        got = {}
        for name, value in (("shutterspeed", want.exposure_s), ("iso", float(want.iso))):
            widget = tree.get_child_by_name(name)
            choices = {c: _seconds(c) for c in widget.get_choices()}
            known = {c: v for c, v in choices.items() if v is not None and v > 0}
            if not known:
                raise CameraError(f"gphoto2:{self._serial}: offers no {name}; set the dial to M")
            best = min(known, key=lambda c: abs(math.log(known[c] / value)))
            widget.set_value(best)
            got[name] = known[best]
        self._camera.set_config(tree)
        return Exposure(got["shutterspeed"], int(got["iso"]))

    def arm(self, count: int, trigger: Trigger) -> None:
        """Prepare for a release by the computer or the controller; files of before are ignored."""
        if trigger not in (Trigger.SOFTWARE, Trigger.EDGE):
            raise CameraError(f"gphoto2:{self._serial}: cannot be triggered by {trigger}")
        if count < 1:
            raise CameraError(f"count: got {count}, expected 1 or more")
        with self._translated():
            while self._event(EVENT_DRAIN_MS) is not None:
                pass
        self._trigger = trigger
        self._seq = 0

    def fire(self) -> None:
        """Record the trigger; the exposure is made when the frame is requested."""
        self._fired_s = self.clock_s()

    def frame(self, timeout_s: float) -> Frame:
        """Expose now, or wait for the controller's release, and download the raw file.

        A file with the bytes of the last one is a repetition: it has the old time and is therefore
        rejected as stale. Another file that was released before the camera was armed but reported
        only later cannot be distinguished from the right one.
        """
        start = self.clock_s()
        if self._trigger is Trigger.EDGE:
            blob = self._await_file(start + timeout_s)
            start = self.clock_s() - self._want.exposure_s
        elif self._fired_s == float("-inf"):
            raise FrameTimeout(
                f"gphoto2:{self._serial}: not fired; fire it before waiting for a frame"
            )
        else:
            blob = self._capture()
        self._fired_s = float("-inf")
        digest = hashlib.sha256(blob).digest()
        stale = digest == self._last[0]
        start = self._last[1] if stale else start
        self._last = (digest, start)
        picture = raw.decode(memoryview(blob), where=f"gphoto2:{self._serial}")
        exposure = Exposure(
            picture.exposure_s or self._want.exposure_s, picture.iso or self._want.iso
        )
        frame = Frame(self._serial, self._seq, start, self.clock_s(), exposure, blob)
        self._seq += not stale
        return frame

    def abort(self) -> None:
        """Clear the trigger."""
        self._fired_s = float("-inf")

    def close(self) -> None:
        """Release the camera."""
        self._camera.exit()

    def _capture(self) -> bytes:
        with self._translated():
            return self._download(self._camera.capture(self._library.GP_CAPTURE_IMAGE))

    def _await_file(self, until_s: float) -> bytes:
        with self._translated():
            while True:
                left_ms = round(1e3 * (until_s - self.clock_s()))
                if left_ms <= 0:
                    raise FrameTimeout(
                        f"gphoto2:{self._serial}: no new file came; is the controller's trigger "
                        "line plugged into the camera? Check the cable [SR-CAP-025]"
                    )
                event = self._event(min(left_ms, EVENT_TIMEOUT_MS))
                if event is not None and event[0] == self._library.GP_EVENT_FILE_ADDED:
                    return self._download(event[1])

    def _event(self, timeout_ms: int) -> tuple[int, Any] | None:
        """Return kind and content of the next event, None when none came."""
        kind, content = self._camera.wait_for_event(timeout_ms)
        return None if kind == self._library.GP_EVENT_TIMEOUT else (kind, content)

    def _download(self, path: Any) -> bytes:
        file = self._camera.file_get(path.folder, path.name, self._library.GP_FILE_TYPE_NORMAL)
        return bytes(file.get_data_and_size())

    @contextlib.contextmanager
    def _translated(self) -> Any:
        try:
            yield
        except self._library.GPhoto2Error as error:
            raise CameraError(f"gphoto2:{self._serial}: {error}") from error


def _seconds(text: str) -> float | None:
    """Return "1/125", "0.5" or "100" as a number, None for "bulb" and "auto"."""
    top, _, bottom = text.strip().removesuffix("s").partition("/")
    try:
        return float(top) / float(bottom or 1)
    except (ValueError, ZeroDivisionError):
        return None
