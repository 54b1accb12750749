"""Whatever lines arrive, each box answers each once, and lights or moves only when it is armed."""

import string

import pytest
from fixtures.box_manuals import BOXES

from capture.devices import wire
from capture.devices.wire import Reply, Request

LATE_S = 0.05
"""Within which a box has answered what it answers late: a delayed pop, blades on their way."""
ROUNDS = 6000

each_box = pytest.mark.parametrize("manual", BOXES.values(), ids=BOXES)


def commands_of(manual):
    return [*(text for text, _, _ in manual.all_answers.values()), *manual.ready, *manual.more]


def mutated(text, rng):
    """Return `text` with a few characters changed, doubled, dropped or moved; half as it is."""
    letters = list(text)
    for _ in range(max(0, int(rng.integers(-3, 4)))):
        at = int(rng.integers(0, len(letters) + 1))
        new = string.printable[int(rng.integers(0, 95))]
        match int(rng.integers(0, 4)):
            case 0:
                letters.insert(at, new)
            case 1:
                del letters[at : at + 1]
            case 2:
                letters[at:at] = letters[:at][-3:]
            case _:
                letters[at : at + 1] = [new]
    return "".join(letters)


def any_of(texts, rng):
    return mutated(texts[int(rng.integers(len(texts)))], rng)


def replies(data):
    return [frame for frame in map(wire.decode, data.splitlines()) if isinstance(frame, Reply)]


@each_box
def test_raw_bytes_light_and_move_nothing(manual, rng):
    bench = manual.bench()
    answers = b""
    for k in range(1500):
        data = rng.bytes(int(rng.integers(1, 80)))
        answers += bench.box.feed(data.replace(b"\x00", b"\n"), 0.01 * k)
    assert not bench.box.armed
    assert manual.begun(bench.unit) == 0
    assert manual.idle(bench.unit)
    for line in answers.splitlines():
        assert wire.decode(line).name == "NAK"


@each_box
def test_nearly_valid_unframed_lines_light_and_move_nothing(manual, rng):
    bench, texts = manual.bench(), commands_of(manual)
    for k in range(3000):
        bench.box.feed(any_of(texts, rng).encode() + b"\n", 0.01 * k)
    assert not bench.box.armed
    assert manual.begun(bench.unit) == 0
    assert manual.idle(bench.unit)


@pytest.mark.long
@each_box
def test_framed_nonsense_is_answered_once_acts_only_armed(manual, rng):
    """Half of the lines are good ones and obeyed: a box that refuses all would not pass."""
    bench, texts = manual.bench(), [text for text in commands_of(manual) if text != "home"]
    box, unit = bench.box, bench.unit
    now, accepted, table_armed = 0.0, set(), False
    for seq in range(ROUNDS):
        now += float(rng.exponential(0.1))
        text = any_of([*texts, "SYST:ARM", "SYST:WDOG 5000"], rng)
        if table_armed and rng.random() < 0.5:  # most lines between would disarm it
            text = "TRIG a1"
        if not text:
            continue
        assert replies(box.advance(now)) == []
        armed, begun = box.armed, manual.begun(unit)
        found = replies(box.feed(wire.encode(Request(seq, box.boot, text)), now))
        if not found:
            now += LATE_S
            found = replies(box.advance(now))
        (reply,) = found
        assert reply.seq == seq
        header = text.partition(" ")[0].upper()
        obeyed = reply.code == 0
        assert not obeyed or header in box.commands
        begins = obeyed and f"{text.upper()} ".startswith(tuple(manual.begins))
        assert manual.begun(unit) - begun == begins
        assert armed or not begins
        assert box.armed or manual.idle(unit)
        table_armed = obeyed and header == "SEQ:ARM"
        if obeyed:
            accepted.add(header)
    assert accepted >= manual.all_answers.keys()
