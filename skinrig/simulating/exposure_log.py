"""What each exposure of a simulation met, kept beside the session until the truth is written.

The truth needs the state of the world at each exposure, also of exposures before an interruption,
and no session may contain it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

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
    """A scene whose exposures are logged, each with the number of its run.

    Parameters
    ----------
    scene
        What the cameras see.
    path
        The log.
    resume
        Whether the session was begun before.
    captured
        Whether the session has frames already.

    Raises
    ------
    SimulationError
        When frames were captured before and their log is gone.
    """

    lost = "what was captured before"
    """What has no truth without the log."""

    def __init__(self, scene: Any, path: Path, *, resume: bool, captured: bool) -> None:
        super().__init__(path, resume=resume)
        self._scene = scene
        entries = self.read()
        if captured and not entries:
            raise SimulationError(
                f"{path}: is gone, and with it the truth of {self.lost}; simulate the session anew"
            )
        self._run = 1 + max((int(entry["run"]) for entry in entries), default=0)

    @property
    def run_id(self) -> str:
        """Begins the tokens of this run."""
        return f"sim{self._run}"

    def note(self, time_s: float, met: Mapping[str, Any]) -> None:
        """Append what an exposure of this run met."""
        self.add({"run": self._run, "t_s": time_s, **met})
