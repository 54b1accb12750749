"""Resume a simulated session by replaying its run from the first step.

A resumed simulation runs the whole plan again in a new world of the same seed. Clocks, controllers
and skin therefore reach the state that they had at the interruption. Frames of the session are
read, not computed; each journal line is compared with the recorded one. New lines are those of an
undisturbed run, byte for byte.
"""

from __future__ import annotations

import json
import shutil
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xxhash

from capture import raw
from capture.session import Session
from capture.session.contents import (
    JOURNAL_FILE,
    MANIFEST_FILE,
    MAX_JOURNAL_BYTES,
    MAX_MANIFEST_BYTES,
    ORPHANS_FOLDER,
    SessionContents,
)
from capture.session.disk import Disk, read_file
from capture.session.journal import AttachmentLine, FrameLine, seal_bounded_line
from capture.session.manifest import decode
from capture.session.view import check_file
from rigsim.arrays import UInt16Array
from rigsim.world import World
from skinrig.simulating.orders import SimulationError

LOG_FILE = "exposures.jsonl"


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
    cut, missing images are computed again.

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
        log = folder / LOG_FILE
        lines = log.read_text(encoding="utf-8").splitlines(keepends=True) if log.is_file() else []
        # an interruption may truncate the last line; its image is still there
        for entry in (json.loads(line) for line in lines if line.endswith("}\n")):
            self._files[entry["exposure"]] = entry["file"]

    @staticmethod
    def key(view_name: str, seed: int) -> str:
        """Return the name of an exposure."""
        return f"{view_name}-{seed:016x}"

    def find(self, key: str, session: ReplayedSession) -> UInt16Array | None:
        """Return the image of an earlier exposure, (H, W) uint16; None when it is unknown."""
        path = self._folder / f"{key}.npy"
        image: UInt16Array | None = None
        if path.is_file():
            image = np.load(path, allow_pickle=False)
        elif (file := self._files.get(key)) is not None:
            image = session.read_recorded(file)
        if image is not None:
            self._keys[_digest(image)] = key
        return image

    def add(self, key: str, image: UInt16Array) -> None:
        """Store an image until it is committed."""
        path = self._folder / f"{key}.npy"
        part = path.with_suffix(".part")
        with part.open("wb") as stream:
            np.save(stream, image, allow_pickle=False)
        part.rename(path)
        self._keys[_digest(image)] = key

    def note_commit(self, file: str, blob: bytes) -> None:
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

    def _write(self, descriptor: int, line: FrameLine | AttachmentLine, blob: bytes) -> None:
        text, head = seal_bounded_line(self._head, line)
        if self._replay(text):
            self._head = head
        else:
            super()._write(descriptor, line, blob)
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
