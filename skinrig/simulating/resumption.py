"""Resume a simulated session by replaying its run from the first step.

A resumed simulation runs the whole plan again in a new world of the same seed. Clocks, controllers
and skin therefore reach the state that they had at the interruption. Frames of the session are
read, not computed; each journal line is compared with the recorded one. New lines are those of an
undisturbed run, byte for byte.
"""

from __future__ import annotations

import json
import shutil
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xxhash

from capture import raw
from capture.session import Session, SubjectRecord
from capture.session.contents import (
    JOURNAL_FILE,
    MANIFEST_FILE,
    MAX_JOURNAL_BYTES,
    MAX_MANIFEST_BYTES,
    ORPHANS_FOLDER,
    SessionContents,
)
from capture.session.disk import Blob, Disk, read_file
from capture.session.journal import AttachmentLine, FrameLine, seal_bounded_line
from capture.session.manifest import decode
from capture.session.view import check_file
from rigsim.arrays import UInt16Array
from rigsim.world import World
from skinrig.simulating.exposure_log import repair_lines
from skinrig.simulating.orders import SimulationError, SimulationResult

LOG_FILE = "exposures.jsonl"
DIGEST_BYTES = 32
"""Length of the digest before a stored image."""


def exposures_folder(session: Path) -> Path:
    """Return the hidden folder, next to a session, of its exposures until the session is closed.

    Examples
    --------
    >>> str(exposures_folder(Path("data/session-flash")))
    'data/.session-flash.exposures'
    """
    return session.with_name(f".{session.name}.exposures")


class ExposureStore:
    """Images of exposures by camera and seed: those not yet committed, and the files of others.

    An image is written before its frame is committed and removed afterwards, so that a killed
    simulation computes at most one exposure twice. Nothing is flushed to the medium: after a power
    cut, images that are missing or damaged are computed again.

    Parameters
    ----------
    folder
        Folder of the store; made when it is missing.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[str, str] = {}
        self._keys: dict[str, str] = {}
        folder.mkdir(mode=0o700, exist_ok=True)
        # an interruption may cut the last line; its image is still there
        for entry in repair_lines(folder / LOG_FILE):
            self._files[str(entry["exposure"])] = str(entry["file"])

    @staticmethod
    def key(view_name: str, seed: int) -> str:
        """Return the name of an exposure."""
        return f"{view_name}-{seed:016x}"

    def find(self, key: str, session: ReplayedSession) -> UInt16Array | None:
        """Return the image of an earlier exposure, (H, W) uint16; None when it is unknown."""
        image = self._load(key)
        if image is None and (file := self._files.get(key)) is not None:
            image = session.read_recorded(file)
        if image is not None:
            self._keys[_digest(image)] = key
        return image

    def _load(self, key: str) -> UInt16Array | None:
        """Return a stored image; None when there is none, or when it is damaged."""
        path = self._folder / f"{key}.npy"
        try:
            with path.open("rb") as stream:
                digest = stream.read(DIGEST_BYTES).decode("ascii")
                image: UInt16Array = np.load(stream, allow_pickle=False)
        except (OSError, EOFError, ValueError):
            image, digest = np.zeros(0, np.uint16), ""
        if digest == _digest(image):
            return image
        path.unlink(missing_ok=True)
        return None

    def add(self, key: str, image: UInt16Array) -> None:
        """Store an image until it is committed."""
        path, digest = self._folder / f"{key}.npy", _digest(image)
        part = path.with_suffix(".part")
        with part.open("wb") as stream:
            stream.write(digest.encode("ascii"))
            np.save(stream, image, allow_pickle=False)
        part.rename(path)
        self._keys[digest] = key

    def note_commit(self, file: str, blob: Blob) -> None:
        """Record the file of a committed image, and remove the image from the store."""
        key = self._keys.pop(_digest(raw.decode(memoryview(blob), where=file).cfa), None)
        if key is None:
            return
        if self._files.get(key) != file:
            self._files[key] = file
            with (self._folder / LOG_FILE).open("a", encoding="utf-8") as stream:
                stream.write(json.dumps({"exposure": key, "file": file}) + "\n")
        (self._folder / f"{key}.npy").unlink(missing_ok=True)

    def clear(self) -> None:
        """Forget all images."""
        self._files.clear()
        for path in self._folder.iterdir():
            path.unlink()

    def remove(self) -> None:
        """Remove the store."""
        shutil.rmtree(self._folder, ignore_errors=True)


def _digest(image: UInt16Array) -> str:
    return xxhash.xxh3_128_hexdigest(np.ascontiguousarray(image).data)


class ReplayedSession(Session):
    """A session open for writing that has no frame until its recorded lines are replayed.

    Lines that are written again must equal the recorded ones; later lines are new.

    Attributes
    ----------
    exposures : ExposureStore
        Images of exposures.
    """

    def __init__(
        self, path: Path, contents: SessionContents, *, disk: Disk, descriptor: int | None
    ) -> None:
        manifest = read_file(path / MANIFEST_FILE, limit=MAX_MANIFEST_BYTES, label="manifest")
        journal = read_file(path / JOURNAL_FILE, limit=MAX_JOURNAL_BYTES, label="journal")
        recorded = journal[: contents.walk.end].splitlines(keepends=True)
        self._recorded = deque(recorded)
        self._recorded_files = {line.file: line for line in contents.file_lines}
        start = replace(contents.walk, lines=(), head=decode(manifest, where=str(path))[1])
        super().__init__(
            path, SessionContents(contents.manifest, start), disk=disk, descriptor=descriptor
        )
        self.exposures = ExposureStore(exposures_folder(path))
        for orphan in (path / ORPHANS_FOLDER).iterdir():  # never acknowledged: they come again
            orphan.unlink()

    @property
    def recorded_count(self) -> int:
        """Number of recorded lines that are not replayed yet."""
        return len(self._recorded)

    def read_recorded(self, file: str) -> UInt16Array | None:
        """Return the pixels of a recorded file, (H, W) uint16; None when there is none.

        Raises
        ------
        SessionDamage
            When the file differs from what was committed.
        """
        line = self._recorded_files.get(file)
        if line is None:
            return None
        blob = check_file(self.path / file, line)
        return raw.decode(memoryview(blob), where=str(self.path / file)).cfa

    def close(self, *, missing_reason: str = "") -> None:
        """Close the session for good, and remove its exposures."""
        super().close(missing_reason=missing_reason)
        self.exposures.remove()

    def _write(
        self, descriptor: int, files: Iterable[tuple[FrameLine | AttachmentLine, Blob]]
    ) -> None:
        written: list[tuple[FrameLine | AttachmentLine, Blob]] = []

        def note() -> Iterator[tuple[FrameLine | AttachmentLine, Blob]]:
            for file in files:
                written.append(file)
                yield file

        fresh = note()
        while self._recorded and (file := next(fresh, None)) is not None:
            # an interruption may have recorded the first lines alone
            text, head = seal_bounded_line(self._head, file[0])
            self._replay(text)
            self._head = head
            self._add_line(file[0])
        super()._write(descriptor, fresh)
        for line, blob in written:
            if isinstance(line, FrameLine) or "camera" in line.about:
                self.exposures.note_commit(line.file, blob)

    def _append(self, descriptor: int, text: bytes) -> None:
        # lines of frames and attachments were compared before their files were written
        if not self._replay(text):
            super()._append(descriptor, text)

    def _replay(self, text: bytes) -> bool:
        """Compare a line with the next recorded one; return False when none is left."""
        if not self._recorded:
            return False
        recorded = self._recorded.popleft()
        if text == recorded:
            return True
        raise SimulationError(
            f"{self.path}: cannot be resumed: the simulation gives another line "
            f"{text[:200].decode(errors='replace')} than {recorded[:200].decode(errors='replace')} "
            "of the journal; another version or machine began it: simulate a new session "
            "[SR-SIM-008]"
        )


class ReplayedWorld(World):
    """A world whose cameras return the images of earlier exposures.

    Parameters
    ----------
    session
        Session open for writing, with its store.
    """

    def __init__(self, *args: Any, session: ReplayedSession, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self._session = session

    def expose(self, view_name: str, *args: Any, seed: int, **light: Any) -> UInt16Array:
        """Return the DN of an exposure, read where it was computed before."""
        store = self._session.exposures
        key = store.key(view_name, seed)
        image = store.find(key, self._session)
        if image is None:
            image = super().expose(view_name, *args, seed=seed, **light)
            store.add(key, image)
        return image


class SessionComplete(Exception):
    """Raised when a resumed simulation lacks neither frames nor ground truth.

    Attributes
    ----------
    result : SimulationResult
        Result of the simulation.
    """

    def __init__(self, result: SimulationResult) -> None:
        super().__init__(result)
        self.result = result


_MAX_SHOWN_CHARACTERS = 60
"""Maximum number of characters of a value in a message."""


def describe_differences(
    recorded: Mapping[str, Any], requested: Mapping[str, Any], *, of: str = ""
) -> tuple[str, ...]:
    """Describe the differences between two settings, one line each.

    Parameters
    ----------
    recorded, requested
        JSON values by name, of a session's manifest and of an order. A changed file, a record with
        ``file`` and ``sha256``, is reported by its name if that is the same.
    of
        Name of the parent setting, for nested settings.

    Examples
    --------
    >>> describe_differences({"width_px": 64, "mesh": ""}, {"width_px": 96, "mesh": "",
    ...     "nearer_mm": 5.0})
    ('width_px: recorded with 64, got 96', 'nearer_mm: recorded without, got 5.0')
    >>> describe_differences({"map": {"file": "m.npy", "sha256": "a"}},
    ...             {"map": {"file": "m.npy", "sha256": "b"}}, of="subject")
    ('subject map: the file m.npy has changed since',)
    """
    lines: list[str] = []
    for key in dict.fromkeys((*recorded, *requested)):
        name = f"{of} {key}" if of else key
        was, now = recorded.get(key), requested.get(key)
        if was == now and (key in recorded) == (key in requested):
            continue
        if isinstance(was, Mapping) and isinstance(now, Mapping) and key != "plan":
            if "sha256" in was and was.get("file") == now.get("file"):
                lines.append(f"{name}: the file {was['file']} has changed since")
            else:
                file = was.get("file")
                same = file is not None and file == now.get("file")
                lines += describe_differences(was, now, of=f"{name} {file}" if same else name)
        elif key == "plan" and was and now:
            lines.append(f"{name}: recorded with {_shorten_value(was)}, got another")
        else:
            old = f"with {_shorten_value(was)}" if key in recorded else "without"
            new = _shorten_value(now) if key in requested else "none"
            lines.append(f"{name}: recorded {old}, got {new}")
    return tuple(lines)


def list_refusals(
    session: Session, requested: Mapping[str, Any], seed: int, person: SubjectRecord | None
) -> tuple[str, ...]:
    """List the reasons why a session cannot be resumed as requested, one line each.

    Parameters
    ----------
    session
        Session to resume; one that is not of a simulation is a reason, too.
    requested
        Settings of the simulation.
    seed
        Seed of subject, sensor and controllers.
    person
        Pseudonym and consent; None: those of the session.
    """
    recorded = session.manifest.extra.get("simulation")
    if not isinstance(recorded, Mapping):
        return ("it was not created by a simulation",)
    lines = list(
        describe_differences({**recorded, "seed": session.seed}, {**requested, "seed": seed})
    )
    if person is not None:
        lines += describe_differences(
            _consent_record(session.manifest.subject), _consent_record(person)
        )
    return tuple(lines)


def count_shots(session: Session) -> Mapping[str, int]:
    """Count the shots that each camera has made for a session, as far as they were recorded.

    The number of the shot seeds the noise of a simulated frame. A new world that resumes a session
    must not restart at 0: later frames would repeat the noise of earlier ones, and the noise of
    their averages would exceed its stated standard error.

    Parameters
    ----------
    session
        Session before it is resumed.

    Returns
    -------
    mapping
        Shots by name of the view; 0 for a view without any.

    Notes
    -----
    A step counts once per attempt that all its cameras recorded, and once per failed attempt. Steps
    that an interruption left incomplete are shot again by all their cameras with the old number. A
    resumed session then has the same pixels as an uninterrupted one, if the same shots are made.
    With a caliper they are not, because skin is taped and imaged again: images of newly taped skin
    and omitted steps are counted too, so that no number occurs twice.
    """
    counts: defaultdict[str, int] = defaultdict(int)
    attempts: defaultdict[str, dict[str, int]] = defaultdict(dict)
    tries: defaultdict[str, int] = defaultdict(int)
    for record in session.frames():
        attempts[record.step_id][record.camera] = record.attempt
        tries[record.step_id] = max(tries[record.step_id], int(record.actual.get("tries", 1)))
    skin_left_out = session.omitted_steps() if session.rig.caliper is not None else {}
    for step in session.plan.steps:
        kept = min(attempts[step.id].get(name, 0) for name in step.cameras)
        shots = kept + max(tries[step.id] - 1, 0) if kept else 0
        for name in step.cameras:
            counts[name] += shots + (step.id in skin_left_out)
    for name in session.attachments():
        camera = session.attachment_line(name).about.get("camera")
        if camera is not None:
            counts[str(camera)] += 1
    return counts


def _consent_record(person: SubjectRecord) -> dict[str, Any]:
    """Return pseudonym and consent for a comparison; uses are sorted, as their order is free."""
    day = person.consent_expires
    return {
        "pseudonym": person.pseudonym,
        "consent": ", ".join(sorted(person.consent_scope)) or "nothing",
        "consent_expires": "no end" if day is None else day.isoformat(),
    }


def _shorten_value(value: Any) -> str:
    """Format a value for a message: files by name, lists by their members, long texts cut."""
    if isinstance(value, Mapping) and "file" in value:
        return str(value["file"])
    if isinstance(value, Mapping) and "steps" in value:
        return f"a plan of {len(value['steps'])} steps"
    if isinstance(value, list | tuple) and all(isinstance(one, str) for one in value):
        text = ", ".join(value) or "none"
    else:
        text = value if isinstance(value, str) and value else repr(value)
    return text if len(text) <= _MAX_SHOWN_CHARACTERS else text[: _MAX_SHOWN_CHARACTERS - 3] + "..."
