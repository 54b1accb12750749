"""Run a reconstruction and print how many processors each of its stages can use.

    python tools/measure_threads.py reconstruct SESSION --maps normals --out MAPS

A thread is able to run while it computes or waits for a processor. The seconds of both, of all
threads, over the wall seconds of a stage are the processors that the stage can use. Waits count, so
that other programs on the machine do not change the figure much.
"""

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

INTERVAL_S = 0.05


def able_s(pid: int) -> dict[str, float]:
    """Return the seconds in which each thread of a process was able to run, by its number."""
    found = {}
    for task in Path(f"/proc/{pid}/task").iterdir():
        try:
            computed, waited, _ = (task / "schedstat").read_text().split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        found[task.name] = 1e-9 * (int(computed) + int(waited))
    return found


def main() -> None:
    """Run the command and print its stages, slowest first."""
    process = subprocess.Popen(
        [sys.executable, "-m", "skinrig", *sys.argv[1:], "--json"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    if process.stderr is None:
        raise RuntimeError("got no pipe of the command's progress, expected one")
    stage, lock = ["start"], threading.Lock()
    used: dict[str, list[float]] = {}

    def sample() -> None:
        last, then = able_s(process.pid), time.perf_counter()
        while process.poll() is None:
            time.sleep(INTERVAL_S)
            try:
                now, at_s = able_s(process.pid), time.perf_counter()
            except FileNotFoundError:
                return
            with lock:
                row = used.setdefault(stage[0], [0.0, 0.0])
            # threads that ended since are lost, at most one interval of each
            row[0] += sum(value - last.get(name, 0.0) for name, value in now.items())
            row[1] += at_s - then
            last, then = now, at_s

    sampler = threading.Thread(target=sample)
    sampler.start()
    for line in process.stderr:
        if line.startswith('{"event": "progress"'):
            with lock:
                stage[0] = json.loads(line)["text"].partition(":")[0]
        elif not line.startswith("{"):
            print(line, end="")
    code = process.wait()
    sampler.join()
    print(f"exit code {code}, {os.cpu_count()} processors")
    print("stage, seconds, processors in use or waited for")
    for name, (able, wall) in sorted(used.items(), key=lambda item: -item[1][1]):
        print(f"{name}, {wall:.1f}, {able / wall:.2f}")
    able, wall = (sum(row[k] for row in used.values()) for k in (0, 1))
    print(f"all, {wall:.1f}, {able / wall:.2f}")
    sys.exit(code)


if __name__ == "__main__":
    main()
