"""Forecast memory and disk of long work, and refuse work that does not fit before it begins.

Forecasts are linear in the sizes of the work. `tools/measure_memory.py` measured what the
coefficients in `data/memory.toml` are set on.
"""

import math
import shutil
import tomllib
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Final

from capture.plan import Plan
from capture.rig import Rig
from skinrig.errors import UnusableError
from skinrig.resources.free_memory import MEMORY_VARIABLE, FreeMemory, read_free_memory

MEMORY_TABLE: Final = resources.files("skinrig").joinpath("data/memory.toml")


Amounts = Mapping[str, float]
"""Sizes that memory and disk depend on: "camera_mp", "frame_mp", "state_mp", megapixels of the
cameras, of all frames, and of one frame per state of the caliper; "source_mb", bytes of the folder
to be exported."""


@dataclass(frozen=True, slots=True)
class ResourceForecast:
    """Forecast peaks, MB."""

    memory_mb: float
    """Peak resident memory of all processes."""
    space_mb: float
    """Peak address space of one process, which `ulimit -v` limits."""
    disk_mb: float
    """Files of the output."""
    temporary_mb: float = 0.0
    """Largest size of a temporary file on the output's disk; less space makes work slower."""

    def fits(self, free: FreeMemory) -> bool:
        """Return whether memory and address space are below what is free.

        Examples
        --------
        >>> need = ResourceForecast(500.0, 1300.0, 2.0)
        >>> need.fits(FreeMemory(600.0, "machine", math.inf))
        True
        >>> need.fits(FreeMemory(600.0, "machine", 1000.0))
        False
        """
        return self.memory_mb <= free.memory_mb and self.space_mb <= free.space_mb


def count_megapixels(rig: Rig, plan: Plan, omitted: Container[str] = ()) -> Amounts:
    """Return the megapixels of the cameras in use, of all frames of a plan, and of all its states.

    Parameters
    ----------
    rig, plan
        The plan, and its rig.
    omitted
        Steps of the plan that were not captured.

    Examples
    --------
    >>> from capture.plan import flash_plan
    >>> from capture.rig import load_rig
    >>> rig = load_rig("flash").resized(128)
    >>> {name: round(number, 3) for name, number in count_megapixels(rig, flash_plan(rig)).items()}
    {'camera_mp': 0.011, 'frame_mp': 0.066, 'state_mp': 0.0}
    """
    megapixels = {view.name: view.width_px * view.height_px * 1e-6 for view in rig.all_views}
    steps = [step for step in plan.steps if step.id not in omitted]
    camera_mp = sum(megapixels[name] for name in {name for step in steps for name in step.cameras})
    states = {(step.index.get("angle"), step.index.get("caliper")) for step in steps}
    return {
        "camera_mp": camera_mp,
        "frame_mp": sum(megapixels[name] for step in steps for name in step.cameras),
        "state_mp": camera_mp * len(states - {(None, None)}),
    }


def forecast_resources(work: str, amounts: Amounts) -> ResourceForecast:
    """Forecast memory and disk of a command.

    Parameters
    ----------
    work
        Command, and rig where the command depends on it, such as "simulate flash".
    amounts
        Sizes of its work.

    Examples
    --------
    >>> forecast_resources("reconstruct flash", {"camera_mp": 1.0}).memory_mb
    563.0
    """
    row: Mapping[str, Any] = _read_table()
    for word in work.split():
        row = row[word]
    memory_mb, disk_mb = (
        one["fixed"]
        + sum(
            min(number * one.get(name, 0.0), one.get("most", {}).get(name, math.inf))
            for name, number in amounts.items()
        )
        for one in (row["memory_mb"], row["disk_mb"])
    )
    return ResourceForecast(memory_mb, memory_mb + row["space_above_memory_mb"], disk_mb)


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
    free_mb = _free_mb(out)
    if need.disk_mb > free_mb:
        raise UnusableError(
            f"--out: {out}: {work} writes about {_gb(need.disk_mb)}, {_gb(free_mb)} free; nothing "
            "was computed: free space, or name another disk [SR-CLI-017]"
        )


def temporary_room_mb(need: ResourceForecast, out: Path) -> float:
    """Return the size that a temporary file may have: at most half of the space left, MB.

    Parameters
    ----------
    need
        Forecast of the work.
    out
        Output, whose disk is tried.
    """
    return min(need.temporary_mb, max(0.0, (_free_mb(out) - need.disk_mb) / 2.0))


def describe_disk(need: ResourceForecast, out: Path) -> str:
    """Describe the space that an output and a temporary file take, and whether the file fits."""
    text = f"disk: about {_gb(max(0.0, need.disk_mb))}"
    if need.temporary_mb:
        text += f", and up to {_gb(need.temporary_mb)} of temporary images until the end"
        room_mb = temporary_room_mb(need, out)
        if room_mb < need.temporary_mb:
            text += f"; {_gb(room_mb)} of these fit, other images are rendered more than once"
    return text


def _free_mb(out: Path) -> float:
    place = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.is_dir())
    return shutil.disk_usage(place).free * 1e-6


@dataclass(frozen=True, slots=True)
class Task:
    """Work of one process, as in `forecast_resources`."""

    work: str
    amounts: Amounts


Job = Sequence[Task]
"""Tasks that one process does one after the other."""


def require_resources_of_jobs(
    jobs: Iterable[Job],
    out: Path,
    *,
    processes: int,
    outputs: int | None = None,
    held_mb: float = 0.0,
    option: str = "--executor local:",
) -> None:
    """Raise unless memory suffices for the largest jobs at once, and disk for their outputs.

    Parameters
    ----------
    jobs
        Jobs, each with at least one task; without any nothing is required.
    out
        Output, whose disk is tried.
    processes
        Processes of this machine that do the jobs; 0: those of other machines do.
    outputs
        Jobs whose outputs are on the disk at once, the largest; None: all.
    held_mb
        Files of the output that are there already, or are removed first.
    option
        Option that sets the number of processes, without the number; empty: there is none.

    Raises
    ------
    skinrig.errors.UnusableError
        With what is needed, what is free, and what to do.
    """
    tasks = [[(forecast_resources(one.work, one.amounts), one.work) for one in job] for job in jobs]
    if not tasks or processes == 0:
        return
    memory_mb = sorted((max(need.memory_mb for need, _ in job) for job in tasks), reverse=True)
    disk_mb = sorted((sum(need.disk_mb for need, _ in job) for job in tasks), reverse=True)
    largest, work = max((one for job in tasks for one in job), key=lambda one: one[0].memory_mb)
    forecasts = {
        count: ResourceForecast(
            sum(memory_mb[:count]), largest.space_mb, sum(disk_mb[:outputs]) - held_mb
        )
        for count in range(min(processes, len(tasks)), 0, -1)
    }
    count, need = next(iter(forecasts.items()))
    smaller = {f"{option}{n}": one for n, one in forecasts.items() if option and n < count}
    many = f" in {count} processes" if count > 1 else ""
    require_resources(work + many, need, out, smaller=smaller)


def _advise_smaller(smaller: Mapping[str, ResourceForecast], free: FreeMemory) -> str:
    for option, need in smaller.items():
        if need.fits(free):
            return f"{option} needs {_gb(need.memory_mb)}; else "
    return ""


def _gb(mb: float) -> str:
    return f"{mb / 1000:.2g} GB" if mb < 99_500 else f"{mb / 1000:.0f} GB"
