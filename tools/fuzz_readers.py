"""Fuzz the readers of files, guided by their coverage, and add the runs to a table.

Each reader begins from one good file. A child process of atheris changes it with the mutations of
the tests and with its own, and keeps what reaches new code. A run is one file read. It fails where
the file is neither read nor refused by one clear error. Runs add up in tools/fuzz_runs.csv over
days: each has a seed of its own. A file that fails is kept in build/fuzz.

python tools/fuzz_readers.py --readers lp,obj --runs 1000000 [--budget 600]
python tools/fuzz_readers.py --day 20261129 --budget 4 (the day's reader, not added to the table)
python tools/fuzz_readers.py --readers "" (totals)
"""

import argparse
import csv
import functools
import logging
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent import futures
from pathlib import Path
from types import FunctionType

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "tools/fuzz_runs.csv"
FAILURES = ROOT / "build/fuzz"
COLUMNS = ("reader", "seed", "runs", "seconds", "failures")
INSTRUMENTED = (
    "capture.calibration.store",
    "capture.documents",
    "capture.importers",
    "capture.plan",
    "capture.raw",
    "capture.session",
    "model.checks.files",
    "model.merl",
    "model.microstructure.kernel_table",
    "model.store",
    "rigsim.population.files",
    "skinrig.blend_shapes",
)
"""Modules whose branches guide the mutations; compiled kernels cannot be."""
MAX_FILE_BYTES = 1 << 16
MAX_INPUT_S = 20
MAX_DATA_BYTES = 4 << 30
PART_RUNS, PART_S = 250_000, 300.0
"""Runs and seconds of one child: what an interruption loses at most."""
READERS = (
    *("dng", "png", "jpeg", "tiff", "exr photograph", "exr map", "npz", "npy", "npz blend shapes"),
    *("gltf", "obj", "obj blend shapes", "ply", "json plan", "json", "json kernel table"),
    *("toml rig", "toml subject", "lp", "merl", "CALIBRATION", "SESSION manifest"),
    *("SESSION journal", "SESSION frame", "APPEARANCE", "APPEARANCE map"),
)
"""Those of tests/fixtures/strangers_files.py."""


def find_functions() -> list[FunctionType]:
    """Return the functions and methods of the loaded modules that guide the mutations.

    Functions that Numba compiles are left out: it cannot compile instrumented ones.
    """
    found = {}
    for name, module in sorted(sys.modules.items()):
        if not any(f"{name}.".startswith(f"{one}.") for one in INSTRUMENTED):
            continue
        own = [one for one in vars(module).values() if getattr(one, "__module__", "") == name]
        held = [
            *own,
            *(part for one in own if isinstance(one, type) for part in vars(one).values()),
        ]
        for one in held:
            plain = getattr(one, "fget", None) or getattr(one, "__func__", None) or one
            if isinstance(plain, FunctionType) and plain.__code__.co_filename == module.__file__:
                found[plain.__qualname__, name] = plain
    return list(found.values())


class SerialPool(futures.Executor):
    """Pool without threads, whose start takes longer than the reading of a small file."""

    def __init__(self, *_: object) -> None:
        pass

    def map(self, function, *lists, **_):
        """Return the results as an iterator, as a pool does."""
        return map(function, *lists)


def keep_unchanged_parts(reader: str) -> None:
    """Decode the files of a session once that are not fuzzed; each has a reader of its own."""
    from capture.session import contents, verification

    if reader in ("SESSION journal", "SESSION frame"):
        contents.decode = functools.lru_cache(contents.decode)
        verification.ThreadPoolExecutor = SerialPool
    if reader == "SESSION frame":
        contents.walk_journal = functools.lru_cache(contents.walk_journal)


def fuzz(reader: str, seed: int, runs: int, budget_s: float, place: Path) -> None:
    """Read mutated files in this process, which ends with the last run or the first failure."""
    import atheris

    sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests/faults")]
    import numpy as np
    from fixtures.mutations import mutate
    from fixtures.strangers_files import FORMATS
    from test_strangers_files import unclear_error, write_good

    for function in find_functions():
        atheris.instrument_func(function)
    form = FORMATS[reader]
    logging.disable()  # texts of the libraries, which take longer than the reading
    keep_unchanged_parts(reader)
    path = write_good(place / "read", form)
    good = path.read_bytes()[:MAX_FILE_BYTES]  # of MERL's 35 MB, the head
    corpus = place / "corpus"
    corpus.mkdir()
    (corpus / "good").write_bytes(good)

    def read_one(data: bytes) -> None:
        path.write_bytes(data)
        if unclear := unclear_error(form, path):
            (place / "failure.txt").write_text(unclear, "utf-8")
            (place / "failure.bin").write_bytes(data)
            raise AssertionError(unclear)

    rng = np.random.default_rng(seed)

    def change(data: bytes, max_size: int, _: int) -> bytes:
        own = rng.random() < 0.5
        return (mutate(data, rng) if own else atheris.Mutate(data, max_size))[:max_size]

    resource.setrlimit(resource.RLIMIT_DATA, (MAX_DATA_BYTES, MAX_DATA_BYTES))
    options = [f"-runs={runs}", f"-seed={seed}", f"-timeout={MAX_INPUT_S}", "-rss_limit_mb=0"]
    options += [f"-max_len={MAX_FILE_BYTES}", f"-artifact_prefix={place}/"]
    options += ["-close_fd_mask=3", "-print_final_stats=1", "-len_control=0"]
    if budget_s:
        options.append(f"-max_total_time={max(1, int(budget_s))}")
    atheris.Setup(["fuzz", *options, str(corpus)], read_one, custom_mutator=change)
    atheris.Fuzz()


def run_child(reader: str, seed: int, runs: int, budget_s: float) -> dict[str, object]:
    """Fuzz in a child process, and return a row of the table; keep a file that fails."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        place = Path(folder)
        (place / "read").mkdir()
        order = [reader, str(seed), str(runs), str(budget_s), folder]
        before_s = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        done = subprocess.run(
            [sys.executable, __file__, "--child", *order],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            check=False,
        )
        seconds = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before_s
        text = done.stdout.decode("utf-8", "replace")
        found = re.findall(r"number_of_executed_units:\s*(\d+)", text)
        if not found:
            raise SystemExit(f"{reader}: the child ended with {done.returncode}\n{text[-3000:]}")
        if done.returncode:
            kept = FAILURES / f"{reader.replace(' ', '-')}-{seed}"
            kept.mkdir(parents=True, exist_ok=True)
            for file in (one for one in place.iterdir() if one.is_file()):
                (kept / file.name).write_bytes(file.read_bytes())
            (kept / "log.txt").write_text(text[-20_000:], "utf-8")
            print(f"{reader}: seed {seed} fails; file and reason kept in {kept}", flush=True)
    values = (reader, seed, int(found[-1]), round(seconds), int(done.returncode != 0))
    return dict(zip(COLUMNS, values, strict=True))


def read_table() -> list[dict[str, str]]:
    """Return the rows of the table; none without a file."""
    if not TABLE.is_file():
        return []
    with TABLE.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def add_row(row: dict[str, object]) -> None:
    """Add a row to the table; several processes may, each for readers of its own."""
    fresh = not TABLE.is_file()
    with TABLE.open("a", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        if fresh:
            table.writeheader()
        table.writerow(row)


def sum_runs() -> tuple[Counter[str], Counter[str], Counter[str]]:
    """Return runs, processor seconds and failures of each reader."""
    runs, seconds, failures = Counter(), Counter(), Counter()
    for row in read_table():
        runs[row["reader"]] += int(row["runs"])
        seconds[row["reader"]] += int(row["seconds"])
        failures[row["reader"]] += int(row["failures"])
    return runs, seconds, failures


def fuzz_to(reader: str, wanted: int, budget_s: float) -> None:
    """Fuzz a reader until the table has the wanted runs, a file fails, or the seconds are over."""
    begun_s = time.monotonic()
    while (left := wanted - sum_runs()[0][reader]) > 0:
        left_s = budget_s - (time.monotonic() - begun_s)
        if left_s <= 0.0:
            return
        used = [int(row["seed"]) for row in read_table() if row["reader"] == reader]
        seed = max(used, default=0) + 1
        row = run_child(reader, seed, min(left, PART_RUNS), min(left_s, PART_S))
        add_row(row)
        print(f"{reader}: seed {seed}, {row['runs']} runs in {row['seconds']} s", flush=True)
        if row["failures"]:
            return


def main() -> None:
    """Fuzz the readers of the options, and print what the table has."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--readers", default="", help="names of tests/fixtures/strangers_files.py")
    parser.add_argument("--runs", type=int, default=1_000_000, help="runs that each shall have")
    parser.add_argument("--budget", type=float, default=PART_S, help="seconds of each reader")
    parser.add_argument("--day", type=int, help="YYYYMMDD: the seed, and the choice of a reader")
    order = parser.parse_args()
    if order.day is not None:
        reader = READERS[order.day % len(READERS)]
        row = run_child(reader, order.day, 10**9, order.budget)
        print(f"{reader}: seed {order.day}, {row['runs']} runs, {row['failures']} failures")
        raise SystemExit(row["failures"])
    for reader in filter(None, order.readers.split(",")):
        fuzz_to(reader, order.runs, order.budget)
    runs, seconds, failures = sum_runs()
    for reader in READERS:
        rate = runs[reader] / max(1, seconds[reader])
        text = f"{reader:18} {runs[reader]:9} runs {seconds[reader]:6} s {rate:6.0f} per s"
        print(f"{text} {failures[reader]:3} failures")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        name, seed_text, runs_text, budget_text, folder_text = sys.argv[2:]
        fuzz(name, int(seed_text), int(runs_text), float(budget_text), Path(folder_text))
    else:
        main()
