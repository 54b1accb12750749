"""What skinrig wrote into a folder, photographs there, and files that are whole or not at all.

Folders are told apart by their documents alone, and no map is read, so that a plain ``skinrig``
answers at once.
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
"""How the policy of a report's page begins; that of a live page allows a script."""


@dataclass(frozen=True, slots=True)
class Workspace:
    """What lies in a folder, each sorted by name."""

    sessions: Mapping[Path, Mapping[str, Any]] = field(default_factory=dict)
    """With their session.json."""
    appearances: Mapping[Path, Mapping[str, Any]] = field(default_factory=dict)
    """With their appearance.json, truths left out."""
    truths: tuple[Path, ...] = ()
    calibrations: tuple[Path, ...] = ()
    reports: tuple[Path, ...] = ()
    photographs: int = 0

    def summary(self) -> str:
        """Return what is here in one line; empty where nothing of skinrig's is."""
        counts = [
            (len(self.sessions), "session"),
            (len(self.calibrations), "calibration"),
            (len(self.appearances), "appearance"),
            (len(self.reports), "report"),
            (self.photographs, "photograph"),
        ]
        return ", ".join(f"{n} {noun}{'s' if n > 1 else ''}" for n, noun in counts if n)


def scan(folder: Path) -> Workspace:
    """Find what skinrig wrote into a folder, and photographs.

    Parameters
    ----------
    folder
        One that exists; the folders in it are looked into, not below. What cannot be read or is
        damaged is passed over: the commands that use it say what is wrong.
    """
    sessions, appearances, truths, calibrations = {}, {}, [], []
    try:
        entries = sorted(folder.iterdir())
    except OSError:
        return Workspace()
    for entry in entries:
        if (document := _document(entry / "session.json")) is not None:
            sessions[entry] = document
        elif (document := _document(entry / "appearance.json")) is not None:
            if document.get("parameters", {}).get("kind") == "truth":
                truths.append(entry)
            else:
                appearances[entry] = document
        elif entry.name.startswith("calibration") and entry.is_dir():
            calibrations.append(entry)
    reports = [e for e in entries if e.suffix == ".html" and _is_report(e)]
    photographs = sum(e.suffix.lower() in PHOTOGRAPH_SUFFIXES for e in entries)
    return Workspace(
        sessions, appearances, tuple(truths), tuple(calibrations), tuple(reports), photographs
    )


def _document(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def _is_report(path: Path) -> bool:
    """Tell a report, which runs no script, from a live page and from pages of others."""
    try:
        with path.open("rb") as stream:
            head = stream.read(1000)
    except OSError:
        return False
    return REPORT_HEAD in head
