"""Simulate captures with the light dome: a face or a target, a scan, and the ground truth."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from capture.plan import Plan
from capture.plan.dome import DomeTarget, add_scan, dome_calibration_plan, dome_plan
from capture.plan.rows import step_lights
from capture.rig import Rig, load_rig
from model.skin import SkinAppearance, SkinMap
from rigsim.as_built.aging import age_dome
from rigsim.as_built.dome import build_dome
from rigsim.mitsuba.variant import choose_renderer
from rigsim.needs.effects import SceneEffects, max_on_time_s
from rigsim.population import files as subject_file
from rigsim.population.conditions import ConditionError, validate_conditions
from rigsim.population.population import PopulationError, get_member
from rigsim.scanner.flaws import encode_binary_ply
from rigsim.scanner.pods import ScannerSettings, scan_face, wrap_template
from rigsim.scenes.dome.images import IMAGE_CACHE_BYTES, SMALL_IMAGE_BYTES
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.dome.stripes import scan_board
from rigsim.scenes.dome.stripes import scan_face as scan_face_by_stripes
from rigsim.scenes.dome.targets import TARGET_POSES, make_target_scene, plate_normals
from rigsim.subject.head_motion import draw_head_motion, draw_head_position
from rigsim.subject.perfusion import STATE_NAMES
from rigsim.targets import make_target
from skinrig.console import select_attributes
from skinrig.errors import require_choice
from skinrig.evaluating.reflection_truth import TEST_FILE, make_test
from skinrig.resources.forecast import temporary_room_mb
from skinrig.simulating import driving, reference
from skinrig.simulating.orders import (
    DomeOrder,
    SimulationError,
    SimulationOptionsError,
    SimulationResult,
    truth_folder,
)
from skinrig.simulating.subject_records import FACE_TEXELS, choose_face_texels

if TYPE_CHECKING:
    from rigsim.population.population import Member

WIDTHS_PX = {"small": 320, "full": 1300}
LIGHT_COUNTS = {"small": 48, "full": None}
VIEW_COUNTS = {"small": 6, "full": None}
TEST_SITES = ("forehead", "nose bridge", "cheek left", "cheek right", "chin")
"""Landmarks whose reflection the ground truth stores as sphere images."""
MIN_FRONT_COSINE = -0.3
"""Minimum cosine between a light's direction and +z, for a subset of few lights: others are too
far behind the face."""
SCAN_FILE = "scan.ply"
TRUE_MESH_FILE = "mesh.ply"
BLEND_SHAPES_FILE = "expressions.npz"
"""Neutral face with the displacement of each expression, see `rigsim.geometry.mesh.load_mesh`."""
SCAN_TRIANGLES = {"small": 12_000, "full": 40_000}
TRACKING_EVERY = 24


def simulate_dome(order: DomeOrder) -> SimulationResult:
    """Simulate a capture with the dome; see `simulation.simulate`."""
    require_choice("state", order.state, STATE_NAMES, SimulationError)
    conditions = _conditions(order)
    reference.check_dome_order(order)
    rig, plan = plan_capture(order)
    driving.require_room(order, rig, plan, temporary_mb=1e-6 * count_image_bytes(order, rig, plan))
    light = driving.announce_light(plan, rig, order)
    settings = _manifest_settings(order, rig, conditions)
    scene = _scene(rig, order, plan)
    session = driving.open_session(order, plan, rig, settings, scene)
    with driving.release_on_error(session):
        attach = order.target is None and not order.scanner
        scan = _attach_scan(session, scene, order) if attach else {}

    def prompt(world: Any, text: str) -> None:
        # prompts such as "pose 3" and "sphere 1": the operator moves the target there
        scene.set_pose(int(text.rpartition(" ")[2]))

    # a target has no eyes; a subject closes them if the plan refuses open eyes
    closed = order.target is not None or light["open_eyes"] != "allowed"
    eyes = "closed" if closed else "open"
    with _expect_images(scene, order, rig, plan):
        rig_seconds = driving.drive_plan(order, session, rig, scene, prompt, eyes=eyes)
    truth = None
    if order.target is None:
        truth = truth_folder(order.out)
        appearance = _with_hair(scene.truth_appearance(), scene)
        landmarks = _landmarks(scene.subject)
        parameters = {**appearance.parameters, **scan, "landmarks_mm": landmarks}
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


def _expect_images(
    scene: Any, order: DomeOrder, rig: Rig, plan: Plan
) -> AbstractContextManager[None]:
    """Let a scene render lights in groups, and ahead of their requests where memory is too small.

    Images ahead are in a file until their last request. It takes up to half of the space that the
    session leaves; without that space images are rendered again.
    """
    if order.target is not None:
        return nullcontext()
    scene.expect_requests(_list_requests(rig, plan))
    if not (image_bytes := count_image_bytes(order, rig, plan)):
        return nullcontext()
    need = driving.forecast_rest(order, rig, plan, temporary_mb=1e-6 * image_bytes)
    most_bytes = int(1e6 * temporary_room_mb(need, order.out))
    images = scene.images.render_ahead(order.out.parent, most_bytes)
    return cast(AbstractContextManager[None], images)


def _list_requests(rig: Rig, plan: Plan) -> list[tuple[str, int]]:
    """Return camera and light of each image that a plan's frames are made of, in order."""
    number = {light.name: k for k, light in enumerate(rig.lights)}
    return [
        (camera, number[light])
        for step in plan.steps
        for camera in step.cameras
        for light in step_lights(step)
    ]


def count_image_bytes(order: DomeOrder, rig: Rig, plan: Plan) -> int:
    """Return the largest size of the file of images that wait for requests; 0: without a file.

    Memory keeps the images of a small dome, those of a target, and those of a head that moves.
    """
    if order.target is not None or order.move:
        return 0
    pixels = {view.name: view.width_px * view.height_px for view in rig.all_views}
    images = set(_list_requests(rig, plan))
    sizes = [np.dtype(np.float32).itemsize * pixels[camera] for camera, _ in images]
    fits = max(sizes, default=0) <= SMALL_IMAGE_BYTES and sum(sizes) <= IMAGE_CACHE_BYTES
    return 0 if fits else sum(sizes)


def _manifest_settings(
    order: DomeOrder, rig: Rig, conditions: Mapping[str, float]
) -> dict[str, Any]:
    """Return the settings of a simulation for its session's manifest."""
    settings: dict[str, Any] = {
        "width_px": rig.views[0].width_px,
        "mesh": str(order.mesh or ""),
        "lights": len(rig.lights),
        "views": len(rig.views),
        "plan": "" if order.plan is None else order.plan.to_json(),
        **select_attributes(order, "move", "state", "movement", "wrapped"),
    }
    if order.scanner:
        settings["scanner"] = True
    if order.target is None:
        if (texels := _texels(order, rig)) != FACE_TEXELS:
            settings["texels"] = texels
        settings |= select_attributes(order, "subsurface", "interreflections")
    if conditions:
        settings["conditions"] = conditions
    return driving.manifest_settings(order, **settings)


def _texels(order: DomeOrder, rig: Rig) -> int:
    return order.texels or choose_face_texels(rig.views[0].width_px)


def _conditions(order: DomeOrder) -> dict[str, float]:
    """Return the validated conditions of the face."""
    try:
        return validate_conditions(order.conditions)
    except ConditionError as error:
        raise SimulationError(str(error)) from error


def _member(order: DomeOrder) -> Member | None:
    """Return the requested member of the simulated population; None for a preset or a target."""
    if order.target is not None or not re.fullmatch(r"P\d+", order.subject):
        return None
    if order.mesh is not None:
        raise SimulationOptionsError(f"mesh: {order.subject} has its own head; remove it")
    try:
        return get_member(order.subject)
    except PopulationError as error:
        raise SimulationError(f"subject: {error}") from error


def _with_hair(truth: SkinAppearance, scene: Any) -> SkinAppearance:
    """Return the ground truth with the fraction of skin behind hair."""
    what = "fraction behind hair of brows and lashes"
    bare = scene.surface(scene.rig.views[0]).bare
    hair = SkinMap(1.0 - bare, "1", valid=scene.subject.atlas.covered, description=what)
    return dataclasses.replace(truth, maps={**truth.maps, "hair": hair})


def _truth_files(scene: Any, truth: SkinAppearance, seed: int) -> dict[str, bytes]:
    """Return the true mesh, its expressions, and the reflection in held-out directions."""
    mesh, landmarks = scene.subject.mesh, scene.subject.landmarks_mm()
    return {
        TRUE_MESH_FILE: encode_binary_ply(mesh.vertices_mm, mesh.faces, mesh.uv),
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
    return dict(zip(points.names, points.positions_on(subject.mesh).round(4).tolist(), strict=True))


def _blend_shapes(subject: Any) -> bytes:
    """Return the neutral face and each expression's displacements as the bytes of an .npz."""
    rest = subject.mesh if subject.rest is None else subject.rest.mesh
    shapes = subject.blend_shapes()
    return driving.encode_arrays(
        {
            "vertices_mm": rest.vertices_mm,
            "faces": rest.faces,
            "uv": rest.uv,
            "shape_names": np.array(list(shapes)),
            "shape_deltas_mm": np.array(list(shapes.values()), np.float16),
        }
    )


def small_dome(
    rig: Rig, *, lights: int | None = None, views: int | None = None, width_px: int | None = None
) -> Rig:
    """Return a dome with an even subset of lights and cameras, and with fewer pixels.

    Parameters
    ----------
    rig : Rig
    lights, views : int, optional
        Number to keep, 1 to all; default all.
    width_px : int, optional
        Width of each camera's image, px.

    Raises
    ------
    SimulationError
        For a number that is not in this range.

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
        positions = np.array([row.position_mm for row in rows])
        # a small subset is chosen from the lights that reach the face, a large one from all
        in_front = positions[:, 2] >= MIN_FRONT_COSINE * np.linalg.norm(positions, axis=1)
        use = np.flatnonzero(in_front)
        use = use if len(use) >= count else np.arange(len(rows))
        kept[field] = [rows[use[k]].name for k in farthest_point_sample(positions[use], count)]
    rig = rig.subset(lights=kept["lights"], views=kept["views"])
    return rig if width_px in (None, rig.views[0].width_px) else rig.resized(int(width_px or 0))


def farthest_point_sample(directions: np.ndarray[Any, Any], count: int) -> list[int]:
    """Return the indices of ``count`` directions by farthest-point sampling.

    Each next direction has the largest angle to the nearest one chosen before.

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
    unit = directions / np.linalg.norm(directions, axis=1)[:, None]
    chosen = [int(np.argmax(unit[:, 2]))]
    while len(chosen) < count:
        # the largest cosine is that of the nearest chosen direction; the minimum over all is next
        nearest = (unit @ unit[chosen].T).max(axis=1)
        nearest[chosen] = np.inf
        chosen.append(int(np.argmin(nearest)))
    return chosen


def _rig(order: DomeOrder) -> Rig:
    """Return the dome with the lights, cameras and image size of an order."""
    width_px = order.width_px or WIDTHS_PX[order.size]
    dome = load_rig("dome").at_iso(order.iso_factor)
    dome = dome.with_scanner() if order.scanner else dataclasses.replace(dome, scanner=None)
    if order.plan is None:
        lights, views = LIGHT_COUNTS[order.size], VIEW_COUNTS[order.size]
        return small_dome(
            dome, lights=order.lights or lights, views=order.views or views, width_px=width_px
        )
    lit = {name for step in order.plan.steps for name in step_lights(step)}
    used = {name for step in order.plan.steps for name in step.cameras}
    return dome.subset(
        lights=[x.name for x in dome.lights if x.name in lit],
        views=[v.name for v in dome.views if v.name in used],
    ).resized(width_px)


def plan_capture(order: DomeOrder) -> tuple[Rig, Plan]:
    """Return the dome with the lights, cameras and image size of an order, and the plan."""
    rig = _rig(order)
    planned = order.plan if order.target is None else None
    return rig, planned or add_scan(_plan(rig, order.target, order.size), rig)


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
    built = age_dome(build_dome(rig, seed=order.seed), order.rig_age, seed=order.seed)
    if order.target == "dark":
        return DomeScene(rig, make_target("dark"), dome=built, seed=order.noise_seed)
    if order.target is not None:
        seed = order.noise_seed
        target = make_target_scene(order.target, rig, seed=seed, dome=built)  # type: ignore[arg-type]
        scan_board(target, seed=order.seed, noise_seed=seed)
        return target
    conditions, texels = dict(order.conditions), _texels(order, rig)
    if (one := _member(order)) is not None:
        person = one.face(texels)
        conditions = dict(one.applied) | conditions
    else:
        subject = subject_file.load_subject(order.subject)
        if (member := subject.person()) is not None:
            conditions = dict(member.applied) | conditions
        person = subject.face(seed=order.seed, size=texels, mesh=order.mesh)
    person = person.translate(draw_head_position(order.session_seed))
    on_s = max_on_time_s(plan)
    if order.renderer == "reference":
        if conditions:
            raise SimulationError(
                f"subject: got conditions {', '.join(conditions)}, expected none for renderer "
                "reference; name another subject"
            )
        given: dict[str, Any] = select_attributes(order, "noise_seed", "size", "progress")
        voxels = reference.make_dome_scene(rig, person, dome=built, on_s=on_s, **given)
        scan_face_by_stripes(voxels, seed=order.seed, noise_seed=order.noise_seed)
        return voxels
    motion = draw_head_motion(order.noise_seed) if order.move else None
    scene = DomeScene(
        rig,
        person,
        dome=built,
        motion=motion,
        state=order.state,
        movement=order.movement,
        seed=order.noise_seed,
        conditions=conditions,
        on_s=on_s,
        effects=SceneEffects.from_switches(_skin_light_effects(order)),
        choice=choose_renderer(order.renderer),
    )
    scan_face_by_stripes(scene, seed=order.seed, noise_seed=order.noise_seed)
    return scene


def _skin_light_effects(order: DomeOrder) -> dict[str, Any]:
    """Return the requested switches of a face's light effects: True built, False omitted.

    An effect without a request, None, is built if it changes pixels.
    """
    requested: dict[str, bool | None] = {
        "subsurface": order.subsurface or None,
        "interreflections": order.interreflections or None,
    }
    without = order.scene_switches()
    for name in without:
        if requested.get(name):
            raise SimulationOptionsError(
                f"--omit (leave_out): {name} is also requested; remove one of them"
            )
    return {**requested, **without}


def _attach_scan(session: Any, scene: Any, order: DomeOrder) -> dict[str, Any]:
    """Attach a scan of the face to the session; return its true pose for the ground truth."""
    scanner = ScannerSettings(triangles=SCAN_TRIANGLES[order.size])
    mesh = scene.subject.mesh
    if order.wrapped:
        rng = np.random.default_rng([order.noise_seed, 7, STATE_NAMES.index(order.state)])
        scan = wrap_template(mesh, rng=rng, scanner=scanner)
    else:
        scan = scan_face(mesh, rng=np.random.default_rng([order.noise_seed, 7]), scanner=scanner)
    if SCAN_FILE not in session.attachments():
        kind = "template wrapped onto a scan" if order.wrapped else "scanned mesh"
        session.attach(SCAN_FILE, scan.ply, about={"kind": kind, "unit": "mm"})
    return {"scan_to_dome": scan.to_dome.tolist()}
