"""Run a plan on the gradient sphere: skin in a caliper, state of strain by state, or a target."""

from collections.abc import Mapping
from typing import Any

from capture.acquire.dome import begin_lit_run
from capture.acquire.gradient.checks import check_caliper, check_eyes, check_force, check_sphere
from capture.acquire.gradient.skin_states import SkinStates, let_go
from capture.acquire.outcome import Acquired, AcquisitionError, CaptureRun, require_trigger_line
from capture.acquire.pattern_scan import Scanner
from capture.devices.caliper import CaliperBox
from capture.devices.gradient_sphere import GradientSphereBox
from capture.plan.gradient import state_of
from capture.plan.rows import passes

SPHERE_LEASE_S = 2.0


def run_gradient(run: CaptureRun, boxes: Mapping[str, Any]) -> Acquired:
    """Capture what the session still lacks of a plan of the gradient sphere; see `run_plan`.

    Everything that can be refused is, before anything is lit or moves.
    """
    skin = any(state_of(step) is not None for step in run.plan.steps)
    sphere: GradientSphereBox = boxes["gradient_sphere"]
    caliper: CaliperBox | None = boxes.get("caliper") if skin else None
    check_eyes(run, skin=skin)
    check_sphere(run.plan, run.rig, sphere.limits)
    for name, camera in run.cameras.items():
        why = "sphere's trigger line, and no other way keeps pace with its patterns"
        require_trigger_line(name, camera, why)
    if skin:
        if caliper is None:
            raise AcquisitionError("box 'caliper': no port was given; add --port caliper=URL")
        check_caliper(run.plan, run.rig, caliper.limits)
        check_force(run.force_limit_n, caliper.limits)
    scanner = Scanner(run, sphere, caliper.ping if caliper is not None else lambda: None)
    try:
        begin_lit_run(run, sphere, SPHERE_LEASE_S)
        for piece in passes([step for step in run.steps_to_do() if state_of(step) is None]):
            run.operator.stop_if_asked()
            scanner.commit(scanner.scan(piece), {})
        if caliper is not None and run.force_limit_n is not None:
            SkinStates(run, caliper, scanner, run.force_limit_n).scan()
    finally:
        if caliper is not None:
            let_go(caliper)
        run.tear_down(sphere)
    return run.account(sphere.failed_leds)
