"""A host of the probe that is killed or freezes: dark and vented within the lease."""

import signal
import subprocess
import sys

import pytest

from capture.rig import load_rig
from rigsim.serve import serve

RIG = load_rig("probe")
# long against the pauses of a busy machine: a host that is held up before the blow trips it too
LEASE_S = 2.0
# the operating system's scheduling on a busy machine; the box itself is exact
MARGIN_S = 0.25

HOST = """
import sys
from capture.devices.port import Port
from capture.devices.probe import ProbeBox

box = ProbeBox(Port(sys.argv[1]))
box.set_lease(float(sys.argv[2]))
box.arm()
box.place("cheek", 0.0)
box.set_level(1.0)
box.suck(60.0, 50.0)
box.listen(0.7)
box.open_shutter(25.0)
while True:
    box.listen(0.1)
    print("shining", flush=True)
"""


@pytest.mark.parametrize("transport", ["pty", pytest.param("tcp", marks=pytest.mark.long)])
@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "frozen"])
def test_a_host_that_dies_leaves_the_head_dark_and_vented_within_the_lease(transport, blow):
    with serve(RIG, pty=transport == "pty") as served:
        world = served.world
        host = subprocess.Popen(
            [sys.executable, "-c", HOST, served.addresses["probe"], str(LEASE_S)],
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            for _ in range(2):
                assert host.stdout.readline() == "shining\n"
            box = world.box("probe")
            assert box.device.lit
            assert world.head_at(world.now).suction_mbar > 20.0
            host.send_signal(blow)
            struck_s = world.now
            while box.device.lit or box.device.pump.drawing:
                assert world.now < struck_s + 5.0
                served.wait(0.01)
            assert (box.armed, box.tripped) == (False, True)
            (light,) = world.sources
            vented_s = [t_s for t_s, _ in world.heads][-1]
            dark_s = light.t_off_s
            print(
                f"dark {1e3 * (dark_s - struck_s):.0f} ms after, vented {vented_s - struck_s:.3f} s"
            )
            assert max(dark_s, vented_s) - struck_s <= LEASE_S + MARGIN_S
            assert not world.head_at(world.now).placed
            served.wait(0.3)
            assert world.head_at(world.now).suction_mbar < 1.0
            assert len(world.sources) == 1
        finally:
            host.kill()
            host.wait()
            host.stdout.close()
