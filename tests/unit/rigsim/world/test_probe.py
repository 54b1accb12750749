"""A world with a contact probe: who sees which light, and what the head touched when."""

import dataclasses
import itertools

import numpy as np
import pytest

from capture.devices.camera import Exposure, Trigger, open_camera
from capture.devices.port import Port
from capture.devices.probe import ProbeBox
from capture.rig import load_rig
from rigsim.boxes.contact_probe.source_shutter import SourceLight
from rigsim.boxes.faults import Faults
from rigsim.world.suction import HeadState
from rigsim.world.world import World

RIG = load_rig("probe")
NAMES = (f"world-probe-{number}" for number in itertools.count())


class Recorder:
    """A scene that remembers what it was asked."""

    def __init__(self):
        self.asked = []

    def exposure(self, view_name, *, pops, exposure_s, seed, head):
        self.asked.append((pops, exposure_s, head))
        return np.zeros((16, 16), np.uint16)


@pytest.fixture
def make():
    worlds = []

    def make(scene=None, **faults):
        world = World(RIG, seed=2, scene=scene, faults=Faults(**faults))
        world.register(next(NAMES))
        worlds.append(world)
        return world, ProbeBox(Port(f"sim://probe?world={world._name}", clock=world.clock))

    yield make
    for world in worlds:
        world.unregister()


def light(box, level=1.0):
    """Have the head held and the LED on."""
    box.arm()
    box.place("cheek", 0.0)
    box.set_level(level)
    box.suck(60.0, 20.0)
    box.listen(1.0)


def test_light_is_clipped_to_the_exposure(make):
    world, box = make()
    light(box, 0.5)
    box.cover(4)
    box.open_shutter(0.04)
    middle_s = box.last_opening().t_open_s + 0.02
    (still,) = world.light_between(0.0, world.now)
    assert still.t_off_s == world.now
    box.listen(0.2)
    (ended,) = world.switched
    assert world.light_between(0.0, ended.t_on_s) == ()
    assert world.light_between(ended.t_off_s, world.now) == ()
    (seen,) = world.light_between(middle_s, world.now)
    assert seen == dataclasses.replace(ended, t_on_s=middle_s)
    assert isinstance(seen, SourceLight)
    assert (seen.level, seen.fiber) == (0.5, 4)
    box.close()


def test_exposure_uses_head_contact_at_its_start(make):
    scene = Recorder()
    world, box = make(scene)
    times = []
    for site, angle_deg in (("forehead", 0.0), ("cheek", 90.0)):
        box.arm()
        box.place(site, angle_deg)
        box.suck(60.0, 10.0)
        box.listen(0.2)
        times.append(world.now)
        box.listen(1.0)
        times.append(world.now)
        box.vent()
        box.listen(RIG.probe.rest_s)
    box.take_away()
    times.append(world.now)
    # made late, in another order
    found = {}
    for at in (3, 0, 4, 1, 2):
        world.expose("cam", Exposure(0.01, 100), times[at], seed=0)
        found[at] = scene.asked[-1][2]
        assert found[at] == world.head_at(times[at])
    assert [found[k].site for k in range(5)] == ["forehead", "forehead", "cheek", "cheek", ""]
    assert [found[k].angle_deg for k in (1, 3)] == [0.0, 90.0]
    assert 20.0 < found[0].suction_mbar < found[1].suction_mbar < 60.0
    assert found[4].suction_mbar < 0.01
    assert not found[4].placed
    box.close()


def test_shutter_triggers_camera_which_receives_its_light(make):
    scene = Recorder()
    world, box = make(scene)
    light(box)
    with_camera = open_camera(f"sim://{world._name}/cam")
    with_camera.configure(Exposure(0.3, 100))
    with_camera.arm(1, Trigger.EDGE)
    box.open_shutter(0.5)
    frame = with_camera.frame(5.0)
    ((seen,), exposure_s, head) = scene.asked[0]
    assert (seen.t_on_s, seen.t_off_s) == pytest.approx((frame.t_start_s, frame.t_end_s))
    assert (exposure_s, head.site) == (0.3, "cheek")
    box.close()


def test_a_world_without_a_scene_gives_black_frames(make):
    world, box = make()
    image = world.expose("cam", Exposure(0.01, 100), 0.0, seed=0)
    view = RIG.views[0]
    assert image.shape == (view.height_px, view.width_px)
    # 153,600 pixels: the mean's standard error is 0.005 DN
    assert abs(image.mean() - view.black_level) < 0.03
    box.close()


def test_head_history_starts_in_air_and_goes_forward(make):
    world, box = make()
    assert world.head_history == [(0.0, HeadState("", 0.0, False, 0.0, RIG.probe.camera_c))]
    box.arm()
    box.place("chin", 0.0)
    box.suck(100.0, 1.0)
    box.listen(2.0)
    times = [t for t, _ in world.head_history]
    assert times == sorted(times)
    assert len(set(times)) == len(times)
    for t_s, state in world.head_history:
        assert world.head_at(t_s) == state
    assert world.head_at(-1.0) == world.head_history[0][1]
    box.close()


def test_camera_warming_is_passed_to_scene(make):
    world, box = make(camera_warms_after=1.0)
    world.clock.sleep(300.0)
    assert world.head_at(0.5).camera_c == RIG.probe.camera_c
    assert world.head_at(300.0).camera_c > RIG.probe.camera_c + 15.0
    assert box.camera_c() == pytest.approx(world.head_at(world.now).camera_c, abs=0.2)
    box.close()


def test_a_world_without_a_probe_has_no_head():
    world = World(load_rig("dome").subset(views=["C00"]).resized(16))
    assert (world.head_history, world.head, world.switched) == ([], None, [])
    with pytest.raises(ValueError, match="has none"):
        world.head_at(0.0)


def test_probe_controller_needs_probe():
    with pytest.raises(ValueError, match="probe: got none"):
        World(dataclasses.replace(RIG, probe=None))


@pytest.mark.parametrize(
    "switches",
    [
        {"pump_leak": -0.1},
        {"shutter_stuck": 1.5},
        {"shutter_jam": -1.0},
        {"head_lifts_after": -1.0},
        {"gauge_dead_after": -1.0},
        {"camera_warms_after": -1.0},
    ],
)
def test_switches_that_make_no_sense_are_named(switches):
    with pytest.raises(ValueError, match=next(iter(switches))):
        Faults(**switches)


def test_same_seed_gives_same_bytes_at_same_times():
    def transcript(seed):
        world = World(RIG, seed=seed, faults=Faults(drop=0.001, shutter_stuck=0.2, pump_leak=0.1))
        name = world.register(next(NAMES))
        with ProbeBox(Port(f"sim://probe?world={name}", clock=world.clock, first_seq=1)) as box:
            box.arm()
            box.place("cheek", 0.0)
            box.suck(60.0, 5.0)
            for _ in range(4):
                box.listen(0.3)
                box.pressure_mbar()
        world.unregister()
        return world.transcript_sha256

    assert transcript(1) == transcript(1)
    assert transcript(1) != transcript(2)
