"""Check the place of an output, write files and replace folders atomically."""

import os
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from skinrig.errors import UnusableError

MIN_FREE_BYTES = 2**20
"""Free space without which no output is begun; the smallest folder that a command writes needs
about as much."""


def require_writable(path: str | Path, *, option: str = "--out") -> None:
    """Raise an error unless an output can be made at a path that need not exist.

    A folder is made for a moment in the nearest folder that exists, and in an output folder that
    exists, because permissions alone do not decide.

    Parameters
    ----------
    path
        File or folder to be written.
    option
        Option that names it, for the message.

    Raises
    ------
    UnusableError
        When its folder is a file, cannot be written to, or has no space left.

    Examples
    --------
    >>> require_writable(Path(tempfile.gettempdir()) / "a" / "b")
    """
    target = Path(path).absolute()
    tried = next(folder for folder in target.parents if os.path.lexists(folder))
    try:
        free = _try_folder(tried)
        if target.is_dir():  # it is written into, or replaced from its parent
            tried = target
            free = min(free, _try_folder(tried))
    except OSError as error:
        raise UnusableError(
            f"{option}: {target}: {tried} cannot be written to ({error.strerror}); nothing was "
            "computed: name another folder"
        ) from error
    if free < MIN_FREE_BYTES:
        raise UnusableError(
            f"{option}: {target}: got {free} bytes free, expected at least {MIN_FREE_BYTES}; "
            "nothing was computed: free space, or name another disk"
        )


def _try_folder(folder: Path) -> int:
    """Return the free bytes of a folder after a folder was made in it."""
    with tempfile.TemporaryDirectory(prefix=".skinrig-", dir=folder):
        return shutil.disk_usage(folder).free


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file atomically; its folder is made and an older file is replaced.

    Parameters
    ----------
    path
        The file.
    content
        Bytes, or text for UTF-8.

    Raises
    ------
    OSError
        With the name of `path`, not of the temporary file next to it.
    """
    part = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        part.write_bytes(content.encode() if isinstance(content, str) else content)
        os.replace(part, path)
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from error
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def replace_folder_atomically(path: Path) -> Iterator[Path]:
    """Yield an empty temporary folder that replaces `path` when the block ends.

    If the block or the replacement fails, the older folder stays unchanged.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    shelter = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.part")
    part, old = shelter / path.name, shelter / "older"
    try:
        part.mkdir(parents=True)
        yield part
        if path.exists():
            path.rename(old)
        try:
            part.rename(path)
        except OSError:
            if old.exists():
                old.rename(path)
            raise
    finally:
        shutil.rmtree(shelter, ignore_errors=True)
