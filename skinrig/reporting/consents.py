"""What the people agreed to whose skin a report shows: it is a copy of them, too."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from model import store
from skinrig import consent
from skinrig.reporting import page
from skinrig.reporting.folders import Findings
from skinrig.reporting.sections import images as image_section


def records_of(found: Findings) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield folder and record of each subject that was measured, see :mod:`skinrig.consent`."""
    for folder in found.appearances.values():
        for record in consent.merge_consent(store.read_document(folder)):
            yield folder, record
    for folder in found.sessions:
        document = json.loads((folder / "session.json").read_text(encoding="utf-8"))
        if document.get("source") == "measured":
            yield folder, dict(document["subject"])
    for folder in found.pictures:
        path = image_section.folder_document(folder)
        if path is not None:
            for record in (
                json.loads(path.read_text(encoding="utf-8")).get(consent.CONSENT_KEY) or ()
            ):
                yield folder, dict(record)


def section(sides: Sequence[Findings]) -> Iterator[page.Block]:
    """Yield the table of subjects and what they agreed to; empty where nobody was measured.

    Parameters
    ----------
    sides
        What a report is about; of a comparison, both runs.
    """
    rows: dict[str, list[str]] = {}
    for found in sides:
        for folder, record in records_of(found):
            (line,) = consent.format_consent([record])
            names = rows.setdefault(line, [])
            if folder.name not in names:
                names.append(folder.name)
    if not rows:
        return
    table = [
        (line.partition(": ")[0], line.partition(": ")[2], ", ".join(names))
        for line, names in sorted(rows.items())
    ]
    yield page.Heading("Consent", level=2)
    yield page.table(
        ("subject", "agreed to", "shown from"),
        table,
        caption="This report shows these people: hand it on for nothing else, and not after",
    )
