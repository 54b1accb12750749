"""Files and folders that are there whole or not at all."""

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all; its folder is made, an older file replaced.

    Parameters
    ----------
    path
        The file.
    content
        Bytes, or text for UTF-8.

    Raises
    ------
    OSError
        Naming the file that was asked for; nobody has heard of the part beside it.
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
    """Yield an empty folder of that name, hidden beside, that replaces the older one in the end.

    Where the block or the replacement fails, the older folder stays as it was.
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
