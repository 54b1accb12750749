"""Lines of the journal: what each must contain, and where the walk along their chain ends."""

import pytest

from capture.session.errors import SessionDamage, SessionError
from capture.session.journal import (
    MAX_LINE_BYTES,
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
    assert walk.end == sum(map(len, texts))


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
