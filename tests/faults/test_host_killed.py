"""A host that is killed or freezes at work: its boxes are dark and let go within the lease."""

import signal
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from capture.plan.eye_light import eye_irradiance
from capture.rig import Rig, load_rig

EXACT_S = 0.001  # a box keeps its own time
GIVE_UP_S = 60.0


@dataclass(frozen=True, repr=False)
class Work:
    """What a host has its boxes do when it is struck."""

    rig: Rig
    script: str
    """Its arguments are the boxes' addresses, and the lease; it prints "at work" over and over."""
    at_work: Callable[[Any], bool]
    """Whether the boxes of a world do it."""
    over: Callable[[Any], bool]
    """Whether all lights are out, and nothing is held."""
    ended_s: Callable[[Any], dict[str, float]]
    """When each box's work ended, on the world's clock."""
    rests: Callable[[Any], bool] = lambda world: True
    """Whether what was held is free and at rest, a while after."""
    lease_s: float = 2.0
    """Long against the pauses of a busy machine: a host held up before the blow trips it too."""


FLASH = Work(
    load_rig("flash").resized(16),
    """
from capture.devices.flash import FlashBox
from capture.devices.port import CommandRefused
box = FlashBox(Port(sys.argv[1]))
box.set_lease(lease_s)
box.arm()
while True:
    try:
        box.lamp_on(0.5)
    except CommandRefused:  # a busy machine held this host up for longer than the lease
        box.arm()
        continue
    print("at work", flush=True)
    box.port.listen(0.02)
""",
    at_work=lambda world: world.box("flash").device.lit,
    over=lambda world: not world.box("flash").device.lit,
    ended_s=lambda world: {"flash": world.box("flash").device.lamp_times[-1][1]},
    lease_s=0.3,  # the lamp's own end comes after .5 s
)

DOME_RIG = load_rig("dome").subset(views=["C00"]).resized(16)
UNSEEN = "+".join(str(k) for k in np.argsort(eye_irradiance(DOME_RIG), kind="stable")[:60])
DOME = Work(
    DOME_RIG,
    f"""
from capture.devices.dome import DomeBox, TableRow
box = DomeBox(Port(sys.argv[1]))
box.set_lease(lease_s)
leds = [int(part) for part in "{UNSEEN}".split("+")]
box.load([TableRow((led,), 1.0, 0.08, 1) for led in leds])
box.arm()
box.arm_sequence(len(leds))
box.trigger("killed")
while True:
    if box.listen(0.1):
        print("at work", flush=True)
""",
    at_work=lambda world: world.box("dome").device.is_running,
    # between two lights it is dark while it runs
    over=lambda world: not (world.box("dome").device.is_running or world.box("dome").device.lit),
    ended_s=lambda world: {"dome": world.switched[-1].t_off_s},
)

GRADIENT = Work(
    load_rig("gradient").cropped(16),
    """
from capture.devices.caliper import CaliperBox
from capture.devices.gradient_sphere import GradientSphereBox, PatternRow
sphere, caliper = GradientSphereBox(Port(sys.argv[1])), CaliperBox(Port(sys.argv[2]))
for box in (sphere, caliper):
    box.set_lease(lease_s)
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
        print("at work", flush=True)
""",
    at_work=lambda world: (
        world.box("gradient_sphere").device.is_running and world.skin.state.attached
    ),
    over=lambda world: not (world.box("gradient_sphere").device.lit or world.skin.state.attached),
    ended_s=lambda world: {
        "gradient_sphere": world.switched[-1].t_off_s,
        "caliper": world.grips[-1][0],
    },
    rests=lambda world: (world.grips[-1][1].attached, world.grips[-1][1].stretch) == (False, 1.0),
)

PROBE = Work(
    load_rig("probe"),
    """
from capture.devices.probe import ProbeBox
box = ProbeBox(Port(sys.argv[1]))
box.set_lease(lease_s)
box.arm()
box.place("cheek", 0.0)
box.set_level(1.0)
box.suck(60.0, 50.0)
box.listen(0.7)
box.open_shutter(25.0)
while True:
    box.listen(0.1)
    print("at work", flush=True)
""",
    at_work=lambda world: (
        world.box("probe").device.lit and world.head_at(world.now).suction_mbar > 20.0
    ),
    over=lambda world: (
        not (world.box("probe").device.lit or world.box("probe").device.pump.is_pumping)
    ),
    ended_s=lambda world: {"probe": max(world.switched[-1].t_off_s, world.head_history[-1][0])},
)

WORK = {"flash": FLASH, "dome": DOME, "gradient": GRADIENT, "probe": PROBE}
SLOW = ("gradient", "probe")


@pytest.mark.long
@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "frozen"])
@pytest.mark.parametrize(
    ("rig", "transport"),
    [
        pytest.param(rig, transport, marks=[pytest.mark.long] * (way_is_slow and rig in SLOW))
        for rig in WORK
        for transport, way_is_slow in (("pty", False), ("tcp", True))
    ],
)
def test_dead_host_leaves_controllers_safe_within_lease(
    host_at_work, last_heard, rig, transport, blow
):
    work = WORK[rig]
    served, host = host_at_work(
        work.script, work.rig, work.lease_s, pty=transport == "pty", at_work=work.at_work
    )
    world = served.world
    host.send_signal(blow)
    struck_s = world.now
    while not work.over(world):
        assert world.now < struck_s + GIVE_UP_S
        served.wait(0.01)
    ended_s = work.ended_s(world)
    for name, end_s in ended_s.items():
        box = world.box(name)
        assert (box.armed, box.tripped) == (False, True)
        print(f"{name} safe {1e3 * (end_s - struck_s):.0f} ms after the host fell silent")
        assert end_s - last_heard(box) <= work.lease_s + EXACT_S
    served.wait(0.3)
    assert work.ended_s(world) == ended_s
    assert work.rests(world)
