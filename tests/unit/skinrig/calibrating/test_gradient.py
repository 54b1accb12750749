"""Sessions of the gradient sphere give their calibrations, or are refused by name."""

import dataclasses
from datetime import date
from types import SimpleNamespace

import numpy as np
import pytest

from capture.calibration import store
from capture.calibration.sensor.noise_model import SensorCalibration
from capture.raw import RawFrame
from capture.rig import load_rig
from skinrig.calibrating import gradient
from skinrig.calibrating.gradient import calibrate_gradient, has_gradient_session
from skinrig.calibrating.outcome import CalibratingError, TargetSessions

RIG = load_rig("gradient").cropped(128)
MADE = date(2026, 11, 21)
GAIN, READ_E, BLACK, WHITE = 3.35, 13.0, 64, 4095


class Shelf:
    """A session in memory: frames of some kinds with their settings."""

    def __init__(self, rig=RIG, frames=(), name="S"):
        self.rig, self.id, self.content_hash = rig, name, "sha256:0"
        self.source = "simulated"
        self._frames = frames

    def frames(self, kind):
        return [
            SimpleNamespace(kind=k, settings=settings, cfa=cfa)
            for k, settings, cfa in self._frames
            if k == kind
        ]

    def read(self, record):
        return RawFrame(cfa=record.cfa, pattern="MONO", black=(float(BLACK),), white=WHITE)


def exposed(mean_e, rng):
    electrons = rng.poisson(mean_e, (128, 128)) + READ_E * rng.standard_normal((128, 128))
    return np.clip(np.rint(electrons / GAIN) + BLACK, 0, WHITE).astype(np.uint16)


def flats(rng):
    rows = [("dark", {"level": 0.0, "exposure_s": 0.018}, exposed(0.0, rng)) for _ in range(4)]
    for level in (0.05, 0.1, 0.2, 0.4, 0.6, 0.8):
        for _ in range(2):
            rows.append(
                ("flat", {"level": level, "exposure_s": 0.018}, exposed(13000 * level, rng))
            )
    return rows


def test_monochrome_sensor_is_calibrated_by_light_levels(tmp_path, rng):
    made = calibrate_gradient("sensor", TargetSessions([Shelf(frames=flats(rng))], tmp_path, MADE))
    found = SensorCalibration.from_calibration(made.calibration, "SG-0001")
    for quantity, true in ((found.gain_e_per_dn, GAIN), (found.read_noise_e, READ_E)):
        assert abs(quantity.value[0] - true) < 4 * quantity.stderr[0]
        assert quantity.stderr[0] < 0.05 * true
    store.save(made.calibration, tmp_path)
    assert store.load(tmp_path, "sensor").serials == ("SG-0001",)


def test_sessions_without_target_report_how_to_make_one(tmp_path):
    for kind, target in (("lights", "ball"), ("polarization", "ball"), ("sensor", "flat")):
        with pytest.raises(CalibratingError, match=f"--target {target}"):
            calibrate_gradient(kind, TargetSessions([Shelf()], tmp_path, MADE))


def test_unlit_ball_is_not_a_ball(tmp_path):
    dark = {"pattern": "dark", "level": 0.0, "exposure_s": 0.018, "polarizer": "parallel"}
    frames = [("ball", dark, np.full((128, 128), 64, np.uint16))]
    with pytest.raises(CalibratingError, match="level above 0"):
        calibrate_gradient("lights", TargetSessions([Shelf(frames=frames)], tmp_path, MADE))


def test_two_balls_rigs_or_other_kinds_are_refused(tmp_path):
    lit = {"pattern": "full", "level": 0.1, "exposure_s": 0.018, "polarizer": "parallel"}
    frames = [("ball", lit, np.full((128, 128), 64, np.uint16))]
    two = [Shelf(frames=frames, name="A"), Shelf(frames=frames, name="B")]
    with pytest.raises(CalibratingError, match="ball moves"):
        calibrate_gradient("lights", TargetSessions(two, tmp_path, MADE))
    other = Shelf(dataclasses.replace(RIG, name="other"))
    with pytest.raises(CalibratingError, match="expected one rig"):
        calibrate_gradient("lights", TargetSessions([Shelf(), other], tmp_path, MADE))
    with pytest.raises(CalibratingError, match="white"):
        calibrate_gradient("white", TargetSessions([Shelf()], tmp_path, MADE))


def test_lights_and_polarizers_share_one_survey(tmp_path, monkeypatch):
    """The survey of a session is reused; other sessions and callers get their own."""
    surveyed = []

    def survey(sessions):
        surveyed.append(sessions.sessions[0].id)
        raise CalibratingError("surveyed")

    monkeypatch.setattr(gradient, "_survey", survey)
    known = object()
    monkeypatch.setattr(gradient, "number_findings", lambda findings: pytest.fail(str(findings)))
    surveys = {("sha256:0",): (SimpleNamespace(findings=(known,)), ())}
    for kind in ("lights", "polarization"):
        with pytest.raises(pytest.fail.Exception, match=str(known)):
            calibrate_gradient(kind, TargetSessions([Shelf()], tmp_path, MADE), surveys)
    assert not surveyed
    other = Shelf(name="other")
    other.content_hash = "sha256:1"
    for session, given in ((other, surveys), (Shelf(), None)):
        with pytest.raises(CalibratingError, match="surveyed"):
            calibrate_gradient("lights", TargetSessions([session], tmp_path, MADE), given)
    assert surveyed == ["other", "S"]


def test_rig_is_identified_by_its_controller():
    assert has_gradient_session([Shelf()])
    assert not has_gradient_session([Shelf(load_rig("dome")), Shelf(load_rig("flash"))])
