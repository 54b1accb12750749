"""Simulate captures with the gradient sphere: skin in a caliper, or a target, with the truth."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, cast

from capture.plan import Plan
from capture.plan.gradient import group_by_state, strain_state
from capture.rig import Rig, load_rig
from capture.session import Session
from rigsim.as_built.aging import RigAge, age_sphere
from rigsim.as_built.sphere import build_sphere
from rigsim.mitsuba.variant import Renderer, choose_renderer
from rigsim.needs.effects import SceneEffects, max_on_time_s
from rigsim.population import files as subject_file
from rigsim.scenes.gradient.scene import GradientScene
from rigsim.scenes.gradient.truth import gradient_truth as ground_truth
from rigsim.scenes.gradient.truth import scene_surface
from rigsim.skin_patch.motion import PatchMotion
from rigsim.skin_patch.stretch import required_size_mm
from rigsim.world.taped_skin import GripState
from skinrig.capturing.plan_choice import DefaultPlan
from skinrig.console import select_attributes
from skinrig.simulating import driving, reference
from skinrig.simulating.exposure_log import SceneLog
from skinrig.simulating.orders import SURFACE_FILE, GradientOrder, SimulationResult, truth_folder

WIDTHS_PX = {"small": 256, "full": 2048}
ANGLES_DEG: dict[str, tuple[float, ...] | None] = {"small": (0.0,), "full": None}
DEFAULT_SITE = "forehead"
FORCE_LIMIT_N = 2.0
"""Force limit of simulated skin, N."""
STRETCH_RANGE = (0.66, 1.4)
"""Range of the stretch ratio of simulated skin before it buckles or detaches."""
MAX_SHIFT_MM = 0.3
"""Maximum offset of the patch from the center, mm: five standard deviations of its motion."""


def simulate_gradient(order: GradientOrder) -> SimulationResult:
    """Simulate a capture with the gradient sphere; see `simulation.simulate`."""
    order = reference.check_gradient_order(order)
    rig, plan = plan_capture(order)
    driving.require_room(order, rig, plan)
    light = driving.announce_light(plan, rig, order)
    asked = driving.manifest_settings(
        order,
        width_px=rig.views[0].width_px,
        site=order.site or DEFAULT_SITE,
        angles=",".join(f"{angle:g}" for angle in order.angles or ANGLES_DEG[order.size] or ()),
        steps="" if order.steps is None else f"{order.steps[0]}..{order.steps[1]}",
    )
    scene = make_scene(
        rig,
        order.target,
        site=order.site,
        subject=order.subject,
        seed=order.seed,
        noise_seed=order.noise_seed,
        age=order.rig_age,
        plan=plan,
        without=order.scene_switches(),
        renderer=order.renderer,
        size=order.size,
        progress=order.progress,
    )
    session, log = driving.open_logged_session(order, plan, rig, asked, scene, GripLog)
    rig_seconds = driving.drive_plan(
        order, session, rig, log, eyes="closed", force_limit_n=FORCE_LIMIT_N
    )
    truth = None
    if order.target is None:
        truth = truth_folder(order.out)
        grips = log.list_grips(session)
        files = {SURFACE_FILE: driving.encode_arrays(scene_surface(scene, grips))}
        driving.write_truth(truth, order, session, ground_truth(scene, grips), files=files)
    log.remove()
    return driving.build_result(order, session, scene, rig_seconds, truth, light=light)


def plan_capture(order: GradientOrder) -> tuple[Rig, Plan]:
    """Return the rig at the image size of an order, and the plan."""
    # the 12 mm ball needs the whole sensor at every size
    width_px = WIDTHS_PX["full" if order.target == "ball" else order.size]
    rig = load_rig("gradient").at_iso(order.iso_factor).cropped(order.width_px or width_px)
    angles = ANGLES_DEG[order.size] if order.angles is None else order.angles
    details = select_attributes(order, "target", "steps")
    return rig, order.plan or DefaultPlan(angles=angles, **details).of(rig)


def make_scene(
    rig: Rig,
    target: str | None = None,
    *,
    site: str | None = None,
    subject: str = "III",
    seed: int = 0,
    noise_seed: int | None = None,
    age: RigAge | None = None,
    plan: Plan | None = None,
    without: Mapping[str, Any] | None = None,
    renderer: Renderer = "mitsuba",
    size: str = "small",
    progress: Callable[[str], None] | None = None,
) -> Any:
    """Return the scene of a target or a patch of skin in the sphere, with its actual LEDs.

    Parameters
    ----------
    rig : Rig
        Rig with its cropped camera.
    target : str, optional
        "ball", "flat" or "dark"; a patch of skin by default.
    site, subject, seed
        Properties of the skin; the seed is also that of the sphere.
    noise_seed
        Seed of the noise, the patch's motion and the place of a target; None: `seed`.
    age
        State of the rig on the day of the session; None: as built.
    plan : Plan, optional
        Plan whose caliper angles set the size of the skin; default any angle.
    without
        Omitted effects of the skin, see `skinrig.simulating.effect_omission`.
    renderer
        Renderer of the patch; "mitsuba" only where its shadow rays are affordable.
    size, progress
        Samples of voxels, and what is called with lines on them (renderer "reference").
    """
    sphere = build_sphere(rig, seed=seed)
    if age is not None:
        sphere = age_sphere(sphere, age, seed=seed)
    session_seed = seed if noise_seed is None else noise_seed
    if target is not None:
        return GradientScene(rig, cast(Any, target), sphere=sphere, seed=session_seed)
    on_s = None if plan is None else max_on_time_s(plan)
    if renderer == "reference":
        return reference.make_gradient_scene(
            rig,
            sphere,
            subject=subject,
            site=site or DEFAULT_SITE,
            seed=seed,
            noise_seed=session_seed,
            size=size,
            on_s=on_s,
            progress=progress,
        )
    angles = {float(s.index["angle"]) for s in plan.steps if strain_state(s)} if plan else set()
    size_mm = required_size_mm(
        max(rig.views[0].field_mm),
        STRETCH_RANGE,
        angle_deg=angles.pop() if len(angles) == 1 else None,
        shift_mm=MAX_SHIFT_MM,
    )
    skin = subject_file.load_subject(subject).patch(
        site or DEFAULT_SITE, seed=seed, size_mm=size_mm
    )
    return GradientScene(
        rig,
        skin,
        sphere=sphere,
        motion=PatchMotion(session_seed),
        seed=session_seed,
        on_s=on_s,
        effects=SceneEffects.from_switches(without or {}),
        choice=choose_renderer(renderer) if renderer == "fast" else None,
    )


class GripLog(SceneLog):
    """Scene that logs the skin's grip by the caliper at each exposure."""

    suffix, kinds, max_lag_s = "grips", ("gradient",), 0.05
    lost_label = "the states captured before"

    def describe_exposure(self, exposed: Mapping[str, Any]) -> Mapping[str, Any] | None:
        """Return the caliper's grip of the lit skin; None without skin."""
        grip = exposed["grip"]
        return {"grip": dataclasses.asdict(grip)} if grip.attached else None

    def list_grips(self, session: Session) -> list[Any]:
        """Return the grip in each recorded strain step, in the plan's order."""
        entries = self.read()
        found = []
        for name, steps in group_by_state(session.plan):
            ids = {step.id for step in steps}
            lit = (
                record
                for record in session.frames("gradient")
                if record.step_id in ids and record.settings["pattern"] != "dark"
            )
            if (first := next(lit, None)) is not None:
                entry = self.at(entries, first, f"state {name}")
                found.append(GripState(**entry["grip"]))
        return found
