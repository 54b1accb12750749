"""A choice simulated, reconstructed and compared with its forecast."""

from collections.abc import Callable, Iterable, Mapping, Sequence
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
    """Simulate a choice, reconstruct it, and compare what came out with the forecast.

    Parameters
    ----------
    choice
        Of `skinrig.planning.plans.choose`.
    out
        Folder for sessions, calibration, maps.
    subject, seed
        The simulated face.
    progress
        Called with a line per step.
    """
    rig = load_planner(choice.rig.name)
    steps = rig.describe_rehearsal(choice)
    calibrate_simulated(
        choice.rig.name, out, steps.targets, steps.calibrations, seed=seed, progress=progress
    )
    progress(f"simulate the skin {subject}")
    done = simulate_session(
        choice.rig.name,
        out / "session-face",
        subject=subject,
        seed=seed,
        plan=choice.plan,
        **steps.options,
    )
    progress("reconstruct")
    pipeline.reconstruct(
        done.session,
        want=steps.want,
        out=out / "appearance",
        calibration=out / "calibration",
        truth=done.truth_name,
    )
    appearance, truth = store.read(out / "appearance"), store.read(out / "truth-face")
    measured = rig.measure_errors(choice, appearance, truth, seed)
    rows = []
    for one in choice.forecasts:
        if one.name in measured:
            median, share = measured[one.name]
            low, high = one.interval
            found = {"median": median, "forecast": one.value, "within": low <= median <= high}
            rows.append({"name": one.name, "unit": one.unit, **found, "valid_share": share})
    return rows


def calibrate_simulated(
    rig: str,
    folder: Path,
    targets: Mapping[str, Mapping[str, Any]],
    kinds: Iterable[tuple[str, Sequence[str]]],
    *,
    seed: int,
    progress: Callable[[str], None] | None = None,
) -> None:
    """Simulate targets and calibrate a rig by them into a folder's `calibration`.

    Parameters
    ----------
    rig
        Its name.
    folder
        For sessions and the calibration.
    targets
        Options of each target's session.
    kinds
        Of calibration, each with the targets that it is made from.
    seed
        Of the sessions.
    progress
        Called with a line per target.
    """
    for target, options in targets.items():
        if progress is not None:
            progress(f"simulate {target}")
        simulate_session(rig, folder / f"session-{target}", target=target, seed=seed, **options)
    for kind, used in kinds:
        sessions = [folder / f"session-{target}" for target in used]
        calibrate(kind, sessions, folder / "calibration")
