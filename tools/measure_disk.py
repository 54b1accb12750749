"""Compare the rates of a session's writing and verification with those of the disk.

    python tools/measure_disk.py FOLDER

FOLDER is on the disk; 1.3 GB are written there per round, and removed. Each round writes a file,
sessions as a capture does it, and a second file in between: steps of 16 cameras, the same with
frames that were encoded before, and steps of one camera. It then reads the first session; the page
cache is dropped before each reading.
"""

import argparse
import os
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np

from capture.acquire.outcome import CaptureRun, Operator
from capture.devices.camera import Camera, CameraInfo, Exposure, Frame
from capture.plan.dome import dome_plan
from capture.rig import load_rig
from capture.session import NewFrame, Session, SubjectRecord
from capture.session.verification import verify

FRAMES = 96
BLOCK_BYTES = 1 << 22
FILE_BLOCKS = 62
"""About the size of the frames."""
SUBJECT = SubjectRecord("P1", ("research",))


def time_s(work: Callable[[], object]) -> float:
    """Return the seconds of a function."""
    begun_s = time.perf_counter()
    work()
    return time.perf_counter() - begun_s


def write_file(path: Path, count: int) -> None:
    """Write random bytes, and flush them to the medium."""
    block = os.urandom(BLOCK_BYTES)
    with path.open("wb", buffering=0) as file:
        for _ in range(count):
            file.write(block)
        os.fdatasync(file.fileno())


def drop_cache(folder: Path) -> None:
    """Drop the cached pages of a folder's files."""
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def read_files(folder: Path) -> None:
    """Read a folder's files."""
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            with path.open("rb", buffering=0) as file:
                while file.read(BLOCK_BYTES):
                    pass


class EncodedAhead(Session):
    """A session that keeps steps until `write`, so that encoding does not count."""

    steps: list[tuple[str, list[NewFrame]]]

    def commit_step(self, step_id: str, frames: Iterable[NewFrame]) -> None:
        """Keep the frames of a step; their memory is used again."""
        kept = [replace(frame, blob=bytes(frame.blob)) for frame in frames]
        self.steps.append((step_id, kept))

    def write(self) -> None:
        """Commit the steps; see `Session.commit_step`."""
        for step_id, frames in self.steps:
            super().commit_step(step_id, frames)


def write_session(path: Path, n_cameras: int, *, is_encoded: bool = False) -> tuple[float, float]:
    """Write a session of `FRAMES` frames, a step at a time; return its MB and its MB/s."""
    rig = load_rig("dome")
    rig = rig.subset(views=[view.name for view in rig.views[:n_cameras]])
    view, rng = rig.views[0], np.random.default_rng(0)
    shape = view.height_px, view.width_px
    pixels = rng.integers(view.black_level, view.white_level, shape).astype(np.uint16)
    levels = (float(view.black_level),) * 4, view.white_level
    info = CameraInfo(view.serial, "camera", *shape[::-1], view.cfa, *levels, triggers=())
    camera = cast(Camera, SimpleNamespace(info=info))
    session = (EncodedAhead if is_encoded else Session).create(
        path, plan=dome_plan(rig), rig=rig, devices={}, subject=SUBJECT, source="simulated", seed=0
    )
    cameras = {view.name: camera for view in rig.views}
    run = CaptureRun(session.plan, rig, cameras, session, Operator())
    frame = Frame(view.serial, 0, 0.0, 0.06, Exposure(0.06, 100), pixels)

    def commit() -> None:
        for step in run.pending_steps()[: FRAMES // n_cameras]:
            frames = dict.fromkeys(step.cameras, frame)
            light = {"light": str(step.settings.get("light", "several"))}
            run.commit_frames(
                step, frames, light=light, tries=1, t_box_s=0.0, journal_entries=light
            )

    if isinstance(session, EncodedAhead):
        session.steps = []
        commit()
        commit_s = time_s(session.write)
    else:
        commit_s = time_s(commit)
    session.release()
    size_mb = sum(record.line.bytes for record in session.frames()) * 1e-6
    return size_mb, size_mb / commit_s


def measure(folder: Path) -> tuple[float, ...]:
    """Return MB/s of a file's and sessions' writing, and of files' reading and verification."""
    file_mb = FILE_BLOCKS * BLOCK_BYTES * 1e-6
    before_s = time_s(lambda: write_file(folder / "before", FILE_BLOCKS))
    size_mb, several = write_session(folder / "session", 16)
    _, encoded = write_session(folder / "encoded", 16, is_encoded=True)
    after_s = time_s(lambda: write_file(folder / "after", FILE_BLOCKS))
    _, one = write_session(folder / "one", 1)
    drop_cache(folder / "session")
    read_s = time_s(lambda: read_files(folder / "session"))
    drop_cache(folder / "session")
    verify_s = time_s(lambda: verify(folder / "session"))
    file_rate = 2.0 * file_mb / (before_s + after_s)
    return file_rate, encoded, several, one, size_mb / read_s, size_mb / verify_s


def main() -> None:
    """Print the rates of each round, and their medians."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()
    names = (
        *("file written", "16 cameras, encoded before", "16 cameras", "1 camera"),
        *("files read", "session verified"),
    )
    rounds = []
    for _ in range(given.rounds):
        folder = Path(tempfile.mkdtemp(dir=given.folder))
        try:
            rounds.append(measure(folder))
        finally:
            shutil.rmtree(folder)
        print(", ".join(f"{rate:.0f}" for rate in rounds[-1]), flush=True)
    for place, name in enumerate(names):
        rates = [one[place] for one in rounds]
        shares = [one[place] / one[0] for one in rounds]
        print(
            f"{name}: {statistics.median(rates):.0f} MB/s ({min(rates):.0f} to {max(rates):.0f}), "
            f"{statistics.median(shares):.2f} of the file written in the same round"
        )


if __name__ == "__main__":
    main()
