"""Keep finished stages and tiles of a run in a work folder, and take them up in the next run.

Each file is named by a hash of all that its content depends on: inputs, calibrations, options,
versions, code, and the stage. Another input or option has other names. The folder is removed when
the maps are written.

Storing costs at most `MAX_COST` of the run's seconds. Products that would cost more are computed
again, as are those of a type that the files do not take.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Final, TypeVar

from reconstruction.pipeline.library_versions import list_library_versions
from reconstruction.pipeline.product_file import (
    PRODUCT_PACKAGES,
    DamagedFileError,
    UnstorableError,
    estimate_bytes,
    read_product,
    write_product,
)
from reconstruction.tiles import map_tiles, open_worker_pool

Result = TypeVar("Result")

MAX_COST: Final = 0.03
"""Largest fraction of a run's seconds that storing takes."""
BYTES_PER_S: Final = 2.5e8
"""Assumed rate of storing before the first file is written, with checksum."""
FILE_S: Final = 1e-3
"""Seconds to make a file."""
_LOCK_FILE: Final = "lock"
_RUN_FILE: Final = "run"
_SCRATCH_SUFFIX: Final = ".scratch"


class BusyError(ValueError):
    """Another process computes the same maps."""


@cache
def code_digest(packages: tuple[str, ...] = PRODUCT_PACKAGES) -> str:
    """Hash the code and data of packages, by default those of maps, and the libraries' versions."""
    digest = hashlib.sha256()
    for name, version in list_library_versions().items():
        digest.update(f"{name} {version}\0".encode())
    for package in packages:
        root = Path(str(resources.files(package)))
        for path in sorted(root.rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                content = hashlib.sha256(path.read_bytes()).hexdigest()
                digest.update(f"{package}/{path.relative_to(root)} {content}\0".encode())
    return digest.hexdigest()


def work_folder(out: Path) -> Path:
    """Return the work folder of an output folder.

    Examples
    --------
    >>> work_folder(Path("maps/face")).as_posix()
    'maps/.face.work'
    """
    return out.with_name(f".{out.name}.work")


@dataclass(slots=True)
class RunRecord:
    """Lines and entries that stages add to the record of a run."""

    assumed: list[str]
    noted: dict[str, Any]
    hashes: dict[str, str]

    def copy(self) -> RunRecord:
        """Return an independent copy."""
        return RunRecord(list(self.assumed), dict(self.noted), dict(self.hashes))

    def additions_since(self, before: RunRecord) -> list[Any]:
        """Return new lines of ``assumed``, and new or changed entries."""
        changed = [
            {name: value for name, value in own.items() if name not in old or old[name] != value}
            for own, old in ((self.noted, before.noted), (self.hashes, before.hashes))
        ]
        return [self.assumed[len(before.assumed) :], *changed]

    def add(self, assumed: list[str], noted: dict[str, Any], hashes: dict[str, str]) -> None:
        """Add what `additions_since` returned."""
        self.assumed += assumed
        self.noted |= noted
        self.hashes |= hashes

    def restore(self, before: RunRecord) -> None:
        """Return to a copy."""
        self.assumed[:] = before.assumed
        for own, old in ((self.noted, before.noted), (self.hashes, before.hashes)):
            own.clear()
            own.update(old)


@dataclass(slots=True)
class Checkpoints:
    """Finished stages and tiles of one run.

    Attributes
    ----------
    folder
        Work folder; made and locked when the first stage is computed.
    identity
        Hash of everything that the run's stages depend on.
    record
        Lists and mappings that the stages extend.
    max_cost
        See `MAX_COST`.
    """

    folder: Path
    identity: str
    record: RunRecord
    max_cost: float = MAX_COST
    _started_s: float = field(default_factory=time.perf_counter)
    _spent_s: float = 0.0
    _stored_bytes: float = 0.0
    _stage: str = ""
    _lock: int | None = None
    _new_folders: list[Path] = field(default_factory=list)

    @classmethod
    @contextmanager
    def of_output(
        cls, out: Path, depends_on: Mapping[str, Any], record: RunRecord
    ) -> Iterator[Checkpoints]:
        """Yield the checkpoints of an output folder; remove them unless the block is interrupted.

        Parameters
        ----------
        out
            Folder of the maps.
        depends_on
            Inputs and options, as JSON values.
        record
            See `Checkpoints`.

        Raises
        ------
        BusyError
            When another process has locked the work folder.
        """
        text = json.dumps([depends_on, code_digest()], sort_keys=True)
        found = cls(work_folder(out), hashlib.sha256(text.encode()).hexdigest(), record)
        if found.folder.is_dir():
            found._open()
        try:
            yield found
        except (OSError, MemoryError):  # of the machine: the same command can succeed later
            raise
        except Exception:
            found.remove()
            raise
        else:
            found.remove()
        finally:
            found._close()

    def recall(self, key: str) -> bool:
        """Add what a finished stage recorded; False if the stage is not finished.

        Parameters
        ----------
        key
            Input hash of the stage, see `reconstruction.pipeline.graph.input_hashes`.
        """
        found = self._read("record", key)
        if found is None:
            return False
        self.record.add(*found)
        return True

    def load(self, key: str) -> Mapping[str, Any] | None:
        """Return the stored products of a stage by name, or None."""
        found: Mapping[str, Any] | None = self._read("products", key)
        return found

    def compute(self, key: str, run: Callable[[], Mapping[str, Any]]) -> Mapping[str, Any]:
        """Run a stage, and store its products and what it recorded.

        Raises
        ------
        BusyError
            When another process has locked the work folder.
        """
        self._lock_early()
        before = self.record.copy()
        self._stage = key
        made = run()
        self._store("products", key, made)
        # the record comes last: it marks the stage as finished
        self._store("record", key, self.record.additions_since(before))
        return made

    def compute_again(self, key: str, run: Callable[[], Mapping[str, Any]]) -> Mapping[str, Any]:
        """Run a finished stage whose products were not stored; record nothing twice."""
        self._lock_early()
        before = self.record.copy()
        self._stage = key
        try:
            return run()
        finally:
            self.record.restore(before)

    def load_tile(self, name: str) -> tuple[Any] | None:
        """Return the result of a tile of the stage that runs, or None if it is not stored."""
        found = self._read("tile", self._stage, name)
        return None if found is None else (found[0],)

    def store_tile(self, name: str, made: Any) -> None:
        """Store the result of a tile of the stage that runs, by its name within the stage."""
        self._store("tile", self._stage, [made], name)

    def scratch_folder(self, name: str) -> Path:
        """Return a folder for tables of the stage that runs, with those of an interrupted run."""
        self._open()
        folder = self._path("scratch", self._stage, name).with_suffix(_SCRATCH_SUFFIX)
        folder.mkdir(exist_ok=True)
        return folder

    def remove(self) -> None:
        """Remove the work folder and unfinished maps of killed runs, if this run has the lock."""
        if self._lock is None:
            return
        unfinished = re.compile(re.escape(self.folder.stem) + r"\.[0-9a-f]{32}\.part")
        for path in self.folder.parent.iterdir():
            if unfinished.fullmatch(path.name):
                shutil.rmtree(path, ignore_errors=True)
        # the lock comes last: until then, no other process takes the folder
        for path in self.folder.iterdir():
            if path.name != _LOCK_FILE:
                _remove_path(path)
        _remove_path(self.folder / _LOCK_FILE)
        for made in (self.folder, *self._new_folders):
            with suppress(OSError):  # contains the maps, or files of a run that waited for the lock
                made.rmdir()

    def _path(self, *parts: str) -> Path:
        text = "\0".join((self.identity, *parts))
        return self.folder / f"{hashlib.sha256(text.encode()).hexdigest()}.npz"

    def _read(self, *parts: str) -> Any:
        path = self._path(*parts)
        if self._lock is None or not path.is_file():
            return None
        try:
            return read_product(path)
        except DamagedFileError:  # cut by a power failure: compute again
            path.unlink(missing_ok=True)
            return None

    def _store(self, kind: str, key: str, value: Any, *parts: str) -> None:
        """Store a value unless its cost exceeds the limit, or the disk is full."""
        start = time.perf_counter()
        try:
            size = estimate_bytes(value)
            known = self._stored_bytes > 0 and self._spent_s > 0.1
            rate = self._stored_bytes / self._spent_s if known else BYTES_PER_S
            cost = self._spent_s + FILE_S + size / rate
            # a record is a few bytes, without which nothing of the stage is taken up
            if kind == "record" or cost <= self.max_cost * (start - self._started_s):
                self._open()
                self._stored_bytes += write_product(self._path(kind, key, *parts), value)
        except UnstorableError:
            pass
        except OSError:
            self.max_cost = -1.0  # the maps themselves will fail with the reason
        self._spent_s += time.perf_counter() - start

    def _open(self) -> None:
        """Make and lock the folder, and remove the files of other runs."""
        if self._lock is not None:
            return
        self._new_folders = [p for p in self.folder.absolute().parents if not p.exists()]
        while self._lock is None:
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            self._lock = _lock_folder(self.folder)
        run = self.folder / _RUN_FILE
        if not run.is_file() or run.read_text() != self.identity:
            for path in self.folder.iterdir():
                if path.suffix in (".npz", ".part"):
                    path.unlink()
                elif path.suffix == _SCRATCH_SUFFIX:
                    shutil.rmtree(path)
            run.write_text(self.identity)

    def _lock_early(self) -> None:
        with suppress(OSError):  # without locks or space: the maps themselves fail, or need neither
            self._open()

    def _close(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def _lock_folder(folder: Path) -> int | None:
    """Make a folder; return its open and locked file, None if another run removed it meanwhile."""
    path = folder / _LOCK_FILE
    folder.mkdir(mode=0o700, exist_ok=True)
    try:
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # the run that held the lock may have removed this file after it was opened here
        if os.path.samestat(os.fstat(lock), os.stat(path)):
            return lock
    except FileNotFoundError:
        pass
    except BlockingIOError:
        os.close(lock)
        raise BusyError(
            f"{folder}: another skinrig process computes these maps, expected none; wait until it "
            "ends, or name another folder"
        ) from None
    except OSError:
        os.close(lock)
        raise
    os.close(lock)
    return None


def _remove_path(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def compute_tiles(
    checkpoints: Checkpoints | None,
    stage: str,
    tiles: Sequence[Any],
    compute: Callable[[Any], Result],
    report: Callable[[str, int, int], None],
    *,
    workers: int = 1,
) -> Iterator[Result]:
    """Yield the result of each tile in order, taken from the checkpoints where it is stored.

    Parameters
    ----------
    checkpoints
        None: nothing is stored.
    stage
        Name of this pass over the tiles, unique within the stage.
    tiles
        Arguments of ``compute``.
    compute
        Without effect but its result, which depends on nothing but the stage's inputs.
    report
        Called before each tile that is computed with ``stage``, the number of earlier tiles and
        that of all.
    workers
        Most tiles that are computed at once, on threads.
    """

    def begin() -> Iterator[tuple[int, tuple[Result] | None]]:
        for number in range(len(tiles)):
            found = None if checkpoints is None else checkpoints.load_tile(name(number))
            if found is None:
                report(stage, number, len(tiles))
            yield number, found

    def finish(begun: tuple[int, tuple[Result] | None]) -> tuple[int, bool, Result]:
        number, found = begun
        return number, found is None, compute(tiles[number]) if found is None else found[0]

    def name(number: int) -> str:
        return f"{stage} {number} of {len(tiles)}"

    with open_worker_pool(workers) as (executor, count):
        for number, fresh, made in map_tiles(finish, begin(), executor=executor, window=count):
            if fresh and checkpoints is not None:
                checkpoints.store_tile(name(number), made)
            yield made
