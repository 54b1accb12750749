"""Broken inputs at the command line: one clear error each, exit code 3, nothing half written."""

import json
import shutil

import numpy as np
import pytest

from capture import raw
from capture.session import Session, SessionDamage
from model.facial_color import FacialColorError
from reconstruction.pipeline.flash import facial_color as facial_color_fit
from skinrig.cli import main
from skinrig.simulating.simulation import simulate_session

pytestmark = pytest.mark.render

PLAIN = ("lateral", "interreflections", "spectral", "optics", "relief_shadows")
"""Pictures without these are pictures as well, made in half the time."""


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sound")
    return simulate_session(
        "flash", folder / "session-flash", seed=5, width_px=64, leave_out=PLAIN
    ).session


@pytest.fixture
def session(sound, tmp_path):
    copy = tmp_path / "session-flash"
    shutil.copytree(sound, copy)
    return copy


def frames(session):
    return sorted((session / "frames").iterdir())


def truncate_frame(session):
    frame = frames(session)[0]
    frame.write_bytes(frame.read_bytes()[:-100])


def empty_frame(session):
    frames(session)[0].write_bytes(b"")


def remove_frame(session):
    frames(session)[1].unlink()


def swap_frames(session):
    first, second = frames(session)[:2]
    held = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(held)


def other_filter_array(session):
    frame = frames(session)[0]
    picture = raw.read(frame)
    frame.write_bytes(
        raw.encode_dng(picture.cfa, pattern="BGGR", black=picture.black, white=picture.white)
    )


def text_frame(session):
    frames(session)[0].write_text("this is not a photograph")


def link_frame(session):
    frame = frames(session)[0]
    moved = session.parent / "elsewhere.dng"
    frame.rename(moved)
    frame.symlink_to(moved)


def flip_bit(session):
    frame = frames(session)[2]
    data = bytearray(frame.read_bytes())
    data[-77] ^= 4
    frame.write_bytes(bytes(data))


def edit_manifest(change):
    def broken(session):
        path = session / "session.json"
        document = json.loads(path.read_text())
        change(document)
        path.write_text(json.dumps(document))

    broken.__name__ = change.__name__
    return broken


def schema_of_the_future(document):
    document["schema"] = "skinrig.session/99"


def unknown_key(document):
    document["colour"] = "red"


def manifest_is_no_json(session):
    (session / "session.json").write_text("{")


def manifest_is_missing(session):
    (session / "session.json").unlink()


def journal_line_lost(session):
    path = session / "journal.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:1] + lines[2:]))


def journal_names_a_file_outside(session):
    path = session / "journal.jsonl"
    path.write_bytes(path.read_bytes().replace(b"frames/", b"../../x/", 1))


def journal_is_empty(session):
    (session / "journal.jsonl").write_bytes(b"")


def journal_is_noise(session):
    noise = np.random.default_rng(12345).integers(0, 256, 500, dtype=np.uint8)
    (session / "journal.jsonl").write_bytes(noise.tobytes())


BREAKS = [
    truncate_frame,
    empty_frame,
    remove_frame,
    swap_frames,
    other_filter_array,
    text_frame,
    link_frame,
    flip_bit,
    edit_manifest(schema_of_the_future),
    edit_manifest(unknown_key),
    manifest_is_no_json,
    manifest_is_missing,
    journal_line_lost,
    journal_names_a_file_outside,
    journal_is_noise,
]


@pytest.mark.long
@pytest.mark.parametrize("damage", BREAKS, ids=lambda f: f.__name__)
def test_verify_finds_the_damage(session, damage, capsys):
    damage(session)
    assert main(["verify", str(session)]) == 3
    out, err = capsys.readouterr()
    assert "damaged" in out + err
    assert "Traceback" not in out + err


@pytest.mark.long
@pytest.mark.parametrize("damage", BREAKS, ids=lambda f: f.__name__)
def test_reconstruct_refuses_damage_or_is_unaffected(session, damage, capsys, tmp_path):
    damage(session)
    code = main(["reconstruct", str(session), "--maps", "melanin", "--out", str(tmp_path / "maps")])
    out, err = capsys.readouterr()
    assert code == 3, out + err
    assert err.count("skinrig: ") == 1
    assert "Traceback" not in out + err
    assert not (tmp_path / "maps").exists()


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "says"),
    [
        (
            ["fit", "facial-color", "SESSION", "--radius", "-3"],
            "radius: got -3 px, expected above 0",
        ),
        (["fit", "facial-color", "SESSION", "--radius", "nan"], "radius: got nan px"),
        (["fit", "facial-color", "SESSION", "--stored-size", "0"], "--stored-size: got 0 cells"),
        (["reconstruct", "SESSION", "--maps", "melanin", "--scan", "x.ply"], "scan: "),
        (
            ["reconstruct", "SESSION", "--maps", "melanin", "--rank", "3"],
            "got a session of another rig",
        ),
        (
            ["reconstruct", "SESSION", "--maps", "melanin", "--landmarks", "x.csv"],
            "landmarks: got x.csv, expected a file",
        ),
    ],
)
def test_impossible_option_is_refused_before_image_processing(words, says, sound, tmp_path, capsys):
    argv = [str(sound) if word == "SESSION" else word for word in words]
    assert main([*argv, "--out", str(tmp_path / "out")]) == 3
    err = capsys.readouterr().err
    assert says in err
    assert len(err.splitlines()) == 1  # no line of progress before
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_blood_undetermined_without_white_reference_error_names_remedy(
    sound, tmp_path, monkeypatch, capsys
):
    def untold(*args, **kwargs):
        raise FacialColorError("neutral: no pixel is valid, expected some")

    monkeypatch.setattr(facial_color_fit, "fit_facial_color", untold)
    argv = ["fit", "facial-color", str(sound), "--out", str(tmp_path / "out")]
    assert main(argv) == 3
    err = capsys.readouterr().err
    assert "no pixel is valid" in err
    assert "add a white calibration with --calibration" in err


def test_session_without_neutral_state_is_refused_before_images(tmp_path, capsys):
    made = simulate_session("flash", tmp_path / "session-white", target="white", width_px=64)
    out = tmp_path / "moving"
    assert main(["fit", "facial-color", str(made.session), "--out", str(out)]) == 3
    err = capsys.readouterr().err
    assert "states of sessions: got white, expected 'neutral'" in err
    assert "repeat" not in err
    assert not out.exists()


def journal_keeps_two_lines(session):
    path = session / "journal.jsonl"
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:2]))


@pytest.mark.long
@pytest.mark.parametrize("damage", [journal_is_empty, journal_keeps_two_lines])
def test_session_whose_journal_lost_lines_is_incomplete(session, damage, capsys):
    frames = len(list((session / "frames").iterdir()))
    damage(session)
    assert main(["verify", str(session)]) == 3
    out, err = capsys.readouterr()
    assert "INCOMPLETE" in out
    assert "Restore journal.jsonl from a copy" in out + err
    with pytest.raises(SessionDamage, match="lines are lost"):
        Session.resume(session)
    assert len(list((session / "frames").iterdir())) == frames


@pytest.mark.long
def test_a_sound_session_passes(session, capsys):
    assert main(["verify", str(session)]) == 0


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("name = 3", "name"),
        ("nam = 'flash'", "nam"),
        ("name = 'flash'\nrecycle_s = nan", "recycle_s"),
        ("[[lights", "toml"),
        ("", "name"),
    ],
)
def test_broken_rig_file_is_refused_with_all_faults(text, says, tmp_path, capsys):
    path = tmp_path / "rig.toml"
    path.write_text(text)
    assert main(["capture", str(path), "--out", str(tmp_path / "x"), "--dry-run"]) == 3
    err = capsys.readouterr().err.lower()
    assert says in err
    assert "traceback" not in err


@pytest.mark.long
def test_calibration_folder_without_rig_calibrations_is_refused(session, tmp_path, capsys):
    order = ["reconstruct", str(session), "--maps", "melanin", "--out", str(tmp_path / "maps")]
    assert main([*order, "--calibration", str(session)]) == 3
    assert f"{session} holds none, expected sensor, color" in capsys.readouterr().err
    other = tmp_path / "calibration-dome"
    other.mkdir()
    (other / "lights.json").write_text('{"rig": "dome"}')
    assert main([*order, "--calibration", str(other)]) == 3
    assert "expected the session's rig flash" in capsys.readouterr().err
    assert not (tmp_path / "maps").exists()


@pytest.mark.long
@pytest.mark.parametrize(
    "order",
    [
        ["reconstruct", "SESSION", "--maps", "melanin", "--out", "OUT"],
        ["fit", "facial-color", "SESSION", "--out", "OUT"],
        ["apply", "expression", "nothing", "--weights", "anger=1", "--out", "OUT"],
        ["edit", "nothing", "--trait", "tan=1", "--out", "OUT"],
    ],
    ids=lambda order: " ".join(order[:2]),
)
def test_unwritable_output_folder_is_refused_before_computation(order, session, tmp_path, capsys):
    taken = tmp_path / "notes.txt"
    taken.write_text("mine")
    for out in (taken, taken / "below"):
        known = {"SESSION": str(session), "OUT": str(out)}
        assert main([known.get(word, word) for word in order]) == 3
        told = capsys.readouterr().err
        assert str(out) in told
        assert " s] " not in told  # no line of progress
    assert taken.read_text() == "mine"


def test_plan_that_is_not_text_is_reported(tmp_path, capsys):
    plan = tmp_path / "plan.json"
    plan.write_bytes(b"\xff\xfe\x00")
    assert main(["capture", "flash", "--plan", str(plan), "--dry-run"]) == 3
    assert f"{plan}: is not JSON" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--lights", "--views", "--width"])
def test_zero_count_is_refused_not_replaced_by_default(option, tmp_path, capsys):
    out = tmp_path / "session"
    assert main(["simulate", "dome", option, "0", "--out", str(out)]) == 3
    assert f"{option[2:]}: got 0, expected a number above 0" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    ("order", "code", "words"),
    [
        (["bench", "--budget", "-1"], 3, "--budget: got -1, expected seconds above 0"),
        (["bench", "--extremes", "--smoke"], 2, "--smoke: not an option of --extremes"),
        (["bench", "--extremes", "--budget", "5"], 2, "--budget: not an option of --extremes"),
        (["bench", "--budget", "nan"], 3, "--budget: got nan, expected seconds above 0"),
        (["bench", "--out", "FILE"], 3, "is a file, expected a folder"),
        (
            ["plan", "flash", "--min-valid-fraction", "7"],
            3,
            "--min-valid-fraction: got 7, expected above 0",
        ),
        (["plan", "flash", "--min-valid-fraction", "nan"], 3, "--min-valid-fraction: got nan"),
        (["plan", "flash", "--out", "FOLDER"], 3, "is a folder, expected a file"),
        (["view", "--out", "FOLDER"], 3, "is a folder, expected a file"),
        (["report", "FOLDER", "--out", "FOLDER"], 3, "is a folder, expected a file"),
        (["view", "--port", "99999999"], 3, "--port: got 99999999, expected 0 to 65535"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_wrong_numbers_and_positions_are_refused_before_work(order, code, words, tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    known = {"FILE": str(tmp_path / "notes.txt"), "FOLDER": str(tmp_path)}
    assert main([known.get(word, word) for word in order]) == code
    told = capsys.readouterr()
    assert words in told.err
    assert not told.out
    assert [entry.name for entry in tmp_path.iterdir()] == ["notes.txt"]


def test_text_disguised_as_photograph_gives_single_error_sentence(tmp_path, capsys):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.jpg").write_text("no photograph")
    assert main(["import", "photos", str(tmp_path / "in"), "--out", str(tmp_path / "s")]) == 3
    told = capsys.readouterr().err
    assert "not a JPEG (first bytes: b'no p'), expected a photograph" in told
    assert told.count("expected") == 1


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("/dev/no-such-port", "cannot open /dev/no-such-port: No such file or directory; is it"),
        ("socket://127.0.0.1:9", "does a server listen there?"),
    ],
)
def test_unopenable_port_is_reported_once_with_hints(url, words, tmp_path, capsys):
    order = ["capture", "flash", "--camera", f"cam=hotfolder:{tmp_path}", "--out"]
    assert main([*order, str(tmp_path / "s"), "--port", f"flash={url}"]) == 4
    told = capsys.readouterr().err
    assert words in told
    assert told.count(url) == 1 + url.startswith("socket")
    assert not (tmp_path / "s").exists()
