"""A host of the probe that is killed or freezes: dark and vented within the lease."""

import signal

import pytest

from capture.rig import load_rig

RIG = load_rig("probe")
# long against the pauses of a busy machine: a host that is held up before the blow trips it too
LEASE_S = 2.0
EXACT_S = 0.001  # the box keeps its own time
GIVE_UP_S = 60.0

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
def test_a_host_that_dies_leaves_the_head_dark_and_vented_within_the_lease(
    host_at_work, last_heard, transport, blow
):
    def at_work(world):
        return world.box("probe").device.lit and world.head_at(world.now).suction_mbar > 20.0

    served, host = host_at_work(
        HOST, RIG, ("probe",), LEASE_S, pty=transport == "pty", word="shining", at_work=at_work
    )
    world, box = served.world, served.world.box("probe")
    host.send_signal(blow)
    struck_s = world.now
    while box.device.lit or box.device.pump.drawing:
        assert world.now < struck_s + GIVE_UP_S
        served.wait(0.01)
    assert (box.armed, box.tripped) == (False, True)
    (light,) = world.switched
    vented_s = [t_s for t_s, _ in world.heads][-1]
    dark_s = light.t_off_s
    print(f"dark {1e3 * (dark_s - struck_s):.0f} ms after, vented {vented_s - struck_s:.3f} s")
    assert max(dark_s, vented_s) - last_heard(box) <= LEASE_S + EXACT_S
    assert not world.head_at(world.now).placed
    served.wait(0.3)
    assert world.head_at(world.now).suction_mbar < 1.0
    assert len(world.switched) == 1
