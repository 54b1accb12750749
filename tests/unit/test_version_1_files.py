"""Files of version 1 of the formats, written by an earlier program, are read as those of today.

``tests/data/version-1.zip`` holds what that program wrote: a flash session with its maps, an
unfinished probe session with omitted steps and an attachment, a calibration, a plan and a rig.
"""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from capture import raw
from capture.calibration import store as calibrations
from capture.plan import Plan, PlanError
from capture.rig import load_rig
from capture.session import Session, SessionError, verify
from model import store
from skinrig.cli import main

WRITTEN = Path(__file__).parents[1] / "data" / "version-1.zip"


@pytest.fixture
def folder(tmp_path):
    with zipfile.ZipFile(WRITTEN) as archive:
        archive.extractall(tmp_path)
    return tmp_path


def test_flash_session_verifies_and_its_maps_match(folder):
    session = folder / "session-flash"
    assert verify(session).ok
    out = folder / "again"
    assert main(["reconstruct", str(session), "--maps", "melanin,image", "--out", str(out)]) == 0
    old, new = store.read(folder / "appearance-flash"), store.read(out)
    assert {"image", "specular_image", "melanin"} <= set(old.maps) <= set(new.maps)
    np.testing.assert_array_equal(old.maps["image"].values, new.maps["image"].values)


def test_former_map_name_is_accepted_with_notice(folder, capsys):
    words = ("reconstruct", str(folder / "session-flash"), "--maps", "picture", "--out")
    assert main([*words, str(folder / "again")]) == 0
    assert "picture is now image" in capsys.readouterr().err
    assert "image" in store.read(folder / "again").maps


def test_probe_session_has_present_names(folder):
    session = Session.open(folder / "session-probe")
    assert {step.kind for step in session.plan.steps} == {"fibers", "mask"}
    (record,) = session.frames("mask")
    assert (record.settings["fiber"], record.actual["fiber"]) == (0, 0)
    assert set(session.omitted_steps()) == {"cheek-r0-a000-b01", "cheek-r0-a000-b02"}
    assert session.attachments() == ("note.txt",)
    assert verify(folder / "session-probe").ok


def test_unfinished_session_is_resumed_and_closed(folder):
    with Session.resume(folder / "session-probe") as session:
        for step, camera in session.pending_frames():
            blob = raw.encode_dng(
                np.full((10, 16), 512, np.uint16),
                pattern="RGGB",
                black=512,
                white=16383,
                step_id=step.id,
                session_id=session.id,
            )
            session.commit(step.id, camera, blob, settings=step.settings, actual={}, t_host_s=2.0)
        session.close()
    report = verify(folder / "session-probe")
    assert report.ok
    assert Session.open(folder / "session-probe").closed


def test_plan_rig_and_calibration_have_present_names(folder):
    plan = Plan.from_json((folder / "plan-probe.json").read_bytes())
    assert plan == Session.open(folder / "session-probe").plan
    assert load_rig(folder / "rig-probe.toml").probe == load_rig("probe").probe
    found = calibrations.load(folder / "calibration", "fiber")
    assert (found.kind, float(found.values["SP-0001"]["gain"].value)) == ("fiber", 0.98)
    turned = calibrations.load(folder / "calibration", "polarization").values["SIM-FLASH"]
    assert float(turned["analyzer_zero_rad"].value) == 0.01
    rig = Session.open(folder / "session-flash").rig
    assert rig.views[0].analyzer_axis_deg == load_rig("flash").views[0].analyzer_axis_deg


def test_name_in_both_spellings_is_refused(folder):
    plan = json.loads((folder / "plan-probe.json").read_bytes())
    (step,) = (s for s in plan["steps"] if s["id"] == "mask-f01-b0")
    step["settings"]["fiber"] = 0
    with pytest.raises(PlanError, match=r"settings\.fibre"):
        Plan.from_json(plan)


@pytest.mark.parametrize("depth", [300, 480, 900])
def test_deeply_nested_plan_is_refused_by_name(depth):
    nested = []
    for _ in range(depth):
        nested = [nested]
    with pytest.raises(PlanError):
        Plan.from_json({"rig": "probe", "steps": nested})


@pytest.mark.parametrize("part", ["session-flash/session.json", "appearance-flash/appearance.json"])
def test_changed_file_of_version_1_is_refused(folder, part):
    path = folder / part
    path.write_bytes(path.read_bytes().replace(b'"simulated"', b'"measured"', 1))
    read = Session.open if "session" in part else store.read
    with pytest.raises((SessionError, store.StoreError)):
        read(path.parent)


def test_present_version_is_written(folder):
    out = folder / "copy"
    store.write(out, store.read(folder / "appearance-flash"))
    document = json.loads((out / "appearance.json").read_text())
    assert document["schema"] == store.SCHEMA == "skinrig.appearance/2"
    assert "image" in document["maps"]
    assert (out / "image.exr").is_file()
