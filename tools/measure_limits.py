"""Compare the kernels of a rig's longest steps with the limits of the machine.

    python tools/measure_limits.py measure dome capture --run small-dome --out limits
    python tools/measure_limits.py table limits

RUN is a run of `tools/measure_scales.py`, whose calibration and sessions the step reads. The step's
own command runs at a moderate size, on one thread. Each call of a kernel adds its processor time;
the largest call's arguments are kept. Then rates of the machine and that call are measured in turns
in the same minute. Kernels are in `tools/listed_kernels.py`, costs in `tools/kernel_costs.py`. The
rate of rays is not a limit of the machine, so kernels that trace rays have none.
"""

import argparse
import copy
import hashlib
import importlib
import json
import math
import os
import platform
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from kernel_costs import Cost
from listed_kernels import KERNELS, STEPS, Kernel
from numba import njit

ONE_THREAD = {
    "NUMBA_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
"""Set before Numba and BLAS start, so that a thread's clock counts all of a kernel's work."""
REPEATS = 5
STREAM_BYTES = 1 << 26  # twice the last level of the cache
TABLE_BYTES = 1 << 28
MIN_CALL_S = 0.01
MIN_SHARE = 0.005
"""Kernels below this fraction of a step's processor time are not listed."""
CHAIN = 16
"""Steps of each chain of multiplications and additions."""

Rates = dict[str, float]


@njit(fastmath={"contract"}, error_model="numpy")
def _chain(values, a, b, rounds):  # type: ignore[no-untyped-def]
    """Apply ``x = x a + b`` to each value: 2 x `CHAIN` operations per value and round."""
    for _ in range(rounds):
        for i in range(values.size):
            x = values[i]
            for _ in range(CHAIN):
                x = x * a + b
            values[i] = x


@njit(fastmath={"contract"}, error_model="numpy")
def _divide(values, a, rounds):  # type: ignore[no-untyped-def]
    """Divide and take a root of each value, 4 of both per value and round."""
    for _ in range(rounds):
        for i in range(values.size):
            x = values[i]
            for _ in range(2):
                x = math.sqrt(a / (x + a))
            values[i] = x


@njit
def _exponentials(values, out):  # type: ignore[no-untyped-def]
    for i in range(values.size):
        out[i] = math.exp(values[i])


@njit
def _gather(table, place, out):  # type: ignore[no-untyped-def]
    for i in range(place.size):
        out[i] = table[place[i]]


def time_call(call: Callable[[], object]) -> float:
    """Return the processor seconds of one call, from as many as take `MIN_CALL_S`."""
    count, taken = 0, 0.0
    begun = time.process_time()
    while taken < MIN_CALL_S:
        call()
        count += 1
        taken = time.process_time() - begun
    return taken / count


def rate_calls() -> dict[str, tuple[float, Callable[[], object]]]:
    """Return, by rate, the units of one call and the call; each has been called once."""
    rng = np.random.default_rng(0)
    source = np.ones(STREAM_BYTES // 4, np.float32)
    target = np.empty_like(source)
    small32, small64 = np.ones(4096, np.float32), np.ones(4096)
    exponents, powers = rng.uniform(-5.0, 0.0, 4096), np.empty(4096)
    table = np.ones(TABLE_BYTES // 4, np.float32)
    place = rng.integers(0, table.size, 1 << 17)
    picked = np.empty(place.size, np.float32)
    blob = rng.bytes(1 << 20)
    mean = np.full(1 << 15, 1000.0)
    one32, half32 = np.float32(0.999), np.float32(0.001)
    found: dict[str, tuple[float, Callable[[], object]]] = {
        # read and written bytes
        "copy": (2.0 * source.nbytes, lambda: np.copyto(target, source)),
        "float32": (2.0 * CHAIN * 4096 * 32, lambda: _chain(small32, one32, half32, 32)),
        "float64": (2.0 * CHAIN * 4096 * 32, lambda: _chain(small64, 0.999, 0.001, 32)),
        "division": (4.0 * 4096 * 8, lambda: _divide(small64, 1.5, 8)),
        "exp": (4096.0, lambda: _exponentials(exponents, powers)),
        "gather": (float(place.size), lambda: _gather(table, place, picked)),
        "sha256": (float(len(blob)), lambda: hashlib.sha256(blob).digest()),
        "normal": (float(1 << 16), lambda: rng.standard_normal(1 << 16, np.float32)),
        "poisson": (float(mean.size), lambda: rng.poisson(mean)),
    }
    for _, call in found.values():
        call()
    return found


def copy_arrays(value: Any) -> Any:
    """Return a value whose arrays and generators are copies, also those in tuples and dicts."""
    if isinstance(value, np.ndarray | np.random.Generator):
        return copy.deepcopy(value)
    if isinstance(value, dict):
        return {key: copy_arrays(one) for key, one in value.items()}
    if isinstance(value, tuple):
        copies = [copy_arrays(one) for one in value]
        return type(value)(*copies) if hasattr(value, "_fields") else tuple(copies)
    return value


class Recorder:
    """A kernel in place of its function: adds processor time, keeps the largest call's arguments.

    Parameters
    ----------
    kernel
        Description of the kernel.
    plain
        The function itself.
    """

    def __init__(self, kernel: Kernel, plain: Callable[..., Any]) -> None:
        self.kernel, self.plain, self.maker = kernel, plain, plain
        self.calls, self.seconds, self.copying_s, self.items = 0, 0.0, 0.0, 0.0
        self.largest: tuple[tuple[Any, ...], dict[str, Any]] | None = None
        self.largest_items = -1.0

    def __call__(self, *args: Any, **options: Any) -> Any:
        """Call the function."""
        begun = time.thread_time()
        count = self.kernel.count(*args, **options)
        more = count - self.largest_items
        if self.kernel.cost is not None and (more > 0.0 or (self.kernel.keeps_last and more == 0)):
            self.largest, self.largest_items = copy_arrays((args, options)), count
        between = time.thread_time()
        found = self.plain(*args, **options)
        self.seconds += time.thread_time() - between
        self.copying_s += between - begun
        self.calls += 1
        self.items += count
        return found


@contextmanager
def recorded(kernels: Sequence[Kernel]) -> Iterator[list[Recorder]]:
    """Replace kernels by recorders, wherever a module has imported them, and put them back."""
    recorders, replaced = [], []
    for kernel in kernels:
        owner: Any = importlib.import_module(kernel.module)
        *classes, name = kernel.name.split(".")
        for one in classes:
            owner = getattr(owner, one)
        plain = getattr(owner, name)
        recorder = Recorder(kernel, plain)

        def stand_in(*args: Any, _record: Recorder = recorder, **options: Any) -> Any:
            if _record.kernel.makes:  # of an element type; the last one made is measured
                _record.plain = _record.maker(*args)
                return _record
            return _record(*args, **options)

        places = [(owner, name)]
        for module in () if classes else list(sys.modules.values()):
            names = list(getattr(module, "__dict__", {}).items())
            places += [(module, key) for key, value in names if value is plain]
        for place, key in places:
            replaced.append((place, key, plain))
            setattr(place, key, stand_in)
        recorders.append(recorder)
    try:
        yield recorders
    finally:
        for place, key, plain in replaced:
            setattr(place, key, plain)


def run_command(words: Sequence[str]) -> float:
    """Run a command of skinrig in this process; return its processor seconds."""
    import drjit
    import typer

    from rigsim.mitsuba.startup import load_mitsuba
    from rigsim.mitsuba.variant import choose_variant
    from skinrig.cli import app

    load_mitsuba(choose_variant("mono"))
    drjit.set_thread_count(0)  # works in the calling thread, whose clock counts it
    begun = time.process_time()
    typer.main.get_command(app).main(args=list(words), prog_name="skinrig", standalone_mode=False)
    return time.process_time() - begun


@dataclass(frozen=True)
class Row:
    """One kernel of a step."""

    kernel: str
    share: float
    """Fraction of the step's processor seconds, with all it calls."""
    seconds_per_item: float
    item: str
    gb_per_s: float
    gflop_per_s: float
    bound: str
    fraction: float
    """Shortest time by the machine's rates over the measured time; NaN without a limit."""
    reason: str


def shortest_seconds(cost: Cost, rates: Mapping[str, float]) -> tuple[str, float]:
    """Return the bound and the shortest time of a cost at the machine's rates, s.

    The slowest class alone is a lower bound: the processor overlaps memory, multiplications,
    divisions and the C library's functions. One generator draws its random numbers one by one.
    """
    times = {
        "memory": cost.bytes / rates["copy"],
        "arithmetic": max(cost.float32 / rates["float32"], cost.float64 / rates["float64"]),
        "divisions": cost.division / rates["division"],
        "functions": cost.exp / rates["exp"],
        "random numbers": cost.normal / rates["normal"] + cost.poisson / rates["poisson"],
        "gathers": cost.gather / rates["gather"],
    }
    bound = max(times, key=lambda name: times[name])
    return bound, times[bound]


def measure_in_turns(
    calls: Mapping[str, tuple[float, Callable[[], object]]], kernels: Sequence[Recorder]
) -> tuple[Rates, list[float]]:
    """Measure rates and the kernels' largest calls in turns; return medians of both."""
    rates: list[Rates] = []
    seconds: list[list[float]] = []
    replays = []
    for one in kernels:
        args, options = one.largest or ((), {})
        replays.append(partial(one.plain, *one.kernel.prepare(*args), **options))
    for _ in range(REPEATS):
        rates.append({name: units / time_call(call) for name, (units, call) in calls.items()})
        seconds.append([time_call(replay) for replay in replays])
    middle = {name: statistics.median(one[name] for one in rates) for name in calls}
    return middle, [statistics.median(column) for column in zip(*seconds, strict=True)]


def judge(recorder: Recorder, total_s: float, taken_s: float, rates: Rates) -> Row:
    """Compare the time of a kernel's largest call with the shortest one."""
    kernel, share = recorder.kernel, recorder.seconds / total_s
    if kernel.cost is None or recorder.largest is None:
        each, nan = recorder.seconds / max(recorder.items, 1.0), math.nan
        return Row(kernel.label, share, each, kernel.item, nan, nan, "-", nan, kernel.reason)
    args, options = recorder.largest
    cost = kernel.cost(*kernel.prepare(*args), **options)
    bound, shortest = shortest_seconds(cost, rates)
    return Row(
        kernel.label,
        share,
        taken_s / recorder.largest_items,
        kernel.item,
        1e-9 * cost.bytes / taken_s,
        1e-9 * (cost.float32 + cost.float64) / taken_s,
        bound,
        shortest / taken_s,
        kernel.reason,
    )


def measure(rig: str, step: str, run: Path | None) -> dict[str, Any]:
    """Run a step with recorders, and return its rows, with the machine's rates."""
    kernels = [one for one in KERNELS if (rig, step) in one.steps]
    if run is None and any("{run}" in word for word in STEPS[rig, step]):
        raise SystemExit(f"{rig} {step}: reads a run's sessions; name one by --run")
    with tempfile.TemporaryDirectory() as folder, recorded(kernels) as recorders:
        words = [word.format(run=run, out=folder) for word in STEPS[rig, step]]
        total_s = run_command(words)
    total_s -= sum(one.copying_s for one in recorders)
    used = [one for one in recorders if one.seconds > MIN_SHARE * total_s]
    limited = [one for one in used if one.largest is not None]
    rates, seconds = measure_in_turns(rate_calls(), limited)
    taken = {id(one): each for one, each in zip(limited, seconds, strict=True)}
    rows = [asdict(judge(one, total_s, taken.get(id(one), 0.0), rates)) for one in used]
    return {
        "rig": rig,
        "step": step,
        "command": " ".join(STEPS[rig, step]),
        "machine": processor_name(),
        "load": os.getloadavg()[0],
        "repeats": REPEATS,
        "processor_s": total_s,
        "rates": rates,
        "rows": sorted(rows, key=lambda row: -row["share"]),
    }


def processor_name() -> str:
    """Return the processor's name and family."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        return platform.processor()
    fields = dict(line.split(":", 1) for line in lines if ":" in line)
    found = {key.strip(): value.strip() for key, value in fields.items()}
    return f"{found.get('model name')}, family {found.get('cpu family')}"


def format_seconds(seconds: float) -> str:
    """Return seconds with a unit of three digits.

    >>> format_seconds(1.234e-7)
    '123 ns'
    """
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"


def tabulate(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a table of rates and a table of kernels in Markdown."""
    lines = ["| rate, one core | median | range |", "| --- | --- | --- |"]
    units = {"copy": "GB/s", "sha256": "GB/s", "float32": "GF/s", "float64": "GF/s"}
    rates = [record["rates"] for record in records if record["rates"]]
    for name in rates[0] if rates else ():
        found = [1e-9 * one[name] for one in rates]
        unit, scale = (units[name], 1.0) if name in units else ("million/s", 1e3)
        middle, low, high = (scale * f(found) for f in (statistics.median, min, max))
        lines.append(f"| {name}, {unit} | {middle:.3g} | {low:.3g} to {high:.3g} |")
    lines += ["", "| step, kernel | share; time per item | GB/s; GF/s | bound | fraction |"]
    lines.append("| --- | --- | --- | --- | --- |")
    for record in records:
        for row in record["rows"]:
            limited = not math.isnan(row["fraction"])
            rate = f"{row['gb_per_s']:.2g}; {row['gflop_per_s']:.2g}" if limited else "-"
            fraction = f"{row['fraction']:.2f}" if limited else "-"
            if row["reason"] and not (limited and row["fraction"] >= 0.5):
                fraction = f"{fraction}; {row['reason']}" if limited else row["reason"]
            each = f"{format_seconds(row['seconds_per_item'])} per {row['item']}"
            lines.append(
                f"| {record['rig']}, {record['step']}: {row['kernel']} | "
                f"{100 * row['share']:.0f} %; {each} | {rate} | {row['bound']} | {fraction} |"
            )
    loads = sorted(record["load"] for record in records)
    if records:
        lines += ["", f"{records[0]['machine']}; loads of {loads[0]:.0f} to {loads[-1]:.0f}"]
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    measuring = commands.add_parser("measure")
    measuring.add_argument("rig", choices=sorted({rig for rig, _ in STEPS}))
    measuring.add_argument("step", choices=sorted({step for _, step in STEPS}))
    measuring.add_argument("--run", type=Path)
    measuring.add_argument("--out", type=Path, required=True)
    table = commands.add_parser("table")
    table.add_argument("folder", type=Path)
    given = parser.parse_args()
    if given.command == "measure":
        if (given.rig, given.step) not in STEPS:
            parser.error(f"{given.step}: not a step of the {given.rig} rig")
        if os.environ.get("NUMBA_NUM_THREADS") != "1":
            os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | ONE_THREAD)
        run = given.run.resolve() if given.run else None
        record = measure(given.rig, given.step, run)
        given.out.mkdir(parents=True, exist_ok=True)
        name = f"{given.rig}-{given.step.replace(' ', '-')}.json"
        (given.out / name).write_text(json.dumps(record, indent=1), "utf-8")
        records = [record]
    else:
        paths = sorted(given.folder.glob("*.json"))
        records = [json.loads(path.read_text("utf-8")) for path in paths]
    print("\n".join(tabulate(records)))


if __name__ == "__main__":
    main()
