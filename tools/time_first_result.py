"""Time `make demo` in fresh clones: until the first report with pictures, and until the end.

    python tools/time_first_result.py [--runs 3] [--source FOLDER]

Each run clones the repository into a new folder. The home folder and its caches are new, too, so
that nothing is installed or compiled; pip's own settings stay. Then `make demo` runs again, warm.
Times include what pip loads from its sources. The machine should be idle.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

REPORT = Path("demo/report.html")
PICTURE = b"data:image/"
POLL_S = 0.2


def main(source: Path, runs: int) -> None:
    """Print a row per run, s."""
    print("run | first report with pictures | whole demo | whole demo, warm")
    for number in range(1, runs + 1):
        with tempfile.TemporaryDirectory() as name:
            first_s, whole_s, warm_s = _time_clone(source, Path(name))
        print(f"{number} | {first_s:.0f} | {whole_s:.0f} | {warm_s:.0f}", flush=True)


def _time_clone(source: Path, folder: Path) -> tuple[float, float, float]:
    kept = {key: value for key, value in os.environ.items() if not _is_of_this_python(key)}
    own = str(Path(sys.prefix) / "bin")
    path = os.pathsep.join(p for p in os.get_exec_path() if p != own)
    environment = kept | {
        "HOME": str(folder),
        "XDG_CACHE_HOME": str(folder / "cache"),
        "PATH": path,
    }
    clone = folder / "skinrig"
    start = time.monotonic()
    subprocess.run(["git", "clone", "--quiet", str(source), str(clone)], check=True)
    first_s, whole_s = _time_demo(clone, environment, start)
    (clone / REPORT).unlink()
    start = time.monotonic()
    return first_s, whole_s, _time_demo(clone, environment, start)[1]


def _is_of_this_python(key: str) -> bool:
    return key.startswith(("PYTHON", "NUMBA", "SKINRIG")) or key == "VIRTUAL_ENV"


def _time_demo(clone: Path, environment: dict[str, str], start: float) -> tuple[float, float]:
    """Return seconds from the start to the first report with pictures, and to the end."""
    demo = subprocess.Popen(["make", "demo"], cwd=clone, env=environment, stdout=sys.stderr)
    first_s: float | None = None
    ended = False
    while not ended:
        ended = demo.poll() is not None  # a report of the last moment counts, too
        report = clone / REPORT
        if first_s is None and report.is_file() and PICTURE in report.read_bytes():
            first_s = time.monotonic() - start
        time.sleep(0.0 if ended else POLL_S)
    if demo.returncode:
        raise SystemExit(f"make demo: got exit code {demo.returncode}; its output is above")
    if first_s is None:
        raise SystemExit(f"make demo: {REPORT} got no picture")
    return first_s, time.monotonic() - start


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", 1)[0])
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--source", type=Path, default=Path(__file__).resolve().parents[1])
    given = parser.parse_args()
    main(given.source, given.runs)
