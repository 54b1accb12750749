"""Run commands of skinrig and print their longest stretch without a line of output.

skinrig demo --out DEMO
python tools/measure_silence.py DEMO --work WORK --commands report,view
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

COMMANDS: Mapping[str, Sequence[str]] = {
    "calibrate": ("calibrate", "lights", "{demo}/session-gradient-ball", "--out", "{work}/cal"),
    "reconstruct flash": (
        *("reconstruct", "{demo}/session-flash-II", "--calibration", "{demo}/calibration-flash"),
        *("--maps", "melanin,hemoglobin", "--out", "{work}/flash"),
    ),
    "reconstruct dome": (
        *("reconstruct", "{demo}/session-dome-III", "--calibration", "{demo}/calibration-dome"),
        *("--maps", "normals,r_d,normals_refined", "--out", "{work}/dome"),
    ),
    "reconstruct gradient": (
        *("reconstruct", "{demo}/session-gradient-forehead", "--maps", "normals,height,kernels"),
        *("--calibration", "{demo}/calibration-gradient", "--out", "{work}/gradient"),
    ),
    "reconstruct probe": (
        *("reconstruct", "{demo}/session-probe-III", "--calibration", "{demo}/calibration-probe"),
        *("--maps", "subsurface,translucency", "--out", "{work}/probe"),
    ),
    "simulate flash": ("simulate", "flash", "--subject", "IV", "--out", "{work}/session-flash"),
    "simulate dome": ("simulate", "dome", "--width", "160", "--out", "{work}/session-dome"),
    "simulate gradient": ("simulate", "gradient", "--out", "{work}/session-gradient"),
    "simulate probe": ("simulate", "probe", "--out", "{work}/session-probe"),
    "report": ("report", "{demo}", "-o", "{work}/report.html"),
    "view": ("view", "{demo}/appearance-flash-moving-II", "-o", "{work}/view.html"),
    "export": ("export", "{demo}/appearance-dome-III", "--to", "maps", "--out", "{work}/maps"),
    "bench": ("bench", "--smoke", "--budget", "20"),
    "demo": ("demo", "--out", "{work}/demo"),
}


def measure(arguments: Sequence[str]) -> tuple[int, float, float, str, int]:
    """Run a command; return exit code, seconds, longest silence in s, the line before it, lines."""
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "skinrig", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    if process.stdout is None:
        raise RuntimeError("got no pipe of the command's output, expected one")
    start = last_s = time.perf_counter()
    longest, before, line, count = 0.0, "", "(start)", 0
    for text in process.stdout:
        now = time.perf_counter()
        if now - last_s > longest:
            longest, before = now - last_s, line
        last_s, line, count = now, text.strip(), count + 1
    end = time.perf_counter()
    if end - last_s > longest:
        longest, before = end - last_s, line
    return process.wait(), end - start, longest, before, count


def main() -> None:
    """Measure the named commands."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("demo", type=Path, help="folder of `skinrig demo`")
    parser.add_argument("--work", type=Path, required=True, help="new folder for outputs")
    parser.add_argument("--commands", default=",".join(COMMANDS))
    given = parser.parse_args()
    given.work.mkdir(parents=True)
    print("command, exit code, seconds, longest silence in s, lines, line before the silence")
    for name in given.commands.split(","):
        arguments = [part.format(demo=given.demo, work=given.work) for part in COMMANDS[name]]
        code, seconds, longest, before, count = measure(arguments)
        print(f"{name}, {code}, {seconds:.1f}, {longest:.1f}, {count}, {before}", flush=True)


if __name__ == "__main__":
    main()
