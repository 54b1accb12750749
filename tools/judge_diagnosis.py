"""Judge the diagnosis of images under listed lights on sets with one known fault each.

The faults and their severities are the rows of ``tools/pain_suite.csv``. Each is made under three
rigs' lights and on three skin tones by ``tests/fixtures/faulty_stacks.py``: heads, reliefs and
balls with highlights, cast shadows and noise. Sound sets are made alike. Prints, per row, how many
sets have any finding, the right one, and the right images; then the totals and false alarms.

A set is judged once: finished sets are lines of the file OUT, and a later run goes on there. Only
sets of the run's own list count: fault, severity, rig, tone, seed and side are compared.

Usage: python tools/judge_diagnosis.py [--seeds N] [--first SEED] [--side PX] [--out FILE]
       [--faults NAME ...]
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fixtures.faulty_stacks import GRADED, RIGS, TONES, make  # type: ignore[import-not-found]

from reconstruction.stack_diagnosis import diagnose_stack

TABLE = Path(__file__).with_name("pain_suite.csv")
FIRST_SEED = 60_000
"""Rules were set on seeds 300 to 312, 20146 to 20151, 30000 to 30023 and 50000 to 50503."""
KEYS = ("fault", "severity", "rig", "tone", "seed", "side")
N_SOUND = 20
"""Sound sets per rig, tone and seed."""


def list_sets(seeds: int, first: int, side: int) -> Iterator[dict[str, Any]]:
    """Yield the sets: values of `KEYS`; no seed is used twice."""
    with TABLE.open() as file:
        rows = [(one["fault"], one["severity"]) for one in csv.DictReader(file)]
    rows += [("", "")] * N_SOUND
    seed = first
    for _, rig, tone, (fault, severity) in product(range(seeds), RIGS, TONES, rows):
        yield dict(zip(KEYS, (fault, severity, rig, tone, seed, side), strict=True))
        seed += 1


def read_finished(out: Path | None) -> dict[tuple[Any, ...], dict[str, Any]]:
    """Return the finished sets of a file by the values of `KEYS`; drop a torn last line from it."""
    if out is None or not out.exists():
        return {}
    text = out.read_text()
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        out.write_text(whole)
    judged = [json.loads(line) for line in whole.splitlines()]
    return {tuple(one.get(key) for key in KEYS): one for one in judged}


def judge(one: dict[str, Any]) -> dict[str, Any]:
    """Return a set with its findings: [fault, numbers of the images from 0] each."""
    severity = float(one["severity"]) if one["severity"] else None
    options = {"severity": severity, "rig": one["rig"], "tone": one["tone"]}
    stack = make(one["fault"], one["seed"], side=one["side"], **options)
    found = diagnose_stack(
        stack.images,
        stack.lights,
        usable=stack.images < 0.998,
        inside=stack.inside,
        rng=np.random.default_rng(0),
    )
    findings = [[each.fault, list(each.frames)] for each in found.findings]
    return one | {"frames": list(stack.frames), "findings": findings}


def count(judged: list[dict[str, Any]]) -> Counter[str]:
    """Return how many sets have any finding, the right one, and the right images."""
    total: Counter[str] = Counter(sets=len(judged))
    for one in judged:
        name = GRADED.get(one["fault"])
        total["any"] += bool(one["findings"])
        total["found"] += any(fault == name for fault, _ in one["findings"])
        total["named"] += [name, one["frames"]] in one["findings"]
        total["single"] += bool(one["frames"])
        total["named single"] += bool(one["frames"]) and [name, one["frames"]] in one["findings"]
    return total


def print_tables(judged: list[dict[str, Any]]) -> None:
    """Print one row per fault and severity, then the totals above the stated severity."""
    with TABLE.open() as file:
        rows = list(csv.DictReader(file))
    sets = defaultdict(list)
    for one in judged:
        sets[one["fault"], one["severity"]].append(one)
    print("| fault | severity | sets | any, right finding | right images |")
    print("| --- | --- | --- | --- | --- |")
    above = []
    for row in rows:
        of_row = sets[row["fault"], row["severity"]]
        total = count(of_row)
        above += of_row if row["stated"] == "yes" else []
        severity = f"{row['severity']} {row['unit']}" + " (below)" * (row["stated"] == "no")
        print(
            f"| {row['fault']} | {severity} | {total['sets']} | {total['any']}, {total['found']} "
            f"| {total['named']} |"
        )
    total = count(above)
    print(
        f"stated severity or more: {total['sets']} sets, {total['any']} with a finding, "
        f"{total['found']} with the right one; right images in {total['named single']} of "
        f"{total['single']} sets with faults of single images"
    )
    sound = sets["", ""]
    print(f"sound: {count(sound)['any']} of {len(sound)} sets with a finding")
    for name in ("rig", "tone"):
        for value in {one[name]: None for one in judged}:
            chosen = count([one for one in above if one[name] == value])
            alarms = count([one for one in sound if one[name] == value])
            print(
                f"{value}: {chosen['found']} of {chosen['sets']}; "
                f"sound {alarms['any']} of {alarms['sets']}"
            )


def main() -> None:
    """Judge the sets that the command line gives, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1, help="sets per row, rig and tone")
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="first seed")
    parser.add_argument("--side", type=int, default=64, help="pixels")
    parser.add_argument("--faults", nargs="+", help="only these; sound: sets without a fault")
    parser.add_argument("--out", type=Path, help="file of the finished sets")
    given = parser.parse_args()
    finished = read_finished(given.out)
    judged = []
    for one in list_sets(given.seeds, given.first, given.side):
        if given.faults and (one["fault"] or "sound") not in given.faults:
            continue
        known = finished.get(tuple(one.values()))
        judged.append(known or judge(one))
        if given.out and known is None:
            with given.out.open("a") as file:
                file.write(json.dumps(judged[-1]) + "\n")
        print(f"\r{len(judged)} sets", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    print_tables(judged)


if __name__ == "__main__":
    main()
