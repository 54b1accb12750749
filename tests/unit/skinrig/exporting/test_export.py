"""Exports of appearances: within the consent, whole or not at all, the same bytes again."""

import dataclasses
from datetime import UTC, date, datetime

import numpy as np
import pytest

from capture.session import ConsentError
from model import store
from model.facial_color.document import to_maps
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig import consent
from skinrig.errors import UsageError
from skinrig.exporting import export as exporting
from skinrig.exporting.export import APPEARANCE_FORMATS
from skinrig.exporting.options import ExportError, ExportSettings

NOW, DAY = datetime(2029, 5, 1, tzinfo=UTC), date(2029, 5, 1)
LAST = date(2030, 1, 1)


@pytest.fixture
def measured(patch, tmp_path):
    face = patch.face(source="measured", parameters={consent.CONSENT_KEY: [patch.consent]})
    return store.write(tmp_path / "measured", face)


@pytest.mark.parametrize("to", ["maps", "mtlx", "gltf", "merl"])
def test_maps_export_requires_subject_consent_and_valid_date(measured, tmp_path, to):
    def export(**more):
        return exporting.export(measured, tmp_path / "out", to=to, now=NOW, **more)

    with pytest.raises(UsageError, match="--use: got none"):
        export(today=DAY)
    for use, today in (("publication", DAY), ("research", date(2030, 1, 2)), ("any", DAY)):
        with pytest.raises(ConsentError, match="P042 has not agreed"):
            export(use=use, today=today)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["measured"]
    if to != "merl":  # tables of 35 MB, see the long test
        assert export(use="research", today=LAST).files > 0


@pytest.mark.long
def test_merl_tables_are_exported_within_the_consent(measured, tmp_path):
    out = tmp_path / "out"
    made = exporting.export(measured, out, to="merl", now=NOW, use="research", today=LAST)
    tables = list(out.rglob("*.binary"))
    assert 0 < len(tables) < made.files


@pytest.mark.parametrize("to", ["mtlx", "gltf", "usd"])
def test_photograph_maps_are_refused_for_surface_formats(tmp_path, to):
    """Not to reconstruct a position, which no session of the flash rig has."""
    values, valid = np.full((4, 4), 0.02, np.float32), np.ones((4, 4), bool)
    flat = SkinMap(values, MAP_UNITS["melanin"], valid=valid)
    maps = store.write(tmp_path / "flash", SkinAppearance({"melanin": flat}, "simulated"))
    with pytest.raises(ExportError, match=r"has melanin; choose maps \["):
        exporting.export(maps, tmp_path / "out", to=to)
    assert not (tmp_path / "out").exists()
    assert exporting.export(maps, tmp_path / "out", to="maps").files > 1


def test_refused_format_error_lists_formats_that_work(tmp_path):
    values, valid = np.full((4, 4), 0.02, np.float32), np.ones((4, 4), bool)
    chromophores = ("melanin", "hemoglobin")
    held = {name: SkinMap(values, MAP_UNITS[name], valid=valid) for name in chromophores}
    held |= {f"height_{n}": SkinMap(values, "1", valid=valid) for n in range(30)}
    maps = store.write(tmp_path / "flash", SkinAppearance(held, "simulated"))
    with pytest.raises(ExportError, match=r"and 26 more; choose (.*) \[SR-EXP-004\]") as error:
        exporting.export(maps, tmp_path / "out", to="gltf")
    offered = str(error.value).partition("; choose ")[2].partition(" [")[0].split(", ")
    assert offered == ["maps", "spectral"]
    for to in offered:
        assert exporting.export(maps, tmp_path / to, to=to).files > 1


def test_simulated_data_needs_no_consent(face_folder, tmp_path):
    assert exporting.export(face_folder, tmp_path / "out", to="mtlx").files > 5


def test_measured_maps_without_consent_record_are_not_exported(patch, tmp_path):
    silent = store.write(tmp_path / "old", patch.face(source="measured"))
    with pytest.raises(ConsentError, match="does not record") as error:
        exporting.export(silent, tmp_path / "out", to="maps", use="research")
    assert "skinrig reconstruct" in str(error.value)


def test_moving_face_needs_consent_of_every_part():
    told = {"pseudonym": "a", "consent_scope": ["research", "film"], "consent_expires": None}
    other = {"pseudonym": "b", "consent_scope": ["research"], "consent_expires": None}
    parts = {
        "facial_color": {"source": "measured", consent.CONSENT_KEY: [told]},
        "wrinkles": {"source": "measured", consent.CONSENT_KEY: [other]},
    }
    face = SkinAppearance({}, "measured", {"kind": "dynamic", "parts": parts})
    assert consent.read_consent(face) == [told, other]
    consent.require_consent(face, "research", folder="x")
    with pytest.raises(ConsentError, match="subject b has not agreed"):
        consent.require_consent(face, "film", folder="x")
    del parts["wrinkles"][
        consent.CONSENT_KEY
    ]  # one part of a simulated face that was measured silently
    mixed = SkinAppearance({}, "simulated", {"kind": "dynamic", "parts": parts})
    with pytest.raises(ConsentError, match="does not record"):
        consent.require_consent(mixed, "research", folder="x")


def test_result_of_measurements_without_consent_permits_no_use():
    made = SkinAppearance(
        {},
        "simulated",
        {consent.CONSENT_KEY: consent.merge_consent(SkinAppearance({}, "measured"))},
    )
    with pytest.raises(ConsentError, match="unknown has not agreed"):
        consent.require_consent(made, "research", folder="x")


def test_damaged_date_is_not_a_consent(patch):
    told = {**patch.consent, "consent_expires": "soon"}
    face = SkinAppearance({}, "measured", {consent.CONSENT_KEY: [told]})
    with pytest.raises(ConsentError, match="got 'soon'"):
        consent.require_consent(face, "research", folder="x")


def test_target_texture_of_colors_needs_consent(measured, face_folder, tmp_path):
    order = ExportSettings(target_face=measured)
    with pytest.raises(ConsentError, match="P042"):
        exporting.export(
            face_folder, tmp_path / "out", to="maps", delivery=order, use="film", today=DAY
        )


@pytest.mark.parametrize("to", ["maps", "mtlx", "gltf", "usd"])
def test_the_same_appearance_gives_the_same_bytes(face_folder, tmp_path, to):
    if to == "usd":
        pytest.importorskip("pxr")
    for name in ("a", "b"):
        order = ExportSettings(with_errors=True)
        exporting.export(face_folder, tmp_path / name / "out", to=to, delivery=order, now=NOW)
    files = [p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file()]
    assert len(files) > 4
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


def test_a_failure_on_the_way_leaves_nothing(patch, tmp_path):
    face = patch.face()
    without = dataclasses.replace(
        face, files={n: d for n, d in face.files.items() if "obj" not in n}
    )
    folder = store.write(tmp_path / "face", without)
    with pytest.raises(ValueError, match=r"mesh\.obj is missing"):
        exporting.export(folder, tmp_path / "out", to="mtlx")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["face"]


def test_existing_folder_or_unknown_format_is_refused(face_folder, tmp_path):
    with pytest.raises(ExportError, match="exists"):
        exporting.export(face_folder, tmp_path, to="maps")
    with pytest.raises(ExportError, match=", ".join(APPEARANCE_FORMATS)):
        exporting.export(face_folder, tmp_path / "out", to="fbx")


def test_the_manifest_lists_every_file(face_folder, tmp_path):
    done = exporting.export(face_folder, tmp_path / "out", to="mtlx", now=NOW)
    text = done.manifest.read_text()
    listed = [p for p in done.path.rglob("*") if p.is_file() and "ascmhl" not in p.parts]
    assert done.files == len(listed)
    for path in listed:
        assert f">{path.relative_to(done.path).as_posix()}<" in text


# consent on its way ---------------------------------------------------------------------------


def test_session_maps_carry_consent_and_older_are_updated(tmp_path):
    from capture import raw
    from capture.plan import flash_plan
    from capture.rig import load_rig
    from capture.session import Session, SubjectRecord
    from reconstruction.pipeline.recipes import reconstruct

    rig = load_rig("flash").resized(16)
    with Session.create(
        tmp_path / "s",
        plan=flash_plan(rig, darks=2),
        rig=rig,
        devices={},
        subject=SubjectRecord("P042", ("research",), LAST),
        source="measured",
    ) as made:
        for number, (step, camera) in enumerate(made.pending_frames()):
            blob = raw.encode_dng(
                np.full((10, 16), 600 + 300 * number, np.uint16),
                pattern="RGGB",
                black=512,
                white=16383,
                step_id=step.id,
                session_id=made.id,
                exposure_s=0.01,
                iso=100,
                noise_profile=(1e-5, 1e-8),
            )
            made.commit(
                step.id,
                camera,
                blob,
                settings=step.settings,
                t_host_s=1.0 + number,
                actual={"light": "flash", "iso": 100},
            )
        made.close()

    def told():
        return store.read(tmp_path / "maps").parameters.get(consent.CONSENT_KEY)

    reconstruct(tmp_path / "s", want=["diffuse"], out=tmp_path / "maps")
    expected = {"pseudonym": "P042", "consent_scope": ["research"], "consent_expires": "2030-01-01"}
    assert told() == [expected]
    found = store.read(tmp_path / "maps")
    old = {k: v for k, v in found.parameters.items() if k != consent.CONSENT_KEY}
    store.write(tmp_path / "maps", dataclasses.replace(found, parameters=old))
    assert told() is None
    outcome = reconstruct(tmp_path / "s", want=["diffuse"], out=tmp_path / "maps")
    assert not outcome.ran  # nothing was computed again
    assert told() == [expected]


def test_fitted_model_carries_consent_of_its_sources(measured, tmp_path):
    from skinrig.fitting.reflectance import fit_reflectance

    fit_reflectance(measured, out=tmp_path / "model")
    read = store.read(tmp_path / "model")
    assert [one["pseudonym"] for one in consent.read_consent(read)] == ["P042"]


def test_an_expression_bears_the_consent_of_both_faces(tmp_path, rng):
    from model.facial_color.rig import HemoglobinRig
    from skinrig.applying import expression as applying

    neutral = 0.05 + 0.01 * rng.random((16, 16))
    rig = HemoglobinRig.from_maps(neutral, {"smile": 1.2 * neutral}, radius_px=4.0)
    maps, document = to_maps(rig)
    maps["melanin"] = SkinMap(np.full((16, 16), 0.04), "volume fraction of the epidermis")
    told = {"consent_scope": ["research"], "consent_expires": None}
    part = {
        "maps": sorted(maps),
        "files": ["facial_color.json"],
        "source": "measured",
        consent.CONSENT_KEY: [{"pseudonym": "rig", **told}],
    }
    made = SkinAppearance(
        maps,
        "measured",
        {"kind": "dynamic", "parts": {"facial_color": part}},
        files={"facial_color.json": document},
    )
    store.write(tmp_path / "moving", made)
    onto = SkinAppearance(
        {"hemoglobin": maps["hemoglobin"], "melanin": maps["melanin"]},
        "measured",
        {consent.CONSENT_KEY: [{"pseudonym": "other", **told}]},
    )
    expression = applying.ExpressionRequest({"smile": 1.0}, target_face=applying.TargetFace(onto))
    applying.apply_expression(tmp_path / "moving", expression, out=tmp_path / "shown")
    shown = consent.read_consent(store.read(tmp_path / "shown"))
    assert [one["pseudonym"] for one in shown] == ["rig", "other"]
