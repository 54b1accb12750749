"""Judge the search for faults of polarized pairs and gradient patterns, on made sets.

Each fault of ``tests/fixtures/faulty_patterns.py`` is made on three skin tones. Prints, per fault,
how many sets have any finding and how many have it with the right images; then false alarms.

Usage: python tools/judge_patterns.py [--seeds N] [--first SEED] [--sound N]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fixtures import faulty_patterns  # type: ignore[import-not-found]
from fixtures.faulty_stacks import TONES  # type: ignore[import-not-found]

from reconstruction.stack_diagnosis.pattern_faults import (
    PATTERN_NAMES,
    find_exchanged_pair,
    find_pattern_faults,
)

FIRST_SEED = 80_000
"""Rules were set on seeds 55000 to 55179."""


def judge(kind: str, fault: str, seed: int, tone: str) -> tuple[bool, bool]:
    """Return whether a set has a finding, and whether one names the right images."""
    if kind == "pair":
        parallel, crossed, inside = faulty_patterns.make_pair(fault, seed, tone=tone)
        found = list(find_exchanged_pair(parallel, crossed, inside))
        return bool(found), bool(found) and bool(fault)
    images, inside, names = faulty_patterns.make_patterns(fault, seed, tone=tone)
    found = list(find_pattern_faults(images, inside))
    numbers = tuple(sorted(PATTERN_NAMES.index(name) for name in names))
    return bool(found), any(one.frames == numbers for one in found)


def main() -> None:
    """Judge the sets that the command line gives, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=4, help="sets per fault and tone")
    parser.add_argument("--sound", type=int, default=20, help="sound sets per kind and tone")
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="first seed")
    given = parser.parse_args()
    rows = [("pair", fault) for fault in (*faulty_patterns.PAIR_FAULTS, "")]
    rows += [("patterns", fault) for fault in (*faulty_patterns.PATTERN_FAULTS, "")]
    seed = given.first
    print("| images | fault | sets | any finding | right images |")
    print("| --- | --- | --- | --- | --- |")
    for kind, fault in rows:
        results = []
        for tone in TONES:
            for _ in range(given.seeds if fault else given.sound):
                results.append(judge(kind, fault, seed, tone))
                seed += 1
        found, named = (sum(column) for column in zip(*results, strict=True))
        right = str(named) if fault else ""
        print(f"| {kind} | {fault or 'none'} | {len(results)} | {found} | {right} |", flush=True)


if __name__ == "__main__":
    main()
