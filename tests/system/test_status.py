"""`skinrig status`: the state of results, and the commands that repeat failed checks."""

import json
from datetime import date, timedelta

import numpy as np
import pytest
from PIL import Image

from capture.session import Session
from model import store
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig.cli import main
from skinrig.reporting import report
from skinrig.reporting.status import read_status

LIMIT = {"name": "median error", "bound": 1.0, "sense": "<=", "unit": "%"}


def write_bench(folder, error):
    limit = LIMIT | {"got": error, "passed": error <= 1.0}
    stage = {"limits": [limit], "points": [], "fronts": {}, "by_band": [], "left_out": []}
    document = {"schema": "skinrig.bench/2", "stages": {"wrinkles": stage}, "left_out": []}
    (folder / "bench.json").write_text(json.dumps(document))


@pytest.fixture
def results(tmp_path):
    """Return a folder with a session of photographs and its maps."""
    photos, folder = tmp_path / "photos", tmp_path / "my results"
    photos.mkdir()
    folder.mkdir()
    pixels = np.random.default_rng(0).integers(40, 200, (32, 48, 3), np.uint8)
    Image.fromarray(pixels).save(photos / "portrait.png")
    assert main(["import", "photos", str(photos), "--out", str(folder / "session")]) == 0
    values = np.full((8, 8), 0.05, np.float32)
    maps = {"melanin": SkinMap(values, MAP_UNITS["melanin"])}
    parameters = {"kind": "appearance", "session": "session", "state": "portrait"}
    store.write(folder / "maps", SkinAppearance(maps, "measured", parameters=parameters))
    return folder


def test_sound_results_and_kept_limits_exit_zero(results, capsys):
    write_bench(results, 0.5)
    assert main(["status", str(results)]) == 0
    text = capsys.readouterr().out
    assert "All 2 results are sound. The only check kept its limit." in text
    assert "missed:" not in text


def test_missed_limit_names_its_command_everywhere(results, tmp_path, capsys):
    write_bench(results, 2.0)
    out = tmp_path / "status.html"
    assert main(["status", str(results), "-o", str(out)]) == 1
    again = "skinrig bench --stage wrinkles"
    said = capsys.readouterr().out
    assert f"missed: wrinkles: median error; repeat in {results}: {again}" in said
    assert again in out.read_text()
    assert str(results) not in out.read_text()  # commands run in the folder
    assert main(["report", str(results), "-o", str(tmp_path / "report.html")]) == 0
    assert f"repeat: {again}" in capsys.readouterr().out
    assert f"repeat: {again}" in (tmp_path / "report.html").read_text()


def test_damaged_frame_is_found_with_verify_command(results, capsys):
    frame = next((results / "session/frames").iterdir())
    frame.write_bytes(frame.read_bytes()[:-1] + b"\0")
    capsys.readouterr()
    assert main(["status", str(results), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    (session,) = (one for one in found["results"] if one["kind"] == "session")
    assert session["state"] == "damaged"
    assert session["command"] == "skinrig verify session"


def test_maps_of_changed_calibration_are_repeated(results):
    appearance = store.read(results / "maps")
    inputs = {"calibration white": "0" * 64, "calibration color": "1" * 64}
    changed = SkinAppearance(
        appearance.maps, "measured", parameters=appearance.parameters, inputs=inputs
    )
    store.write(results / "maps", changed)

    def state():
        status = read_status(results, today=date.today())
        return next(one for one in status.results if one.kind == "maps")

    assert state().state == "up to date"  # none of its calibrations is nearby
    assert Session.open(results / "session").manifest
    write_calibration(results / "calibration", inputs)
    found = state()
    assert found.state == "out of date"
    assert found.command == (
        "skinrig reconstruct session --maps melanin --calibration calibration --state portrait"
        " --out maps"
    )


def write_calibration(folder, inputs):
    """Write one document, and let the maps name its digest as their color calibration."""
    from capture.calibration import store as calibrations
    from capture.calibration.record import Calibration
    from skinrig.appearances.contents import hash_file

    day = date.today()
    calibrations.save(
        Calibration("color", "flash", ("cam",), day, day + timedelta(days=5), "measured", {}),
        folder,
    )
    inputs["calibration color"] = hash_file(folder / "color.json")
    maps = store.read(folder.parent / "maps")
    parameters = maps.parameters
    store.write(
        folder.parent / "maps",
        SkinAppearance(maps.maps, "measured", parameters=parameters, inputs=inputs),
    )


def test_missing_folder_is_refused(tmp_path, capsys):
    assert main(["status", str(tmp_path / "none")]) == 3
    assert "does not exist" in capsys.readouterr().err
    with pytest.raises(report.ReportError):
        read_status(tmp_path / "none", today=date.today())
