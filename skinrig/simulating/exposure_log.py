"""Log the world's state at each exposure of a simulation until the ground truth is written.

The ground truth needs these states, also those of exposures before an interruption. They must not
be in a session, so the log is a hidden file next to the folder of the ground truth.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from capture.session import FrameRecord, Session
from skinrig.simulating.orders import SimulationError


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
        path.touch()  # a missing log is a lost one

    def add(self, entry: Mapping[str, Any]) -> None:
        """Append an entry."""
        with self._path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(dict(entry)) + "\n")

    def read(self) -> list[dict[str, Any]]:
        """Return all complete entries, the oldest first."""
        if not self._path.is_file():
            return []
        lines = self._path.read_text(encoding="utf-8").splitlines(keepends=True)
        # an interruption may truncate the last line; the frame of that line was not committed
        return [json.loads(line) for line in lines if line.endswith("}\n")]

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
