"""Build tables of inputs, versions, parameters, assumptions and omitted stages of a map."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from model import store
from model.skin import SkinAppearance
from reconstruction.pipeline.graph import UNWANTED_REASON
from skinrig import consent
from skinrig.fusing.finished_face_file import DOCUMENT_FILE as FACE_DOCUMENT
from skinrig.reporting import page
from skinrig.reporting.folders import ReportInputs
from skinrig.reporting.sections import images as image_section

DIGEST_CHARS = 16
"""Characters of a digest that a table shows."""


def flatten_settings(values: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return nested settings by their path, as text.

    Examples
    --------
    >>> flatten_settings({"fit": {"rank": 4, "seed": None}, "views": [1, 2]})
    {'fit.rank': '4', 'fit.seed': 'null', 'views': '[1, 2]'}
    """
    flat: dict[str, str] = {}
    for key, value in sorted(values.items()):
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and value:
            flat |= flatten_settings(value, f"{name}.")
        elif isinstance(value, (list, tuple)) and len(json.dumps(value)) > 120:
            flat[name] = f"{len(value)} entries"
        else:
            flat[name] = value if isinstance(value, str) else json.dumps(value)
    return flat


def section(appearance: SkinAppearance) -> Iterator[page.Block]:
    """Yield assumptions, omitted stages and provenance of an appearance."""
    assumed = appearance.parameters.get("assumed")
    if isinstance(assumed, (list, tuple)) and assumed:
        yield page.Heading("Assumptions")
        yield page.build_assumptions_table(assumed)
    omitted = [row for row in appearance.left_out if row[1] != UNWANTED_REASON]
    if omitted:
        yield page.Heading("Omitted stages")
        yield page.build_table(("stage", "reason"), omitted, caption="Stages that were not run")
    origin = page.build_facts_table(
        {"source": appearance.source, "seed": str(appearance.seed)}
        | {f"input {k}": shorten_digest(v) for k, v in sorted(appearance.inputs.items())}
        | {f"version of {k}": v for k, v in sorted(appearance.versions.items())},
        caption=f"Inputs, by the first {DIGEST_CHARS} digits of their SHA-256",
    )
    settings = {
        name: value
        for name, value in flatten_settings(appearance.parameters).items()
        if not name.startswith(("stages.", "assumed"))
    }
    listed = page.build_facts_table(settings, caption="Parameters recorded in the folder")
    title = f"Provenance: inputs, versions and {len(settings)} parameters"
    yield page.Collapsible(title, [origin, listed])


def shorten_digest(digest: str) -> str:
    """Return the first characters of a digest.

    Examples
    --------
    >>> shorten_digest("sha256:0123456789abcdef0123")
    '0123456789abcdef'
    """
    return digest.removeprefix("sha256:")[:DIGEST_CHARS]


def read_consent_records(found: ReportInputs) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield folder and record of each subject that was measured, see :mod:`skinrig.consent`."""
    for folder in found.appearances.values():
        for record in consent.merge_consent(store.read_document(folder)):
            yield folder, record
    for folder in found.sessions:
        document = json.loads((folder / "session.json").read_text(encoding="utf-8"))
        if document.get("source") == "measured":
            yield folder, dict(document["subject"])
    documents = [image_section.folder_document(folder) for folder in found.pictures]
    for path in (*documents, *(folder / FACE_DOCUMENT for folder in found.faces)):
        if path is not None:
            document = json.loads(path.read_text(encoding="utf-8"))
            for record in document.get(consent.CONSENT_KEY) or ():
                yield path.parent, dict(record)


def consent_section(sides: Sequence[ReportInputs]) -> Iterator[page.Block]:
    """Yield the table of subjects and their consent; empty where nobody was measured.

    Parameters
    ----------
    sides
        Contents of the report; of a comparison, of both runs.
    """
    rows: dict[str, list[str]] = {}
    for found in sides:
        for folder, record in read_consent_records(found):
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
    yield page.build_table(
        ("subject", "consent", "folders shown"),
        table,
        caption="This report shows these people; use it within their consent only",
    )
