"""Evaluate fused people against the best single rig, over simulated sessions of all skin types.

    python tools/judge_fused_people.py WORK [--people N] [--first SEED] [--tissue published]
        [--small]

Person k has seed FIRST + k and skin type I to VI in turn. With ``--tissue published`` the other
properties of the skin fill their published ranges, as the intervals state. Dome (320 px), flash rig
(384 px) and probe are simulated with a calibration of their own, reconstructed and fused.
``--small`` has a dome of 24 lights and 4 views (240 px) and a flash rig of 256 px. WORK
keeps the sessions, so that an interrupted run continues; ``--people 0`` only evaluates them.
Printed per quantity: median errors of the logarithm and coverage of 68 % intervals, means over
people, and the number of people whose fused error is at most that of the best single rig, without
tolerance.
A person takes about 170 s of processor time, with ``--small`` 80 s.
"""

from __future__ import annotations

import argparse
import dataclasses
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model import store
from model.skin import SkinAppearance
from model.skin_reflectance import TRANSLUCENCY_MAP
from reconstruction.fusion.signals import residual_covariance
from reconstruction.fusion.texels import OffsetModel
from reconstruction.surface.errors import interior_error
from rigsim.population.files import DRAWN_TISSUE, SCHEMA, TISSUE_SPREADS
from skinrig.arrays import Float64Array
from skinrig.demo_rigs import (
    DOME_OMITTED_EFFECTS,
    DOME_WIDTH_PX,
    FLASH_CALIBRATIONS,
    PROBE_WANT,
    RigDemo,
)
from skinrig.evaluating import subsurface, surface
from skinrig.evaluating.fusion import FusionAccuracy, compare_filled, compare_fused
from skinrig.fusing.double import FusedDouble, FusionInputs, fuse_sources
from skinrig.fusing.maps import estimate_maps
from skinrig.fusing.measurements import LOCAL_SHARE, Measurements
from skinrig.fusing.sources import read_sources
from skinrig.fusing.texel_colors import DomeColors

TYPES = ("I", "II", "III", "IV", "V", "VI")
RIGS = ("flash", "dome", "probe")
FIGURES = ("fused", "single", "fused_coverage", "single_coverage", "own_coverage", "common_sigmas")


@dataclass(frozen=True, slots=True)
class Sizes:
    """Options of flash rig and dome."""

    flash: dict[str, int]
    dome: dict[str, int]


USUAL_SIZES = Sizes({"width_px": 384}, {"width_px": DOME_WIDTH_PX})
SMALL_SIZES = Sizes({"width_px": 256}, {"width_px": 240, "lights": 24, "views": 4})


def capture(folder: Path, skin_type: str, seed: int, tissue: str, sizes: Sizes) -> None:
    """Simulate, calibrate and reconstruct a person's sessions that `folder` lacks."""
    subject = folder / "subject.toml"
    lines = f'schema = "{SCHEMA}"', f'preset = "{skin_type}"', f'tissue_model = "{tissue}"'
    subject.write_text("\n".join(lines) + "\n", encoding="utf-8")

    @contextmanager
    def share(_step: str) -> Iterator[None]:
        yield

    run = RigDemo(folder, seed, share, sizes.flash["width_px"], {})
    plans = {
        "flash": (
            [(kind, (target,)) for target, kind in FLASH_CALIBRATIONS.items()],
            sizes.flash,
            ("melanin", "hemoglobin", "diffuse"),
        ),
        "dome": (
            [("geometry", ("charuco",)), ("lights", ("mirror", "white"))],
            sizes.dome,
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


@dataclass(slots=True, eq=False)
class SimulatedErrors(Measurements):
    """Measurements whose error model has only what the sessions simulate.

    It lacks residuals of measured spectra and light from inside the skin, which real skin has."""

    def errors(self, log_skin: Float64Array) -> OffsetModel:
        """Return the covariances of the signals' errors."""
        found = Measurements.errors(self, log_skin)
        real = residual_covariance(self.rigs, log_skin)
        light = np.repeat([rig.kind == "reflectance" for rig in self.rigs], 3)
        real = np.where(np.outer(light, light), real, 0.0)
        calibration = found.calibration.copy()
        for k, one in enumerate(self.colors):
            if isinstance(one, DomeColors):
                r_d = one.r_d.values.reshape(-1, 3)[one.valid]
                interior = interior_error(r_d)[:, 0] / r_d[:, 0]
                at = slice(3 * k, 3 * k + 3)
                calibration[at, at] -= float(np.median(np.square(interior)))
        return OffsetModel(found.unexplained - real, calibration, found.local - LOCAL_SHARE * real)


def evaluate(folder: Path) -> tuple[list[FusionAccuracy], list[FusionAccuracy]]:
    """Fuse a person's maps, compare them with each rig's, and print the errors of filled texels.

    The second rows are those of chromophores and R_d by `SimulatedErrors`.
    """
    paths = [next(folder.glob(f"appearance-{rig}-*")) for rig in RIGS]
    double = fuse_sources(read_sources(paths), FusionInputs(tuple(paths)))
    if double.contradiction is not None:
        print(f"{folder.name}: {double.contradiction}")
    single = {rig: store.read(path) for rig, path in zip(RIGS[:2], paths, strict=False)}
    truths = {rig: store.read(folder / str(one.parameters["truth"])) for rig, one in single.items()}
    fused = double.appearance
    fields = {f.name: getattr(double.measured, f.name) for f in dataclasses.fields(Measurements)}
    measured = SimulatedErrors(**fields)
    person, errors = measured.estimate_person()
    maps, _ = estimate_maps(measured, person, errors, position=fused.maps["position"])
    other = dataclasses.replace(fused, maps={**fused.maps, **maps})
    for row in compare_filled(fused, truths):
        figures = 100 * row.share, 100 * row.error, 100 * row.coverage
        print(folder.name, "filled", row.quantity, row.texels, *(f"{one:.1f}" for one in figures))
    print_other_maps(folder, double, single["dome"], truths["dome"])
    placement = double.measured.placement
    first, second = (compare_fused(one, single, truths, placement) for one in (fused, other))
    return first, second


def print_other_maps(
    folder: Path, double: FusedDouble, dome: SkinAppearance, truth: SkinAppearance
) -> None:
    """Print errors of normals, fused and of the dome, and of sigma_tr at the probe's sites."""
    rng = np.random.default_rng(0)
    for what, one in (("fused", double.appearance), ("dome", dome)):
        for row in surface.compare(one, truth, rng=rng):
            if row.unit == "deg":
                held, masked = 100 * row.coverage.fraction, 100 * row.masked
                figures = f"{row.mean:.2f} deg, coverage {held:.0f} %, masked {masked:.1f} %"
                print(folder.name, what, row.name, figures)
    known = subsurface.true_profiles(store.read(next(folder.glob("truth-probe-[IV]*"))))
    mean_free_path = double.appearance.maps[TRANSLUCENCY_MAP]
    for site in double.measured.sites:
        true = [one["sigma_tr_per_mm"] for one in known.values() if one["site"] == site.name]
        log_true = np.log(np.mean(true, axis=0))
        fused = -np.log(mean_free_path.values[site.texel]) - log_true
        probe = np.log(site.sigma_tr_per_mm) - log_true
        errors = mean_free_path.stderr[site.texel] / mean_free_path.values[site.texel]
        held = int((np.abs(fused) < errors).sum())
        rows = [" ".join(f"{100 * one:+.1f}" for one in part) for part in (fused, probe)]
        print(
            folder.name, "sigma_tr", site.name, f"fused {rows[0]}; probe {rows[1]} %; held {held}/3"
        )


def print_table(people: dict[str, list[FusionAccuracy]]) -> None:
    """Print errors and coverages of all people, and their means."""
    found: dict[str, list[FusionAccuracy]] = {}
    print("person quantity fused% single% coverage%: fused single own; common, in standard errors")
    for name, rows in people.items():
        for row in rows:
            parts = row.fused, row.single, row.fused_coverage, row.single_coverage, row.own_coverage
            figures = " ".join(f"{100 * one:.1f}" for one in parts)
            print(name, row.quantity, figures, f"{row.common_sigmas:+.2f}")
            found.setdefault(row.quantity, []).append(row)
    print("quantity n fused% single% not-worse coverage%: fused single own; rms common ± stderr")
    for quantity, rows in found.items():
        table = np.array([[getattr(row, name) for name in FIGURES] for row in rows])
        fused, single, held, single_held, own = 100 * table[:, :5].mean(axis=0)
        wins = int((table[:, 0] <= table[:, 1]).sum())
        # standard error of a root mean square of n draws of a normal distribution
        common = float(np.sqrt(np.mean(table[:, 5] ** 2)))
        print(
            f"{quantity} {len(rows)} {fused:.1f} {single:.1f} {wins} {held:.0f} {single_held:.0f}"
            f" {own:.0f} {common:.2f} ± {common / np.sqrt(2 * len(rows)):.2f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--people", type=int, default=10)
    parser.add_argument("--first", type=int, default=6200)
    parser.add_argument("--tissue", choices=tuple(TISSUE_SPREADS), default=DRAWN_TISSUE)
    parser.add_argument("--small", action="store_true")
    given = parser.parse_args()
    for k in range(given.people):
        seed, skin_type = given.first + k, TYPES[k % len(TYPES)]
        folder = given.work / f"{seed}-{skin_type}"
        folder.mkdir(parents=True, exist_ok=True)
        capture(folder, skin_type, seed, given.tissue, SMALL_SIZES if given.small else USUAL_SIZES)
    folders = [
        folder
        for folder in sorted(given.work.iterdir())
        if all(any(folder.glob(f"appearance-{rig}-*")) for rig in RIGS)
    ]
    usual, simulated = {}, {}
    print("person filled quantity texels: share% error% coverage%")
    for folder in folders:
        usual[folder.name], simulated[folder.name] = evaluate(folder)
    print_table(usual)
    print("error model without residuals of measured spectra and light from inside the skin:")
    print_table(simulated)


if __name__ == "__main__":
    main()
