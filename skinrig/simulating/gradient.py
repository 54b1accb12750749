"""The gradient sphere simulated: a patch of skin in a caliper, or a target, and the truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from capture.plan import Plan
from capture.plan.gradient import (
    GradientTarget,
    gradient_calibration_plan,
    gradient_plan,
    state_of,
    states,
)
from capture.rig import Rig, load_rig
from capture.session import Session
from rigsim.as_built.sphere import build_sphere
from rigsim.needs.effects import SceneEffects, longest_on_s
from rigsim.population import files as subject_file
from rigsim.scenes.gradient.scene import GradientScene
from rigsim.scenes.gradient.truth import appearance as ground_truth
from rigsim.skin_patch.motion import PatchMotion
from rigsim.skin_patch.stretch import size_for
from rigsim.world.taped_skin import GripState
from skinrig.simulating import subject_records
from skinrig.simulating.driving import announce_light, drive, finish, open_session, write_truth
from skinrig.simulating.exposure_log import SceneLog
from skinrig.simulating.orders import GradientOrder, Simulated, SimulationError, truth_folder

WIDTHS_PX = {"small": 256, "full": 2048}
ANGLES_DEG: dict[str, tuple[float, ...] | None] = {"small": (0.0,), "full": None}
DEFAULT_SITE = "forehead"
FORCE_LIMIT_N = 2.0
"""What simulated skin bears."""
STRETCH_RANGE = (0.66, 1.4)
"""No simulated skin goes further before it buckles or comes off."""
MAX_SHIFT_MM = 0.3
"""How far the patch may come to lie off the middle: five standard deviations of its motion."""
MAX_LOG_LAG_S = 0.05


def simulate_gradient(order: GradientOrder) -> Simulated:
    """Simulate a capture with the gradient sphere; see `simulation.simulate`."""
    # a ball of 12 mm fills the whole sensor, however small all else is kept
    width_px = WIDTHS_PX["full" if order.target == "ball" else order.size]
    rig = load_rig("gradient").cropped(order.width_px or width_px)
    plan = _plan(rig, order)
    light = announce_light(plan, rig, order)
    asked = {
        "rig": "gradient",
        "width_px": rig.views[0].width_px,
        "subject": subject_records.of_manifest(order.subject),
        "target": order.target or "",
        "site": order.site or DEFAULT_SITE,
        "angles": ",".join(f"{angle:g}" for angle in order.angles or ANGLES_DEG[order.size] or ()),
        "steps": "" if order.steps is None else f"{order.steps[0]}..{order.steps[1]}",
        **({} if order.plan is None else {"plan": order.plan.to_json()}),
        **({"leave_out": list(order.leave_out)} if order.leave_out else {}),
    }
    scene = make_scene(
        rig,
        order.target,
        site=order.site,
        subject=order.subject,
        seed=order.seed,
        plan=plan,
        without=order.scene_switches(),
    )
    session = open_session(order, plan, rig, asked, scene)
    try:
        log = GripLog(scene, truth_folder(order.out), resume=order.resume, session=session)
    except BaseException:
        session.release()
        raise
    rig_seconds = drive(
        order, session, rig, log, eyes="closed", force_limit_n=FORCE_LIMIT_N, run_id=log.run_id
    )
    truth = None
    if order.target is None:
        truth = truth_folder(order.out)
        write_truth(truth, order, session, ground_truth(scene, log.grips(session)))
    log.remove()
    return finish(order, session, scene, rig_seconds, truth, light=light)


def _plan(rig: Rig, order: GradientOrder) -> Plan:
    if order.target is not None:
        return gradient_calibration_plan(rig, cast(GradientTarget, order.target))
    if order.plan is not None:
        return order.plan
    angles = ANGLES_DEG[order.size] if order.angles is None else order.angles
    return gradient_plan(rig, angles=angles, steps=order.steps)


def make_scene(
    rig: Rig,
    target: str | None = None,
    *,
    site: str | None = None,
    subject: str = "III",
    seed: int = 0,
    plan: Plan | None = None,
    without: Mapping[str, Any] | None = None,
) -> Any:
    """Return what stands in the sphere, with LEDs as they were built.

    Parameters
    ----------
    rig : Rig
        Cropped as it is used.
    target : str, optional
        "ball", "flat" or "dark"; a patch of skin by default.
    site, subject, seed
        Of the skin; the seed also of the sphere and of the patch's motion.
    plan : Plan, optional
        By whose angles the skin must be large enough; any angle by default.
    without
        What of the skin is not built, see `skinrig.simulating.leaving_out`.
    """
    sphere = build_sphere(rig, seed=seed)
    if target is not None:
        return GradientScene(rig, cast(Any, target), sphere=sphere, seed=seed)
    angles = {float(s.index["angle"]) for s in plan.steps if state_of(s)} if plan else set()
    size_mm = size_for(
        max(rig.views[0].field_mm),
        STRETCH_RANGE,
        angle_deg=angles.pop() if len(angles) == 1 else None,
        shift_mm=MAX_SHIFT_MM,
    )
    skin = subject_file.load_subject(subject).patch(
        site or DEFAULT_SITE, seed=seed, size_mm=size_mm
    )
    on_s = None if plan is None else longest_on_s(plan)
    return GradientScene(
        rig,
        skin,
        sphere=sphere,
        motion=PatchMotion(seed),
        seed=seed,
        on_s=on_s,
        effects=SceneEffects.from_switches(without or {}),
    )


class GripLog(SceneLog):
    """A scene that notes what the caliper held at every exposure, beside the session.

    Parameters
    ----------
    scene
        What the cameras see.
    truth : Path
        Where the truth will be; the log lies beside it until then.
    resume : bool
        Whether the session was begun before.
    session : Session
        Open.

    Raises
    ------
    SimulationError
        When frames were captured before and their log is gone.
    """

    lost = "the states captured before"

    def __init__(self, scene: Any, truth: Path, *, resume: bool, session: Session) -> None:
        path = truth.with_name(f".{truth.name}.grips.jsonl")
        captured = bool(session.frames("gradient"))
        super().__init__(scene, path, resume=resume, captured=captured)

    def exposure(
        self, view_name: str, *, pops: Sequence[Any], exposure_s: float, seed: int, grip: Any
    ) -> Any:
        """Expose the scene, and note the grip of what is lit."""
        if pops and grip.attached:
            self.note(pops[0].t_on_s, {"grip": dataclasses.asdict(grip)})
        return self._scene.exposure(
            view_name, pops=pops, exposure_s=exposure_s, seed=seed, grip=grip
        )

    def grips(self, session: Session) -> list[Any]:
        """Return what was held in each state that the session has, in the plan's order."""
        entries = self.read()
        found = []
        for name, steps in states(session.plan):
            ids = {step.id for step in steps}
            lit = [
                record
                for record in session.frames("gradient")
                if record.step_id in ids and record.settings["pattern"] != "dark"
            ]
            if not lit:
                continue
            run = int(str(lit[0].actual["token"]).partition(".")[0].removeprefix("sim"))
            time_s = float(lit[0].line.t_box_s or 0.0)
            near = [
                e for e in entries if e["run"] == run and abs(e["t_s"] - time_s) < MAX_LOG_LAG_S
            ]
            if not near:
                raise SimulationError(f"{self._path}: tells nothing of the state {name}")
            found.append(GripState(**near[0]["grip"]))
        return found
