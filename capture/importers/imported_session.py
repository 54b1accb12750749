"""Create the session of imported images, complete or not at all, with a placeholder camera."""

import hashlib
import re
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

from capture.documents import Fault
from capture.importers.image_checks import PhotoError
from capture.plan import Plan
from capture.raw import RawFrame
from capture.rig import Light, Rig, Vector, View
from capture.session import Session, SessionDiskError, SubjectRecord

SENSOR_MM = 36.0
"""Width of the full-frame sensor that is assumed for an unknown one."""
DISTANCE_MM = 1000.0
"""Assumed distance of a camera or a light whose distance was not measured."""


def make_placeholder_view(frame: RawFrame, **known: Any) -> View:
    """Return a view for an image of which only the frame is known.

    Parameters
    ----------
    frame
        Frame of the image.
    **known
        Other fields of the view.
    """
    height, width = frame.cfa.shape
    about: dict[str, Any] = {
        "name": "cam",
        "camera_model": frame.camera_model or "unknown camera",
        "serial": "unknown",
        "position_mm": (0.0, 0.0, DISTANCE_MM),
        "target_mm": (0.0, 0.0, 0.0),
        "up": (0.0, 1.0, 0.0),
        "focal_mm": frame.focal_mm or 50.0,
        "pixel_um": 1e3 * SENSOR_MM / width,
        "width_px": width,
        "height_px": height,
        "f_number": 8.0,
        "readout_s": 0.0,
        "bit_depth": min(max(frame.white.bit_length(), 8), 16),
        "cfa": frame.pattern,
        "black_level": round(sum(frame.black) / len(frame.black)),
        "white_level": frame.white,
        "full_well_e": 20_000.0,
        "read_noise_e": 10.0,
    }
    return View(**{**about, **known})


def make_placeholder_light(name: str, position_mm: Vector, illuminant: str, **known: Any) -> Light:
    """Return a light of which only position and color are known."""
    about = {"illuminant": illuminant, "energy_ws": 1.0, "radius_mm": 1.0, **known}
    return Light(name=name, position_mm=position_mm, **about)


def make_placeholder_rig(name: str, lights: Sequence[Light], *views: View) -> Rig:
    """Return a rig without controllers."""
    return Rig(name=name, lights=tuple(lights), views=views, boxes=(), recycle_s=0.0)


def hash_file(file: Path) -> str:
    """Return the digest of a file's bytes, prefixed with its algorithm's name."""
    with file.open("rb") as stream:
        return f"sha256:{hashlib.file_digest(stream, 'sha256').hexdigest()}"


@contextmanager
def create_imported_session(
    target: Path,
    plan: Plan,
    rig: Rig,
    subject: SubjectRecord | None,
    extra: Mapping[str, Any],
    clock: Callable[[], datetime],
) -> Iterator[Session]:
    """Create a session at ``target`` that is closed at the end; on failure nothing is kept.

    Raises
    ------
    PhotoError
        Unless ``target`` is a new or empty folder.
    SessionDiskError
        When the disk refuses; nothing is kept.
    """
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise PhotoError(
            "cannot write here",
            where=str(target),
            faults=[Fault("out", "something that exists", "a new or empty folder")],
            advice="Choose a new folder.",
        )
    part = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with Session.create(
            part,
            plan=plan,
            rig=rig,
            devices={},
            subject=subject or SubjectRecord("unnamed"),
            source="measured",
            extra=extra,
            now=clock,
        ) as session:
            yield session
            session.close()
        if target.exists():
            target.rmdir()
        part.rename(target)
    except BaseException as exc:
        shutil.rmtree(part, ignore_errors=True)
        if isinstance(exc, SessionDiskError):
            advice = "Free space or name another folder, then import again; nothing was kept."
            raise SessionDiskError(exc.what, where=str(target), advice=advice) from exc
        raise


def find_common_white(values: Sequence[float | None]) -> float | None:
    """Return the white value under which several files keep their ratios; None: all integers.

    Examples
    --------
    >>> find_common_white([None, 2.0, 0.0, 3.0])
    3.0
    """
    given = [value for value in values if value is not None]
    return max(given) if given else None


def restate_white(notes: Sequence[str], white_value: float) -> tuple[str, ...]:
    """Return a photograph's notes with another white value.

    Examples
    --------
    >>> restate_white(["values were divided by 3 to fit the range", "a"], 5.0)
    ('values were divided by 5 to fit the range', 'a')
    """
    pattern = r"^values were divided by \S+ to"
    return tuple(re.sub(pattern, f"values were divided by {white_value:.6g} to", n) for n in notes)
