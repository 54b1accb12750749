"""Whatever lines arrive: a sphere lights and a caliper moves only when armed, each is answered."""

import string

import pytest

from capture.devices import wire
from capture.devices.wire import Reply, Request
from capture.rig import load_rig
from rigsim.world import World

RIG = load_rig("gradient").cropped(16)
SHARED = [
    "*IDN?",
    "*RST",
    "*CLS",
    "*OPC?",
    "SYST:ERR?",
    "SYST:WDOG 5000",
    "SYST:ARM",
    "SYST:ARM",
    "SYST:PING?",
    "SAFE",
    "STAT?",
    "SYST:CAP:PART? 1",
]
COMMANDS = {
    "gradient_sphere": [
        *SHARED,
        "SEQ:CLE",
        "SEQ:DEF 0,X:0:500:30000:1;-Y:90:400:30000:1",
        "SEQ:CRC?",
        "SEQ:ARM 2",
        "TRIG t1",
        "SEQ:POS?",
        "SEQ:STEP? 0",
        "PATT X,80,500",
        "PATT DARK",
        "PATT?",
        "POL 90",
        "POL 0",
        "POL:ANG 45.5",
        "POL?",
        "GAIN:CLE",
        "GAIN:DEF 0,1000+990",
        "GAIN:CRC?",
        "CAM:MASK 1",
        "CAM:TRIG d1",
        "SAFE:EYES CLOSED",
        "DOSE? 3",
        "DOSE:NEW p",
    ],
    "caliper": [
        *SHARED,
        "CAL:HOME",
        "CAL:HOME",
        "CAL:STEP:ABS 2",
        "CAL:STEP:ABS -2",
        "CAL:STEP:ABS 7",
        "CAL:POS?",
        "CAL:LAST?",
        "CAL:ANG 45",
        "CAL:ANG?",
        "CAL:ATT",
        "CAL:ATT?",
        "CAL:REL",
        "CAL:FORC?",
        "CAL:FORC:LIM 1.5",
        "CAL:FORC:LIM 9",
        "CAL:FORC:LIM?",
    ],
}


def mutated(text, rng):
    """Return `text` with a few characters changed, doubled, dropped or moved; half as it is."""
    letters = list(text)
    for _ in range(max(0, int(rng.integers(-3, 4)))):
        at = int(rng.integers(0, len(letters) + 1))
        new = string.printable[int(rng.integers(0, 95))]
        match int(rng.integers(0, 3)):
            case 0:
                letters.insert(at, new)
            case 1:
                del letters[at : at + 1]
            case _:
                letters[at : at + 1] = [new]
    return "".join(letters)


@pytest.mark.parametrize("name", COMMANDS)
def test_framed_nonsense_is_answered_once_and_acts_only_on_an_armed_box(name, rng):
    world = World(RIG, seed=1)
    box = world.box(name)
    now, accepted = 0.0, {}
    for seq in range(4000):
        now += float(rng.exponential(0.1))
        text = mutated(COMMANDS[name][int(rng.integers(len(COMMANDS[name])))], rng)
        if not text:
            continue
        box.advance(now)
        armed, limit = box.armed, getattr(box.device, "limit_n", None)
        moves = len(getattr(box.device, "moves", ()))
        said = box.feed(wire.encode(Request(seq, box.boot, text)), now)
        (reply,) = [f for f in map(wire.decode, said.splitlines()) if isinstance(f, Reply)]
        assert reply.seq == seq
        header = text.partition(" ")[0].upper()
        assert reply.code != 0 or header in box.commands
        if reply.code == 0:
            accepted[header] = accepted.get(header, 0) + 1
        if name == "caliper":
            begun = len(box.device.moves) - moves
            assert begun == (reply.code == 0 and header in ("CAL:HOME", "CAL:STEP:ABS"))
            assert not begun or (armed and limit is not None)
            assert box.armed or not box.device.attached
        else:
            assert box.armed or not box.device.lit
            assert abs(sum(box.device.bank._dose_ws)) < 132 * RIG.leds.dose_ws
    # every command was accepted at least once, so that refusing all of them would not pass
    assert set(accepted) >= {command.partition(" ")[0] for command in COMMANDS[name]}
