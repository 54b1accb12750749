"""Endings of commands after success or failure: next steps, pages and plans, and their streams."""

import errno
import json
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from capture.rig import load_rig
from capture.session.disk import Disk
from model import store
from model.skin import SkinAppearance, SkinMap
from skinrig import errors
from skinrig.cli import main
from skinrig.command_line import completion


def photograph(path, color=True, seed=0):
    pixels = np.random.default_rng(seed).integers(40, 200, (32, 48, 3), np.uint8)
    Image.fromarray(pixels if color else pixels[..., 0]).save(path)


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    return folder


def bring(photos, session):
    return main(["import", "photos", str(photos), "--out", str(session)])


def test_a_gray_photograph_is_not_offered_for_melanin(photos, tmp_path, capsys, monkeypatch):
    photograph(photos / "portrait.png", color=False)
    assert bring(photos, tmp_path / "session") == 0
    said = capsys.readouterr().out
    assert "next: skinrig verify" in said
    assert "reconstruct" not in said
    monkeypatch.chdir(tmp_path)
    assert main([]) == 0
    assert "skinrig reconstruct" not in capsys.readouterr().out


def test_reconstruct_lists_maps_of_session(photos, tmp_path, capsys):
    photograph(photos / "portrait.png")
    session = tmp_path / "session"
    assert bring(photos, session) == 0
    capsys.readouterr()
    assert main(["reconstruct", str(session), "--list"]) == 0
    listed = capsys.readouterr().out.split()
    assert {"melanin", "hemoglobin"} <= set(listed)
    context = SimpleNamespace(params={"sessions": [session]})
    assert set(completion.complete_wants(context, "")) == set(listed)
    assert "r_d" not in listed  # a map of the dome
    assert "r_d" in completion.complete_wants(SimpleNamespace(params={}), "")
    assert main(["reconstruct", str(session), "--maps", "melanin"]) == 2
    assert "--out: not given" in capsys.readouterr().err


def test_colored_photograph_is_offered_before_gray(photos, tmp_path, capsys, monkeypatch):
    photograph(photos / "a.png", color=False)
    photograph(photos / "b.png")
    assert bring(photos, tmp_path / "session") == 0
    assert "--out appearance --state b" in capsys.readouterr().out
    monkeypatch.chdir(tmp_path)
    assert main([]) == 0
    assert "--out appearance --state b" in capsys.readouterr().out


def test_of_several_photographs_the_states_there_are_named(photos, tmp_path, capsys):
    photograph(photos / "a.png")
    photograph(photos / "b.png")
    session, out = tmp_path / "session", tmp_path / "appearance"
    assert bring(photos, session) == 0
    assert main(["reconstruct", str(session), "--maps", "melanin", "--out", str(out)]) == 3
    said = capsys.readouterr().err
    assert "has no photograph of state 'neutral'; it has those of a, b" in said
    assert "--state a" in said
    assert "crossed-polarized frame" not in said


def test_large_photographs_are_advised_to_be_averaged(photos, tmp_path, capsys):
    Image.new("RGB", (64, 64), "gray").save(photos / "a.png")
    assert bring(photos, tmp_path / "small") == 0
    assert "advice:" not in capsys.readouterr().out
    Image.new("RGB", (2048, 1024), "gray").save(photos / "a.png")
    assert bring(photos, tmp_path / "large") == 0
    assert "advice: images have up to 2.1 million pixels" in capsys.readouterr().out


def test_counted_progress_precedes_each_part(photos, tmp_path, capsys):
    for name in ("a.png", "b.png"):
        photograph(photos / name)
    flat = np.broadcast_to([0.0, 0.0, 1.0], (16, 16, 3))
    maps = {"normals": SkinMap(flat, "1"), "r_d": SkinMap(np.full((16, 16, 3), 0.4), "1")}
    place = str(store.write(tmp_path / "maps", SkinAppearance(maps, "simulated")))
    out = str(tmp_path / "out")
    for argv, text in (
        (["import", "photos", str(photos), "--out", out + "s"], "read photograph 1/2"),
        (["report", place, "--out", out + ".html"], "draw section 0/1: maps"),
        (["view", place, "--out", out + "v.html"], "content 1/2: color and uncertainty"),
        (["export", place, "--to", "maps", "--out", out], "content 1/2: r_d"),
    ):
        assert main([*argv, "--json"]) == 0
        events = [json.loads(line) for line in capsys.readouterr().err.splitlines() if "{" in line]
        (found,) = [one for one in events if one["text"] == text]
        assert (found["left_s"] is None) == ("0/" in text)


def test_full_disk_during_import_suggests_reimport(photos, tmp_path, capsys, monkeypatch):
    photograph(photos / "a.png")

    def full(self, descriptor, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Disk, "write", full)
    assert bring(photos, tmp_path / "session") == 3
    said = capsys.readouterr().err
    assert "No space left on device" in said
    assert "then import again; nothing was kept" in said
    assert "resume" not in said
    assert ".part" not in said
    assert [entry.name for entry in tmp_path.iterdir()] == ["photos"]


@pytest.mark.parametrize(("name", "kind"), [("a.jpg", "JPEG"), ("a.PNG", "PNG")])
def test_text_disguised_as_image_error_names_image_format(name, kind, photos, tmp_path, capsys):
    (photos / name).write_bytes(b"text")
    assert bring(photos, tmp_path / "session") == 3
    said = capsys.readouterr().err
    assert f"not a {kind}" in said
    assert "b'text'" in said
    assert "LibRaw" not in said


def test_unwritable_page_is_reported_by_its_name(photos, tmp_path, capsys):
    photograph(photos / "a.png")
    assert bring(photos, tmp_path / "session") == 0
    capsys.readouterr()
    code = main(["report", str(tmp_path / "session"), "-o", "/proc/page.html"])
    said = capsys.readouterr().err
    assert code == 3
    assert "/proc/page.html" in said
    assert ".part" not in said


def test_a_report_goes_to_the_standard_output_alone(photos, tmp_path, capsys, monkeypatch):
    photograph(photos / "a.png")
    assert bring(photos, tmp_path / "session") == 0
    capsys.readouterr()
    monkeypatch.chdir(tmp_path)
    assert main(["report", str(tmp_path / "session"), "-o", "-"]) == 0
    page = capsys.readouterr().out
    assert page.startswith("<!")
    assert page.rstrip().endswith("</html>")
    assert not (tmp_path / "-").exists()
    assert main(["report", str(tmp_path / "session"), "-o", "-", "--json"]) == 2
    assert main(["view", "-o", "-"]) == 2
    assert not (tmp_path / "-").exists()


def test_script_reads_whole_dry_run_plan(capsys):
    assert main(["capture", "flash", "--dry-run", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert len(told["plan"]["steps"]) == told["steps"] > 0
    assert {step["kind"] for step in told["plan"]["steps"]} == {"dark", "subject"}


@pytest.mark.parametrize("kind", ["lights", "geometry"])
def test_dome_is_not_calibrated_by_other_rig_sessions(kind, photos, tmp_path, capsys):
    photograph(photos / "a.png")
    session = tmp_path / "session"
    assert bring(photos, session) == 0
    assert main(["calibrate", kind, str(session), "--out", str(tmp_path / "c")]) == 3
    assert "session of rig 'imported', expected one of a dome" in capsys.readouterr().err


def test_served_rig_prints_single_document_and_ends(monkeypatch, capsys):
    rig = load_rig("flash")
    addresses = {name: f"tcp://127.0.0.1:1/{name}" for name in (*rig.boxes, "cam")}

    class Served(SimpleNamespace):
        def __enter__(self):
            return self

        def __exit__(self, *error):
            return None

        def wait(self):
            raise KeyboardInterrupt

    monkeypatch.setattr(
        "skinrig.simulating.serving.serve_world",
        lambda *args, **settings: Served(addresses=addresses),
    )
    monkeypatch.setattr("skinrig.simulating.serving._flash_scene", lambda *args: None)
    assert main(["serve", "flash", "--json"]) == errors.EXIT_INTERRUPTED
    told = json.loads(capsys.readouterr().out)
    assert told["schema"] == "skinrig.serve/1"
    assert told["addresses"] == addresses
    assert told["next"].startswith("skinrig capture flash --port flash=tcp://127.0.0.1:1/flash")
    assert main(["serve", "flash"]) == errors.EXIT_INTERRUPTED
    assert capsys.readouterr().out.splitlines() == [f"{n} {url}" for n, url in addresses.items()]


def test_several_sessions_are_reconstructed_into_folders_by_name(tmp_path, capsys, monkeypatch):
    asked = []

    def reconstruct(session, *, want, out, **settings):
        asked.append((session.name, out))
        return SimpleNamespace(ran=("a",), reused=(), omitted=(), assumed=(), work=())

    monkeypatch.setattr("reconstruction.pipeline.recipes.reconstruct", reconstruct)
    monday, tuesday, out = tmp_path / "monday", tmp_path / "tuesday", tmp_path / "maps"
    command = ["reconstruct", "--maps", "melanin", "--out", str(out), "--json"]
    assert main([*command, str(monday), str(tuesday)]) == 0
    assert asked == [("monday", out / "monday"), ("tuesday", out / "tuesday")]
    told = json.loads(capsys.readouterr().out)
    assert [row["path"] for row in told["appearances"]] == [str(path) for _, path in asked]
    assert main([*command, str(monday)]) == 0
    assert asked[-1] == ("monday", out)
    assert json.loads(capsys.readouterr().out)["path"] == str(out)
    assert main([*command, str(monday), str(tmp_path / "other" / "monday")]) == 3
    assert "two folders named 'monday'" in capsys.readouterr().err
    out.mkdir()
    (out / "appearance.json").write_text("{}")
    assert main([*command, str(monday), str(tuesday)]) == 3
    assert "holds the maps of one session" in capsys.readouterr().err
    assert len(asked) == 3


def test_quantity_unplanned_for_rig_lists_rigs_planning(capsys):
    assert main(["plan", "flash", "--goals", "normals<=1deg,hemoglobin<=5%"]) == 3
    said = capsys.readouterr().err
    assert "got 'normals' of rig 'flash'" in said
    assert "normals is planned for dome, gradient" in said
