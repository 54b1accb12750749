"""Write files and replace folders atomically."""

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


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
