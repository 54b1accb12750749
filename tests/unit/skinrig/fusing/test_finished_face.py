"""A fused person's face: light, blood and movement of the frames, on a head that is known."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures.finished_faces import HEAD_BLOOD, HEAD_MELANIN, HEAD_PX, matte_head, matte_maps
from fixtures.head_scans import draw_scan

from model import color_table, spectra, store
from model.facial_color import HemoglobinRig
from model.facial_color.document import RIG_DOCUMENT, to_maps
from model.skin import SkinAppearance
from model.skin_reflectance import assemble
from model.tissue_optics.layers import ANISOTROPY_SKIN
from rigsim.geometry.atlas import unwrap
from skinrig.appearances.contents import hash_document
from skinrig.fusing import finished_face
from skinrig.fusing.finished_face import (
    LIGHT_AZIMUTHS_DEG,
    complete_skin,
    render_finished_face,
    write_finished_face,
)
from skinrig.fusing.finished_face_file import DOCUMENT_FILE, SHEET_FILE
from skinrig.fusing.sources import FusionInputError
from skinrig.unmeasured.head_fit import fit_head
from skinrig.unmeasured.person import HEAD_FILE

FRAME_PX = (48, 54)
R_D = (0.4, 0.3, 0.2)
BACKGROUND = (40, 42, 45)


@pytest.fixture(scope="module")
def head():
    """Return matte maps of one color on the procedural head, and its texels."""
    return matte_head()


def person(head, *, rigs=("dome",), placed=True):
    """Return a fused person whose flash image has the layout of the texture."""
    appearance, covered = head
    colors = [
        SimpleNamespace(
            bands=SimpleNamespace(rig=rig, camera=spectra.LINEAR_SRGB, illuminant="D65")
        )
        for rig in rigs
    ]
    placement = SimpleNamespace(sample=lambda values, valid: (values, valid & covered))
    measured = SimpleNamespace(placement=placement if placed else None, colors=colors)
    return SimpleNamespace(appearance=appearance, measured=measured)


def moving(blood):
    """Return a hemoglobin rig whose anger has this blood volume fraction everywhere."""
    rest = np.full((HEAD_PX, HEAD_PX), HEAD_BLOOD)
    rig = HemoglobinRig.from_maps(rest, {"anger": np.full_like(rest, blood)}, radius_px=6.0)
    maps, document = to_maps(rig)
    return SkinAppearance(maps, "simulated", files={RIG_DOCUMENT: document})


def small_frames(head, blood):
    """Return frames of few pixels, (L, S, H, W, 3)."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finished_face, "FRAME_PX", FRAME_PX)
        return render_finished_face(person(head), moving(blood), expression="anger", seed=0).frames


@pytest.fixture(scope="module")
def still_blood(head):
    """Return frames of a face whose blood stays."""
    return small_frames(head, HEAD_BLOOD)


def linear(frames):
    """Undo the sRGB curve, IEC 61966-2-1."""
    code = frames / 255.0
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def test_light_direction_brightens_its_side_of_the_face(still_blood):
    frames = still_blood
    assert frames.shape == (5, 5, *FRAME_PX[::-1], 3)
    level = linear(frames[:, 0]).mean(axis=-1)
    half = FRAME_PX[0] // 2
    contrast = level[..., :half].sum(axis=(1, 2)) / level[..., half:].sum(axis=(1, 2))
    assert list(LIGHT_AZIMUTHS_DEG) == ["left", "half left", "front", "half right", "right"]
    assert contrast[0] > 1.5
    assert contrast[4] < 1 / 1.5
    assert np.all(np.diff(contrast) < 0.0)
    np.testing.assert_allclose(contrast[2], 1.0, atol=0.05)  # the head is nearly symmetric
    assert tuple(frames[0, 0, 0, 0]) == BACKGROUND


def test_expression_moves_the_face_step_by_step(still_blood):
    front = still_blood[2].astype(float)
    away = np.abs(front - front[0]).mean(axis=(1, 2, 3))
    assert away[0] == 0.0
    assert np.all(np.diff(away) > 0.0)


def test_blood_changes_color_by_table_ratio(head, still_blood):
    """Rationale: matte skin of one color moves alike in both; only its R_d differs.

    Tolerance: a code of 8 bits is 1 % at the level of the darkest compared pixels.
    """
    more = 0.03
    still, blushed = (linear(one[2, -1]) for one in (still_blood, small_frames(head, more)))
    table = color_table.build(spectra.LINEAR_SRGB, "D65", anisotropy=ANISOTROPY_SKIN)
    expected = table.lookup(HEAD_MELANIN, more) / table.lookup(HEAD_MELANIN, HEAD_BLOOD)
    lit = (still.min(axis=-1) > 0.1) & (still.max(axis=-1) < 0.7)
    assert lit.sum() > 200
    found = np.median(blushed[lit] / still[lit], axis=0)
    assert expected[1] < 0.9
    np.testing.assert_allclose(found, expected, rtol=0.02)


@pytest.mark.parametrize(
    ("changes", "says"), [({"placed": False}, "flash rig"), ({"rigs": ("probe",)}, "dome")]
)
def test_person_without_both_rigs_is_refused(head, changes, says):
    with pytest.raises(FusionInputError, match=says):
        render_finished_face(
            person(head, **changes), moving(HEAD_BLOOD), expression="anger", seed=0
        )


def test_unknown_expression_is_refused(head):
    with pytest.raises(FusionInputError, match="yawn"):
        render_finished_face(person(head), moving(HEAD_BLOOD), expression="yawn", seed=0)
    with pytest.raises(FusionInputError, match="smile"):
        render_finished_face(person(head), moving(HEAD_BLOOD), expression="smile", seed=0)


def write_record(out, double, blood):
    """Write a face of these appearances; return its record."""
    face = finished_face.FinishedFace(
        np.zeros((5, 5, 270, 240, 3), np.uint8), "anger", (0.0, 1.0), 0.5, 7, (("eyes", "none"),)
    )
    folders = out.parent / "double", out.parent / "moving"
    for folder, one in zip(folders, (double, blood), strict=True):
        store.write(folder, one)
    person_maps = SimpleNamespace(appearance=double)
    write_finished_face(out, face, person_maps, blood, errors={"normals": "1.3°"}, folders=folders)
    return json.loads((out / DOCUMENT_FILE).read_text(encoding="utf-8"))


def test_written_folder_names_person_and_omissions(head, tmp_path):
    out = tmp_path / "face"
    document = write_record(out, head[0], moving(HEAD_BLOOD))
    assert {path.name for path in out.iterdir()} == {DOCUMENT_FILE, SHEET_FILE}
    assert document["person"] == "double"
    assert document["errors"] == {"normals": "1.3°"}
    assert document["left_out"] == [["eyes", "none"]]
    assert document["source"] == "simulated"
    assert document["seed"] == 7
    assert document["inputs"] == {
        name: hash_document(tmp_path / name) for name in ("double", "moving")
    }


def test_consent_of_both_inputs_is_recorded(head, tmp_path):
    subjects = [
        {"pseudonym": name, "consent_scope": [use], "consent_expires": None}
        for name, use in (("P1", "publication"), ("P2", "research"))
    ]
    double, blood = (
        dataclasses.replace(one, source="measured", parameters={"consent": [subject]})
        for one, subject in zip((head[0], moving(HEAD_BLOOD)), subjects, strict=True)
    )
    document = write_record(tmp_path / "face", double, blood)
    assert document["consent"] == subjects
    assert document["source"] == "measured"
    simulated = dataclasses.replace(blood, source="simulated")
    document = write_record(tmp_path / "face", double, simulated)
    assert document["source"] == "simulated"
    assert document["consent"] == subjects


def test_unmeasured_texels_have_normals_of_the_mesh(head):
    """Rationale: false or mean normals that face away from the camera render black."""
    appearance, covered = head
    hole = np.zeros_like(covered)
    hole[HEAD_PX // 2, HEAD_PX // 2 : HEAD_PX // 2 + 4] = True
    assert covered[hole].all()
    model = assemble(appearance)
    normals, r_d = model.normals.copy(), model.r_d.copy()
    normals[hole] *= -1.0
    r_d[hole] = 0.0
    valid = model.valid & ~hole
    for known in (valid, model.valid):
        damaged = dataclasses.replace(model, normals=normals, r_d=r_d, valid=known)
        found = complete_skin(appearance, damaged, seed=0).model
        assert found.valid[covered].all()
        cosine = np.einsum("nk,nk->n", found.normals[hole], model.normals[hole])
        assert cosine.min() > 0.9
        if known is valid:
            np.testing.assert_allclose(found.r_d[hole], model.r_d[hole], rtol=1e-5)
        kept = valid & covered
        to_camera = np.array(finished_face.CAMERA_MM) - appearance.maps["position"].values
        kept &= np.einsum("hwk,hwk->hw", model.normals, to_camera) > 0.0
        np.testing.assert_array_equal(found.normals[kept], model.normals[kept])


@pytest.mark.long
def test_crown_and_neck_continue_the_scan():
    scan, _ = draw_scan(300)
    appearance, _ = matte_maps(scan)
    files = {**appearance.files, HEAD_FILE: fit_head(scan).to_bytes()}
    model = assemble(appearance)
    whole = complete_skin(dataclasses.replace(appearance, files=files), model, seed=0)
    height = whole.person.mesh.vertices_mm[:, 1]
    assert height.max() > scan.vertices_mm[:, 1].max() + 5.0
    assert height.min() < scan.vertices_mm[:, 1].min() - 5.0
    everywhere = unwrap(whole.person.mesh, HEAD_PX).covered
    assert whole.model.valid[everywhere].all()
    assert (everywhere & ~model.valid).sum() > 50
    np.testing.assert_allclose(
        whole.model.r_d[everywhere], np.broadcast_to(R_D, (everywhere.sum(), 3)), rtol=1e-3
    )
    assert {"crown", "neck"} <= set(whole.person.regions)
    named = dataclasses.replace(appearance, files=files)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finished_face, "FRAME_PX", FRAME_PX)
        bald, haired = (
            render_finished_face(
                person((one, everywhere)), moving(HEAD_BLOOD), expression="anger", seed=0
            )
            for one in (appearance, named)
        )
    assert any(part.startswith("eyes, ") for part, _ in haired.left_out)
    assert not any(part.startswith("eyes, ") for part, _ in bald.left_out)
    top = np.s_[2, 0, 4:12, FRAME_PX[0] // 3 : -FRAME_PX[0] // 3]
    assert haired.frames[top].mean() < 0.6 * bald.frames[top].mean()
