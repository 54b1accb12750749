"""`skinrig status`: the state of results, and the commands that repeat failed checks."""

import json
import shlex
import shutil
from dataclasses import replace
from datetime import date, timedelta
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from capture.calibration import store as calibrations
from capture.calibration.record import Calibration
from capture.session import Session
from model import store
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig.appearances.contents import hash_file
from skinrig.cli import main
from skinrig.reporting import report
from skinrig.reporting.folders import discover
from skinrig.reporting.repeating import repeat_maps
from skinrig.reporting.status import read_status

LIMIT = {"name": "median error", "bound": 1.0, "sense": "<=", "unit": "%"}
EXPIRY = date(2090, 1, 31)


def write_bench(folder, error):
    limit = LIMIT | {"got": error, "passed": error <= 1.0}
    stage = {"limits": [limit], "points": [], "fronts": {}, "by_band": [], "left_out": []}
    document = {"schema": "skinrig.bench/2", "stages": {"wrinkles": stage}, "left_out": []}
    (folder / "bench.json").write_text(json.dumps(document))


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Return a session of one photograph of a person whose consent ends at EXPIRY."""
    folder = tmp_path_factory.mktemp("photos")
    pixels = np.random.default_rng(0).integers(40, 200, (32, 48, 3), np.uint8)
    Image.fromarray(pixels).save(folder / "portrait.png")
    options = ["--subject", "P1", "--consent", "research", "--consent-expires", str(EXPIRY)]
    out = folder / "session"
    assert main(["import", "photos", str(folder), *options, "--out", str(out)]) == 0
    return out


@pytest.fixture
def results(tmp_path, session):
    """Return a folder with a session of photographs and its maps."""
    folder = tmp_path / "my results"
    shutil.copytree(session, folder / "session")
    write_maps(folder)
    return folder


def write_maps(folder, *, names=("melanin",), inputs=None, **parameters):
    """Write maps as `skinrig reconstruct` does, with calibrations among their inputs."""
    maps = {
        name: SkinMap(np.full((8, 8), 0.05, np.float32), MAP_UNITS.get(name, "1")) for name in names
    }
    about = {"kind": "appearance", "session": "session", "state": "neutral", **parameters}
    made_of = {"session": Session.open(folder / "session").content_hash, **(inputs or {})}
    store.write(folder / "maps", SkinAppearance(maps, "measured", parameters=about, inputs=made_of))


def write_calibration(folder, kind="color", rig="imported", made_days=0):
    """Write a calibration made some days from today; return its digest."""
    day = date.today() + timedelta(days=made_days)
    until = day + timedelta(days=5)
    calibrations.save(Calibration(kind, rig, ("cam",), day, until, "measured", {}), folder)
    return hash_file(folder / f"{kind}.json")


def state_of(folder, kind, today=None):
    found = read_status(folder, today=today or date.today())
    return next(one for one in found.results if one.kind == kind)


def test_sound_results_and_kept_limits_exit_zero(results, capsys):
    write_bench(results, 0.5)
    assert main(["status", str(results)]) == 0
    said = capsys.readouterr()
    assert "0 faults in 2 results. The only check kept its limit." in said.out
    assert "missed:" not in said.out
    assert "read result 1/3" in said.err


def test_missed_limit_names_its_command_everywhere(results, tmp_path, capsys):
    write_bench(results, 2.0)
    out = tmp_path / "status.html"
    assert main(["status", str(results), "-o", str(out)]) == 1
    again = "skinrig bench --stage wrinkles"
    line = f"missed: wrinkles: median error; repeat: {again}"
    assert line in capsys.readouterr().out
    assert again in out.read_text()
    assert main(["report", str(results), "-o", str(tmp_path / "report.html")]) == 0
    assert line in capsys.readouterr().out
    assert f"repeat: {again}" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    ("file", "kind"),
    [
        ("session/frames/*", "session"),
        ("session/session.json", "session"),
        ("maps/melanin.exr", "maps"),
        ("maps/appearance.json", "maps"),
        ("truth/melanin.exr", "ground truth"),
        ("bench.json", "document"),
    ],
)
def test_truncated_file_leaves_the_other_states(results, file, kind, capsys):
    write_bench(results, 0.5)
    shutil.copytree(results / "maps", results / "truth")
    truth = store.read(results / "truth")
    store.write(results / "truth", replace(truth, parameters={"kind": "truth"}))
    (path,) = results.glob(file)
    path.write_bytes(path.read_bytes()[:-40])
    capsys.readouterr()
    assert main(["status", str(results), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)["results"]
    (fault,) = (one for one in found if one["state"] not in ("sound", "up to date"))
    assert (fault["kind"], fault["state"], fault["command"]) == (kind, "damaged", "")
    assert path.name in fault["detail"]
    assert "\n" not in fault["detail"]
    assert len({"session", "maps"} & {one["kind"] for one in found}) == 2


def test_report_names_truncated_session(results, tmp_path, capsys):
    path = results / "session/session.json"
    path.write_bytes(path.read_bytes()[:-40])
    assert main(["report", str(results), "-o", str(tmp_path / "report.html")]) == 3
    assert f"{path}: is not JSON" in capsys.readouterr().err


def test_session_without_end_is_incomplete(results):
    journal = results / "session/journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join(lines[:-2]))
    for frame in (results / "session/frames").iterdir():
        frame.unlink()
    found = state_of(results, "session")
    assert (found.state, found.command) == ("incomplete", "")
    assert "1 frame of the plan missing; not closed" in found.detail


@pytest.mark.parametrize(("days", "state"), [(0, "sound"), (1, "consent expired")])
def test_consent_is_judged_on_the_day(results, days, state):
    found = state_of(results, "session", EXPIRY + timedelta(days=days))
    assert found.state == state


def test_calibration_is_judged_at_capture(results):
    used = write_calibration(results / "calibration", made_days=-1)
    write_maps(results, inputs={"calibration color": used})
    found = state_of(results, "calibration", date.today() + timedelta(days=100))
    assert found.state == "valid"
    assert "capture its target again" in found.detail
    used = write_calibration(results / "calibration", made_days=-30)
    write_maps(results, inputs={"calibration color": used})
    found = state_of(results, "calibration")
    assert (found.state, found.command) == ("not valid at capture", "")
    status = read_status(results, today=date.today())
    assert [(one.got < 0, one.command) for one in status.missed] == [(True, "")]


def test_maps_of_changed_calibrations_are_repeated(results):
    """Also if all of them have changed; other rigs and absent folders do not count."""
    old = {"calibration white": "0" * 64, "calibration color": "1" * 64}
    write_maps(results, inputs=old)
    assert state_of(results, "maps").state == "up to date"  # none of its calibrations is nearby
    for kind in ("white", "color"):
        write_calibration(results / "calibration-dome", kind, rig="dome")
    assert state_of(results, "maps").state == "up to date"
    for kind in ("white", "color"):
        write_calibration(results / "calibration", kind)
    found = state_of(results, "maps")
    assert found.state == "out of date"
    assert found.detail.endswith("another calibration: color, white")
    paths = [results / name for name in ("session", "calibration", "maps")]
    session, calibration, maps = (shlex.quote(str(path)) for path in paths)
    assert found.command == (
        f"skinrig reconstruct {session} --maps melanin --calibration {calibration} --out {maps}"
    )
    shutil.copytree(results / "calibration", results / "calibration-2")
    assert state_of(results, "maps").command == ""  # either folder may be meant


def test_maps_of_present_calibration_are_current(results):
    used = write_calibration(results / "calibration")
    write_calibration(results / "calibration-2", made_days=-2)
    write_maps(results, inputs={"calibration color": used})
    assert state_of(results, "maps").state == "up to date"
    found = discover([results])
    again = repeat_maps("maps", store.read(results / "maps"), found)
    assert shlex.split(again)[5:7] == ["--calibration", str(results / "calibration")]


@pytest.mark.parametrize("name", ["scan", "basis", "landmarks"])
def test_maps_with_unnamed_files_have_no_command(results, name):
    found = discover([results])
    assert repeat_maps("maps", store.read(results / "maps"), found)
    write_maps(results, inputs={name: "0" * 64})
    assert repeat_maps("maps", store.read(results / "maps"), found) == ""


def test_edited_maps_and_other_sessions_have_no_command(results):
    found = discover([results])
    write_maps(results, edit={})
    assert repeat_maps("maps", store.read(results / "maps"), found) == ""
    write_maps(results, inputs={"session": "sha256:" + "0" * 64})
    assert repeat_maps("maps", store.read(results / "maps"), found) == ""


def test_recorded_options_are_repeated(results):
    held = {"lights": ["L007", "L023"], "views": []}
    weights = [f"basis_weight_{k}" for k in range(6)]
    write_maps(results, names=["melanin", *weights], held_out=held)
    words = shlex.split(repeat_maps("maps", store.read(results / "maps"), discover([results])))
    assert words[5:9] == ["--hold-out", "lights=L007,L023", "--rank", "6"]


@pytest.mark.long
@pytest.mark.parametrize("folder", ["m", "my data"])
def test_commands_run_where_they_are_printed(session, folder, tmp_path, monkeypatch, capsys):
    """In folders whose names are parts of other words of the commands."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(session, Path(folder, "session"))
    maps = Path(folder, f"{folder}-maps")
    made = ["reconstruct", f"{folder}/session", "--maps", "melanin", "--out", str(maps)]
    assert main(made) == 0
    before = store.read(maps)
    again = shlex.split(repeat_maps(maps.name, before, discover([Path(folder)])))
    capsys.readouterr()
    assert main(["status", folder, "--json"]) == 0
    steps = [one["command"] for one in json.loads(capsys.readouterr().out)["next"]]
    assert f"skinrig report {shlex.quote(folder)}" in steps
    named = [word for step in steps for word in shlex.split(step) if word.startswith(f"{folder}/")]
    assert named
    assert all(Path(word).exists() for word in named)
    shutil.rmtree(maps)
    assert main(again[1:]) == 0
    after = store.read(maps)
    assert after.parameters["stages"] == before.parameters["stages"]
    assert after.maps.keys() == before.maps.keys()
    np.testing.assert_array_equal(after.maps["melanin"].values, before.maps["melanin"].values)


def test_missing_folder_is_refused(tmp_path, capsys):
    assert main(["status", str(tmp_path / "none")]) == 3
    assert "does not exist" in capsys.readouterr().err
    with pytest.raises(report.ReportError):
        read_status(tmp_path / "none", today=date.today())
