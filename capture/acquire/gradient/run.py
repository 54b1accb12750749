"""Run a plan on the gradient sphere: strain steps of skin in a caliper, or a target."""

from collections.abc import Mapping
from typing import Any

from capture.acquire.dome import begin_lit_run, check_dwell, check_safety, row_overrun_error
from capture.acquire.gradient.skin_states import SkinStates, release_skin
from capture.acquire.outcome import (
    AcquisitionError,
    AcquisitionResult,
    CaptureRun,
    require_trigger_line,
    step_limit_error,
)
from capture.acquire.pattern_scan import PatternScanner, analyzer_reading_deg
from capture.devices.caliper import CaliperBox
from capture.devices.gradient_sphere import GradientSphereBox
from capture.plan import Plan
from capture.plan.gradient import strain_state
from capture.plan.rows import split_passes
from capture.rig import Rig


def check_eyes(run: CaptureRun, *, skin: bool) -> None:
    """Raise an error for too much light; patterns on skin may come close to an eye."""
    check_safety(run.plan, run.rig, eyes=run.eyes)
    if skin and run.eyes == "open":
        raise AcquisitionError(
            "eyes: patterns change many times per second, and the patch may be next to an eye; "
            "nothing was lit: close or shield the eyes and give --eyes [SR-CAP-017]"
        )


def check_sphere(plan: Plan, rig: Rig, limits: Mapping[str, Any]) -> None:
    """Raise an error when the sphere's controller is another one, or its limits are exceeded."""
    counts = {"leds": ("lights", len(rig.lights)), "cameras": ("cameras", len(rig.views))}
    for name, (what, count) in counts.items():
        if int(limits.get(name, 0)) != count:
            raise AcquisitionError(
                f"{what}: the sphere's controller has {limits.get(name)}, the rig {count}; "
                "nothing was lit: use the rig file of this controller"
            )
    settle_s = float(limits["settle_us"]) / 1e6
    low_deg, high_deg = float(limits["analyser_min_deg"]), float(limits["analyser_max_deg"])
    for step in plan.steps:
        dwell_s, exposure_s = float(step.settings["dwell_s"]), float(step.settings["exposure_s"])
        check_dwell(step, dwell_s, limits)
        views = [rig.view(name) for name in step.cameras]
        over_s = max(view.shutter_lag_s + view.readout_s for view in views) + exposure_s
        if settle_s + exposure_s > dwell_s or over_s > dwell_s:
            raise row_overrun_error(step, dwell_s)
        angle_deg = analyzer_reading_deg(step)
        if not low_deg <= angle_deg <= high_deg:
            what = (
                f"got analyzer_deg {angle_deg:g}, the controller turns from {low_deg:g} to "
                f"{high_deg:g}"
            )
            raise step_limit_error(step, what)
    longest = max(len(piece) for piece in split_passes(plan.steps))
    if longest > int(limits["max_rows"]):
        raise AcquisitionError(
            f"plan: a scan has {longest} patterns, the controller holds {limits['max_rows']}; "
            "nothing was lit: change the plan"
        )


def check_caliper(plan: Plan, rig: Rig, limits: Mapping[str, Any]) -> None:
    """Raise an error when the caliper is not the rig file's, or the plan exceeds its travel."""
    drawn = rig.caliper
    if drawn is None:
        raise AcquisitionError("caliper: the rig file has none; use that of this rig")
    for name, expected in (("aperture_mm", drawn.aperture_mm), ("step_mm", drawn.step_mm)):
        if abs(float(limits.get(name, 0.0)) - expected) > 1e-6:
            raise AcquisitionError(
                f"caliper: its controller reports {name} {limits.get(name)}, the rig file has "
                f"{expected:g}; nothing has moved: use the rig file of this controller"
            )
    known = [float(angle) for angle in limits["angles_deg"]]
    low, high = int(limits["step_min"]), int(limits["step_max"])
    for step in plan.steps:
        if strain_state(step) is None:
            continue
        angle, position = float(step.index["angle"]), int(step.index["caliper"])
        if angle not in known or not low <= position <= high:
            raise AcquisitionError(
                f"step {step.id}: got position {position} at {angle:g} degrees, the caliper has "
                f"{low} to {high} at {', '.join(f'{a:g}' for a in known)}; nothing has moved: "
                "change the plan, or use the rig file of this controller"
            )


def check_force(limit_n: float | None, limits: Mapping[str, Any]) -> None:
    """Raise an error when the force limit is missing, or outside the sensor's range."""
    low, high = float(limits["force_limit_min_n"]), float(limits["force_limit_max_n"])
    if limit_n is None:
        raise AcquisitionError(
            "force limit: got none, expected the greatest force that this skin may bear; give "
            f"--force-limit N ({low:g} to {high:g} newton), it has no default; nothing has moved"
        )
    if not low <= limit_n <= high:
        raise AcquisitionError(
            f"force limit: got {limit_n:g} N, expected {low:g} to {high:g} N, the range of the "
            "caliper's sensor; nothing has moved: give a limit within it [SR-CAP-016]"
        )


SPHERE_LEASE_S = 2.0


def acquire(run: CaptureRun, boxes: Mapping[str, Any]) -> AcquisitionResult:
    """Capture the missing steps of a plan on the gradient sphere; see `run_plan`.

    All checks are made before anything is lit or moves.
    """
    skin = any(strain_state(step) is not None for step in run.plan.steps)
    sphere: GradientSphereBox = boxes["gradient_sphere"]
    caliper: CaliperBox | None = boxes.get("caliper") if skin else None
    check_eyes(run, skin=skin)
    check_sphere(run.plan, run.rig, sphere.limits)
    for name, camera in run.cameras.items():
        why = "sphere's trigger line, and no other way keeps pace with its patterns"
        require_trigger_line(name, camera, why)
    if skin:
        if caliper is None:
            raise AcquisitionError(
                "controller 'caliper': no port was given; add --port caliper=URL"
            )
        check_caliper(run.plan, run.rig, caliper.limits)
        check_force(run.force_limit_n, caliper.limits)
    scanner = PatternScanner(run, sphere, caliper.ping if caliper is not None else lambda: None)
    try:
        begin_lit_run(run, sphere, SPHERE_LEASE_S)
        for piece in split_passes(
            [step for step in run.pending_steps() if strain_state(step) is None]
        ):
            run.operator.stop_if_asked()
            scanner.commit(scanner.scan(piece), {})
        if caliper is not None and run.force_limit_n is not None:
            SkinStates(run, caliper, scanner, run.force_limit_n).scan()
    finally:
        if caliper is not None:
            release_skin(caliper)
        run.tear_down(sphere)
    return run.summarize(sphere.failed_leds)
