"""A dome's host that is killed or freezes while the box steps: dark within the lease."""

import signal

import numpy as np
import pytest

from capture.plan.eye_light import eye_light
from capture.rig import load_rig

RIG = load_rig("dome").subset(views=["C00"]).resized(16)
UNSEEN = [int(k) for k in np.argsort(eye_light(RIG), kind="stable")[:60]]
# long against the pauses of a busy machine: a host that is held up before the blow trips it too
LEASE_S = 2.0
EXACT_S = 0.001  # the box keeps its own time
GIVE_UP_S = 60.0

HOST = """
import sys
from capture.devices.dome import DomeBox, TableRow
from capture.devices.port import Port

box = DomeBox(Port(sys.argv[1]))
box.set_lease(float(sys.argv[2]))
leds = [int(part) for part in sys.argv[3].split("+")]
box.load([TableRow((led,), 1.0, 0.08, 1) for led in leds])
box.arm()
box.arm_sequence(len(leds))
box.trigger("killed")
while True:
    if box.listen(0.1):
        print("stepping", flush=True)
"""


@pytest.mark.parametrize("transport", ["pty", "tcp"])
@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "frozen"])
def test_a_host_that_dies_in_a_sequence_leaves_the_dome_dark_within_the_lease(
    host_at_work, last_heard, transport, blow
):
    served, host = host_at_work(
        HOST,
        RIG,
        ("dome",),
        LEASE_S,
        "+".join(map(str, UNSEEN)),
        pty=transport == "pty",
        word="stepping",
        at_work=lambda world: world.box("dome").device.running,
    )
    world, box = served.world, served.world.box("dome")
    host.send_signal(blow)
    struck_s = world.now
    # between two lights it is dark while it runs
    while box.device.running or box.device.lit:
        assert world.now < struck_s + GIVE_UP_S
        served.wait(0.01)
    assert not box.armed
    assert box.tripped
    dark_s = world.switched[-1].t_off_s
    print(f"dark {1e3 * (dark_s - struck_s):.0f} ms after the host fell silent")
    assert dark_s - last_heard(box) <= LEASE_S + EXACT_S
    steps = len(world.switched)
    served.wait(0.2)
    assert len(world.switched) == steps
