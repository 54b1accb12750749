"""Resume a session that may be complete, and copy a closed one into one open for additions."""

from pathlib import Path

from capture.documents import Fault
from capture.session.contents import (
    ATTACHMENTS_FOLDER,
    FRAMES_FOLDER,
    JOURNAL_FILE,
    MANIFEST_FILE,
    MAX_JOURNAL_BYTES,
    MAX_MANIFEST_BYTES,
    ORPHANS_FOLDER,
    read_undamaged_contents,
)
from capture.session.disk import Disk, read_file
from capture.session.errors import SessionError
from capture.session.folder import DiskErrors, require_free, write_manifest, write_new
from capture.session.journal import CloseLine
from capture.session.store import Session
from capture.session.view import check_file


def resume_unless_complete(path: str | Path) -> Session:
    """Open a session for writing, or only for reading when it is closed and lacks nothing.

    A capture that was killed between its last frame and its exit is such a session.

    Raises
    ------
    SessionError
        See `Session.resume`.
    """
    opened = Session.open(path)
    return opened if opened.complete else Session.resume(path)


def reopen_copy(
    path: str | Path, copy: str | Path, *, disk: Disk | None = None
) -> tuple[Session, str]:
    """Copy a closed session without its closing line, and open the copy for writing.

    Every byte is checked while it is copied. The copy has the same id, manifest and chain of hashes
    up to the closing line, so that its frames are identical; its `content_hash` differs as soon as
    something is added.

    Parameters
    ----------
    path : str or Path
        The closed session; it is only read.
    copy : str or Path
        A new (or empty) folder whose parent exists.
    disk : Disk, optional
        File operations; the real ones by default.

    Returns
    -------
    Session
        The copy, open for writing.
    str
        Reason of missing frames, from the closing line; empty when none is missing. Pass it on when
        closing the copy.

    Raises
    ------
    SessionError
        When the session is not closed, or `copy` is not free.
    SessionDamage
        When any bit of the session differs from what was written.
    """
    disk = disk or Disk()
    place, target = Path(path), Path(copy)
    contents = read_undamaged_contents(place)
    if contents.close_line is None:
        advice = "An open session needs no copy: Session.resume opens it."
        faults = [Fault("session", "open", "closed")]
        raise SessionError("is not closed", where=str(place), faults=faults, advice=advice)
    (start, reason) = next(
        (byte, line.reason) for byte, line in contents.walk.lines if isinstance(line, CloseLine)
    )
    journal = read_file(place / JOURNAL_FILE, limit=MAX_JOURNAL_BYTES, label="journal")[:start]
    manifest = read_file(place / MANIFEST_FILE, limit=MAX_MANIFEST_BYTES, label="manifest")
    require_free(target)
    with DiskErrors(target):
        folders = [
            FRAMES_FOLDER,
            ORPHANS_FOLDER,
            *([ATTACHMENTS_FOLDER] if contents.attachment_lines else []),
        ]
        for folder in (target, *(target / name for name in folders)):
            if not folder.is_dir():
                disk.make_dir(folder)
        for line in contents.file_lines:
            write_new(disk, target / line.file, check_file(place / line.file, line))
        for name in folders:
            disk.fsync_dir(target / name)
        if (target / JOURNAL_FILE).exists():  # left over from an interrupted creation, empty
            disk.remove(target / JOURNAL_FILE)
        write_new(disk, target / JOURNAL_FILE, journal)
        write_manifest(disk, target, manifest)
    return Session.resume(target, disk=disk), reason
