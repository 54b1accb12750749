"""Read the memory that this process can have: of the machine, its control groups and its limits."""

import math
import os
import resource
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final

from skinrig.errors import UnusableError

PROCESS_FOLDER: Final = Path("/proc")
CONTROL_GROUP_FOLDER: Final = Path("/sys/fs/cgroup")
MEMORY_VARIABLE: Final = "SKINRIG_MEMORY_GB"
"""Environment variable of the memory that a command may use instead of what is free, GB."""
NO_LIMIT_BYTES: Final = 2**60
"""Limits from here on are none: control groups of version 1 state a number near 2^63."""


@dataclass(frozen=True, slots=True)
class FreeMemory:
    """Memory that this process can have, with what it has already, MB."""

    memory_mb: float
    source: str
    """What limits `memory_mb`: machine, control group, or the variable."""
    space_mb: float
    """Limit of the address space (`ulimit -v`); infinite without one."""


def read_free_memory(
    process: Path = PROCESS_FOLDER, groups: Path = CONTROL_GROUP_FOLDER
) -> FreeMemory:
    """Return the memory that this process can have: least of machine, control groups and limits.

    Swap counts as memory of the machine. What cannot be read does not limit it. The environment
    variable replaces machine and control groups, as forecasts extrapolate from small sizes.

    Parameters
    ----------
    process, groups
        Folders of the kernel's files; other ones for tests.

    Examples
    --------
    >>> read_free_memory().memory_mb > 0.0
    True
    """
    space = (resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_AS, resource.RLIMIT_DATA))
    limits = [one * 1e-6 for one in space if one != resource.RLIM_INFINITY]
    space_mb = min(limits, default=math.inf)
    if given := os.environ.get(MEMORY_VARIABLE):
        return FreeMemory(_parse_memory_mb(given), MEMORY_VARIABLE, space_mb)
    own = _read_kilobytes(process / "self/status")
    machine = _read_kilobytes(process / "meminfo")
    held_mb = own.get("VmRSS", 0.0)
    free_mb = machine.get("MemAvailable", math.inf) + machine.get("SwapFree", 0.0)
    group_mb = _read_group_mb(process, groups)
    source = "control group" if group_mb < free_mb else "machine"
    return FreeMemory(held_mb + min(free_mb, group_mb), source, space_mb)


def _parse_memory_mb(text: str) -> float:
    try:
        memory_mb = 1000.0 * float(text)
    except ValueError:
        memory_mb = math.nan
    if not memory_mb > 0.0:
        raise UnusableError(f"{MEMORY_VARIABLE}: got {text!r}, expected GB above 0; correct it")
    return memory_mb


def _read_kilobytes(path: Path) -> dict[str, float]:
    """Return the rows "NAME: NUMBER kB" of a file, MB; empty where it cannot be read."""
    try:
        rows = [line.split() for line in path.read_text("ascii", errors="replace").splitlines()]
    except OSError:
        return {}
    return {
        row[0].rstrip(":"): float(row[1]) * 1.024e-3
        for row in rows
        if len(row) == 3 and row[2] == "kB" and row[1].isdigit()
    }


def _read_group_mb(process: Path, groups: Path) -> float:
    """Return what the control groups of this process leave free, MB; infinite without limits."""
    try:
        lines = (process / "self/cgroup").read_text("utf-8", errors="replace").splitlines()
    except OSError:
        return math.inf
    free_mb = math.inf
    for line in lines:
        number, controllers, name = [*line.split(":", 2), "", ""][:3]
        if number == "0" and not controllers:
            root, names = groups, ("memory.max", "memory.current", "")
        elif "memory" in controllers.split(","):
            root = groups / "memory"
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_")
        else:
            continue
        own = PurePosixPath(name.lstrip("/"))
        for folder in (own, *own.parents):
            free_mb = min(free_mb, _read_group_folder_mb(root / folder, *names))
    return free_mb


def _read_group_folder_mb(folder: Path, limit: str, usage: str, prefix: str) -> float:
    """Return limit less usage of one group, MB; pages of files that can be dropped are free."""
    try:
        limit_bytes = int((folder / limit).read_text("ascii"))
        used_bytes = int((folder / usage).read_text("ascii"))
        rows = [line.split() for line in (folder / "memory.stat").read_text("ascii").splitlines()]
        dropped = {f"{prefix}active_file", f"{prefix}inactive_file"}
        used_bytes -= sum(int(row[1]) for row in rows if row[0] in dropped)
    except (OSError, ValueError, IndexError):  # no such group, "max", or another format
        return math.inf
    if limit_bytes >= NO_LIMIT_BYTES:
        return math.inf
    return max(limit_bytes - max(used_bytes, 0), 0) * 1e-6
