"""Measure the errors between two sessions of one person, and the drift of calibrations with age.

    python tools/measure_session_errors.py gradient --seeds 11 12 --people 0 1 2
    python tools/measure_session_errors.py gradient --seeds 0 --people 104 105 106 107 108
    python tools/measure_session_errors.py gradient --seeds 0 --ages 1 30 90 365

Each seed is another rig as built. Before gradient rig and probe it is also another person. The
benchmark `repeatability` has seed 0. Sessions are 30 days apart, each with its day's calibration.
Printed per quantity: rms difference, the stated one, their ratio with its standard error over
pairs, and the errors common to the whole skin and to a region in stated standard uncertainties:
those of `skinrig/data/session_errors.csv` before their factor. Then pairs judged as changed, and
per age the typical change of each calibration in combined standard errors, 1 by noise alone, and
relative to its numbers: the rows of `skinrig/data/calibration_drift.csv`.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from pathlib import Path

import numpy as np

from skinrig.benchmarks.repeatability.sessions import RigProtocol, choose_protocol
from skinrig.benchmarks.repeatability.stage import WIDTHS_PX, RigTrials, measure_drifts, run_trials


def print_trials(found: list[RigTrials]) -> None:
    """Print errors between sessions by quantity, and the verdicts."""
    print("quantity pairs rms stated ratio stderr face region")
    for quantity in found[0].ratios:
        rows = np.array([row for one in found for row in one.ratios.get(quantity, [])])
        common = np.array([row for one in found for row in one.common.get(quantity, [])])
        rms, stated = np.sqrt(np.mean(rows[:, :2] ** 2, axis=0))
        stderr = rows[:, 2].std(ddof=1) / np.sqrt(len(rows)) if len(rows) > 1 else float("nan")
        face, region = np.sqrt(np.mean(common**2, axis=0))
        figures = rms, stated, rms / stated, stderr, face, region
        print(quantity, len(rows), *(f"{one:.3g}" for one in figures), sep="; ")
    counts = [(one.false_alarms, one.pairs, one.found, one.changed) for one in found]
    alarms, pairs, named, changed = np.sum(counts, axis=0).tolist()
    print(f"one person judged as changed: {alarms} of {pairs}; two people: {named} of {changed}")


def print_drifts(folder: Path, protocol: RigProtocol, ages_days: list[int]) -> None:
    """Print the change of each calibration with age."""
    print("rig,kind,quantity,days,numbers,sigmas,percent")
    for one in measure_drifts(folder, protocol, ages_days):
        for quantity in dict.fromkeys(row.name.split("[")[0] for row in one.moved):
            rows = [row for row in one.moved if row.name.split("[")[0] == quantity]
            sigmas = [abs(row.sigmas) for row in rows if row.sigmas is not None]
            relative = [abs(row.change / row.old) for row in rows if row.old]
            if not relative:
                continue
            # a standard deviation by the median: a few numbers have errors near 0
            size = f"{np.median(sigmas) / 0.6745:.2g}" if sigmas else ""
            found = protocol.rig, one.kind, quantity, one.days, len(rows), size
            print(*found, f"{100 * np.median(relative):.2g}", sep=",", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rig", choices=tuple(WIDTHS_PX))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--people", type=int, nargs="+", default=[])
    parser.add_argument("--ages", type=int, nargs="+", default=[])
    given = parser.parse_args()
    begun = time.process_time()
    found = []
    for seed in given.seeds:
        usual = choose_protocol(given.rig, width_px=WIDTHS_PX[given.rig])
        protocol = dataclasses.replace(usual, seed=seed)
        with tempfile.TemporaryDirectory() as name:
            if given.people:
                trials = run_trials(Path(name), protocol, given.people, with_state=False)
                found.append(trials)
            if given.ages:
                print_drifts(Path(name) / "drift", protocol, given.ages)
    if found:
        print_trials(found)
    print(f"processor time: {time.process_time() - begun:.0f} s")


if __name__ == "__main__":
    main()
