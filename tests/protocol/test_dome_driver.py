"""The driver of the dome's box, the same suite over sim://, a pty and TCP."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from capture.devices.dome import DomeBox, TableRow
from capture.devices.port import BadAnswer, CommandRefused, Port, WrongDevice
from capture.devices.wire import Code
from capture.plan.eye_light import eye_irradiance
from capture.rig import load_rig
from rigsim.boxes.faults import Faults
from rigsim.world import World
from rigsim.world.serve import serve_world

RIG = load_rig("dome").subset(views=["C00", "C05"]).resized(16)
NAMES = (f"dome-driver-{number}" for number in itertools.count())
UNSEEN = [int(k) for k in np.argsort(eye_irradiance(RIG), kind="stable")[:12]]
SEEN = int(np.argmax(eye_irradiance(RIG)))


@pytest.fixture(params=["sim", "pty", "tcp"])
def bench(request):
    """A dome's box behind one transport, and its driver."""
    if request.param == "sim":
        world = World(RIG, seed=5)
        name = world.register(next(NAMES))
        box = DomeBox(Port(f"sim://dome?world={name}", clock=world.clock))
        yield SimpleNamespace(world=world, box=box)
        box.close()
        world.unregister()
        return
    world = World(RIG, seed=5, clock="real", faults=Faults(baud=0.0))
    with serve_world(RIG, world=world, pty=request.param == "pty") as served:
        box = DomeBox(Port(served.addresses["dome"]))
        yield SimpleNamespace(world=world, box=box)
        box.close()


def rows(leds, *, dwell_s=0.03, level=1.0, mask=3):
    return [TableRow((led,), level, dwell_s, mask) for led in leds]


def test_controller_reports_identity_and_limits(bench):
    assert bench.box.identify() == "RIGSIM,DOME1,DM-0001,1.0"
    assert (bench.box.identity.kind, bench.box.identity.serial) == ("dome", "DM-0001")
    assert bench.box.limits["leds"] == 150
    assert bench.box.limits["max_duty"] == RIG.leds.max_duty


def test_armed_table_runs_once_with_every_release_timed(bench):
    box = bench.box
    box.load(rows(UNSEEN[:8]))
    with pytest.raises(CommandRefused) as caught:
        box.arm_sequence(8)
    assert caught.value.code == Code.NOT_ARMED
    box.arm()
    judged = box.arm_sequence(8)
    assert judged.flashes_per_s == 0.0
    assert judged.duty == pytest.approx(0.03, abs=1e-3)
    assert box.position().state == "READY"
    start_s = box.trigger("run-1")
    times = {}
    while box.position().state == "RUN":
        times |= box.listen(0.05)
    times |= box.listen(0.05)
    assert sorted(times) == list(range(8))
    found = np.array([times[row] for row in range(8)])
    wanted = start_s + 0.03 * np.arange(8) + RIG.leds.settle_s
    assert np.abs(found - wanted).max() <= (2e-6 if bench.world.virtual else 0.05)
    assert box.step_time(7) == times[7]
    assert box.step_time(8) is None
    position = box.position()
    assert (position.state, position.row, position.rows, position.token) == ("DONE", 7, 8, "run-1")
    assert [pulse.led for pulse in bench.world.switched] == UNSEEN[:8]


def test_long_table_loads_in_short_lines_with_checksum(bench, monkeypatch):
    many, parts = [TableRow(tuple(UNSEEN[:5]), 0.1, 0.05, 3)] * 60, []
    port = bench.box.port
    ask = port.ask
    monkeypatch.setattr(port, "ask", lambda line, **more: parts.append(line) or ask(line, **more))
    bench.box.load(many)
    lengths = [len(line.partition(",")[2]) for line in parts if line.startswith("SEQ:DEF")]
    assert 100 < max(lengths) <= 200  # bytes that a controller stores per line
    assert len(bench.world.box("dome").device.table) == 60
    bench.box.load(many[:2])
    assert len(bench.world.box("dome").device.table) == 2


def test_another_table_than_was_sent_is_noticed(bench, monkeypatch):
    monkeypatch.setattr("rigsim.boxes.led_sequencer.table_crc", lambda table: "1234")
    with pytest.raises(BadAnswer, match="the table that was sent"):
        bench.box.load(rows(UNSEEN[:2]))


def test_leds_go_out_by_themselves_and_by_command(bench):
    box = bench.box
    box.arm()
    box.light(UNSEEN[:2], 0.4, level=0.25)
    assert box.lit() == tuple(sorted(UNSEEN[:2]))
    assert box.status().lit
    box.put_out(UNSEEN[:1])
    assert box.lit() == (UNSEEN[1],)
    box.put_out()
    assert box.lit() == ()
    box.light(UNSEEN[2:3], 0.05)
    box.listen(0.15)
    assert box.lit() == ()
    assert not box.status().lit


def test_listening_for_no_time_asks_nothing(bench):
    asked = bench.box.port.statistics.requests
    assert bench.box.listen(0.0) == {}
    assert bench.box.port.statistics.requests == asked


def test_flicker_is_refused_until_eye_safety_confirmation(bench):
    box = bench.box
    box.arm()
    flicker = rows([SEEN, UNSEEN[0]] * 8, level=0.4)
    box.load(flicker)
    with pytest.raises(CommandRefused) as caught:
        box.arm_sequence(16)
    assert caught.value.code == Code.FLICKER
    box.set_eyes("closed")
    assert box.eyes() == "closed"
    assert box.status().eyes_safe
    assert box.arm_sequence(16).flashes_per_s >= 3.0
    box.new_subject("P043")
    assert box.eyes() == "open"
    with pytest.raises(ValueError, match="expected one of open, closed, shielded"):
        box.set_eyes("shut")


def test_the_dose_is_read_per_led(bench):
    box = bench.box
    box.arm()
    box.light(UNSEEN[:1], 0.1, level=0.5)
    box.listen(0.2)
    assert box.dose_ws(UNSEEN[0]) == pytest.approx(0.05, abs=0.01)
    assert box.dose_ws(UNSEEN[1]) == 0.0
    box.new_subject("P043")
    assert box.dose_ws(UNSEEN[0]) == 0.0


def test_cameras_are_masked_and_released_without_light(bench):
    box = bench.box
    box.set_cameras(2)
    assert box.cameras() == 2
    assert 0.0 <= box.trigger_cameras("dark-1") <= box.ping()
    assert bench.world.switched == []


def test_silence_stops_sequence_within_lease_until_rearmed(bench):
    box = bench.box
    box.set_lease(0.3)
    box.load(rows(UNSEEN * 3, dwell_s=0.05))
    box.arm()
    box.arm_sequence(36)
    box.trigger("left-alone")
    events = [event.name for event in box.port.listen(0.6)]
    assert "WDOG:TRIP" in events
    assert "SEQ:STOP" in events
    assert not bench.world.box("dome").device.lit
    assert box.status().tripped
    with pytest.raises(CommandRefused) as caught:
        box.arm_sequence(36)
    assert caught.value.code == Code.WATCHDOG_TRIPPED
    assert box.position().state == "STOP"


def test_a_dead_led_is_named():
    world = World(RIG, seed=5, faults=Faults(led_dead=str(UNSEEN[1])))
    name = world.register(next(NAMES))
    with DomeBox(Port(f"sim://dome?world={name}", clock=world.clock)) as box:
        box.arm()
        box.load(rows(UNSEEN[:3]))
        box.arm_sequence(3)
        box.trigger("r")
        box.listen(0.3)
        assert box.failed_leds == {UNSEEN[1]}
    world.unregister()


@pytest.mark.parametrize("minor", [2, 3])
def test_dead_led_is_queried_from_newer_controllers(minor):
    world = World(RIG, seed=5, faults=Faults(led_dead=str(UNSEEN[1])))
    name = world.register(next(NAMES))
    with DomeBox(Port(f"sim://dome?world={name}", clock=world.clock)) as box:
        box._limits = {**box.limits, "protocol_minor": minor}
        box.arm()
        box.load(rows(UNSEEN[:3]))
        box.arm_sequence(3)
        box.trigger("r")
        world.clock.sleep(0.3)  # the event is not read
        box.find_failed_leds()
        assert box.failed_leds == ({UNSEEN[1]} if minor == 3 else set())
    world.unregister()


def test_slow_judgment_is_awaited_with_retries():
    world = World(RIG, seed=5, faults=Faults(slow_judgment=1.7))
    name = world.register(next(NAMES))
    port = Port(f"sim://dome?world={name}", clock=world.clock)
    with DomeBox(port) as box:
        box.load(rows(UNSEEN[:8]))
        box.arm()
        asked_s = world.now
        assert box.arm_sequence(8).duty == pytest.approx(0.03, abs=1e-3)
        assert world.now - asked_s == pytest.approx(1.7, abs=0.05)
        assert port.statistics.retries >= 5
        assert box.position().state == "READY"
        assert box.is_armed()
    world.unregister()


def test_flash_controller_is_not_accepted_as_dome():
    world = World(seed=5)
    name = world.register(next(NAMES))
    with pytest.raises(WrongDevice, match="expected a 'dome' controller"):
        DomeBox(Port(f"sim://flash?world={name}", clock=world.clock))
    world.unregister()


def test_a_url_without_a_world_makes_a_dome():
    with DomeBox(Port("sim://dome?seed=4")) as box:
        assert box.limits["cameras"] == 16
