"""Judge the diagnosis on sets with one known fault each: the pain suite.

The faults and their severities are the rows of ``tools/pain_suite.csv``. Those of images under
listed lights are made under three rigs' lights and on three skin tones, heads, reliefs and balls
with highlights, cast shadows and noise. Those of polarized pairs and gradient patterns are made on
the three surfaces and skin tones. Sound sets are made alike. Prints, per row, how many sets have
any finding, the right one, and the right images; then the totals and false alarms.

A set is judged once: finished sets are lines of the file OUT, and a later run goes on there. Only
sets of the run's own list count: images, fault, severity, rig, tone, seed and side are compared.
One set takes about half a second of one processor.

Usage: python tools/judge_diagnosis.py [--seeds N] [--sound N] [--first SEED] [--side PX]
       [--out FILE] [--images lights pair patterns] [--faults NAME ...] [--most N]
"""

from __future__ import annotations

import os

# small matrices: more threads only wait for each other
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import csv
import json
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fixtures.faulty_patterns import PAIR_FAULTS, PATTERN_FAULTS, make_pair, make_patterns  # type: ignore[import-not-found]
from fixtures.faulty_stacks import GRADED, RIGS, SHAPES, TONES, make  # type: ignore[import-not-found]

from reconstruction.stack_diagnosis import Finding, diagnose_stack
from reconstruction.stack_diagnosis.pattern_faults import PATTERN_NAMES, find_pattern_faults
from reconstruction.stack_diagnosis.polarized_pairs import find_pair_faults

TABLE = Path(__file__).with_name("pain_suite.csv")
FIRST_SEED = 150_000
"""Rules were set on seeds 300 to 312, 20146 to 20151, 30000 to 30023, 50000 to 50503, 55000 to
55329, 110000 to 110732 and 120000 to 123071; seeds 20000 to 60503, 80000 to 80999, 90000 to 90999,
110000 to 113193, 130000 to 133193 and 140000 to 140773 were judged before."""
KEYS = ("images", "fault", "severity", "rig", "tone", "seed", "side")
NAMES = {"lights": GRADED, "pair": PAIR_FAULTS, "patterns": PATTERN_FAULTS}
"""What the diagnosis calls each fault, by kind of images."""
VARIANTS = {"lights": tuple(RIGS), "pair": SHAPES, "patterns": SHAPES}
"""Lights of a rig, or a surface: the column "rig" of a set."""


def read_rows() -> list[dict[str, str]]:
    """Return the rows of the table of faults and severities."""
    with TABLE.open() as file:
        return list(csv.DictReader(file))


def list_sets(seeds: int, sound: int, first: int, side: int) -> Iterator[dict[str, Any]]:
    """Yield the sets: values of `KEYS`; no seed is used twice."""
    rows = read_rows()
    seed = first
    for _, images in product(range(seeds), NAMES):
        faults = [(row["fault"], row["severity"]) for row in rows if row["images"] == images]
        faults += [("", "")] * sound
        for variant, tone, (fault, severity) in product(VARIANTS[images], TONES, faults):
            if images != "lights":  # the seed chooses the surface
                seed += (SHAPES.index(variant) - seed) % len(SHAPES)
            values = (images, fault, severity, variant, tone, seed, side)
            yield dict(zip(KEYS, values, strict=True))
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
    """Return a set with the numbers of its faulty images, from 0, and its findings, likewise."""
    start = time.process_time()
    given: dict[str, Any] = {"side": one["side"], "tone": one["tone"]}
    if one["severity"]:
        given["severity"] = float(one["severity"])
    frames, found = FIND[one["images"]](one, given)
    findings = [[each.fault, list(each.frames)] for each in found]
    seconds = round(time.process_time() - start, 3)
    return one | {"frames": frames, "findings": findings, "seconds": seconds}


def find_in_stack(one: dict[str, Any], given: dict[str, Any]) -> tuple[list[int], list[Finding]]:
    """Return the faulty images of a set under listed lights, and what is found in it."""
    stack = make(one["fault"], one["seed"], rig=one["rig"], **given)
    usable, rng = stack.images < 0.998, np.random.default_rng(0)
    found = diagnose_stack(stack.images, stack.lights, usable=usable, inside=stack.inside, rng=rng)
    return list(stack.frames), list(found.findings)


def find_in_pair(one: dict[str, Any], given: dict[str, Any]) -> tuple[list[int], list[Finding]]:
    """Return the faulty images of a polarized pair, and what is found in it."""
    gray = not one["fault"] and one["seed"] % 2 == 1
    parallel, crossed, inside = make_pair(one["fault"], one["seed"], gray=gray, **given)
    return [0, 1] if one["fault"] else [], list(find_pair_faults(parallel, crossed, inside))


def find_in_patterns(one: dict[str, Any], given: dict[str, Any]) -> tuple[list[int], list[Finding]]:
    """Return the faulty images of gradient patterns, and what is found in them."""
    images, inside, names = make_patterns(one["fault"], one["seed"], **given)
    frames = sorted(PATTERN_NAMES.index(name) for name in names)
    return frames, list(find_pattern_faults(images, inside))


FIND = {"lights": find_in_stack, "pair": find_in_pair, "patterns": find_in_patterns}


def count(judged: list[dict[str, Any]]) -> Counter[str]:
    """Return how many sets have any finding, the right one, and the right images."""
    total: Counter[str] = Counter(sets=len(judged))
    for one in judged:
        name = NAMES[one["images"]].get(one["fault"])
        right = [name, one["frames"]] in one["findings"]
        total["any"] += bool(one["findings"])
        total["found"] += any(fault == name for fault, _ in one["findings"])
        total["named"] += right
        total["single"] += bool(one["frames"])
        total["named single"] += bool(one["frames"]) and right
    return total


def print_tables(judged: list[dict[str, Any]]) -> None:
    """Print one row per fault and severity, then the totals above the stated severity."""
    sets = defaultdict(list)
    for one in judged:
        sets[one["images"], one["fault"], one["severity"]].append(one)
    print("| images: fault | severity | sets | any, right finding | right images |")
    print("| --- | --- | --- | --- | --- |")
    above = []
    for row in read_rows():
        of_row = sets[row["images"], row["fault"], row["severity"]]
        if not of_row:
            continue
        total = count(of_row)
        above += of_row if row["stated"] == "yes" else []
        severity = f"{row['severity']} {row['unit']}" + " (below)" * (row["stated"] == "no")
        print(
            f"| {row['images']}: {row['fault']} | {severity} | {total['sets']} "
            f"| {total['any']}, {total['found']} | {total['named']} |"
        )
    sound = [one for one in judged if not one["fault"]]
    print_totals("all", above, sound)
    for key in ("images", "rig", "tone"):
        for value in dict.fromkeys(one[key] for one in judged):
            chosen = ([one for one in part if one[key] == value] for part in (above, sound))
            print_totals(value, *chosen)
    seconds = sum(one.get("seconds", 0.0) for one in judged)
    print(f"{len(judged)} sets, {seconds:.0f} processor seconds")


def print_totals(name: str, above: list[dict[str, Any]], sound: list[dict[str, Any]]) -> None:
    """Print the totals of sets of the stated severity or more, and of sound ones."""
    total = count(above)
    print(
        f"{name}: {total['sets']} sets of the stated severity or more, {total['any']} with a "
        f"finding, {total['found']} with the right one; right images in {total['named single']} of "
        f"{total['single']} sets with faults of single images; "
        f"{count(sound)['any']} of {len(sound)} sound sets with a finding"
    )


def main() -> None:
    """Judge the sets that the command line gives, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1, help="sets per row, rig and tone")
    parser.add_argument("--sound", type=int, default=34, help="sound sets per rig and tone")
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="first seed")
    parser.add_argument("--side", type=int, default=64, help="pixels")
    parser.add_argument("--images", nargs="+", choices=NAMES, default=[*NAMES], help="only these")
    parser.add_argument("--faults", nargs="+", help="only these; sound: sets without a fault")
    parser.add_argument("--most", type=int, help="judge at most this many new sets")
    parser.add_argument("--out", type=Path, help="file of the finished sets")
    given = parser.parse_args()
    finished = read_finished(given.out)
    judged = []
    left = given.most
    for one in list_sets(given.seeds, given.sound, given.first, given.side):
        wanted = not given.faults or (one["fault"] or "sound") in given.faults
        if one["images"] not in given.images or not wanted:
            continue
        known = finished.get(tuple(one.values()))
        if known is None:
            if left == 0:
                break
            left = None if left is None else left - 1
            known = judge(one)
            if given.out:
                with given.out.open("a") as file:
                    file.write(json.dumps(known) + "\n")
        judged.append(known)
        print(f"\r{len(judged)} sets", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    print_tables(judged)


if __name__ == "__main__":
    main()
