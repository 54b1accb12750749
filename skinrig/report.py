"""One self-contained HTML page of what was measured, and how far from the truth it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from model import store
from model.skin import SkinAppearance
from skinrig import (
    bench_section,
    calibration_section,
    chromophore_section,
    dynamic_section,
    extremes_section,
    map_pictures,
    microrelief_section,
    page,
    pictures_section,
    population_section,
    provenance_section,
    sequence_section,
    session_section,
    subsurface_section,
    surface_section,
    unjudged_section,
    verdict_section,
)
from skinrig.dynamic_appearance import parts_of
from skinrig.report_folders import Findings, ReportError, discover, read_json

__all__ = ["ReportError", "build", "sections"]


def build(paths: Sequence[str | Path], *, title: str = "skinrig report") -> str:
    """Return the report of everything at ``paths`` as HTML, equal for equal input.

    Parameters
    ----------
    paths
        Folders or files that skinrig wrote: a demo's folder, sessions, appearances, truths,
        benchmark documents.
    title
        Heading of the page.

    Raises
    ------
    ReportError
        When a path does not exist, or nothing is found at all.
    """
    checks: list[page.Check] = []
    body = sections(discover([Path(p) for p in paths]), checks)
    return page.document(title, verdict_section.section(checks), body)


def sections(found: Findings, checks: list[page.Check]) -> str:
    """Return the sections on all that was found, and judge it.

    Parameters
    ----------
    found
        What lies at the paths of a report.
    checks
        Judgements are added to it.
    """
    appearances = {name: store.read(folder) for name, folder in found.appearances.items()}
    sessions = session_section.facts_of(found.sessions)
    parts: list[str] = []
    for name, appearance in appearances.items():
        if dynamic_section.is_dynamic(appearance):
            parts.append(_dynamic_section(name, appearance, found, checks))
            continue
        truth = truth_of(appearance, found)
        parts.append(_appearance_section(name, appearance, truth, checks))
    parts += [pictures_section.section(folder, checks) for folder in found.pictures]
    parts.append(chromophore_section.identifiability(appearances.values()))
    parts.append(population_section.section(appearances))
    for path in found.documents:
        document = read_json(path)
        if bench_section.is_bench(document):
            parts.append(bench_section.section(document, checks))
        elif document["schema"] == extremes_section.SCHEMA:
            parts.append(extremes_section.section(document, checks))
        else:
            parts.append(_document_section(document))
    parts.append(calibration_section.section(found.calibrations, appearances, sessions, checks))
    parts.append(session_section.section(sessions))
    return "".join(parts)


def truth_of(appearance: SkinAppearance, found: Findings) -> SkinAppearance | None:
    """Return the truth that an appearance names, where it was found."""
    path = found.truths.get(str(appearance.parameters.get("truth", "")))
    return store.read(path) if path else None


def _appearance_section(
    name: str,
    appearance: SkinAppearance,
    truth: SkinAppearance | None,
    checks: list[page.Check],
) -> str:
    body = f"<h2>Maps: {page.escape(name)}</h2>"
    pictures = [
        map_pictures.color_picture(f"{label}, linear sRGB", appearance.maps[key].values)
        for key, label in (("picture", "crossed polarizers"), ("specular_picture", "specular"))
        if key in appearance.maps
    ]
    if pictures:
        body += f'<div class="maps">{"".join(pictures)}</div>'
    if "position" in appearance.maps:
        body += surface_section.section(name, appearance, truth, checks)
    elif microrelief_section.is_microrelief(appearance):
        body += microrelief_section.section(name, appearance, truth, checks)
    else:
        if subsurface_section.is_probe(appearance):
            body += subsurface_section.section(name, appearance, truth, checks)
        elif sequence_section.is_sequence(appearance):
            body += sequence_section.section(appearance)
        if truth is not None and "melanin" in truth.maps:
            body += chromophore_section.errors(name, appearance, truth, checks)
        body += chromophore_section.panels(appearance, truth)
    if truth is None:
        body += unjudged_section.section(appearance)
    return body + provenance_section.section(appearance)


def _dynamic_section(
    name: str, appearance: SkinAppearance, found: Findings, checks: list[page.Check]
) -> str:
    part = parts_of(appearance).get("facial_color", {})
    truths = {
        state: store.read(found.truths[folder])
        for state, folder in part.get("truth", {}).items()
        if folder in found.truths
    }
    body = f"<h2>Moving face: {page.escape(name)}</h2>"
    body += dynamic_section.section(name, appearance, truths, checks)
    if not truths:
        body += unjudged_section.section(appearance)
    return body + provenance_section.section(appearance)


def _document_section(document: Mapping[str, Any]) -> str:
    heading = document.get("title", document["schema"])
    body = f"<h2>{page.escape(heading)}</h2>"
    for entry in document.get("tables", ()):
        body += page.table(entry["head"], entry["rows"], caption=entry["title"])
    return body
