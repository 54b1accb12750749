"""Build a self-contained HTML page of measurements and their errors against ground truth."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from capture.session import Session
from model import store
from model.skin import SkinAppearance
from skinrig.appearances.contents import hash_file, is_fused
from skinrig.appearances.dynamic import describe_parts
from skinrig.evaluating.session_agreement import SessionAgreement
from skinrig.reporting import chapter, first_screen, page, provenance, repeating
from skinrig.reporting import verdict as verdict_section
from skinrig.reporting.comparison import page as comparison
from skinrig.reporting.comparison import runs as run_comparison
from skinrig.reporting.drawn_sections import DrawnSections
from skinrig.reporting.folders import ReportError, ReportInputs, discover, read_json
from skinrig.reporting.sections import (
    bench,
    calibration,
    chromophore,
    dynamic,
    extremes,
    finished_face,
    fused,
    microrelief,
    sequence,
    session,
    study,
    subsurface,
)
from skinrig.reporting.sections import images as image_section
from skinrig.reporting.sections import surface as surface_section

__all__ = ["Report", "ReportError", "build", "build_any"]


@dataclass(frozen=True, slots=True)
class Report:
    """A page and its verdict."""

    html: str
    checks: tuple[page.Check, ...]
    compared: tuple[str, str] | None
    """Labels of the two runs that are compared; None: the report is on one collection."""
    sessions: Mapping[str, SessionAgreement] = field(default_factory=dict)
    """Verdicts on person and state, by the name of the compared maps."""

    @property
    def verdict(self) -> str:
        """Number of checks that kept their limits, in a sentence."""
        return verdict_section.format_headline(self.checks)


def build(
    paths: Sequence[str | Path],
    *,
    title: str = "skinrig report",
    reload_s: int | None = None,
    folder: Path | None = None,
    drawn: DrawnSections | None = None,
) -> str:
    """Return a deterministic HTML report of everything at ``paths``.

    Parameters
    ----------
    paths
        Folders or files written by skinrig: a demo's folder, sessions, appearances, ground truths,
        benchmark documents.
    title
        Heading of the page.
    reload_s
        Seconds after which a browser loads the page again; None: never.
    folder
        Folder in which the page will be, for links to files there; None: without links.
    drawn
        Sections of earlier reports; those of unchanged maps are reused, new ones are added.

    Raises
    ------
    ReportError
        If a path does not exist, or nothing is found.
    """
    report = build_any(
        paths, title=title, compare=False, reload_s=reload_s, folder=folder, drawn=drawn
    )
    return report.html


def build_any(
    paths: Sequence[str | Path],
    *,
    title: str = "skinrig report",
    compare: bool | None = None,
    reload_s: int | None = None,
    folder: Path | None = None,
    drawn: DrawnSections | None = None,
    progress: Callable[[str], None] | None = None,
) -> Report:
    """Return the report on a collection, or the comparison of two runs.

    Parameters
    ----------
    paths
        As for `build`.
    title
        Heading of the page.
    compare
        Whether two runs are compared; None: by the rule of `run_comparison.split_sides`.
    reload_s, folder, drawn
        As for `build`; a comparison is never loaded again, and none of it is reused.
    progress
        Called with the number and the count before each section of maps, and before the rest.

    Raises
    ------
    ReportError
        When a path does not exist, nothing is found, or a comparison is requested of paths that
        are not two runs.
    """
    places = [Path(p) for p in paths]
    both = run_comparison.split_sides(places, require_comparison=compare)
    if both is not None:
        for run in both:
            evaluate_checks(run.found, run.checks)
        pairs = run_comparison.compare_maps_of_runs(*both)
        html = page.render_page(
            title, comparison.build_lead(*both, pairs), comparison.build_sections(*both, pairs)
        )
        checks = tuple(both[0].checks + both[1].checks)
        verdicts = {p.name: p.agreement for p in pairs if p.agreement is not None}
        return Report(html, checks, (both[0].label, both[1].label), verdicts)
    checks_of_all: list[page.Check] = []
    found = discover(places)
    appearances = _read_appearances(found)
    body = _build_sections(found, appearances, checks_of_all, folder, drawn, progress)
    first = _first_screen(found, appearances)
    lead = verdict_section.section(
        checks_of_all, found.summary(), _list_least_certain(found), first
    )
    html = page.render_page(title, lead, body, reload_s=reload_s)
    return Report(html, tuple(checks_of_all), None)


def _first_screen(
    found: ReportInputs, appearances: Mapping[str, SkinAppearance]
) -> Iterator[page.Block]:
    """Yield the images of the first screen."""
    truths = {name: found.find_truth(appearance) for name, appearance in appearances.items()}
    yield from first_screen.draw_first_screen(appearances, truths)


def _read_appearances(found: ReportInputs) -> dict[str, SkinAppearance]:
    """Return the appearances by name, a fused person first."""
    appearances = {name: store.read(folder) for name, folder in found.appearances.items()}
    order = sorted(appearances, key=lambda name: not is_fused(appearances[name]))
    return {name: appearances[name] for name in order}


def _list_least_certain(found: ReportInputs) -> list[str]:
    """Return the least certain maps without a ground truth, in sentences."""
    sentences = []
    for name, folder in found.appearances.items():
        parameters: Mapping[str, Any] = store.read_document(folder).parameters
        states = parameters.get("parts", {}).get("facial_color", {}).get("truth", {})
        if not found.truths.keys() & {parameters.get("truth"), *states.values()}:
            sentences += verdict_section.list_least_certain(name, store.read(folder))
    return sentences


def evaluate_checks(found: ReportInputs, checks: list[page.Check]) -> None:
    """Add the checks of a report, without its blocks.

    Parameters
    ----------
    found
        Contents of the paths of a report.
    checks
        Checks are added to it.
    """
    appearances = _read_appearances(found)
    sessions = session.read_session_facts(found.sessions)
    for blocks in (
        _maps(found, appearances, checks),
        _documents(found, checks),
        calibration.section(found.calibrations, appearances, sessions, checks),
    ):
        deque(blocks, maxlen=0)  # each section adds its checks while its blocks are made


def _build_sections(
    found: ReportInputs,
    appearances: Mapping[str, SkinAppearance],
    checks: list[page.Check],
    folder: Path | None,
    drawn: DrawnSections | None,
    progress: Callable[[str], None] | None,
) -> list[page.Block]:
    """Return the sections of a report, and add its checks."""
    sessions = session.read_session_facts(found.sessions)
    return [
        *_maps(found, appearances, checks, drawn, progress),
        *(
            block
            for number, face in enumerate(found.faces)
            for block in finished_face.section(face, number, folder)
        ),
        *chromophore.draw_identifiability(appearances.values()),
        *subsurface.compare_people(appearances, found.truths),
        *_documents(found, checks, drawn),
        *calibration.section(found.calibrations, appearances, sessions, checks),
        *session.list_omissions(found.sessions),
        *provenance.consent_section([found]),
        *session.section(sessions),
    ]


def _maps(
    found: ReportInputs,
    appearances: Mapping[str, SkinAppearance],
    checks: list[page.Check],
    drawn: DrawnSections | None = None,
    progress: Callable[[str], None] | None = None,
) -> Iterator[page.Block]:
    drawn = DrawnSections() if drawn is None else drawn
    for number, (name, appearance) in enumerate(appearances.items()):
        if progress is not None:
            progress(f"draw section {number}/{len(appearances)}: {name}")
        if dynamic.is_dynamic(appearance):
            again = ""
            draw = partial(_dynamic_section, found=found)
        else:
            again = repeating.repeat_maps(name, appearance, found)
            draw = partial(_appearance_section, found=found)
        subject = page.ReportedAppearance(name, appearance, None, [], again)
        documents = [found.appearances[name], *_name_truths(appearance, found)]
        digests = (hash_file(folder / store.DOCUMENT_FILE) for folder in documents)
        captured = repeating.find_session(appearance, found)
        contents = name, again, captured and captured.content_hash, *digests
        draw = partial(_draw_chapter, draw, subject, captured)
        yield from drawn.draw(contents, draw, checks)
    if progress is not None and appearances:
        progress(f"draw section {len(appearances)}/{len(appearances)}: the rest")
    for folder in found.pictures:
        yield from image_section.section(folder, checks)


def _draw_chapter(
    draw: Callable[[page.ReportedAppearance], Iterator[page.Block]],
    subject: page.ReportedAppearance,
    captured: Session | None,
    checks: list[page.Check],
) -> Iterator[page.Block]:
    """Draw the section of an appearance, and add its checks to an empty list."""
    subject = replace(subject, checks=checks)
    body = list(draw(subject))  # its checks are in the head
    yield from chapter.draw_head(subject, captured)
    yield from body


def _name_truths(appearance: SkinAppearance, found: ReportInputs) -> list[Path]:
    """Return the folders of an appearance's ground truths that were found."""
    states = describe_parts(appearance).get("facial_color", {}).get("truth", {})
    names = (str(appearance.parameters.get("truth", "")), *states.values())
    return [found.truths[name] for name in names if name in found.truths]


def _documents(
    found: ReportInputs, checks: list[page.Check], drawn: DrawnSections | None = None
) -> Iterator[page.Block]:
    drawn = DrawnSections() if drawn is None else drawn
    for path in found.documents:
        document = read_json(path)
        if bench.is_bench(document):
            contents = path.name, hash_file(path)
            yield from drawn.draw(contents, partial(bench.section, document), checks)
        elif document["schema"] == extremes.SCHEMA:
            yield from extremes.section(document, checks)
        elif study.is_study(document):
            yield from study.section(document, checks)
        else:
            yield from _document_section(document)


def _appearance_section(
    subject: page.ReportedAppearance, found: ReportInputs
) -> Iterator[page.Block]:
    appearance = subject.appearance
    truth = found.find_truth(appearance)
    subject = replace(subject, truth=truth)
    if is_fused(appearance):
        yield from fused.section(appearance)
        appearance = fused.without_copies(appearance)
        subject = replace(subject, appearance=appearance)
    if "position" in appearance.maps:
        yield from surface_section.section(subject)
    elif microrelief.is_microrelief(appearance):
        yield from microrelief.section(subject)
    else:
        if subsurface.is_probe(appearance):
            yield from subsurface.section(subject)
        elif sequence.is_sequence(appearance):
            yield from sequence.section(appearance)
        if truth is not None and "melanin" in truth.maps:
            yield from chromophore.list_errors(subject, truth)
        yield from chromophore.draw_panels(appearance, truth)
    if truth is None:
        yield from verdict_section.build_uncertainty_blocks(appearance)
    yield from provenance.section(appearance)


def _dynamic_section(subject: page.ReportedAppearance, found: ReportInputs) -> Iterator[page.Block]:
    appearance = subject.appearance
    part = describe_parts(appearance).get("facial_color", {})
    truths = {
        state: store.read(found.truths[folder])
        for state, folder in part.get("truth", {}).items()
        if folder in found.truths
    }
    yield from dynamic.section(subject, truths)
    if not truths:
        yield from verdict_section.build_uncertainty_blocks(appearance)
    yield from provenance.section(appearance)


def _document_section(document: Mapping[str, Any]) -> Iterator[page.Block]:
    heading = document.get("title", document["schema"])
    yield page.Heading(heading, level=2)
    for entry in document.get("tables", ()):
        yield page.build_table(entry["head"], entry["rows"], caption=entry["title"])
