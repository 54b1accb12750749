"""Read a session folder: manifest, journal, and their consistency."""

import os
import stat
from dataclasses import dataclass
from pathlib import Path

from capture.documents import Fault
from capture.session.consent_seal import UNSEALED_STATE, check_seal
from capture.session.disk import read_file
from capture.session.errors import NotASession, SessionDamage, SessionError
from capture.session.journal import (
    AttachmentLine,
    CloseLine,
    FrameLine,
    JournalWalk,
    OmissionLine,
    walk_journal,
)
from capture.session.manifest import Manifest, decode

MANIFEST_FILE, JOURNAL_FILE = "session.json", "journal.jsonl"
FRAMES_FOLDER, ORPHANS_FOLDER, ATTACHMENTS_FOLDER = "frames", "orphans", "attachments"
MAX_MANIFEST_BYTES = 2**26
MAX_JOURNAL_BYTES = 2**30


@dataclass(frozen=True, slots=True)
class SessionContents:
    """Content of the two text files of a session."""

    manifest: Manifest
    walk: JournalWalk
    consent_seal: str = UNSEALED_STATE
    """State of the consent's seal."""

    @property
    def frame_lines(self) -> tuple[FrameLine, ...]:
        """All committed frames, in the order of commitment."""
        return tuple(line for _, line in self.walk.lines if isinstance(line, FrameLine))

    @property
    def attachment_lines(self) -> tuple[AttachmentLine, ...]:
        """All committed attachments, in the order of commitment."""
        return tuple(line for _, line in self.walk.lines if isinstance(line, AttachmentLine))

    @property
    def omission_lines(self) -> tuple[OmissionLine, ...]:
        """Omitted steps and their reasons, in the order in which they were omitted."""
        return tuple(line for _, line in self.walk.lines if isinstance(line, OmissionLine))

    @property
    def file_lines(self) -> tuple[FrameLine | AttachmentLine, ...]:
        """All committed files: frames, then attachments."""
        return (*self.frame_lines, *self.attachment_lines)

    @property
    def close_line(self) -> CloseLine | None:
        """Closing line of the session, None while it is open."""
        last = self.walk.lines[-1][1] if self.walk.lines else None
        return last if isinstance(last, CloseLine) else None


def read_contents(path: Path, *, sealing: bool = False) -> SessionContents:
    """Return manifest and journal of the session at ``path``; damage of the journal is recorded.

    Parameters
    ----------
    path : Path
        The session's folder.
    sealing : bool
        Whether a session without a consent seal is accepted although a key is set.

    Raises
    ------
    SessionError
        When the folder is not a session, its schema is unknown, or its consent seal is missing.
    SessionDamage
        When session.json differs from what was written or sealed, or the journal is missing.
    """

    def no_session() -> SessionError:
        advice = "Name the folder of a session; skinrig simulate and skinrig capture make one."
        if path.is_dir():
            found = f"no {MANIFEST_FILE} in it"
        else:
            found = "a file" if path.exists() else "no such folder"
        faults = [Fault("folder", found, f"a folder with {MANIFEST_FILE}")]
        if (path / JOURNAL_FILE).is_file() and (path / JOURNAL_FILE).stat().st_size > 0:
            return SessionDamage(
                "has lost its manifest",
                where=str(path),
                faults=faults,
                advice=f"Restore {MANIFEST_FILE} from a copy: frames were committed here.",
                code="SR-SES-006",
            )
        return NotASession(
            "is not a session", where=str(path), faults=faults, advice=advice, code="SR-SES-001"
        )

    if path.is_file():
        raise no_session()
    where = path / MANIFEST_FILE
    data = read_file(where, limit=MAX_MANIFEST_BYTES, label="manifest", missing=no_session)
    manifest, seal = decode(data, where=str(where))
    consent_seal = UNSEALED_STATE if sealing else check_seal(path, data)
    where = path / JOURNAL_FILE
    journal = read_file(where, limit=MAX_JOURNAL_BYTES, label="journal")
    _require_folder(path / FRAMES_FOLDER)
    if os.path.lexists(path / ATTACHMENTS_FOLDER):  # made with the first attachment
        _require_folder(path / ATTACHMENTS_FOLDER)
    cameras = {step.id: len(step.cameras) for step in manifest.plan.steps}
    walked = walk_journal(journal, seal=seal, where=str(where), cameras=cameras)
    if walked.damage is None:
        walked = _check_against_plan(walked, manifest, str(where))
    return SessionContents(manifest, walked, consent_seal)


def _check_against_plan(walked: JournalWalk, manifest: Manifest, where: str) -> JournalWalk:
    """Record the first line that the plan does not allow: an unknown step, a frame twice."""
    seen: set[str] = set()
    left_out: set[str] = set()
    steps = {step.id: step for step in manifest.plan.steps}
    frames = 0
    for byte, line in walked.lines:
        if isinstance(line, CloseLine):
            got, good, expected = f"{line.frames} frames", line.frames == frames, str(frames)
        elif isinstance(line, AttachmentLine):
            got, good, expected = line.file, line.file not in seen, "each attachment once"
            seen.add(line.file)
        elif isinstance(line, OmissionLine):
            strangers = [step for step in line.steps if step not in steps or step in left_out]
            got, good = ", ".join(strangers), not strangers
            expected = "steps of the plan, each omitted once"
            left_out.update(line.steps)
        else:
            got, good, expected = line.file, line.file not in seen, "each frame once"
            seen.add(line.file)
            frames += 1
            step = steps.get(line.step)
            if step is None:
                got, good, expected = line.step, False, "a step of the plan"
            elif line.step in left_out:
                got, good, expected = line.step, False, "no frame of an omitted step"
            elif line.camera not in step.cameras:
                got, good, expected = line.camera, False, f"one of {', '.join(step.cameras)}"
        if not good:
            damage = SessionDamage(
                "does not fit the plan",
                where=f"{where}, byte {byte}",
                faults=[Fault("line", got, expected)],
                advice="The journal was changed by another program; restore it from a copy.",
            )
            good_lines = tuple(pair for pair in walked.lines if pair[0] < byte)
            return JournalWalk(good_lines, walked.head, byte, 0, damage)
    return walked


def list_files(path: Path) -> list[str]:
    """Return the paths in the folders of frames and attachments, sorted, inside the session."""
    folders = [folder for folder in (FRAMES_FOLDER, ATTACHMENTS_FOLDER) if (path / folder).is_dir()]
    return sorted(f"{folder}/{name}" for folder in folders for name in os.listdir(path / folder))


def unlisted_files(path: Path, contents: SessionContents) -> list[str]:
    """Return the files of frames and attachments without a line in the journal, sorted."""
    known = {line.file for line in contents.file_lines}
    return [file for file in list_files(path) if file not in known]


def find_lost_lines(
    path: Path, contents: SessionContents, unlisted: list[str]
) -> SessionDamage | None:
    """Return the error of an open session whose journal has lost lines, None when it has not.

    One process gives the files of one step their names, and then writes their lines: an
    interruption leaves at most one step's files without lines.
    """
    files = [file for file in unlisted if not file.endswith(".part")]
    if len(files) <= (most := contents.manifest.plan.max_cameras):
        return None
    journal = path / JOURNAL_FILE
    got = f"{len(files)} files without a line, first {files[0]}"
    return SessionDamage(
        "is incomplete: lines are lost",
        where=str(journal),
        faults=[Fault("journal", got, f"at most {most}, after an interruption")],
        advice=f"Restore {JOURNAL_FILE} from a copy; without one, capture a new session.",
        code="SR-SES-014",
    )


def _require_folder(folder: Path) -> None:
    """Raise an error when ``folder`` is missing or is a symbolic link."""
    try:
        plain = stat.S_ISDIR(os.lstat(folder).st_mode)
    except FileNotFoundError:
        plain = False
    if not plain:
        got = "a symbolic link" if folder.is_symlink() else "no folder"
        faults = [Fault(FRAMES_FOLDER, got, "a folder, not a link")]
        advice = "Restore the folder from a copy."
        raise SessionDamage("is damaged", where=str(folder), faults=faults, advice=advice)


def read_undamaged_contents(path: Path) -> SessionContents:
    """Return manifest and journal; damage of the journal is an error."""
    contents = read_contents(path)
    if contents.walk.damage is not None:
        raise contents.walk.damage
    return contents
