"""Camera behind a TCP port: ``tcp://HOST:PORT/VIEW``, as ``skinrig serve`` prints it.

Another program can serve its cameras in the same way: see `capture.devices.cameras.camera_wire`. A
lost connection is made again once until the next frame arrives; the exposure is lost with it, and
its frame is refused, so that the step is taken again.
"""

import contextlib
import logging
import socket
from time import monotonic, sleep
from typing import Any

from capture.devices.camera import (
    Camera,
    CameraBusy,
    CameraError,
    CameraInfo,
    CameraUrlError,
    Exposure,
    Frame,
    FrameRefused,
    FrameTimeout,
    Trigger,
)
from capture.devices.cameras import camera_wire
from capture.devices.cameras.camera_wire import BadMessage
from capture.devices.port import LinkLost

log = logging.getLogger(__name__)

RECONNECTION_TIMEOUT_S = 10.0
"""Largest time to open a camera again after a lost connection, s: it may read out."""
RECONNECTION_PAUSE_S = 0.2
ANSWER_TIMEOUT_S = 5.0
"""Largest delay of an answer beyond the requested time, s."""
DEVELOP_TIMEOUT_S = 300.0
"""Largest time from the arrival of a frame until its pixels are sent, s."""
_ERROR_CLASSES = {"FrameTimeout": FrameTimeout, "CameraBusy": CameraBusy}


def open_camera(rest: str) -> Camera:
    """Open ``tcp://HOST:PORT/VIEW``."""
    address, slash, view = rest.partition("/")
    host, colon, port = address.rpartition(":")
    if not (slash and view and colon and host and port.isdecimal() and 0 < int(port) < 65_536):
        raise CameraUrlError(f"tcp://{rest}: got {rest!r}, expected HOST:PORT/VIEW")
    return RemoteCamera(host, int(port), view)


class RemoteCamera:
    """Camera that another program serves.

    Parameters
    ----------
    host, port
        Address of the server.
    view
        View of the camera there.

    Raises
    ------
    LinkLost
        When nothing answers there.
    CameraError
        When no such camera is served there (`CameraBusy`: another program uses it).
    """

    def __init__(self, host: str, port: int, view: str) -> None:
        self._url = f"tcp://{host}:{port}/{view}"
        self._host, self._port, self._view = host, port, view
        self._id = 0
        self._is_closed = self._is_reconnected = False
        self._expected_frames = 0
        self._exposure: Exposure | None = None
        self._socket: socket.socket | None = None
        self._connect()

    def _connect(self) -> None:
        """Connect and open the camera."""
        self._received = bytearray()
        try:
            self._socket = socket.create_connection(
                (self._host, self._port), timeout=ANSWER_TIMEOUT_S
            )
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError as exc:
            raise LinkLost(f"cannot open {self._url}: {exc}; is it being served?") from exc
        try:
            answer = self._exchange(
                "open", version=camera_wire.CAMERA_WIRE_VERSION, view=self._view
            )
            with self._translate_errors():
                self._info = camera_wire.info_from_json(answer["info"])
        except BaseException:
            self._drop()
            raise

    def _reconnect(self, lost: LinkLost) -> None:
        """Make a lost connection again, with the exposure that was set; raise `lost` if not."""
        if self._is_closed or self._is_reconnected:
            raise lost
        self._is_reconnected = True
        info = self._info
        last_s = monotonic() + RECONNECTION_TIMEOUT_S
        while True:
            try:
                self._connect()
                break
            except CameraBusy:
                if monotonic() >= last_s:
                    raise lost from None
                sleep(RECONNECTION_PAUSE_S)
            except LinkLost:
                raise lost from None
        if self._info != info:
            self._drop()
            other, self._info = self._info, info
            raise LinkLost(
                f"{lost}; then another camera answered: got {other}, expected {info}"
            ) from None
        log.warning("%s; connected again", lost)
        if self._exposure is not None:
            self._exchange(
                "configure", exposure_s=self._exposure.exposure_s, iso=self._exposure.iso
            )

    @property
    def info(self) -> CameraInfo:
        """Identity and properties of the camera."""
        return self._info

    def clock_s(self) -> float:
        """Return the time on the clock that stamps its frames, s."""
        with self._translate_errors():
            return float(self._ask("clock")["clock_s"])

    def configure(self, want: Exposure) -> Exposure:
        """Set an exposure and return the settings in effect."""
        self._exposure = want
        answer = self._ask("configure", exposure_s=want.exposure_s, iso=want.iso)
        with self._translate_errors():
            return Exposure(float(answer["exposure_s"]), int(answer["iso"]))

    def arm(self, count: int, trigger: Trigger) -> None:
        """Prepare for `count` frames and drop frames that wait from before."""
        self._expected_frames = 0
        self._ask("arm", count=count, trigger=str(trigger))
        self._expected_frames = count

    def fire(self) -> None:
        """Start one exposure."""
        self._ask("fire")

    def frame(self, timeout_s: float) -> Frame:
        """Return the next frame, or raise `FrameTimeout`.

        A damaged one, and one that was lost with its connection, raise `FrameRefused`.
        """
        answer = self._ask("frame", timeout_s=timeout_s, reply_delay_s=timeout_s)
        self._expected_frames = max(self._expected_frames - 1, 0)
        try:
            camera_wire.check_blob(answer, answer["blob"])
            frame = camera_wire.frame_from_message(answer["frame"], answer["blob"])
        except (BadMessage, KeyError, TypeError) as exc:
            raise FrameRefused(f"{self._url}: a frame was damaged on its way: {exc!r}") from exc
        self._is_reconnected = False
        return frame

    def abort(self) -> None:
        """Cancel what was armed."""
        self._expected_frames = 0
        self._ask("abort")

    def close(self) -> None:
        """Release the camera; calling it twice is allowed."""
        self._is_closed = True
        self._drop()

    def _drop(self) -> None:
        connection, self._socket = self._socket, None
        if connection is not None:
            with contextlib.suppress(OSError):
                connection.close()

    @contextlib.contextmanager
    def _translate_errors(self) -> Any:
        try:
            yield
        except (BadMessage, KeyError, TypeError, ValueError) as exc:
            self._drop()
            raise CameraError(
                f"{self._url}: got an answer that cannot be decoded: {exc!r}"
            ) from exc

    def _ask(self, request: str, **fields: Any) -> dict[str, Any]:
        """Send one request and return its answer; after a lost connection, again on a new one.

        Raises
        ------
        FrameRefused
            When the connection was lost, and made again, before all frames had arrived.
        LinkLost
            When it cannot be made again, or was lost twice without a frame.
        """
        try:
            return self._exchange(request, **fields)
        except LinkLost as lost:
            self._reconnect(lost)
        if self._expected_frames or request == "frame":  # the server has aborted its exposures
            self._expected_frames = 0
            raise FrameRefused(
                f"{self._url}: the link was lost in {request!r} and made again; the exposure is "
                "repeated"
            )
        return self._exchange(request, **fields)

    def _exchange(
        self, request: str, *, reply_delay_s: float = 0.0, **fields: Any
    ) -> dict[str, Any]:
        """Send one request and return the fields of its answer, its bytes under ``blob``."""
        connection = self._socket
        if connection is None:
            raise LinkLost(f"{self._url}: the connection is closed; open the camera again")
        self._id += 1
        try:
            connection.settimeout(ANSWER_TIMEOUT_S + reply_delay_s)
            connection.sendall(
                camera_wire.encode_message({"id": self._id, "do": request, **fields})
            )
            while True:
                answer = self._message(connection)
                if answer.get("id") != self._id:
                    continue
                if not answer.get("developing"):
                    break
                connection.settimeout(DEVELOP_TIMEOUT_S)
        except (OSError, BadMessage) as exc:
            self._drop()
            raise LinkLost(f"{self._url}: the link was lost in {request!r} ({exc})") from exc
        if answer.get("ok") is not True:
            kind = _ERROR_CLASSES.get(str(answer.get("error")), CameraError)
            raise kind(f"{self._url}: {answer.get('text', 'refused without a reason')}")
        return answer

    def _message(self, connection: socket.socket) -> dict[str, Any]:
        while (end := self._received.find(b"\n")) < 0:
            if len(self._received) > camera_wire.MAX_HEADER_BYTES:
                raise BadMessage("header: too long")
            self._receive(connection)
        fields = camera_wire.decode_header(bytes(self._received[:end]))
        del self._received[: end + 1]
        size = camera_wire.blob_size(fields)
        while len(self._received) < size:
            self._receive(connection)
        fields["blob"] = bytes(self._received[:size])
        del self._received[:size]
        return fields

    def _receive(self, connection: socket.socket) -> None:
        data = connection.recv(1 << 16)
        if not data:
            raise ConnectionResetError("the other end closed the connection")
        self._received += data
