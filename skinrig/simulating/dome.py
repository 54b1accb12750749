"""The light dome simulated: a face or a target, a scan of the face, and the truth."""

from __future__ import annotations

import dataclasses
import io
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from capture.plan import Plan
from capture.plan.dome import DomeTarget, dome_calibration_plan, dome_plan
from capture.plan.rows import step_lights
from capture.rig import Rig, load_rig
from model.skin import SkinAppearance
from rigsim.as_built.dome import build_dome
from rigsim.needs.effects import SceneEffects, max_on_time_s
from rigsim.population import files as subject_file
from rigsim.population.conditions import ConditionError, validate_conditions
from rigsim.population.population import PopulationError, get_member
from rigsim.scanner.flaws import encode_binary_ply
from rigsim.scanner.pods import ScannerSettings, scan_face, wrap_template
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.dome.targets import TARGET_POSES, make_target_scene, plate_normals
from rigsim.subject.head_motion import draw_head_motion
from rigsim.subject.perfusion import STATE_NAMES
from rigsim.targets import make_target
from skinrig.console import select_attributes
from skinrig.errors import one_of
from skinrig.evaluating.reflection_truth import TEST_FILE, make_test
from skinrig.simulating import driving
from skinrig.simulating.orders import (
    DomeOrder,
    SimulationError,
    SimulationOptionsError,
    SimulationResult,
    truth_folder,
)

if TYPE_CHECKING:
    from rigsim.population.population import Member

TEXTURE_TEXELS = 512
"""Along one side of a face's maps."""
WIDTHS_PX = {"small": 320, "full": 1300}
LIGHT_COUNTS = {"small": 48, "full": None}
VIEW_COUNTS = {"small": 6, "full": None}
TEST_SITES = ("forehead", "nose bridge", "cheek left", "cheek right", "chin")
"""Where the truth keeps pictures of the reflection."""
MIN_FRONT_COSINE = -0.3
"""Cosine from +z beyond which a light stands too far behind the face to be chosen among few."""
SCAN_FILE = "scan.ply"
TRUE_MESH_FILE = "mesh.ply"
BLEND_SHAPES_FILE = "expressions.npz"
"""The face at rest with the movement of each expression, see `rigsim.geometry.mesh.load_mesh`."""
SCAN_TRIANGLES = {"small": 12_000, "full": 40_000}
TRACKING_EVERY = 24


def simulate_dome(order: DomeOrder) -> SimulationResult:
    """Simulate a capture with the dome; see `simulation.simulate`."""
    one_of("state", order.state, STATE_NAMES, SimulationError)
    conditions = _conditions(order)
    rig = _rig(order)
    planned = order.plan if order.target is None else None
    plan = planned or _plan(rig, order.target, order.size)
    light = driving.announce_light(plan, rig, order)
    asked = _manifest_settings(order, rig, conditions)
    scene = _scene(rig, order, plan)
    session = driving.open_session(order, plan, rig, asked, scene)
    with driving.release_on_error(session):
        scan = _attach_scan(session, scene, order) if order.target is None else {}

    def prompt(world: Any, text: str) -> None:
        # "pose 3" and "sphere 1": the operator puts the target there
        scene.set_pose(int(text.rpartition(" ")[2]))

    # nobody sits in front of a target; a face is asked to close its eyes where that is needed
    safe = order.target is not None or light["open_eyes"] != "allowed"
    rig_seconds = driving.drive_plan(
        order, session, rig, scene, prompt, eyes="closed" if safe else "open"
    )
    truth = None
    if order.target is None:
        truth = truth_folder(order.out)
        appearance = scene.truth_appearance()
        parameters = appearance.parameters | scan | {"landmarks_mm": _landmarks(scene.subject)}
        driving.write_truth(
            truth,
            order,
            session,
            dataclasses.replace(appearance, parameters=parameters),
            files=_truth_files(scene, appearance, order.seed),
            **select_attributes(order, "state", "movement"),
            **select_attributes(scene, "subsurface", "interreflections"),
        )
    return driving.build_result(order, session, scene, rig_seconds, truth, light=light)


def _manifest_settings(
    order: DomeOrder, rig: Rig, conditions: Mapping[str, float]
) -> dict[str, Any]:
    """Return the settings of a simulation as its session's manifest keeps them."""
    asked: dict[str, Any] = {
        "width_px": rig.views[0].width_px,
        "mesh": str(order.mesh or ""),
        "lights": len(rig.lights),
        "views": len(rig.views),
        "plan": "" if order.plan is None else order.plan.to_json(),
        **select_attributes(order, "move", "state", "movement", "wrapped"),
    }
    if order.target is None:
        asked |= select_attributes(order, "subsurface", "interreflections")
    if conditions:
        asked["conditions"] = conditions
    return driving.manifest_settings(order, **asked)


def _conditions(order: DomeOrder) -> dict[str, float]:
    """Return the conditions of the face, checked."""
    try:
        return validate_conditions(order.conditions)
    except ConditionError as error:
        raise SimulationError(str(error)) from error


def _member(order: DomeOrder) -> Member | None:
    """Return the member of the simulated population that is asked for; None: a preset is."""
    if order.target is not None or not re.fullmatch(r"P\d+", order.subject):
        return None
    if order.mesh is not None:
        raise SimulationOptionsError(f"mesh: {order.subject} has a head already; leave it out")
    try:
        return get_member(order.subject)
    except PopulationError as error:
        raise SimulationError(f"subject: {error}") from error


def _truth_files(scene: Any, truth: SkinAppearance, seed: int) -> dict[str, bytes]:
    """Return the true mesh, its expressions, and how it reflects where no light is."""
    mesh, landmarks = scene.subject.mesh, scene.subject.landmarks_mm()
    return {
        TRUE_MESH_FILE: encode_binary_ply(mesh.vertices_mm, mesh.faces),
        BLEND_SHAPES_FILE: _blend_shapes(scene.subject),
        TEST_FILE: make_test(
            scene,
            truth,
            rng=np.random.default_rng([seed, 8]),
            sites={name: landmarks[name] for name in TEST_SITES},
        ),
    }


def _landmarks(subject: Any) -> dict[str, list[float]]:
    """Return named points of the skin, x, y, z in mm, rig frame."""
    points = subject.surface_landmarks()
    return dict(zip(points.names, points.on(subject.mesh).round(4).tolist(), strict=True))


def _blend_shapes(subject: Any) -> bytes:
    """Return the face at rest and how each expression moves it, as the bytes of an .npz."""
    rest = subject.mesh if subject.rest is None else subject.rest.mesh
    shapes = subject.blend_shapes()
    out = io.BytesIO()
    np.savez_compressed(
        out,
        vertices_mm=rest.vertices_mm,
        faces=rest.faces,
        uv=rest.uv,
        shape_names=np.array(list(shapes)),
        shape_deltas_mm=np.array(list(shapes.values()), np.float16),
    )
    return out.getvalue()


def small_dome(
    rig: Rig, *, lights: int | None = None, views: int | None = None, width_px: int | None = None
) -> Rig:
    """Return a dome with fewer lights, cameras and pixels, those kept spread evenly.

    Parameters
    ----------
    rig : Rig
    lights, views : int, optional
        How many to keep, 1 to all; all by default.
    width_px : int, optional
        Pixels across each camera.

    Raises
    ------
    SimulationError
        For a number that the rig cannot give.

    Examples
    --------
    >>> small = small_dome(load_rig("dome"), lights=12, views=3, width_px=130)
    >>> len(small.lights), len(small.views), small.views[0].height_px
    (12, 3, 104)
    """
    kept: dict[str, list[str] | None] = {"lights": None, "views": None}
    for field, count in (("lights", lights), ("views", views)):
        rows = getattr(rig, field)
        if count is None:
            continue
        if not 1 <= count <= len(rows):
            raise SimulationError(f"{field}: got {count}, expected 1 to {len(rows)}")
        places = np.array([row.position_mm for row in rows])
        # few lights stand where they reach a face; many stand all around
        use = np.flatnonzero(places[:, 2] >= MIN_FRONT_COSINE * np.linalg.norm(places, axis=1))
        use = use if len(use) >= count else np.arange(len(rows))
        kept[field] = [rows[use[k]].name for k in farthest_point_sample(places[use], count)]
    rig = rig.subset(lights=kept["lights"], views=kept["views"])
    return rig if width_px in (None, rig.views[0].width_px) else rig.resized(int(width_px or 0))


def farthest_point_sample(directions: np.ndarray[Any, Any], count: int) -> list[int]:
    """Return the numbers of ``count`` directions, each next one the farthest from those before.

    Parameters
    ----------
    directions : ndarray
        (N, 3), any length; the first chosen is the one most towards +z.
    count : int
        1 to N.

    Examples
    --------
    >>> farthest_point_sample(np.array([[1.0, 0, 0], [0, 0, 1], [-1, 0, 0], [0.9, 0, 0.1]]), 3)
    [1, 0, 2]
    """
    way = directions / np.linalg.norm(directions, axis=1)[:, None]
    chosen = [int(np.argmax(way[:, 2]))]
    while len(chosen) < count:
        nearest = (way @ way[chosen].T).max(axis=1)
        nearest[chosen] = np.inf
        chosen.append(int(np.argmin(nearest)))
    return chosen


def _rig(order: DomeOrder) -> Rig:
    """Return the dome with the lights, cameras and pixels of an order."""
    width_px = order.width_px or WIDTHS_PX[order.size]
    dome = load_rig("dome")
    if order.plan is None:
        lights, views = LIGHT_COUNTS[order.size], VIEW_COUNTS[order.size]
        return small_dome(
            dome, lights=order.lights or lights, views=order.views or views, width_px=width_px
        )
    lit = {name for step in order.plan.steps for name in step_lights(step)}
    seen = {name for step in order.plan.steps for name in step.cameras}
    return dome.subset(
        lights=[x.name for x in dome.lights if x.name in lit],
        views=[v.name for v in dome.views if v.name in seen],
    ).resized(width_px)


def _plan(rig: Rig, target: str | None, size: str) -> Plan:
    if target is None:
        return dome_plan(rig, tracking_interval=TRACKING_EVERY)
    few = {"charuco": 10, "mirror": 3, "white": 3} if size == "small" else TARGET_POSES
    return dome_calibration_plan(
        rig,
        cast(DomeTarget, target),
        poses=few["charuco"],
        spheres=few["mirror"],
        plates=few["white"],
        plate_normals=plate_normals(),
    )


def _scene(rig: Rig, order: DomeOrder, plan: Plan) -> Any:
    built = build_dome(rig, seed=order.seed)
    if order.target == "dark":
        return DomeScene(rig, make_target("dark"), dome=built, seed=order.seed)
    if order.target is not None:
        return make_target_scene(order.target, rig, seed=order.seed, dome=built)  # type: ignore[arg-type]
    conditions = dict(order.conditions)
    if (one := _member(order)) is not None:
        person = one.face(TEXTURE_TEXELS)
        conditions = dict(one.applied) | conditions
    else:
        subject = subject_file.load_subject(order.subject)
        person = subject.face(seed=order.seed, size=TEXTURE_TEXELS, mesh=order.mesh)
    motion = draw_head_motion(order.seed) if order.move else None
    return DomeScene(
        rig,
        person,
        dome=built,
        motion=motion,
        state=order.state,
        movement=order.movement,
        seed=order.seed,
        conditions=conditions,
        on_s=max_on_time_s(plan),
        effects=SceneEffects.from_switches(_skin_light_effects(order)),
    )


def _skin_light_effects(order: DomeOrder) -> dict[str, Any]:
    """Return what of a face is built though it shows in no pixel, and what is not though it does.

    What changes pixels is built where nothing is asked for.
    """
    asked: dict[str, bool | None] = {
        "subsurface": order.subsurface or None,
        "interreflections": order.interreflections or None,
    }
    without = order.scene_switches()
    for name in without:
        if asked.get(name):
            raise SimulationOptionsError(f"leave_out: {name} was asked for, too")
    return {**asked, **without}


def _attach_scan(session: Any, scene: Any, order: DomeOrder) -> dict[str, Any]:
    """Scan the face into the session; return what the truth keeps of it."""
    scanner = ScannerSettings(triangles=SCAN_TRIANGLES[order.size])
    mesh = scene.subject.mesh
    if order.wrapped:
        rng = np.random.default_rng([order.seed, 7, STATE_NAMES.index(order.state)])
        scan = wrap_template(mesh, rng=rng, scanner=scanner)
    else:
        scan = scan_face(mesh, rng=np.random.default_rng([order.seed, 7]), scanner=scanner)
    if SCAN_FILE not in session.attachments():
        kind = "template wrapped onto a scan" if order.wrapped else "scanned mesh"
        session.attach(SCAN_FILE, scan.ply, about={"kind": kind, "unit": "mm"})
    return {"scan_to_dome": scan.to_dome.tolist()}
