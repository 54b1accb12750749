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
    seal_bounded_line,
    seal_line,
    walk_journal,
)

SEAL = "0" * 64
OMITTED = OmissionLine(steps=("S001",), reason="blinked", about={}, t_host_s=1.0)


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
@pytest.mark.parametrize("lost", ["hole", "end", "zeros"])
def test_lines_of_one_write_are_torn(kept, lost):
    """The lines before are whole, and their files are durable: they count."""
    texts = seal_lines(*(OMITTED,) * 4)
    start = sum(map(len, texts[: 1 + kept]))
    whole = b"".join(texts)
    data = {
        "hole": whole[: start + 5] + bytes(len(texts[-1])) + whole[start + 5 + len(texts[-1]) :],
        "end": whole[: start + 5],
        "zeros": whole[: start + 5].ljust(len(whole), b"\0"),
    }[lost]
    walk = walk_journal(data, seal=SEAL, where="journal", max_group=3)
    assert (len(walk.lines), walk.damage) == (1 + kept, None)
    assert (walk.end, walk.torn) == (start, len(data) - start)


@pytest.mark.parametrize("end", [b"", b'{"h"'])
def test_hole_before_lines_of_later_writes_is_damage(end):
    first, second, *later = seal_lines(*(OMITTED,) * 4)
    data = first + second[:5] + bytes(9) + second[14:] + b"".join(later) + end
    group = 2 + bool(end)
    walk = walk_journal(data, seal=SEAL, where="journal", max_group=group)
    assert walk.damage is not None
    assert walk_journal(data, seal=SEAL, where="journal", max_group=group + 1).damage is None


def test_flipped_bit_within_last_write_is_damage():
    first, second, third = seal_lines(*(OMITTED,) * 3)
    data = first + second.replace(b"omission", b"omissiom") + third
    assert walk_journal(data, seal=SEAL, where="journal", max_group=3).damage is not None


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
