"""Every buffer of the core, read back as floats, against the Python model of the same equation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fixtures.packed_scenes import as_packed
from twins import facial_specular, screen_scattering, tone_mapping

from model import color_table, spectra
from model.facial_color import HemoglobinRig, StateMaps
from model.facial_color.rig import GLOBAL_GAINS
from model.tissue_optics.layers import ANISOTROPY_SKIN
from skinrig.viewer import page
from skinrig.viewer.scene import Texture

pytestmark = pytest.mark.long

RIG_CELLS = 64
"""Fewer than texels, so that the page's interpolation is compared as well."""


@pytest.fixture(scope="module")
def scene(procedural_scene):
    """The procedural head with the core's own data alone: other features leave themselves out."""
    whole = procedural_scene
    states = whole.textures["facial_states"].values
    step = states.shape[1] // RIG_CELLS
    few = Texture(np.ascontiguousarray(states[:, ::step, ::step]))
    kept = {name: whole.textures[name] for name in ("chromophores", "surface_maps")}
    return as_packed(
        replace(
            whole,
            textures={**kept, "facial_states": few},
            tables={"skin_color": whole.tables["skin_color"]},
            facts={n: whole.facts[n] for n in ("color_table", "facial_color", "scattering")},
            params={"weights": whole.params["weights"]},
            presets={},
        )
    )


@pytest.fixture(scope="module")
def face(open_page, scene):
    return open_page(page.build(scene))


@pytest.fixture
def viewer(face):
    before = face.page.evaluate("() => window.viewer.params")
    yield face
    face.set(**before)


def _rig(scene):
    """The page's textures as the model's own rig."""
    neutral = scene.textures["chromophores"].values[..., 1].astype(np.float64) ** 3
    layers = scene.textures["facial_states"].values.astype(np.float64)
    names = scene.facts["facial_color"]["states"]
    valid = np.ones(layers.shape[1:3], bool)
    zero = np.zeros(layers.shape[1:3])
    states = {
        name: StateMaps(layer[..., 0], layer[..., 1], zero, zero, zero, valid, 1.0, 0.0, 0.0)
        for name, layer in zip(names[1:], layers[1:], strict=True)
    }
    return HemoglobinRig(
        neutral=neutral,
        valid=np.ones(neutral.shape, bool),
        neutral_stderr=np.zeros(neutral.shape),
        neutral_mean=layers[0, ..., 1],
        states=states,
        radius_px=12.0,
    )


@pytest.mark.parametrize(
    "weights",
    [{}, {"smile": 1.0}, {"anger": 1.0, "surprise": 1.0}, {"fear": 0.4, "alcohol": 1.3}],
    ids=["neutral", "smile", "anger and surprise", "fear and alcohol"],
)
def test_the_page_blends_blood_as_the_model_does(viewer, scene, weights):
    rig = _rig(scene)
    viewer.set(weights={**dict.fromkeys(scene.params["weights"], 0.0), **weights})
    got = viewer.read("chromophores")[..., 1]
    wanted = rig.evaluate(
        {"neutral": 1.0 - sum(weights.values()), **weights}, gains=GLOBAL_GAINS
    ).hemoglobin
    # float32 sums; the texture unit interpolates between cells in steps of 1/256 of a cell
    assert np.abs(got - wanted).max() < 2e-3 * wanted.max()
    assert np.median(np.abs(got / wanted - 1.0)) < 2e-4
    if weights:
        assert np.abs(got - rig.neutral).max() > 0.05 * wanted.max()


def test_the_page_colors_skin_as_the_table_does(viewer):
    table = color_table.build(spectra.LINEAR_SRGB, "D65", size=128, anisotropy=ANISOTROPY_SKIN)
    found = viewer.read("chromophores").astype(np.float64)
    color = viewer.read("color")[..., :3]
    wanted = table.lookup(found[..., 0], found[..., 1])
    # linear between the nodes instead of cubic
    assert np.abs(color - wanted).max() < 1e-3
    assert np.ptp(wanted[..., 0]) > 0.05


def test_page_moves_vertices_and_normals_like_simulation(viewer, scene):
    from rigsim.geometry.mesh import build_mesh
    from rigsim.subject.expressions import displace_mesh

    weights = {"anger": 0.8, "happiness": 0.5}
    viewer.set(weights=weights)
    positions, normals = viewer.mesh()
    mesh = scene.mesh
    deltas = sum(w * mesh.shapes[name] for name, w in weights.items())
    rest = build_mesh(mesh.vertices_mm, mesh.faces, mesh.uv, mesh.normals)
    wanted = displace_mesh(rest, deltas.astype(np.float32))
    assert np.abs(positions - wanted.vertices_mm).max() < 1e-4
    away = np.degrees(np.arccos(np.clip(np.sum(normals * wanted.normals, -1), -1.0, 1.0)))
    # normals are packed in 16 bits, and arccos of float32 knows 0.03 degrees
    assert away.max() < 0.1
    assert np.abs(normals - mesh.normals).max() > 0.1


def _camera(params, size):
    """Return eye, and the directions of the pixels, (H, W, 3), unit depth."""
    yaw, pitch = np.radians(params["camera_yaw_deg"]), np.radians(params["camera_pitch_deg"])
    back = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    right = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    up = np.cross(back, right)
    eye = np.array(params["camera_target_mm"]) + params["camera_distance_mm"] * back
    focal = 0.5 * size / np.tan(0.5 * np.radians(params["camera_fov_deg"]))
    at = (np.arange(size) + 0.5 - 0.5 * size) / focal
    return eye, at[None, :, None] * right - at[:, None, None] * up - back, focal


def test_page_shades_smooth_face_by_lambert_and_kelemen(viewer, scene):
    params = viewer.set(ambient=0.0, camera_yaw_deg=25.0, shadows=0)
    eye, way, _ = _camera(params, 256)
    normal = viewer.read("normal").astype(np.float64)
    depth = normal[..., 3]
    seen = depth > 0.0
    position = eye + depth[..., None] * way
    n = normal[seen][:, :3]
    azimuth, elevation = (np.radians(params[f"light_{k}_deg"]) for k in ("azimuth", "elevation"))
    light = np.array(
        [
            np.sin(azimuth) * np.cos(elevation),
            np.sin(elevation),
            np.cos(azimuth) * np.cos(elevation),
        ]
    )
    irradiance = viewer.read("irradiance")
    cosine = np.clip(n @ light, 0.0, None)
    wanted = params["light_intensity"] * cosine
    assert np.abs(irradiance[seen][:, 1] - wanted).max() < 1e-4
    np.testing.assert_allclose(irradiance[seen][:, 3], depth[seen], rtol=1e-5)
    assert np.all(irradiance[~seen] == 0.0)

    view = eye - position[seen]
    view /= np.linalg.norm(view, axis=-1, keepdims=True)
    uv = viewer.read("inspect")[seen][:, :2].astype(np.float64)
    maps = _bilinear(scene.textures["surface_maps"].values, uv)
    got = viewer.read("specular")[seen][:, 0]
    for low, high in ((0.15, 0.25), (0.25, 0.35), (0.35, 0.5)):
        here = (maps[:, 0] >= low) & (maps[:, 0] < high)
        if not here.any():
            continue
        some = [
            float(facial_specular.kelemen(a, light, b, m, f0=params["f0"]))
            for a, b, m in zip(n[here], view[here], maps[here, 0], strict=True)
        ]
        lit = np.pi * params["light_intensity"] * cosine[here] * maps[here, 1] * np.array(some)
        # half floats hold 11 bits; interpolated roughness in steps of 1/256
        assert np.abs(got[here] - lit).max() < 4e-3 * max(got.max(), 1.0)
    assert got.max() > 0.2


def _bilinear(values, uv):
    height, width, _ = values.shape
    x = np.clip(uv[:, 0] * width - 0.5, 0.0, width - 1.0)
    y = np.clip((1.0 - uv[:, 1]) * height - 0.5, 0.0, height - 1.0)
    i, j = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    f, g = (x - i)[:, None], (y - j)[:, None]
    top = values[j, i] * (1 - f) + values[j, i + 1] * f
    low = values[j + 1, i] * (1 - f) + values[j + 1, i + 1] * f
    return (top * (1 - g) + low * g).astype(np.float64)


@pytest.mark.parametrize(
    ("texturing", "distance_mm"),
    [("post", 220.0), ("pre", 220.0), ("both", 220.0), ("post", 620.0)],
)
def test_screen_space_scattering_matches_model(viewer, scene, texturing, distance_mm):
    # at 220 mm a millimeter is three pixels; at 620 mm the narrowest Gaussian is omitted
    params = viewer.set(camera_distance_mm=distance_mm, texturing=texturing, camera_yaw_deg=20.0)
    assert ("scatter_0_y" in viewer.buffers()) == (distance_mm == 220.0)
    source = viewer.read("irradiance").astype(np.float64)
    albedo = viewer.read("albedo")[..., :3].astype(np.float64)
    specular = viewer.read("specular").astype(np.float64)
    before, behind = screen_scattering.ALBEDO_POWERS[texturing]
    _, _, focal = _camera(params, 256)
    profile = scene.facts["scattering"]
    spread = screen_scattering.scatter(
        source[..., :3] * albedo**before,
        source[..., 3],
        variances_mm2=profile["variances_mm2"],
        weights=profile["weights"],
        focal_px=focal,
        width=specular[..., 3],
    )
    wanted = spread * albedo**behind + specular[..., :3]
    got = viewer.read("radiance")[..., :3]
    seen = source[..., 3] > 0.0
    error = np.abs(got - wanted)[seen]
    # at most eight passes of half floats, 2^-11 each; texture coordinates in steps of 1/256 px
    assert np.percentile(error, 99.0) < 6e-3
    assert np.median(error) < 1.5e-3
    # without scattering the picture differs by far more
    plain = source[..., :3] * albedo + specular[..., :3]
    assert np.percentile(np.abs(plain - wanted)[seen], 99.0) > 0.05


@pytest.mark.parametrize("filmic", [True, False])
def test_the_display_follows_the_tone_curve(viewer, filmic):
    params = viewer.set(filmic=filmic)
    radiance = viewer.read("radiance").astype(np.float64)
    seen = radiance[..., 3] > 0.999
    exposed = params["exposure"] * radiance[seen][:, :3]
    curve = tone_mapping.filmic(exposed) if filmic else exposed
    wanted = tone_mapping.srgb_encoded(curve)
    got = viewer.read("display")[seen][:, :3]
    assert np.abs(got - wanted).max() < 0.75 / 255.0  # rounded to 8 bits


def test_change_redraws_only_affected_passes(viewer):
    viewer.set(light_azimuth_deg=10.0)
    before = viewer.draws()
    viewer.set(light_azimuth_deg=12.0)
    after = viewer.draws()
    drawn = {name for name in after if after[name] > before.get(name, 0)}
    assert {"surface", "radiance", "display"} <= drawn
    assert not drawn & {"hemoglobin_rig", "strain", "wrinkles", "surface_traits"}
    viewer.set(exposure=2.0)
    last = viewer.draws()
    assert {name for name in last if last[name] > after.get(name, 0)} == {"display"}
    viewer.set(weights={"anger": 0.5})
    final = viewer.draws()
    assert final["hemoglobin_rig"] == last["hemoglobin_rig"] + 1
