"""A subject's consent accompanies every fit, edit, page and report, and stops exports."""

import dataclasses
import json
import re
from datetime import date

import pytest

from capture.session import ConsentError, Session, SubjectRecord
from model import store
from model.skin import SkinAppearance, SkinMap
from model.traits.storage import load
from skinrig import consent
from skinrig.appearances.dynamic import describe_parts
from skinrig.cli import main
from skinrig.editing import edit as editing
from skinrig.editing.spots import SpotRequest
from skinrig.errors import UsageError
from skinrig.exporting.export import export
from skinrig.fitting.microstructure import fit_microstructure
from skinrig.fitting.reflectance import fit_reflectance
from skinrig.fitting.wrinkles import fit_wrinkles
from skinrig.reporting import provenance, report

PLAIN = ("lateral", "interreflections", "spectral", "optics", "relief_shadows")
"""Effects that consent does not depend on."""
FLASH = {"width_px": 160, "seed": 4}
DAY = date(2026, 1, 1)
NARROW = {"pseudonym": "P042", "consent_scope": ["research"], "consent_expires": "2030-01-01"}
OTHER = {"pseudonym": "P007", "consent_scope": ["teaching"], "consent_expires": None}


@pytest.fixture
def dome(patch, tmp_path):
    """Return what writes a measured dome's maps with somebody's consent."""

    def write(name, record=NARROW, **more):
        told = {} if record is None else {consent.CONSENT_KEY: [record]}
        return store.write(
            tmp_path / name, patch.face(source="measured", parameters={**told, **more})
        )

    return write


def refused_beyond(folder, tmp_path, to):
    """Assert that a folder leaves for research alone, and not after the last day."""
    for use, day in (("film", DAY), ("research", date(2030, 1, 2))):
        with pytest.raises(ConsentError, match="P042 has not agreed"):
            export(folder, tmp_path / "out", to=to, use=use, today=day)
    assert not (tmp_path / "out").exists()
    export(folder, tmp_path / "out", to=to, use="research", today=DAY)
    told = next((tmp_path / "out").glob("*.json"))
    assert json.loads(told.read_text())[consent.CONSENT_KEY] == [NARROW]


def test_ended_consent_is_refused_at_the_capture():
    today = date(2026, 1, 2)
    assert consent.parse_subject("P042", ["research"], today, today=today).consent_expires == today
    with pytest.raises(UsageError, match=r"got 2026-01-01, expected 2026-01-02 or later"):
        consent.parse_subject("P042", ["research"], DAY, today=today)


def test_a_fitted_reflectance_leaves_within_the_consent_alone(dome, tmp_path):
    fit_reflectance(dome("dome"), out=tmp_path / "model")
    refused_beyond(tmp_path / "model", tmp_path, "mtlx")


def test_model_of_two_sessions_needs_both_consents(dome, tmp_path):
    """A dome of one subject and a probe of another: neither alone may be overruled."""
    fit_reflectance(dome("dome"), out=tmp_path / "model")
    both = consent.merge_consent(
        *(store.read(dome(n, r)) for n, r in (("a", NARROW), ("b", OTHER)))
    )
    model = store.read(tmp_path / "model")
    mixed = dataclasses.replace(model, parameters={**model.parameters, consent.CONSENT_KEY: both})
    for use, who in (("research", "P007"), ("teaching", "P042")):
        with pytest.raises(ConsentError, match=f"{who} has not agreed"):
            consent.require_consent(mixed, use, folder="x", today=DAY)


@pytest.fixture
def smiling(patch, tmp_path):
    """Return what writes the same dome with other relief."""

    def write(name, record=NARROW):
        told = {} if record is None else {consent.CONSENT_KEY: [record]}
        face = patch.face(source="measured", parameters={**told, "state": "smile"})
        old = face.maps["normals"]
        relief = SkinMap(patch.bumpy(old.values, seed=9), "1", old.stderr, old.valid)
        return store.write(
            tmp_path / name, dataclasses.replace(face, maps={**face.maps, "normals": relief})
        )

    return write


@pytest.mark.long
def test_fitted_wrinkles_leave_within_the_consent_alone(dome, smiling, tmp_path):
    faces = [dome("n", state="neutral"), smiling("s")]
    fit_wrinkles(faces, out=tmp_path / "moving", size=32, mask_size=16)
    (part,) = describe_parts(store.read(tmp_path / "moving")).values()
    assert part[consent.CONSENT_KEY] == [NARROW]
    refused_beyond(tmp_path / "moving", tmp_path, "metahuman")


def test_wrinkles_from_session_without_consent_are_not_exported(dome, smiling, tmp_path):
    faces = [dome("n", state="neutral"), smiling("s", None)]
    fit_wrinkles(faces, out=tmp_path / "moving", size=32, mask_size=16)
    with pytest.raises(ConsentError, match="unknown has not agreed"):
        export(tmp_path / "moving", tmp_path / "out", to="maps", use="research")


def test_fitted_microstructure_leaves_within_the_consent_alone(tmp_path, rng):
    caliper = SkinAppearance(
        {"height_a000_n0": SkinMap(rng.normal(0.0, 9.0, (32, 32)), "um")},
        "measured",
        {"states": ["a000_n0"], "pixel_um": 6.0, consent.CONSENT_KEY: [NARROW]},
        files={"kernels.json": b'{"fits": []}'},
    )
    store.write(tmp_path / "cheek", caliper)
    fit_microstructure([tmp_path / "cheek"], out=tmp_path / "moving", paper_table=True)
    refused_beyond(tmp_path / "moving", tmp_path, "maps")


@pytest.mark.long
@pytest.mark.render
def test_fitted_facial_color_leaves_within_the_consent_alone(tmp_path, monkeypatch):
    """Frames of a simulation in a session that calls itself measured, of a narrow consent."""
    from skinrig.calibrating.calibrate import calibrate
    from skinrig.fitting.facial_color import fit_facial_color
    from skinrig.simulating.simulation import simulate_session

    create = Session.create.__func__
    narrow = SubjectRecord("P042", ("research",), date(2030, 1, 1))
    monkeypatch.setattr(
        Session,
        "create",
        classmethod(lambda *a, **k: create(*a, **{**k, "source": "measured", "subject": narrow})),
    )
    states = ("neutral", "anger")
    about = FLASH | {"subject": "II", "states": states, "leave_out": PLAIN}
    simulate_session("flash", tmp_path / "session-face", **about)
    monkeypatch.undo()
    simulate_session("flash", tmp_path / "white", target="white", **FLASH)
    calibrate("white", [tmp_path / "white"], tmp_path / "calibration")
    marks = tmp_path / "marks"
    marks.mkdir()
    for state, name in (("neutral", "truth-face"), ("anger", "truth-face-anger")):
        points = store.read_document(tmp_path / name).parameters["landmarks_px"]
        rows = [f"{n},{x},{y}" for n, (x, y) in points.items()]
        (marks / f"{state}.csv").write_text("\n".join(["name,x,y", *rows]) + "\n")
    fit_facial_color(
        [tmp_path / "session-face"],
        out=tmp_path / "moving",
        landmarks=marks,
        calibration=tmp_path / "calibration",
    )
    (part,) = describe_parts(store.read(tmp_path / "moving")).values()
    assert part["source"] == "measured"
    refused_beyond(tmp_path / "moving", tmp_path, "metahuman")


def test_an_edited_face_leaves_within_the_consent_alone(dome, tmp_path):
    order = editing.EditRequest(traits={}, spots=(SpotRequest("freckles", 1.0, 3.0),))
    editing.edit_folder(dome("dome"), order, out=tmp_path / "edited")
    assert store.read(tmp_path / "edited").parameters["edit"]["spots"]
    refused_beyond(tmp_path / "edited", tmp_path, "mtlx")


@pytest.mark.long
def test_traits_carry_consent_of_their_training_subjects(tmp_path, dome_faces):
    """Traits of measured faces on a simulated one: the people behind them are asked for, too."""
    paths, labels = dome_faces.population(tmp_path)
    target = paths[0]
    for k, path in enumerate(paths[1:]):
        one = store.read(path)
        record = {**NARROW, "pseudonym": f"P{k:03d}"}
        store.write(
            path,
            dataclasses.replace(
                one, source="measured", parameters={**one.parameters, consent.CONSENT_KEY: [record]}
            ),
        )
    space = tmp_path / "traits.npz"
    argv = ["fit", "traits", *map(str, paths), "--labels", str(labels), "--out", str(space)]
    assert main(argv) == 0
    learned = consent.read_consent(load(space))
    assert [one["pseudonym"] for one in learned] == [f"P{k:03d}" for k in range(len(paths) - 1)]
    edit = ["edit", str(target), "--space", str(space), "--out"]
    assert main([*edit, str(tmp_path / "tanned"), "--trait", "tan=0.5"]) == 0
    assert consent.read_consent(store.read(tmp_path / "tanned")) == learned
    with pytest.raises(ConsentError, match="P000 has not agreed"):
        export(tmp_path / "tanned", tmp_path / "out", to="maps", use="film", today=DAY)
    # an edit that takes nothing of them owes them nothing
    assert main([*edit, str(tmp_path / "same"), "--trait", "tan=0"]) == 0
    assert consent.read_consent(store.read(tmp_path / "same")) == []


@pytest.mark.long
def test_page_of_measured_face_reports_subject_consent(dome, tmp_path):
    from skinrig.viewer import faces, packing

    scene = faces.build_scene([dome("dome")], size=64)
    assert scene.provenance[consent.CONSENT_KEY] == ["P042: research, until 2030-01-01"]
    assert packing.pack(scene).header["provenance"][consent.CONSENT_KEY] == list(
        scene.provenance[consent.CONSENT_KEY]
    )


@pytest.mark.long
def test_page_of_simulated_face_names_no_subject(face_folder):
    from skinrig.viewer import faces

    assert consent.CONSENT_KEY not in faces.build_scene([face_folder], size=64).provenance


def consent_of(html):
    """Return the section of a report, empty where it has none."""
    found = re.search(r"<h2[^>]*>Consent</h2>.*?</section>", html, re.DOTALL)
    return found.group() if found else ""


@pytest.mark.long
def test_report_names_subjects_and_permitted_uses(dome, tmp_path):
    shown = tmp_path / "shown"
    shown.mkdir()
    dome("shown/monday")
    dome("shown/other", OTHER)
    (shown / "pictures").mkdir()
    (shown / "pictures" / "render.json").write_text(
        json.dumps({"schema": "skinrig.render/1", consent.CONSENT_KEY: [NARROW]})
    )
    html = report.build([shown])
    section = consent_of(html)
    assert "P042" in section
    assert "research, until 2030-01-01" in section
    assert "monday, pictures" in section
    assert "teaching" in section
    assert report.build([shown]) == html
    both = report.build_any([shown / "monday", shown / "other"])
    assert both.compared is not None
    assert "research, until 2030-01-01" in consent_of(both.html)


def test_a_report_of_simulations_has_no_such_section(face_folder):
    assert consent_of(report.build([face_folder])) == ""


def test_a_report_on_a_session_names_its_subject(tmp_path):
    from skinrig.reporting.folders import ReportInputs

    for name, source in (("measured", "measured"), ("simulated", "simulated")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "session.json").write_text(
            json.dumps({"source": source, "subject": NARROW})
        )
    found = ReportInputs(sessions=[tmp_path / "measured", tmp_path / "simulated"])
    assert [(folder.name, one) for folder, one in provenance.read_consent_records(found)] == [
        ("measured", NARROW)
    ]


def test_rendering_carries_consent_of_shown_subject(dome):
    from skinrig.rendering.figures import RenderModel as Rendered

    assert Rendered.of(dome("dome")).record()[consent.CONSENT_KEY] == [NARROW]
