"""Simulate captures with the flash rig: a face or a target, with the ground truth."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from itertools import groupby
from typing import Any

from capture.plan import Plan
from capture.rig import Rig, load_rig
from model import store
from model.skin import SkinAppearance
from rigsim import targets
from rigsim.caching import forget_cached
from rigsim.mitsuba.variant import choose_renderer
from rigsim.needs.effects import SceneEffects
from rigsim.population import files as subject_file
from rigsim.scenes.flash.scene import FlashScene
from rigsim.scenes.flash.truth import face_surface
from rigsim.scenes.reference.flash_session import VoxelFlashScene, crop_to_patch, make_patch_sensor
from rigsim.subject.head_motion import draw_head_position
from rigsim.subject.perfusion import STATE_NAMES
from skinrig.capturing.plan_choice import DefaultPlan
from skinrig.console import select_attributes
from skinrig.errors import require_choice
from skinrig.simulating import reference, subject_records
from skinrig.simulating.driving import (
    build_result,
    drive_plan,
    encode_arrays,
    manifest_settings,
    open_session,
    require_room,
)
from skinrig.simulating.flash_truth import WIDTHS_PX, _stance_offset_mm, build_truth
from skinrig.simulating.orders import (
    MIN_WIDTH_PX,
    SURFACE_FILE,
    FlashOrder,
    SimulationError,
    SimulationResult,
    truth_folder,
)
from skinrig.simulating.sequence import simulate_sequence


def simulate_flash(order: FlashOrder) -> SimulationResult:
    """Simulate a capture with the flash rig; see `simulation.simulate`."""
    reference.check_flash_order(order)
    if order.sequence is not None:
        return simulate_sequence(order, order.sequence)
    target, states = order.target, order.states
    for state in states if target is None else ():
        require_choice("state", state, STATE_NAMES, SimulationError)
    # plan and scenes are built first, so that an error leaves no session folder
    rig, plan = plan_capture(order)
    require_room(order, rig, plan)
    is_patch = order.renderer == "reference"
    width = rig.views[0].width_px
    settings = manifest_settings(
        order,
        width_px=width,
        mesh=str(order.mesh or ""),
        states=list(states),
        **select_attributes(
            order,
            "repeats",
            "movement",
            *(["nearer_mm"] if order.nearer_mm else []),
            *(["bands"] if order.bands else []),
            *(["size", "site"] if is_patch else []),
        ),
    )
    texels = subject_records.choose_face_texels(width)
    if target is None and texels != subject_records.FACE_TEXELS:
        settings["texels"] = texels
    states_of = _StateScenes(_scene_makers(rig, order, plan), order, plan)
    first = states_of.first
    session = open_session(order, plan, rig, settings, first)
    states_of.with_oxygenation = any("light" in step.settings for step in plan.steps)
    rig_seconds = drive_plan(order, session, rig, first, states_of.prompt)
    if target is not None:
        return build_result(order, session, first, rig_seconds, None)
    truth = truth_folder(order.out)
    for state in states:
        folder = truth if state == states[0] else truth.with_name(f"{truth.name}-{state}")
        appearance = states_of.describe(state, session.content_hash)
        if isinstance(first, VoxelFlashScene):
            appearance = reference.add_voxels(first, appearance)
        elif state == states[0]:
            surface = face_surface(first.subject, state, rig, first.white_rgb())
            files = {SURFACE_FILE: encode_arrays(surface)}
            appearance = dataclasses.replace(appearance, files=files)
        store.write(folder, appearance)
    if is_patch:
        return build_result(order, session, first, rig_seconds, truth)
    blur_mm = tuple(float(width) for width in first.resolution_mm())
    return build_result(order, session, first, rig_seconds, truth, blur_mm=blur_mm)


class _StateScenes:
    """Scenes of a face by state; those that are left give way, as many would need much memory."""

    def __init__(
        self, makers: Mapping[str, Callable[[], Any]], order: FlashOrder, plan: Plan
    ) -> None:
        self._makers, self._order = makers, order
        states = [str(step.index.get("state", "")) for step in plan.steps]
        # a plan with repeats returns to its states
        self._visits_left = Counter(state for state, _ in groupby(filter(None, states)))
        self._scenes: dict[str, Any] = {}
        self._truths: dict[str, SkinAppearance] = {}
        self.with_oxygenation = False
        self.first = self._scene(next(iter(makers)))

    def _scene(self, state: str) -> Any:
        if state not in self._scenes:
            self._scenes[state] = self._makers[state]()
        return self._scenes[state]

    def prompt(self, world: Any, state: str) -> None:
        """Put the face in a state in front of the camera."""
        for left, scene in list(self._scenes.items()):
            if scene is world.scene and left != state and self._order.target is None:
                self._visits_left[left] -= 1
                if self._visits_left[left] <= 0 and left not in self._truths:
                    self._truths[left] = self._leave(left)
        world.scene = self._scene(state)

    def describe(self, state: str, session_hash: str) -> SkinAppearance:
        """Return the ground truth of a state, for the session of this hash."""
        found = self._truths.pop(state, None) or self._leave(state)
        return dataclasses.replace(found, inputs={"session": session_hash})

    def _leave(self, state: str) -> SkinAppearance:
        """Return the ground truth of a state, and forget its scene."""
        order, scene = self._order, self._scene(state)
        truth = build_truth(
            scene,
            order.seed,
            "",
            state,
            parameters=subject_records.truth_parameters(order.subject, "flash", order.progress),
            with_oxygenation=self.with_oxygenation,
        )
        forget_cached(scene)
        if scene is not self.first:
            del self._scenes[state]
        return truth


def plan_capture(order: FlashOrder) -> tuple[Rig, Plan]:
    """Return the rig at the image size of an order, and the plan; that of a sequence differs."""
    rig = load_rig("flash").at_iso(order.iso_factor)
    is_patch = order.renderer == "reference"
    width = order.width_px or (MIN_WIDTH_PX if is_patch else WIDTHS_PX[order.size])
    if is_patch:
        rig = crop_to_patch(rig, width)
    elif width != rig.views[0].width_px:
        rig = rig.resized(width)
    details = select_attributes(order, "target", "states", "repeats", "bands")
    return rig, order.plan or DefaultPlan(**details).of(rig)


def _scene_makers(rig: Rig, order: FlashOrder, plan: Plan) -> dict[str, Callable[[], Any]]:
    """Return a function per state that makes its scene."""
    seed = order.noise_seed
    powers = [float(step.settings.get("power", 0.0)) for step in plan.steps]
    power = max(powers, default=0.0) or 1.0
    if order.target is not None:
        state = "white" if order.target == "white" else ""
        target = targets.make_target(order.target)
        sensor = make_patch_sensor(rig) if order.renderer == "reference" else None
        return {state: partial(FlashScene, rig, target, seed=seed, power=power, sensor=sensor)}
    if order.renderer == "reference":
        given = select_attributes(
            order, "subject", "site", "seed", "noise_seed", "size", "progress"
        )
        return {"neutral": partial(reference.make_patch_scene, rig, **given)}
    offset_mm = _stance_offset_mm(rig, order.nearer_mm)  # refuses, before the face is made
    subject = subject_file.load_subject(order.subject)
    texels = subject_records.choose_face_texels(rig.views[0].width_px)
    person = subject.face(seed=order.seed, size=texels, mesh=order.mesh)
    person = person.translate(offset_mm)
    person = person.translate(draw_head_position(order.session_seed))
    return {
        state: partial(
            FlashScene,
            rig,
            person,
            state=state,
            movement=order.movement,
            seed=seed,
            power=power,
            effects=SceneEffects.from_switches(order.scene_switches()),
            choice=choose_renderer(order.renderer),
        )
        for state in order.states
    }
