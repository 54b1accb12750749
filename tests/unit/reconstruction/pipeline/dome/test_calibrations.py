"""Calibrations of the dome: gaps are reported, and all that a stage uses is part of its key."""

from datetime import UTC, date, datetime

import numpy as np
import pytest

from capture import raw
from capture.calibration import store
from capture.calibration.lights.light_list import LightTable
from capture.plan import Plan, Step
from capture.rig import load_rig
from capture.session import Session, SubjectRecord
from reconstruction.pipeline.dome import stages as dome_stages
from reconstruction.pipeline.dome import stripes
from reconstruction.pipeline.graph import input_hashes, order_stages
from reconstruction.pipeline.inputs import DomeOptions, Inputs

RIG = load_rig("dome").subset(lights=["L000", "L001"], views=["C00"]).resized(24)
TODAY = date(2026, 11, 21)


@pytest.fixture
def session(tmp_path):
    return capture_session(tmp_path, RIG)


def capture_session(tmp_path, rig):
    view = rig.views[0]
    steps = tuple(
        Step(
            f"O{light.name}",
            "olat",
            {"light": light.name, "exposure": 0, "pass": 0},
            {"light": light.name, "exposure_s": 0.06, "level": 1.0},
            ("C00",),
        )
        for light in RIG.lights
    )
    with Session.create(
        tmp_path / "session",
        plan=Plan("dome", steps),
        rig=rig,
        devices={},
        subject=SubjectRecord("P1", ("research",)),
        source="simulated",
        seed=0,
        now=lambda: datetime(2026, 11, 21, tzinfo=UTC),
    ) as session:
        for step in steps:
            blob = raw.encode_dng(
                np.full((view.height_px, view.width_px), 900, np.uint16),
                pattern=view.cfa,
                black=view.black_level,
                white=view.white_level,
                exposure_s=0.06,
                camera_serial=view.serial,
                step_id=step.id,
                session_id=session.id,
            )
            session.commit(step.id, "C00", blob, settings=step.settings, actual={}, t_host_s=2.0)
        session.close()
    return Session.open(tmp_path / "session")


def evidence_with(session, folder, notes):
    table = LightTable.nominal(RIG)
    store.save(
        table.to_calibration(rig="dome", source="simulated", created=TODAY, notes=notes), folder
    )
    return Inputs.of(session, folder, state="neutral", on_date=TODAY)


def albedo_of(evidence):
    """Return why there can be no albedo, known before anything is computed."""
    (stage,) = [s for s in dome_stages.graph(evidence) if s.name == "albedo"]
    return stage.refused


def test_lights_without_measured_strengths_give_no_albedo(session, tmp_path):
    evidence = evidence_with(session, tmp_path / "c", {"intensities": "nominal and relative"})
    assert "the lights are not calibrated" in albedo_of(evidence)
    assert "the lights' intensities are nominal and relative" in evidence.assumed


def test_unmeasured_light_positions_are_reported_as_assumed(session, tmp_path):
    evidence = evidence_with(session, tmp_path / "c", {"positions": "nominal"})
    assert not albedo_of(evidence)
    assert "the lights' positions are nominal" in evidence.assumed


def test_whole_calibrations_leave_only_the_cameras_to_assume(session, tmp_path):
    evidence = evidence_with(session, tmp_path / "c", {})
    assert not albedo_of(evidence)
    assert evidence.assumed == ["the cameras have the nominal poses of the rig file"]


def test_stage_keys_depend_on_scanner_calibration(tmp_path, monkeypatch):
    rig = RIG.with_scanner()
    session = capture_session(tmp_path, rig)
    monkeypatch.setattr(dome_stages, "has_stripes", lambda session: True)
    monkeypatch.setattr(stripes, "poses_from_calibration", lambda *_: {})
    scanner = rig.scanner
    serials = [view.serial for view in scanner.views]
    serials += [projector.pinhole.serial for projector in scanner.projectors]

    def surface_key(depth_stderr_mm):
        if depth_stderr_mm:
            values = {s: {"depth_stderr_mm": store.Quantity(depth_stderr_mm)} for s in serials}
            made = store.Calibration(
                *("scanner", "dome", tuple(serials), TODAY, TODAY, "simulated", values)
            )
            store.save(made, tmp_path / "c")
        inputs = evidence_with(session, tmp_path / "c", {})
        graph = dome_stages.graph(inputs)
        keys = input_hashes(order_stages(graph, ["normals"]))
        # recorded before any stage runs, thus also when the stage is reused
        assert ("calibration scanner" in inputs.hashes) == bool(depth_stderr_mm)
        nominal = "the scanner has the nominal geometry of the rig file"
        assert (nominal in inputs.assumed) == (not depth_stderr_mm)
        return keys["surface"]

    keys = [surface_key(depth) for depth in (0.0, 0.1, 0.1, 0.2)]
    assert keys[1] == keys[2]
    assert len(set(keys)) == 3


def test_lobes_key_depends_on_rank(session):
    def key(rank):
        options = DomeOptions(rank=rank)
        graph = dome_stages.graph(
            Inputs.of(session, None, state="neutral", on_date=TODAY, dome=options)
        )
        return input_hashes(order_stages(graph, ["basis"]))["lobes"]

    assert key(None) == key(4) != key(5)


def test_basis_hash_covers_upper_case_tables(session, tmp_path):
    def digest(content):
        (tmp_path / "tables").mkdir(exist_ok=True)
        (tmp_path / "tables" / "SKIN.BINARY").write_bytes(content)
        options = DomeOptions(basis=tmp_path / "tables")
        return Inputs.of(session, None, state="neutral", dome=options).hashes["basis"]

    assert digest(b"1") != digest(b"2")
