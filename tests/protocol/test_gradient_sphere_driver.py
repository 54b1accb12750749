"""The driver of the gradient sphere's box, the same suite over sim://, a pty and TCP."""

import dataclasses
import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from capture.devices.caliper import CaliperBox
from capture.devices.camera import Exposure, Trigger, open_camera
from capture.devices.gradient_sphere import GradientSphereBox, PatternRow
from capture.devices.port import BadAnswer, CommandRefused, Port, PortTimeout, WrongDevice
from capture.devices.wire import Code
from capture.rig import load_rig
from rigsim.boxes.faults import Faults
from rigsim.world import World
from rigsim.world.serve import serve_world

SLOW = load_rig("gradient").cropped(16)
# fast jaws, so that a suite in real time does not wait for them
RIG = dataclasses.replace(SLOW, caliper=dataclasses.replace(SLOW.caliper, speed_mm_per_s=40.0))
NAMES = (f"sphere-driver-{number}" for number in itertools.count())
CALM = ("full", "z", "x", "y", "-x", "-y", "-z", "dark")


class Witness:
    """A scene whose pixels tell pattern, analyzer and what the caliper held."""

    def exposure(self, view_name, *, pops, exposure_s, seed, grip):
        lit_s = sum(pop.level * (pop.t_off_s - pop.t_on_s) for pop in pops)
        image = np.full((16, 16), 64, np.uint16)
        image[0, 0] = 1 + CALM.index(pops[0].pattern) if pops else 0
        image[0, 1] = round(pops[0].analyzer_deg) if pops else 0
        image[0, 2] = round(1e3 * lit_s / exposure_s)
        image[0, 3] = round(1e3 * grip.stretch)
        image[0, 4] = grip.step + 100
        return image


@pytest.fixture(params=["sim", "pty", pytest.param("tcp", marks=pytest.mark.long)])
def bench(request):
    """A sphere's box behind one transport, its driver, and the rig's other addresses."""
    if request.param == "sim":
        world = World(RIG, seed=5, scene=Witness())
        name = world.register(next(NAMES))
        addresses = {box: f"sim://{box}?world={name}" for box in RIG.boxes}
        box = GradientSphereBox(Port(addresses["gradient_sphere"], clock=world.clock))
        yield SimpleNamespace(
            world=world, box=box, addresses={**addresses, "cam": f"sim://{name}/cam"}
        )
        box.close()
        world.unregister()
        return
    world = World(RIG, seed=5, clock="real", scene=Witness(), faults=Faults(baud=0.0))
    with serve_world(RIG, world=world, pty=request.param == "pty") as served:
        box = GradientSphereBox(Port(served.addresses["gradient_sphere"]))
        yield SimpleNamespace(world=world, box=box, addresses=served.addresses)
        box.close()


def rows(names, *, reading_deg=0.0, dwell_s=0.03, level=0.9, mask=1):
    return [PatternRow(name, reading_deg, level, dwell_s, mask) for name in names]


def run(box, table, token="r"):
    box.load(table)
    box.arm()
    box.arm_scan(len(table))
    start_s = box.trigger(token)
    times = {}
    while box.position().state == "RUN":
        times |= box.listen(0.1)
    return start_s, times | box.listen(0.05)


def test_controller_reports_identity_and_limits(bench):
    assert bench.box.identify() == "RIGSIM,SPHERE1,GS-0001,1.0"
    identity = bench.box.identity
    assert (identity.kind, identity.serial) == ("gradient_sphere", "GS-0001")
    assert bench.box.limits["leds"] == len(RIG.lights)
    assert 90.0 * bench.box.limits["move_s_per_deg"] == pytest.approx(RIG.polarizer_move_s)


def test_armed_scan_of_sixteen_conditions_times_every_release(bench):
    box = bench.box
    table = rows(CALM) + rows(CALM[::-1], reading_deg=90.0)
    box.load(table)
    with pytest.raises(CommandRefused) as caught:
        box.arm_scan(16)
    assert caught.value.code == Code.NOT_ARMED
    box.arm()
    judged = box.arm_scan(16)
    assert judged.flashes_per_s < 3.0
    assert judged.duty == pytest.approx(0.9 * 8 * 0.03, abs=1e-3)
    assert box.position().state == "READY"
    start_s, times = run(box, table)
    wanted = start_s + 0.03 * np.arange(16) + RIG.leds.settle_s
    wanted[8:] += RIG.polarizer_move_s
    found = np.array([times[row] for row in range(16)])
    assert np.abs(found - wanted).max() <= (2e-6 if bench.world.virtual else 0.05)
    assert box.step_time(15) == times[15]
    assert box.step_time(16) is None
    position = box.position()
    assert (position.state, position.row, position.rows, position.token) == ("DONE", 15, 16, "r")
    patterns = [(p.pattern, p.analyzer_deg) for p in bench.world.switched]
    assert patterns == [(n, 0.0) for n in CALM[:7]] + [(n, 90.0) for n in CALM[6::-1]]
    assert box.analyzer_deg() == 90.0


def test_camera_records_each_pattern_separately_under_its_analyzer(bench):
    box = bench.box
    clock = bench.world.clock if bench.world.virtual else None
    with CaliperBox(Port(bench.addresses["caliper"], clock=clock)) as caliper:
        caliper.set_lease(5.0)
        caliper.arm()
        caliper.set_force_limit(5.0)
        caliper.home()
        caliper.attach()
        caliper.move_to(1)
        held = bench.world.skin.state
        camera = open_camera(bench.addresses["cam"])
        camera.configure(Exposure(0.015, 100))
        camera.arm(4, Trigger.EDGE)
        dwell_s = 0.03 if bench.world.virtual else 0.1
        table = rows(("full", "-x"), dwell_s=dwell_s, level=0.4)
        table += rows(("z", "dark"), dwell_s=dwell_s, level=0.4, reading_deg=90.0)
        run(box, table)
        caliper.release()
        # pixels are made late, of what was held at the time
        frames = [camera.frame(5.0).image for _ in range(4)]
        camera.close()
    for image, name, reading in zip(frames, ("full", "-x", "z"), (0, 0, 90), strict=False):
        assert (CALM[image[0, 0] - 1], image[0, 1], image[0, 2]) == (name, reading, 400)
    assert (frames[3][0, 0], frames[3][0, 2]) == (0, 0)
    for image in frames:
        assert (image[0, 3], image[0, 4]) == (round(1e3 * held.stretch), 101)


def test_patterns_go_out_by_themselves_and_by_command(bench):
    box = bench.box
    box.set_eyes("closed")
    box.arm()
    box.light("-y", 0.4, level=0.2)
    assert (box.lit(), box.status().lit) == ("-y", True)
    box.light("dark", 0.1)
    assert box.lit() == "dark"
    box.light("x", 0.05)
    box.listen(0.1)
    assert box.lit() == "dark"
    box.light("y", 0.3, level=0.2)
    box.put_out()
    assert not box.status().lit
    with pytest.raises(ValueError, match="expected one of full"):
        box.light("w", 0.1)


def test_analyzer_rotates_to_stops_and_any_reading(bench):
    box = bench.box
    box.set_polarizer("crossed")
    assert not box.is_settled() or not bench.world.virtual
    box.wait_settled()
    assert (box.is_settled(), box.analyzer_deg(), box.status().turning) == (True, 90.0, False)
    box.set_analyzer(87.125)
    box.wait_settled()
    assert box.analyzer_deg() == 87.125
    box.set_polarizer("parallel")
    box.wait_settled()
    assert box.analyzer_deg() == 0.0
    with pytest.raises(ValueError, match="'parallel' or 'crossed'"):
        box.set_polarizer("none")
    with pytest.raises(ValueError, match="finite"):
        box.set_analyzer(float("inf"))


def test_gains_are_sent_whole_and_forgotten(bench):
    box = bench.box
    gains = np.linspace(0.5, 1.0, len(RIG.lights))
    box.set_gains(gains.tolist())
    box.arm()
    box.light("full", 0.02)
    box.listen(0.1)
    (light,) = bench.world.switched
    np.testing.assert_allclose(light.led_shares, gains, atol=5.1e-4)
    box.clear_gains()
    box.light("full", 0.02)
    box.listen(0.1)
    assert bench.world.switched[-1].led_shares == ()
    with pytest.raises(ValueError, match=r"gains\[1\]"):
        box.set_gains([1.0, 1.1])


def test_another_table_than_was_sent_is_noticed(bench, monkeypatch):
    for module in ("led_sequencer", "gradient_sphere"):
        monkeypatch.setattr(f"rigsim.boxes.{module}.table_crc", lambda table: "1234")
    with pytest.raises(BadAnswer, match="the table that was sent"):
        bench.box.load(rows(("x",)))
    with pytest.raises(BadAnswer, match="the table that was sent"):
        bench.box.set_gains([1.0] * len(RIG.lights))


def test_flicker_is_refused_until_eye_safety_confirmation(bench):
    box = bench.box
    box.arm()
    box.load(rows(("full", "dark") * 4))
    with pytest.raises(CommandRefused) as caught:
        box.arm_scan(8)
    assert caught.value.code == Code.FLICKER
    box.set_eyes("shielded")
    assert (box.eyes(), box.status().eyes_safe) == ("shielded", True)
    assert box.arm_scan(8).flashes_per_s >= 3.0
    box.new_subject("P7")
    assert box.eyes() == "open"


def test_silence_stops_the_scan_within_the_lease(bench):
    box = bench.box
    box.set_lease(0.3)
    box.load(rows(("x", "y") * 10, dwell_s=0.1, level=0.15))
    box.arm()
    box.arm_scan(20)
    box.trigger("left-alone")
    events = {event.name for event in box.port.listen(0.5)}
    assert {"WDOG:TRIP", "SEQ:STOP"} <= events
    assert (box.status().tripped, box.lit(), box.position().state) == (True, "dark", "STOP")


def test_a_dead_led_is_named():
    world = World(RIG, seed=5, faults=Faults(led_dead="11"))
    name = world.register(next(NAMES))
    with GradientSphereBox(Port(f"sim://gradient_sphere?world={name}", clock=world.clock)) as box:
        run(box, rows(("x",)))
        assert box.failed_leds == {11}
    world.unregister()


def test_analyzer_that_never_arrives_is_abandoned(monkeypatch):
    with GradientSphereBox(Port("sim://gradient_sphere?seed=8")) as box:
        monkeypatch.setattr(
            "rigsim.boxes.gradient_sphere.GradientSphereUnit.is_busy", lambda self, now: True
        )
        with pytest.raises(PortTimeout, match="still turns"):
            box.wait_settled(0.2)


def test_a_dome_is_not_taken_for_a_sphere():
    with pytest.raises(WrongDevice, match="expected a 'gradient_sphere' controller"):
        GradientSphereBox(Port("sim://dome?seed=9"))
