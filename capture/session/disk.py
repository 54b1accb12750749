"""File operations on which a session's safety rests, each one method that a test can replace.

Reading needs no such care: it is one function.
"""

import fcntl
import os
import stat
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Final, TypeAlias, TypeVar

from capture.documents import Fault
from capture.session.errors import SessionDamage, SessionError

_E = TypeVar("_E", bound=SessionError)
ItemT = TypeVar("ItemT")
Blob: TypeAlias = bytes | memoryview
"""Bytes of a file."""

N_WRITERS: Final = 16
"""Files written at the same time: the dome's step, whose flushes the file system joins."""


class Disk:
    """Operations of the real disk; each method is one operation of a power-cut model."""

    def make_dir(self, path: Path) -> None:
        """Make a directory whose parent exists; its owner alone may enter it."""
        os.mkdir(path, 0o700)

    def create(self, path: Path) -> int:
        """Create a new file for writing and return its descriptor; an existing one is an error.

        Its owner alone may read it: a session may show a face.
        """
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)

    def open_append(self, path: Path) -> int:
        """Open an existing file for appending; a symbolic link is an error."""
        return os.open(path, os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC)

    def open_update(self, path: Path) -> int:
        """Open a file for reading and writing, a new one if none exists; no symbolic link."""
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
        return os.open(path, flags, 0o600)

    def write(self, descriptor: int, data: Blob) -> None:
        """Write all of ``data``, in one system call unless the kernel takes less."""
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(descriptor, rest) :]

    def fsync(self, descriptor: int) -> None:
        """Flush a file's data and size to the medium."""
        os.fsync(descriptor)

    def fdatasync(self, descriptor: int) -> None:
        """Flush a file's data, and the size needed to read it, to the medium."""
        os.fdatasync(descriptor)

    def truncate(self, descriptor: int, size: int) -> None:
        """Cut a file to ``size`` bytes."""
        os.ftruncate(descriptor, size)

    def rename(self, old: Path, new: Path) -> None:
        """Rename a file atomically."""
        os.rename(old, new)

    def remove(self, path: Path) -> None:
        """Remove a file's name."""
        os.unlink(path)

    def for_each(self, work: Callable[[ItemT], object], items: Iterable[ItemT]) -> None:
        """Do work for each item on threads, while this one makes the next items.

        After an error of the work or of the items, no further item is begun and no further one is
        made. It returns, or raises the work's first error or else the items' error, once no thread
        works any more. This thread does the work itself where no further thread can start. A model
        of the disk does one after the other.
        """
        failed: list[BaseException] = []
        stopped = threading.Event()

        def do_once(item: ItemT, begun: threading.Lock) -> None:
            if not stopped.is_set() and begun.acquire(blocking=False):
                try:
                    work(item)
                except BaseException as exc:
                    failed.append(exc)
                    stopped.set()

        pool = ThreadPoolExecutor(N_WRITERS)
        try:
            for item in items:
                task = partial(do_once, item, threading.Lock())
                try:
                    pool.submit(task)
                except RuntimeError:  # no thread could start; one that runs may take it, too
                    task()
                if stopped.is_set():
                    break
            _end_pool(pool)
        except BaseException as exc:
            stopped.set()
            _end_pool(pool)
            if not failed:
                raise
            raise failed[0] from exc
        if failed:
            raise failed[0]

    def fsync_dir(self, path: Path) -> None:
        """Flush the names in a directory to the medium."""
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def close(self, descriptor: int) -> None:
        """Close a descriptor; a lock held through it is released."""
        os.close(descriptor)

    def lock(self, descriptor: int, *, shared: bool = False) -> bool:
        """Acquire the writer's lock, or one that excludes writers only; False when refused.

        NFS locks a file exclusively only through a descriptor that can write.
        """
        kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
        try:
            fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True


def _end_pool(pool: ThreadPoolExecutor) -> None:
    """Wait for all threads; another Ctrl-C ends no wait, so that none writes afterwards."""
    try:
        pool.shutdown()
    except BaseException:
        _end_pool(pool)
        raise


def read_file(
    path: Path, *, limit: int, label: str, missing: Callable[[], SessionError] | None = None
) -> bytes:
    """Return the bytes of a regular file of at most ``limit`` bytes, following no link.

    Raises
    ------
    SessionDamage
        When the file is missing (unless ``missing`` allows it), too large, or not a regular file.
    """
    try:
        flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        descriptor = os.open(path, flags)
    except OSError as exc:
        if isinstance(exc, FileNotFoundError) and missing is not None:
            raise missing() from exc
        got = "a symbolic link" if path.is_symlink() else str(exc.strerror)
        raise _damage_error(path, label, got, "a file") from exc
    try:
        state = os.fstat(descriptor)
        if not stat.S_ISREG(state.st_mode):
            raise _damage_error(path, label, "not a plain file", "a file")
        if state.st_size > limit:
            raise _damage_error(path, label, f"{state.st_size} bytes", f"at most {limit}")
        try:
            with open(descriptor, "rb", closefd=False) as file:
                return file.read()
        except OSError as exc:
            raise _damage_error(path, label, str(exc.strerror), "a readable file") from exc
    finally:
        os.close(descriptor)


def _damage_error(path: Path, label: str, got: str, expected: str) -> SessionDamage:
    advice = "Restore the file from a copy; skinrig verify lists all that is damaged."
    faults = [Fault(label, got, expected)]
    return SessionDamage("cannot be read", where=str(path), faults=faults, advice=advice)
