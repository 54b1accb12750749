"""Compare sessions with all effects of light with those of the rules: seconds, and errors of maps.

    python tools/_j6.py RIG OUT [--people 3] [--seed 770] [--width PX]

Each person is simulated twice with the same noise, each time in a process of its own: with all
effects at their finest settings, and with those that the rules build. Seconds are the processor
time of the simulation after its imports. Equal frames have equal maps. If any frame differs, the
rig is calibrated and both sessions are reconstructed. Printed per person: seconds, pixels that
differ, the largest difference, and the median error of each map against its own ground truth.
The exit status is 1 if an error grows by more than 5 %.
"""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from capture.session import Session
from model import store
from reconstruction.pipeline import recipes
from skinrig.benchmarks.simulation.drawn_scenes import BUILT_SWITCHES
from skinrig.capturing.plan_choice import DefaultPlan
from skinrig.planning.confirmation import calibrate_simulated
from skinrig.planning.plans import PlanChoice, load_planner, load_sized_rig
from skinrig.simulating.dome import small_dome
from skinrig.simulating.effect_omission import SWITCHES_BY_RIG, TISSUE_SWITCHES
from skinrig.simulating.orders import SimulationOrder, order_for, truth_folder
from skinrig.simulating.simulation import simulate

PRESETS = ("II", "IV", "VI", "I", "III", "V")
MAX_GROWTH = 0.05
WIDTHS_PX: dict[str, int | None] = {"flash": 192, "dome": 256, "gradient": 96, "probe": None}
"""Image widths, px; a dome of fewer pixels cannot be calibrated."""
DOME_OPTIONS = {"lights": 12, "views": 4}


def build_everything(order: SimulationOrder) -> SimulationOrder:
    """Return an order whose scene builds all effects at their finest settings."""
    rig = order.rig
    switches = dict.fromkeys((*SWITCHES_BY_RIG[rig], *TISSUE_SWITCHES), True)
    switches |= BUILT_SWITCHES.get(rig, {})
    kind = type(order)
    body = {"__slots__": (), "scene_switches": lambda _: dict(switches)}
    everything: Any = type(kind.__name__, (kind,), body)
    made: SimulationOrder = everything(
        **{one.name: getattr(order, one.name) for one in fields(order)}
    )
    return made


def choose_plan(rig_name: str) -> PlanChoice:
    """Return the plan that both sessions of a person capture."""
    rig = load_sized_rig(rig_name, WIDTHS_PX[rig_name])
    if rig_name == "dome":
        rig = small_dome(rig, **DOME_OPTIONS)
    if rig_name == "gradient":  # skin at rest
        plan = next(iter(load_planner(rig_name).generate_candidates(rig)))[1]
    else:
        plan = DefaultPlan().of(rig)
    return PlanChoice(rig, plan, (), 0.0, {}, ())


def simulate_one(rig: str, out: Path, subject: str, seed: int, everything: bool) -> float:
    """Simulate a session; return its processor seconds."""
    importlib.import_module(f"skinrig.simulating.{rig}")
    choice = choose_plan(rig)
    options: dict[str, Any] = {"subject": subject, "seed": seed, "plan": choice.plan}
    if WIDTHS_PX[rig] is not None:
        options["width_px"] = WIDTHS_PX[rig]
    order = order_for(rig, out=out, **options)
    begun_s = time.process_time()
    simulate(build_everything(order) if everything else order)
    return time.process_time() - begun_s


def start(rig: str, out: Path, subject: str, seed: int, everything: bool) -> float:
    """Run `simulate_one` in a process of its own."""
    asked = [rig, str(out), "--one", subject, "--seed", str(seed)]
    asked += ["--everything"] if everything else []
    if WIDTHS_PX[rig] is not None:
        asked += ["--width", str(WIDTHS_PX[rig])]
    done = subprocess.run(
        [sys.executable, __file__, *asked], check=True, capture_output=True, text=True
    )
    return float(json.loads(done.stdout.splitlines()[-1]))


def compare_frames(have: Path, lack: Path) -> tuple[float, int]:
    """Return the fraction of pixels that differ between two sessions, and the largest, DN."""
    differ, total, most = 0, 0, 0
    with Session.open(have) as one, Session.open(lack) as other:
        for a, b in zip(one.frames(), other.frames(), strict=True):
            change = np.abs(one.read(a).cfa.astype(np.int64) - other.read(b).cfa)
            differ, total = differ + int((change > 0).sum()), total + change.size
            most = max(most, int(change.max()))
    return differ / total, most


def measure_errors(
    folder: Path, sessions: list[Path], rig: str, seed: int
) -> list[dict[str, float]]:
    """Calibrate the rig, reconstruct sessions, and return the median error of each map."""
    planner, choice = load_planner(rig), choose_plan(rig)
    steps = planner.describe_rehearsal(choice)
    calibrate_simulated(rig, folder, steps.targets, steps.calibrations, seed=seed)
    found = []
    for session in sessions:
        made, truth = session.with_name(f"appearance-{session.name}"), truth_folder(session)
        recipes.reconstruct(
            session, want=steps.want, out=made, calibration=folder / "calibration", truth=truth.name
        )
        errors = planner.measure_errors(choice, store.read(made), store.read(truth), seed)
        found.append({name: median for name, (median, _) in errors.items()})
    return found


def main() -> None:
    """Compare the sessions of each person."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rig", choices=list(WIDTHS_PX))
    parser.add_argument("out", type=Path)
    parser.add_argument("--people", type=int, default=3)
    parser.add_argument("--seed", type=int, default=770)
    parser.add_argument("--width", type=int, help="image width, px; not of the probe")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    parser.add_argument("--everything", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.width is not None:
        WIDTHS_PX[asked.rig] = asked.width
    if asked.one:
        print(simulate_one(asked.rig, asked.out, asked.one, asked.seed, asked.everything))
        return
    largest = 0.0
    for number in [2]:
        subject, seed = PRESETS[number], asked.seed + number
        folder = asked.out / f"{asked.rig}-{subject}"
        folder.mkdir(parents=True)
        sessions = [folder / f"session-{name}" for name in ("all", "rules")]
        seconds = [
            start(asked.rig, session, subject, seed, session == sessions[0]) for session in sessions
        ]
        share, most = compare_frames(*sessions)
        line = f"{asked.rig} {subject}, seed {seed}: {seconds[0]:.2f} s with all effects, "
        line += f"{seconds[1]:.2f} s by the rules; {100 * share:.2f} % of pixels differ, "
        line += f"by {most} DN at most"
        if most:
            have, lack = measure_errors(folder, sessions, asked.rig, seed)
            growth = {name: lack[name] / have[name] - 1.0 for name in have}
            largest = max(largest, *growth.values())
            each = (f"{name} {have[name]:.4g} to {lack[name]:.4g}" for name in have)
            line += f"; median errors {', '.join(each)}"
        print(line, flush=True)
    print(f"largest growth of an error: {100 * largest:.2f} %")
    raise SystemExit(largest > MAX_GROWTH)


if __name__ == "__main__":
    main()
