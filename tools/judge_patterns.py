"""Judge the search for faults of polarized pairs and gradient patterns, on sets with known faults.

Each fault of ``tests/fixtures/faulty_patterns.py`` is made on three skin tones: on made surfaces,
and with ``--sessions`` on images of the simulated flash and gradient rigs. Prints, per fault, how
many sets have any finding and how many have it with the right images; then false alarms.

Usage: python tools/judge_patterns.py [--seeds N] [--first SEED] [--sound N] [--sessions N]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fixtures import faulty_patterns  # type: ignore[import-not-found]
from fixtures.faulty_stacks import TONES  # type: ignore[import-not-found]

from capture.session import Session
from reconstruction.pipeline.flash.pair_diagnosis import diagnose_pair, list_pairs
from reconstruction.pipeline.gradient import pattern_diagnosis
from reconstruction.pipeline.gradient.images import GradientImages, Key, StatePatterns
from reconstruction.pipeline.linear_frame import read_linear
from reconstruction.stack_diagnosis.pattern_faults import PATTERN_NAMES, find_pattern_faults
from reconstruction.stack_diagnosis.polarized_pairs import find_pair_faults

FIRST_SEED = 90_000
"""Rules were set on seeds 55000 to 55329, and on sessions of seeds 1 and 11 to 16."""
FIRST_SESSION_SEED = 1001
SUBJECTS = ("I", "III", "VI")
STATE_FAULTS = {"polarizers of x": ("x",), "polarizers of all": PATTERN_NAMES}
NOISE = 0.002
"""Standard deviation of an empty image of a session, over full scale."""
Result = tuple[str, str, bool, bool]
"""Images, fault, whether there is any finding, whether the right one names the right images."""


def judge(kind: str, fault: str, seed: int, tone: str) -> tuple[bool, bool]:
    """Return whether a made set has a finding, and whether one names the right images."""
    if kind == "pair":
        gray = not fault and seed % 2 == 1
        parallel, crossed, inside = faulty_patterns.make_pair(fault, seed, tone=tone, gray=gray)
        found = list(find_pair_faults(parallel, crossed, inside))
        right = faulty_patterns.PAIR_FAULTS.get(fault)
        return bool(found), [one.fault for one in found] == [right]
    images, inside, names = faulty_patterns.make_patterns(fault, seed, tone=tone)
    found = list(find_pattern_faults(images, inside))
    numbers = tuple(sorted(PATTERN_NAMES.index(name) for name in names))
    return bool(found), any(one.frames == numbers for one in found)


def judge_flash(path: Path) -> Iterator[Result]:
    """Yield the results of a simulated flash session's pairs, each with every fault."""
    session = Session.open(path)
    for pair in list_pairs(session):
        frames = [session.read(record) for record in pair]
        (parallel, usable), (crossed, also) = map(read_linear, frames)
        whole = [parallel, crossed, usable & also, frames[0].neutral, ("a", "b")]
        for fault in (*faulty_patterns.PAIR_FAULTS, ""):
            shown = list(whole)
            if "exposed" in fault:
                k = fault.startswith("crossed")
                shown[k] = 2 * shown[k]
                shown[2] = shown[2] & (shown[k] < 1.0).all(axis=-1)
            if "gray" in fault:
                shown[:2] = [one.mean(axis=-1, keepdims=True) for one in shown[:2]]
            if fault.startswith("exchanged"):
                shown[:2] = shown[1::-1]
            found = [one.fault for one in diagnose_pair(*shown).findings]
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
            values: dict[Key, np.ndarray],
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
                values = rest | {(n, light): np.float32(one) for n, one in spoiled.items()}
                named = [f"s {light} {name}" for name in names]
                yield (f"gradient session, {light}", fault, *diagnose(values, named))
        for fault, exchanged in STATE_FAULTS.items():
            values = dict(patterns.values)
            for name in exchanged:
                a, b = ((name, light) for light in pattern_diagnosis.POLARIZERS)
                values |= {a: patterns.values[b], b: patterns.values[a]}
            named = [f"s {light} {n}" for n in exchanged for light in pattern_diagnosis.POLARIZERS]
            yield ("gradient session, both", fault, *diagnose(values, named))


def judge_sessions(count: int) -> Iterator[Result]:
    """Simulate sessions of three skin tones, and yield their results."""
    seed = FIRST_SESSION_SEED
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


def judge_made(first: int, seeds: int, sound: int) -> Iterator[Result]:
    """Yield the results of made sets."""
    rows = [("pair", fault) for fault in (*faulty_patterns.PAIR_FAULTS, "")]
    rows += [("patterns", fault) for fault in (*faulty_patterns.PATTERN_FAULTS, "")]
    seed = first
    for kind, fault in rows:
        for tone in TONES:
            for _ in range(seeds if fault else sound):
                yield (kind, fault, *judge(kind, fault, seed, tone))
                seed += 1


def main() -> None:
    """Judge the sets that the command line gives, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=4, help="made sets per fault and tone")
    parser.add_argument("--sound", type=int, default=20, help="made sound sets per kind and tone")
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="first seed of made sets")
    parser.add_argument("--sessions", type=int, default=0, help="sessions per rig and skin tone")
    given = parser.parse_args()
    total: Counter[tuple[str, str, str]] = Counter()
    every = [judge_made(given.first, given.seeds, given.sound), judge_sessions(given.sessions)]
    for results in every:
        for kind, fault, found, named in results:
            total[kind, fault, "sets"] += 1
            total[kind, fault, "any"] += found
            total[kind, fault, "right"] += named
            print(f"\r{kind} {fault:30}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    print("| images | fault | sets | any finding | right images |")
    print("| --- | --- | --- | --- | --- |")
    for kind, fault in dict.fromkeys(key[:2] for key in total):
        sets, found, named = (total[kind, fault, name] for name in ("sets", "any", "right"))
        print(f"| {kind} | {fault or 'none'} | {sets} | {found} | {named if fault else ''} |")


if __name__ == "__main__":
    main()
