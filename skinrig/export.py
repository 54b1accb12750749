"""What is handed to other programs: sessions, as agreed to by their subjects, and BRDFs."""

from __future__ import annotations

import json
import shutil
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime
from importlib.metadata import version
from pathlib import Path

from capture.session import Session, verify
from capture.session.contents import undamaged_contents
from capture.session.frames import check_file
from capture.session.mhl import write_first_generation
from skinrig import brdf_export
from skinrig.errors import UsageError
from skinrig.event_model import documents

FRAMES, DOCUMENTS = "frames", "documents.jsonl"


class ExportError(ValueError):
    """An export that cannot be made as asked."""


@dataclass(frozen=True, slots=True)
class Exported:
    """What an export made."""

    path: Path
    manifest: Path
    """The ASC MHL manifest that lists every file."""
    files: int
    """Without the manifest."""


def export(
    session_path: str | Path,
    out: str | Path,
    *,
    to: str,
    use: str,
    today: date | None = None,
    now: datetime | None = None,
) -> Exported:
    """Copy a session for another program, sealed by an ASC MHL manifest; all of it, or nothing.

    Parameters
    ----------
    session_path
        SESSION/ folder.
    out
        New folder.
    to
        One of `FORMATS`: "mhl" (the whole session), "frames" (DNG files alone), "event-model" (the
        frames, and documents.jsonl as Bluesky's event model describes a run).
    use
        What the copy is for; must lie within the consent's scope, on a day before it ends.
    today, now
        For tests.

    Raises
    ------
    ConsentError
        Where the subject has not agreed to the use, or not any more.
    ExportError
        For an unknown format, or a folder that exists.
    SessionError
        Where the session is damaged.
    """
    if to not in FORMATS:
        raise ExportError(f"to: got {to!r}, expected one of {', '.join(FORMATS)}")
    session = Session.open(session_path)
    session.require_consent(use, today=today)
    target = _fresh(out)
    found = verify(session_path)
    if not found.ok:
        raise ExportError(f"{session_path}: is damaged, nothing was copied: {found.problems[0]}")
    return _sealed(target, lambda part: FORMATS[to](session, part), now)


def export_brdfs(
    appearance_path: str | Path,
    out: str | Path,
    *,
    to: str,
    place: brdf_export.Place | None = None,
    now: datetime | None = None,
) -> Exported:
    """Write an appearance's lobes, and the BRDF of a place, for other programs; all, or nothing.

    Parameters
    ----------
    appearance_path
        APPEARANCE/ folder of a dome, or a fitted MODEL.
    out
        New folder.
    to
        "merl" or "rgl", see :func:`skinrig.brdf_export.write_brdfs`.
    place
        Where on the skin; None: lobes alone.
    now
        For tests.

    Raises
    ------
    ExportError
        For an unknown format, or a folder that exists.
    """
    if to not in brdf_export.SUFFIX:
        raise ExportError(f"to: got {to!r}, expected one of {', '.join(brdf_export.SUFFIX)}")
    target = _fresh(out)

    def write(part: Path) -> None:
        brdf_export.write_brdfs(appearance_path, part, to=to, place=place)

    return _sealed(target, write, now)


def named(use: str | None) -> str:
    """Return the use that a command line names.

    Raises
    ------
    skinrig.errors.UsageError
        When it names none.
    """
    if use is None:
        raise UsageError("--use: got none; say what the copy of a session is for, e.g. research")
    return use


def _fresh(out: str | Path) -> Path:
    target = Path(out)
    if target.exists():
        raise ExportError(f"{target}: exists; choose a new folder")
    return target


def _sealed(target: Path, write: Callable[[Path], None], now: datetime | None) -> Exported:
    moment = now or datetime.now(UTC)
    target.parent.mkdir(parents=True, exist_ok=True)
    # of the final name, which the manifest bears, in a hidden folder beside it
    shelter = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.part")
    part = shelter / target.name
    try:
        part.mkdir(parents=True)
        write(part)
        files = sum(path.is_file() for path in part.rglob("*"))
        manifest = write_first_generation(part, now=moment, version=version("skinrig"))
        part.rename(target)
    finally:
        shutil.rmtree(shelter, ignore_errors=True)
    return Exported(target, target / manifest.relative_to(part), files)


def _copy_all(session: Session, out: Path) -> None:
    for name in ("session.json", "journal.jsonl"):
        shutil.copyfile(session.path / name, out / name)
    for folder in ("frames", "attachments"):
        if (session.path / folder).is_dir():
            (out / folder).mkdir()
    # all attempts, not the last alone: the journal names them
    for line in undamaged_contents(session.path).file_lines:
        (out / line.file).write_bytes(check_file(session.path / line.file, line))


def _copy_frames(session: Session, out: Path) -> None:
    (out / FRAMES).mkdir()
    for record in session.frames():
        (out / record.file).write_bytes(check_file(session.path / record.file, record.line))


def _copy_documents(session: Session, out: Path) -> None:
    _copy_frames(session, out)
    with (out / DOCUMENTS).open("w", encoding="utf-8") as stream:
        for name, document in documents(session):
            stream.write(json.dumps([name, document], allow_nan=False) + "\n")


FORMATS: Mapping[str, Callable[[Session, Path], None]] = {
    "mhl": _copy_all,
    "frames": _copy_frames,
    "event-model": _copy_documents,
}
