"""Simulate sequences in time with the flash rig: prompts, perfusion, and the ground truth."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from capture.rig import load_rig
from capture.session import Session
from model import store
from rigsim.mitsuba.variant import choose_renderer
from rigsim.population import files as subject_file
from rigsim.scenes.flash.course import FlashCourseScene, FlashEvent
from rigsim.subject.head_motion import draw_head_position
from rigsim.subject.perfusion import STATE_NAMES
from rigsim.subject.perfusion_course import EventCourse, PromptedCourse
from skinrig.arrays import BoolArray, Float64Array
from skinrig.capturing.sequences import SequenceOrder, sequence_lines, sequence_plan
from skinrig.errors import require_choice
from skinrig.simulating import subject_records
from skinrig.simulating.driving import (
    build_result,
    drive_plan,
    open_session,
    require_exposures_of_log,
    require_room,
    require_unfinished,
    session_settings,
)
from skinrig.simulating.exposure_log import ExposureLog
from skinrig.simulating.flash_truth import WIDTHS_PX, build_truth, scale_landmarks, to_superpixels
from skinrig.simulating.orders import (
    FlashOrder,
    SimulationError,
    SimulationOptionsError,
    SimulationResult,
    truth_folder,
)

COURSE_FILE = "perfusion_course.json"
"""File of the ground truth with the blood volume fraction at the time of each frame."""
LANDMARKS_FILE = "landmarks.csv"
"""File of the ground truth with the landmarks of the neutral face, px of superpixels."""
COURSE_LANDMARKS = {
    "forehead": "forehead",
    "cheek": "cheek left",
    "nose": "nose tip",
    "chin": "chin",
    "temple": "temple left",
}
"""The five positions of Jimenez et al. 2010, figure 7, with their landmarks."""
DISC_RADIUS_FRACTION = 0.02
"""Radius of the disc at a position, as a fraction of the image width."""


def simulate_sequence(order: FlashOrder, sequence: SequenceOrder) -> SimulationResult:
    """Simulate a sequence with the flash rig; see `simulation.simulate`."""
    prompted = [state for state in STATE_NAMES if state != "neutral"]
    require_choice("sequence", sequence.state, prompted, SimulationError)
    width, seed = order.width_px or WIDTHS_PX[order.size], order.seed
    rig = load_rig("flash").at_iso(order.iso_factor).resized(width)
    constant_s = order.relaxation_s
    if constant_s is not None and not 0 < constant_s < np.inf:
        raise SimulationError(f"relaxation: got {constant_s}, expected seconds > 0")
    asked = {
        "rig": "flash",
        "width_px": width,
        "subject": subject_records.manifest_record(order.subject),
        "mesh": str(order.mesh or ""),
        "sequence": sequence.document(),
        "relaxation_s": constant_s,
        "movement": order.movement,
        **session_settings(order),
    }
    reaction_s = sequence.reaction_s
    if reaction_s is not None and not 0 <= reaction_s < np.inf:
        raise SimulationError(f"reaction: got {reaction_s}, expected seconds >= 0")
    if reaction_s is not None and not sequence.is_prompted:
        raise SimulationOptionsError(
            f"reaction: an option of prompted sequences, not of {sequence.state}; remove it"
        )
    if sequence.is_prompted:
        own = {"rise_s": constant_s, "fall_s": constant_s, "reaction_s": reaction_s}
        known: dict[str, Any] = {name: v for name, v in own.items() if v is not None}
        course: EventCourse | PromptedCourse = PromptedCourse(
            sequence.state, seed=order.noise_seed, **known
        )
    else:
        course = EventCourse(sequence.state, constant_s)
    plan = sequence_plan(rig, sequence)
    require_room(order, rig, plan)
    subject = subject_file.load_subject(order.subject)
    texels = subject_records.choose_face_texels(width)
    person = subject.face(seed=seed, size=texels, mesh=order.mesh)
    person = person.translate(draw_head_position(order.session_seed))
    if order.progress is not None:
        for line in sequence_lines(plan):
            order.progress(line)
    truth = truth_folder(order.out)
    log: ExposureLog | None = None

    def note(flash: FlashEvent) -> None:
        if log is not None:  # None until the session is open; flashes begin later
            log.add(dataclasses.asdict(flash))

    scene = FlashCourseScene(
        rig,
        person,
        course,
        seed=order.noise_seed,
        movement=order.movement,
        on_flash=note,
        choice=choose_renderer(order.renderer),
    )
    session = open_session(order, plan, rig, asked, scene)
    log_path = truth.with_name(f"{truth.name}.flashes.jsonl")
    require_unfinished(order, session, scene, log_path)
    require_exposures_of_log(session, log_path)
    log = ExposureLog(log_path, resume=order.resume)

    def prompt(world: Any, text: str) -> None:
        if text == sequence.state:
            course.prompt(world.now, text)

    def signal(world: Any, text: str) -> None:
        course.prompt(world.now, text)

    rig_seconds = drive_plan(order, session, rig, scene, prompt, signal=signal)
    about = subject_records.truth_parameters(order.subject, "flash", order.progress)
    flashes = {str(entry["token"]): entry for entry in log.read()}
    _write_truth(truth, scene, session, sequence, flashes, seed, about)
    log.remove()
    return build_result(order, session, scene, rig_seconds, truth)


def _write_truth(
    folder: Path,
    scene: FlashCourseScene,
    session: Session,
    sequence: SequenceOrder,
    flashes: Mapping[str, Mapping[str, Any]],
    seed: int,
    parameters: Mapping[str, Any],
) -> None:
    """Write the ground truth at rest with the perfusion at each frame, and that of the state."""
    poses = sorted({"neutral", *(str(flash["pose"]) for flash in flashes.values())})
    radius_px = DISC_RADIUS_FRACTION * session.rig.views[0].width_px / 2
    places = {pose: scale_landmarks(scene.landmarks_px(pose)) for pose in poses}
    points = {
        pose: {name: at[of] for name, of in COURSE_LANDMARKS.items() if of in at}
        for pose, at in places.items()
    }
    frames = []
    for record in session.frames("subject"):
        actual = record.line.actual
        met = flashes.get(str(actual.get("token")))
        if met is None:
            continue
        times = {"time_s": actual.get("time_s"), "phase_s": actual.get("phase_s")}
        frames.append({"step": record.step_id, **times, "level": met["level"], "pose": met["pose"]})
    for pose in poses:
        chosen = [frame for frame in frames if frame["pose"] == pose]
        maps = scene.hemoglobin(pose, [float(frame["level"]) for frame in chosen])
        mask = np.asarray(scene.truth(pose, 0.0)["mask"], bool)
        for frame, whole in zip(chosen, maps, strict=True):
            small = to_superpixels(np.asarray(whole, np.float64), mask)
            valid = to_superpixels(mask.astype(float)) == 1.0
            frame["hemoglobin"] = {
                name: disc_mean(small, valid, place, radius_px)
                for name, place in points[pose].items()
            }
    document = {
        "schema": "skinrig.perfusion-course/1",
        "state": sequence.state,
        "constants_s": _constants(scene.course),
        "points_px": points,
        "radius_px": radius_px,
        "frames": frames,
    }
    table = ["name,x,y", *(f"{name},{x:.3f},{y:.3f}" for name, (x, y) in places["neutral"].items())]
    rest = build_truth(
        scene.scene_at("neutral", 0.0), seed, session.content_hash, "neutral", parameters=parameters
    )
    files = {
        COURSE_FILE: (json.dumps(document, indent=1) + "\n").encode(),
        LANDMARKS_FILE: ("\n".join(table) + "\n").encode(),
    }
    store.write(folder, dataclasses.replace(rest, files=files))
    pose = sequence.state if sequence.is_prompted else "neutral"
    state = sequence.state
    full = build_truth(
        scene.scene_at(pose, 1.0), seed, session.content_hash, state, parameters=parameters
    )
    store.write(folder.with_name(f"{folder.name}-{sequence.state}"), full)


def _constants(course: Any) -> dict[str, float]:
    names = ("rise_s", "fall_s", "reaction_s", "reaction_spread_s", "relaxation_s")
    return {name: float(getattr(course, name)) for name in names if hasattr(course, name)}


def disc_mean(
    values: Float64Array, valid: BoolArray, center_px: Sequence[float], radius: float
) -> float | None:
    """Return the mean of the valid pixels in a disc about (x, y), px; None if there are none."""
    rows, columns = np.indices(values.shape)
    near = (columns - center_px[0]) ** 2 + (rows - center_px[1]) ** 2 <= radius**2
    inside = valid & near
    return float(values[inside].mean()) if inside.any() else None
