"""Domes that are simulated small, and their targets through the real drivers."""

import dataclasses
import itertools
import math
import shutil
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from capture.plan import Plan, Step
from capture.rig import load_rig
from capture.session import Session, verify
from skinrig.capturing.light_safety import light_figures, light_lines
from skinrig.cli import main
from skinrig.errors import UnusableError
from skinrig.resources import forecast
from skinrig.resources.free_memory import FreeMemory
from skinrig.simulating import dome, driving
from skinrig.simulating.dome import farthest_point_sample, small_dome
from skinrig.simulating.orders import DomeOrder, SimulationError
from skinrig.simulating.simulation import simulate_session

DOME = load_rig("dome")
SMALL_POSES = 10


def test_reduced_dome_lights_are_evenly_distributed():
    places = np.array([light.position_mm for light in DOME.lights])
    way = places / np.linalg.norm(places, axis=1)[:, None]
    chosen = farthest_point_sample(places, 24)
    assert len(set(chosen)) == 24
    cosines = way[chosen] @ way[chosen].T
    np.fill_diagonal(cosines, -1.0)
    gap_deg = np.degrees(np.arccos(cosines.max(axis=1)))
    assert gap_deg.min() > 25.0
    first = np.degrees(np.arccos(np.sort((way[:24] @ way[:24].T)[0])[-2]))
    assert first < 20.0  # the first 24 as they come lie together: the test can fail


@pytest.mark.long
def test_simulating_a_dome_loads_nothing_that_only_evaluates():
    code = (
        "import sys, skinrig.simulating.dome\n"
        "assert not {'sklearn', 'reconstruction'} & set(sys.modules)\n"
        "import skinrig.evaluating.reflection\n"
        "assert 'reconstruction' in sys.modules, 'what evaluates loads it: this test can fail'"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def test_small_dome_keeps_names_and_fields_of_view():
    small = small_dome(DOME, lights=12, views=3, width_px=130)
    assert {light.name for light in small.lights} <= {light.name for light in DOME.lights}
    for view in small.views:
        assert view.field_mm[0] == pytest.approx(DOME.view(view.name).field_mm[0], rel=1e-6)
    assert small_dome(DOME) == DOME


@pytest.mark.parametrize(("field", "count"), [("lights", 0), ("lights", 151), ("views", 17)])
def test_more_than_the_dome_has_is_refused(field, count):
    with pytest.raises(SimulationError, match=field):
        small_dome(DOME, **{field: count})


def test_a_targets_session_is_complete_and_sound(tmp_path):
    done = simulate_session(
        "dome", tmp_path / "session-charuco", target="charuco", lights=8, views=2, width_px=64
    )
    session = Session.open(done.session)
    assert session.closed
    poses = {record.index["pose"] for record in session.frames("charuco")}
    assert poses == set(range(SMALL_POSES))
    assert verify(done.session).ok
    assert done.truth is None
    # the board moved between the poses: pictures of a camera differ by more than noise
    name = session.rig.views[0].name
    pictures = [
        session.read(record).cfa.astype(int)
        for record in session.frames("charuco")
        if record.camera == name
    ]
    darks = [session.read(record).cfa.astype(int) for record in session.frames("dark")]
    noise = np.abs(darks[0] - darks[1]).mean()
    changes = [np.abs(after - before).mean() for before, after in itertools.pairwise(pictures)]
    assert min(changes) > 2.0 * noise


def test_simulation_resumes_only_with_same_settings(tmp_path):
    class Enough(Exception):
        pass

    def stop(line):
        if "rows of 2 cameras kept" in line:
            raise Enough

    asked = {"target": "charuco", "lights": 8, "views": 2, "width_px": 64}
    with pytest.raises(Enough):
        simulate_session("dome", tmp_path / "s", **asked, progress=stop)
    assert Session.open(tmp_path / "s").pending_frames()
    with pytest.raises(SimulationError, match="same settings"):
        simulate_session("dome", tmp_path / "s", **{**asked, "lights": 9}, resume=True)
    done = simulate_session("dome", tmp_path / "s", **asked, resume=True)
    assert done.frames == 2 * (2 + SMALL_POSES)


@pytest.mark.parametrize(
    ("more", "match"),
    [
        ({"target": "chart"}, "charuco, mirror, white, dark"),
        ({"states": ("anger", "fear")}, "states: got anger, fear"),
        ({"states": ("angry",)}, "state: got 'angry'"),
        ({"states": ("anger",), "target": "mirror"}, "a target has none"),
        ({"repeats": 2}, "repeats"),
        ({"size": "huge"}, "size"),
        ({"seed": -1}, "seed"),
    ],
)
def test_unsupported_dome_options_are_refused_before_folder_creation(tmp_path, more, match):
    with pytest.raises(SimulationError, match=match):
        simulate_session("dome", tmp_path / "s", **more)
    assert not (tmp_path / "s").exists()


def test_flash_rig_refuses_choice_of_lights(tmp_path):
    with pytest.raises(SimulationError, match="lights: not an option of the flash rig"):
        simulate_session("flash", tmp_path / "s", lights=12)


def test_flicker_and_dose_are_reported_before_capture(tmp_path, capsys):
    assert main(["capture", "dome", "--dry-run"]) == 0
    said = capsys.readouterr()
    text = said.out + said.err
    assert "flicker at the eyes: 1.0 flashes in the worst second" in text
    assert "light dose: at most 0.439 Ws from one LED" in text
    lines = []
    simulate_session(
        "dome", tmp_path / "s", target="dark", lights=8, views=1, width_px=32, progress=lines.append
    )
    assert lines[0].startswith("flicker at the eyes: 0.0 flashes")
    assert lines[1].startswith("light dose: at most 0 Ws")


def test_plan_requiring_closed_eyes_is_reported():
    from capture.plan.dome import dome_plan

    plan = dome_plan(DOME, order=list(range(150)), tracking_interval=0)
    assert light_figures(plan, DOME)["open_eyes"] == "refused"
    assert "must be closed or shielded" in light_lines(plan, DOME)[0]


def test_invalid_eye_options_are_refused(capsys):
    assert main(["capture", "dome", "--dry-run", "--eyes", "shut"]) == 3
    assert "open, closed, shielded" in capsys.readouterr().err


@pytest.mark.render
@pytest.mark.long
@pytest.mark.timeout(300)
def test_face_session_contains_scan_and_separate_truth(tmp_path):
    from model import store

    done = simulate_session(
        "dome",
        tmp_path / "session-face",
        lights=12,
        views=2,
        width_px=64,
        seed=1,
        leave_out=("subsurface", "interreflections"),
    )
    session = Session.open(done.session)
    assert session.attachments() == ("scan.ply",)
    assert session.attachment("scan.ply").startswith(b"ply")
    truth = store.read(done.truth)
    assert truth.inputs["session"] == session.content_hash
    assert {"normals", "r_d", "position"} <= set(truth.maps)
    assert np.shape(truth.parameters["scan_to_dome"]) == (4, 4)
    places = truth.maps["position"].values.reshape(-1, 3)
    for name, point in truth.parameters["landmarks_mm"].items():
        assert np.linalg.norm(places - point, axis=1).min() < 3.0, name
    assert len(truth.parameters["landmarks_mm"]) >= 20
    assert len(session.frames("olat")) == 2 * 2 * 12
    bright = session.read(session.frames("olat", exposure=0)[0]).cfa
    dark = session.read(session.frames("dark", exposure=0)[0]).cfa
    assert bright.mean() > dark.mean()


def test_scene_expects_lights_of_each_steps_cameras(monkeypatch, tmp_path):
    """One camera per light, and one step of two lights; images exceed the memory's cache."""
    rig = small_dome(DOME, lights=3, views=2, width_px=1300)
    (a, b, c), (left, right) = (tuple(one.name for one in rows) for rows in (rig.lights, rig.views))
    steps = (
        Step("D", "dark", {}, {}, (left, right)),
        Step("O1", "olat", {}, {"light": c}, (left,)),
        Step("O2", "olat", {}, {"light": a}, (right,)),
        Step("T", "tracking", {}, {"leds": f"{b}+{c}"}, (left, right)),
    )
    expected, files = [], []
    images = SimpleNamespace(render_ahead=lambda *given: files.append(given))
    scene = SimpleNamespace(expect_requests=expected.extend, images=images)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10**10))
    order = DomeOrder(out=tmp_path)
    dome._expect_images(scene, order, rig, Plan("dome", steps))
    twice = [(left, 1), (left, 2), (right, 1), (right, 2)]
    assert expected == [(left, 2), (right, 0), *twice]
    assert len(files) == 1
    folder, most_bytes = files[0]
    sizes = {view.name: view.width_px * view.height_px for view in rig.views}
    assert folder == tmp_path.parent
    assert most_bytes == pytest.approx(4 * (2 * sizes[left] + 3 * sizes[right]), abs=1)


def test_images_ahead_are_forecast_without_being_required(monkeypatch, tmp_path):
    """At full size, images of 150 lights take 13 GB until the end."""
    enough = FreeMemory(math.inf, "machine", math.inf)
    monkeypatch.setattr(forecast, "read_free_memory", lambda: enough)
    space, lines = [10**12], []
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=space[0]))
    order = DomeOrder(out=tmp_path / "s", progress=lines.append)
    rig, plan = dome.plan_capture(dataclasses.replace(order, size="full"))
    image_mb = 1e-6 * dome.count_image_bytes(order, rig, plan)
    assert image_mb == pytest.approx(16 * 150 * 1.339 * 4, rel=1e-3)
    session_mb = driving.forecast_rest(order, rig, plan, image_mb).disk_mb
    for left_mb, text in [
        (2.0 * image_mb + 1.0, "13 GB of temporary images until the end"),
        (8000.0, "13 GB of temporary images until the end; 4 GB of these fit, other images are"),
        (1000.0, "; 0.5 GB of these fit, other images are rendered more than once"),
    ]:
        space[0] = int(1e6 * (session_mb + left_mb)) + 1
        driving.require_room(order, rig, plan, image_mb)
        assert text in lines[-1]
        assert lines[-1].endswith("until the end") == (left_mb > 2.0 * image_mb)
        need = driving.forecast_rest(order, rig, plan, image_mb)
        room_mb = forecast.temporary_room_mb(need, order.out)
        assert room_mb == pytest.approx(min(image_mb, left_mb / 2.0), abs=1e-3)
    space[0] = int(1e6 * session_mb) - 1
    with pytest.raises(UnusableError, match="SR-CLI-017"):
        driving.require_room(order, rig, plan, image_mb)


@pytest.mark.parametrize("change", [{"target": "white"}, {"move": True}, {"size": "small"}])
def test_images_that_memory_keeps_take_no_disk(change, tmp_path):
    order = DomeOrder(out=tmp_path, **{"size": "full"} | change)
    assert dome.count_image_bytes(order, *dome.plan_capture(order)) == 0
