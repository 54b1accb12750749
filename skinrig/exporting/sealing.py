"""A new folder that appears whole or not at all, listed file by file in an ASC MHL manifest."""

import json
import os
import shutil
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from capture.session.mhl import write_first_generation


class ExportError(ValueError):
    """An export that cannot be made as asked."""


@dataclass(frozen=True, slots=True)
class Exported:
    """What an export made.

    Attributes
    ----------
    path
        The folder.
    manifest
        The ASC MHL manifest that lists every file.
    files
        How many, without the manifest.
    left_out
        What the format asks for and the source does not hold, with the reason.
    """

    path: Path
    manifest: Path
    files: int
    left_out: tuple[tuple[str, str], ...] = ()


def fresh(out: str | Path) -> Path:
    """Return a folder that does not exist yet.

    Raises
    ------
    ExportError
        When it does.
    """
    target = Path(out)
    if target.exists():
        raise ExportError(f"{target}: exists; choose a new folder")
    return target


def sealed(
    target: Path,
    write: Callable[[Path], Sequence[tuple[str, str]] | None],
    now: datetime | None = None,
) -> Exported:
    """Let ``write`` fill a hidden folder, seal it, and rename it once it is complete.

    Parameters
    ----------
    target
        A folder that does not exist, see :func:`fresh`.
    write
        Called with an empty folder.
    now
        Time that the manifest bears; None: the present.

    Returns
    -------
    Exported
        With what ``write`` returned as left out, where it returned anything.
    """
    moment = now or datetime.now(UTC)
    target.parent.mkdir(parents=True, exist_ok=True)
    # of the final name, which the manifest bears, in a hidden folder beside it
    shelter = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.part")
    part = shelter / target.name
    try:
        part.mkdir(parents=True)
        left_out = tuple(write(part) or ())
        written = [path for path in part.rglob("*") if path.is_file()]
        for path in written:  # the manifest bears dates: one moment, one manifest
            os.utime(path, (moment.timestamp(), moment.timestamp()))
        manifest = write_first_generation(part, now=moment, version=version("skinrig"))
        part.rename(target)
    finally:
        shutil.rmtree(shelter, ignore_errors=True)
    return Exported(target, target / manifest.relative_to(part), len(written), left_out)


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a document as people read it; the same bytes for the same content."""
    text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")
