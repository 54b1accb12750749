"""Exports: within the consent, sealed as archives expect, readable by the programs they are for."""

import json
import subprocess
import sys
from datetime import date

import numpy as np
import pytest

from capture import raw
from capture.plan import flash_plan
from capture.rig import load_rig
from capture.session import ConsentError, Session, SessionDamage, SubjectRecord, verify
from capture.session.mhl import c4_id
from skinrig.cli import main
from skinrig.exporting.export import export
from skinrig.exporting.options import ExportError

RIG = load_rig("flash").resized(16)
DAY = date(2030, 1, 1)
MHL = "{urn:ASC:MHL:v2.0}"


@pytest.fixture
def session(tmp_path):
    """Two darks and a pair of images; one frame is a second attempt."""
    with Session.create(
        tmp_path / "s",
        plan=flash_plan(RIG, darks=2),
        rig=RIG,
        devices={},
        subject=SubjectRecord("P042", ("research",), DAY),
        source="measured",
    ) as made:
        for number, (step, camera) in enumerate(made.pending_frames()):
            for attempt in (1, 2) if step.id == "S001" else (1,):
                blob = raw.encode_dng(
                    np.full((10, 16), 600 + number, np.uint16),
                    pattern="RGGB",
                    black=512,
                    white=16383,
                    step_id=step.id,
                    session_id=made.id,
                )
                made.commit(
                    step.id,
                    camera,
                    blob,
                    settings=step.settings,
                    t_host_s=100.0 + number,
                    actual={"light": "flash", "iso": 100},
                    attempt=attempt,
                )
        made.attach("notes.txt", b"a note", about={})
        made.close()
    return tmp_path / "s"


@pytest.mark.parametrize("to", ["mhl", "frames", "event-model"])
def test_export_requires_subject_consent_and_valid_date(session, tmp_path, to):
    out = tmp_path / "out"
    for use, today in (("publication", DAY), ("research", date(2030, 1, 2)), ("any", DAY)):
        with pytest.raises(ConsentError, match="has not agreed"):
            export(session, out, to=to, use=use, today=today)
    assert not out.exists()
    assert export(session, out, to=to, use="research", today=DAY).path == out
    assert [path for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_consent_is_asked_for_at_the_command_line(session, tmp_path, capsys):
    argv = ["export", str(session), "--to", "frames", "--out", str(tmp_path / "out"), "--use"]
    assert main([*argv, "publication"]) == 3
    assert "has not agreed to this use" in capsys.readouterr().err
    assert main([*argv, "research", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["files"] == 4


def test_exported_session_contains_all_committed_data(session, tmp_path):
    export(session, tmp_path / "out", to="mhl", use="research", today=DAY)
    copy = Session.open(tmp_path / "out")
    assert copy.content_hash == Session.open(session).content_hash
    assert verify(tmp_path / "out", today=DAY).warnings == ()
    assert (tmp_path / "out" / "frames" / "S001+cam.dng").exists()  # the first attempt too
    assert copy.attachment("notes.txt") == b"a note"


def test_a_damaged_session_is_not_handed_on(session, tmp_path):
    frame = session / "frames" / "S000+cam.dng"
    blob = bytearray(frame.read_bytes())
    blob[-3] ^= 1
    frame.write_bytes(blob)
    with pytest.raises((ExportError, SessionDamage), match=r"S000\+cam"):
        export(session, tmp_path / "out", to="frames", use="research", today=DAY)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s"]


def test_existing_folder_or_unknown_format_is_refused(session, tmp_path):
    with pytest.raises(ExportError, match="exists"):
        export(session, session, to="frames", use="research", today=DAY)
    with pytest.raises(ExportError, match="mhl, frames, event-model"):
        export(session, tmp_path / "out", to="zip", use="research", today=DAY)


# ASC MHL --------------------------------------------------------------------------------------


def test_c4_id_matches_published_value():
    """The ID of no bytes at all, as SMPTE ST 2114 lists it."""
    expected = (
        "c459dsjfscH38cYeXXYogktxf4Cd9ibshE3BHUo6a58hBXmRQdZrAkZzsWcbWtDg5oQstpDuni4Hirj75GEmTc1sFT"
    )
    assert c4_id(b"") == expected
    assert len(c4_id(b"skinrig")) == 90


def ascmhl(*argv):
    return subprocess.run(
        [sys.executable, "-c", "from ascmhl.cli.ascmhl import mhltool_cli as m; m()", *argv],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_reference_tool_verifies_export_and_names_changes(session, tmp_path):
    pytest.importorskip("ascmhl")
    out = tmp_path / "delivery"
    export(session, out, to="mhl", use="research", today=DAY)
    whole = ascmhl("diff", str(out))
    assert whole.returncode == 0, whole.stdout + whole.stderr
    again = ascmhl("create", "-v", "-h", "xxh128", str(out))
    assert again.returncode == 0, again.stdout + again.stderr
    verified = [line for line in again.stdout.splitlines() if line.split()[:1] == ["verified"]]
    assert len(verified) == 8  # manifest, journal, five frames, an attachment
    frame = out / "frames" / "S000+cam.dng"
    blob = bytearray(frame.read_bytes())
    blob[-3] ^= 1
    frame.write_bytes(blob)
    changed = ascmhl("create", "-h", "xxh128", str(out))
    assert changed.returncode != 0
    assert "S000+cam.dng" in changed.stdout + changed.stderr


def test_sealed_folder_names_no_host_sealed_only_once(session, tmp_path):
    import platform

    from capture.session import SessionError
    from capture.session.mhl import write_first_generation

    done = export(session, tmp_path / "out", to="frames", use="research", today=DAY)
    text = done.manifest.read_text()
    assert str(tmp_path) not in text
    assert f"<hostname>{platform.node()}<" not in text
    with pytest.raises(SessionError, match="a history"):
        write_first_generation(
            tmp_path / "out", now=Session.open(session).manifest.created_at, version="0"
        )


# event model ----------------------------------------------------------------------------------


@pytest.fixture
def exported(session, tmp_path):
    export(session, tmp_path / "out", to="event-model", use="research", today=DAY)
    lines = (tmp_path / "out" / "documents.jsonl").read_text().splitlines()
    return tmp_path / "out", [tuple(json.loads(line)) for line in lines]


def test_documents_fit_the_schemas_of_the_event_model(exported):
    event_model = pytest.importorskip("event_model")
    for name, document in exported[1]:
        kind = event_model.DocumentNames[name]
        event_model.schema_validators[kind].validate(document)


def test_run_router_assigns_every_document_to_its_run(exported):
    event_model = pytest.importorskip("event_model")
    seen = []

    class Gather(event_model.SingleRunDocumentRouter):
        def event(self, doc):
            stream = self.get_stream_name(doc)
            seen.append((stream, doc["data"]["step"], doc["seq_num"]))

    gather = Gather()
    for name, document in exported[1]:
        gather(name, document)
    assert seen == [
        ("dark-cam", "D000", 1),
        ("dark-cam", "D001", 2),
        ("subject-cam", "S000", 1),
        ("subject-cam", "S001", 2),
    ]


def test_every_event_refers_to_exported_frame(exported):
    out, documents = exported
    by_name = {}
    for name, document in documents:
        by_name.setdefault(name, []).append(document)
    (start,), (resource,), (stop,) = (by_name[name] for name in ("start", "resource", "stop"))
    assert (start["sample"], start["consent_scope"]) == ("P042", ["research"])
    assert (stop["exit_status"], stop["num_events"]) == (
        "success",
        {"dark-cam": 2, "subject-cam": 2},
    )
    files = {d["datum_id"]: d["datum_kwargs"]["file"] for d in by_name["datum"]}
    for event in by_name["event"]:
        file = out / resource["resource_path"] / files[event["data"]["cam_image"]]
        assert raw.read(file).step_id == event["data"]["step"]
    assert [event["data"]["attempt"] for event in by_name["event"]] == [1, 1, 1, 2]


def test_run_lacking_frames_reports_missing_frames(session, tmp_path):
    unfinished = Session.create(
        tmp_path / "t",
        plan=flash_plan(RIG),
        rig=RIG,
        devices={},
        subject=SubjectRecord("x", ("any",)),
        source="simulated",
    )
    unfinished.release()
    export(tmp_path / "t", tmp_path / "out", to="event-model", use="teaching")
    name, stop = json.loads((tmp_path / "out/documents.jsonl").read_text().splitlines()[-1])
    assert (name, stop["exit_status"]) == ("stop", "abort")
    assert "6 frames" in stop["reason"]
