"""Judge the search for faults of polarized pairs and gradient patterns on simulated sessions.

Simulates sessions of the flash and the gradient rig on three skin tones, and makes each fault of
``tests/fixtures/faulty_patterns.py`` in their images. Prints, per fault, how many sets have any
finding and how many have the right images; the rows "none" are false alarms. Made surfaces are
judged by ``tools/judge_diagnosis.py``.

Usage: python tools/judge_patterns.py [--sessions N] [--first SEED]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fixtures import faulty_patterns  # type: ignore[import-not-found]

from capture.session import Session
from reconstruction.arrays import Float32Array
from reconstruction.pipeline.flash.pair_diagnosis import diagnose_pair, list_pairs
from reconstruction.pipeline.gradient import pattern_diagnosis
from reconstruction.pipeline.gradient.images import GradientImages, Key, StatePatterns
from reconstruction.pipeline.linear_frame import read_linear
from reconstruction.stack_diagnosis.pattern_faults import PATTERN_NAMES

FIRST_SEED = 1001
"""Rules were set on seeds 1 and 11 to 16."""
SUBJECTS = ("I", "III", "VI")
STATE_FAULTS = {"polarizers of x": ("x",), "polarizers of all": PATTERN_NAMES}
NOISE = 0.002
"""Standard deviation of an empty image of a session, over full scale."""
Result = tuple[str, str, bool, bool]
"""Images, fault, whether there is any finding, whether the right one names the right images."""


def judge_flash(path: Path) -> Iterator[Result]:
    """Yield the results of a simulated flash session's pairs, each with every fault."""
    session = Session.open(path)
    for pair in list_pairs(session):
        frames = [session.read(record) for record in pair]
        (parallel, usable), (crossed, also) = map(read_linear, frames)
        for fault in (*faulty_patterns.PAIR_FAULTS, ""):
            shown = [parallel, crossed]
            clear = usable & also
            if "longer" in fault:
                k = int(fault.startswith("crossed"))
                shown[k] = 2 * shown[k]
                clear = clear & (shown[k] < 1.0).all(axis=-1)
            if "gray" in fault:
                shown = [one.mean(axis=-1, keepdims=True) for one in shown]
            if fault.startswith("exchanged"):
                shown = shown[::-1]
            group = diagnose_pair(shown[0], shown[1], clear, frames[0].neutral, ("a", "b"))
            found = [one.fault for one in group.findings]
            right = found == [faulty_patterns.PAIR_FAULTS.get(fault)]
            yield "flash session", fault, bool(found), right


def judge_gradient(path: Path, seed: int) -> Iterator[Result]:
    """Yield the results of a simulated gradient session's strain steps, each with every fault."""
    session = Session.open(path)
    images = GradientImages(session)
    planned = pattern_diagnosis.list_planned_patterns(session)
    for number, state in enumerate(images.states):
        patterns = images.of(state)

        def diagnose(
            values: Mapping[Key, Float32Array],
            names: list[str],
            patterns: StatePatterns = patterns,
            keys: tuple[Key, ...] = planned[state.name],
        ) -> tuple[bool, bool]:
            shown = replace(patterns, values=values)
            found = pattern_diagnosis.diagnose_state(shown, keys, name="s")
            named = [sorted(found.names[k] for k in one.frames) for one in found.findings]
            return bool(named), sorted(names) in named

        rng = np.random.default_rng([seed, number])
        for light in pattern_diagnosis.POLARIZERS:
            own = {name: one for (name, other), one in patterns.values.items() if other == light}
            rest = {key: one for key, one in patterns.values.items() if key[1] != light}
            for fault in (*faulty_patterns.PATTERN_FAULTS, ""):
                spoiled, names = faulty_patterns.spoil(fault, own, rng, NOISE)
                values = rest | {(n, light): one.astype(np.float32) for n, one in spoiled.items()}
                named = [f"s {light} {name}" for name in names]
                yield (f"gradient session, {light}", fault, *diagnose(values, named))
        for fault, exchanged in STATE_FAULTS.items():
            values = dict(patterns.values)
            for name in exchanged:
                a, b = (name, "parallel"), (name, "crossed")
                values |= {a: patterns.values[b], b: patterns.values[a]}
            named = [f"s {light} {n}" for n in exchanged for light in pattern_diagnosis.POLARIZERS]
            yield ("gradient session, both", fault, *diagnose(values, named))


def judge_sessions(count: int, seed: int) -> Iterator[Result]:
    """Simulate sessions of three skin tones, and yield their results."""
    options = {"flash": ["--width", "96"], "gradient": ["--width", "128", "--angles", "0"]}
    options["gradient"] += ["--steps", "-1..1"]
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(count):
            for subject in SUBJECTS:
                for rig, given in options.items():
                    out = Path(folder) / f"{rig}-{seed}"
                    argv = ["skinrig", "simulate", rig, "--out", str(out), "--subject", subject]
                    subprocess.run(
                        [*argv, "--seed", str(seed), *given], check=True, capture_output=True
                    )
                    yield from judge_flash(out) if rig == "flash" else judge_gradient(out, seed)
                    seed += 1


def main() -> None:
    """Judge the sessions that the command line asks for, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=3, help="sessions per rig and skin tone")
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="first seed")
    given = parser.parse_args()
    total: Counter[tuple[str, str, str]] = Counter()
    for kind, fault, found, named in judge_sessions(given.sessions, given.first):
        total[kind, fault, "sets"] += 1
        total[kind, fault, "any"] += found
        total[kind, fault, "right"] += named
        print(f"\r{kind} {fault:30}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    print("| images | fault | sets | any finding | right images |")
    print("| --- | --- | --- | --- | --- |")
    for kind, fault in dict.fromkeys(key[:2] for key in total):
        sets, any_found, right = (total[kind, fault, name] for name in ("sets", "any", "right"))
        print(f"| {kind} | {fault or 'none'} | {sets} | {any_found} | {right if fault else ''} |")


if __name__ == "__main__":
    main()
