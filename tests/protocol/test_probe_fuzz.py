"""Whatever lines arrive: a probe lights and sucks only when armed, and each line is answered."""

import string

from capture.devices import wire
from capture.devices.wire import Reply, Request
from capture.rig import load_rig
from rigsim.world import World

RIG = load_rig("probe")
COMMANDS = [
    "*IDN?",
    "*RST",
    "*CLS",
    "*OPC?",
    "SYST:ERR?",
    "SYST:WDOG 5000",
    "SYST:ARM",
    "SYST:ARM",
    "SYST:ARM",
    "SYST:PING?",
    "SAFE",
    "STAT?",
    "SYST:CAP:PART? 1",
    "HEAD:SITE cheek,0",
    "HEAD:SITE forehead,22.5",
    "HEAD:SITE?",
    "HEAD:FREE",
    "PUMP ON,3000,60",
    "PUMP ON,500,150",
    "PUMP ON,3000,60",
    "PUMP VENT",
    "PUMP?",
    "PUMP:LAST?",
    "PRES?",
    "LED 500",
    "LED 1000",
    "LED 0",
    "LED?",
    "SHUT OPEN,50",
    "SHUT OPEN,900",
    "SHUT CLOSE",
    "SHUT?",
    "SHUT:LAST?",
    "SHUT:COUN?",
    "FIB 3",
    "FIB ALL",
    "FIB?",
    "CAM:TRIG d1",
    "CAM:TEMP?",
    "DOSE?",
    "DOSE:NEW p",
]


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


def replies(data):
    return [frame for frame in map(wire.decode, data.splitlines()) if isinstance(frame, Reply)]


def test_framed_nonsense_is_answered_once_and_acts_only_on_an_armed_box(rng):
    world = World(RIG, seed=1)
    box = world.box("probe")
    unit = box.device
    now, accepted, seq = 0.0, {}, 0
    for _ in range(6000):
        now += float(rng.exponential(0.1))
        text = mutated(COMMANDS[int(rng.integers(len(COMMANDS)))], rng)
        if not text:
            continue
        assert replies(box.advance(now)) == []
        armed, openings, suctions = box.armed, unit.shutter.count, unit.pump.count
        seq += 1
        found = replies(box.feed(wire.encode(Request(seq, box.boot, text)), now))
        if not found:  # blades that are on their way
            now += 1e-3
            found = replies(box.advance(now))
        (reply,) = found
        assert reply.seq == seq
        header, _, arguments = text.partition(" ")
        header = header.upper()
        assert reply.code != 0 or header in box.commands
        if reply.code == 0:
            accepted[header] = accepted.get(header, 0) + 1
        opened, sucked = unit.shutter.count - openings, unit.pump.count - suctions
        begins = reply.code == 0 and arguments.upper().startswith("O")
        assert opened == (begins and header == "SHUT")
        assert sucked == (begins and header == "PUMP")
        assert armed or not (opened or sucked)
        assert box.armed or not (unit.lit or unit.pump.drawing or unit.pump.placement)
        assert not unit.pump.drawing or unit.pump.placement is not None
    # every command was accepted at least once, so that refusing all of them would not pass
    assert set(accepted) >= {command.partition(" ")[0] for command in COMMANDS}
    assert unit.shutter.count > 20
    assert unit.pump.count > 20


def test_bytes_that_are_no_lines_do_nothing(rng):
    world = World(RIG, seed=1)
    box = world.box("probe")
    box.feed(wire.encode(Request(1, box.boot, "SYST:ARM")), 0.0)
    for number in range(500):
        noise = rng.integers(0, 256, size=int(rng.integers(1, 60)), dtype="uint8").tobytes()
        box.feed(noise + b"\n", 0.001 * number)
        assert (box.device.lit, box.device.pump.drawing) == (False, False)
    assert box.device.shutter.count == box.device.pump.count == 0
