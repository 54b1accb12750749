"""A new session folder that appears whole or not at all."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from capture.documents import Fault
from capture.importers.images import PhotoError


def require_new(target: Path) -> None:
    """Refuse a place that holds something.

    Raises
    ------
    PhotoError
        Unless `target` is a new or empty folder.
    """
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise PhotoError(
            "cannot write here",
            where=str(target),
            faults=[Fault("out", "something that exists", "a new or empty folder")],
            advice="Choose a new folder.",
        )


@contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """Yield a place beside `target` that takes its name at the end; remove it after an error."""
    part = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield part
        if target.exists():
            target.rmdir()
        part.rename(target)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
