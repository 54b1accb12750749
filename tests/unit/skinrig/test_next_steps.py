"""Next steps suggested by a plain ``skinrig``, from the contents of a folder."""

import json
import shlex
from pathlib import Path

import pytest

from skinrig.cli import main
from skinrig.next_steps import (
    CALIBRATION_BY_TARGET,
    OPEN_COMMAND,
    format_welcome,
    suggest,
    suggest_after_geometry,
    suggest_after_session,
)
from skinrig.reporting import page
from skinrig.reporting.page import render_page
from skinrig.workspace import scan


def session(path, rig="flash", kinds=("dark", "subject"), target="", **more):
    path.mkdir()
    document = {
        **more,
        "rig": {"name": rig},
        "plan": {"steps": [{"kind": kind} for kind in kinds]},
        "extra": {"simulation": {"target": target}} if target else {},
    }
    (path / "session.json").write_text(json.dumps(document))


def calibration(path, rig, *kinds):
    path.mkdir()
    for kind in kinds:
        (path / f"{kind}.json").write_text(json.dumps({"kind": kind, "rig": rig}))


def appearance(path, session="", kind="appearance", files=(), maps=("melanin", "r_d"), **more):
    path.mkdir()
    document = {
        "parameters": {"kind": kind, "session": session, **more},
        "maps": {name: {} for name in maps},
        "files": dict.fromkeys(files, ""),
    }
    (path / "appearance.json").write_text(json.dumps(document))


def commands(folder=Path()):
    return [step.command for step in suggest(scan(folder), folder)]


def report_page():
    return render_page("a report", [page.build_note("All checks.")], [page.Heading("Maps")])


@pytest.fixture(autouse=True)
def _inside(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_an_empty_folder_begins_with_the_demo():
    assert commands()[0] == "skinrig demo"


def test_photographs_are_imported():
    Path("anna.NEF").touch()
    wanted = ["skinrig photo anna.NEF --out portrait", "skinrig import photos . --out session"]
    assert commands() == wanted
    Path("portrait").mkdir()
    assert commands() == wanted[1:]


def test_skin_session_is_reconstructed_with_own_calibration():
    session(Path("session-a"), "dome", ("dark", "olat"))
    calibration(Path("calibration-a"), "gradient", "lights")
    calibration(Path("calibration-dome"), "dome", "geometry", "lights")
    calibration(Path("calibration-flash"), "flash", "white")
    assert commands()[0] == (
        "skinrig reconstruct session-a --maps normals,r_d --calibration calibration-dome "
        "--out appearance"
    )


def test_target_is_not_reconstructed_as_skin():
    session(Path("session-white"), "dome", ("dark", "white"))
    session(Path("session-tile"), "flash", target="white")
    assert not any("reconstruct" in command for command in commands())


def test_session_with_maps_is_viewed_next():
    session(Path("session-a"))
    appearance(Path("appearance"), "session-a", files=("mesh.obj",))
    assert [command.split()[1] for command in commands()] == ["report", "view", "export"]


@pytest.mark.parametrize(
    ("other", "shown"),
    [
        ({"files": ()}, False),
        ({"files": ("mesh.obj",), "maps": ("melanin",)}, False),
        ({"fusion": {}}, False),
        ({"maps": ("melanin", "hemoglobin")}, False),  # without landmarks
        ({"maps": ("melanin", "hemoglobin"), "truth": "truth-a"}, True),
        ({"maps": ("normals_n0", "height_n0")}, True),
        ({"maps": ("translucency",)}, True),
        ({"maps": ("normals", "position"), "files": ("mesh.obj",)}, False),
    ],
)
def test_maps_are_viewed_where_view_takes_them(other, shown):
    appearance(Path("truth-a"), kind="truth")
    appearance(Path("appearance"), "session-a", **other)
    wanted = ["report", "view", "export"] if shown else ["report", "export"]
    assert [command.split()[1] for command in commands()] == wanted


def test_whole_face_is_viewed_before_patch_never_truth():
    appearance(Path("truth-a"), kind="truth", files=("mesh.obj",))
    appearance(Path("a-patch"))
    appearance(Path("b-face"), files=("mesh.obj",))
    assert "skinrig view b-face" in commands()


def test_dynamic_face_is_viewed_and_mesh_face_exported():
    appearance(Path("a-face"), files=("mesh.obj",))
    parts = {"facial_color": {}}
    appearance(Path("b-moving"), kind="dynamic", files=("facial_color.json",), parts=parts)
    assert "skinrig view b-moving" in commands()
    assert "skinrig export a-face --to maps --out export" in commands()


@pytest.mark.parametrize(
    ("scope", "offered"),
    [(["research"], True), (["any"], True), (["teaching"], False), ([], False)],
)
def test_export_of_measured_maps_is_offered_within_consent(scope, offered):
    record = {"pseudonym": "P1", "consent_scope": scope, "consent_expires": None}
    appearance(Path("a-face"), consent=[record])
    document = json.loads(Path("a-face/appearance.json").read_text()) | {"source": "measured"}
    Path("a-face/appearance.json").write_text(json.dumps(document))
    told = "skinrig export a-face --to maps --use research --out export" in commands()
    assert told is offered


def test_missing_calibration_is_not_named():
    session(Path("session-a"), "dome", ("dark", "olat"))
    assert commands()[0] == "skinrig reconstruct session-a --maps normals,r_d --out appearance"


def test_calibration_of_another_rig_is_not_named():
    session(Path("session-a"), "dome", ("dark", "olat"))
    calibration(Path("calibration-flash"), "flash", "white")
    calibration(Path("calibration-gradient"), "gradient", "lights")
    Path("calibration-dome").mkdir()
    assert "--calibration" not in commands()[0]


def test_calibration_of_flash_session_is_named():
    calibration(Path("calibration"), "flash", "white")
    told = suggest_after_session("flash", "session-a", None)
    assert "--calibration calibration" in told


def test_probe_is_calibrated_before_reconstruction():
    session(Path("session-skin"), "probe", ("dark", "place"))
    calibration(Path("calibration-flash"), "flash", "white")
    assert commands()[0] == "skinrig simulate probe --target phantom --out session-phantom"
    session(Path("session-phantom"), "probe", target="phantom")
    assert commands()[0] == "skinrig calibrate fiber session-phantom --out calibration"
    calibration(Path("calibration"), "probe", "fibre")  # of an older version
    told = commands()[0]
    assert told.startswith("skinrig reconstruct session-skin --maps profiles")
    assert "--calibration calibration" in told


def test_measured_probe_is_offered_capture_of_phantom():
    told = suggest_after_session("probe", "session-skin", None, source="measured")
    assert told == "skinrig capture probe --target phantom --out session-phantom"


def test_a_demo_below_is_found():
    Path("demo").mkdir()
    session(Path("demo/session-a"))
    Path("demo/report.html").write_text(report_page())
    text = format_welcome(Path(), "1")
    assert "In demo: 1 session, 1 report" in text
    assert f"{OPEN_COMMAND} {Path('demo/report.html')}" in text


def test_live_or_foreign_pages_are_not_reports():
    session(Path("session-a"))
    live = report_page().replace("img-src data:;", "script-src 'sha256-x'; img-src data:;")
    Path("face.html").write_text(live)
    Path("notes.html").write_text("<html>about reports</html>")
    assert not scan(Path()).reports
    Path("zone.html").write_text(report_page())
    assert scan(Path()).reports == (Path("zone.html"),)


def test_damaged_documents_do_not_stop_next_steps():
    Path("session-a").mkdir()
    Path("session-a/session.json").write_bytes(b"\xff{")
    Path("appearance").mkdir()
    Path("appearance/appearance.json").write_text("[1]")
    assert commands()[0] == "skinrig demo"


@pytest.mark.parametrize(
    ("rig", "target"),
    [(rig, target) for rig, kinds in CALIBRATION_BY_TARGET.items() for target in kinds],
)
def test_each_target_leads_to_a_calibration_that_exists(rig, target, capsys):
    for number, other in enumerate(CALIBRATION_BY_TARGET[rig]):  # dome lights need two targets
        session(Path(f"session-{number}"), rig, target=other)
    words = suggest_after_session(rig, "session", target).split()
    assert words[:2] == ["skinrig", "calibrate"]
    assert main([*words[1:3], "missing"]) == 3
    assert "missing" in capsys.readouterr().err


def test_dome_lights_follow_both_targets_and_geometry():
    def after(session, target, source="simulated"):
        return suggest_after_session("dome", session, target, source=source)

    made = "skinrig simulate dome --target white --out session-white"
    assert after("a", "mirror") == made
    session(Path("session-white"), "flash", target="white")
    assert after("a", "mirror") == f"{made}-2"
    assert after("b", "white", "measured").startswith("skinrig capture dome --target mirror")
    session(Path("b"), "dome", target="white")
    assert after("a", "mirror").startswith("skinrig simulate dome --target charuco")
    session(Path("c"), "dome", target="charuco")
    assert after("a", "mirror") == "skinrig calibrate geometry c --out calibration"
    calibration(Path("calibration"), "dome", "geometry")
    assert after("a", "mirror") == "skinrig calibrate lights a b --out calibration"
    made = suggest_after_session("flash", "d", "dark")
    assert made == "skinrig simulate flash --target flat --out session-flat"


def test_lights_after_geometry_are_of_same_dome():
    folder = Path("my rigs")
    folder.mkdir()
    for name, seed, target in (
        ("charuco", 1, "charuco"),
        ("mirror", 1, "mirror"),
        ("other-white", 2, "white"),
        ("session-white", 2, "white"),
        ("session-white-2", 2, "charuco"),
    ):
        session(folder / name, "dome", target=target, seed=seed, source="simulated")
    assert suggest_after_geometry(folder / "charuco", "store") == (
        "skinrig simulate dome --target white --seed 1 --out 'my rigs/session-white-3'"
    )
    session(folder / "white", "dome", target="white", seed=1, source="simulated")
    calibration(Path("store"), "dome", "geometry")
    assert suggest_after_geometry(folder / "charuco", "store") == (
        "skinrig calibrate lights 'my rigs/mirror' 'my rigs/white' --out store"
    )
    session(folder / "captured", "dome", target="charuco", source="measured")
    assert suggest_after_geometry(folder / "captured", "store") is None


def test_nothing_typed_prints_the_next_steps(capsys):
    assert main([]) == 0
    assert "skinrig demo" in capsys.readouterr().out


def test_path_with_spaces_is_quoted_for_pasting():
    folder = Path("an o'clock")
    folder.mkdir()
    session(folder / "my face")
    appearance(folder / "my maps", files=("mesh.obj",))
    (folder / "anna.NEF").touch()
    for command in [
        *commands(folder),
        suggest_after_session("flash", "my tile", "white", calibration="my rig"),
        suggest_after_session("dome", "my ball", "mirror"),
        suggest_after_session("gradient", "my skin", None, calibration="my rig"),
        suggest_after_session("flash", "my smiles", "sequence"),
    ]:
        words = shlex.split(command)
        assert words[0] in ("skinrig", OPEN_COMMAND)
        assert not {"my", "o'clock"} & set(words), command


def test_photograph_of_captured_tile_is_not_skin():
    session(Path("session-tile"))
    document = json.loads(Path("session-tile/session.json").read_text())
    document["plan"]["steps"] = [{"kind": "subject", "index": {"state": "white"}}]
    Path("session-tile/session.json").write_text(json.dumps(document))
    assert not any("reconstruct" in command for command in commands())
