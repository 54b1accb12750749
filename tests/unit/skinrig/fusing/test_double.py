"""`skinrig fuse` on small drawn maps: each rig alone, both together, and refused inputs."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from typer.testing import CliRunner

from capture.rig import load_rig
from model import store
from model.skin import SkinAppearance, SkinMap
from reconstruction.pipeline.probe.stages import PROFILE_FILE
from reconstruction.surface.errors import interior_error
from skinrig.appearances import dynamic
from skinrig.applying.expression import ExpressionRequest, apply_expression
from skinrig.cli import app
from skinrig.exporting.materials.material import list_expression_omissions
from skinrig.fitting.wrinkles import fit_wrinkles
from skinrig.fusing import double
from skinrig.fusing.cost import compare_without
from skinrig.fusing.double import FusionInputs, fuse
from skinrig.fusing.sources import FusionInputError, Source, read_sources
from skinrig.fusing.texel_colors import LOG_R_D_OVER_REFLECTANCE, DomeColors

SIDE = 24
REFLECTANCE = np.array([0.36, 0.26, 0.21])
"""Color of skin of type III in the dome's channels, about."""
LIGHT = 0.77
FOCAL_PX, DISTANCE_MM = 300.0, 600.0


def positions():
    """Points of a bulged patch of 96 mm, and its normals."""
    y, x = np.meshgrid(np.linspace(48, -48, SIDE), np.linspace(-48, 48, SIDE), indexing="ij")
    z = 40.0 - (x**2 + y**2) / 160.0
    normals = np.stack([x / 80.0, y / 80.0, np.ones_like(x)], axis=-1)
    return np.stack([x, y, z], axis=-1), normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def project(points):
    """Pixels of points in the flash image of 96 x 96 pixels, its camera on the z axis."""
    scale = FOCAL_PX / (DISTANCE_MM - points[..., 2])
    return np.stack([47.5 + scale * points[..., 0], 47.5 - scale * points[..., 1]], axis=-1)


def write_dome(path, *, gain=(1.0, 1.0, 1.0), seed=0):
    rng = np.random.default_rng(seed)
    at, normals = positions()
    r_d = REFLECTANCE * np.exp(LOG_R_D_OVER_REFLECTANCE) * np.array(gain)
    r_d = r_d * np.exp(0.03 * rng.standard_normal((SIDE, SIDE, 1))) * np.ones((SIDE, SIDE, 3))
    maps = {
        "position": SkinMap(at, "mm"),
        "normals": SkinMap(normals, "1", np.full_like(normals, 0.01)),
        # noise of 3 % and the dome's error by light from inside the skin
        "r_d": SkinMap(r_d, "1", np.hypot(0.03 * r_d, interior_error(r_d))),
    }
    return store.write(path, SkinAppearance(maps, "simulated", {"kind": "appearance"}, seed=seed))


def write_flash(path, seed=1):
    rng = np.random.default_rng(seed)
    noise = 1.0 + 0.005 * rng.standard_normal((96, 96, 3))
    diffuse = LIGHT * REFLECTANCE * noise
    maps = {"diffuse": SkinMap(diffuse, "1", 0.005 * diffuse)}
    return store.write(path, SkinAppearance(maps, "simulated", {"kind": "appearance"}, seed=seed))


def write_landmarks(folder):
    """Tables of ten points on the mesh and in the image."""
    at, _ = positions()
    picks = at[::5, ::5].reshape(-1, 3)
    solid = ["name,x,y,z"] + [f"p{k},{x},{y},{z}" for k, (x, y, z) in enumerate(picks)]
    flat = ["name,x,y"] + [f"p{k},{x},{y}" for k, (x, y) in enumerate(project(picks))]
    tables = folder / "mesh.csv", folder / "image.csv"
    for path, rows in zip(tables, (solid, flat), strict=True):
        path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return tables


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuse")
    write_dome(folder / "dome")
    write_flash(folder / "flash")
    write_landmarks(folder)
    return folder


def both(folders, **more):
    paths = folders / "dome", folders / "flash"
    return FusionInputs(
        paths, landmarks=folders / "mesh.csv", image_landmarks=folders / "image.csv", **more
    )


@pytest.fixture(scope="module")
def fused(folders):
    return fuse(both(folders), out=folders / "fused")


@pytest.mark.long
def test_fuse_two_rigs_lowers_r_d_error(folders, fused):
    found = fused.appearance
    true = REFLECTANCE * np.exp(LOG_R_D_OVER_REFLECTANCE)
    good = found.maps["r_d"].mask
    assert good.mean() > 0.5
    errors = [
        np.abs(np.log(one.maps["r_d"].values[good] / true)).std()
        for one in (found, store.read(folders / "dome"))
    ]
    assert errors[0] < 0.65 * errors[1]
    assert found.parameters["fusion"]["maps"]["melanin"] == ["dome", "flash"]


@pytest.mark.long
def test_fuse_writes_common_and_own_errors(folders, fused):
    maps = store.read(folders / "fused").maps
    good = maps["melanin"].mask
    own = maps["melanin_texel_stderr"].values[good]
    assert (maps["melanin"].stderr[good] > own).all()
    assert np.isfinite(maps["melanin_blood_covariance"].values[good]).all()


def test_fuse_without_albedo_keeps_mesh(folders, fused, tmp_path):
    found = fuse(both(folders, without=("r_d",)), out=tmp_path / "double").appearance
    assert "r_d" not in found.maps
    assert found.maps["melanin"].values.shape == (SIDE, SIDE)
    rows = {row[0]: row for row in compare_without(fused.appearance, found)}
    _, full, less, change = rows["melanin"]
    assert less > full
    assert change > 0.0
    assert rows["r_d red"][2] is None


def test_fuse_without_covariance_is_less_exact(folders, fused, tmp_path):
    without = fuse(both(folders, without=("covariance",)), out=tmp_path / "double")
    maps = [one.appearance.maps["melanin"] for one in (fused, without)]
    width = [float(np.median(one.stderr[one.mask])) for one in maps]
    assert width[1] > width[0]


def test_fuse_without_only_colors_is_refused(folders, tmp_path):
    with pytest.raises(FusionInputError, match="only rig with colors"):
        fuse(FusionInputs((folders / "dome",), without=("r_d",)), out=tmp_path / "double")


def test_dome_common_gain_grows_on_dark_skin(folders):
    dome = store.read(folders / "dome")
    dark = SkinMap(0.2 * dome.maps["r_d"].values, "1", 0.1 * dome.maps["r_d"].values)
    made = [
        DomeColors.of(
            SkinAppearance({**dome.maps, "r_d": one}, "simulated"), "Nikon 5100 (NPL)", "D65"
        )
        for one in (dome.maps["r_d"], dark)
    ]
    light_sd, dark_sd = (float(np.sqrt(one.calibration[0, 1])) for one in made)
    assert 0.02 < light_sd < 0.04
    assert dark_sd > 3.0 * light_sd


def test_fuse_dome_alone_keeps_its_texture(folders, tmp_path):
    found = fuse(FusionInputs((folders / "dome",)), out=tmp_path / "double")
    assert found.appearance.maps["melanin"].values.shape == (SIDE, SIDE)
    assert found.checks == ()


def test_fuse_fills_gaps_of_normals(folders, tmp_path):
    dome = store.read(folders / "dome")
    normals = dome.maps["normals"]
    gap = np.zeros((SIDE, SIDE), bool)
    gap[11:13, 11] = True
    near = {
        "position": SkinMap(0.5 * dome.maps["position"].values, "mm"),
        "normals": SkinMap(normals.values, "1", normals.stderr, ~gap),
    }
    path = store.write(tmp_path / "dome", dataclasses.replace(dome, maps=dome.maps | near))
    found = fuse(FusionInputs((path,)), out=tmp_path / "double").appearance
    maps = store.read(tmp_path / "double").maps
    assert maps["normals"].mask.all()
    assert maps["normals"].stderr[gap].min() > 0.01
    np.testing.assert_array_equal(maps["normals_measured"].values, ~gap)
    assert found.parameters["fusion"]["maps"]["normals_measured"] == ["dome"]
    whole = fuse(FusionInputs((folders / "dome",)), out=tmp_path / "whole").appearance
    assert "normals_measured" not in whole.maps


def test_fuse_flash_alone_uses_its_image(folders, tmp_path):
    found = fuse(FusionInputs((folders / "flash",)), out=tmp_path / "double")
    assert found.appearance.maps["melanin"].values.shape == (96, 96)
    assert "r_d" not in found.appearance.maps


def test_fuse_faulty_dome_is_named(folders, fused, tmp_path):
    write_dome(tmp_path / "dome", gain=(1.3, 1.0, 0.8))
    given = both(folders)
    wrong = FusionInputs(
        (tmp_path / "dome", folders / "flash"),
        landmarks=given.landmarks,
        image_landmarks=given.image_landmarks,
    )
    assert fused.contradiction is None
    found = fuse(wrong, out=tmp_path / "double").contradiction
    assert found is not None
    assert found.startswith("dome: R_d")


def test_fuse_without_landmarks_names_the_option(folders, tmp_path):
    with pytest.raises(FusionInputError, match="--image-landmarks"):
        fuse(FusionInputs((folders / "dome", folders / "flash")), out=tmp_path / "double")
    assert not (tmp_path / "double").exists()


def test_sources_of_one_rig_twice_raise(folders):
    with pytest.raises(FusionInputError, match="second dome"):
        read_sources([folders / "dome", folders / "dome"])


def test_command_without_unknown_rig_is_refused(folders, tmp_path):
    words = ["fuse", str(folders / "dome"), "--without", "probe", "--out", str(tmp_path / "double")]
    result = CliRunner().invoke(app, words)
    assert result.exit_code != 0
    assert "--without" in str(result.exception) + result.output


def test_command_prints_one_document(folders, tmp_path):
    words = ["fuse", str(folders / "dome"), "--out", str(tmp_path / "double"), "--json"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert '"skinrig.fuse/1"' in result.output


@pytest.fixture(scope="module")
def wrinkled(folders):
    """Wrinkles fitted to the dome's neutral face and a smile whose normals wave by 0.2 rad."""
    smile = write_dome(folders / "smile")
    at, normals = positions()
    waved = normals + 0.2 * np.sin(at[..., :1] / 6.0) * np.array([1.0, 0.0, 0.0])
    waved /= np.linalg.norm(waved, axis=-1, keepdims=True)
    maps = store.read(smile).maps | {"normals": SkinMap(waved, "1", np.full_like(waved, 0.01))}
    store.write(smile, SkinAppearance(maps, "simulated", {"kind": "appearance"}, seed=0))
    moving = folders / "moving"
    states = (Path(f"neutral={folders / 'dome'}"), Path(f"smile={smile}"))
    fit_wrinkles(states, out=moving, size=SIDE, mask_size=8)
    return moving


def test_fused_wrinkles_move_like_fitted_ones(folders, wrinkled, tmp_path):
    double = tmp_path / "double"
    found = fuse(FusionInputs((folders / "dome", wrinkled)), out=double).appearance
    _, parts = dynamic.read(double, parts=(dynamic.WRINKLES,))
    assert parts[dynamic.WRINKLES]["expressions"] == ["smile"]
    for name in parts[dynamic.WRINKLES]["maps"]:
        assert found.parameters["fusion"]["maps"][name] == ["dome"]
    shown = [
        apply_expression(
            folder, ExpressionRequest({"smile": weight}), out=tmp_path / f"{folder.name}{weight}"
        ).maps
        for folder, weight in ((double, 1.0), (wrinkled, 1.0), (double, 0.0))
    ]
    normals = [maps["normals"].values for maps in shown]
    np.testing.assert_array_equal(normals[0], normals[1])
    assert np.abs(normals[0] - normals[2]).max() > 0.1  # the wave of 0.2 rad is there
    ((omitted, _),) = list_expression_omissions(found)
    assert omitted == "wrinkles of expressions"
    assert not list_expression_omissions(store.read(folders / "dome"))


def test_wrinkles_of_another_face_are_refused(folders, wrinkled, tmp_path):
    other = write_dome(tmp_path / "other", seed=9)
    with pytest.raises(FusionInputError, match="neutral face that the wrinkles were fitted to"):
        fuse(FusionInputs((other, wrinkled)), out=tmp_path / "double")


def write_gradient(path, *, turned_deg=0.0):
    """A drawn relief of 64 x 64 pixels, whose normals are turned about the camera's axis."""
    rng = np.random.default_rng(2)
    height = ndimage.gaussian_filter(rng.standard_normal((64, 64)), 4.0)
    down, right = np.gradient(height / height.std())
    angle = np.radians(turned_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    slopes = np.stack([right, -down], axis=-1) @ turn.T
    normals = np.concatenate([-slopes, np.ones((64, 64, 1))], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    maps = {
        "normals_a000_n0": SkinMap(normals, "1", np.full_like(normals, 0.02)),
        "height_a000_n0": SkinMap(20.0 * height / height.std(), "um"),
    }
    parameters = {"kind": "appearance", "pixel_um": 6.0, "states": ["a000_n0"]}
    return store.write(path, SkinAppearance(maps, "simulated", parameters, seed=2))


def test_fuse_places_gradient_patch_by_table(folders, tmp_path):
    write_gradient(tmp_path / "gradient-forehead")
    sites = tmp_path / "sites.csv"
    sites.write_text("name,x,y\nforehead,12,12\n", encoding="utf-8")
    paths = folders / "dome", tmp_path / "gradient-forehead"
    found = fuse(FusionInputs(paths, sites=sites), out=tmp_path / "double")
    maps = store.read(tmp_path / "double").maps
    at = maps["patch_position_forehead"].values.reshape(-1, 3)
    assert np.abs(at.mean(axis=0) - positions()[0][12, 12]).max() < 1e-3
    mean = maps["patch_normals_forehead"].values.reshape(-1, 3).mean(axis=0)
    # the patch's mean tilt is the face's there
    assert np.degrees(np.arccos(mean @ positions()[1][12, 12] / np.linalg.norm(mean))) < 2.0
    assert found.appearance.parameters["fusion"]["maps"]["patch_normals_forehead"] == [
        "dome",
        "gradient",
    ]
    assert "microrelief_forehead" in maps
    assert found.contradiction is None


def test_fuse_turned_gradient_normals_are_named(folders, tmp_path):
    write_gradient(tmp_path / "gradient-forehead", turned_deg=40.0)
    paths = folders / "dome", tmp_path / "gradient-forehead"
    found = fuse(FusionInputs(paths), out=tmp_path / "double").contradiction
    assert found is not None
    assert found.startswith("gradient: normals turned by 40 degrees")


def test_fuse_patch_of_unknown_site_is_left_out(folders, tmp_path):
    write_gradient(tmp_path / "gradient-elbow")
    paths = folders / "dome", tmp_path / "gradient-elbow"
    found = fuse(FusionInputs(paths), out=tmp_path / "double")
    assert "elbow" in dict(found.left_out)["gradient: normals"]
    assert "patch_normals_elbow" not in found.appearance.maps


@pytest.mark.parametrize(("scale", "stated"), [(1.0, 0), (0.5, 1)])
def test_other_probe_states_its_light_distance(tmp_path, scale, stated):
    """sigma_tr of the light is fitted to the packaged probe's distances of fibers."""
    radius_mm = [scale * r for r in load_rig("probe").probe.radius_mm]
    files = {PROFILE_FILE: json.dumps({"radius_mm": radius_mm}).encode()}
    probe = Source("probe", tmp_path, SkinAppearance({}, "simulated", files=files))
    texts = double._assume_light_distance(probe)
    assert len(texts) == stated
    assert all(f"its fibers are at {min(radius_mm):g} to" in text for text in texts)


@pytest.mark.parametrize("document", [b"", b"null", b"{}", b'{"radius_mm": []}', b"[1]"])
def test_unreadable_profiles_of_probe_are_refused(tmp_path, document):
    appearance = SkinAppearance({}, "simulated", files={PROFILE_FILE: document})
    with pytest.raises(FusionInputError, match=r"profiles\.json: not readable"):
        double._assume_light_distance(Source("probe", tmp_path, appearance))
