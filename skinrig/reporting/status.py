"""Describe the state of each result in a folder, with the command that repeats it."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Any, Final

from capture.calibration import store as calibration_store
from capture.calibration.record import CalibrationError
from capture.session import Session, SessionError, verify
from model import store
from model.skin import SkinAppearance
from skinrig.console import format_count
from skinrig.next_steps import Step, suggest
from skinrig.reporting import page, repeating
from skinrig.reporting.folders import ReportError, ReportInputs, discover, read_json
from skinrig.reporting.report import evaluate_checks
from skinrig.reporting.sections.calibration import count_days_left, list_uses
from skinrig.reporting.sections.images import folder_document
from skinrig.reporting.sections.session import SessionFacts, read_session_facts
from skinrig.reporting.verdict import format_headline
from skinrig.unit_format import format_quantity
from skinrig.workspace import scan

GOOD_STATES: Final = ("sound", "valid", "up to date")
DAMAGED_STATE: Final = "damaged"


@dataclass(frozen=True, slots=True)
class ResultState:
    """State of one result."""

    kind: str
    """session, calibration, maps, ground truth, images or document."""
    name: str
    state: str
    """One of `GOOD_STATES`, or a fault in words."""
    detail: str
    command: str = ""
    """Command that repeats it, with the paths as given; empty: none."""

    @property
    def is_good(self) -> bool:
        """Whether nothing has to be done."""
        return self.state in GOOD_STATES


@dataclass(frozen=True, slots=True)
class FolderStatus:
    """States of all results in a folder, checks of their limits, and next steps."""

    name: str
    results: tuple[ResultState, ...]
    checks: tuple[page.Check, ...]
    steps: tuple[Step, ...]

    @property
    def faults(self) -> tuple[ResultState, ...]:
        """Results that are not good."""
        return tuple(one for one in self.results if not one.is_good)

    @property
    def missed(self) -> tuple[page.Check, ...]:
        """Checks that missed their limits."""
        return tuple(one for one in self.checks if not one.passed)

    def headline(self) -> str:
        """Return the verdict as one sentence."""
        faults = format_count(len(self.faults), "fault")
        results = format_count(len(self.results), "result")
        return f"{faults} in {results}. {format_headline(self.checks)}"

    def document(self) -> dict[str, Any]:
        """Return the status as JSON values."""
        return {
            "results": [asdict(one) for one in self.results],
            "checks": len(self.checks),
            "missed": [{"check": one.name, "repeat": one.command} for one in self.missed],
            "next": [asdict(one) for one in self.steps],
        }


def read_status(
    folder: Path, *, today: date, progress: Callable[[str], None] = lambda text: None
) -> FolderStatus:
    """Verify all sessions, calibrations and maps in a folder, and check the limits of sound ones.

    Parameters
    ----------
    folder
        Folder of results, such as a demo's.
    today
        Day on which consent and the age of calibrations are judged.
    progress
        Called before each result is read.

    Raises
    ------
    skinrig.reporting.folders.ReportError
        If the folder does not exist or has no results.
    """
    found = discover([folder])
    number = itertools.count(1)
    others = [*found.truths.values(), *found.pictures, *found.documents]
    total = len(found.sessions) + len(found.appearances) + len(others)

    def begin(path: Path) -> None:
        progress(f"read result {next(number)}/{total}: {path}")

    results: list[ResultState] = []
    for path in tuple(found.sessions):
        begin(path)
        results.append(_read_session(path, today))
        if results[-1].state == DAMAGED_STATE:
            found.sessions.remove(path)
    appearances: dict[str, SkinAppearance] = {}
    for name, path in tuple(found.appearances.items()):
        begin(path)
        try:
            appearances[name] = store.read(path)
        except store.StoreError as error:
            del found.appearances[name]
            results.append(_describe_damage("maps", name, error))
    facts = read_session_facts(found.sessions)
    for path in found.calibrations:
        results += _read_calibrations(path, appearances, facts, today)
    results += [_judge_maps(name, one, found) for name, one in appearances.items()]
    results += _drop_damaged_rest(found, begin)
    checks: list[page.Check] = []
    progress("evaluate the checks")
    evaluate_checks(found, checks)
    steps = suggest(scan(folder), folder)
    return FolderStatus(folder.absolute().name, tuple(results), tuple(checks), steps)


def _describe_damage(kind: str, name: str, error: object) -> ResultState:
    """Return the state of a damaged result, with its error on one line."""
    return ResultState(kind, name, DAMAGED_STATE, " ".join(str(error).split()))


def _read_session(path: Path, today: date) -> ResultState:
    try:
        report = verify(path, today=today)
        if not report.ok:
            return _describe_damage("session", path.name, report.problems[0])
        session = Session.open(path)
    except (SessionError, OSError, ValueError) as error:
        return _describe_damage("session", path.name, error)
    size = f"{format_count(report.frames, 'frame')}, {report.bytes / 1e6:.1f} MB"
    expires = session.manifest.subject.consent_expires
    if expires is not None and today > expires:
        detail = f"{size}; on {expires.isoformat()}, do not use the data any more"
        return ResultState("session", path.name, "consent expired", detail)
    if missing := len(session.pending_frames()):
        size += f"; {format_count(missing, 'frame')} of the plan missing"
    if not session.closed:
        return ResultState("session", path.name, "incomplete", f"{size}; not closed")
    return ResultState("session", path.name, "sound", size)


def _read_calibrations(
    folder: Path,
    appearances: Mapping[str, SkinAppearance],
    sessions: Mapping[str, SessionFacts],
    today: date,
) -> Iterator[ResultState]:
    """Yield the state of each calibration of a folder at the captures of its maps."""
    for file in sorted(folder.glob("*.json")):
        name = f"{folder.name}, {file.stem}"
        try:
            one = calibration_store.load(folder, file.stem)
        except (CalibrationError, ValueError) as error:
            yield _describe_damage("calibration", name, error)
            continue
        _, captured = list_uses(file, appearances, sessions)
        outside = [day.isoformat() for day in captured if count_days_left(one, day) < 0]
        detail = f"from {one.created.isoformat()} to {one.valid_until.isoformat()}"
        if outside:
            detail += f", captured on {', '.join(outside)}"
        elif today > one.valid_until:
            detail += "; capture its target again before further sessions"
        state = "not valid at capture" if outside else "valid"
        yield ResultState("calibration", name, state, detail)


def _judge_maps(name: str, appearance: SkinAppearance, found: ReportInputs) -> ResultState:
    """Return whether the calibrations that maps were made with are still those of a folder."""
    detail = format_count(len(appearance.maps), "map")
    if session := appearance.parameters.get("session"):
        detail += f" of {session}"
    place = repeating.find_session(appearance, found)
    rig = None if place is None else place.rig.name
    changed = [
        kind
        for kind, digest in sorted(repeating.list_used_calibrations(appearance).items())
        if (now := repeating.hash_calibrations(kind, found, rig)) and digest not in now.values()
    ]
    if not changed:
        return ResultState("maps", name, "up to date", detail)
    detail += f"; made with another calibration: {', '.join(changed)}"
    again = repeating.repeat_maps(name, appearance, found)
    return ResultState("maps", name, "out of date", detail, again)


def _drop_damaged_rest(found: ReportInputs, begin: Callable[[Path], None]) -> Iterator[ResultState]:
    """Remove damaged ground truths, images and documents from `found`, and yield their states."""

    def read_images(folder: Path) -> None:
        if (document := folder_document(folder)) is not None:
            read_json(document)

    truths = list(found.truths.values())
    readers: tuple[tuple[str, list[Path], Callable[[Path], object]], ...] = (
        ("ground truth", truths, store.read),
        ("images", found.pictures, read_images),
        ("document", found.documents, read_json),
    )
    for kind, places, read in readers:
        for path in tuple(places):
            begin(path)
            try:
                read(path)
            except (store.StoreError, ReportError) as error:
                places.remove(path)
                yield _describe_damage(kind, path.name, error)
    found.truths = {name: path for name, path in found.truths.items() if path in truths}


def build_status_page(status: FolderStatus) -> str:
    """Return the status of a folder as an HTML page."""
    bad = bool(status.faults or status.missed)
    lead: list[page.Block] = [
        page.Paragraph(status.headline(), f"verdict {'bad' if bad else 'good'}")
    ]
    if status.faults:
        lead.append(_table("Needs work", status.faults))
    if status.missed:
        lead.append(
            page.build_table(
                ("missed check", "measured", "limit", "repeat with"),
                [
                    (
                        one.name,
                        format_quantity(page.format_number(one.got), one.unit),
                        format_quantity(page.format_number(one.bound), one.unit),
                        one.command or "none known",
                    )
                    for one in status.missed
                ],
                caption="Missed limits",
            )
        )
    rows = [(one.command, one.why) for one in status.steps]
    lead.append(page.build_table(("command", "result"), rows, caption="Next steps"))
    lead.append(page.build_note("Commands run in the folder where this page was made."))
    body: list[page.Block] = []
    for kind in dict.fromkeys(one.kind for one in status.results):
        own = [one for one in status.results if one.kind == kind]
        body += [page.Heading(kind.capitalize(), level=2), _table(f"State of {len(own)}", own)]
    if status.checks:
        body += [page.Heading("Checks", level=2), page.build_checks_table(status.checks)]
    return page.render_page(f"status of {status.name}", lead, body, folded=False)


def _table(caption: str, results: Sequence[ResultState]) -> page.Table:
    rows = [(one.name, one.state, one.detail, one.command) for one in results]
    return page.build_table(("result", "state", "detail", "command"), rows, caption=caption)
