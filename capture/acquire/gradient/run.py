"""Run a plan on the gradient sphere: skin in a caliper, state of strain by state, or a target."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from capture.acquire.gradient.checks import (
    check_caliper,
    check_cameras,
    check_eyes,
    check_force,
    check_sphere,
)
from capture.acquire.gradient.skin_states import CaliperDriver, SkinStates, let_go
from capture.acquire.outcome import Acquired, AcquisitionError, Operator, steps_to_do, tear_down
from capture.acquire.pattern_scan import Scanner, Sphere
from capture.devices.camera import Camera
from capture.devices.gradient_sphere import Eyes
from capture.plan import Plan
from capture.plan.gradient import state_of
from capture.plan.rows import passes
from capture.rig import Rig
from capture.session import Session

SPHERE_LEASE_S = 2.0


def run_gradient(
    plan: Plan,
    rig: Rig,
    *,
    boxes: Mapping[str, Any],
    cameras: Mapping[str, Camera],
    session: Session,
    operator: Operator,
    eyes: Eyes = "open",
    force_limit_n: float | None = None,
) -> Acquired:
    """Capture what the session still lacks of a plan of the gradient sphere; see `run_plan`.

    Everything that can be refused is, before anything is lit or moves.
    """
    skin = any(state_of(step) is not None for step in plan.steps)
    sphere = cast(Sphere, boxes["gradient_sphere"])
    caliper = cast(CaliperDriver | None, boxes.get("caliper")) if skin else None
    check_eyes(plan, rig, eyes, skin=skin)
    check_sphere(plan, rig, sphere.limits)
    check_cameras(cameras)
    if skin:
        if caliper is None:
            raise AcquisitionError("box 'caliper': no port was given; add --port caliper=URL")
        check_caliper(plan, rig, caliper.limits)
        check_force(force_limit_n, caliper.limits)
    keep_alive = caliper.ping if caliper is not None else _nothing
    scanner = Scanner(rig, sphere, cameras, session, operator, keep_alive=keep_alive)
    try:
        sphere.dark()  # whatever was going on before
        sphere.set_lease(SPHERE_LEASE_S)
        sphere.set_cameras((1 << len(rig.views)) - 1)
        if not session.frames():
            sphere.new_subject(session.id[:32])
        sphere.set_eyes(eyes)
        flat = [step for step in steps_to_do(session) if state_of(step) is None]
        for piece in passes(flat):
            operator.stop_if_asked()
            scanner.commit(scanner.scan(piece), {})
        if caliper is not None and force_limit_n is not None:
            SkinStates(rig, caliper, scanner, session, operator, force_limit_n).run()
    finally:
        if caliper is not None:
            let_go(caliper)
        tear_down(sphere, cameras)
    dead = tuple(rig.lights[led].name for led in sorted(sphere.failed_leds))
    return Acquired(scanner.steps, scanner.frames, scanner.stale, scanner.retakes, dead)


def _nothing() -> None:
    """Do nothing."""
