"""Scenes for Mitsuba: what is written, and sessions that have no known skin."""

import io
import json
import shutil
from datetime import UTC, date, datetime
from xml.etree import ElementTree

import numpy as np
import OpenEXR
import pytest
import trimesh

from capture.plan.dome import dome_plan
from capture.rig import load_rig
from capture.session import Session, SubjectRecord
from model import store
from model.skin import SkinAppearance, SkinMap
from rigsim.as_built.dome import build_dome
from rigsim.as_built.polarizers import draw_polarizers
from rigsim.as_built.sphere import build_sphere
from rigsim.geometry.atlas import unwrap
from rigsim.mitsuba.led_array import FILM_COLUMNS, LED_COLUMNS
from rigsim.mitsuba.rig_camera import DISTORTION_NAMES
from rigsim.scanner.flaws import encode_binary_ply
from skinrig.exporting import export as exporting
from skinrig.exporting.mitsuba import dome as dome_scene
from skinrig.exporting.mitsuba import flash as flash_scene
from skinrig.exporting.mitsuba import gradient as gradient_scene
from skinrig.exporting.mitsuba import lights, skin
from skinrig.exporting.mitsuba.cameras import describe_rig_camera
from skinrig.exporting.options import ExportError
from skinrig.simulating.dome import small_dome

NOW = datetime(2026, 1, 1, tzinfo=UTC)
SIDE = 64


def make_session(path, *, rig="dome", source="simulated", effects=()):
    drawn = load_rig(rig)
    drawn = small_dome(drawn, lights=2, views=2, width_px=32) if rig == "dome" else drawn
    session = Session.create(
        path,
        plan=dome_plan(drawn) if rig == "dome" else _default_plan(drawn),
        rig=drawn,
        devices={},
        subject=SubjectRecord("simulated-III-0", ("research",)),
        source=source,
        seed=4 if source == "simulated" else None,
        extra={"effects": list(effects)},
        now=lambda: NOW,
    )
    session.release()
    return Session.open(path)


def _default_plan(rig):
    from skinrig.capturing.plan_choice import DefaultPlan

    return DefaultPlan(target=None).of(rig)


def make_truth(patch, **maps):
    mesh = patch.mesh()
    atlas = unwrap(mesh, SIDE)
    ones = np.ones((SIDE, SIDE), np.float32)
    ramp = np.linspace(0.0, 1.0, SIDE, dtype=np.float32) * ones
    values = {
        "r_d": np.stack([0.5 + 0.2 * ramp, 0.3 * ones, 0.2 + 0.1 * ramp.T], -1),
        "roughness": 0.3 * ones,
        "oil": 0.2 * ramp,
        "fuzz": 0.001 * ones,
        "hair": (ramp > 0.9).astype(np.float32),
        "normals": patch.bumpy(atlas.normal),
        **maps,
    }
    files = {"mesh.ply": encode_binary_ply(mesh.vertices_mm, mesh.faces, mesh.uv)}
    valid = atlas.covered & (values["hair"] < 0.5)
    kept = {name: SkinMap(layer, "1", valid=valid) for name, layer in values.items()}
    return SkinAppearance(kept, "simulated", files=files, seed=4)


@pytest.fixture
def session(patch, tmp_path):
    lateral = {"name": "lateral scattering in skin", "verdict": "built"}
    shadows = {"name": "shadows", "verdict": "built"}
    negligible = {"name": "bounces beyond the sum", "verdict": "negligible"}
    made = make_session(tmp_path / "session-a", effects=(lateral, shadows, negligible))
    truth = make_truth(patch)
    inputs = {"session": made.content_hash}
    store.write(tmp_path / "truth-a", SkinAppearance(**_fields(truth) | {"inputs": inputs}))
    return made


def _fields(appearance):
    names = ("maps", "source", "parameters", "files", "seed")
    return {name: getattr(appearance, name) for name in names}


def export(session, out):
    return exporting.export(
        session.path, out, "mitsuba", use="research", today=date(2026, 1, 1), now=NOW
    )


def read_map(folder, name):
    with OpenEXR.File(str(folder / "textures" / f"{name}.exr")) as file:
        ((_, channel),) = file.channels().items()
        return np.array(channel.pixels)


def test_maps_of_the_truth_are_unchanged_on_skin(session, patch, tmp_path):
    export(session, tmp_path / "out")
    truth = make_truth(patch)
    on = unwrap(patch.mesh(), SIDE).covered
    for name in ("r_d", "roughness", "oil", "fuzz", "normals"):
        found = read_map(tmp_path / "out", name)
        np.testing.assert_array_equal(found[on], truth.maps[name].values[on])
        assert np.isfinite(found).all()
    bare = read_map(tmp_path / "out", "bare")
    np.testing.assert_array_equal(bare[on], 1.0 - truth.maps["hair"].values[on])


def test_mesh_survives_with_normals_and_coordinates(session, patch, tmp_path):
    export(session, tmp_path / "out")
    data = (tmp_path / "out" / "face.ply").read_bytes()
    found = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
    mesh = patch.mesh()
    np.testing.assert_array_equal(found.vertices, mesh.vertices_mm)
    np.testing.assert_array_equal(found.faces, mesh.faces)
    rows = np.frombuffer(data[data.index(b"end_header\n") + 11 :], "<f4", 8 * len(mesh.uv))
    rows = rows.reshape(-1, 8)
    np.testing.assert_allclose(rows[:, 3:6], mesh.normals, atol=1e-6)
    np.testing.assert_allclose(rows[:, 6:], mesh.uv, atol=1e-6)


def test_scene_has_every_light_and_camera_as_built(session, tmp_path):
    export(session, tmp_path / "out")
    dome = build_dome(session.rig, seed=4)
    scene = ElementTree.parse(tmp_path / "out" / "scene-stock.xml").getroot()
    views = [one.get("id") for one in scene.findall("sensor")]
    assert views == [view.name for view in session.rig.views]
    every = ElementTree.parse(tmp_path / "out" / "lights-stock" / "all.xml").getroot()
    for emitter, light, axis in zip(every, dome.rig.lights, dome.axis, strict=True):
        pose = emitter.find("transform/lookat")
        origin, target = (
            np.array([float(x) for x in pose.get(end).split(",")]) for end in ("origin", "target")
        )
        np.testing.assert_allclose(origin, light.position_mm, atol=1e-5)
        np.testing.assert_allclose(target - origin, axis, atol=1e-5)
    document = json.loads((tmp_path / "out" / "mitsuba.json").read_text())
    assert [row[0] for row in document["left_out"]] == ["lateral scattering in skin"]
    assert [one["gain"] for one in document["views"]] == [dome.gain[name] for name in views]


def test_tables_of_lights_are_those_of_the_plugin(session, tmp_path):
    export(session, tmp_path / "out")
    dome = build_dome(session.rig, seed=4)
    every = np.loadtxt(tmp_path / "out" / "lights" / "all.csv", delimiter=",", skiprows=1)
    assert every.shape == (len(dome.rig.lights), len(LED_COLUMNS))
    np.testing.assert_allclose(every[:, 3:6], dome.axis, atol=1e-6)
    for light, row in zip(dome.rig.lights, every, strict=True):
        one = np.loadtxt(
            tmp_path / "out" / "lights" / f"{light.name}.csv", delimiter=",", skiprows=1
        )
        np.testing.assert_array_equal(one, row)
        np.testing.assert_allclose(row[:3], light.position_mm, rtol=1e-6)


def test_only_coated_skin_has_a_film(session, patch, tmp_path):
    export(session, tmp_path / "out")
    scene = ElementTree.parse(tmp_path / "out" / "scene.xml").getroot()
    bare = {one.get("name") for one in scene.findall("bsdf/*")} - {"distribution"}
    assert bare == {"r_d", "alpha", "oil", "vellus", "bare", "normals"}
    film = {
        name: np.full((SIDE, SIDE), 0.3, np.float32) for name in skin.COATING_PROPERTIES.values()
    }
    (tmp_path / "coated").mkdir()
    maps = skin.write_skin(make_truth(patch, **film), patch.mesh(), tmp_path / "coated")
    coat = skin.describe_skin_coat(maps)
    coated = {one.get("name") for one in coat.findall("texture")}
    assert coated - bare == {"film", "film_alpha", "film_ior", "powder"}


def test_intensity_gives_white_plate_its_signal(session):
    """A Lambertian white of 1/pi that faces the light has white_intensity / d^2."""
    from rigsim.light.led_light import white_intensity

    dome = build_dome(session.rig, seed=4)
    (led, *_) = dome_scene.list_lights(dome)
    signal = led.intensity / np.pi / 700.0**2
    white = white_intensity(dome.rig.lights[0], dome.rig.views[0]) / 700.0**2
    np.testing.assert_allclose(signal, white)
    assert 5.0 < signal.max() < 20.0


def test_same_session_gives_same_bytes(session, tmp_path):
    for name in ("a", "b"):
        export(session, tmp_path / name / "out")
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.*"))
    assert len(files) > 12
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_rotated_normals_keep_their_angle(patch):
    mesh = patch.mesh()
    atlas = unwrap(mesh, SIDE)
    normals = patch.bumpy(atlas.normal)
    turned = skin.rotate_to_triangles(atlas, mesh, normals)
    on = atlas.covered
    cosine = np.sum(normals * atlas.normal, axis=-1)
    np.testing.assert_allclose(turned[on][:, 2], cosine[on], atol=1e-5)
    assert turned[on][:, 2].min() < 0.95


def test_measured_session_has_no_scene(tmp_path):
    session = make_session(tmp_path / "session-m", source="measured")
    with pytest.raises(ExportError, match="is measured, expected a simulated session"):
        export(session, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_session_of_other_rig_has_no_scene(tmp_path):
    session = make_session(tmp_path / "session-p", rig="probe")
    with pytest.raises(ExportError, match="got the rig probe, expected one of dome, flash"):
        export(session, tmp_path / "out")


def test_flashes_light_the_white_reference_as_metered():
    """A white that faces the camera, behind two polarizers, has the signal of the reference."""
    rig = load_rig("flash")
    films, white = draw_polarizers(rig), np.array([0.4, 0.8, 0.5])
    signal = np.zeros(3)
    for light in flash_scene.list_lights(rig, films, white):
        place = np.asarray(light.position_mm)
        cosine = place @ np.array(rig.views[0].axes[2]) / np.linalg.norm(place)
        signal += 0.25 / np.pi * light.intensity * cosine / (place @ place)
        assert light.leak == pytest.approx(1.0 / films.light_extinction)
        assert abs(light.absorbs @ light.axis) < 1e-9
    np.testing.assert_allclose(signal, white, rtol=1e-6)


def test_opposite_patterns_sum_to_the_full_one():
    rig = load_rig("gradient")
    sphere = build_sphere(rig, seed=2)
    leds = gradient_scene.list_lights(sphere, draw_polarizers(rig), 3.0)
    levels = gradient_scene.list_patterns(sphere)
    np.testing.assert_allclose(levels["x"] + levels["-x"], levels["full"])
    assert len(leds) == len(levels["full"]) < len(rig.lights)
    assert min(led.position_mm[2] for led in leds) > 0.0
    assert min(level.min() for level in levels.values()) >= 0.0
    assert np.ptp(levels["z"]) > 0.3


def test_stock_flash_scene_lacks_crossed_specular(patch, tmp_path):
    """Materials of both analyzer stops, with levels and polarizers of the lights."""
    rig = load_rig("flash")
    flashes = flash_scene.list_lights(rig, draw_polarizers(rig), np.ones(3))
    levels = lights.single_lights(flashes)
    lights.write_light_tables(flashes, levels, tmp_path)
    lights.write_stock_lights(flashes, levels, tmp_path)
    table = np.loadtxt(tmp_path / "lights" / "all.csv", delimiter=",", skiprows=1)
    assert table.shape == (len(flashes), len(LED_COLUMNS) + len(FILM_COLUMNS))
    spot = ElementTree.parse(tmp_path / "lights-stock" / "all.xml").getroot()[0]
    value = float(spot.find("rgb").get("value").split(",")[0])
    assert value == pytest.approx(0.25 * flashes[0].intensity[0], rel=1e-6)
    kinds = [
        {one.get("type") for one in skin.describe_polarized_skin(name, True).iter("bsdf")}
        for name in ("parallel", "crossed")
    ]
    assert kinds[0] ^ kinds[1] == {"roughconductor", "diffuse"}


def test_camera_has_the_distortion_of_its_lens():
    bent = (-0.12, 0.05, 1e-3, -2e-3, 0.01)
    camera = describe_rig_camera(load_rig("dome").views[0], bent)
    found = {one.get("name"): one.get("value") for one in camera.findall("float")}
    assert [float(found[name]) for name in DISTORTION_NAMES] == list(bent)
    assert float(found["focal_px"]) == pytest.approx(load_rig("dome").views[0].focal_px)


@pytest.mark.parametrize("rig", ["flash", "gradient"])
def test_truth_without_surface_has_no_scene(patch, tmp_path, rig):
    made = make_session(tmp_path / "session-a", rig=rig)
    truth = _fields(make_truth(patch)) | {"inputs": {"session": made.content_hash}}
    store.write(tmp_path / "truth-a", SkinAppearance(**truth))
    with pytest.raises(ExportError, match=r"no surface\.npz.*SR-EXP-010"):
        export(made, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_session_without_its_truth_has_no_scene(session, tmp_path):
    other = make_session(tmp_path / "session-b", effects=({"name": "a", "verdict": "absent"},))
    with pytest.raises(ExportError, match=r"truth-b: not found, expected the ground truth"):
        export(other, tmp_path / "out")
    shutil.copytree(tmp_path / "truth-a", tmp_path / "truth-b")
    with pytest.raises(ExportError, match="ground truth of another session"):
        export(other, tmp_path / "out")
