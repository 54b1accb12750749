"""Report section on a fused person's face, lit and moving."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

from model import store
from skinrig.appearances.contents import hash_document
from skinrig.drawing import frame_sheet
from skinrig.drawing.png import to_data_url
from skinrig.fusing.finished_face_file import DOCUMENT_FILE, LIVE_PAGE, SCHEMA, SHEET_FILE
from skinrig.next_steps import shell_quote
from skinrig.reporting import page
from skinrig.reporting.folders import ReportError, read_json

SECTION_TITLE = "The finished face"
DOCUMENT_TYPES: dict[str, type | tuple[type, ...]] = {
    "person": str,
    "expression": str,
    "weights": list,
    "lights": dict,
    "blood_fraction": (int, float),
    "errors": dict,
    "left_out": list,
    "inputs": dict,
}
"""Types of the entries of the record that the section shows."""
RENDER_ADVICE = "remove the folder, or render the face again with `skinrig demo`"


def section(folder: Path, number: int, report_folder: Path | None) -> Iterator[page.Block]:
    """Yield the frames of a finished face with buttons for light and movement.

    Parameters
    ----------
    folder
        With frames and their record.
    number
        Number of the face on the page; it distinguishes the names of buttons.
    report_folder
        Folder of the report, for the link to the live page; None: unknown, without a link.

    Raises
    ------
    ReportError
        If the record or the frames are missing or damaged.
    """
    document = _read(folder / DOCUMENT_FILE)
    sheet = folder / SHEET_FILE
    try:
        image = sheet.read_bytes()
    except OSError as error:
        raise ReportError(f"{sheet}: {error.strerror}; {RENDER_ADVICE}") from error
    live = folder.parent / LIVE_PAGE
    person = folder.parent / document["person"]
    width, height = frame_sheet.FRAME_PX
    yield page.Heading(SECTION_TITLE, level=2)
    yield page.build_view(
        "finished_face",
        index=number,
        address=to_data_url(image, "webp"),
        size=(width * frame_sheet.N_STEPS, height * frame_sheet.N_LIGHTS),
        lights=list(document["lights"]),
        first=frame_sheet.FIRST_LIGHT,
        document=document,
        older=_list_changed(folder.parent, document["inputs"]),
        link=_link(live, report_folder),
        command=f"skinrig view {shell_quote(person)} -o {shell_quote(live)}",
        left_out=document["left_out"],
    )


def _read(path: Path) -> dict[str, Any]:
    """Read and check the record of a finished face."""
    document = read_json(path)
    if wrong := _find_fault(document):
        raise ReportError(f"{path}: {wrong}; {RENDER_ADVICE}")
    return document


def _find_fault(document: dict[str, Any]) -> str:
    """Return what is wrong with a record, in words; empty if nothing is."""
    if document["schema"] != SCHEMA:
        return f"got schema {document['schema']!r}, expected {SCHEMA}"
    for key, kind in DOCUMENT_TYPES.items():
        if not isinstance(document.get(key), kind):
            return f"got no valid {key!r}, expected that of {SCHEMA}"
    for key, count in (("lights", frame_sheet.N_LIGHTS), ("weights", frame_sheet.N_STEPS)):
        if len(document[key]) != count:
            return f"got {len(document[key])} {key}, expected {count}"
    if not all(isinstance(row, list) and len(row) == 2 for row in document["left_out"]):
        return "got no pairs in 'left_out', expected part and reason"
    return ""


def _list_changed(parent: Path, inputs: dict[str, str]) -> list[str]:
    """Return the folders of maps that are not those from which the frames were rendered."""
    changed = []
    for name, digest in inputs.items():
        maps = parent / name
        if (maps / store.DOCUMENT_FILE).is_file() and hash_document(maps) != digest:
            changed.append(name)
    return changed


def _link(live: Path, report_folder: Path | None) -> str:
    """Return the address of the live page from the report; empty if there is none."""
    if report_folder is None or not live.is_file():
        return ""
    try:
        relative = os.path.relpath(live.resolve(), report_folder.resolve())
    except ValueError:  # on another drive
        return ""
    return quote(Path(relative).as_posix())
