"""Verify a session: recompute every hash and seal, and list the differences."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path

from capture.session.consent_seal import (
    REFUSED_STATE,
    SEAL_FILE,
    UNSEALED_STATE,
    check_seal,
    read_key,
)
from capture.session.contents import (
    ATTACHMENTS_FOLDER,
    FRAMES_FOLDER,
    JOURNAL_FILE,
    MANIFEST_FILE,
    MAX_MANIFEST_BYTES,
    ORPHANS_FOLDER,
    SessionContents,
    find_lost_lines,
    read_contents,
    unlisted_files,
)
from capture.session.disk import read_file
from capture.session.errors import NotASession, SessionError
from capture.session.journal import AttachmentLine, FrameLine
from capture.session.view import check_file

_KNOWN_NAMES = {MANIFEST_FILE, JOURNAL_FILE, FRAMES_FOLDER, ATTACHMENTS_FOLDER, ORPHANS_FOLDER}
_KNOWN_NAMES |= {"index.sqlite", "ascmhl", SEAL_FILE}


N_READERS = 4
"""Files read at the same time: a disk with a queue is then never idle while hashes are computed."""


@dataclass(frozen=True, slots=True)
class VerifyReport:
    """Result of a verification."""

    ok: bool
    """Whether every committed byte is as it was written, and no seal is refused."""
    problems: tuple[str, ...]
    """Refused seal first, then damage: one entry per file (with the byte, where it is known)."""
    warnings: tuple[str, ...]
    """Findings that matter to a person although nothing is damaged."""
    frames: int
    """Number of committed frames whose files are intact."""
    bytes: int
    """Bytes of those frames and of the intact attachments."""
    complete: bool = True
    """Whether the journal has a line for each file but those that an interruption may leave."""
    consent_seal: str = UNSEALED_STATE
    """Whether a key of the lab has sealed the consent, and whether the seal was checked."""
    refused_seal: str = ""
    """Error of a missing or wrong seal where a key is set, empty for none."""

    @property
    def damage(self) -> tuple[str, ...]:
        """Problems without that of the seal: an unsealed session may be intact."""
        return self.problems[1:] if self.refused_seal else self.problems


def verify(
    path: str | Path, *, today: date | None = None, progress: Callable[[str], None] | None = None
) -> VerifyReport:
    """Check manifest, journal, every frame and every attachment of a session.

    Parameters
    ----------
    path : str or Path
        The session's folder.
    today : date, optional
        Day on which consent is evaluated; today by default.
    progress : callable, optional
        Called with a line per file.

    Returns
    -------
    VerifyReport

    Raises
    ------
    NotASession
        When the folder is not a session.
    SessionError
        When a key of the lab is set and its file cannot be used.

    Notes
    -----
    A flipped bit anywhere in a committed file is detected: session.json carries a seal over all its
    bytes, the journal a SHA-256 chain from that seal, and the journal an XXH3-128 of every frame
    and attachment. This protects against accidents; against a forger only a copy of the last hash
    kept elsewhere helps (``Session.content_hash``). A key of the lab protects the consent alone
    (`capture.session.consent_seal`).
    """
    place = Path(path)
    problems: list[str] = []
    warnings: list[str] = []
    read_key()  # an unfit key is not damage of the session
    try:
        contents = read_contents(place, sealing=True)
        manifest = read_file(place / MANIFEST_FILE, limit=MAX_MANIFEST_BYTES, label="manifest")
    except NotASession:
        raise
    except SessionError as exc:
        return VerifyReport(False, (str(exc),), (), 0, 0)
    try:
        sealed, refused = check_seal(place, manifest), ""
    except SessionError as exc:
        sealed, refused = REFUSED_STATE, str(exc)
        problems.append(refused)
    if contents.walk.damage is not None:
        problems.append(str(contents.walk.damage))
    frames, size = _check_files(place, contents.file_lines, problems, progress)
    unlisted = unlisted_files(place, contents) if contents.walk.damage is None else []
    lost = None if contents.walk.closed else find_lost_lines(place, contents, unlisted)
    if lost is None:
        advice = "it was never acknowledged; resuming sets it aside"
        strays = problems if contents.walk.closed else warnings
        strays.extend(f"{place / file}: no line in the journal; {advice}" for file in unlisted)
    else:
        problems.append(str(lost))
    warnings.extend(_state(place, contents))
    warnings.extend(_consent(contents, today or datetime.now(UTC).date()))
    return VerifyReport(
        *(not problems, tuple(problems), tuple(warnings), frames, size, lost is None),
        *(sealed, refused),
    )


def _check_files(
    place: Path,
    lines: tuple[FrameLine | AttachmentLine, ...],
    problems: list[str],
    progress: Callable[[str], None] | None,
) -> tuple[int, int]:
    """Check files, several at a time; return the sound frames and the bytes of sound files."""

    def find_problem(line: FrameLine | AttachmentLine) -> str | None:
        try:
            check_file(place / line.file, line)
        except SessionError as exc:
            return str(exc)
        return None

    frames = size = 0
    pool = ThreadPoolExecutor(N_READERS)
    try:
        for number, (line, problem) in enumerate(
            zip(lines, pool.map(find_problem, lines), strict=True), start=1
        ):
            if problem is None:
                size += line.bytes
                frames += isinstance(line, FrameLine)
            else:
                problems.append(problem)
            if progress is not None:
                progress(f"check {number}/{len(lines)} files")
    finally:
        pool.shutdown(cancel_futures=True)  # Ctrl-C does not wait for the files that are left
    return frames, size


def _state(place: Path, contents: SessionContents) -> list[str]:
    notes = []
    walk = contents.walk
    if walk.torn:
        where = f"{place / JOURNAL_FILE}, byte {walk.end}"
        notes.append(f"{where}: {walk.torn} bytes of a line cut off by a crash; resuming cuts them")
    done = {(line.step, line.camera) for line in contents.frame_lines}
    left_out = {step: line.reason for line in contents.omission_lines for step in line.steps}
    steps = [step for step in contents.manifest.plan.steps if step.id not in left_out]
    missing = sum((step.id, camera) not in done for step in steps for camera in step.cameras)
    end = contents.close_line
    if end is None:
        notes.append(f"{place}: not closed, {missing} frames of the plan are missing")
    elif missing:
        notes.append(f"{place}: closed with {missing} frames missing: {end.reason}")
    for reason in dict.fromkeys(left_out.values()):
        count = sum(other == reason for other in left_out.values())
        notes.append(f"{place}: {count} steps omitted: {reason}")
    if (place / ORPHANS_FOLDER).is_dir() and (orphans := os.listdir(place / ORPHANS_FOLDER)):
        notes.append(
            f"{place / ORPHANS_FOLDER}: {len(orphans)} files set aside after interruptions"
        )
    for name in sorted(set(os.listdir(place)) - _KNOWN_NAMES):
        notes.append(f"{place / name}: not a part of the session, not verified")
    return notes


def _consent(contents: SessionContents, today: date) -> list[str]:
    subject = contents.manifest.subject
    who = f"subject {subject.pseudonym}"
    if not subject.consent_scope:
        return [f"{who}: no consent beyond the capture is recorded"]
    expires = subject.consent_expires
    if expires is not None and today > expires:
        return [f"{who}: consent expired on {expires}; do not use the data any more"]
    return []
