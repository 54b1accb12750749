"""Damaged and forged sessions: one flipped bit is named, each broken input gives one clear error.

A forger here recomputes every seal, so that the content itself must be refused.
"""

import json
import os
import re
import shutil

import numpy as np
import pytest

from capture import raw
from capture.documents import InputError
from capture.plan import Plan, Step
from capture.rig import load_rig, rig_from_json
from capture.session import NotASession, Session, SessionDamage, SubjectRecord, verify
from capture.session.journal import frame_path
from capture.session.manifest import seal

RIG = load_rig("flash").resized(16)
PLAN = Plan("flash", tuple(Step(f"S{n:03d}", "subject", {}, {}, ("cam",)) for n in range(4)))


def write_session(path, *, closed=True, session_id="one", frames=4):
    words = {"devices": {}, "subject": SubjectRecord("P1"), "source": "simulated"}
    with Session.create(path, plan=PLAN, rig=RIG, session_id=session_id, **words) as session:
        for step, _ in session.pending_frames()[:frames]:
            values = np.full((10, 16), 600 + int(step.id[1:]), np.uint16)
            levels = {"pattern": "RGGB", "black": 512, "white": 16383}
            blob = raw.encode_dng(values, **levels, step_id=step.id, session_id=session.id)
            note = {"note": "token @ 7 J*"}  # letters that one bit turns into a newline or a zero
            session.commit(step.id, "cam", blob, settings={}, actual=note, t_host_s=0.0)
            if step.id == "S001":
                session.attach("scan.ply", b"ply\nscan of a head\n" * 9, about={"unit": "mm"})
        if closed:
            session.close()
    return path


@pytest.fixture
def closed(tmp_path):
    return write_session(tmp_path / "closed")


@pytest.fixture
def interrupted(tmp_path):
    return write_session(tmp_path / "interrupted", closed=False, frames=3)


def parts(path):
    names = [str(file.relative_to(path)) for file in path.rglob("*") if file.is_file()]
    return sorted(names)


def flip(file, byte, bit):
    data = bytearray(file.read_bytes())
    data[byte] ^= 1 << bit
    file.write_bytes(data)


# --- one flipped bit ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["closed", "interrupted"])
@pytest.mark.parametrize(
    "flips_per_file", [12, pytest.param(200, marks=pytest.mark.long, id="200")]
)
def test_flipped_bit_in_any_file_is_reported(request, rng, kind, flips_per_file):
    path = request.getfixturevalue(kind)
    assert verify(path).ok
    for name in parts(path):
        file = path / name
        whole = file.read_bytes()
        for _ in range(flips_per_file):
            byte, bit = int(rng.integers(len(whole))), int(rng.integers(8))
            flip(file, byte, bit)
            report = verify(path)
            assert not report.ok, (name, byte, bit)
            assert any(str(file) in problem for problem in report.problems), (name, byte, bit)
            file.write_bytes(whole)
    assert verify(path).ok


@pytest.mark.parametrize("kind", ["closed", "interrupted"])
@pytest.mark.parametrize("stride", [59, pytest.param(1, marks=pytest.mark.long)])
def test_every_bit_of_the_last_acknowledged_line_counts(request, kind, stride):
    """The end of the journal is where damage could be mistaken for a line cut off by a crash."""
    path = request.getfixturevalue(kind)
    file = path / "journal.jsonl"
    whole = file.read_bytes()
    start = whole.rindex(b"\n", 0, -1) + 1
    for place in range(8 * start, 8 * len(whole), stride):
        byte, bit = divmod(place, 8)
        flip(file, byte, bit)
        report = verify(path)
        named = [int(x) for x in re.findall(r"journal\.jsonl, byte (\d+)", str(report.problems))]
        assert named, (byte - start, bit)
        assert start <= named[0] <= byte
        with pytest.raises(SessionDamage):
            Session.resume(path)
        file.write_bytes(whole)


def test_damaged_middle_line_is_reported_by_first_byte(interrupted):
    file = interrupted / "journal.jsonl"
    first = file.read_bytes().index(b"\n") + 1
    flip(file, first + 100, 0)
    with pytest.raises(SessionDamage, match=rf"journal\.jsonl, byte {first}"):
        Session.open(interrupted)
    before = file.read_bytes()
    with pytest.raises(SessionDamage, match=rf"journal\.jsonl, byte {first}"):
        Session.resume(interrupted)
    assert file.read_bytes() == before


def test_a_damaged_frame_is_not_handed_out(closed):
    session = Session.open(closed)
    record = session.frames()[1]
    flip(closed / record.file, -1, 3)
    with pytest.raises(SessionDamage, match=re.escape(record.file)):
        session.read(record)
    assert session.read(session.frames()[0]).step_id == "S000"


def test_all_damaged_frames_are_listed_at_once(closed):
    for name in ("S000", "S002"):
        flip(closed / frame_path(name, "cam", 1), 700, 1)
    (closed / frame_path("S003", "cam", 1)).unlink()
    report = verify(closed)
    assert (len(report.problems), report.frames) == (3, 1)


@pytest.mark.parametrize("cut", [1, 20, 200])
def test_line_truncated_by_crash_warns_and_is_dropped(interrupted, cut):
    file = interrupted / "journal.jsonl"
    whole = file.read_bytes()
    file.write_bytes(whole[:-cut])
    start = whole.rindex(b"\n", 0, -1) + 1
    report = verify(interrupted)
    assert report.ok
    assert any(f"byte {start}" in warning for warning in report.warnings)
    Session.resume(interrupted).release()
    assert file.read_bytes() == whole[:start]
    assert [file.name for file in (interrupted / "orphans").iterdir()] == ["S002+cam.dng.1"]


@pytest.mark.parametrize("cut", [1, 20])
def test_truncated_closed_session_is_never_accepted(closed, cut):
    """What can be cut without a trace is the whole closing line: the session is open again."""
    file = closed / "journal.jsonl"
    file.write_bytes(file.read_bytes()[:-cut])
    assert any("not closed" in warning for warning in verify(closed).warnings)


# --- forged and broken inputs ---------------------------------------------------------------------


def reseal(path, *, manifest=None, journal=None):
    """Change manifest and records as a forger would: with every seal recomputed."""
    from hashlib import sha256

    content = json.loads((path / "session.json").read_text())
    content.pop("seal")
    if manifest is not None:
        manifest(content)
    data, head = seal(content)
    (path / "session.json").write_bytes(data)
    records = [json.loads(line)["r"] for line in (path / "journal.jsonl").read_bytes().splitlines()]
    if journal is not None:
        journal(records)
    text = ""
    for record in records:
        packed = json.dumps(record, sort_keys=True, separators=(",", ":"))
        head = sha256((head + packed).encode()).hexdigest()
        text += f'{{"h":"{head}","r":{packed}}}\n'
    (path / "journal.jsonl").write_text(text)


def manifest_with(*keys, value):
    """Return a forgery that sets one value of the manifest."""

    def forge(content):
        for key in keys[:-1]:
            content = content[key]
        content[keys[-1]] = value

    return lambda path: reseal(path, manifest=forge)


def record_with(key, value):
    return lambda path: reseal(path, journal=lambda records: records[1].update({key: value}))


def attachment_with(key, value):
    return lambda path: reseal(path, journal=lambda records: records[2].update({key: value}))


def attachment(path):
    return path / "attachments" / "scan.ply"


def frame(path):
    return path / frame_path("S001", "cam", 1)


def link_the_frame(path):
    secret = path.parent / "secret.dng"
    frame(path).rename(secret)
    frame(path).symlink_to(secret)


def link_the_folder(path, name="frames"):
    (path / name).rename(path.parent / "elsewhere")
    (path / name).symlink_to(path.parent / "elsewhere")


def take_another_journal(path):
    other = write_session(path.parent / "other", session_id="two")
    shutil.copy(other / "journal.jsonl", path / "journal.jsonl")


def swap_two_frames(path):
    other = path / frame_path("S002", "cam", 1)
    frame(path).rename(path / "x")
    other.rename(frame(path))
    (path / "x").rename(other)


def drop_a_line(path):
    lines = (path / "journal.jsonl").read_bytes().splitlines(keepends=True)
    (path / "journal.jsonl").write_bytes(b"".join(lines[:1] + lines[2:]))


BROKEN = {
    "manifest missing": (lambda p: (p / "session.json").unlink(), "no session.json"),
    "manifest empty": (lambda p: (p / "session.json").write_bytes(b""), "is not JSON"),
    "manifest is no JSON": (lambda p: (p / "session.json").write_text("hello"), "is not JSON"),
    "manifest is a list": (lambda p: (p / "session.json").write_text("[]"), "not a session"),
    "manifest nested to death": (
        lambda p: (p / "session.json").write_text("[" * 200_000),
        "session.json: is not JSON",
    ),
    "manifest with NaN": (
        lambda p: (p / "session.json").write_text('{"schema": NaN}'),
        "expected a finite number",
    ),
    "manifest of a later schema": (
        manifest_with("schema", value="skinrig.session/3"),
        "got 'skinrig.session/3', expected skinrig.session/2 or skinrig.session/1",
    ),
    "manifest with an unknown key": (manifest_with("subjcet", value="x"), "did you mean subject?"),
    "manifest without a source": (manifest_with("source", value=None), "source"),
    "manifest with a name": (
        manifest_with("subject", "pseudonym", value="Ada Lovelace"),
        "subject.pseudonym",
    ),
    "manifest with a step twice": (
        manifest_with("plan", "steps", 1, "id", value="S000"),
        "plan.steps[1].id",
    ),
    "manifest with an absurd camera": (
        manifest_with("rig", "views", 0, "width_px", value=2_000_000_000),
        "rig.views[0].width_px",
    ),
    "manifest with a wrong filter array": (
        manifest_with("rig", "views", 0, "cfa", value="RGBW"),
        "rig.views[0].cfa",
    ),
    "step that is a path trick": (
        manifest_with("plan", "steps", 1, "id", value="../../etc/passwd"),
        "plan.steps[1].id",
    ),
    "journal missing": (lambda p: (p / "journal.jsonl").unlink(), "journal.jsonl"),
    "journal of another session": (take_another_journal, "journal.jsonl, byte 0"),
    "journal that is binary": (
        lambda p: (p / "journal.jsonl").write_bytes(b"\xff\xfe\n" * 5),
        "journal.jsonl, byte 0",
    ),
    "journal without one line": (drop_a_line, "journal.jsonl, byte"),
    "journal that climbs out": (record_with("file", "../passwd"), "expected frames/S001"),
    "journal with an absolute path": (record_with("file", "/etc/passwd"), "expected frames/S001"),
    "journal with another frame's path": (
        record_with("file", "frames/S002+cam.dng"),
        "expected frames/S001",
    ),
    "journal with an unknown step": (
        lambda p: reseal(
            p, journal=lambda r: r[1].update(step="S999", file=frame_path("S999", "cam", 1))
        ),
        "got S999, expected a step of the plan",
    ),
    "journal with a frame twice": (
        lambda p: reseal(p, journal=lambda r: r.insert(1, r[1])),
        "each frame once",
    ),
    "journal with an absurd size": (record_with("bytes", -1), "bytes: got -1, expected > 0"),
    "journal with an unknown record": (record_with("type", "delete"), "got 'delete'"),
    "attachment missing": (lambda p: attachment(p).unlink(), "scan.ply"),
    "attachment truncated": (
        lambda p: attachment(p).write_bytes(attachment(p).read_bytes()[:-7]),
        "scan.ply",
    ),
    "attachment that climbs out": (
        attachment_with("file", "../passwd"),
        "expected attachments/scan.ply",
    ),
    "attachment of a bad name": (attachment_with("name", "../scan.ply"), "name"),
    "attachment of an absurd size": (attachment_with("bytes", 0), "bytes: got 0, expected > 0"),
    "attachment twice": (
        lambda p: reseal(p, journal=lambda r: r.insert(3, r[2])),
        "each attachment once",
    ),
    "attachments folder that is a link": (
        lambda p: link_the_folder(p, "attachments"),
        "a folder, not a link",
    ),
    "frame missing": (lambda p: frame(p).unlink(), "S001+cam.dng"),
    "frame empty": (lambda p: frame(p).write_bytes(b""), "got 0 bytes"),
    "frame truncated": (lambda p: frame(p).write_bytes(frame(p).read_bytes()[:-7]), "S001+cam.dng"),
    "frame replaced by a text": (lambda p: frame(p).write_text("not a DNG"), "S001+cam.dng"),
    "frame that is a link": (link_the_frame, "a symbolic link"),
    "frame that is a pipe": (
        lambda p: (frame(p).unlink(), os.mkfifo(frame(p))),
        "not a plain file",
    ),
    "frame that is a folder": (lambda p: (frame(p).unlink(), frame(p).mkdir()), "not a plain file"),
    "manifest that is a folder": (
        lambda p: ((p / "session.json").unlink(), (p / "session.json").mkdir()),
        "not a plain file",
    ),
    "journal that is a folder": (
        lambda p: ((p / "journal.jsonl").unlink(), (p / "journal.jsonl").mkdir()),
        "not a plain file",
    ),
    "frames swapped": (swap_two_frames, "S001+cam.dng"),
    "frames folder that is a link": (link_the_folder, "a folder, not a link"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_session_gives_single_clear_error(closed, name):
    """`verify` returns it, opening or reading raises it, and nothing else ever comes out."""
    breaking, expected = BROKEN[name]
    breaking(closed)
    report = verify(closed)
    assert not report.ok
    assert expected in report.problems[0]
    assert str(closed) in report.problems[0]
    with pytest.raises(InputError) as caught:
        read_all(closed)
    assert expected in str(caught.value)


def read_all(path):
    session = Session.open(path)
    frames = [session.read(record) for record in session.frames()]
    return frames, [session.attachment(name) for name in session.attachments()]


def test_the_list_of_broken_inputs_is_long_enough():
    assert len(BROKEN) >= 20


def test_forged_session_without_faults_is_accepted(closed):
    """The forger's tool alone breaks nothing: what the tests above see is the content."""
    reseal(closed)
    assert verify(closed).ok


@pytest.mark.parametrize("file", ["frames/S009+cam.dng", "attachments/notes.txt"])
def test_stray_file_in_closed_session_is_problem(closed, file):
    (closed / file).write_bytes(b"x")
    assert file in verify(closed).problems[0]


def test_unknown_file_among_frames_is_warning(closed):
    (closed / "notes.txt").write_text("x")
    report = verify(closed)
    assert report.ok
    assert any("notes.txt" in warning for warning in report.warnings)


def test_folder_that_is_not_session_is_reported(tmp_path):
    for path in (tmp_path, tmp_path / "none"):
        for read in (verify, Session.open):
            with pytest.raises(NotASession, match=f"{path}: is not a session"):
                read(path)


@pytest.mark.parametrize("field", ["width_px", "height_px", "bit_depth", "black_level"])
@pytest.mark.parametrize("value", [-1, 0.5, 1e300, "16", None, [], 2**63])
def test_rig_values_never_raise_foreign_errors(field, value):
    data = json.loads(json.dumps(RIG.to_json()))
    data["views"][0][field] = value
    with pytest.raises(InputError, match=rf"views\[0\]\.({field}|white_level)"):
        rig_from_json(data)
