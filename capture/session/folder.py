"""Create and repair the folder of a session, one disk operation after the other."""

import logging
import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from capture.documents import Fault
from capture.session.consent_seal import KEY_VARIABLE, SEAL_FILE, make_seal, read_key
from capture.session.contents import (
    ATTACHMENTS_FOLDER,
    FRAMES_FOLDER,
    JOURNAL_FILE,
    MANIFEST_FILE,
    MAX_MANIFEST_BYTES,
    ORPHANS_FOLDER,
    SessionContents,
    find_lost_lines,
    list_files,
    read_contents,
    unlisted_files,
)
from capture.session.disk import Blob, Disk, ItemT, read_file
from capture.session.errors import SessionDamage, SessionDiskError, SessionError

_log = logging.getLogger(__name__)


class DiskErrors:
    """Convert the operating system's errors to session errors that name session and cause."""

    def __init__(
        self,
        path: Path,
        *,
        advice: str = "Free space or repair the disk, then resume; committed frames are safe.",
    ) -> None:
        self._path, self._advice = path, advice

    def __enter__(self) -> None:
        return None

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if isinstance(value, OSError) and not isinstance(value, SessionError):
            what = f"the disk refused: {value.strerror or value}"
            where, code = str(value.filename or self._path), "SR-SES-013"
            raise SessionDiskError(what, where=where, advice=self._advice, code=code) from value


def write_new(disk: Disk, path: Path, data: Blob) -> None:
    """Write a new file and flush its data; the caller flushes its name."""
    _fill(disk, disk.create(path), data)


def _fill(disk: Disk, descriptor: int, data: Blob) -> None:
    """Write a new file, flush its data, and close it."""
    try:
        disk.write(descriptor, data)
        disk.fsync(descriptor)
    finally:
        disk.close(descriptor)


def note_errors(items: Iterable[ItemT], noted: list[BaseException]) -> Iterator[ItemT]:
    """Yield items; append the error that ends them to ``noted``, and raise it."""
    try:
        yield from items
    except BaseException as exc:
        noted.append(exc)
        raise


def write_group(disk: Disk, files: Iterable[tuple[Path, Blob]]) -> None:
    """Write new files of one folder, several at once, and flush their data, then their names.

    Files are written while further ones are made. After an error, files of the group that have no
    name yet are removed unless the disk refuses that, too; a file that was there before is kept.
    """
    parts: dict[Path, Path] = {}
    created: list[Path] = []

    def write_part(file: tuple[Path, Blob]) -> None:
        part, blob = file
        descriptor = disk.create(part)
        created.append(part)
        _fill(disk, descriptor, blob)

    def name_parts() -> Iterator[tuple[Path, Blob]]:
        for path, blob in files:
            part = path.with_name(f"{path.name}.part")
            parts[part] = path
            yield part, blob

    try:
        disk.for_each(write_part, name_parts())
    except BaseException:
        for part in created:
            with suppress(OSError):  # the first error is the cause
                disk.remove(part)
        raise
    for part, path in parts.items():
        disk.rename(part, path)
    for folder in {path.parent for path in parts.values()}:
        disk.fsync_dir(folder)


def make_folder(disk: Disk, path: Path, manifest: bytes) -> None:
    """Create the folder of a session with an empty journal and its manifest.

    Raises
    ------
    SessionError
        Unless the folder is new, empty, or left over from an interrupted creation.
    """
    require_free(path)
    read_key()  # an unfit key is refused before a folder is made
    with DiskErrors(path):
        for folder in (path, path / FRAMES_FOLDER, path / ORPHANS_FOLDER):
            if not folder.is_dir():
                disk.make_dir(folder)
        if not (path / JOURNAL_FILE).exists():
            write_new(disk, path / JOURNAL_FILE, b"")
        write_manifest(disk, path, manifest)


def make_attachments_folder(disk: Disk, path: Path) -> None:
    """Make the folder of attachments, also where an interruption left its name unflushed."""
    if not (path / ATTACHMENTS_FOLDER).is_dir():
        disk.make_dir(path / ATTACHMENTS_FOLDER)
    disk.fsync_dir(path)


def write_consent_seal(disk: Disk, path: Path, manifest: bytes) -> None:
    """Write the seal of a manifest where a key is set; the caller flushes its name.

    Without a key, a seal that an interrupted creation left is removed: it is of another manifest.
    """
    key, part = read_key(), path / f"{SEAL_FILE}.part"
    for name in (part, path / SEAL_FILE) if key is None else (part,):
        if os.path.lexists(name):
            disk.remove(name)
    if key is None:
        return
    write_new(disk, part, make_seal(manifest, key))
    disk.rename(part, path / SEAL_FILE)


def seal_consent(path: str | Path, *, disk: Disk | None = None) -> SessionContents:
    """Seal the consent of a session that has no seal yet, and return its contents.

    Raises
    ------
    SessionError
        Without a key, or when the folder is not a session.
    SessionDamage
        When the session is damaged, or has another seal.
    """
    disk, place = disk or Disk(), Path(path)
    if read_key() is None:
        raise SessionError.at(
            "cannot be sealed",
            KEY_VARIABLE,
            "not set",
            "the file of the lab's key",
            where=place,
            advice=f"Set {KEY_VARIABLE}.",
            code="SR-SES-018",
        )
    sealed = os.path.lexists(place / SEAL_FILE)
    contents = read_contents(place, sealing=not sealed)
    if contents.walk.damage is not None:
        raise contents.walk.damage
    if not sealed:
        manifest = read_file(place / MANIFEST_FILE, limit=MAX_MANIFEST_BYTES, label="manifest")
        with DiskErrors(place):
            write_consent_seal(disk, place, manifest)
            disk.fsync_dir(place)
    return read_contents(place)


def write_manifest(disk: Disk, path: Path, manifest: bytes) -> None:
    """Write the manifest under its name, last: from then on the session exists."""
    write_consent_seal(disk, path, manifest)
    part = path / f"{MANIFEST_FILE}.part"
    if part.exists():
        disk.remove(part)
    write_new(disk, part, manifest)
    disk.fsync_dir(path)
    disk.rename(part, path / MANIFEST_FILE)
    disk.fsync_dir(path)
    disk.fsync_dir(path.resolve().parent)


def require_free(path: Path) -> None:
    """Raise an error unless the folder is new, empty, or left over from an interrupted creation."""
    if path.is_symlink() or (path.exists() and not path.is_dir()):
        kind = "a link" if path.is_symlink() else "a file"
        raise _occupied_error(path, "folder", kind, "a new or empty folder")
    if not path.parent.is_dir():
        raise _occupied_error(path, "parent", "no such folder", "an existing folder")
    if not path.exists():
        return
    debris = {FRAMES_FOLDER, ORPHANS_FOLDER, JOURNAL_FILE, SEAL_FILE}
    debris |= {f"{MANIFEST_FILE}.part", f"{SEAL_FILE}.part"}
    found = {entry.name for entry in os.scandir(path)}
    filled = any(
        any((path / folder).iterdir())
        for folder in (FRAMES_FOLDER, ORPHANS_FOLDER)
        if (path / folder).is_dir()
    )
    written = (path / JOURNAL_FILE).exists() and (path / JOURNAL_FILE).stat().st_size > 0
    if found - debris or filled or written:
        got = ", ".join(sorted(found)[:5])
        raise _occupied_error(path, "folder", f"a folder with {got}", "a new or empty folder")


def _occupied_error(path: Path, field: str, got: str, expected: str) -> SessionError:
    return SessionError.at(
        "cannot start here",
        field,
        got,
        expected,
        where=path,
        advice="Choose a new folder, or resume the session that is there.",
        code="SR-SES-008",
    )


def move_orphans(disk: Disk, path: Path, contents: SessionContents) -> None:
    """Move files without a line to ``orphans/``; a missing committed file is an error."""
    lines = {line.file: line for line in contents.file_lines}
    present = list_files(path)
    orphans = unlisted_files(path, contents)
    if (lost := find_lost_lines(path, contents, orphans)) is not None:
        raise lost
    for line in lines.values():
        size = (path / line.file).lstat().st_size if line.file in present else None
        if size != line.bytes:
            got = "nothing" if size is None else f"{size} bytes"
            faults = [Fault(line.file, got, f"{line.bytes} bytes, as committed")]
            advice = "Restore the file from a copy; skinrig verify lists all that is damaged."
            raise SessionDamage(
                "a committed file is gone", where=str(path), faults=faults, advice=advice
            )
    if not orphans:
        return
    if not (path / ORPHANS_FOLDER).is_dir():  # mail and archives drop empty folders
        disk.make_dir(path / ORPHANS_FOLDER)
        disk.fsync_dir(path)
    taken = set(os.listdir(path / ORPHANS_FOLDER))
    for file in orphans:
        name, number = Path(file).name, 1
        while f"{name}.{number}" in taken:
            number += 1
        taken.add(f"{name}.{number}")
        _log.warning("%s: no line in the journal, set aside", path / file)
        disk.rename(path / file, path / ORPHANS_FOLDER / f"{name}.{number}")
    disk.fsync_dir(path / ORPHANS_FOLDER)
    for folder in sorted({Path(file).parent for file in orphans}):
        disk.fsync_dir(path / folder)
