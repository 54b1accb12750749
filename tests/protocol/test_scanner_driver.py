"""The driver of the scanner's box over sim://: what is asked for is shown and released."""

import itertools

import numpy as np
import pytest

from capture.devices.camera import Exposure, Trigger, open_camera
from capture.devices.port import CommandRefused, Port, WrongDevice
from capture.devices.scanner import ScannerBox
from capture.devices.wire import Code
from capture.rig import load_rig
from rigsim.boxes.faults import Faults
from rigsim.world import World

RIG = load_rig("dome").subset(views=["C00"], lights=["L000"]).resized(16).with_scanner()
NAMES = (f"scanner-driver-{number}" for number in itertools.count())


class Photometer:
    """A scene that remembers the light of each exposure."""

    def __init__(self):
        self.seen = []

    def exposure(self, view_name, *, pops, exposure_s, seed):
        self.seen.append((view_name, pops))
        return np.zeros((20, 16), np.uint16)


def opened(**faults):
    world = World(RIG, seed=5, scene=Photometer(), faults=Faults(**faults))
    name = world.register(next(NAMES))
    return world, name, ScannerBox(Port(f"sim://scanner?world={name}", clock=world.clock))


def test_pattern_fills_exposure_of_its_cameras():
    world, name, box = opened()
    cameras = {view: open_camera(f"sim://{name}/{view}") for view in ("S0", "S1", "S2")}
    for camera in cameras.values():
        camera.configure(Exposure(0.02, 100))
        camera.arm(1, Trigger.EDGE)
    box.set_eyes("closed")
    box.select_projector(0)
    box.select_pattern("rows", 3)
    box.arm()
    box.trigger("t1", 0.05)
    for view in ("S0", "S1"):
        cameras[view].frame(1.0)
    assert {view for view, _ in world.scene.seen} == {"S0", "S1"}
    for _, (light,) in world.scene.seen:
        assert (light.projector, light.axis, light.pattern) == ("P0", "rows", 3)
        assert light.t_off_s - light.t_on_s == pytest.approx(0.02)
    assert world.camera("S2").missed_edges == 0
    assert box.shown_patterns() == 1
    box.close()


def test_limits_and_state_are_read():
    _, _, box = opened()
    assert box.limits["columns"] == [800, 800]
    assert box.limits["settle_ms"] == 20
    assert box.selected_projector() == 0
    assert box.eyes() == "open"
    box.set_eyes("shielded")
    assert box.status().eyes_safe
    box.select_white()
    assert box.dose_ws() == 0.0
    box.new_subject("P1")
    assert box.eyes() == "open"
    box.close()


def test_refusals_reach_the_host():
    _, _, box = opened(led_dead="0")
    box.arm()
    with pytest.raises(CommandRefused) as open_eyes:
        box.trigger("t1", 0.05)
    assert open_eyes.value.code == Code.FLICKER
    box.set_eyes("closed")
    with pytest.raises(CommandRefused, match="draws no current"):
        box.trigger("t2", 0.05)
    with pytest.raises(ValueError, match="axis: got 'diagonal'"):
        box.select_pattern("diagonal", 0)
    with pytest.raises(ValueError, match="eyes: got 'shut'"):
        box.set_eyes("shut")
    box.close()


def test_other_controller_is_refused():
    world = World(RIG, seed=5)
    name = world.register(next(NAMES))
    with pytest.raises(WrongDevice, match="expected a 'scanner' controller"):
        ScannerBox(Port(f"sim://dome?world={name}", clock=world.clock))


def test_lost_answers_show_a_pattern_once():
    world, _, box = opened(lose_answer=0.3, drop=0.0005)
    box.set_eyes("closed")
    for number in range(12):
        box.arm()
        box.trigger(f"t{number}", 0.03)
        box.listen(0.1)
    assert world.box("scanner").device.count == 12
    box.close()
