"""Camera interface, and the rule by which a frame is accepted.

A valid image can be the wrong one: left over from an earlier trigger, from the camera next to it,
or taken with other settings. Each frame is therefore accepted by its own metadata, never because it
arrived.
"""

from __future__ import annotations

import importlib.metadata
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache
from typing import Any, Protocol

import numpy as np

from capture.arrays import UInt16Array
from capture.devices.port import DeviceError

CAMERA_ENTRY_POINTS = "capture.cameras"
MAX_EXPOSURE_DEVIATION_EV = 1.0 / 3.0


class CameraError(DeviceError, RuntimeError):
    """Raised when a camera did not do what was requested."""


class CameraUrlError(CameraError, ValueError):
    """Raised for an address at which no camera answers."""


class CameraBusy(CameraError):
    """Raised when another program uses the camera."""


class FrameTimeout(CameraError, TimeoutError):
    """Raised when no frame came in time."""


class FrameRefused(CameraError):
    """Raised for a frame that is not the requested one."""


class StaleFrame(FrameRefused):
    """Raised for a frame of an earlier trigger."""


class WrongCamera(FrameRefused):
    """Raised for a frame of another camera."""


class WrongExposure(FrameRefused):
    """Raised for a frame with other settings than those requested."""


class Trigger(StrEnum):
    """Source of the trigger of an exposure."""

    SOFTWARE = "software"
    EDGE = "edge"
    LEVEL = "level"
    HAND = "hand"
    """A person presses the shutter button."""


@dataclass(frozen=True, slots=True)
class Exposure:
    """Settings of an exposure.

    Attributes
    ----------
    exposure_s
        Exposure time, s, above 0.
    iso
        ISO sensitivity, above 0.
    """

    exposure_s: float
    iso: int

    def __post_init__(self) -> None:
        """Reject times and sensitivities that are not positive."""
        if not (math.isfinite(self.exposure_s) and self.exposure_s > 0):
            raise ValueError(f"exposure_s: got {self.exposure_s}, expected a time above 0")
        if self.iso <= 0:
            raise ValueError(f"iso: got {self.iso}, expected a number above 0")

    def deviation_ev(self, other: Exposure) -> float:
        """Return how much brighter ``self`` exposes than ``other``, in stops.

        Examples
        --------
        >>> Exposure(0.02, 100).deviation_ev(Exposure(0.01, 200))
        0.0
        """
        return math.log2(self.exposure_s * self.iso / (other.exposure_s * other.iso))


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """Identity and properties of a camera.

    Attributes
    ----------
    serial, model
        The serial number identifies the camera; no two in a rig share one.
    width_px, height_px
        Size of its frames.
    pattern
        Color filter array, "RGGB" and so on, or "MONO".
    black, white
        Levels, DN; black for each position of the color filter array.
    triggers
        Triggers that it supports.
    pixel_um
        Side of a pixel, um; None: not reported.
    """

    serial: str
    model: str
    width_px: int
    height_px: int
    pattern: str
    black: tuple[float, ...]
    white: int
    triggers: tuple[Trigger, ...]
    pixel_um: float | None = None


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame as a camera delivers it, with its metadata.

    Attributes
    ----------
    serial
        Serial number of the camera that took it.
    seq
        Number of the frame since the camera was armed, from 0.
    t_start_s, t_end_s
        Begin and end of the exposure, on the camera's clock.
    exposure
        Settings read back from the camera.
    image
        Sensor values, (H, W) uint16, or a whole raw file as bytes.
    light
        Metadata of the light, as far as the camera has any; may be empty.
    """

    serial: str
    seq: int
    t_start_s: float
    t_end_s: float
    exposure: Exposure
    image: UInt16Array | bytes
    light: Mapping[str, Any] = field(default_factory=dict)


class Camera(Protocol):
    """Interface of a camera, whatever its connection."""

    @property
    def info(self) -> CameraInfo:
        """Identity and properties of the camera."""

    def clock_s(self) -> float:
        """Return the time on the clock that stamps its frames, s."""

    def configure(self, want: Exposure) -> Exposure:
        """Set an exposure and return the settings in effect."""

    def arm(self, count: int, trigger: Trigger) -> None:
        """Prepare for ``count`` frames and drop frames that wait from before."""

    def fire(self) -> None:
        """Start one exposure (software trigger only)."""

    def frame(self, timeout_s: float) -> Frame:
        """Return the next frame, or raise :class:`FrameTimeout`."""

    def abort(self) -> None:
        """Cancel what was armed."""

    def close(self) -> None:
        """Release the camera."""


def check_address(url: str) -> None:
    """Check that the address names an installed kind of camera; nothing is opened.

    Raises
    ------
    CameraUrlError
    """
    _entry(url)


@cache  # each call reads the metadata of all installed packages
def _kinds() -> dict[str, importlib.metadata.EntryPoint]:
    return {one.name: one for one in importlib.metadata.entry_points(group=CAMERA_ENTRY_POINTS)}


def _entry(url: str) -> importlib.metadata.EntryPoint:
    kind, colon, _ = url.partition(":")
    found = _kinds()
    if not colon or kind not in found:
        raise CameraUrlError(
            f"camera address: got {url!r}, expected KIND:REST with KIND one of "
            f"{', '.join(sorted(found))}; for example hotfolder:incoming [SR-CAP-032]"
        )
    return found[kind]


def open_camera(url: str) -> Camera:
    """Open a camera by its address.

    Parameters
    ----------
    url
        ``sim://WORLD/VIEW``, ``tcp://HOST:PORT/VIEW``, ``hotfolder:PATH``, ``gphoto2:SERIAL``,
        ``genicam:SERIAL``.
        The part before the colon names an entry point of the group ``capture.cameras``.

    Raises
    ------
    CameraUrlError
        When no such kind of camera is installed.
    CameraError
        When the camera does not answer.
    """
    rest = url.partition(":")[2]
    camera: Camera = _entry(url).load()(rest.removeprefix("//"))
    return camera


def check_frame(
    frame: Frame, info: CameraInfo, *, seq: int, not_before_s: float, want: Exposure
) -> None:
    """Raise an error when ``frame`` is not the requested one.

    Parameters
    ----------
    frame
        The frame as the camera delivered it.
    info
        Properties of the camera that was triggered.
    seq
        Number that the frame must have.
    not_before_s
        Time of the trigger, on the camera's clock.
    want
        Exposure that was requested.

    Raises
    ------
    WrongCamera
        When the serial number is another camera's.
    StaleFrame
        When it was exposed before the trigger, or has another number.
    WrongExposure
        When its settings differ by more than a third of a stop.
    """
    if frame.serial != info.serial:
        raise WrongCamera(
            f"camera {info.serial}: got a frame of camera {frame.serial}; two cameras are mixed "
            "up: address each by its serial number"
        )
    if frame.seq != seq:
        raise StaleFrame(f"camera {info.serial}: got frame number {frame.seq}, expected {seq}")
    if frame.t_start_s < not_before_s:
        raise StaleFrame(
            f"camera {info.serial}: got a frame exposed {not_before_s - frame.t_start_s:.3f} s "
            "before the trigger"
        )
    deviation = frame.exposure.deviation_ev(want)
    if not abs(deviation) <= MAX_EXPOSURE_DEVIATION_EV + 1e-9:
        raise WrongExposure(
            f"camera {info.serial}: got {frame.exposure.exposure_s:g} s at ISO "
            f"{frame.exposure.iso}, expected {want.exposure_s:g} s at ISO {want.iso} "
            f"({deviation:+.2f} stops off); set the camera to manual exposure and ISO [SR-CAP-031]"
        )
    if isinstance(frame.image, np.ndarray):
        shape = (info.height_px, info.width_px)
        if frame.image.shape != shape or frame.image.dtype != np.uint16:
            raise FrameRefused(
                f"camera {info.serial}: got a {frame.image.dtype} frame of shape "
                f"{frame.image.shape}, expected uint16 {shape}"
            )


def next_frame(
    camera: Camera, *, seq: int, not_before_s: float, want: Exposure, timeout_s: float
) -> tuple[Frame, int]:
    """Return the requested frame, and the number of stale frames dropped before it.

    Parameters
    ----------
    camera
        Camera, armed.
    seq, not_before_s, want
        As for :func:`check_frame`.
    timeout_s
        Time to wait for each frame, s.

    Raises
    ------
    FrameTimeout
        When nothing came, or nothing but stale frames (at most 8 are read).
    WrongCamera, WrongExposure
        When waiting cannot help.
    """
    for stale in range(8):
        frame = camera.frame(timeout_s)
        try:
            check_frame(frame, camera.info, seq=seq, not_before_s=not_before_s, want=want)
        except StaleFrame:
            continue
        return frame, stale
    raise FrameTimeout(
        f"camera {camera.info.serial}: sent 8 stale frames in a row; switch it off and on"
    )


def check_serials(cameras: Mapping[str, Camera], expected: Sequence[tuple[str, str]]) -> None:
    """Raise an error when a view's camera is not the one that the rig file names.

    Parameters
    ----------
    cameras
        Cameras by view.
    expected
        Serial number by view, as in the rig file.
    """
    for view, serial in expected:
        if view not in cameras:
            raise CameraUrlError(f"view {view!r}: no camera was given; add --camera {view}=URL")
        got = cameras[view].info.serial
        if got != serial:
            raise WrongCamera(
                f"view {view!r}: got the camera {got}, expected {serial} (rig file); exchange "
                "the addresses, or write the new serial number into the rig file [SR-CAP-030]"
            )
