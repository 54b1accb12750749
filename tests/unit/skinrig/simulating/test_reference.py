"""Sessions of voxel skin: `--renderer reference` of flash rig and probe, and all refusals."""

from dataclasses import replace

import numpy as np
import pytest

from capture.rig import load_rig
from capture.session import Session
from model import store
from reconstruction.pipeline import recipes as pipeline
from rigsim.boxes.flash import FlashPop
from rigsim.fiber.probe_profile import BandProfile
from rigsim.mitsuba.variant import choose_variant
from rigsim.needs.tissue import TISSUE_RULES
from rigsim.scenes.exposing import SceneError
from rigsim.scenes.reference.flash_session import RenderedSkin, VoxelFlashScene, crop_to_patch
from rigsim.scenes.reference.patch import PatchImage, draw_patch
from rigsim.scenes.reference.probe_session import UNEVEN_EFFECT
from rigsim.subject.person_skin import PersonSkin
from rigsim.world.suction import HeadState
from skinrig.calibrating.calibrate import calibrate
from skinrig.evaluating.subsurface import compare_profiles
from skinrig.simulating import reference
from skinrig.simulating.orders import SimulationError
from skinrig.simulating.simulation import simulate_session

needs_llvm = pytest.mark.skipif(
    not choose_variant("rgb").is_vectorized, reason="voxels need a vectorized variant"
)
ONES = np.ones((28, 3))
SUBJECT = {"subject": "II", "seed": 5, "renderer": "reference"}


@pytest.fixture(scope="module")
def flash_session(tmp_path_factory):
    """A patch with few samples, and the lines of its progress."""
    folder, lines = tmp_path_factory.mktemp("flash"), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(reference.PATCH_SAMPLES, "small", 16)
        done = simulate_session(
            "flash", folder / "session-flash", progress=lines.append, site="chin", **SUBJECT
        )
    return done, lines


@needs_llvm
@pytest.mark.render
@pytest.mark.long
def test_flash_patch_states_time_renderer_and_voxels(flash_session):
    done, lines = flash_session
    assert lines[0].endswith("s of processor time")
    extra = Session.open(done.session).manifest.extra
    assert extra["renderer"]["name"] == "reference"
    assert "noise is" in extra["renderer"]["why"]
    assert extra["simulation"]["site"] == "chin"
    truth = store.read(done.truth)
    assert truth.maps["melanin"].values.shape == (8, 8)
    voxels = truth.parameters["voxels"]
    assert voxels["tissue"]["epidermis_mm"] > 0.0
    with np.load(done.truth / reference.VOXEL_FILE) as held:
        inner = np.abs(held["x_mm"]) < 32 * voxels["voxel_mm"]
        mean = held["melanin"][np.ix_(inner, inner)].mean()
        np.testing.assert_allclose(truth.maps["melanin"].values.mean(), mean, rtol=1e-5)


@needs_llvm
@pytest.mark.render
@pytest.mark.long
def test_flash_patch_is_calibrated_and_reconstructed(flash_session, tmp_path):
    """Rationale: the light that polarizers separate is that of the voxels, which are known.

    Tolerance: 2 % of the mean over 256 pixels, whose noise is 13 % each, shared by both sides; a
    white reference or an analyzer that is wrong by a few percent fails.
    """
    done, _ = flash_session
    for target, kind in (("flat", "sensor"), ("white", "white"), ("malus", "polarization")):
        session = tmp_path / f"session-{target}"
        simulate_session("flash", session, target=target, renderer="reference")
        calibrate(kind, [session], tmp_path / "calibration")
    pipeline.reconstruct(
        done.session,
        want=("diffuse", "specular", "melanin"),
        out=tmp_path / "maps",
        calibration=tmp_path / "calibration",
    )
    found = store.read(tmp_path / "maps")
    with np.load(done.truth / reference.VOXEL_FILE) as held:
        true = held["rgb"].mean(axis=(0, 1))
    diffuse = found.maps["diffuse"].values.mean(axis=(0, 1))
    np.testing.assert_allclose(diffuse, true, rtol=0.02)
    assert found.maps["specular"].values.mean() > 0.02
    assert found.maps["melanin"].valid.mean() > 0.9


@needs_llvm
@pytest.mark.render
@pytest.mark.long
def test_patch_noise_follows_session_seed(monkeypatch):
    monkeypatch.setitem(reference.PATCH_SAMPLES, "small", 2)
    rig = crop_to_patch(load_rig("flash"), 2)
    given = {"subject": "II", "site": None, "seed": 5, "size": "small", "progress": None}
    first, second, again = (
        reference.make_patch_scene(rig, noise_seed=noise_seed, **given).skin
        for noise_seed in (1, 2, 1)
    )
    np.testing.assert_array_equal(first.patch.melanin, second.patch.melanin)
    np.testing.assert_array_equal(first.image.rgb, again.image.rgb)
    assert (first.image.rgb != second.image.rgb).all()


@needs_llvm
def test_patch_under_led_is_refused():
    """A scene that fell back to its white reference would record wrong frames."""
    rig = crop_to_patch(load_rig("flash"), 4)
    person = PersonSkin.of_preset("II")
    patch = draw_patch(person, "cheek", field_mm=4.0, voxel_mm=0.25)
    skin = RenderedSkin(patch, PatchImage(np.full((4, 4, 3), 0.5), np.full((4, 4, 3), 1e-4)))
    scene = VoxelFlashScene(rig, skin)
    assert scene.under("") is scene
    pop = FlashPop("1", 0.0, 1.0, "crossed", 0.0, "LED-550-20")
    with pytest.raises(SceneError, match="got LED-550-20, expected the tube"):
        scene.exposure("cam", pops=[pop], exposure_s=0.01, seed=0)


@pytest.mark.long
def test_probe_session_measures_its_voxels(tmp_path, monkeypatch):
    """Rationale: the fibers' light is that of the voxels below the head, which differ by site.

    Tolerance: errors of the phantom and of the photons are common to neighboring fibers, so more
    than 68 % of fibers may be within one standard error; 84 of each site are judged.
    """
    monkeypatch.setitem(reference.PATCH_PHOTONS, "small", 1000)
    simulate_session("probe", tmp_path / "session-phantom", target="phantom")
    calibrate("fiber", [tmp_path / "session-phantom"], tmp_path / "calibration")
    sites = {"cheek": "forehead", "forehead": "cheek"}
    done = simulate_session("probe", tmp_path / "session", sites=tuple(sites), **SUBJECT)
    pipeline.reconstruct(
        done.session,
        want=("profiles",),
        out=tmp_path / "maps",
        calibration=tmp_path / "calibration",
    )
    found, truth = store.read(tmp_path / "maps"), store.read(done.truth)
    rows = compare_profiles(found, truth)
    assert len(rows) == 6
    assert min(row.coverage for row in rows) > 0.68
    assert max(row.median for row in rows) < 0.02
    exchanged = [one | {"site": sites[one["site"]]} for one in truth.parameters["profiles"]]
    swapped = replace(truth, parameters={**truth.parameters, "profiles": exchanged})
    assert max(row.coverage for row in compare_profiles(found, swapped)) < 0.5
    verdicts = {one["name"]: one["verdict"] for one in done.effects}
    assert verdicts[UNEVEN_EFFECT] == "built"
    assert {verdicts[rule.name] for rule in TISSUE_RULES} == {"built"}
    assert verdicts["suction other than nominal"] == "unmodeled"


def test_probe_place_that_was_not_traced_is_refused(monkeypatch):
    rig = load_rig("probe")
    scene = reference.make_probe_scene(
        rig, subject="II", seed=5, noise_seed=None, size="small", places=(), progress=None
    )
    traced = []
    monkeypatch.setattr(
        scene.profiles, "_read", lambda *place: traced.append(place) or BandProfile(ONES, ONES)
    )
    scene.profiles.trace_only([("cheek", 0.0)])
    head = HeadState("cheek", 0.0, True, 100.0, 5.0)
    assert scene.fiber_radiance(head).min() > 0.0
    for other in (replace(head, site="chin"), replace(head, angle_deg=45.0)):
        with pytest.raises(SceneError, match="expected one whose voxels were traced before"):
            scene.fiber_radiance(other)
    assert traced == [("cheek", 0.0)]


@pytest.mark.parametrize(
    ("rig", "options", "message"),
    [
        ("dome", {"states": ("anger",)}, "state: got 'anger', expected neutral"),
        ("dome", {"move": True}, "move: not an option of the dome"),
        ("dome", {"conditions": {"lotion": 1.0}}, "got conditions lotion, expected none"),
        ("gradient", {"steps": (-1, 1)}, r"steps: got -1..1, expected 0..0"),
        ("gradient", {"width_px": 1024}, "width: got 1024, expected at most 512"),
        ("flash", {"width_px": 64}, "width: got 64, expected an even number up to 32"),
        ("flash", {"states": ("anger",)}, "states: not an option"),
        ("flash", {"renderer": "fast", "site": "chin"}, "site: not an option"),
        ("probe", {"sites": ("abdomen",)}, "site: got 'abdomen', expected one of forehead"),
        ("probe", {"subject": "homogeneous:0.1,1"}, "expected a person"),
    ],
)
def test_reference_is_refused_before_folder_creation(tmp_path, rig, options, message):
    with pytest.raises(SimulationError, match=message):
        simulate_session(rig, tmp_path / "session", **SUBJECT | options)
    assert not (tmp_path / "session").exists()


def test_reference_without_llvm_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("SKINRIG_MITSUBA", "scalar")
    with pytest.raises(SimulationError, match="reference needs LLVM"):
        simulate_session("flash", tmp_path / "session", **SUBJECT)
