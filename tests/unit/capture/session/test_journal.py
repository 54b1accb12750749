"""Lines of the journal: what each must contain, and where the walk along their chain ends."""

import hashlib
import math

import pytest

from capture.documents import canonical_json
from capture.session.errors import SessionDamage, SessionError
from capture.session.journal import (
    MAX_LINE_BYTES,
    AttachmentLine,
    CloseLine,
    FrameLine,
    OmissionLine,
    frame_path,
    seal_bounded_line,
    seal_line,
    walk_journal,
)

SEAL = "0" * 64
OMITTED = OmissionLine(steps=("S001",), reason="blinked", about={}, t_host_s=1.0)
END = CloseLine(frames=0, missing=(), reason="")
VIEWS = ("C00", "C01", "C02")
CAMERAS = {"S001": 3, "S002": 3, "S003": 1, "S004": 2}
"""Cameras of each step."""


def frame_line(step, camera, attempt=1):
    return FrameLine(
        **{"step": step, "camera": camera, "attempt": attempt, "bytes": 9, "xxh128": "0" * 32},
        **{"file": frame_path(step, camera, attempt), "settings": {"iso": 100}},
        **{"actual": {"serial": camera}, "t_box_s": None, "t_host_s": 1.0},
    )


def frame_lines(step, views=VIEWS, attempt=1):
    return [frame_line(step, view, attempt) for view in views]


def seal_lines(*lines):
    texts, head = [], SEAL
    for line in lines:
        text, head = seal_line(head, line)
        texts.append(text)
    return texts


@pytest.mark.parametrize("steps", [(), ("S001", "S001"), ("../S001",), ("",)])
def test_omission_line_needs_different_names(steps):
    with pytest.raises(SessionDamage, match="steps"):
        OmissionLine(steps=steps, reason="blinked", about={}, t_host_s=1.0)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("step", "../S001"),
        ("camera", "../cam"),
        ("attempt", 0),
        ("file", "frames/S002+cam.dng"),
        ("bytes", 0),
        ("xxh128", "0" * 31),
    ],
)
def test_frame_line_refuses_impossible_values(field, value):
    good = {
        **{"step": "S001", "camera": "cam", "attempt": 1, "file": "frames/S001+cam.dng"},
        **{"bytes": 1, "xxh128": "0" * 32, "settings": {}, "actual": {}},
        **{"t_box_s": None, "t_host_s": 1.0},
    }
    FrameLine(**good)
    with pytest.raises(SessionDamage, match=rf"\n  {field}: got "):
        FrameLine(**good | {field: value})


def test_data_after_end_is_damage():
    texts = seal_lines(OMITTED, CloseLine(frames=0, missing=(), reason=""))
    assert walk_journal(b"".join(texts), seal=SEAL, where="journal").damage is None
    walk = walk_journal(b"".join([*texts, texts[0]]), seal=SEAL, where="journal")
    assert "data after the end" in str(walk.damage)
    assert len(walk.lines) == 2
    assert (walk.end, walk.torn) == (sum(map(len, texts)), 0)


@pytest.mark.parametrize("excess", [0, 1])
def test_longest_line_is_written_and_read(excess):
    """An acknowledged line is readable: the writer's limit is the reader's."""
    (empty,) = seal_lines(OmissionLine(steps=("S001",), reason=".", about={}, t_host_s=1.0))
    reason = "." * (1 + MAX_LINE_BYTES + excess - len(empty))
    line = OmissionLine(steps=("S001",), reason=reason, about={}, t_host_s=1.0)
    (text,) = seal_lines(line)
    assert len(text) == MAX_LINE_BYTES + excess
    walk = walk_journal(text, seal=SEAL, where="journal")
    if excess:
        assert "65537 bytes" in str(walk.damage)
        with pytest.raises(SessionError, match="too long"):
            seal_bounded_line(SEAL, line)
    else:
        assert walk.lines == ((0, line),)
        assert seal_bounded_line(SEAL, line)[0] == text


@pytest.mark.parametrize(("zeros", "torn"), [(1, False), (2, True), (3, True)])
def test_line_with_zeros_is_torn_from_two_on(zeros, torn):
    """A flipped bit makes one zero byte at most; an interrupted write leaves more."""
    first, last = seal_lines(OMITTED, OMITTED)
    spoiled = last[:80] + b"\0" * zeros + last[80 + zeros :]
    walk = walk_journal(first + spoiled, seal=SEAL, where="journal")
    assert (walk.damage is None) == torn
    assert walk.torn == (len(spoiled) if torn else 0)
    assert len(walk.lines) == 1


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("name", "../a.ply"), ("name", "a.part"), ("file", "attachments/b.ply")),
        *(("bytes", 0), ("xxh128", "0" * 33), ("xxh128", "G" * 32)),
    ],
)
def test_attachment_line_refuses_impossible_values(field, value):
    good = {"name": "a.ply", "file": "attachments/a.ply", "bytes": 1, "xxh128": "0" * 32}
    AttachmentLine(**good, about={})
    with pytest.raises(SessionDamage, match=rf"\n  {field}: got "):
        AttachmentLine(**good | {field: value}, about={})


@pytest.mark.parametrize("reason", ["", " \n"])
def test_omission_line_needs_reason(reason):
    with pytest.raises(SessionDamage, match=r"reason: got .*, expected a text"):
        OmissionLine(steps=("S001",), reason=reason, about={}, t_host_s=1.0)


def test_second_attempt_has_file_of_its_own():
    words = {"bytes": 1, "xxh128": "0" * 32, "settings": {}, "actual": {}}
    words |= {"step": "S001", "camera": "cam", "t_box_s": None, "t_host_s": 1.0}
    FrameLine(**words, attempt=2, file="frames/S001+cam+2.dng")
    with pytest.raises(SessionDamage, match=r"file: .*, expected frames/S001\+cam\+2\.dng"):
        FrameLine(**words, attempt=2, file="frames/S001+cam.dng")


def test_walk_returns_each_line_with_its_byte():
    end = CloseLine(frames=0, missing=("S002",), reason="over")
    texts = seal_lines(OMITTED, OMITTED, end)
    data = b"".join(texts)
    starts = [0, len(texts[0]), len(texts[0]) + len(texts[1])]
    walk = walk_journal(data, seal=SEAL, where="journal")
    assert walk.lines == tuple(zip(starts, (OMITTED, OMITTED, end), strict=True))
    assert (walk.end, walk.torn, walk.damage, walk.closed) == (len(data), 0, None, True)
    assert walk.head == seal_line(walk_journal(data[: starts[2]], seal=SEAL, where="").head, end)[1]
    empty = walk_journal(b"", seal=SEAL, where="journal")
    assert (empty.lines, empty.head, empty.end, empty.torn) == ((), SEAL, 0, 0)
    assert (empty.closed, empty.damage) == (False, None)


@pytest.mark.parametrize("kept", [1, 40, -2, -1])
def test_any_prefix_of_last_line_is_torn(kept):
    """Also one that lacks its newline alone: it was never acknowledged."""
    first, last = seal_lines(OMITTED, OMITTED)
    walk = walk_journal(first + last[:kept], seal=SEAL, where="journal")
    assert (walk.lines, walk.damage) == (((0, OMITTED),), None)
    assert (walk.end, walk.torn) == (len(first), len(last[:kept]))
    assert not walk.closed


@pytest.mark.parametrize("tail", [b"\0", b"\0\0", b'{"h"\0'])
def test_zeros_after_last_line_are_torn(tail):
    """A disk may have made the file longer before it wrote the line."""
    (first,) = seal_lines(OMITTED)
    walk = walk_journal(first + tail, seal=SEAL, where="journal")
    assert (walk.end, walk.torn, walk.damage) == (len(first), len(tail), None)


@pytest.mark.parametrize("kept", [0, 1, 2])
@pytest.mark.parametrize("lost", ["hole", "end", "zeros", "hole and end"])
@pytest.mark.parametrize("before", [[OMITTED], frame_lines("S002"), frame_lines("S001")])
def test_lines_of_one_write_are_torn(kept, lost, before):
    """The lines before are whole, and their files are durable: they count."""
    texts = seal_lines(*before, *frame_lines("S001", attempt=2))
    start = sum(map(len, texts[: len(before) + kept]))
    whole = b"".join(texts)
    hole = whole[: start + 5] + bytes(len(texts[-1])) + whole[start + 5 + len(texts[-1]) :]
    data = {
        **{"hole": hole, "hole and end": hole[:-9], "end": whole[: start + 5]},
        "zeros": whole[: start + 5].ljust(len(whole), b"\0"),
    }[lost]
    walk = walk_journal(data, seal=SEAL, where="journal", cameras=CAMERAS)
    assert (len(walk.lines), walk.damage) == (len(before) + kept, None)
    assert (walk.end, walk.torn) == (start, len(data) - start)


@pytest.mark.parametrize("size", [2, 40, 180, 333, 500, 700])
def test_hole_anywhere_in_write_is_torn(size):
    """Also over newlines, beginnings of lines, and names of steps."""
    before, *texts = seal_lines(OMITTED, *frame_lines("S001"))
    write = b"".join(texts)
    for first in range(0, len(write) - size + 1, 3):
        holed = write[:first] + bytes(size) + write[first + size :]
        walk = walk_journal(before + holed, seal=SEAL, where="journal", cameras=CAMERAS)
        assert walk.damage is None, first
        kept = write[:first].count(b"\n")
        assert (walk.end, len(walk.lines)) == (len(before + b"".join(texts[:kept])), 1 + kept)


LATER_WRITES = {
    "end": [*frame_lines("S001"), END],
    "omission": [*frame_lines("S001"), OMITTED],
    "one camera": [frame_line("S003", "C00"), frame_line("S003", "C00", 2)],
    "second attempt": [*frame_lines("S001"), *frame_lines("S001", attempt=2)],
    "second step": [*frame_lines("S002", VIEWS[:2]), *frame_lines("S004", VIEWS[:2])],
    "step of three": [frame_line("S003", "C00"), *frame_lines("S001")],
    "omission first": [OMITTED, *frame_lines("S004", VIEWS[:2])],
}


@pytest.mark.parametrize("later", LATER_WRITES)
@pytest.mark.parametrize("zeros", [2, 9])
def test_hole_before_later_write_is_damage(later, zeros):
    """Every line before the last write was acknowledged, wherever the hole in it is."""
    texts = seal_lines(*LATER_WRITES[later])
    group = {"end": 1, "omission": 1, "one camera": 1, "step of three": 3, "second attempt": 3}
    group = group.get(later, 2)
    whole = b"".join(texts)
    limit = sum(map(len, texts[:-group]))
    for first in range(0, limit - zeros, 3):
        data = whole[:first] + bytes(zeros) + whole[first + zeros :]
        walk = walk_journal(data, seal=SEAL, where="journal", cameras=CAMERAS)
        assert walk.damage is not None, (first, limit)


@pytest.mark.parametrize("later", ["end", "omission", "second step", "step of three"])
def test_hole_over_newline_of_two_writes_is_damage(later):
    texts = seal_lines(*LATER_WRITES[later])
    group = {"end": 1, "omission": 1, "step of three": 3}.get(later, 2)
    whole, limit = b"".join(texts), sum(map(len, texts[:-group]))
    data = whole[: limit - 20] + bytes(60) + whole[limit + 40 :]
    assert walk_journal(data, seal=SEAL, where="journal", cameras=CAMERAS).damage is not None


def test_flipped_bit_behind_hole_is_damage():
    """The hole is of an interrupted write, the bit is not."""
    texts = seal_lines(*frame_lines("S001"))
    holed = texts[0][:90] + bytes(9) + texts[0][99:]
    for line in (texts[2].replace(b'"iso":100', b'"iso":101'), texts[2][:-2] + b"\r\n"):
        data = holed + texts[1] + line
        assert walk_journal(data, seal=SEAL, where="journal", cameras=CAMERAS).damage is not None


def test_flipped_bit_within_last_write_is_damage():
    first, second, third = seal_lines(*frame_lines("S001"))
    data = first + second.replace(b"frames", b"frbmes") + third
    assert walk_journal(data, seal=SEAL, where="journal", cameras=CAMERAS).damage is not None


def test_spoiled_newline_is_damage():
    """The record is whole: a bit of the newline flipped after the line was durable."""
    first, last = seal_lines(OMITTED, OMITTED)
    walk = walk_journal(first + last[:-1] + b"\x0b", seal=SEAL, where="journal")
    assert f"journal, byte {len(first)}: " in str(walk.damage)
    assert (walk.end, walk.torn, len(walk.lines)) == (len(first), 0, 1)


@pytest.mark.parametrize("spoiled", [b"{}\n", b"[]\n", b'{"r":[]}\n', b"7\n", b"\n", b"\0\0\n"])
def test_line_without_record_is_damage_before_others(spoiled):
    """In the middle, no line is torn."""
    first, last = seal_lines(OMITTED, OMITTED)
    walk = walk_journal(first + spoiled + last, seal=SEAL, where="journal")
    assert f"journal, byte {len(first)}" in str(walk.damage)
    assert (walk.end, walk.torn, len(walk.lines)) == (len(first), 0, 1)


@pytest.mark.parametrize("rest", [b"", b"\0\0"])
def test_newline_at_beginning_is_damage(rest):
    """An interrupted write leaves the beginning of a line, and no line begins with its end."""
    walk = walk_journal(b"\n" + rest, seal=SEAL, where="journal")
    assert (walk.damage is None, walk.torn) == (False, 0)


def test_line_of_unknown_kind_is_named():
    """Sealed as it should be, so that its content must be refused."""
    record = canonical_json({"type": "erasure"})
    digest = hashlib.sha256(SEAL.encode() + record).hexdigest()
    text = b'{"h":"' + digest.encode() + b'","r":' + record + b"}\n"
    walk = walk_journal(text, seal=SEAL, where="journal")
    assert "type: got 'erasure', expected \"frame\"" in str(walk.damage)
    assert "[SR-SES-012]" in str(walk.damage)


def test_changed_hash_is_named_with_expected_one():
    (text,) = seal_lines(OMITTED)
    digest = text[6:70].decode()
    walk = walk_journal(text.replace(b'"h":"', b'"h":"0'), seal=SEAL, where="journal")
    assert f"hash: got '0{digest}', expected {digest}: the line is not" in str(walk.damage)


def test_omission_of_first_version_is_read():
    """Its record was called `left_out`."""
    (text,) = seal_lines(OMITTED)
    record = text[text.index(b'"r":') + 4 : -2].replace(b'"omission"', b'"left_out"')
    digest = hashlib.sha256(SEAL.encode() + record).hexdigest()
    old = b'{"h":"' + digest.encode() + b'","r":' + record + b"}\n"
    assert walk_journal(old, seal=SEAL, where="journal").lines == ((0, OMITTED),)


def test_data_after_end_are_shown_in_part():
    """A message has the first 40 bytes of what follows the end."""
    texts = seal_lines(CloseLine(frames=0, missing=(), reason=""), OMITTED)
    walk = walk_journal(b"".join(texts), seal=SEAL, where="journal")
    assert f"data after the end: got {texts[1][:40]!r}, expected nothing" in str(walk.damage)
    assert walk.closed


def test_unwritable_line_names_its_part():
    attached = AttachmentLine(
        name="a.ply", file="attachments/a.ply", bytes=1, xxh128="0" * 32, about={"x": math.nan}
    )
    omitted = OmissionLine(steps=("S001",), reason="x", about={"x": math.inf}, t_host_s=1.0)
    for line in (attached, omitted):
        with pytest.raises(SessionError, match=r"cannot be written\n  about: got "):
            seal_bounded_line(SEAL, line)
    frame = FrameLine(
        **{"step": "S001", "camera": "cam", "attempt": 1, "file": "frames/S001+cam.dng"},
        **{"bytes": 1, "xxh128": "0" * 32, "settings": {}, "actual": {"x": math.nan}},
        **{"t_box_s": None, "t_host_s": 1.0},
    )
    with pytest.raises(SessionError, match=r"cannot be written\n  settings, actual: got "):
        seal_bounded_line(SEAL, frame)
