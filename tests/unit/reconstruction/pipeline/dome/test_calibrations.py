"""Gaps in a calibration of the dome's lights are reported, and never used as values."""

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
from reconstruction.pipeline.inputs import Inputs

RIG = load_rig("dome").subset(lights=["L000", "L001"], views=["C00"]).resized(24)
TODAY = date(2026, 11, 21)


@pytest.fixture
def session(tmp_path):
    view = RIG.views[0]
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
        rig=RIG,
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
