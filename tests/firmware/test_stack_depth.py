"""Depth of each image's stack, from the paint that its memory keeps where no call has touched it.

Run with `-rP` to see the figures, which docs/validation/firmware.md lists.
"""

import contextlib
import socket
import subprocess

import numpy as np
import pytest
from fixtures.compiled.fuzzing import DEEP, texts_of
from fixtures.compiled.targets import IMAGES, TARGETS, run_mega2560, run_qemu, start_target

from capture.devices.checkup import CheckupPort
from capture.devices.port import CommandRefused

# pyserial leaves ports to the collector
pytestmark = [
    pytest.mark.long,
    pytest.mark.timeout(240),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]
CHIPS = {"mega2560": "mega2560", "mps2-an385": "m3", "mps2-an500": "m7"}
"""By board, the prefix of its images."""
PAINT = 0xC5
AVR_RAM_END = 0x802200
STACK_TOP, PAINTED_BYTES = 0x20300000, 65536
RANDOM_TEXTS, ARMED_TEXTS = 60, 4
MIN_DEPTH_BYTES, MAX_DEPTH_BYTES = 100, 4096


def act(url, box):
    """Ask all of a box's manual, and what a random host asks, armed."""
    rng = np.random.default_rng(7)
    texts = [*texts_of(box), *(DEEP[box](rng) for _ in range(RANDOM_TEXTS)), "SYST:CAP?"]
    with CheckupPort(url, timeout_s=0.5) as port:
        port.hello()
        for number, text in enumerate(texts):
            with contextlib.suppress(CommandRefused):
                if number % ARMED_TEXTS == 0:
                    port.ask("SYST:ARM")
                port.ask(text)


def depth_on_mega2560(image, box):
    """Return the depth of the stack, and how many bytes it has, from the runner's count."""
    names = subprocess.run(["avr-nm", image], check=True, capture_output=True, text=True).stdout
    (start,) = [line.split()[0] for line in names.splitlines() if line.endswith(" _end")]
    room = AVR_RAM_END - int(start, 16)
    with contextlib.closing(run_mega2560(image)) as target:
        act(target.url, box)
        target.command("g")
        target.wait_for(lambda: target.of_pin("untouched"))
        return room - int(target.of_pin("untouched")[0].value), room


def depth_in_qemu(machine, image, box, folder):
    """Return the depth of the stack, and how many bytes are painted, from QEMU's memory."""
    low = STACK_TOP - PAINTED_BYTES
    paint, monitor, dump = folder / "paint", folder / "monitor", folder / "dump"
    paint.write_bytes(bytes([PAINT]) * PAINTED_BYTES)
    more = (
        *("-device", f"loader,file={paint},addr={low:#x},force-raw=on"),
        *("-monitor", f"unix:{monitor},server=on,wait=off"),
    )
    with contextlib.closing(run_qemu(machine, image, more=more)) as target:
        act(target.url, box)
        with socket.socket(socket.AF_UNIX) as console:
            console.connect(str(monitor))
            console.sendall(f'pmemsave {low:#x} {PAINTED_BYTES} "{dump}"\nquit\n'.encode())
            while console.recv(4096):
                pass
    data = np.fromfile(dump, np.uint8)
    return PAINTED_BYTES - int(np.argmax(data != PAINT)), PAINTED_BYTES


@pytest.mark.parametrize(
    ("board", "box"), [(board, box) for board in CHIPS for box in TARGETS[board][0]]
)
def test_stack_stays_within_half_its_room(board, box, tmp_path):
    start_target(board, box).close()  # skips by name
    image = IMAGES / f"{CHIPS[board]}-{box}.elf"
    if board == "mega2560":
        depth, room = depth_on_mega2560(image, box)
    else:
        depth, room = depth_in_qemu(board, image, box, tmp_path)
    print(f"{image.stem}: deepest stack {depth} bytes")
    assert MIN_DEPTH_BYTES < depth < min(room // 2, MAX_DEPTH_BYTES)
