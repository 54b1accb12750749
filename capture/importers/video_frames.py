"""Decode a video's frames to a folder of images, with what compression loses."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from capture.documents import Fault
from capture.importers.image_checks import (
    FRAMES_ADVICE,
    VIDEO_SUFFIXES,
    PhotoError,
    check_size,
    read_head,
)

MAX_FRAMES = 1000
"""Frames of a video that are imported; longer ones are refused."""
MIN_DECODED_FRACTION = 0.98
"""Of the frames that the file states; fewer count as lost, as these counts are estimates."""
LOSSLESS_CODECS = frozenset(("FFV1", "HFYU", "FFVH", "PNG ", "MPNG"))
PNG_COMPRESSION = 1


@dataclass(frozen=True, slots=True)
class ImageSource:
    """A folder of images, or one file, with what is known of its origin.

    Attributes
    ----------
    path
        Folder or file that an import reads.
    assumed
        Assumptions and losses, one sentence each; empty unless it was a video.
    """

    path: Path
    assumed: tuple[str, ...] = ()


def is_video(path: Path) -> bool:
    """Return whether a path is a file with the suffix of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


@contextmanager
def open_source(path: Path) -> Iterator[ImageSource]:
    """Yield a folder of images, or that of a video's frames, which is removed afterwards.

    The frames are 8-bit PNG files named 00001.png and so on.

    Parameters
    ----------
    path
        Folder, image or video; only a video is decoded.

    Raises
    ------
    PhotoError
        For a video that cannot be decoded, or is too long.
    """
    if not is_video(path):
        yield ImageSource(path)
        return
    with tempfile.TemporaryDirectory(prefix="skinrig-") as scratch:
        folder = Path(scratch) / path.stem
        folder.mkdir()
        yield ImageSource(folder, tuple(_write_frames(path, folder)))


def _write_frames(video: Path, folder: Path) -> list[str]:
    """Write the frames of a video, and return the assumptions that they rest on."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # quiet: errors are ours
    import cv2

    where = str(video)
    read_head(video, where)
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    stream = cv2.VideoCapture(where, cv2.CAP_FFMPEG)
    try:
        if not stream.isOpened():
            raise _not_decodable(where, "no stream of images")
        width, height = (
            int(stream.get(one)) for one in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        )
        check_size(width, height, where)
        stated = int(stream.get(cv2.CAP_PROP_FRAME_COUNT))
        count = 0
        while True:
            good, frame = stream.read()
            if not good:
                break
            count += 1
            _require_short(max(count, stated), where)
            file = folder / f"{count:05d}.png"
            if not cv2.imwrite(str(file), frame, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION]):
                raise PhotoError(
                    "frames cannot be written",
                    where=str(folder),
                    advice="Free space in the folder for temporary files (TMPDIR).",
                )
        if not count:
            raise _not_decodable(where, "no frame that can be decoded")
        codec = _read_codec(stream)
    finally:
        stream.release()
        cv2.utils.logging.setLogLevel(level)
    bits = 8.0 * video.stat().st_size / (width * height * count)
    return _list_assumptions(codec, bits, count, stated)


def _require_short(count: int, where: str) -> None:
    if count > MAX_FRAMES:
        raise PhotoError(
            "is too long",
            where=where,
            faults=[Fault("frames", f"{count} or more", f"at most {MAX_FRAMES}")],
            advice="Cut it by `ffmpeg -ss START -t SECONDS -i VIDEO -c copy SHORT`.",
        )


def _not_decodable(where: str, got: str) -> PhotoError:
    return PhotoError(
        "cannot be decoded",
        where=where,
        faults=[Fault("video", got, "frames of MP4, AVI or MOV")],
        advice=FRAMES_ADVICE,
        code="SR-IMP-017",
    )


def _read_codec(stream: Any) -> str:
    import cv2

    code = int(stream.get(cv2.CAP_PROP_FOURCC))
    letters = bytes((code >> shift) & 0xFF for shift in (0, 8, 16, 24)).decode("ascii", "replace")
    return letters if letters.isprintable() else "an unnamed codec"


def _list_assumptions(codec: str, bits: float, count: int, stated: int) -> list[str]:
    found = []
    if codec.upper() not in LOSSLESS_CODECS:
        found.append(
            f"the frames were compressed ({codec.strip()}, {bits:.2g} bits per pixel): fine "
            "structure, colors and dark values are changed, which stated errors leave out"
        )
    found.append(
        "the camera's transfer curve of the video is not known: 8-bit values count as sRGB unless "
        "--encoding or the shading shows linear values"
    )
    if count < MIN_DECODED_FRACTION * stated:
        found.append(f"{count} of the {stated} frames that the file states could be decoded")
    return found
