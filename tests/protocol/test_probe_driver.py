"""The driver of the probe's box, the same suite over sim://, a pty and TCP."""

import dataclasses
import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest

from capture.devices.camera import Exposure, Trigger, open_camera
from capture.devices.port import BadAnswer, CommandRefused, Port, PortTimeout, WrongDevice
from capture.devices.probe import ProbeBox
from capture.devices.wire import Code
from capture.rig import load_rig
from rigsim.boxes.contact_probe import source_shutter
from rigsim.boxes.faults import Faults
from rigsim.boxes.probe import ProbeUnit
from rigsim.world import World
from rigsim.world.serve import serve_world

SHIPPED = load_rig("probe")
# a short rest, so that a suite in real time does not wait for it
RIG = dataclasses.replace(SHIPPED, probe=dataclasses.replace(SHIPPED.probe, rest_s=0.3))
NAMES = (f"probe-driver-{number}" for number in itertools.count())


class Photometer:
    """A scene whose every pixel tells how much light there was, and remembers the head."""

    def __init__(self):
        self.heads = []

    def exposure(self, view_name, *, pops, exposure_s, seed, head):
        self.heads.append(head)
        spent = sum(light.level * (light.t_off_s - light.t_on_s) for light in pops)
        return np.full((4, 4), round(1e4 * spent), np.uint16)


@pytest.fixture(autouse=True)
def quick_cover(monkeypatch):
    monkeypatch.setattr(source_shutter, "COVER_MOVE_S", 0.05)


@pytest.fixture(params=["sim", "pty", pytest.param("tcp", marks=pytest.mark.long)])
def bench(request):
    """A probe's box behind one transport, its driver and its camera."""
    if request.param == "sim":
        world = World(RIG, seed=5, scene=Photometer())
        name = world.register(next(NAMES))
        box = ProbeBox(Port(f"sim://probe?world={name}", clock=world.clock))
        yield SimpleNamespace(world=world, box=box, camera=lambda: open_camera(f"sim://{name}/cam"))
        box.close()
        world.unregister()
        return
    world = World(RIG, seed=5, clock="real", faults=Faults(baud=0.0), scene=Photometer())
    with serve_world(RIG, world=world, pty=request.param == "pty") as served:
        box = ProbeBox(Port(served.addresses["probe"]))
        yield SimpleNamespace(
            world=world, box=box, camera=lambda: open_camera(served.addresses["cam"])
        )
        box.close()


@pytest.fixture
def alone():
    """A probe on a virtual clock with faults of one's own."""
    worlds = []

    def alone(seed=5, rig=RIG, **faults):
        world = World(rig, seed=seed, faults=Faults(**faults))
        worlds.append(world)
        name = world.register(next(NAMES))
        return world, ProbeBox(Port(f"sim://probe?world={name}", clock=world.clock))

    yield alone
    for world in worlds:
        world.unregister()


def hold(box, mbar=60.0, seconds=20.0, site="cheek"):
    box.arm()
    box.place(site, 22.5)
    return box.suck(mbar, seconds)


def light(box, level=1.0, seconds=50.0):
    """Have the head held and the LED on."""
    hold(box, seconds=seconds)
    box.set_level(level)
    box.listen(0.7)


def refused(call, *arguments):
    with pytest.raises(CommandRefused) as caught:
        call(*arguments)
    return caught.value.code


def test_controller_reports_identity_and_limits(bench):
    box = bench.box
    assert box.identify() == "RIGSIM,PROBE1,PR-0001,1.0"
    assert (box.identity.kind, box.identity.serial) == ("probe", "PR-0001")
    assert (box.limits["fibres"], box.limits["suction_max_mbar"]) == (28, 150.0)
    assert (box.limits["shutter_max_ms"], box.limits["rest_ms"]) == (30_000.0, 300.0)
    assert (
        box.placement() is box.last_suction() is box.last_opening() is box.uncovered_fiber() is None
    )
    assert (box.level(), box.count_openings(), box.dose_ws()) == (0.0, 0, 0.0)
    assert abs(box.pressure_mbar()) < 5.0
    assert box.camera_c() == pytest.approx(5.0, abs=0.2)


def test_measurement_follows_from_camera_and_shutter(bench):
    box, camera = bench.box, bench.camera()
    assert hold(box) == 1
    box.set_level(0.5)
    assert box.level() == 0.5
    box.listen(1.3)
    assert box.pressure_mbar() == pytest.approx(60.0, abs=6.0)
    assert box.suction().on
    assert box.suction().wanted_mbar == 60.0
    camera.configure(Exposure(0.1, 100))
    camera.arm(1, Trigger.EDGE)
    opening = box.open_shutter(0.2)
    assert (opening.number, opening.ended, opening.t_shut_s) == (1, "open", math.inf)
    assert box.status().lit
    box.listen(0.3)
    frame = camera.frame(5.0)
    ended = box.last_opening()
    assert (ended.number, ended.ended, ended.t_open_s) == (1, "timed", opening.t_open_s)
    assert ended.t_shut_s - ended.t_open_s == pytest.approx(0.2, abs=1e-5)
    # half of full light for the 0.1 s of the exposure, which is the shorter one
    assert frame.image.max() == pytest.approx(1e4 * 0.5 * 0.1, abs=1.0)
    (head,) = bench.world.scene.heads
    assert (head.site, head.angle_deg, head.placed) == ("cheek", 22.5, True)
    assert head.suction_mbar == pytest.approx(60.0, abs=3.0)
    assert box.dose_ws() == pytest.approx(1e-3 * 0.5 * 0.2, abs=1e-6)
    box.new_subject("S2")
    assert box.dose_ws() == 0.0
    box.vent()
    assert box.last_suction().ended == "asked"
    assert box.status().placed
    camera.close()


def test_dark_frame_needs_neither_head_nor_light(bench):
    box, camera = bench.box, bench.camera()
    camera.configure(Exposure(0.05, 100))
    camera.arm(1, Trigger.EDGE)
    assert box.trigger_camera("dark.1") == pytest.approx(box.ping(), abs=1.0)
    assert camera.frame(5.0).image.max() == 0
    assert not bench.world.scene.heads[0].placed
    camera.close()


def test_nothing_shines_or_sucks_unarmed_or_unplaced(bench):
    box = bench.box
    calls = [
        (box.place, "cheek", 0.0),
        (box.suck, 60.0, 5.0),
        (box.set_level, 0.5),
        (box.open_shutter, 0.1),
    ]
    assert [refused(*call) for call in calls] == [Code.NOT_ARMED] * 4
    box.set_level(0.0)
    box.vent()
    box.close_shutter()
    box.arm()
    assert refused(box.suck, 60.0, 5.0) == Code.IGNORED
    box.place("cheek", 0.0)
    assert refused(box.suck, 150.5, 5.0) == Code.OUT_OF_RANGE
    assert refused(box.suck, 60.0, 60.1) == Code.OUT_OF_RANGE
    assert refused(box.open_shutter, 30.1) == Code.OUT_OF_RANGE
    assert bench.world.switched == []


def test_unheld_head_emits_no_light(bench):
    box = bench.box
    box.arm()
    box.set_level(1.0)
    assert refused(box.open_shutter, 0.1) == Code.IGNORED
    light(box)
    box.open_shutter(20.0)
    box.vent()
    assert box.last_opening().ended == "pump"
    assert len(bench.world.switched) == 1
    assert refused(box.open_shutter, 0.1) == Code.IGNORED


def test_skin_rests_between_two_times_of_suction(bench):
    box = bench.box
    hold(box)
    box.listen(0.5)
    box.vent()
    state = box.suction()
    assert not state.on
    assert 0.0 < state.left_s <= 0.3
    assert box.status().resting
    assert refused(box.suck, 60.0, 5.0) == Code.RECYCLE
    box.listen(0.4)
    assert box.suction().left_s == 0.0
    assert box.placement() == ("cheek", 22.5)
    assert box.suck(60.0, 5.0) == 2
    assert refused(box.place, "chin", 0.0) == Code.IGNORED


def test_single_uncovered_fiber_is_revealed_by_light(bench):
    box = bench.box
    light(box)
    for fiber in (3, 27, None):
        box.cover(fiber)
        assert box.uncovered_fiber() == fiber
        box.open_shutter(0.05)
        box.listen(0.1)
    assert [seen.fiber for seen in bench.world.switched] == [3, 27, None]
    assert refused(box.cover, 28) == Code.OUT_OF_RANGE


def test_the_shutter_is_closed_before_its_end(bench):
    box = bench.box
    light(box)
    box.open_shutter(20.0)
    assert refused(box.set_level, 0.5) == Code.IGNORED
    assert box.status().busy
    box.close_shutter()
    assert box.last_opening().ended == "asked"
    assert not box.status().busy
    (seen,) = bench.world.switched
    assert seen.t_off_s - seen.t_on_s < 2.0


def test_listening_keeps_head_and_light_silence_loses_both(bench):
    box = bench.box
    box.set_lease(0.3)
    light(box)
    box.open_shutter(20.0)
    box.listen(0.5)
    assert box.status().lit
    box.port.listen(0.45)
    status = box.status()
    assert status.tripped
    assert (status.lit, status.sucking, status.placed) == (False, False, False)
    assert box.last_opening().ended == box.last_suction().ended == "dark"
    assert refused(box.suck, 60.0, 5.0) == Code.WATCHDOG_TRIPPED
    assert not bench.world.head_at(bench.world.now).placed


@pytest.mark.long
@pytest.mark.parametrize("end", ["dark", "close", "reset", "take_away"])
def test_release_commands_end_light_and_suction(bench, end):
    light(bench.box)
    bench.box.open_shutter(20.0)
    getattr(bench.box, end)()
    assert len(bench.world.switched) == 1
    unit = bench.world.box("probe").device
    assert (unit.lit, unit.pump.is_pumping) == (False, False)
    assert not bench.world.head_at(bench.world.now).placed


def test_nonfinite_numbers_are_refused_before_sending(bench):
    box = bench.box
    for call in (
        lambda: box.place("cheek", math.nan),
        lambda: box.suck(math.inf, 1.0),
        lambda: box.suck(60.0, math.nan),
        lambda: box.open_shutter(math.inf),
    ):
        with pytest.raises(ValueError, match="finite"):
            call()
    for level in (-0.1, 1.1, math.nan):
        with pytest.raises(ValueError, match="0 to 1"):
            box.set_level(level)


@pytest.mark.parametrize(
    ("faults", "ended"),
    [
        ({"pump_leak": 4.0}, "low"),
        ({"pump_dead": True}, "low"),
        ({"head_lifts_after": 1.5}, "lost"),
        ({"gauge_dead_after": 1.0}, "gauge"),
        ({"interlock_after": 1.0}, "interlock"),
    ],
)
def test_each_suction_ending_is_reported(alone, faults, ended):
    world, box = alone(**faults)
    hold(box)
    box.listen(3.0)
    report = box.last_suction()
    assert (report.number, report.ended) == (1, ended)
    assert box.placement() is None
    assert world.head_at(world.now).suction_mbar < 1.0
    box.close()


def test_stuck_shutter_is_refused_and_jammed_shutter_reported(alone):
    world, box = alone(shutter_stuck=1.0)
    light(box)
    assert refused(box.open_shutter, 0.1) == Code.HARDWARE
    assert (box.count_openings(), box.last_opening(), world.switched) == (1, None, [])
    box.close()
    world, box = alone(shutter_jam=1.0)
    light(box)
    box.open_shutter(0.1)
    box.listen(0.3)
    assert box.last_opening().ended == "jam"
    assert box.status().jammed
    assert box.level() == 0.0
    assert refused(box.close_shutter) == Code.HARDWARE
    box.close()


def test_a_cover_that_never_arrives_is_given_up(alone, monkeypatch):
    _, box = alone()
    monkeypatch.setattr(ProbeUnit, "is_busy", lambda self, now: True)
    with pytest.raises(PortTimeout, match="still moves"):
        box.cover(3)
    box.port.close()


@pytest.mark.parametrize(
    ("header", "payload", "call", "match"),
    [
        ("PUMP", "x", lambda box: box.suck(60.0, 1.0), "number of the suction"),
        ("PUMP?", "ON,60", lambda box: box.suction(), "ON,mbar,ms"),
        ("PUMP?", "REST,x", lambda box: box.suction(), "ON,mbar,ms"),
        ("PUMP:LAST?", "1,TIRED,60.0,5", lambda box: box.last_suction(), "number,END,mbar,us"),
        ("SHUT", "1", lambda box: box.open_shutter(0.1), "number,us"),
        ("SHUT:LAST?", "1,MELTED,5,6", lambda box: box.last_opening(), "number,END,us,us"),
        ("HEAD:SITE?", "cheek,x", lambda box: box.placement(), "a number"),
        ("FIB?", "x", lambda box: box.uncovered_fiber(), "a number"),
        ("CAM:TRIG", "other,5", lambda box: box.trigger_camera("d1"), "token,us"),
    ],
)
def test_invalid_answer_is_reported(alone, header, payload, call, match):
    world, box = alone()
    box.arm()
    command = world.box("probe").commands[header]
    answer = dataclasses.replace(command, run=lambda arguments, now: payload)
    world.box("probe").commands[header] = answer
    with pytest.raises(BadAnswer, match=match):
        call(box)
    box.close()


def test_a_flash_is_not_taken_for_a_probe():
    with pytest.raises(WrongDevice, match="expected a 'probe' controller"):
        ProbeBox(Port("sim://flash?seed=77"))


def test_a_url_without_a_world_makes_a_probe():
    with ProbeBox(Port("sim://probe?seed=4&clock=virtual&pump_leak=0.2")) as box:
        box.arm()
        box.place("forehead", 0.0)
        box.suck(60.0, 10.0)
        box.listen(2.0)
        assert 40.0 < box.pressure_mbar() < 54.0
