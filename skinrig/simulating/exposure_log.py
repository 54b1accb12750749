"""Log the world's state at each exposure of a simulation until the ground truth is written.

The ground truth needs these states, also those of exposures before an interruption. They must not
be in a session, so the log is a hidden file next to the folder of the ground truth.
"""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from capture.session import FrameRecord, Session
from skinrig.simulating.orders import SimulationError


def repair_lines(path: Path) -> list[dict[str, Any]]:
    r"""Return the documents of a log, one per line, and cut off what an interruption left.

    The first line that is not a complete document ends the log.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     log = Path(folder) / "log.jsonl"
    ...     _ = log.write_bytes(b'{"a": 1}\n{"a":')
    ...     repair_lines(log), log.read_bytes()
    ([{'a': 1}], b'{"a": 1}\n')
    """
    text = path.read_bytes() if path.is_file() else b""
    found: list[dict[str, Any]] = []
    end = 0
    for line in text.splitlines(keepends=True):
        try:
            entry = json.loads(line) if line.endswith(b"}\n") else None
        except ValueError:
            entry = None
        if not isinstance(entry, dict):
            os.truncate(path, end)
            break
        found.append(entry)
        end += len(line)
    return found


class ExposureLog:
    """Log file with one JSON document per line.

    Parameters
    ----------
    path
        File of the log.
    resume
        Whether the session is resumed; otherwise an older log is removed.
    """

    def __init__(self, path: Path, *, resume: bool) -> None:
        self._path = path
        if not resume:
            path.unlink(missing_ok=True)
        repair_lines(path)
        path.touch()  # a missing log is a lost one

    def add(self, entry: Mapping[str, Any]) -> None:
        """Append an entry, and flush it to the medium: its frame is committed later."""
        with self._path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(dict(entry)) + "\n")
            stream.flush()
            os.fsync(stream.fileno())

    def read(self) -> list[dict[str, Any]]:
        """Return all complete entries, the oldest first."""
        return repair_lines(self._path)

    def remove(self) -> None:
        """Remove the log, after the ground truth was written."""
        self._path.unlink(missing_ok=True)


class SceneLog(ExposureLog):
    """Scene wrapper that logs the world's state at each exposure.

    A resumed simulation replays the run, so that an entry may occur twice, with equal values.

    Parameters
    ----------
    scene
        Scene in front of the cameras.
    truth
        Folder of the ground truth; the log is a hidden file next to it.
    resume
        Whether the session is resumed.
    session
        Open session.

    Raises
    ------
    SimulationError
        If the session has frames but their log is missing.
    """

    suffix: ClassVar[str]
    """Suffix of the log's name."""
    kinds: ClassVar[tuple[str, ...]]
    """Kinds of frames whose exposures are logged."""
    max_lag_s: ClassVar[float]
    """Maximum time between an entry and its frame, s."""
    lost_label: ClassVar[str] = "the frames captured before"
    """Frames that have no ground truth without the log, for messages."""

    def __init__(self, scene: Any, truth: Path, *, resume: bool, session: Session) -> None:
        super().__init__(self.path_of(truth), resume=resume)
        self._scene = scene
        entries = self.read()
        if not entries and any(session.frames(kind) for kind in self.kinds):
            raise SimulationError(
                f"{self._path}: is missing, so the ground truth of {self.lost_label} is lost; "
                "simulate a new session"
            )

    @classmethod
    def path_of(cls, truth: Path) -> Path:
        """Return the path of the log of a ground truth's folder."""
        return truth.with_name(f".{truth.name}.{cls.suffix}.jsonl")

    def exposure(self, view_name: str, *, pops: Sequence[Any], **exposed: Any) -> Any:
        """Expose the scene; log the state if a light was on."""
        state = self.describe_exposure(exposed) if pops else None
        if state is not None:
            self.add({"t_s": pops[0].t_on_s, **state})
        return self._scene.exposure(view_name, pops=pops, **exposed)

    def describe_exposure(self, exposed: Mapping[str, Any]) -> Mapping[str, Any] | None:
        """Return the state to log for an exposure; None: nothing is logged."""
        raise NotImplementedError

    def at(
        self, entries: Sequence[Mapping[str, Any]], record: FrameRecord, label: str
    ) -> Mapping[str, Any]:
        """Return the entry of a frame.

        Raises
        ------
        SimulationError
            If the log has no entry within `max_lag_s` of the frame.
        """
        time_s = float(record.line.t_box_s or 0.0)
        for entry in entries:
            if abs(entry["t_s"] - time_s) < self.max_lag_s:
                return entry
        raise SimulationError(f"{self._path}: has no entry for {label}; simulate a new session")
