"""Confirm a plan choice: simulate it, reconstruct it and compare the errors with the forecast."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from model import store
from reconstruction.pipeline import recipes as pipeline
from skinrig.calibrating.calibrate import calibrate
from skinrig.planning.plans import PlanChoice, load_planner
from skinrig.simulating.simulation import simulate_session


def confirm_choice(
    choice: PlanChoice, out: Path, *, subject: str, seed: int, progress: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Simulate and reconstruct a chosen plan; return measured errors next to the forecast.

    Parameters
    ----------
    choice
        Result of `skinrig.planning.plans.choose`.
    out
        Folder of sessions, calibration and maps.
    subject, seed
        Preset and seed of the simulated subject.
    progress
        Called with one line per step.
    """
    rig = load_planner(choice.rig.name)
    steps = rig.describe_rehearsal(choice)
    calibrate_simulated(
        choice.rig.name, out, steps.targets, steps.calibrations, seed=seed, progress=progress
    )
    progress(f"simulate the skin {subject} and reconstruct")
    measured = capture_choice(choice, out, subject=subject, seed=seed).errors
    rows = []
    for one in choice.forecasts:
        if one.name in measured:
            median, share = measured[one.name]
            low, high = one.interval
            found = {"median": median, "forecast": one.value, "within": low <= median <= high}
            rows.append({"name": one.name, "unit": one.unit, **found, "valid_share": share})
    return rows


@dataclass(frozen=True, slots=True)
class RehearsedCapture:
    """Errors and times of a simulated capture and its maps."""

    errors: Mapping[str, tuple[float, float]]
    """Median error, in the unit of the rig's goals, and valid fraction by map."""
    capture_s: float
    """Time elapsed on the rig's clock, s."""
    reconstruct_s: float
    """Processor time of the reconstruction, s."""


def capture_choice(
    choice: PlanChoice, folder: Path, *, subject: str, seed: int
) -> RehearsedCapture:
    """Simulate and reconstruct a chosen plan with the calibration in `folder`.

    Parameters
    ----------
    choice
        Plan of a rig.
    folder
        Folder with ``calibration``; session, ground truth and maps are written into it.
    subject, seed
        Preset and seed of the simulated subject.
    """
    rig = load_planner(choice.rig.name)
    steps = rig.describe_rehearsal(choice)
    done = simulate_session(
        choice.rig.name,
        folder / "session-face",
        subject=subject,
        seed=seed,
        plan=choice.plan,
        **steps.options,
    )
    begun_s = time.process_time()
    pipeline.reconstruct(
        done.session,
        want=steps.want,
        out=folder / "appearance",
        calibration=folder / "calibration",
        truth=done.truth_name,
    )
    reconstruct_s = time.process_time() - begun_s
    appearance, truth = store.read(folder / "appearance"), store.read(folder / done.truth_name)
    errors = rig.measure_errors(choice, appearance, truth, seed)
    return RehearsedCapture(errors, done.rig_seconds, reconstruct_s)


def calibrate_simulated(
    rig: str,
    folder: Path,
    targets: Mapping[str, Mapping[str, Any]],
    kinds: Iterable[tuple[str, Sequence[str]]],
    *,
    seed: int,
    progress: Callable[[str], None] | None = None,
) -> None:
    """Simulate calibration targets and calibrate a rig from them into `folder/calibration`.

    Parameters
    ----------
    rig
        Name of the rig.
    folder
        Folder of the sessions and the calibration.
    targets
        Options of each target's session.
    kinds
        Kinds of calibration, each with the targets that it is made from.
    seed
        Random seed of the sessions.
    progress
        Called with one line per target.
    """
    for target, options in targets.items():
        if progress is not None:
            progress(f"simulate {target}")
        simulate_session(rig, folder / f"session-{target}", target=target, seed=seed, **options)
    for kind, used in kinds:
        sessions = [folder / f"session-{target}" for target in used]
        calibrate(kind, sessions, folder / "calibration")
