"""One self-contained HTML page of what was measured, and how far from the truth it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from model import store
from model.skin import SkinAppearance
from skinrig.appearances.dynamic import parts_of
from skinrig.reporting import consents, page, provenance, unjudged
from skinrig.reporting import map_images as map_pictures
from skinrig.reporting import verdict as verdict_section
from skinrig.reporting.comparison import page as comparison
from skinrig.reporting.comparison import runs as run_comparison
from skinrig.reporting.folders import Findings, ReportError, discover, read_json
from skinrig.reporting.sections import (
    bench,
    calibration,
    chromophore,
    dynamic,
    extremes,
    microrelief,
    omissions,
    population,
    sequence,
    session,
    subsurface,
)
from skinrig.reporting.sections import images as pictures_section
from skinrig.reporting.sections import surface as surface_section

__all__ = ["Report", "ReportError", "build", "make"]


@dataclass(frozen=True, slots=True)
class Report:
    """A page, and what it says first."""

    html: str
    checks: tuple[page.Check, ...]
    compared: tuple[str, str] | None
    """Labels of the two runs that it compares; None: it is about one collection."""

    @property
    def verdict(self) -> str:
        """Whether the checks kept their limits, in a sentence."""
        return verdict_section.headline(self.checks)


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
    return make(paths, title=title, compare=False).html


def make(
    paths: Sequence[str | Path], *, title: str = "skinrig report", compare: bool | None = None
) -> Report:
    """Return the report on a collection, or on two runs beside each other.

    Parameters
    ----------
    paths
        As for `build`.
    title
        Heading of the page.
    compare
        Whether two runs are compared; None: by the rule of `run_comparison.sides`.

    Raises
    ------
    ReportError
        When a path does not exist, nothing is found, or a comparison is asked of what are not two
        runs.
    """
    places = [Path(p) for p in paths]
    both = run_comparison.sides(places, insist=compare)
    if both is not None:
        for run in both:
            judge(run.found, run.checks)
        pairs = run_comparison.compared(*both)
        html = page.document(
            title, comparison.lead(*both, pairs), comparison.sections(*both, pairs)
        )
        checks = tuple(both[0].checks + both[1].checks)
        return Report(html, checks, (both[0].label, both[1].label))
    checks_of_all: list[page.Check] = []
    found = discover(places)
    body = sections(found, checks_of_all)
    lead = verdict_section.section(checks_of_all, found.words(), _least_known(found))
    html = page.document(title, lead, body)
    return Report(html, tuple(checks_of_all), None)


def _least_known(found: Findings) -> list[str]:
    """Return what maps without a truth know least of."""
    told = []
    for name, folder in found.appearances.items():
        parameters: Mapping[str, Any] = store.read_document(folder).parameters
        states = parameters.get("parts", {}).get("facial_color", {}).get("truth", {})
        if not found.truths.keys() & {parameters.get("truth"), *states.values()}:
            told += unjudged.weaknesses(name, store.read(folder))
    return told


def judge(found: Findings, checks: list[page.Check]) -> None:
    """Judge all that was found as its report does, without what the report only shows.

    Parameters
    ----------
    found
        What lies at the paths of a report.
    checks
        Judgements are added to it.
    """
    appearances = {name: store.read(folder) for name, folder in found.appearances.items()}
    _maps(found, appearances, checks)
    _documents(found, checks)
    sessions = session.facts_of(found.sessions)
    calibration.section(found.calibrations, appearances, sessions, checks)


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
    sessions = session.facts_of(found.sessions)
    body = _maps(found, appearances, checks)
    body += chromophore.identifiability(appearances.values())
    body += population.section(appearances, found.truths)
    body += _documents(found, checks)
    body += calibration.section(found.calibrations, appearances, sessions, checks)
    body += omissions.section(found.sessions)
    body += consents.section([found])
    return body + session.section(sessions)


def _maps(
    found: Findings, appearances: Mapping[str, SkinAppearance], checks: list[page.Check]
) -> str:
    body = ""
    for name, appearance in appearances.items():
        if dynamic.is_dynamic(appearance):
            body += _dynamic_section(name, appearance, found, checks)
        else:
            body += _appearance_section(name, appearance, found.truth_of(appearance), checks)
    return body + "".join(pictures_section.section(folder, checks) for folder in found.pictures)


def _documents(found: Findings, checks: list[page.Check]) -> str:
    body = ""
    for path in found.documents:
        document = read_json(path)
        if bench.is_bench(document):
            body += bench.section(document, checks)
        elif document["schema"] == extremes.SCHEMA:
            body += extremes.section(document, checks)
        else:
            body += _document_section(document)
    return body


def _appearance_section(
    name: str, appearance: SkinAppearance, truth: SkinAppearance | None, checks: list[page.Check]
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
    elif microrelief.is_microrelief(appearance):
        body += microrelief.section(name, appearance, truth, checks)
    else:
        if subsurface.is_probe(appearance):
            body += subsurface.section(name, appearance, truth, checks)
        elif sequence.is_sequence(appearance):
            body += sequence.section(appearance)
        if truth is not None and "melanin" in truth.maps:
            body += chromophore.errors(name, appearance, truth, checks)
        body += chromophore.panels(appearance, truth)
    if truth is None:
        body += unjudged.section(appearance)
    return body + provenance.section(appearance)


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
    body += dynamic.section(name, appearance, truths, checks)
    if not truths:
        body += unjudged.section(appearance)
    return body + provenance.section(appearance)


def _document_section(document: Mapping[str, Any]) -> str:
    heading = document.get("title", document["schema"])
    body = f"<h2>{page.escape(heading)}</h2>"
    for entry in document.get("tables", ()):
        body += page.table(entry["head"], entry["rows"], caption=entry["title"])
    return body
