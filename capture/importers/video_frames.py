"""Decode a video's frames to a folder of images, with what compression loses."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from capture.documents import Fault, InputError
from capture.importers.image_checks import (
    FRAMES_ADVICE,
    VIDEO_SUFFIXES,
    PhotoError,
    check_size,
    read_head,
)
from capture.importers.imported_session import hash_file

MAX_FRAMES = 1000
"""Frames of a video that are imported; longer ones are refused."""
MIN_DECODED_FRACTION = 0.98
"""Of the frames that the file states; fewer count as lost, as these counts are estimates."""
LOSSLESS_CODECS = frozenset(("FFV1", "HFYU", "FFVH", "PNG ", "MPNG"))
PNG_COMPRESSION = 1
SPACE_ADVICE = (
    "Free space there, name another folder for temporary files by TMPDIR, or cut the video."
)


@dataclass(frozen=True, slots=True)
class ImageSource:
    """A folder of images, or one file, with what is known of its origin.

    Attributes
    ----------
    path
        Folder or file that an import reads.
    assumed
        Assumptions and losses, one sentence each; empty unless it was a video.
    video
        For a session's manifest: name, SHA-256, codec, and stated and decoded number of frames of
        the video; None unless it was one.
    """

    path: Path
    assumed: tuple[str, ...] = ()
    video: Mapping[str, Any] | None = None

    def to_manifest(self) -> dict[str, Any]:
        """Return the entry of a session's manifest; empty unless it was a video."""
        return {"video": dict(self.video)} if self.video else {}


def is_video(path: Path) -> bool:
    """Return whether a path is a file with the suffix of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


@contextmanager
def open_source(path: Path) -> Iterator[ImageSource]:
    """Yield a folder of images, or that of a video's frames, which is removed afterwards.

    The frames are 8-bit PNG files named 00001.png and so on. An error about one of them names the
    video and the number of the frame instead.

    Parameters
    ----------
    path
        Folder, image or video; only a video is decoded.

    Raises
    ------
    PhotoError
        For a video that cannot be decoded, is too long, or whose frames need more space than is
        free.
    """
    if not is_video(path):
        yield ImageSource(path)
        return
    with tempfile.TemporaryDirectory(prefix="skinrig-") as scratch:
        folder = Path(scratch) / path.stem
        folder.mkdir()
        source = _write_frames(path, folder)
        try:
            yield source
        except Exception as error:  # of any package: their messages name the removed folder
            _name_video(error, path, folder)
            raise


def _name_video(error: Exception, video: Path, folder: Path) -> None:
    """Replace the paths of frames in an error by the video and the number of the frame."""
    frame = re.compile(re.escape(str(folder)) + r"[\\/](\d{5})\.png")

    def rename(text: str) -> str:
        text = frame.sub(lambda found: f"{video}, frame {int(found[1])}", text)
        return text.replace(str(folder), str(video))

    if not isinstance(error, InputError):
        error.args = tuple(rename(one) if isinstance(one, str) else one for one in error.args)
        return
    bare = re.compile(r"(\d{5})\.png")
    faults = [
        replace(
            one,
            path=f"frame {int(found[1])}" if (found := bare.fullmatch(one.path)) else one.path,
            got=rename(one.got),
            expected=rename(one.expected),
        )
        for one in error.faults
    ]
    InputError.__init__(
        error,
        error.what,
        where=rename(error.where),
        faults=faults,
        advice=error.advice,
        code=error.code,
    )


def _write_frames(video: Path, folder: Path) -> ImageSource:
    """Write the frames of a video, and return their folder with what they rest on."""
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
                raise PhotoError("frames cannot be written", where=str(folder), advice=SPACE_ADVICE)
            if count == 1:
                _require_space(folder, file.stat().st_size, max(stated, 1))
        if not count:
            raise _not_decodable(where, "no frame that can be decoded")
        codec = _read_codec(stream)
    finally:
        stream.release()
        cv2.utils.logging.setLogLevel(level)
    bits = 8.0 * video.stat().st_size / (width * height * count)
    about = {
        "name": video.name,
        "sha256": hash_file(video),
        "codec": codec.strip(),
        "stated_frames": stated,
        "decoded_frames": count,
    }
    return ImageSource(folder, tuple(_list_assumptions(codec, bits, count, stated)), about)


def _require_space(folder: Path, first_bytes: int, stated: int) -> None:
    """Refuse a video whose other frames, each as large as the first one, do not fit."""
    free, needed = shutil.disk_usage(folder).free, (stated - 1) * first_bytes
    if needed > free:
        raise PhotoError(
            "has too little space for the video's frames",
            where=str(folder.parent.parent),
            faults=[
                Fault(
                    "free space",
                    f"{free / 1e6:.0f} MB",
                    f"{needed / 1e6:.0f} MB for {stated} frames of {first_bytes / 1e6:.2g} MB",
                )
            ],
            advice=SPACE_ADVICE,
        )


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
        code="SR-IMP-018",
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
