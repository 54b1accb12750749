"""A host of sphere and caliper that is killed or freezes: dark and let go within the lease."""

import signal

import pytest

from capture.rig import load_rig

RIG = load_rig("gradient").cropped(16)
# long against the pauses of a busy machine: a host that is held up before the blow trips it too
LEASE_S = 2.0
EXACT_S = 0.001  # the boxes keep their own time
GIVE_UP_S = 60.0

HOST = """
import sys
from capture.devices.caliper import CaliperBox
from capture.devices.gradient_sphere import GradientSphereBox, PatternRow
from capture.devices.port import Port

sphere, caliper = GradientSphereBox(Port(sys.argv[1])), CaliperBox(Port(sys.argv[2]))
for box in (sphere, caliper):
    box.set_lease(float(sys.argv[3]))
sphere.set_eyes("closed")
sphere.load([PatternRow("x", 0.0, 0.2, 0.2, 1)] * 60)
caliper.set_force_limit(5.0)
caliper.arm()
caliper.home()
caliper.attach()
caliper.port.ask("CAL:STEP:ABS 2")
sphere.arm()
sphere.arm_scan(60)
caliper.force_n()
sphere.trigger("killed")
while True:
    caliper.force_n()
    if sphere.listen(0.1):
        print("stepping", flush=True)
"""


@pytest.mark.parametrize("transport", ["pty", pytest.param("tcp", marks=pytest.mark.long)])
@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "frozen"])
def test_a_host_that_dies_leaves_the_sphere_dark_and_the_skin_free_within_the_lease(
    host_at_work, last_heard, transport, blow
):
    boxes = ("gradient_sphere", "caliper")
    served, host = host_at_work(
        HOST,
        RIG,
        boxes,
        LEASE_S,
        pty=transport == "pty",
        word="stepping",
        at_work=lambda world: world.box(boxes[0]).device.running and world.skin.state.attached,
    )
    world = served.world
    sphere, caliper = (world.box(name) for name in boxes)
    host.send_signal(blow)
    struck_s = world.now
    while world.skin.state.attached or sphere.device.lit:
        assert world.now < struck_s + GIVE_UP_S
        served.wait(0.01)
    for box in (sphere, caliper):
        assert (box.armed, box.tripped) == (False, True)
    dark_s, (free_s, state) = world.switched[-1].t_off_s, world.grips[-1]
    print(f"dark {1e3 * (dark_s - struck_s):.0f} ms after, free {free_s - struck_s:.3f} s")
    assert dark_s - last_heard(sphere) <= LEASE_S + EXACT_S
    assert free_s - last_heard(caliper) <= LEASE_S + EXACT_S
    assert (state.attached, state.stretch) == (False, 1.0)
    grips = len(world.grips)
    served.wait(0.2)
    assert len(world.grips) == grips
