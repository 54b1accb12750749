"""Industrial cameras through GenICam, by serial number; needs the extra ``genicam``.

The manufacturer's GenTL producer talks to the camera; features are set by their standard names, and
images come as sensor values. The module is tested with the simulated producer of the ``genicam``
package, which streams, and with a substitute for the features that it lacks (exposure, triggers, a
clock). It has not been tested with a camera.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from typing import Any

from capture.devices.camera import (
    CameraError,
    CameraInfo,
    Exposure,
    Frame,
    FrameRefused,
    FrameTimeout,
    Trigger,
    WrongCamera,
)
from capture.devices.cameras.genicam_producer import (
    Connection,
    Features,
    GenicamLibrary,
    connect_camera,
    load_library,
    producer_files,
)
from capture.devices.cameras.genicam_readout import Address, parse_address, prepare_readout

MAX_BUFFER_BYTES = 2**32
"""Largest memory for the frames of a sequence, which are fetched after its end."""
MIN_BUFFERS = 3
STAMP_TOLERANCE_S = 1e-3
"""Largest lead of a frame's time stamp over the camera's clock, s: both count rounded ticks."""

_IMAGE_PAYLOADS = (1, 4)
"""Payload types: an image, and an image with chunk data (GenTL 1.6, PAYLOADTYPE_INFO_IDS)."""


def open_camera(rest: str) -> GenicamCamera:
    """Open ``genicam:SERIAL``, with ``?producer=``, ``format=``, ``line=``, ``iso=``, ``black=``.

    Raises
    ------
    CameraUrlError
        When the address, the producer or the camera cannot be found.
    CameraError
        When the camera lacks a required feature (`CameraBusy`: another program uses it;
        `MissingHarvesters`: the extra is not installed).
    """
    address = parse_address(rest)
    library = load_library(address.url)
    files = producer_files(address.url, address.producer)
    connection = connect_camera(library, address.url, address.serial, files)
    try:
        return GenicamCamera(library, connection, address)
    except BaseException:
        connection.close()
        raise


class GenicamCamera:
    """One industrial camera.

    Parameters
    ----------
    library
        From :func:`~capture.devices.cameras.genicam_producer.load_library`.
    connection
        The opened camera; closed with this object.
    address
        Requested settings.
    clock
        Clock of the host, s, for timeouts; for tests.

    Raises
    ------
    CameraError
        When a feature is missing without which no frame can be accepted: exposure time, trigger, a
        readable clock, a raw pixel format, a known black level.
    """

    def __init__(
        self,
        library: GenicamLibrary,
        connection: Connection,
        address: Address,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._library = library
        self._connection = connection
        self._acquirer = connection.acquirer
        self._url = address.url
        self._base_iso = address.iso
        self._host_clock = clock
        self._features = Features(connection.acquirer.remote_device.node_map, library, self._url)
        self._check_serial(address.serial)
        self._readout = prepare_readout(self._features, address, connection.model)
        self._info = self._readout.info
        self._got = self.configure(Exposure(0.01, self._base_iso))
        self._trigger: Trigger | None = None
        self._left = 0
        self._seq = -1
        self._frame_id: int | None = None

    @property
    def info(self) -> CameraInfo:
        """Identity and properties of the camera."""
        return self._info

    def clock_s(self) -> float:
        """Return the camera's own clock, which stamps its frames, s."""
        self._features.execute(self._readout.latch)
        return float(self._features.read(self._readout.latched)) * self._readout.tick_s

    def configure(self, want: Exposure) -> Exposure:
        """Set exposure time and gain to the nearest values that the camera has.

        A gain of 0 dB is the base sensitivity, and each 20 dB are a factor of ten. A gain whose
        unit is not stated as dB is set to its minimum, which then counts as the base sensitivity.
        """
        features = self._features
        got_us = features.set_nearest(self._readout.exposure_feature, 1e6 * want.exposure_s)
        gain_db = 0.0
        if features.has("Gain"):
            for everything in ("All", "AnalogAll"):
                if everything in features.choices("GainSelector"):
                    features.set("GainSelector", everything)
                    break
            if features.unit("Gain").strip().lower() == "db":
                asked_db = 20.0 * math.log10(want.iso / self._base_iso)
                gain_db = features.set_nearest("Gain", asked_db)
            else:
                features.set_nearest("Gain", -math.inf)
        iso = max(round(self._base_iso * 10.0 ** (gain_db / 20.0)), 1)
        self._got = Exposure(1e-6 * got_us, iso)
        return self._got

    def arm(self, count: int, trigger: Trigger) -> None:
        """Prepare for ``count`` frames; frames of before are dropped with their buffers."""
        if trigger not in self._info.triggers:
            raise CameraError(f"{self._url}: cannot be triggered by {trigger}")
        if count < 1:
            raise CameraError(f"count: got {count}, expected 1 or more")
        self.abort()
        features = self._features
        if features.has("TriggerSelector"):
            # another trigger that is still on would have to be disabled first
            for other in features.choices("TriggerSelector"):
                features.set("TriggerSelector", other)
                features.set_if_present("TriggerMode", "Off")
            features.set("TriggerSelector", "FrameStart")
        features.set("TriggerMode", "On")
        if trigger is Trigger.SOFTWARE:
            features.set("TriggerSource", "Software")
        else:
            features.set("TriggerSource", self._readout.line)
            features.set_if_present("TriggerActivation", "RisingEdge")
        size = int(features.read("PayloadSize"))
        if (count + 1) * size > MAX_BUFFER_BYTES and count + 1 > MIN_BUFFERS:
            raise CameraError(
                f"{self._url}: {count} frames of {size / 1e6:.1f} MB that wait for the end of a "
                f"sequence: got {count * size / 1e9:.1f} GB, expected "
                f"{MAX_BUFFER_BYTES / 1e9:.1f} GB at most; use a packed format or a smaller part "
                "of the sensor"
            )
        with self._library.translate_errors(f"{self._url}: arming"):
            least = max(self._acquirer.min_num_buffers, MIN_BUFFERS)
            self._acquirer.num_buffers = max(count + 1, least)
            self._acquirer.start()
        self._trigger, self._left = trigger, count
        self._seq, self._frame_id = -1, None

    def fire(self) -> None:
        """Start one exposure.

        Raises
        ------
        CameraError
            When the camera is not armed for the software trigger.
        """
        if self._trigger is not Trigger.SOFTWARE or self._left == 0:
            raise CameraError(f"{self._url}: not armed for the software trigger; arm it first")
        self._left -= 1
        self._features.execute("TriggerSoftware")

    def frame(self, timeout_s: float) -> Frame:
        """Return the next frame.

        Raises
        ------
        FrameTimeout
            When none came in time.
        FrameRefused
            When the frame has another format than the one that was set.
        LinkLost
            When the camera no longer answers.
        """
        if self._trigger is None:
            raise FrameTimeout(f"{self._url}: not armed; arm it before waiting for a frame")
        until_s = self._host_clock() + timeout_s
        incomplete = 0
        while (left_s := until_s - self._host_clock()) > 0:
            with self._library.translate_errors(f"{self._url}: waiting for a frame"):
                buffer = self._acquirer.try_fetch(timeout=left_s, is_raw=True)
            if buffer is not None:
                try:
                    return self._take(buffer)
                finally:
                    with contextlib.suppress(*self._library.errors):
                        buffer.parent.queue_buffer(buffer)
            # for a frame with lost bytes the library returns nothing, before the timeout
            incomplete += until_s - self._host_clock() > 2e-3
        self.clock_s()  # raises when the camera is disconnected
        cause = (
            f"{incomplete} came with bytes missing: check the cable, or use a packed format"
            if incomplete
            else f"is the controller's trigger line plugged into the camera's {self._readout.line}?"
            " Check the cable"
            if self._trigger is Trigger.EDGE
            else "was it fired? Fire it before the wait"
        )
        raise FrameTimeout(f"{self._url}: no frame came in {timeout_s:g} s; {cause} [SR-CAP-026]")

    def abort(self) -> None:
        """Cancel what was armed."""
        self._trigger, self._left = None, 0
        with self._library.translate_errors(f"{self._url}: stopping"):
            self._acquirer.stop()

    def close(self) -> None:
        """Release the camera; calling it twice is allowed."""
        self._trigger = None
        self._connection.close()

    def _check_serial(self, serial: str) -> None:
        """Raise an error when camera and producer report different serial numbers."""
        if not self._features.has("DeviceSerialNumber"):
            return
        own = str(self._features.read("DeviceSerialNumber"))
        if serial not in (own, self._connection.identifier):
            raise WrongCamera(
                f"{self._url}: the camera that opened reports the serial number {own}"
            )

    def _take(self, buffer: Any) -> Frame:
        """Return the frame in a buffer of the library."""
        with self._library.translate_errors(f"{self._url}: a frame"):
            payload = int(buffer.payload_type)
            number = self._optional(buffer, "pixel_format", self._readout.format_number)
            size = (
                self._optional(buffer, "width", self._info.width_px),
                self._optional(buffer, "height", self._info.height_px),
            )
            data = memoryview(buffer.raw_buffer)[self._optional(buffer, "image_offset", 0) :]
            padding = self._optional(buffer, "padding_x", 0)
            big_endian = self._optional(buffer, "pixel_endianness", 1) == 2
            frame_id = self._optional(buffer, "frame_id", -1)
            start_s = self._stamp_s(buffer)
        if payload not in _IMAGE_PAYLOADS:
            raise FrameRefused(
                f"{self._url}: got a payload of kind {payload}, expected an image; switch off its "
                "multi-part and GenDC streaming"
            )
        wanted = (self._info.width_px, self._info.height_px)
        if number != self._readout.format_number or size != wanted:
            raise FrameRefused(
                f"{self._url}: got {size[0]} x {size[1]} pixels of format 0x{number:08x}, expected "
                f"{wanted[0]} x {wanted[1]} of 0x{self._readout.format_number:08x} "
                f"({self._readout.pixel_format.name}); another program has changed the camera"
            )
        try:
            image = self._readout.pixel_format.unpack(
                data,
                width_px=size[0],
                height_px=size[1],
                padding_bytes=padding,
                big_endian=big_endian,
            )
        except ValueError as error:
            raise FrameRefused(f"{self._url}: {error}") from error
        self._check_stamp(start_s)
        self._count(frame_id)
        return Frame(
            self._info.serial, self._seq, start_s, start_s + self._got.exposure_s, self._got, image
        )

    def _count(self, frame_id: int) -> None:
        """Increment the frame number; by more than one when the camera reports skipped frames."""
        step = 1
        if frame_id >= 0:
            if self._frame_id is not None and frame_id > self._frame_id:
                step = frame_id - self._frame_id
            self._frame_id = frame_id
        self._seq += step

    def _stamp_s(self, buffer: Any) -> float:
        stamp = self._optional(buffer, "timestamp_ns", None)
        if stamp is not None:
            return 1e-9 * stamp
        return self._readout.tick_s * int(buffer.timestamp)

    def _check_stamp(self, start_s: float) -> None:
        # a producer may stamp with the computer's time; the first frame reveals it
        if self._seq < 0 and start_s > (now_s := self.clock_s()) + STAMP_TOLERANCE_S:
            raise CameraError(
                f"{self._url}: a frame is stamped {start_s - now_s:.3f} s ahead of the camera's "
                "clock: the producer stamps by another clock, so that older frames cannot be "
                "recognized; use the manufacturer's newest producer, or another one"
            )

    def _optional(self, buffer: Any, name: str, otherwise: Any) -> Any:
        """Return an attribute of a buffer, or `otherwise` when the producer does not support it."""
        try:
            value = getattr(buffer, name)
        except self._library.errors as error:
            if type(error).__name__ in ("NotAvailableException", "NotImplementedException"):
                return otherwise
            raise
        return value if value is None else int(value)
