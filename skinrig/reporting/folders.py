"""Find the contents of a report: appearances, ground truths, calibrations, sessions, documents."""

import contextlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from capture.calibration.store import SCHEMA as CALIBRATION_SCHEMA
from model import store
from model.skin import SkinAppearance
from skinrig import consent
from skinrig.fusing.finished_face_file import DOCUMENT_FILE as FACE_DOCUMENT
from skinrig.reporting.sections import images as image_section


class ReportError(ValueError):
    """Paths without results to report."""


@dataclass(slots=True)
class ReportInputs:
    """Contents of the paths of a report."""

    appearances: dict[str, Path] = field(default_factory=dict)
    truths: dict[str, Path] = field(default_factory=dict)
    calibrations: list[Path] = field(default_factory=list)
    sessions: list[Path] = field(default_factory=list)
    pictures: list[Path] = field(default_factory=list)
    """Folders of renderings and analyses."""
    faces: list[Path] = field(default_factory=list)
    """Folders of finished faces."""
    documents: list[Path] = field(default_factory=list)
    """JSON documents of commands: benchmarks and the demo's own."""

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to report."""
        shown = (self.appearances, self.sessions, self.documents, self.pictures, self.faces)
        return not any(shown)

    def summary(self) -> str:
        """Return the number of folders of each kind, in a sentence.

        Examples
        --------
        >>> ReportInputs(sessions=[Path("one")], truths={"truth": Path("truth")}).summary()
        'Contents: 1 ground truth and 1 session.'
        """
        kinds = (
            ("set of maps", "sets of maps", len(self.appearances)),
            ("ground truth", "ground truths", len(self.truths)),
            ("folder of images", "folders of images", len(self.pictures)),
            ("finished face", "finished faces", len(self.faces)),
            ("calibration", "calibrations", len(self.calibrations)),
            ("session", "sessions", len(self.sessions)),
            ("document", "documents", len(self.documents)),
        )
        parts = [f"{n} {one if n == 1 else many}" for one, many, n in kinds if n]
        return (
            "Contents: "
            + (" and ".join([", ".join(parts[:-1]), parts[-1]]) if parts[1:] else parts[0])
            + "."
            + self._describe_source()
        )

    def _describe_source(self) -> str:
        """Return whether people were measured, by the sources that the folders record."""
        sources, has_people = [], False
        for path in (*self.appearances.values(), *self.sessions, *self.faces):
            for name in (store.DOCUMENT_FILE, "session.json", FACE_DOCUMENT):
                with contextlib.suppress(OSError, ValueError, AttributeError):
                    document = json.loads((path / name).read_bytes())
                    sources.append(document.get("source"))
                    has_people |= bool(document.get(consent.CONSENT_KEY))
        if not sources:
            return ""
        simulated = sources.count("simulated")
        if simulated == len(sources):
            if has_people:
                return " All data are simulated, but some of their inputs are measured."
            return " All data are simulated; no person was measured."
        if simulated:
            return f" {simulated} of the {len(sources)} sets of maps and sessions are simulated."
        return " All data are measured."

    def find_truth(self, appearance: SkinAppearance) -> SkinAppearance | None:
        """Return the ground truth that an appearance names, where it was found."""
        path = self.truths.get(str(appearance.parameters.get("truth", "")))
        return store.read(path) if path else None


def discover(paths: Sequence[Path]) -> ReportInputs:
    """Find appearances, truths, calibrations, sessions and documents at or below ``paths``.

    Raises
    ------
    ReportError
        When a path does not exist, or nothing is found at all.
    """
    found = ReportInputs()
    for path in paths:
        if not path.exists():
            raise ReportError(
                f"{path}: does not exist; give a folder that skinrig wrote [SR-CLI-007]"
            )
        below = [path, *sorted(path.iterdir())] if path.is_dir() else [path]
        for entry in below:
            if not entry.name.startswith("."):
                _classify_entry(entry, found)
    if found.is_empty:
        raise ReportError(
            f"{', '.join(map(str, paths))}: holds no session, appearance or benchmark; "
            "`skinrig demo` makes all of them [SR-CLI-008]"
        )
    return found


def _classify_entry(entry: Path, found: ReportInputs) -> None:
    if entry.is_file() and entry.suffix == ".json" and entry.name != store.DOCUMENT_FILE:
        if (entry.parent / store.DOCUMENT_FILE).is_file():
            return  # of the appearance itself, which its section shows
        if entry.name in (*image_section.DOCUMENT_FILES, FACE_DOCUMENT):
            return  # of a folder of images, which its section shows
        if _is_of_a_calibration(entry):
            return  # the section of its folder lists all of them
        text = entry.read_text(encoding="utf-8", errors="replace")
        if '"schema"' in text and '"skinrig.' in text and "session" not in entry.name:
            found.documents.append(entry)
    elif (entry / store.DOCUMENT_FILE).is_file():
        kind: object = None
        with contextlib.suppress(store.StoreError):  # raised again when its maps are read
            kind = store.read_document(entry).parameters.get("kind")
        (found.truths if kind == "truth" else found.appearances)[entry.name] = entry
    elif (entry / "session.json").is_file():
        found.sessions.append(entry)
    elif (entry / FACE_DOCUMENT).is_file():
        found.faces.append(entry)
    elif entry.is_dir() and image_section.folder_document(entry) is not None:
        found.pictures.append(entry)
    elif entry.is_dir() and (
        entry.name.startswith("calibration") or any(map(_is_of_a_calibration, entry.glob("*.json")))
    ):
        found.calibrations.append(entry)


_SCHEMA_SEARCH_CHARS = 400
"""Characters searched for the schema of a document."""


def _is_of_a_calibration(file: Path) -> bool:
    with file.open(encoding="utf-8", errors="replace") as text:
        return f'"{CALIBRATION_SCHEMA}"' in text.read(_SCHEMA_SEARCH_CHARS)


def read_json(path: Path) -> dict[str, Any]:
    """Read a command's JSON document.

    Raises
    ------
    ReportError
        When it is not JSON, or no document of a command.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ReportError(f"{path}: cannot be read as JSON ({error}); write it again") from error
    if not isinstance(document, dict) or not isinstance(document.get("schema"), str):
        raise ReportError(f'{path}: got no "schema", expected a document of a skinrig command')
    return document
