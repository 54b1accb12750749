"""A world with a gradient sphere and a caliper: who sees which light, and what was held when."""

import dataclasses
import itertools

import numpy as np
import pytest

from capture.devices.caliper import CaliperBox
from capture.devices.camera import Exposure
from capture.devices.gradient_sphere import GradientSphereBox
from capture.devices.port import Port
from capture.rig import load_rig
from rigsim.boxes.faults import Faults
from rigsim.boxes.gradient_sphere import PatternLight
from rigsim.world.rig_boxes import BOXES
from rigsim.world.taped_skin import GripState
from rigsim.world.world import World

RIG = load_rig("gradient").cropped(16)
NAMES = (f"world-gradient-{number}" for number in itertools.count())


class Recorder:
    """A scene that remembers what it was asked."""

    def __init__(self):
        self.asked = []

    def exposure(self, view_name, *, pops, exposure_s, seed, grip):
        self.asked.append((pops, grip))
        return np.zeros((16, 16), np.uint16)


@pytest.fixture
def world():
    world = World(RIG, seed=2, scene=Recorder())
    world.register(next(NAMES))
    yield world
    world.unregister()


def port(world, box):
    return Port(f"sim://{box}?world={world._name}", clock=world.clock)


def test_shipped_rig_controllers_have_own_serial_and_rig():
    serials = set()
    for name in ("flash", "dome", "gradient", "probe"):
        for box in load_rig(name).boxes:
            assert BOXES[box].rig == name
            serials.add(World(load_rig(name)).box(box).serial)
    assert serials == {"FL-0001", "DM-0001", "GS-0001", "CA-0001", "PR-0001"}


def test_patterns_are_clipped_to_the_exposure(world):
    with GradientSphereBox(port(world, "gradient_sphere")) as box:
        box.arm()
        box.light("x", 0.04, level=0.5)
        box.listen(0.2)
    (light,) = world.switched
    middle_s = 0.5 * (light.t_on_s + light.t_off_s)
    assert world.light_between(0.0, light.t_on_s) == ()
    assert world.light_between(light.t_off_s, world.now) == ()
    (seen,) = world.light_between(middle_s, world.now)
    assert seen == dataclasses.replace(light, t_on_s=middle_s)
    assert isinstance(seen, PatternLight)


def test_exposure_uses_grip_at_its_start(world):
    with CaliperBox(port(world, "caliper")) as box:
        box.arm()
        box.set_force_limit(3.0)
        box.home()
        box.attach()
        times, states = [], []
        for step in (0, 1, -1):
            box.move_to(step)
            times.append(world.now)
            states.append(world.skin.state)
            box.listen(0.1)
        box.release()
    # made late, in another order
    for at in (2, 0, 1):
        world.expose("cam", Exposure(0.01, 100), times[at], seed=0)
        assert world.scene.asked[-1] == ((), states[at])
    assert [s.step for s in states] == [0, 1, -1]
    assert not world.grip_at(world.now).attached
    assert world.grip_at(-1.0) == world.grips[0][1]


def test_grip_history_includes_states_during_motion(world):
    with CaliperBox(port(world, "caliper")) as box:
        box.arm()
        box.set_force_limit(3.0)
        box.home()
        box.attach()
        start_s = world.now
        box.move_to(2)
    on_the_way = [s.stretch for t, s in world.grips if start_s < t <= start_s + 0.8]
    assert len(on_the_way) > 100
    assert on_the_way == sorted(on_the_way)
    times = [t for t, _ in world.grips]
    assert times == sorted(times)


def test_a_world_without_a_caliper_holds_nothing():
    world = World(load_rig("dome").subset(views=["C00"]).resized(16))
    assert (world.grips, world.skin) == ([], None)
    with pytest.raises(ValueError, match="has none"):
        world.grip_at(0.0)


def test_caliper_controller_needs_caliper():
    with pytest.raises(ValueError, match="caliper: got none"):
        World(dataclasses.replace(RIG, caliper=None))


def test_rig_with_caliper_starts_with_skin_at_rest():
    assert World(RIG, seed=4).grip_at(0.0) == GripState(
        0.0,
        World(RIG, seed=4).skin.state.step,
        World(RIG, seed=4).skin.state.aperture_mm,
        1.0,
        False,
        False,
    )


@pytest.mark.parametrize(
    "switches",
    [{"skin_stiff": 0.0}, {"skin_stiff": -1.0}, {"jaw_stall": 1.5}, {"interlock_after": -1.0}],
)
def test_switches_that_make_no_sense_are_named(switches):
    with pytest.raises(ValueError, match=next(iter(switches))):
        Faults(**switches)


def test_stiff_skin_is_stiffer():
    usual, stiff = (World(RIG, seed=1, faults=Faults(skin_stiff=k)).skin for k in (1.0, 7.0))
    ratio = stiff.mechanics.stiffness_n / usual.mechanics.stiffness_n
    assert ratio == pytest.approx(7.0)
