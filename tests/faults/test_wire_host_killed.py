"""A host that is killed or freezes with a lamp on: the box is dark within its lease."""

import signal
import subprocess
import sys

import pytest

from capture.rig import load_rig
from rigsim.serve import serve

LEASE_S = 0.3
# the operating system's scheduling on a busy machine; the box itself is exact to a millisecond
MARGIN_S = 0.25

HOST = """
import sys
from capture.devices.flash import FlashBox
from capture.devices.port import Port

box = FlashBox(Port(sys.argv[1]))
box.set_lease(float(sys.argv[2]))
box.arm()
while True:
    box.lamp_on(0.5)
    print("lit", flush=True)
    box.port.listen(0.02)
"""


@pytest.fixture
def lamp_keeper():
    """Start a host process that keeps the lamp on; it is gone when the test ends."""
    started = []

    def lamp_keeper(url):
        process = subprocess.Popen(
            [sys.executable, "-c", HOST, url, str(LEASE_S)], stdout=subprocess.PIPE, text=True
        )
        started.append(process)
        for _ in range(3):
            assert process.stdout.readline() == "lit\n"
        return process

    yield lamp_keeper
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.mark.parametrize("transport", ["pty", "tcp"])
@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "frozen"])
def test_a_host_that_dies_leaves_the_box_dark_within_the_lease(lamp_keeper, transport, blow):
    with serve(load_rig("flash").resized(16), pty=transport == "pty") as served:
        host = lamp_keeper(served.addresses["flash"])
        world, box = served.world, served.world.box("flash")
        assert box.device.lit
        host.send_signal(blow)
        struck_s = world.now
        while box.device.lit and world.now < struck_s + 5.0:
            served.wait(0.01)
        assert not box.device.lit
        assert not box.armed
        dark_s = box.device.lamp_times[-1][1]
        print(f"dark {1e3 * (dark_s - struck_s):.0f} ms after the host fell silent")
        assert dark_s - struck_s <= LEASE_S + MARGIN_S
        assert box.tripped
