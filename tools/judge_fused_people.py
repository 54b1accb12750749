"""Evaluate fused people against the best single rig, over simulated sessions of all skin types.

    python tools/judge_fused_people.py WORK [--people N] [--first SEED] [--tissue published]

Person k has seed FIRST + k and skin type I to VI in turn. With ``--tissue published`` the other
properties of the skin fill their published ranges, as the intervals state. Dome (320 px), flash rig
(384 px) and probe are simulated with a calibration of their own, reconstructed and fused. WORK
keeps the sessions, so that an interrupted run continues; ``--people 0`` only evaluates them.
Printed per quantity: median errors of the logarithm and coverage of 68 % intervals, means over
people, and the number of people whose fused error is at most that of the best single rig, without
tolerance.
A person takes about 150 s of processor time.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from model import store
from rigsim.population.files import DRAWN_TISSUE, SCHEMA, TISSUE_SPREADS
from skinrig.demo_rigs import (
    DOME_OMITTED_EFFECTS,
    DOME_WIDTH_PX,
    FLASH_CALIBRATIONS,
    PROBE_WANT,
    DemoResults,
    RigDemo,
)
from skinrig.evaluating.fusion import FusionAccuracy, compare_fused
from skinrig.fusing.double import FusionInputs, fuse_sources
from skinrig.fusing.sources import read_sources

TYPES = ("I", "II", "III", "IV", "V", "VI")
FLASH_WIDTH_PX = 384
RIGS = ("flash", "dome", "probe")


def capture(folder: Path, skin_type: str, seed: int, tissue: str) -> None:
    """Simulate, calibrate and reconstruct a person's sessions that `folder` lacks."""
    subject = folder / "subject.toml"
    lines = f'schema = "{SCHEMA}"', f'preset = "{skin_type}"', f'tissue_model = "{tissue}"'
    subject.write_text("\n".join(lines) + "\n", encoding="utf-8")

    @contextmanager
    def share(_step: str) -> Iterator[None]:
        yield

    run = RigDemo(folder, seed, share, FLASH_WIDTH_PX, DemoResults())
    flash = {"width_px": FLASH_WIDTH_PX}
    dome = {"width_px": DOME_WIDTH_PX}
    plans = {
        "flash": (
            [(kind, (target,)) for target, kind in FLASH_CALIBRATIONS.items()],
            flash,
            ("melanin", "hemoglobin", "diffuse"),
        ),
        "dome": (
            [("geometry", ("charuco",)), ("lights", ("mirror", "white"))],
            dome,
            ("normals", "normals_refined", "r_d"),
        ),
        "probe": ([("fiber", ("phantom",))], {}, PROBE_WANT),
    }
    for rig, (kinds, size, want) in plans.items():
        if (folder / f"appearance-{rig}-{skin_type}").is_dir():
            continue
        for one in folder.glob(f"*-{rig}*"):
            shutil.rmtree(one)
        begun = time.process_time()
        for kind, targets in kinds:
            for target in targets:
                run.simulate(rig, target, target=target, **size)
            run.calibrate(rig, kind, *targets)
        omitted = {"leave_out": DOME_OMITTED_EFFECTS} if rig == "dome" else {}
        done = run.simulate(rig, skin_type, subject=str(subject), **size, **omitted)
        run.reconstruct(rig, done, want)
        print(f"{folder.name} {rig}: {time.process_time() - begun:.0f} s", file=sys.stderr)


def evaluate(folder: Path) -> list[FusionAccuracy]:
    """Fuse a person's maps and compare them with each rig's."""
    paths = [next(folder.glob(f"appearance-{rig}-*")) for rig in RIGS]
    double = fuse_sources(read_sources(paths), FusionInputs(tuple(paths)))
    single = {rig: store.read(path) for rig, path in zip(RIGS[:2], paths, strict=False)}
    truths = {rig: store.read(folder / str(one.parameters["truth"])) for rig, one in single.items()}
    if double.contradiction is not None:
        print(f"{folder.name}: {double.contradiction}")
    return compare_fused(double.appearance, single, truths, double.measured.placement)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--people", type=int, default=10)
    parser.add_argument("--first", type=int, default=6200)
    parser.add_argument("--tissue", choices=tuple(TISSUE_SPREADS), default=DRAWN_TISSUE)
    given = parser.parse_args()
    for k in range(given.people):
        seed, skin_type = given.first + k, TYPES[k % len(TYPES)]
        folder = given.work / f"{seed}-{skin_type}"
        folder.mkdir(parents=True, exist_ok=True)
        capture(folder, skin_type, seed, given.tissue)
    found: dict[str, list[FusionAccuracy]] = {}
    print("person quantity fused% single% coverage, fused and single%")
    for folder in sorted(given.work.iterdir()):
        if not all(any(folder.glob(f"appearance-{rig}-*")) for rig in RIGS):
            continue
        for row in evaluate(folder):
            figures = row.fused, row.single, row.fused_coverage, row.single_coverage
            print(folder.name, row.quantity, *(f"{100 * one:.1f}" for one in figures))
            found.setdefault(row.quantity, []).append(row)
    print("quantity n fused% single% not-worse coverage, fused and single%")
    for quantity, rows in found.items():
        table = np.array([[r.fused, r.single, r.fused_coverage, r.single_coverage] for r in rows])
        fused, single, held, single_held = 100 * table.mean(axis=0)
        wins = int((table[:, 0] <= table[:, 1]).sum())
        print(
            f"{quantity} {len(rows)} {fused:.1f} {single:.1f} {wins} {held:.0f} {single_held:.0f}"
        )


if __name__ == "__main__":
    main()
