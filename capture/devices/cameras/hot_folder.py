"""Use a folder as a camera: any tethering program that writes raw files there fits.

The flash controller's trigger line releases the camera, with light and without; with
``release=hand`` in the address a person does. Frames are raw files that appeared after the camera
was armed and have stopped growing.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from urllib.parse import parse_qsl

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

FOLDER_POLL_S = 0.1
FILE_SETTLE_S = 0.5
"""Time without a change of size after which a file counts as complete, s."""
RAW_SUFFIXES = frozenset(
    ".dng .nef .cr2 .cr3 .arw .raf .orf .rw2 .pef .srw .kdc .dcr .iiq .3fr .rwl".split()
)


def open_camera(rest: str) -> HotFolder:
    """Open ``hotfolder:PATH``, with ``?serial=NUMBER`` and ``release=hand`` where they apply."""
    path, _, query = rest.partition("?")
    words = dict(parse_qsl(query, keep_blank_values=True))
    serial, release = words.pop("serial", ""), words.pop("release", "box")
    if words or release not in ("box", "hand") or (query and not (serial or "release=" in query)):
        raise CameraUrlError(
            f"hotfolder:{rest}: got {query!r}, expected serial=NUMBER or release=hand, joined by &"
        )
    return HotFolder(Path(path), serial=serial, by_hand=release == "hand")


def parse_camera_info(frame: raw.RawFrame, serial: str, *triggers: Trigger) -> CameraInfo:
    """Read the properties of the camera from a raw file."""
    height, width = frame.cfa.shape
    levels = (frame.pattern, frame.black, frame.white)
    return CameraInfo(serial, frame.camera_model, width, height, *levels, triggers)


class HotFolder:
    """Camera over a folder that another program fills.

    Parameters
    ----------
    path
        An existing folder.
    serial
        Serial number that frames must have; empty: that of the first file in the folder, which must
        then contain one.
    by_hand
        Whether only a person can release the camera.
    clock, sleep
        For tests; the clock must be the one that stamps files (seconds since 1970).

    Raises
    ------
    CameraUrlError
        When the folder is missing, or no file contains the serial number.
    """

    def __init__(
        self,
        path: Path,
        *,
        serial: str = "",
        by_hand: bool = False,
        clock: Callable[[], float] = time.time,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if not path.is_dir():
            raise CameraUrlError(
                f"hotfolder:{path}: not a folder; make it, then try again [SR-CAP-027]"
            )
        self._path = path
        self._clock = clock
        self._sleep = sleep
        self._seen = set(self._files())
        self._seq = 0
        self._want = Exposure(0.01, 100)
        sample = next(iter(sorted(self._seen)), None)
        if sample is None:
            raise CameraUrlError(
                f"hotfolder:{path}: empty; take one test image into it, from which the camera "
                "is identified [SR-CAP-028]"
            )
        frame = raw.read(sample)
        known = serial or frame.camera_serial or frame.camera_model
        self._info = parse_camera_info(frame, known, Trigger.HAND if by_hand else Trigger.EDGE)

    @property
    def info(self) -> CameraInfo:
        """Properties of the camera, from the test image."""
        return self._info

    def clock_s(self) -> float:
        """Return the clock that stamps files."""
        return self._clock()

    def configure(self, want: Exposure) -> Exposure:
        """Record the requested exposure; the tethering program sets it."""
        self._want = want
        return want

    def arm(self, count: int, trigger: Trigger) -> None:
        """Ignore all files that are in the folder now."""
        if count < 1:
            raise CameraError(f"count: got {count}, expected 1 or more")
        if trigger not in self._info.triggers:
            raise CameraError(f"hotfolder:{self._path}: cannot be released by {trigger}")
        self._seen |= set(self._files())
        self._seq = 0

    def fire(self) -> None:
        """Raise an error: a folder cannot release a camera.

        Raises
        ------
        CameraError
            Always.
        """
        raise CameraError(
            f"hotfolder:{self._path}: cannot be fired; release the camera by the "
            "controller or by hand"
        )

    def frame(self, timeout_s: float) -> Frame:
        """Wait for a new raw file that has stopped growing, and read it."""
        deadline = self._clock() + timeout_s
        sizes: dict[Path, tuple[int, float]] = {}
        while True:
            now = self._clock()
            for path in self._files():
                if path in self._seen:
                    continue
                try:
                    size = path.stat().st_size
                except FileNotFoundError:  # a temporary file that was renamed meanwhile
                    continue
                known = sizes.get(path)
                if known is None or known[0] != size:
                    sizes[path] = (size, now)
                elif size and now - known[1] >= FILE_SETTLE_S:
                    return self._take(path)
            if now >= deadline:
                raise FrameTimeout(
                    f"hotfolder:{self._path}: no new raw file in {timeout_s:g} s; is the "
                    "tethering program writing there? Set it to RAW and to this folder [SR-CAP-029]"
                )
            self._sleep(FOLDER_POLL_S)

    def abort(self) -> None:
        """Ignore what is in the folder."""
        self._seen |= set(self._files())

    def close(self) -> None:
        """Do nothing: a folder needs no release."""

    def _files(self) -> list[Path]:
        return [p for p in self._path.iterdir() if p.suffix.lower() in RAW_SUFFIXES and p.is_file()]

    def _take(self, path: Path) -> Frame:
        self._seen.add(path)
        blob = path.read_bytes()
        picture = raw.read(path)
        written = path.stat().st_mtime
        exposure_s = picture.exposure_s or self._want.exposure_s
        frame = Frame(
            serial=picture.camera_serial or picture.camera_model or self._info.serial,
            seq=self._seq,
            t_start_s=written - exposure_s,
            t_end_s=written,
            exposure=Exposure(exposure_s, picture.iso or self._want.iso),
            image=blob,
        )
        self._seq += 1
        return frame
