"""Describe the state of each result in a folder, with the command that repairs or repeats it."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any, Final

from capture.calibration import store as calibration_store
from capture.calibration.record import CalibrationError
from capture.session import SessionError, verify
from model import store
from model.skin import SkinAppearance
from skinrig.console import format_count
from skinrig.next_steps import Step, shell_quote, suggest
from skinrig.reporting import page, repeating
from skinrig.reporting.folders import ReportInputs, discover
from skinrig.reporting.report import evaluate_checks
from skinrig.reporting.verdict import format_headline
from skinrig.unit_format import format_quantity
from skinrig.workspace import scan

SOON_DAYS: Final = 14
"""Days before the end of a calibration's validity from which its expiry is near."""
GOOD_STATES: Final = ("sound", "valid", "up to date")


@dataclass(frozen=True, slots=True)
class ResultState:
    """State of one result."""

    kind: str
    """session, calibration or maps."""
    name: str
    state: str
    """One of `GOOD_STATES`, or a fault in words."""
    detail: str
    command: str = ""
    """Command that repairs or repeats it, in the folder of the results; empty: none."""

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
        count, faults = len(self.results), len(self.faults)
        state = f"{faults} of {count} results need work"
        if not faults:
            state = f"All {count} results are sound"
        return f"{state}. {format_headline(self.checks)}"

    def document(self) -> dict[str, Any]:
        """Return the status as JSON values."""
        return {
            "results": [asdict(one) for one in self.results],
            "checks": len(self.checks),
            "missed": [{"check": one.name, "repeat": one.command} for one in self.missed],
            "next": [asdict(one) for one in self.steps],
        }


def read_status(folder: Path, *, today: date) -> FolderStatus:
    """Verify every session, calibration and set of maps in a folder, and check their limits.

    Parameters
    ----------
    folder
        Folder of results, such as a demo's.
    today
        Day on which the validity of calibrations is judged.

    Raises
    ------
    skinrig.reporting.folders.ReportError
        If the folder does not exist or has no results.
    """
    found = discover([folder])
    checks: list[page.Check] = []
    results = [
        *(_read_session(path) for path in found.sessions),
        *(
            one
            for path in found.calibrations
            for one in _read_calibration(path, found, today=today)
        ),
        *(_read_maps(name, path, found) for name, path in found.appearances.items()),
    ]
    evaluate_checks(found, checks)
    steps = [
        replace(one, command=_run_inside(one.command, folder))
        for one in suggest(scan(folder), folder)
    ]
    return FolderStatus(folder.absolute().name, tuple(results), tuple(checks), tuple(steps))


def _run_inside(command: str, folder: Path) -> str:
    """Return a command with its paths relative to the folder of the results.

    Examples
    --------
    >>> _run_inside("skinrig report 'my demo'", Path("my demo"))
    'skinrig report .'
    >>> _run_inside("skinrig view 'my demo/maps'", Path("my demo"))
    "skinrig view 'maps'"
    """
    inside = command.replace(f"{folder}{os.sep}", "")
    return inside.replace(f" {shell_quote(folder)}", " .")


def _read_session(path: Path) -> ResultState:
    again = f"skinrig verify {shell_quote(path.name)}"
    try:
        report = verify(path)
    except (SessionError, OSError, ValueError) as error:
        return ResultState("session", path.name, "damaged", str(error), again)
    size = f"{format_count(report.frames, 'frame')}, {report.bytes / 1e6:.1f} MB"
    if report.ok:
        return ResultState("session", path.name, "sound", size)
    state = "damaged" if report.complete else "incomplete"
    return ResultState("session", path.name, state, "; ".join([size, *report.problems[:1]]), again)


def _read_calibration(path: Path, found: ReportInputs, *, today: date) -> Iterator[ResultState]:
    for file in sorted(path.glob("*.json")):
        name = f"{path.name}, {file.stem}"
        try:
            one = calibration_store.load(path, file.stem)
        except (CalibrationError, ValueError) as error:
            yield ResultState("calibration", name, "damaged", str(error))
            continue
        left = (one.valid_until - today).days
        state = "expired" if left < 0 else "expires soon" if left < SOON_DAYS else "valid"
        again = repeating.repeat_calibration(path.name, one, found.sessions)
        detail = f"until {one.valid_until.isoformat()}, {left} days left"
        yield ResultState("calibration", name, state, detail, "" if state == "valid" else again)


def _read_maps(name: str, path: Path, found: ReportInputs) -> ResultState:
    try:
        appearance = store.read(path)
    except store.StoreError as error:
        return ResultState("maps", name, "damaged", str(error))
    detail = format_count(len(appearance.maps), "map")
    if session := appearance.parameters.get("session"):
        detail += f" of {session}"
    changed = _list_changed_calibrations(appearance, found)
    if not changed:
        return ResultState("maps", name, "up to date", detail)
    detail += f"; calibrations {', '.join(changed)} have changed since"
    return ResultState(
        "maps", name, "out of date", detail, repeating.repeat_maps(name, appearance, found)
    )


def _list_changed_calibrations(appearance: SkinAppearance, found: ReportInputs) -> list[str]:
    """Return the kinds of calibration behind the maps that no folder has any more.

    Without any of them nearby, the maps may have come from elsewhere, and none is listed.
    """
    now = set().union(*(repeating.hash_files(one) for one in found.calibrations))
    used = {
        key.removeprefix(repeating.CALIBRATION_PREFIX): digest
        for key, digest in appearance.inputs.items()
        if key.startswith(repeating.CALIBRATION_PREFIX)
    }
    changed = sorted(kind for kind, digest in used.items() if digest not in now)
    return changed if len(changed) < len(used) else []


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
                        one.command or "unknown",
                    )
                    for one in status.missed
                ],
                caption="Missed limits",
            )
        )
    rows = [(one.command, one.why) for one in status.steps]
    lead.append(page.build_table(("command", "result"), rows, caption="Next steps"))
    lead.append(page.build_note("Commands run in the folder that holds the results."))
    kinds = {"session": "Sessions", "calibration": "Calibrations", "maps": "Maps"}
    body: list[page.Block] = []
    for kind, title in kinds.items():
        own = [one for one in status.results if one.kind == kind]
        if own:
            body += [page.Heading(title, level=2), _table(f"State of {len(own)}", own)]
    if status.checks:
        body += [page.Heading("Checks", level=2), page.build_checks_table(status.checks)]
    return page.render_page(f"status of {status.name}", lead, body)


def _table(caption: str, results: Sequence[ResultState]) -> page.Table:
    rows = [(one.name, one.state, one.detail, one.command) for one in results]
    return page.build_table(("result", "state", "detail", "command"), rows, caption=caption)
