"""The probe is simulated on its phantom, captured through its driver and calibrated."""

import json

import numpy as np
import pytest

from capture.calibration.fiber.probe_calibration import FiberCalibration
from capture.session import Session
from rigsim.as_built.probe import build_probe
from skinrig.cli import main
from skinrig.simulating.simulation import simulate_session

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]


def document(capsys):
    return json.loads(capsys.readouterr().out.strip().splitlines()[-1])


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    out = tmp_path_factory.mktemp("probe") / "phantom"
    simulate_session("probe", out, target="phantom", seed=3)
    return out


def test_a_probe_is_calibrated_from_its_phantom(phantom, tmp_path, capsys):
    out = tmp_path / "calibration"
    assert main(["calibrate", "fiber", str(phantom), "--out", str(out), "--json"]) == 0
    said = document(capsys)
    assert said["values"]["spots found"].startswith("28 of 28")
    assert said["values"]["dead fibers"] == "none"
    assert all("no sensor calibration" in text for text in said["findings"])

    rig = Session.open(phantom).rig
    built = build_probe(rig, seed=0)
    known = FiberCalibration.load(out, rig)
    assert known.valid.all()
    away = (known.spots.center_px - built.spot_px) / known.spots.center_stderr_px
    assert np.abs(away).max() < 5  # of 56: once in 30,000
    # gains over the built ones fall off with the lens's shading, which is smooth along the row
    ratio = known.gain[:, 1] / built.gain
    place = np.linspace(-1, 1, 28)
    smooth = np.polyval(np.polyfit(place, ratio, 4), place)
    scatter = (ratio / smooth - 1).std()
    assert scatter < 0.01
    assert (built.gain / built.gain.mean()).std() > 3 * scatter  # the gains do differ
    # cross-talk between neighbors, with the light of the lens's wings on top
    leak = np.diagonal(known.crosstalk.matrix, 1)
    assert np.corrcoef(leak, np.diagonal(built.crosstalk, 1))[0, 1] > 0.9
    assert known.crosstalk.cover_leak == pytest.approx(built.cover_leak, rel=0.2)


def test_wrong_certificate_and_wrong_session_are_reported(phantom, tmp_path, capsys):
    paper = tmp_path / "block.json"
    paper.write_text('{"schema": "skinrig.phantom/1", "eta": 1.4}')
    arguments = ["calibrate", "fiber", str(phantom), "--out", str(tmp_path / "c")]
    assert main([*arguments, "--phantom", str(paper)]) == 3
    assert "sigma_a_per_mm" in capsys.readouterr().err
    assert main(["calibrate", "fiber", str(phantom), str(phantom), "--out", str(tmp_path)]) == 3
    assert "expected one" in capsys.readouterr().err


def test_a_session_without_a_phantom_is_refused(tmp_path, capsys):
    dark = tmp_path / "dark"
    simulate_session("probe", dark, target="dark", seed=3)
    assert main(["calibrate", "fiber", str(dark), "--out", str(tmp_path / "c")]) == 3
    assert "no frames of kind 'phantom'" in capsys.readouterr().err
