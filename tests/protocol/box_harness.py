"""Coverage-guided fuzzing of the flash box: a program of its own, run by test_fuzz.py.

Input is cut into acts at its newlines: the first byte of each says whether it is sent as it is, or
framed with the right number, epoch and checksum (raw bytes never get past the checksum), and how
much time passes before. The box must survive, answer each frame once, and light only when armed.

Usage: python box_harness.py [libFuzzer options] CORPUS_FOLDER
"""

import dataclasses
import resource
import sys

import atheris

with atheris.instrument_imports(include=["rigsim.boxes", "capture.devices.wire"]):
    import numpy as np

    from capture.devices import wire
    from capture.devices.wire import Reply, Request
    from rigsim.boxes.controller import Controller
    from rigsim.boxes.device import Wiring
    from rigsim.boxes.flash import FlashUnit

from capture.rig import load_rig

RIG = dataclasses.replace(
    load_rig("flash"), recycle_s=0.1, max_pops_per_min=20, polarizer_move_s=0.1
)


def one_input(data):
    unit = FlashUnit(Wiring(rig=RIG, rng=np.random.default_rng(0)))
    box = Controller(unit, serial="FL-0001", rng=np.random.default_rng(1))
    now_s = 0.0
    for seq, act in enumerate(data.split(b"\n")[:200]):
        if not act:
            continue
        now_s += (act[0] & 0x7F) * 0.01
        box.advance(now_s)
        armed, count = box.armed, unit.count
        text = "".join(chr(0x20 + byte % 0x5F) for byte in act[1:])[:800]
        if act[0] & 0x80 or not text:
            box.feed(act[1:] + b"\n", now_s)
            assert unit.count == count
        else:
            said = box.feed(wire.encode(Request(seq, box.boot, text)), now_s)
            if not said:  # a delayed pop
                now_s += 0.05
                said = box.advance(now_s)
            frames = [wire.decode(line) for line in said.splitlines()]
            (reply,) = [frame for frame in frames if isinstance(frame, Reply)]
            assert reply.seq == seq
            assert unit.count == count or (armed and reply.code == 0)
        assert box.armed or not unit.lit


MEMORY_BYTES = 2 << 30

if __name__ == "__main__":
    # In place of libFuzzer's own limit, which reads a peak that is inherited from the parent.
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
    atheris.Setup(sys.argv, one_input)
    atheris.Fuzz()
