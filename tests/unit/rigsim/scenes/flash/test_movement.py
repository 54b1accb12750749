"""The flash scene of a moving face: its truth moves with it and says what it is at rest."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from capture.rig import Rig, load_rig
from rigsim.mitsuba.variant import VariantChoice
from rigsim.needs.effects import SceneEffects
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.flash.scene import FlashScene
from rigsim.subject import landmarks
from rigsim.subject.person import SimulatedSubject, make_subject
from skinrig.simulating.dome import small_dome
from skinrig.simulating.flash_truth import build_truth

EMBREE = VariantChoice("scalar_rgb", "asked for by the test", "")
WIDTH = 192


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("flash").resized(WIDTH)


def scene_of(
    rig: Rig, face: SimulatedSubject, state: str, lateral: bool = False, **kwargs
) -> FlashScene:
    effects = SceneEffects(lateral=lateral, interreflections=False)
    return FlashScene(rig, face, state=state, effects=effects, **({"choice": EMBREE} | kwargs))


@pytest.fixture(scope="module")
def rest(rig: Rig, face: SimulatedSubject) -> FlashScene:
    return scene_of(rig, face, "neutral")


@pytest.fixture(scope="module")
def smile(rig: Rig, face: SimulatedSubject) -> FlashScene:
    return scene_of(rig, face, "smile")


@pytest.fixture(scope="module")
def tired(rig: Rig, face: SimulatedSubject) -> FlashScene:
    return scene_of(rig, face, "exercise")


@pytest.fixture(scope="module")
def still(rig: Rig, face: SimulatedSubject) -> FlashScene:
    return scene_of(rig, face, "smile", movement=False)


@pytest.mark.long
def test_moved_face_is_rendered_with_matching_maps(rest, smile):
    before, after = rest.truth(), smile.truth()
    x, y = before["position_mm"][..., 0], before["position_mm"][..., 1]
    corner = before["mask"] & after["mask"] & (np.hypot(x - 30.0, y + 40.0) < 12.0)
    still = before["mask"] & after["mask"] & (y > 55.0)
    light = np.abs(smile.radiance() - rest.radiance()).sum(axis=-1)
    assert light[corner].mean() > 5.0 * light[still].mean()
    assert np.abs(after["uv"] - before["uv"])[corner].mean() > 0.005
    assert np.abs(after["uv"] - before["uv"])[still].max() < 0.002


@pytest.mark.long
def test_state_blood_warped_back_matches_blood_at_rest(smile, rig):
    """Rationale: each pixel's skin is known at rest, so the moved map can be laid over the face at
    rest, where it must be the blood of that state.

    Tolerance: 2 % in the median; both maps average the texture over a pixel, and once more by
    bilinear sampling. Laid over without regard of the movement, smiling cheeks err at least three
    times as much.
    """
    truth = smile.truth()
    inside = truth["mask"]
    pixels = landmarks.project_points(
        truth["position_at_rest_mm"][inside].astype(np.float64), rig.views[0]
    )
    at = pixels[:, ::-1].T
    whole = map_coordinates(truth["mask_at_rest"].astype(float), at, order=1) == 1.0
    moved = np.linalg.norm((truth["position_mm"] - truth["position_at_rest_mm"])[inside], axis=-1)
    checked = whole & (moved > 4.0)
    assert checked.sum() > 300
    for name in ("hemoglobin", "melanin", "hemoglobin_blurred", "melanin_blurred"):
        expected = map_coordinates(truth[f"{name}_at_rest"].astype(float), at, order=1)
        error = np.abs(truth[name][inside] / np.maximum(expected, 1e-6) - 1.0)[checked]
        unmoved = np.abs(truth[name] / np.maximum(truth[f"{name}_at_rest"], 1e-6) - 1.0)[inside]
        assert np.median(error) < 0.02
        assert np.median(unmoved[checked]) > 3.0 * np.median(error)


@pytest.mark.long
def test_blood_at_rest_matches_unmoved_face(smile, still):
    truth, unmoved = smile.truth(), still.truth()
    for name in ("hemoglobin", "melanin", "mask"):
        np.testing.assert_array_equal(truth[f"{name}_at_rest"], unmoved[name])
    for name in ("hemoglobin", "melanin", "mask", "hemoglobin_blurred", "melanin_blurred"):
        np.testing.assert_array_equal(unmoved[f"{name}_at_rest"], unmoved[name])
    assert "position_at_rest_mm" not in unmoved


@pytest.mark.long
def test_unchanged_blood_is_laterally_scattered_as_at_rest(rig, face):
    """Rationale: a picture shows blood as light has spread over it, whatever the state, so what a
    state's map at rest is compared with is as smooth as the neutral one. A sharp map less a blurred
    one would be a change where there is none.

    Tolerance: where sharp blood is the same within 1 %, the blurred maps differ at most a third as
    much as a sharp one from a blurred one; cheeks beside have moved, and light with them.
    """
    before, after = (
        scene_of(rig, face, state, lateral=True).truth() for state in ("neutral", "smile")
    )
    same = before["mask"] & after["mask_at_rest"] & (before["hair"] == 0.0)
    change = np.abs(after["hemoglobin_at_rest"] - before["hemoglobin"])
    same &= change < 0.01 * before["hemoglobin"]
    assert same.sum() > 300
    blurred = before["hemoglobin_blurred"][same]

    def difference(name):
        return np.std(after[name][same] / blurred)

    assert difference("hemoglobin_blurred_at_rest") < difference("hemoglobin_at_rest") / 3.0


@pytest.mark.long
def test_states_without_movement_change_blood_only_as_reported(rest, smile, still):
    np.testing.assert_array_equal(still.truth()["normals"], rest.truth()["normals"])
    assert (still.truth()["hemoglobin"] != rest.truth()["hemoglobin"]).any()
    said = dict(still.omitted)
    assert said["movement of the face with the states"] == "movement=False requests it"
    assert "movement of the face with the states" not in dict(smile.omitted)
    assert smile.needs.builds("shadows of relief")


@pytest.mark.long
def test_global_states_keep_pose_neutral_skips_rest_maps(rest, tired):
    truth = tired.truth()
    np.testing.assert_array_equal(truth["position_mm"], rest.truth()["position_mm"])
    np.testing.assert_array_equal(truth["hemoglobin_at_rest"], truth["hemoglobin"])
    assert not [name for name in rest.truth() if "at_rest" in name]


@pytest.mark.long
def test_posed_subject_keeps_pose_when_blood_changes(rig, face, tired):
    half = face.with_expression("smile", 0.5)
    scene = scene_of(rig, half, "exercise")
    assert scene.subject is half
    np.testing.assert_array_equal(
        scene.truth()["hemoglobin_at_rest"], tired.truth()["hemoglobin_at_rest"]
    )


@pytest.mark.long
def test_truth_at_rest_has_blood_of_pose_amount(rig, face, rest, smile):
    half = scene_of(rig, face.with_expression("smile", 0.5), "smile").truth()
    neutral, full = rest.truth(), smile.truth()
    both = neutral["mask"] & half["mask_at_rest"] & full["mask_at_rest"]

    def change(truth):
        return np.abs(truth["hemoglobin_at_rest"] - neutral["hemoglobin"])[both].mean()

    assert 0.3 * change(full) < change(half) < 0.75 * change(full)


@pytest.mark.long
def test_scenes_sharing_light_match_scenes_alone(rig, rest, tired):
    beside = tired.radiance()
    stranger = make_subject("II", seed=4, size=256)  # the same person, nothing shared
    alone = scene_of(rig, stranger, "exercise").radiance()
    np.testing.assert_array_equal(beside, alone)
    assert (beside != rest.radiance()).any()


@pytest.mark.long
def test_stored_truth_has_landmarks_and_masked_rest_blood(smile, rest):
    truth = build_truth(smile, 4, "0" * 64, "smile")
    assert truth.parameters["state"] == "smile"
    assert truth.parameters["movement"] is True
    assert len(truth.parameters["landmarks_px"]) >= 20
    height, width = truth.maps["melanin"].values.shape
    for x, y in truth.parameters["landmarks_px"].values():
        assert -0.5 <= x <= width - 0.5
        assert -0.5 <= y <= height - 0.5
    own, at_rest = truth.maps["hemoglobin"].valid, truth.maps["hemoglobin_at_rest"].valid
    assert (own != at_rest).any()
    assert truth.maps["hemoglobin_at_rest"].unit == truth.maps["hemoglobin"].unit
    assert truth.maps["position_at_rest_mm"].unit == "mm"
    neutral = build_truth(rest, 4, "0" * 64, "neutral")
    assert len(neutral.parameters["landmarks_px"]) >= 20
    assert "hemoglobin_at_rest" not in neutral.maps


@pytest.mark.long
def test_dome_renders_expression_with_texture_frame_normals(face):
    rig = small_dome(load_rig("dome"), lights=4, views=1, width_px=32)
    scenes = {
        state: DomeScene(rig, face, state=state, choice=EMBREE) for state in ("neutral", "surprise")
    }
    truths = {state: scene.truth_appearance().maps for state, scene in scenes.items()}
    posed = face.with_expression("surprise")
    np.testing.assert_array_equal(truths["surprise"]["normals"].values, posed.normal)
    np.testing.assert_array_equal(
        truths["surprise"]["normals_tangent"].values, posed.tangent_normal()
    )
    np.testing.assert_array_equal(
        truths["surprise"]["position_at_rest"].values, truths["neutral"]["position"].values
    )
    valid = truths["neutral"]["r_d"].valid
    changed = truths["surprise"]["r_d"].values[valid] / truths["neutral"]["r_d"].values[valid]
    assert np.ptp(changed) > 0.02  # the blood of the state
    assert "position_at_rest" not in truths["neutral"]
    seen = scenes["surprise"].truth()["position_mm"][..., 1]
    assert np.abs(seen - scenes["neutral"].truth()["position_mm"][..., 1]).max() > 1.0
    still = DomeScene(rig, face, state="surprise", movement=False, choice=EMBREE)
    assert dict(still.omitted)["movement of the face with the state"]
