"""Model a disk at its worst: operations fail, processes are killed, unsynced data is lost.

Data that was not synced is on the medium not at all, wholly, in part, as zeros, or with a hole. A
name that was not synced in its folder is there or not.
"""

import errno
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

from capture.session.disk import Blob, Disk, ItemT
from skinrig.soaking.host_life import HostLife

DATA_FATES: Final[Mapping[str, Callable[[bytes], bytes]]] = {
    "none": lambda data: b"",
    "all": lambda data: data,
    "one byte": lambda data: data[:1],
    "half": lambda data: data[: len(data) // 2],
    "all but one byte": lambda data: data[:-1],
    "zeros": lambda data: bytes(len(data)),
    "half and zeros": lambda data: data[: len(data) // 2].ljust(len(data), b"\0"),
    "hole": lambda data: bytes(len(data) // 2) + data[len(data) // 2 :],
}
"""What of unsynced data reaches the medium."""
DISK_FAULTS: Final = (
    *("ENOSPC", "EIO", "EINTR", "EDQUOT", "short write", "kill", "kill in write", "kill after"),
)
LOST_SYNC: Final = "lost sync"
"""Fault of a medium that reports each sync as done, and does none from then on."""

Operation = tuple[Any, ...]
Image = dict[str, bytes | None]
"""Content of each file by its path; None for a folder."""


class LoggedDisk(Disk):
    """The real disk without the wait of its syncs, with a log of its operations.

    Parameters
    ----------
    root
        Folder to which the names in the log are relative.
    earlier
        Disk of an earlier process, whose files are known; None: none.

    Attributes
    ----------
    log : list of tuple
        Operations in their order: kind, then names, numbers of files, data.
    """

    left_out = "nothing"
    """Kind of sync that is not logged, for tests of the model."""

    def __init__(self, root: Path, earlier: "LoggedDisk | None" = None) -> None:
        self.root = root
        self.log: list[Operation] = []
        self.inodes: Iterator[int] = itertools.count() if earlier is None else earlier.inodes
        self.known: dict[int, int] = {} if earlier is None else earlier.known
        self.opened: dict[int, tuple[str, int]] = {}

    def note(self, *operation: Any) -> None:
        """Append an operation to the log."""
        self.log.append(operation)

    def name(self, path: Path) -> str:
        """Return a path relative to the root."""
        return os.path.relpath(path, self.root)

    def for_each(self, work: Callable[[ItemT], object], items: Iterable[ItemT]) -> None:
        """Do work for one item after the other, so that each run has the same log."""
        for item in items:
            work(item)

    def make_dir(self, path: Path) -> None:
        """Make a directory; see `Disk`, as for all operations."""
        super().make_dir(path)
        self.note("mkdir", self.name(path))

    def create(self, path: Path) -> int:
        """Create a file."""
        descriptor = super().create(path)
        inode = self.known[os.fstat(descriptor).st_ino] = next(self.inodes)
        self.opened[descriptor] = (self.name(path), inode)
        self.note("create", self.name(path), inode)
        return descriptor

    def open_append(self, path: Path) -> int:
        """Open a file for appending."""
        descriptor = super().open_append(path)
        number = os.fstat(descriptor).st_ino
        if number not in self.known:
            self.known[number] = next(self.inodes)
        self.opened[descriptor] = (self.name(path), self.known[number])
        return descriptor

    def write(self, descriptor: int, data: Blob) -> None:
        """Write data."""
        super().write(descriptor, data)
        self.note("write", self.opened[descriptor][1], bytes(data))

    def truncate(self, descriptor: int, size: int) -> None:
        """Cut a file."""
        super().truncate(descriptor, size)
        self.note("truncate", self.opened[descriptor][1], size)

    def _sync(self, descriptor: int) -> None:
        name, inode = self.opened[descriptor]
        kinds = {".dng.part": "frame", ".ply.part": "attachment"}
        kind = next((k for end, k in kinds.items() if name.endswith(end)), Path(name).name)
        if kind != self.left_out:
            self.note("sync", inode)

    def fsync(self, descriptor: int) -> None:
        """Log a sync of data and size."""
        self._sync(descriptor)

    def fdatasync(self, descriptor: int) -> None:
        """Log a sync of data."""
        self._sync(descriptor)

    def rename(self, old: Path, new: Path) -> None:
        """Rename a file."""
        super().rename(old, new)
        self.note("rename", self.name(old), self.name(new))

    def remove(self, path: Path) -> None:
        """Remove a name."""
        super().remove(path)
        self.note("remove", self.name(path))

    def fsync_dir(self, path: Path) -> None:
        """Log a sync of the names in a directory."""
        if self.name(path) != self.left_out:
            self.note("sync_dir", self.name(path))

    def close(self, descriptor: int) -> None:
        """Close a descriptor."""
        self.opened.pop(descriptor, None)
        super().close(descriptor)

    def adopt(self, image: Image) -> None:
        """Log an image that lies below the root as wholly on the medium."""
        for name in sorted(image):
            content = image[name]
            if content is None:
                self.note("mkdir", name)
            else:
                inode = self.known[(self.root / name).stat().st_ino] = next(self.inodes)
                self.note("create", name, inode)
                self.note("write", inode, content)
                self.note("sync", inode)
        for folder in [".", *(name for name in image if image[name] is None)]:
            self.note("sync_dir", folder)


class FaultyDisk(LoggedDisk):
    """A logged disk on which one operation fails; a dead process does nothing afterwards.

    Parameters
    ----------
    root, earlier
        See `LoggedDisk`.
    life
        Process that uses the disk.
    strike
        Number of the operation that fails, from 1; 0: none.
    fault
        Fault of that operation: one of `DISK_FAULTS`, or `LOST_SYNC`.

    Attributes
    ----------
    struck : str
        Name of the operation that failed; empty for none.
    count : int
        Number of operations.
    lies : bool
        Whether syncs are reported as done, and are not.
    """

    def __init__(
        self,
        root: Path,
        earlier: LoggedDisk | None = None,
        *,
        life: HostLife | None = None,
        strike: int = 0,
        fault: str = "EIO",
    ) -> None:
        super().__init__(root, earlier)
        self.life = life or HostLife()
        self.strike, self.fault = strike, fault
        self.count, self.struck, self.lies = 0, "", False

    def note(self, *operation: Any) -> None:
        """Append an operation to the log; a lost sync is not one."""
        if not (self.lies and operation[0] in ("sync", "sync_dir")):
            super().note(*operation)

    def close_all(self) -> None:
        """Close what an ended process leaves open."""
        for descriptor in list(self.opened):
            self.close(descriptor)

    def _run(self, name: str, operation: Callable[..., Any], *arguments: Any) -> Any:
        self.life.require()
        self.count += 1
        if self.count != self.strike:
            return operation(*arguments)
        self.struck, fault = name, self.fault
        if fault == LOST_SYNC:
            self.lies = True
            return operation(*arguments)
        if name == "write" and fault in ("short write", "kill in write", "ENOSPC"):
            descriptor, data = arguments
            operation(descriptor, data[: len(data) // 2])
        elif fault == "kill after":
            operation(*arguments)
        if fault.startswith("kill"):
            self.life.end()
        number = errno.ENOSPC if fault == "short write" else getattr(errno, fault)
        raise OSError(number, os.strerror(number))

    def make_dir(self, path: Path) -> None:
        """Make a directory; see `Disk`, as for all operations."""
        self._run("make_dir", super().make_dir, path)

    def create(self, path: Path) -> int:
        """Create a file."""
        return int(self._run("create", super().create, path))

    def open_append(self, path: Path) -> int:
        """Open a file for appending."""
        return int(self._run("open_append", super().open_append, path))

    def write(self, descriptor: int, data: Blob) -> None:
        """Write data."""
        self._run("write", super().write, descriptor, data)

    def truncate(self, descriptor: int, size: int) -> None:
        """Cut a file."""
        self._run("truncate", super().truncate, descriptor, size)

    def fsync(self, descriptor: int) -> None:
        """Log a sync of data and size."""
        self._run("fsync", super().fsync, descriptor)

    def fdatasync(self, descriptor: int) -> None:
        """Log a sync of data."""
        self._run("fdatasync", super().fdatasync, descriptor)

    def rename(self, old: Path, new: Path) -> None:
        """Rename a file."""
        self._run("rename", super().rename, old, new)

    def remove(self, path: Path) -> None:
        """Remove a name."""
        self._run("remove", super().remove, path)

    def fsync_dir(self, path: Path) -> None:
        """Log a sync of the names in a directory."""
        self._run("fsync_dir", super().fsync_dir, path)

    def lock(self, descriptor: int, *, shared: bool = False) -> bool:
        """Acquire the writer's lock, or one that excludes writers only."""
        return bool(self._run("lock", partial(super().lock, shared=shared), descriptor))


@dataclass
class Medium:
    """What is on the medium for certain, and what is still on its way."""

    data: dict[int, bytes] = field(default_factory=dict)
    """Bytes by number of the file."""
    data_coming: dict[int, list[Operation]] = field(default_factory=dict)
    """Unsynced operations by number of the file."""
    names: dict[str, int | str] = field(default_factory=dict)
    """Number of the file by path; "folder" for a folder."""
    names_coming: list[tuple[set[str], list[str], dict[str, int | str]]] = field(
        default_factory=list
    )
    """Unsynced changes: folders, names taken away, names given."""

    def apply(self, operation: Operation) -> None:
        """Apply an operation of a disk's log."""
        kind, *what = operation
        parent = os.path.dirname
        if kind == "create":
            name, inode = what
            self.data[inode], self.data_coming[inode] = b"", []
            self.names_coming.append(({parent(name)}, [], {name: inode}))
        elif kind == "mkdir":
            self.names_coming.append(({parent(what[0])}, [], {what[0]: "folder"}))
        elif kind in ("write", "truncate"):
            self.data_coming[what[0]].append((kind, what[1]))
        elif kind == "sync":
            self.data[what[0]] = self.content(what[0], "all")
            self.data_coming[what[0]] = []
        elif kind == "remove":
            self.names_coming.append(({parent(what[0])}, [what[0]], {}))
        elif kind == "rename":
            self._rename(*what)
        elif kind == "sync_dir":
            folder = "" if what[0] == "." else what[0]
            arrived = [change for change in self.names_coming if folder in change[0]]
            self.names_coming = [c for c in self.names_coming if folder not in c[0]]
            for _, taken, given in arrived:
                _change_names(self.names, taken, given)

    def _rename(self, old: str, new: str) -> None:
        before, after = os.path.dirname(old), os.path.dirname(new)
        inode = self.tree(len(self.names_coming))[old]
        if before == after:
            self.names_coming.append(({before}, [old], {new: inode}))
        else:  # between folders the two names reach the medium separately
            self.names_coming.append(({after}, [], {new: inode}))
            self.names_coming.append(({before}, [old], {}))

    def tree(self, arrived: int) -> dict[str, int | str]:
        """Return the names after the first ``arrived`` of those on their way."""
        names = dict(self.names)
        for _, taken, given in self.names_coming[:arrived]:
            _change_names(names, taken, given)
        return names

    def content(self, inode: int, fate: str) -> bytes:
        """Return a file's bytes, with one of `DATA_FATES` for what was not synced."""
        data = self.data[inode]
        if fate == "none":
            return data
        for kind, what in self.data_coming[inode]:
            data = data[:what] if kind == "truncate" else data + DATA_FATES[fate](what)
        return data

    def image(self, arrived: int, choose_fate: Callable[[], str]) -> Image:
        """Return a state that the medium may be found in.

        Parameters
        ----------
        arrived
            Number of the changes of names that reached it.
        choose_fate
            Returns one of `DATA_FATES` for each file.
        """
        names = self.tree(arrived)
        image: Image = {}
        for name in sorted(names):
            above = os.path.dirname(name)
            if above in ("", *image):  # a name in a folder that is lost is lost with it
                inode = names[name]
                content = None if isinstance(inode, str) else self.content(inode, choose_fate())
                image[name] = content
        return image

    def images(self) -> Iterator[Image]:
        """Yield every state that the medium may be found in, of one fate for all files."""
        for arrived in range(len(self.names_coming) + 1):
            for fate in DATA_FATES:
                yield self.image(arrived, lambda fate=fate: fate)  # type: ignore[misc]


def _change_names(
    names: dict[str, int | str], taken: list[str], given: dict[str, int | str]
) -> None:
    for name in taken:
        names.pop(name, None)
    names.update(given)


def lay_out(image: Image, root: Path) -> None:
    """Write an image below a folder."""
    for name, content in image.items():
        if content is None:
            (root / name).mkdir()
        else:
            (root / name).write_bytes(content)
