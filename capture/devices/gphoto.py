"""Cameras that libgphoto2 knows, by serial number; needs the extra ``gphoto``."""

from __future__ import annotations

import time
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


class MissingGphoto2(CameraError, ImportError):
    """The optional library is not installed."""


def open_camera(serial: str) -> GphotoCamera:
    """Open ``gphoto2:SERIAL``."""
    try:
        import gphoto2
    except ImportError as error:
        raise MissingGphoto2(
            f"gphoto2:{serial}: needs the optional part 'gphoto': pip install 'skinrig[gphoto]'"
        ) from error
    return GphotoCamera(gphoto2, serial)


class GphotoCamera:
    """One tethered camera.

    Parameters
    ----------
    library
        The module ``gphoto2``.
    serial
        As the camera itself reports it. Port names are not used: they move from camera to
        camera when a cable is plugged in again.
    """

    def __init__(self, library: Any, serial: str) -> None:
        self._library = library
        self._camera = self._find(serial)
        self._serial = serial
        self._want = Exposure(0.01, 100)
        self._seq = 0
        self._info: CameraInfo | None = None
        self._fired_s = float("-inf")

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
            "file manager may hold it: unmount it there"
        )

    @property
    def info(self) -> CameraInfo:
        """What the camera is; takes one test picture the first time it is asked."""
        if self._info is None:
            picture = raw.decode(memoryview(self._capture()), where=f"gphoto2:{self._serial}")
            self._info = CameraInfo(
                serial=self._serial,
                model=picture.camera_model,
                width_px=picture.cfa.shape[1],
                height_px=picture.cfa.shape[0],
                pattern=picture.pattern,
                black=picture.black,
                white=picture.white,
                triggers=(Trigger.SOFTWARE,),
            )
        return self._info

    def clock_s(self) -> float:
        """Return the host's clock, which stamps the frames."""
        return time.monotonic()

    def configure(self, want: Exposure) -> Exposure:
        """Set shutter and ISO to the nearest the camera has."""
        self._want = want
        tree = self._camera.get_config()
        got = {}
        for name, value in (("shutterspeed", want.exposure_s), ("iso", float(want.iso))):
            widget = tree.get_child_by_name(name)
            choices = {c: _seconds(c) for c in widget.get_choices()}
            known = {c: v for c, v in choices.items() if v is not None and v > 0}
            if not known:
                raise CameraError(f"gphoto2:{self._serial}: offers no {name}; set the dial to M")
            best = min(known, key=lambda c: abs(known[c] / value - 1.0))
            widget.set_value(best)
            got[name] = known[best]
        self._camera.set_config(tree)
        return Exposure(got["shutterspeed"], int(got["iso"]))

    def arm(self, count: int, trigger: Trigger) -> None:
        """Make ready; only the software trigger is known to libgphoto2."""
        if trigger is not Trigger.SOFTWARE:
            raise CameraError(
                f"gphoto2:{self._serial}: cannot be triggered by {trigger}; sync the flash from "
                "its hot shoe, or use a hot folder"
            )
        self._seq = 0

    def fire(self) -> None:
        """Note the trigger; the exposure is made when the frame is asked for."""
        self._fired_s = self.clock_s()

    def frame(self, timeout_s: float) -> Frame:
        """Expose and download one raw file."""
        start = self.clock_s()
        if self._fired_s == float("-inf"):
            raise FrameTimeout(f"gphoto2:{self._serial}: was not fired")
        blob = self._capture()
        self._fired_s = float("-inf")
        picture = raw.decode(memoryview(blob), where=f"gphoto2:{self._serial}")
        exposure = Exposure(
            picture.exposure_s or self._want.exposure_s, picture.iso or self._want.iso
        )
        frame = Frame(self._serial, self._seq, start, self.clock_s(), exposure, blob)
        self._seq += 1
        return frame

    def abort(self) -> None:
        """Forget the trigger."""
        self._fired_s = float("-inf")

    def close(self) -> None:
        """Release the camera."""
        self._camera.exit()

    def _capture(self) -> bytes:
        library = self._library
        try:
            path = self._camera.capture(library.GP_CAPTURE_IMAGE)
            file = self._camera.file_get(path.folder, path.name, library.GP_FILE_TYPE_NORMAL)
            return bytes(file.get_data_and_size())
        except library.GPhoto2Error as error:
            raise CameraError(f"gphoto2:{self._serial}: {error}") from error


def _seconds(text: str) -> float | None:
    """Return "1/125" or "0.5" or "100" as a number, None for "bulb" and "auto"."""
    top, _, bottom = text.strip().removesuffix("s").partition("/")
    try:
        return float(top) / float(bottom or 1)
    except (ValueError, ZeroDivisionError):
        return None
