"""Calibrations in the report: as old as they were at capture, expired ones missed."""

import hashlib
import json
from datetime import date

import numpy as np
import pytest

from capture.calibration import store as calibrations
from capture.calibration.record import Calibration, Quantity
from model import store
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig.reporting import report


def write_run(folder, *, captured="2026-03-10", valid_until=date(2026, 6, 1), worst=0.3):
    """Write a calibration of two cameras, a session of a day, and maps made by both."""
    calibration = folder / "calibration"
    values = {
        serial: {"reprojection_px": Quantity(np.array(px), stderr=np.array(0.02))}
        for serial, px in (("C1", 0.1), ("C2", worst))
    }
    calibrations.save(
        Calibration(
            "geometry", "dome", ("C1", "C2"), date(2026, 3, 1), valid_until, "simulated", values
        ),
        calibration,
    )
    session = folder / "session"
    (session / "frames").mkdir(parents=True)
    (session / "session.json").write_text(
        json.dumps(
            {
                "plan": {"rig": "dome"},
                "created_at": f"{captured}T10:00:00+00:00",
                "source": "simulated",
                "seed": 0,
            }
        )
    )
    digest = hashlib.sha256((calibration / "geometry.json").read_bytes()).hexdigest()
    store.write(
        folder / "maps",
        SkinAppearance(
            {"melanin": SkinMap(np.full((4, 4), 0.1), MAP_UNITS["melanin"])},
            "simulated",
            parameters={"session": "session"},
            inputs={"calibration geometry": digest},
        ),
    )
    return folder


def test_calibration_age_is_age_at_capture(tmp_path):
    html = report.build([write_run(tmp_path)])
    assert "The only check kept its limit" in html
    assert "valid, 83 days left" in html  # 10 March to 1 June
    assert ">9<" in html  # days from 1 to 10 March
    assert "none beyond noise" in html


@pytest.mark.parametrize("captured", ["2026-06-02", "2026-02-28"])
def test_calibration_not_in_force_is_missed_check(tmp_path, captured):
    html = report.build([write_run(tmp_path, captured=captured)])
    assert "1 of 1 checks missed" in html
    assert "not valid at capture" in html


def test_the_worst_device_is_named(tmp_path):
    html = report.build([write_run(tmp_path)])
    row = html[html.index("reprojection error</td>") :]
    assert row.index("C2") < row.index("</tr>")
    assert "0.3" in row[: row.index("</tr>")]


def test_damaged_calibration_is_missed_and_rest_shown(tmp_path):
    path = write_run(tmp_path) / "calibration" / "geometry.json"
    path.write_text(path.read_text().replace("0.1", "0.2"))
    html = report.build([tmp_path])
    assert "1 of 1 checks missed" in html
    assert "melanin" in html


def test_without_a_session_no_age_is_claimed(tmp_path):
    folder = write_run(tmp_path)
    (folder / "session" / "session.json").unlink()
    html = report.build([folder])
    assert "date of use unknown" in html
    assert "No limit was checked" in html


@pytest.mark.parametrize("given", ["folder", "file by file"])
def test_calibration_is_identified_by_contents_not_folder_name(tmp_path, given):
    folder = write_run(tmp_path)
    (folder / "calibration").rename(folder / "mine")
    places = [folder] if given == "folder" else [folder / "maps", folder / "mine"]
    html = report.build([*places, folder / "session"])
    assert "valid, 83 days left" in html
    assert ">skinrig.calibration/2<" not in html
