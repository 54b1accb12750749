"""Judge the diagnosis of images under listed lights on sets with one known fault each.

The sets come from ``tests/fixtures/faulty_stacks.py``: heads, reliefs and balls with highlights,
cast shadows and noise, 12, 24 or 40 lights. Prints, per fault, how many sets have the finding and
how many name the right images, and the false alarms on sound sets.

Usage: python tools/judge_diagnosis.py [--seeds N] [--first SEED]
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fixtures.faulty_stacks import FAULTS, make  # type: ignore[import-not-found]

from reconstruction.stack_diagnosis import diagnose_stack


def find(fault: str, seed: int) -> tuple[set[tuple[str, tuple[int, ...]]], tuple[int, ...]]:
    """Return the findings of a set, and the numbers of its faulty images."""
    stack = make(fault, seed)
    found = diagnose_stack(
        stack.images,
        stack.lights,
        usable=stack.images < 0.998,
        inside=stack.inside,
        rng=np.random.default_rng(0),
    )
    return {(one.fault, one.frames) for one in found.findings}, stack.frames


def main() -> None:
    """Judge all faults on the seeds that the command line gives."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=24, help="sets of each fault")
    parser.add_argument("--first", type=int, default=1000, help="first seed; none is used twice")
    given = parser.parse_args()
    seed = given.first
    print("| fault | sets | found | right images | other findings |")
    print("| --- | --- | --- | --- | --- |")
    total: Counter[str] = Counter()
    for fault, name in FAULTS.items():
        count: Counter[str] = Counter()
        for _ in range(given.seeds):
            found, frames = find(fault, seed)
            seed += 1
            count["found"] += any(one == name for one, _ in found)
            count["named"] += (name, frames) in found
            count["others"] += any(one != name for one, _ in found)
        total += count
        counts = " | ".join(str(count[key]) for key in ("found", "named", "others"))
        print(f"| {fault} | {given.seeds} | {counts} |", flush=True)
    sets = given.seeds * len(FAULTS)
    print(f"| all | {sets} | {total['found']} | {total['named']} | {total['others']} |")
    sound = 4 * given.seeds
    alarms = sum(bool(find("", seed + number)[0]) for number in range(sound))
    print(f"false alarms on sound sets: {alarms} of {sound}")


if __name__ == "__main__":
    main()
