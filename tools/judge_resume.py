"""Kill commands with SIGKILL at random moments, repeat them, and compare the bytes.

Each command runs twice undisturbed; the first run fills the cache of compiled kernels. Then it is
killed, repeated (`reconstruct`: the same command, `simulate`: with --resume) and killed until it
ends. The seconds from its first step to the kill are drawn uniformly up to --span of the
undisturbed run's. All files of its output are compared with the undisturbed ones; the date of
simulated sessions is fixed by SOURCE_DATE_EPOCH. Stages and tiles that begin again although they
began before the kill are counted by the events of --json. A simulation replays its run: the images
that it computes again are counted, by a log of this tool.

    skinrig demo --out DEMO
    python tools/judge_resume.py DEMO --kills 50 --work WORK
    python tools/judge_resume.py DEMO --kills 50 --work WORK --commands "simulate flash"
"""

import argparse
import hashlib
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from rigsim.world import World
from skinrig.cli import main as main_command

RUN_WORD = "--run"
"""First argument of a process that runs one command."""
MAX_KILLS_PER_CHAIN = 8
"""Kills until a command may end: on a machine that became busier it might never."""
DATE_EPOCH_S = 1_795_000_000

RECONSTRUCTIONS: dict[str, tuple[str, str, str]] = {
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
"""Session, calibration (empty: none) and maps of each rig in the folder of a demo."""
SIMULATIONS: Mapping[str, Sequence[str]] = {
    "simulate flash": (
        *("flash", "--subject", "IV", "--width", "64", "--state", "neutral", "--state", "smile"),
        *("--omit", "lateral,interreflections,relief_shadows"),
    ),
    "simulate sequence": (
        *("flash", "--width", "48", "--sequence", "exercise", "--duration", "120"),
    ),
    "simulate dome": (
        *("dome", "--width", "64", "--lights", "12", "--views", "2"),
        *("--omit", "lateral,interreflections"),
    ),
    "simulate gradient": ("gradient", "--width", "64", "--angles", "0", "--steps", "-1..1"),
    "simulate probe": ("probe", "--subject", "homogeneous:0.08,1.2", "--sites", "cheek,chin"),
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
        Seconds from the first step to the kill, and those of the undisturbed run to its last step.
    same
        Whether the final output equals the undisturbed one.
    interrupted
        Stages and tiles at work when the process was killed that began again; of a simulation:
        images that were computed twice in a chain of kills, at its first.
    left_out
        Stages and tiles that were complete before the kill and began again, as storing them would
        have cost too much.
    left_out_s
        Seconds of these before the kill.
    """

    command: str
    after_s: float
    whole_s: float
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


def list_outputs(out: Path) -> list[Path]:
    """Return an output folder and, of a session, its ground truth's folders."""
    return [out, *sorted(out.parent.glob(f"truth-{out.name}*"))]


def hash_outputs(out: Path) -> dict[str, str]:
    """Hash the files of an output folder, and those of a session's ground truth."""
    return {
        f"{number}/{name}": digest
        for number, folder in enumerate(list_outputs(out))
        for name, digest in hash_folder(folder).items()
    }


def remove_outputs(out: Path) -> None:
    """Remove an output folder, and the ground truth of a session."""
    for folder in list_outputs(out):
        shutil.rmtree(folder, ignore_errors=True)


def start(arguments: Sequence[str], log: Path) -> "subprocess.Popen[bytes]":
    """Start skinrig with --json; its events go to a file, its computed exposures to another."""
    words = [sys.executable, __file__, RUN_WORD, str(log), *arguments]
    with open(log, "wb") as stream:
        return subprocess.Popen(
            words, stdout=subprocess.DEVNULL, stderr=stream, start_new_session=True
        )


def run_command(arguments: Sequence[str], log: Path) -> int:
    """Run skinrig, and log each computed exposure; return its exit code."""
    computed, expose = log.with_suffix(".computed"), World.expose

    def count(self: World, view: str, *given: Any, seed: int, **light: Any) -> Any:
        with computed.open("a") as stream:
            stream.write(f"{view} {seed}\n")
        return expose(self, view, *given, seed=seed, **light)

    setattr(World, "expose", count)  # noqa: B010
    return main_command([*arguments, "--json"])


def read_computed(log: Path) -> list[str]:
    """Return the exposures that were computed since the file was removed."""
    path = log.with_suffix(".computed")
    return path.read_text().splitlines() if path.exists() else []


def read_events(log: Path) -> list[tuple[str, float]]:
    """Return text and seconds of the beginnings of steps in a file."""
    events = []
    for line in (log.read_text() if log.exists() else "").splitlines():
        if line.startswith('{"event"') and line.endswith("}"):
            event = json.loads(line)
            if event["event"] == "progress":
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


def kill_until_done(
    name: str,
    run: Sequence[str],
    out: Path,
    *,
    whole: tuple[float, Mapping[str, str]],
    rng: np.random.Generator,
    again: Sequence[str] = (),
    span: float = 0.5,
    most: float = np.inf,
) -> list[Kill]:
    """Kill a command at random moments, but at `most` times, until it ends; compare its output."""
    seconds, expected = whole
    log = out.with_suffix(".log")
    kills: list[tuple[float, list[tuple[str, float]]]] = []
    code = None
    while code is None:
        after_s = float(rng.uniform(0.0, span * seconds))
        log.unlink(missing_ok=True)
        begun = (out / "session.json").exists() or not again
        process = start([*run, *(again if begun else ())], log)
        while process.poll() is None and not read_events(log):
            time.sleep(0.02)
        try:
            code = process.wait(timeout=after_s if len(kills) < most else None)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        kills.append((after_s, read_events(log)))
    found = hash_outputs(out)
    same = code == 0 and found == expected and not list(out.parent.glob(f".{out.name}.*"))
    if not same:
        names = found.keys() | expected.keys()
        differing = sorted(file for file in names if found.get(file) != expected.get(file))
        print(f"{name}: exit code {code}, differing {differing[:5]}", file=sys.stderr)
    computed = read_computed(log)
    log.with_suffix(".computed").unlink(missing_ok=True)
    remove_outputs(out)
    repeats = len(computed) - len(set(computed)), (), 0.0
    return [
        # all images of a chain that were computed again are those of its first kill
        Kill(name, after_s, seconds, same, *(repeats if number == 0 else (0, (), 0.0)))
        if again
        else Kill(name, after_s, seconds, same, *count_repeated(before, after))
        for number, ((after_s, before), (_, after)) in enumerate(pairwise(kills))
    ]


def judge(
    demo: Path,
    work: Path,
    names: Sequence[str],
    kills: int,
    seed: int,
    span: float = 0.5,
    compiled: bool = False,
) -> list[Kill]:
    """Kill each command in turn until there are enough kills; print each outcome."""
    rng = np.random.default_rng(seed)
    runs: dict[str, tuple[list[str], tuple[str, ...]]] = {}
    for name in names:
        if name in SIMULATIONS:
            runs[name] = (["simulate", *SIMULATIONS[name], "--seed", "3"], ("--resume",))
        else:
            session, calibration, maps = RECONSTRUCTIONS[name]
            given = [str(demo / session)]
            if calibration:
                given += ["--calibration", str(demo / calibration)]
            runs[name] = (["reconstruct", *given, "--maps", maps], ())
    found: list[Kill] = []
    undisturbed: dict[str, tuple[float, Mapping[str, str]]] = {}
    out = work / "out"
    log = work / "whole.log"
    for name in itertools.cycle(runs):
        if len(found) >= kills:
            break
        run, again = runs[name]
        for _ in () if name in undisturbed else ("compile", "judge")[compiled:]:
            process = start([*run, "--out", str(out)], log)
            if process.wait() != 0:
                raise SystemExit(log.read_text())
            events = read_events(log)
            undisturbed[name] = events[-1][1] - events[0][1], hash_outputs(out)
            log.with_suffix(".computed").unlink(missing_ok=True)
            remove_outputs(out)
        given_out = [*run, "--out", str(out)]
        chain = kill_until_done(
            name,
            given_out,
            out,
            whole=undisturbed[name],
            rng=rng,
            again=again,
            span=span,
            most=MAX_KILLS_PER_CHAIN,
        )
        found += chain
        for kill in chain:
            print(json.dumps(asdict(kill)), flush=True)
    return found


def main() -> int:
    """Judge by the arguments; 1 when an output differs or more than one part repeats per kill."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("demo", type=Path, help="folder of `skinrig demo`")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--span", type=float, default=0.5, help="latest kill, over the run's time")
    parser.add_argument("--compiled", action="store_true", help="kernels are in the cache")
    parser.add_argument("--commands", default=",".join([*RECONSTRUCTIONS, *SIMULATIONS]))
    parser.add_argument("--work", type=Path, required=True, help="new folder for outputs")
    given = parser.parse_args()
    given.work.mkdir(parents=True)
    os.environ["SOURCE_DATE_EPOCH"] = str(DATE_EPOCH_S)
    names = given.commands.split(",")
    found = judge(
        given.demo, given.work, names, given.kills, given.seed, given.span, given.compiled
    )
    print("command, kills, same bytes, interrupted parts, complete parts again, their seconds")
    for name in names:
        own = [kill for kill in found if kill.command == name]
        same = sum(kill.same for kill in own)
        parts = sum(kill.interrupted for kill in own), sum(len(kill.left_out) for kill in own)
        print(name, len(own), same, *parts, round(sum(kill.left_out_s for kill in own), 1))
    # a killed simulation repeats the image that it computed; a chain of kills is judged as a whole
    simulated = [kill for kill in found if kill.command.startswith("simulate")]
    repeated = sum(kill.interrupted for kill in simulated) > len(simulated)
    repeated |= any(kill.interrupted > 1 for kill in found if kill not in simulated)
    return int(repeated or any(not kill.same for kill in found))


if __name__ == "__main__":
    if sys.argv[1:2] == [RUN_WORD]:
        sys.exit(run_command(sys.argv[3:], Path(sys.argv[2])))
    sys.exit(main())
