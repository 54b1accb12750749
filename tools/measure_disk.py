"""Compare the rates of a session's writing and verification with those of the disk.

    python tools/measure_disk.py FOLDER

FOLDER is on the disk; 0.6 GB are written there, and removed. Each round writes one file, the frames
of a session, and reads them; the page cache is dropped before each reading.
"""

import argparse
import os
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from capture import raw
from capture.plan.dome import dome_plan
from capture.rig import load_rig
from capture.session import Session, SubjectRecord
from capture.session.verification import verify

FRAMES = 96
BLOCK_BYTES = 1 << 22
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


def measure(folder: Path) -> tuple[float, float, float, float]:
    """Return MB/s of a file's and a session's writing, and of files' reading and verification."""
    rig = load_rig("dome")
    lights, views = ([one.name for one in rows[:24]] for rows in (rig.lights, rig.views))
    rig = rig.subset(lights=lights, views=views[:4])
    session = Session.create(
        folder / "session",
        plan=dome_plan(rig),
        rig=rig,
        devices={},
        subject=SUBJECT,
        source="simulated",
        seed=0,
    )
    view, rng = rig.views[0], np.random.default_rng(0)
    shape = view.height_px, view.width_px
    pixels = rng.integers(view.black_level, view.white_level, shape).astype(np.uint16)
    pending = session.pending_frames()[:FRAMES]
    frames = [
        raw.encode_dng(
            pixels,
            pattern=view.cfa,
            black=view.black_level,
            white=view.white_level,
            step_id=step.id,
            session_id=session.id,
        )
        for step, _ in pending
    ]
    size_mb = sum(map(len, frames)) * 1e-6

    def commit() -> None:
        for (step, camera), blob in zip(pending, frames, strict=True):
            settings = dict(step.settings)
            session.commit(step.id, camera, blob, settings=settings, actual={}, t_host_s=0.0)

    count = round(size_mb * 1e6 / BLOCK_BYTES)
    file_s = time_s(lambda: write_file(folder / "file", count))
    commit_s = time_s(commit)
    session.release()
    drop_cache(folder / "session")
    read_s = time_s(lambda: read_files(folder / "session"))
    drop_cache(folder / "session")
    verify_s = time_s(lambda: verify(folder / "session"))
    file_mb = count * BLOCK_BYTES * 1e-6
    return file_mb / file_s, size_mb / commit_s, size_mb / read_s, size_mb / verify_s


def main() -> None:
    """Print the rates of each round, and their medians."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()
    names = ("file written", "session written", "files read", "session verified")
    rounds = []
    for _ in range(given.rounds):
        folder = Path(tempfile.mkdtemp(dir=given.folder))
        try:
            rounds.append(measure(folder))
        finally:
            shutil.rmtree(folder)
        print(", ".join(f"{rate:.0f}" for rate in rounds[-1]), flush=True)
    for name, rates in zip(names, zip(*rounds, strict=True), strict=True):
        print(f"{name}: {statistics.median(rates):.0f} MB/s (median of {given.rounds})")


if __name__ == "__main__":
    main()
