"""The gradient sphere simulated: a patch of skin in a caliper, or a target, and the truth."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast, get_args

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
from model import store
from rigsim.scenes.gradient.truth import appearance as ground_truth
from skinrig.capturing.light_safety import light_figures, light_lines
from skinrig.simulating import subject_records
from skinrig.simulating.driving import drive, effects_of, open_session
from skinrig.simulating.orders import Order, Simulated, SimulationError, truth_folder

WIDTHS_PX = {"small": 256, "full": 2048}
ANGLES_DEG: dict[str, tuple[float, ...] | None] = {"small": (0.0,), "full": None}
SITE = "forehead"
FORCE_LIMIT_N = 2.0
"""What simulated skin bears."""
STRETCHES = (0.66, 1.4)
"""No simulated skin goes further before it buckles or comes off."""
SHIFT_MM = 0.3
"""How far the patch may come to lie off the middle: five standard deviations of its motion."""
NEAR_S = 0.05


def simulate_gradient(order: Order) -> Simulated:
    """Simulate a capture with the gradient sphere; see `simulation.simulate_session`."""
    targets = get_args(GradientTarget)
    if order.target is not None and order.target not in targets:
        raise SimulationError(f"target: got {order.target!r}, expected one of {', '.join(targets)}")
    order.refuse(
        "gradient",
        states=("neutral",),
        movement=True,
        repeats=1,
        mesh=None,
        lights=None,
        views=None,
        move=False,
        sites=None,
        all_brackets=False,
        wrapped=False,
    )
    if order.target is not None:
        order.refuse("target of the gradient", site=None, angles=None, steps=None)
    # a ball of 12 mm fills the whole sensor, however small all else is kept
    width_px = WIDTHS_PX["full" if order.target == "ball" else order.size]
    rig = load_rig("gradient").cropped(order.width_px or width_px)
    plan = plan_of(rig, order)
    figures = light_figures(plan, rig)
    if order.progress is not None:
        for line in light_lines(plan, rig):
            order.progress(line)
    shown = subject_records.of_manifest(order.subject)
    asked = {
        "rig": "gradient",
        "width_px": rig.views[0].width_px,
        "subject": shown,
        "target": order.target or "",
        "site": order.site or SITE,
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
        without=order.without("gradient"),
    )
    session = open_session(order, plan, rig, asked, scene)
    try:
        log = GripLog(scene, truth_folder(order.out), resume=order.resume, session=session)
    except BaseException:
        session.release()
        raise
    rig_seconds = drive(
        session,
        rig,
        log,
        order.seed,
        lambda world, text: None,
        order.progress,
        eyes="closed",
        force_limit_n=FORCE_LIMIT_N,
        run_id=log.run_id,
    )
    truth = None
    if order.target is None:
        truth = truth_folder(order.out)
        appearance = ground_truth(scene, log.grips(session))
        appearance = dataclasses.replace(
            appearance,
            parameters={
                "kind": "truth",
                "state": "neutral",
                **appearance.parameters,
                **subject_records.of_truth(order.subject, "gradient", order.progress),
            },
            inputs={"session": session.content_hash},
            seed=order.seed,
        )
        store.write(truth, appearance)
    log.remove()
    return Simulated(
        order.out,
        truth,
        len(session.frames()),
        rig_seconds,
        tuple(scene.left_out),
        light=figures,
        effects=effects_of(scene),
    )


def plan_of(rig: Rig, order: Order) -> Plan:
    """Return the plan of what is to be simulated."""
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
    from rigsim.as_built.sphere import build_sphere
    from rigsim.needs.effects import SceneEffects, longest_on_s
    from rigsim.population import files as subject_file
    from rigsim.scenes.gradient.scene import GradientScene
    from rigsim.skin_patch.motion import PatchMotion
    from rigsim.skin_patch.stretch import size_for

    sphere = build_sphere(rig, seed=seed)
    if target is not None:
        return GradientScene(rig, cast(Any, target), sphere=sphere, seed=seed)
    angles = {float(s.index["angle"]) for s in plan.steps if state_of(s)} if plan else set()
    size_mm = size_for(
        max(rig.views[0].field_mm),
        STRETCHES,
        angle_deg=angles.pop() if len(angles) == 1 else None,
        shift_mm=SHIFT_MM,
    )
    skin = subject_file.load_subject(subject).patch(site or SITE, seed=seed, size_mm=size_mm)
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


class GripLog:
    """A scene that notes what the caliper held at every exposure, beside the session.

    The truth needs the skin's own stretch in each state, also of states that were captured before
    an interruption, and no session may hold it.

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

    def __init__(self, scene: Any, truth: Path, *, resume: bool, session: Session) -> None:
        self._scene = scene
        self._path = truth.with_name(f".{truth.name}.grips.jsonl")
        if not resume:
            self._path.unlink(missing_ok=True)
        entries = self._read()
        if session.frames("gradient") and not entries:
            raise SimulationError(
                f"{self._path}: is gone, and with it the truth of the states captured before; "
                "simulate the session anew"
            )
        self.run_id = f"sim{1 + max((int(entry['run']) for entry in entries), default=0)}"

    def exposure(
        self, view_name: str, *, pops: Sequence[Any], exposure_s: float, seed: int, grip: Any
    ) -> Any:
        """Expose the scene, and note the grip of what is lit."""
        if pops and grip.attached:
            entry = {
                "run": int(self.run_id.removeprefix("sim")),
                "t_s": pops[0].t_on_s,
                "grip": dataclasses.asdict(grip),
            }
            with self._path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(entry) + "\n")
        return self._scene.exposure(
            view_name, pops=pops, exposure_s=exposure_s, seed=seed, grip=grip
        )

    def grips(self, session: Session) -> list[Any]:
        """Return what was held in each state that the session has, in the plan's order."""
        from rigsim.world.taped_skin import GripState

        entries = self._read()
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
            near = [e for e in entries if e["run"] == run and abs(e["t_s"] - time_s) < NEAR_S]
            if not near:
                raise SimulationError(f"{self._path}: tells nothing of the state {name}")
            found.append(GripState(**near[0]["grip"]))
        return found

    def remove(self) -> None:
        """Remove the log: the truth is written."""
        self._path.unlink(missing_ok=True)

    def _read(self) -> list[Mapping[str, Any]]:
        if not self._path.is_file():
            return []
        lines = self._path.read_text(encoding="utf-8").splitlines(keepends=True)
        # a last line may be cut off; its frame was not committed
        return [json.loads(line) for line in lines if line.endswith("}\n")]
