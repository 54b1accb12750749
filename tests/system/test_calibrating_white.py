"""A white reference is of a white tile: other sessions are refused, with one clear error."""

import numpy as np
import pytest
from PIL import Image

from skinrig.calibrating import white_reference
from skinrig.cli import main
from skinrig.simulating.simulation import simulate_session

pytestmark = pytest.mark.render


@pytest.mark.long
@pytest.mark.parametrize("subject", ["palest", "IV"])
def test_a_face_makes_no_white_reference(subject, tmp_path, capsys):
    simulate_session("flash", tmp_path / "face", subject=subject, width_px=96)
    calibration = tmp_path / "calibration"
    assert main(["calibrate", "white", str(tmp_path / "face"), "--out", str(calibration)]) == 3
    said = capsys.readouterr().err
    assert "frame S001 of state 'neutral' does not show a white reference" in said
    assert not calibration.exists()


def test_small_simulated_white_reference_works_partial_is_reported(tmp_path, capsys, monkeypatch):
    simulate_session("flash", tmp_path / "tile", target="white", width_px=96)
    (tmp_path / "photographs").mkdir()
    (tmp_path / "photographs" / "session.json").write_text('{"rig": {"name": "imported"}}')
    calibration = tmp_path / "calibration"
    command = ["calibrate", "white", str(tmp_path / "tile"), "--out", str(calibration)]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "found:" not in said
    assert "usable, no finding; valid until" in said
    assert "next:" not in said  # no session of skin of this rig is near
    assert (calibration / "white.json").exists()
    monkeypatch.setattr(white_reference, "even_fraction", lambda rgb, valid: 0.9)
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "found: frame S001 of state 'white': 90 % of the image is even" in said
    assert f"check {said.count('found:')} findings before use" in said
    monkeypatch.setattr(white_reference, "even_fraction", lambda rgb, valid: 0.3)
    assert main(command) == 3
    assert "does not show a white reference: 30 %" in capsys.readouterr().err


def test_imported_photographs_lack_power_required_for_white_reference(tmp_path, capsys):
    (tmp_path / "photos").mkdir()
    Image.fromarray(np.full((32, 48, 3), 128, np.uint8)).save(tmp_path / "photos" / "tile.jpg")
    session, calibration = tmp_path / "session", tmp_path / "calibration"
    assert main(["import", "photos", str(tmp_path / "photos"), "--out", str(session)]) == 0
    assert main(["calibrate", "white", str(session), "--out", str(calibration)]) == 3
    said = capsys.readouterr().err
    assert "frame P000 of rig 'imported' lacks its power" in said
    assert "defect of skinrig" not in said
