"""Lines of the journal: what each must contain, and where the walk along their chain ends."""

import pytest

from capture.session.errors import SessionDamage
from capture.session.journal import CloseLine, OmissionLine, seal_line, walk_journal

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


def test_data_after_end_is_damage():
    texts = seal_lines(OMITTED, CloseLine(frames=0, missing=(), reason=""))
    assert walk_journal(b"".join(texts), seal=SEAL, where="journal").damage is None
    walk = walk_journal(b"".join([*texts, texts[0]]), seal=SEAL, where="journal")
    assert "data after the end" in str(walk.damage)
    assert len(walk.lines) == 2
    assert walk.end == sum(map(len, texts))


@pytest.mark.parametrize(("zeros", "torn"), [(1, False), (2, True), (3, True)])
def test_line_with_zeros_is_torn_from_two_on(zeros, torn):
    """A flipped bit makes one zero byte at most; an interrupted write leaves more."""
    first, last = seal_lines(OMITTED, OMITTED)
    spoiled = last[:80] + b"\0" * zeros + last[80 + zeros :]
    walk = walk_journal(first + spoiled, seal=SEAL, where="journal")
    assert (walk.damage is None) == torn
    assert walk.torn == (len(spoiled) if torn else 0)
    assert len(walk.lines) == 1
