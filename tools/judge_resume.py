"""Kill commands with SIGKILL at random moments, repeat them, and compare the bytes.

Each command of `COMMANDS` runs once undisturbed. Then it is killed at a moment drawn uniformly over
the seconds of the undisturbed run, repeated to its end (`reconstruct`: with the same command,
`simulate`: with --resume), and its output is compared with the undisturbed one. Stages and tiles
that begin again although they began before the kill are counted by the events of --json.

    skinrig demo --out DEMO
    python tools/judge_resume.py DEMO --kills 50 --out record.json
"""

import argparse
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

RECONSTRUCTIONS: Mapping[str, tuple[str, str, str]] = {
    "flash": (
        "session-flash-II",
        "calibration-flash",
        "melanin,hemoglobin,shading,diffuse,specular,tsumura_melanin",
    ),
    "dome": (
        "session-dome-III",
        "calibration-dome",
        "half_vector_normals,normals,r_d,normals_refined,samples",
    ),
    "gradient": (
        "session-gradient-forehead",
        "calibration-gradient",
        "normals,height,crossed,strain,histograms,kernels",
    ),
    "probe": ("session-probe-III", "calibration-probe", "profiles,subsurface,translucency"),
}
"""Session, calibration and maps of each rig in the folder of a demo."""
SIMULATIONS: Mapping[str, Sequence[str]] = {
    "simulate flash": ("flash", "--subject", "IV", "--width", "96"),
    "simulate probe": ("probe", "--subject", "homogeneous:0.08,1.2"),
}
"""Arguments of `skinrig simulate`."""


@dataclass(frozen=True, slots=True)
class Kill:
    """Outcome of one kill.

    Attributes
    ----------
    command
        Name of the command.
    after_s, whole_s
        Seconds from the start to the kill, and those of the undisturbed run.
    killed
        False when the command had ended before.
    same
        Whether the output equals the undisturbed one.
    interrupted
        Stages and tiles at work when the process was killed that began again.
    left_out
        Stages and tiles that were complete before the kill and began again, as storing them would
        have cost too much.
    left_out_s
        Seconds of these before the kill.
    """

    command: str
    after_s: float
    whole_s: float
    killed: bool
    same: bool
    interrupted: int
    left_out: tuple[str, ...]
    left_out_s: float


def hash_folder(folder: Path) -> dict[str, str]:
    """Hash the files of a folder by their relative paths."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def start(arguments: Sequence[str], log: Path) -> "subprocess.Popen[bytes]":
    """Start skinrig with --json; its events go to a file."""
    with open(log, "wb") as stream:
        return subprocess.Popen(
            [sys.executable, "-m", "skinrig", *arguments, "--json"],
            stdout=subprocess.DEVNULL,
            stderr=stream,
            start_new_session=True,
        )


def read_events(log: Path) -> list[tuple[str, float]]:
    """Return text and seconds of the complete events in a file."""
    events = []
    for line in log.read_text().splitlines():
        if line.startswith('{"event"') and line.endswith("}"):
            event = json.loads(line)
            events.append((str(event["text"]), float(event["seconds"])))
    return events


def count_repeated(
    before: Sequence[tuple[str, float]], after: Sequence[tuple[str, float]]
) -> tuple[int, tuple[str, ...], float]:
    """Return how many interrupted parts, which complete parts and how many of their seconds repeat.

    Parameters
    ----------
    before, after
        Beginnings of stages and tiles before and after the kill: text and seconds.

    Examples
    --------
    >>> before = [("frames", 0.0), ("fit", 0.5), ("fit: 0/2", 0.5), ("fit: 1/2", 9.0)]
    >>> count_repeated(before, [("frames", 0.0), ("fit", 0.5), ("fit: 1/2", 0.5)])
    (1, ('frames',), 0.5)
    """
    again = {text for text, _ in after}
    interrupted, complete, seconds = 0, [], 0.0
    for number, (text, at_s) in enumerate(before):
        if text not in again:
            continue
        parts = any(other.startswith(f"{text}: ") for other, _ in before[number + 1 :])
        if number == len(before) - 1:
            interrupted += 1
        elif not parts:
            complete.append(text)
            seconds += before[number + 1][1] - at_s
    return interrupted, tuple(complete), seconds


def kill_once(
    name: str,
    run: Sequence[str],
    out: Path,
    *,
    whole: tuple[float, Mapping[str, str]],
    after_s: float,
    again: Sequence[str] = (),
) -> Kill:
    """Kill a command after some seconds, repeat it to its end, and compare its output."""
    seconds, expected = whole
    first, second = out.with_suffix(".first"), out.with_suffix(".second")
    process = start(run, first)
    try:
        process.wait(timeout=after_s)
        killed = False
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        killed = True
    started = out.exists()
    code = start([*run, *(again if started else ())], second).wait()
    before, after = read_events(first), read_events(second)
    interrupted, left_out, left_out_s = count_repeated(before, after) if killed else (0, (), 0.0)
    same = code == 0 and hash_folder(out) == expected
    same &= not list(out.parent.glob(f".{out.name}.*"))
    shutil.rmtree(out)
    return Kill(name, after_s, seconds, killed, same, interrupted, left_out, left_out_s)


def judge(demo: Path, work: Path, names: Sequence[str], kills: int, seed: int) -> list[Kill]:
    """Kill each command in turn until there are enough kills; print each outcome."""
    rng = np.random.default_rng(seed)
    runs: dict[str, tuple[list[str], tuple[str, ...]]] = {}
    for name in names:
        if name in SIMULATIONS:
            runs[name] = (["simulate", *SIMULATIONS[name], "--seed", "3"], ("--resume",))
        else:
            session, calibration, maps = RECONSTRUCTIONS[name]
            given = [str(demo / session), "--calibration", str(demo / calibration)]
            runs[name] = (["reconstruct", *given, "--maps", maps], ())
    found: list[Kill] = []
    undisturbed: dict[str, tuple[float, Mapping[str, str]]] = {}
    out = work / "out"
    for name, (run, _) in runs.items():
        for _ in range(2):  # the first run may compile
            shutil.rmtree(out, ignore_errors=True)
            began = time.perf_counter()
            if start([*run, "--out", str(out)], work / "whole").wait() != 0:
                raise SystemExit((work / "whole").read_text())
            hashes = hash_folder(out)
            if name in undisturbed and undisturbed[name][1] != hashes:
                raise SystemExit(f"{name}: two undisturbed runs differ")
            undisturbed[name] = time.perf_counter() - began, hashes
        shutil.rmtree(out)
    while sum(kill.killed for kill in found) < kills:
        name = list(runs)[len(found) % len(runs)]
        run, again = runs[name]
        whole = undisturbed[name]
        after_s = float(rng.uniform(0.0, whole[0]))
        found.append(
            kill_once(
                name, [*run, "--out", str(out)], out, whole=whole, after_s=after_s, again=again
            )
        )
        print(json.dumps(asdict(found[-1])), flush=True)
    return found


def main() -> int:
    """Judge by the arguments; 1 when an output differs or more than one part repeats per kill."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("demo", type=Path, help="folder of `skinrig demo`")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", default=",".join([*RECONSTRUCTIONS, *SIMULATIONS]))
    parser.add_argument("--work", type=Path, required=True, help="new folder for outputs")
    given = parser.parse_args()
    given.work.mkdir(parents=True)
    names = given.commands.split(",")
    found = judge(given.demo, given.work, names, given.kills, given.seed)
    print("command, kills, same bytes, interrupted parts, complete parts again, their seconds")
    for name in names:
        own = [kill for kill in found if kill.command == name and kill.killed]
        same = sum(kill.same for kill in own)
        parts = sum(kill.interrupted for kill in own), sum(len(kill.left_out) for kill in own)
        print(name, len(own), same, *parts, round(sum(kill.left_out_s for kill in own), 1))
    return int(any(not kill.same or kill.interrupted > 1 for kill in found))


if __name__ == "__main__":
    sys.exit(main())
