"""Sessions handed to other programs, as agreed to by their subjects."""

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from datetime import date, datetime
from pathlib import Path
from typing import Any

from capture.session import Session, verify
from capture.session.contents import undamaged_contents
from capture.session.frames import check_file
from reconstruction.pipeline.inputs import Inputs
from skinrig.errors import UsageError
from skinrig.exporting.sealing import Exported, ExportError, fresh, sealed, write_json
from skinrig.exporting.sessions.event_model import documents

FRAMES_FOLDER, DOCUMENTS_FILE = "frames", "documents.jsonl"


def export_session(
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
        One of `SESSION_FORMATS`: "mhl" (the whole session), "frames" (DNG files alone),
        "event-model" (the frames, and documents.jsonl as Bluesky's event model describes a run).
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
    if to not in SESSION_FORMATS:
        raise ExportError(f"to: got {to!r}, expected one of {', '.join(SESSION_FORMATS)}")
    target = fresh(out)
    session = allowed(session_path, use, today=today)
    return sealed(target, lambda part: SESSION_FORMATS[to](session, part), now)


def allowed(path: str | Path, use: str, *, today: date | None = None) -> Session:
    """Open an undamaged session whose subject agreed to a use; see :func:`export_session`."""
    session = Session.open(path)
    session.require_consent(use, today=today)
    found = verify(path)
    if not found.ok:
        raise ExportError(f"{path}: is damaged, nothing was copied: {found.problems[0]}")
    return session


def write_session_document(
    path: Path, inputs: Inputs, told: Mapping[str, Any], left_out: Sequence[tuple[str, str]]
) -> None:
    """Write what a document beside a session's images says, and of whom and what they are."""
    session = inputs.session
    origin = {
        "source": session.source,
        "inputs": inputs.hashes,
        "assumed": list(inputs.assumed),
        "consent": [session.manifest.to_json()["subject"]],
    }
    write_json(path, {**told, **origin, "left_out": [list(row) for row in left_out]})


def require_use(use: str | None) -> str:
    """Return the use that a command line names.

    Raises
    ------
    skinrig.errors.UsageError
        When it names none.
    """
    if use is None:
        raise UsageError("--use: got none; say what the copy of a session is for, e.g. research")
    return use


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
    (out / FRAMES_FOLDER).mkdir()
    for record in session.frames():
        (out / record.file).write_bytes(check_file(session.path / record.file, record.line))


def _copy_documents(session: Session, out: Path) -> None:
    _copy_frames(session, out)
    with (out / DOCUMENTS_FILE).open("w", encoding="utf-8") as stream:
        for name, document in documents(session):
            stream.write(json.dumps([name, document], allow_nan=False) + "\n")


SESSION_FORMATS: Mapping[str, Callable[[Session, Path], None]] = {
    "mhl": _copy_all,
    "frames": _copy_frames,
    "event-model": _copy_documents,
}
