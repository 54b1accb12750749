"""What each exposure of a simulation met, kept beside the session until the truth is written.

The truth needs the state of the world at each exposure, also of exposures before an interruption,
and no session may contain it.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from capture.session import FrameRecord, Session
from skinrig.simulating.orders import SimulationError


class ExposureLog:
    """Entries of a file, a JSON line each.

    Parameters
    ----------
    path
        The log.
    resume
        Whether the session was begun before; else an older log is removed.
    """

    def __init__(self, path: Path, *, resume: bool) -> None:
        self._path = path
        if not resume:
            path.unlink(missing_ok=True)

    def add(self, entry: Mapping[str, Any]) -> None:
        """Append an entry."""
        with self._path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(dict(entry)) + "\n")

    def read(self) -> list[dict[str, Any]]:
        """Return all whole entries, the oldest first."""
        if not self._path.is_file():
            return []
        lines = self._path.read_text(encoding="utf-8").splitlines(keepends=True)
        # a last line may be cut off; its frame was not committed
        return [json.loads(line) for line in lines if line.endswith("}\n")]

    def remove(self) -> None:
        """Remove the log: the truth is written."""
        self._path.unlink(missing_ok=True)


class SceneLog(ExposureLog):
    """A scene that notes what its exposures met, with the number of the run, beside the session.

    Parameters
    ----------
    scene
        What the cameras see.
    truth
        Where the truth will be; the log lies beside it until then.
    resume
        Whether the session was begun before.
    session
        Open.

    Raises
    ------
    SimulationError
        When frames were captured before and their log is gone.
    """

    suffix: ClassVar[str]
    """Of the log's name."""
    kinds: ClassVar[tuple[str, ...]]
    """Of frames whose exposures are logged."""
    max_lag_s: ClassVar[float]
    """Between an entry and the frame that it is of."""
    lost_label: ClassVar[str] = "what was captured before"
    """What has no truth without the log."""

    def __init__(self, scene: Any, truth: Path, *, resume: bool, session: Session) -> None:
        super().__init__(truth.with_name(f".{truth.name}.{self.suffix}.jsonl"), resume=resume)
        self._scene = scene
        entries = self.read()
        if not entries and any(session.frames(kind) for kind in self.kinds):
            raise SimulationError(
                f"{self._path}: is gone, and with it the truth of {self.lost_label}; simulate the "
                "session anew"
            )
        self._run = 1 + max((int(entry["run"]) for entry in entries), default=0)

    @property
    def run_id(self) -> str:
        """Begins the tokens of this run."""
        return f"sim{self._run}"

    def exposure(self, view_name: str, *, pops: Sequence[Any], **exposed: Any) -> Any:
        """Expose the scene, and note what is lit."""
        met = self.describe_exposure(exposed) if pops else None
        if met is not None:
            self.add({"run": self._run, "t_s": pops[0].t_on_s, **met})
        return self._scene.exposure(view_name, pops=pops, **exposed)

    def describe_exposure(self, exposed: Mapping[str, Any]) -> Mapping[str, Any] | None:
        """Return what is noted of an exposure; None: nothing."""
        raise NotImplementedError

    def at(
        self, entries: Sequence[Mapping[str, Any]], run_id: str, record: FrameRecord, label: str
    ) -> Mapping[str, Any]:
        """Return the entry of a frame, of a run."""
        run, time_s = int(run_id.removeprefix("sim")), float(record.line.t_box_s or 0.0)
        for entry in entries:
            if entry["run"] == run and abs(entry["t_s"] - time_s) < self.max_lag_s:
                return entry
        raise SimulationError(f"{self._path}: tells nothing of the {label}")
