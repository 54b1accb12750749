"""Find skinrig's results, and photographs, in a folder.

The kind of a result follows from its document alone. No map is read, so that ``skinrig`` without
arguments answers at once.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

PHOTOGRAPH_SUFFIXES: Final = tuple(
    ".dng .nef .cr2 .cr3 .arw .raf .orf .rw2 .tif .tiff .jpg .jpeg".split()
)
REPORT_HEAD: Final = b"content=\"default-src 'none'; img-src data:; style-src 'sha256-"
"""Start of the content security policy of a report; that of a live page names its script first."""


@dataclass(frozen=True, slots=True)
class Workspace:
    """Contents of a folder, each kind sorted by name."""

    sessions: Mapping[Path, Mapping[str, Any]] = field(default_factory=dict)
    """Parsed session.json by folder."""
    appearances: Mapping[Path, Mapping[str, Any]] = field(default_factory=dict)
    """Parsed appearance.json by folder, without ground truths."""
    truths: tuple[Path, ...] = ()
    calibrations: tuple[Path, ...] = ()
    reports: tuple[Path, ...] = ()
    photographs: tuple[Path, ...] = ()

    def summary(self) -> str:
        """Return the number of each kind in one line; empty if there are none."""
        counts = [
            (len(self.sessions), "session"),
            (len(self.calibrations), "calibration"),
            (len(self.appearances), "appearance"),
            (len(self.reports), "report"),
            (len(self.photographs), "photograph"),
        ]
        return ", ".join(f"{n} {noun}{'s' if n > 1 else ''}" for n, noun in counts if n)


def scan(folder: Path) -> Workspace:
    """Find skinrig's results and photographs in a folder.

    Parameters
    ----------
    folder
        Existing folder; its subfolders are read, but not theirs. Unreadable or damaged entries are
        skipped: the commands that use them report the fault.
    """
    sessions, appearances, truths, calibrations = {}, {}, [], []
    try:
        entries = sorted(folder.iterdir())
    except OSError:
        return Workspace()
    for entry in entries:
        if (document := read_document(entry / "session.json")) is not None:
            sessions[entry] = document
        elif (document := read_document(entry / "appearance.json")) is not None:
            if document.get("parameters", {}).get("kind") == "truth":
                truths.append(entry)
            else:
                appearances[entry] = document
        elif entry.name.startswith("calibration") and entry.is_dir():
            calibrations.append(entry)
    reports = [e for e in entries if e.suffix == ".html" and _is_report(e)]
    photographs = tuple(e for e in entries if e.suffix.lower() in PHOTOGRAPH_SUFFIXES)
    return Workspace(
        sessions, appearances, tuple(truths), tuple(calibrations), tuple(reports), photographs
    )


def read_document(path: Path) -> dict[str, Any] | None:
    """Return the object of a JSON file; None if it is unreadable or not an object."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def _is_report(path: Path) -> bool:
    """Return whether an HTML file is a report, by the start of its security policy."""
    try:
        with path.open("rb") as stream:
            head = stream.read(1000)
    except OSError:
        return False
    return REPORT_HEAD in head
