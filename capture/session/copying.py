"""Copy a session to another disk, with every byte checked, so that an interrupted copy continues.

Files are written to a hidden folder next to the copy, which gets its name when all is there: a
folder under the copy's name is complete.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from capture.documents import Fault
from capture.session.consent_seal import MAX_SEAL_BYTES, SEAL_FILE
from capture.session.contents import (
    ATTACHMENTS_FOLDER,
    FRAMES_FOLDER,
    JOURNAL_FILE,
    MANIFEST_FILE,
    MAX_JOURNAL_BYTES,
    MAX_MANIFEST_BYTES,
    ORPHANS_FOLDER,
    SessionContents,
    find_lost_lines,
    read_contents,
    read_undamaged_contents,
    unlisted_files,
)
from capture.session.disk import Disk, read_file
from capture.session.errors import SessionDamage, SessionError, SessionLocked
from capture.session.folder import DiskErrors, write_new
from capture.session.journal import FileLine
from capture.session.verification import N_READERS
from capture.session.view import check_file

Texts = dict[str, bytes]
"""Bytes of the manifest, of the consent's seal where there is one, and of the journal, by name."""

_CONTINUE = "Free space or repair the disk, then run the same command again: it continues."


@dataclass(frozen=True, slots=True)
class CopyReport:
    """Result of a copy."""

    frames: int
    """Number of frames in the copy."""
    bytes: int
    """Bytes of frames and attachments."""
    kept: int
    """Number of files that an interrupted copy had left, and that are sound."""
    verified: bool
    """Whether all files were read back."""
    content_hash: str
    """Hash of the copy, equal to the session's."""


def part_folder(copy: Path) -> Path:
    """Return the hidden folder of an unfinished copy.

    Examples
    --------
    >>> part_folder(Path("backup/session-flash")).as_posix()
    'backup/.session-flash.copying'
    """
    return copy.with_name(f".{copy.name}.copying")


def copy_session(
    path: str | Path,
    copy: str | Path,
    *,
    read_back: bool = False,
    progress: Callable[[str], None] | None = None,
    disk: Disk | None = None,
) -> CopyReport:
    """Copy the committed files of a session, byte for byte, and flush them to the medium.

    Every file is checked against the journal while it is read. A second call after an interruption
    checks the files that are there, and copies the others.

    Parameters
    ----------
    path
        SESSION/ folder; it is only read. An open session is copied as far as it is committed.
    copy
        New folder whose parent exists.
    read_back
        Read every file of the copy again and check it, after the operating system was asked to
        drop it from its cache.
    progress
        Called with a line per file.
    disk
        File operations; the real ones by default.

    Returns
    -------
    CopyReport

    Raises
    ------
    SessionLocked
        When a capture writes the session, or another process writes the copy.
    SessionDamage
        When a file of the session, or of the copy after it was written, differs from what was
        committed; a file that differs is removed from the copy.
    SessionDiskError
        When the disk refuses.
    SessionError
        When `copy` exists, is inside the session, or has an unfinished copy of another session;
        when the session changes meanwhile.
    """
    disk = disk or Disk()
    place, target = Path(path), Path(copy)
    _require_free(place, target)
    with _locked_source(place, disk):
        contents = read_undamaged_contents(place)
        lost = (
            None
            if contents.walk.closed
            else find_lost_lines(place, contents, unlisted_files(place, contents))
        )
        if lost is not None:
            raise lost
        texts = _read_texts(place, contents)
        part = part_folder(target)
        with DiskErrors(target, advice=_CONTINUE), _locked_part(part, contents, disk) as journal:
            _require_free(place, target)  # again, under the lock
            stamp = _stamp_part(part, texts[MANIFEST_FILE], disk)
            writer = _FileWriter(place, part, disk, read_back)
            kept = writer.write_all(contents.file_lines, progress)
            if _read_texts(place, read_undamaged_contents(place)) != texts:
                raise _changed_error(place)
            _write_texts(disk, part, stamp, journal, texts, read_back=read_back)
            disk.rename(part, target)
            disk.fsync_dir(target.resolve().parent)
    return CopyReport(
        frames=len(contents.frame_lines),
        bytes=sum(line.bytes for line in contents.file_lines),
        kept=kept,
        verified=read_back,
        content_hash=f"sha256:{contents.walk.head.removeprefix('sha256:')}",
    )


class _FileWriter:
    """Writer of the files of a copy, several at a time."""

    def __init__(self, place: Path, part: Path, disk: Disk, read_back: bool) -> None:
        self._place, self._part, self._disk, self._read_back = place, part, disk, read_back

    def write_all(self, lines: tuple[FileLine, ...], progress: Callable[[str], None] | None) -> int:
        """Write files and flush their names; return how many were there before."""
        pool = ThreadPoolExecutor(N_READERS)
        kept = 0
        try:
            for number, was_there in enumerate(pool.map(self._write, lines)):
                kept += was_there
                if progress is not None:
                    progress(f"copy {number + 1}/{len(lines)} files")
        finally:
            # after an error or Ctrl-C, files at work are ended and others are not begun
            pool.shutdown(cancel_futures=True)
        listed = {line.file for line in lines}
        for folder in (FRAMES_FOLDER, ATTACHMENTS_FOLDER):
            if not (self._part / folder).is_dir():
                continue
            for name in os.listdir(self._part / folder):
                if f"{folder}/{name}" not in listed:  # half written by an interrupted copy
                    self._disk.remove(self._part / folder / name)
            self._disk.fsync_dir(self._part / folder)
        return kept

    def _write(self, line: FileLine) -> bool:
        """Write a file unless a sound one is there; return whether it was."""
        target = self._part / line.file
        if target.exists():
            try:
                self._check(target, line)
                return True
            except SessionDamage:
                self._disk.remove(target)
        blob = check_file(self._place / line.file, line)
        half = target.with_name(f"{target.name}.part")
        if half.exists():
            self._disk.remove(half)
        write_new(self._disk, half, blob)
        self._disk.rename(half, target)
        del blob
        if self._read_back:
            try:
                self._check(target, line)
            except SessionDamage as error:
                self._disk.remove(target)
                raise _not_as_written(target) from error
        return False

    def _check(self, target: Path, line: FileLine) -> None:
        if self._read_back:
            drop_from_cache(target)
        check_file(target, line)


def drop_from_cache(path: Path) -> None:
    """Ask the operating system to drop the pages of a flushed file, so that the disk is read.

    File systems in memory, and pages that another process maps, ignore it.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
    finally:
        os.close(descriptor)


def _read_texts(place: Path, contents: SessionContents) -> Texts:
    """Return the texts of a session, the journal without a line that is cut off."""
    texts = {
        MANIFEST_FILE: read_file(place / MANIFEST_FILE, limit=MAX_MANIFEST_BYTES, label="manifest")
    }
    if os.path.lexists(place / SEAL_FILE):
        texts[SEAL_FILE] = read_file(place / SEAL_FILE, limit=MAX_SEAL_BYTES, label="consent seal")
    journal = read_file(place / JOURNAL_FILE, limit=MAX_JOURNAL_BYTES, label="journal")
    return texts | {JOURNAL_FILE: journal[: contents.walk.end]}


def _write_texts(
    disk: Disk, part: Path, stamp: Path, journal: int, texts: Texts, *, read_back: bool
) -> None:
    """Write seal and journal, give the manifest its name, and read all back."""
    if os.path.lexists(part / SEAL_FILE):
        disk.remove(part / SEAL_FILE)
    if SEAL_FILE in texts:
        write_new(disk, part / SEAL_FILE, texts[SEAL_FILE])
    disk.truncate(journal, 0)
    disk.write(journal, texts[JOURNAL_FILE])
    disk.fsync(journal)
    if stamp.name != MANIFEST_FILE:
        disk.rename(stamp, part / MANIFEST_FILE)
    disk.fsync_dir(part)
    if read_back:
        for name in texts:
            drop_from_cache(part / name)
    # compared before anything is parsed: a byte that the disk changed is the disk's fault
    for name, text in texts.items():
        if read_file(part / name, limit=MAX_JOURNAL_BYTES, label=name) != text:
            if name != JOURNAL_FILE:  # the next call rewrites the journal in place, under its lock
                disk.remove(part / name)
            raise _not_as_written(part / name)


@contextmanager
def _locked_source(place: Path, disk: Disk) -> Iterator[None]:
    """Keep writers from a session that is open; it need not be writable."""
    if read_contents(place).walk.closed:
        yield
        return
    descriptor = os.open(place / JOURNAL_FILE, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        if not disk.lock(descriptor, shared=True):
            raise _locked_error(place)
        yield
    finally:
        disk.close(descriptor)


@contextmanager
def _locked_part(part: Path, contents: SessionContents, disk: Disk) -> Iterator[int]:
    """Make or take up the folder of an unfinished copy; yield its journal, locked and open.

    The journal is never removed while the copy is unfinished: a lock on a removed file would not
    keep a second copy away.
    """
    folders = [FRAMES_FOLDER, ORPHANS_FOLDER]
    folders += [ATTACHMENTS_FOLDER] if contents.attachment_lines else []
    for folder in (part, *(part / name for name in folders)):
        if not folder.is_dir():
            disk.make_dir(folder)
    descriptor = disk.open_update(part / JOURNAL_FILE)
    try:
        if not disk.lock(descriptor):
            raise _locked_error(part)
        yield descriptor
    finally:
        disk.close(descriptor)


def _stamp_part(part: Path, manifest: bytes, disk: Disk) -> Path:
    """Write the manifest of an unfinished copy, or compare the one there; return its path."""
    stamp = part / f"{MANIFEST_FILE}.part"
    if (part / MANIFEST_FILE).exists():  # interrupted before the folder got its name
        stamp = part / MANIFEST_FILE
    if stamp.exists():
        written = read_file(stamp, limit=MAX_MANIFEST_BYTES, label="manifest")
        if written == manifest:
            return stamp
        if not manifest.startswith(written):
            raise SessionError(
                "is the unfinished copy of another session",
                where=str(part),
                faults=[Fault(stamp.name, "another manifest", "that of the session")],
                advice="Remove the folder, or choose another name for the copy.",
                code="SR-SES-019",
            )
        disk.remove(stamp)  # cut off by an interruption
    write_new(disk, stamp, manifest)
    return stamp


def _locked_error(path: Path) -> SessionLocked:
    return SessionLocked(
        "another process is writing this session",
        where=str(path),
        advice="Wait for its end.",
        code="SR-SES-003",
    )


def _require_free(place: Path, target: Path) -> None:
    """Raise an error unless a copy can be made under a name."""
    advice = "Choose a new folder outside the session, in one that exists."
    got = ""
    if os.path.lexists(target):
        got, expected = "a folder or file of this name", "a new folder"
    elif not target.parent.is_dir():
        got, expected = "no such parent", "an existing parent"
    elif target.resolve().is_relative_to(place.resolve()):
        got, expected = "a folder inside the session", "one outside"
    if got:
        raise SessionError(
            "cannot be the copy",
            where=str(target),
            faults=[Fault("folder", got, expected)],
            advice=advice,
            code="SR-SES-022",
        )


def _changed_error(place: Path) -> SessionError:
    return SessionError(
        "has changed while it was copied",
        where=str(place),
        faults=[Fault("journal", "other bytes", "those at the beginning")],
        advice="End the program that changes it, then run the same command again.",
        code="SR-SES-020",
    )


def _not_as_written(target: Path) -> SessionDamage:
    return SessionDamage(
        "is not as it was written",
        where=str(target),
        faults=[Fault("content", "other bytes", "those of the session")],
        advice="Do not trust this disk; copy to another one.",
        code="SR-SES-021",
    )
