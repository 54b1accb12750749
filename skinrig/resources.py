"""Forecast memory and disk of long work, and refuse work that does not fit before it begins.

Forecasts are linear in the sizes of the work. `tools/measure_memory.py` measured what the
coefficients in `data/memory.toml` are set on.
"""

import math
import os
import resource
import shutil
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path, PurePosixPath
from typing import Any, Final

from capture.plan import Plan
from capture.rig import Rig
from skinrig.errors import UnusableError

MEMORY_TABLE: Final = resources.files("skinrig").joinpath("data/memory.toml")
PROCESS_FOLDER: Final = Path("/proc")
CONTROL_GROUP_FOLDER: Final = Path("/sys/fs/cgroup")
MEMORY_VARIABLE: Final = "SKINRIG_MEMORY_GB"
"""Environment variable of the memory that a command may use instead of what is free, GB."""
NO_LIMIT_BYTES: Final = 2**60
"""Limits from here on are none: control groups of version 1 state a number near 2^63."""


Amounts = Mapping[str, float]
"""Sizes that memory and disk depend on: "camera_mp" and "frame_mp", megapixels of the cameras and
of all frames; "source_mb", bytes of the folder to be exported."""


@dataclass(frozen=True, slots=True)
class ResourceForecast:
    """Forecast peaks of one process, MB."""

    memory_mb: float
    """Peak resident memory."""
    space_mb: float
    """Peak address space, which `ulimit -v` limits."""
    disk_mb: float
    """Files of the output."""

    def fits(self, free: "FreeMemory") -> bool:
        """Return whether the memory of a process is below what it can have.

        Examples
        --------
        >>> need = ResourceForecast(500.0, 1300.0, 2.0)
        >>> need.fits(FreeMemory(600.0, "machine", math.inf))
        True
        >>> need.fits(FreeMemory(600.0, "machine", 1000.0))
        False
        """
        return self.memory_mb <= free.memory_mb and self.space_mb <= free.space_mb


@dataclass(frozen=True, slots=True)
class FreeMemory:
    """Memory that this process can have, with what it has already, MB."""

    memory_mb: float
    source: str
    """What limits `memory_mb`: machine, control group, or the variable."""
    space_mb: float
    """Limit of the address space (`ulimit -v`); infinite without one."""


def count_megapixels(rig: Rig, plan: Plan) -> Amounts:
    """Return the megapixels of the cameras in use, and of all frames of a plan.

    Examples
    --------
    >>> from capture.plan import flash_plan
    >>> from capture.rig import load_rig
    >>> rig = load_rig("flash").resized(128)
    >>> {name: round(number, 3) for name, number in count_megapixels(rig, flash_plan(rig)).items()}
    {'camera_mp': 0.011, 'frame_mp': 0.066}
    """
    megapixels = {view.name: view.width_px * view.height_px * 1e-6 for view in rig.all_views}
    used = {name for step in plan.steps for name in step.cameras}
    return {
        "camera_mp": sum(megapixels[name] for name in used),
        "frame_mp": sum(megapixels[name] for step in plan.steps for name in step.cameras),
    }


def forecast_resources(
    work: str, amounts: Amounts, *, processes: int = 1, outputs: int = 1
) -> ResourceForecast:
    """Forecast memory and disk of a command.

    Parameters
    ----------
    work
        Command, and rig where the command depends on it, such as "simulate flash".
    amounts
        Sizes of one process's work.
    processes
        Processes that do such work at once.
    outputs
        Such outputs that are written.

    Examples
    --------
    >>> one, two = (forecast_resources("simulate probe", {}, processes=n) for n in (1, 2))
    >>> two.memory_mb == 2.0 * one.memory_mb > 0.0
    True
    """
    row: Mapping[str, Any] = _read_table()
    for word in work.split():
        row = row[word]
    memory_mb, disk_mb = (
        one["fixed"] + sum(number * one.get(name, 0.0) for name, number in amounts.items())
        for one in (row["memory_mb"], row["disk_mb"])
    )
    space_mb = memory_mb + row["space_above_memory_mb"]
    return ResourceForecast(memory_mb * processes, space_mb, disk_mb * outputs)


def forecast_smaller_widths(
    work: str, width_px: int, amounts: Amounts
) -> dict[str, ResourceForecast]:
    """Forecast a simulation at a half, a quarter, and an eighth of its width, by option.

    Examples
    --------
    >>> list(forecast_smaller_widths("simulate flash", 1000, {"camera_mp": 0.7}))
    ['--width 500', '--width 250', '--width 124']
    """
    found = {}
    for divisor in (2, 4, 8):
        fewer = {name: number / divisor**2 for name, number in amounts.items()}
        found[f"--width {width_px // divisor // 2 * 2}"] = forecast_resources(work, fewer)
    return found


def measure_folder_mb(folder: str | Path) -> float:
    """Return the bytes of all files of a folder, MB.

    Examples
    --------
    >>> measure_folder_mb("no such folder")
    0.0
    """
    files = Path(folder).rglob("*")
    return sum(path.stat().st_size for path in files if path.is_file()) * 1e-6


@cache
def _read_table() -> dict[str, dict[str, Any]]:
    return tomllib.loads(MEMORY_TABLE.read_text(encoding="utf-8"))


def require_resources(
    work: str,
    need: ResourceForecast,
    out: Path,
    *,
    smaller: Mapping[str, ResourceForecast] | None = None,
) -> None:
    """Raise unless memory and disk suffice for a forecast.

    Parameters
    ----------
    work
        What is about to begin, for the message.
    need
        Its forecast, for all its processes.
    out
        Output, whose disk is tried.
    smaller
        Forecasts of smaller work by the option that orders it, the largest first. The message names
        the first that fits.

    Raises
    ------
    skinrig.errors.UnusableError
        With what is needed, what is free, and what to do.
    """
    free = read_free_memory()
    if not need.fits(free):
        if need.memory_mb > free.memory_mb:
            lack = f"{_gb(need.memory_mb)}, {_gb(free.memory_mb)} free ({free.source})"
            advice = f"close other programs, or set {MEMORY_VARIABLE} to the GB that it may use"
        else:
            advice = "raise the limit"
            lack = f"{_gb(need.space_mb)} of addresses, {_gb(free.space_mb)} allowed (ulimit -v)"
        raise UnusableError(
            f"memory: {work} needs about {lack}; nothing was computed: "
            + _advise_smaller(smaller or {}, free)
            + f"{advice} [SR-CLI-016]"
        )
    place = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.is_dir())
    free_mb = shutil.disk_usage(place).free * 1e-6
    if need.disk_mb > free_mb:
        raise UnusableError(
            f"--out: {out}: {work} writes about {_gb(need.disk_mb)}, {_gb(free_mb)} free; nothing "
            "was computed: free space, or name another disk [SR-CLI-003]"
        )


@dataclass(frozen=True, slots=True)
class Task:
    """Work of one process, as in `forecast_resources`."""

    work: str
    amounts: Amounts


def require_resources_of_tasks(
    tasks: Iterable[Task],
    out: Path,
    *,
    processes: int,
    outputs: int,
    option: str = "--executor local:",
) -> None:
    """Raise unless memory and disk suffice for the largest of some tasks in each process.

    Parameters
    ----------
    tasks
        Tasks; without any nothing is required.
    out
        Output, whose disk is tried.
    processes
        Processes of this machine that do the tasks; 0: those of other machines do.
    outputs
        Outputs that are on the disk at once.
    option
        Option that sets the number of processes, without the number; empty: there is none.

    Raises
    ------
    skinrig.errors.UnusableError
        With what is needed, what is free, and what to do.
    """
    largest = max(
        tasks, key=lambda task: forecast_resources(task.work, task.amounts).memory_mb, default=None
    )
    if largest is None or processes == 0:
        return

    def forecast(count: int) -> ResourceForecast:
        work, amounts = largest.work, largest.amounts
        return forecast_resources(work, amounts, processes=count, outputs=outputs)

    fewer = range(processes - 1, 0, -1) if option else ()
    smaller = {f"{option}{n}": forecast(n) for n in fewer}
    many = f" in {processes} processes" if processes > 1 else ""
    require_resources(largest.work + many, forecast(processes), out, smaller=smaller)


def _advise_smaller(smaller: Mapping[str, ResourceForecast], free: FreeMemory) -> str:
    for option, need in smaller.items():
        if need.fits(free):
            return f"{option} needs {_gb(need.memory_mb)}; else "
    return ""


def _gb(mb: float) -> str:
    return f"{mb / 1000:.2g} GB" if mb < 99_500 else f"{mb / 1000:.0f} GB"


def read_free_memory(
    process: Path = PROCESS_FOLDER, groups: Path = CONTROL_GROUP_FOLDER
) -> FreeMemory:
    """Return the memory that this process can have: least of machine, control groups and limits.

    Swap counts as memory of the machine. What cannot be read is no limit. The environment variable
    replaces machine and control groups, as forecasts extrapolate from small sizes.

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
            root, names = groups, ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            root = groups / "memory"
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        own = PurePosixPath(name.lstrip("/"))
        for folder in (own, *own.parents):
            free_mb = min(free_mb, _read_group_folder_mb(root / folder, *names))
    return free_mb


def _read_group_folder_mb(folder: Path, limit: str, usage: str, cached: str) -> float:
    """Return limit less usage of one group, MB; pages of files that can be dropped are free."""
    try:
        limit_bytes = int((folder / limit).read_text("ascii"))
        used_bytes = int((folder / usage).read_text("ascii"))
        rows = (folder / "memory.stat").read_text("ascii").splitlines()
    except (OSError, ValueError):  # no such group, or "max"
        return math.inf
    if limit_bytes >= NO_LIMIT_BYTES:
        return math.inf
    dropped = sum(int(row.split()[1]) for row in rows if row.split()[0] == cached)
    return max(limit_bytes - max(used_bytes - dropped, 0), 0) * 1e-6
