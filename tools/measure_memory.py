"""Measure peak memory and disk of `skinrig simulate` and `skinrig reconstruct` at several sizes.

Prints one row per command: the megapixels of its cameras and of all frames, the peak resident
memory and address space of the process, and the bytes that it wrote, which skinrig/data/memory.toml
is set on and judged by.

python tools/measure_memory.py --work WORK [--rigs flash,probe] [--sizes set|judged]
"""

import argparse
import csv
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from capture.session import Session
from skinrig.resources.forecast import count_megapixels, measure_folder_mb

Size = tuple[str, ...]
SIZES: dict[str, dict[str, tuple[Size, ...]]] = {
    "set": {
        "flash": (("--width", "128"), ("--width", "960"), ("--width", "128", "--repeats", "4")),
        "dome": (
            ("--width", "96", "--lights", "48", "--views", "6"),
            ("--width", "640", "--lights", "4", "--views", "2"),
            ("--width", "1300", "--lights", "4", "--views", "4"),
            ("--width", "1300", "--lights", "2", "--views", "16"),
        ),
        "gradient": (
            ("--width", "96", "--angles", "0"),
            ("--width", "224", "--angles", "0", "--steps", "0..0"),
            ("--width", "512", "--angles", "0", "--steps", "0..0"),
        ),
        "probe": (("--sites", "cheek"), ("--sites", "cheek", "--repeats", "4")),
    },
    "judged": {
        "flash": (("--width", "384"), ("--width", "640")),
        "dome": (
            ("--width", "224", "--lights", "16", "--views", "4"),
            ("--width", "320", "--lights", "12", "--views", "3"),
        ),
        "gradient": (("--width", "320", "--angles", "0", "--steps", "0..1"),),
        "probe": (("--sites", "cheek,forehead", "--repeats", "2"),),
    },
}
"""Options of the simulation of each rig."""
MAPS = {
    "flash": "melanin,hemoglobin,diffuse,specular",
    "dome": "half_vector_normals,normals",
    "gradient": "normals,height,histograms",
    "probe": "subsurface,translucency",
}
CALIBRATED = ("probe",)
"""Rigs that make no map without a calibration, which is that of a demo."""
POLL_S = 0.05


def measure(arguments: Sequence[str]) -> tuple[int, float, float, float]:
    """Run a command; return exit code, processor s, peak resident MB and peak address space MB."""
    process = subprocess.Popen(
        [sys.executable, "-m", "skinrig", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    status = Path(f"/proc/{process.pid}/status")
    space_mb = 0.0
    while os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
        for line in status.read_text("ascii", errors="replace").splitlines():
            if line.startswith("VmPeak:"):
                space_mb = float(line.split()[1]) * 1024e-6
        time.sleep(POLL_S)
    _, code, usage = os.wait4(process.pid, 0)
    if code and process.stderr is not None:
        sys.stderr.write(process.stderr.read().decode(errors="replace")[-2000:])
    return code, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024e-6, space_mb


def main() -> None:
    """Measure all sizes of the rigs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--demo", type=Path, help="folder of `skinrig demo`")
    parser.add_argument("--rigs", default="flash,probe,gradient,dome")
    parser.add_argument("--sizes", choices=tuple(SIZES), default="set")
    order = parser.parse_args()
    order.work.mkdir(parents=True, exist_ok=True)
    table = csv.writer(sys.stdout)
    table.writerow(
        "work,size,camera_mp,frame_mp,state_mp,code,cpu_s,peak_mb,space_mb,disk_mb".split(",")
    )
    for rig in order.rigs.split(","):
        for number, size in enumerate(SIZES[order.sizes][rig]):
            name = f"{rig}-{order.sizes}{number}"
            session = order.work / f"session-{name}"
            run = ("simulate", rig, *size, "--subject", "III", "--out", str(session))
            measured = measure(run)
            opened = Session.open(session)
            pixels = count_megapixels(opened.rig, opened.plan, opened.omitted_steps())
            disk_mb = measure_folder_mb(session) + measure_folder_mb(order.work / f"truth-{name}")
            label = " ".join(size)
            table.writerow((f"simulate {rig}", label, *pixels.values(), *measured, disk_mb))
            sys.stdout.flush()
            out = order.work / f"appearance-{name}"
            run = ("reconstruct", str(session), "--maps", MAPS[rig], "--out", str(out))
            if rig in CALIBRATED:
                run += ("--calibration", str(order.demo / f"calibration-{rig}"))
            measured = measure(run)
            row = (f"reconstruct {rig}", label, *pixels.values(), *measured, measure_folder_mb(out))
            table.writerow(row)
            sys.stdout.flush()


if __name__ == "__main__":
    main()
