"""A probe on a bad line and with bad luck: no light or suction twice, and every end is told."""

import dataclasses
import itertools

import pytest

from capture.devices.port import BoxRebooted, CommandRefused, LinkLost, Port, PortTimeout
from capture.devices.probe import ProbeBox
from capture.devices.wire import Code
from capture.rig import load_rig
from rigsim.boxes.faults import Faults
from rigsim.world import World

SHIPPED = load_rig("probe")
RIG = dataclasses.replace(SHIPPED, probe=dataclasses.replace(SHIPPED.probe, rest_s=0.5))
NAMES = (f"probe-faults-{number}" for number in itertools.count())

# number in the catalogue, faults, what must be seen at least once (None: nothing may be)
ON_THE_LINE = [
    (1, {"drop": 0.003}, None),
    (2, {"flip": 0.003}, None),
    (3, {"glue": 0.1, "cut": 0.1}, None),
    (4, {"late": 0.2}, None),
    (5, {"lose_answer": 0.3}, None),
    (6, {"duplicate": 0.5}, None),
    (7, {"babble": 0.5}, None),
    (8, {"reset_on_open": True}, None),
    (9, {"reset_after": 4.0}, "BoxRebooted"),
    (9, {"brownout": 0.03, "boot_s": 0.3}, "BoxRebooted"),
    (10, {"unplug_after": 4.0, "replug_after": 0.5}, "LinkLost"),
    (12, {"stall_after": 4.0, "stall_s": 4.0}, "PortTimeout"),
    (15, {"led_dead": "0"}, "-240"),
    (18, {"pump_leak": 3.0}, "low"),
    (18, {"pump_dead": True}, "low"),
    (18, {"head_lifts_after": 3.0}, "lost"),
    (18, {"gauge_dead_after": 6.0}, "gauge"),
    (18, {"shutter_stuck": 0.3}, "-240"),
    (18, {"shutter_jam": 0.3}, "jam"),
]


class Host:
    """A host that measures skin, notes what it was told, and recovers from what goes wrong."""

    def __init__(self, world, url):
        self.world, self.unit = world, world.box("probe").device
        self.box = ProbeBox(Port(url, clock=world.clock, retries=12))
        self.seen = set()
        self.openings = []

    def ready(self):
        """Begin again from nothing, as after a person has looked."""
        box = self.box
        box.dark()
        box.set_lease(2.0)
        box.arm()
        if box.status().jammed:
            try:
                box.close_shutter()
            except CommandRefused:
                return
        box.set_level(1.0)
        box.place("cheek", 0.0)
        box.listen(0.6)
        box.suck(60.0, 20.0)
        box.listen(2.2)  # by then the box has given up what is not reached

    def measure(self):
        """Open the shutter once: a number for each accepted opening, no light for a refused one."""
        before = self.unit.shutter.count
        try:
            state = self.box.suction()
            if not state.on or state.left_s < 5.0:
                self.note_suction()
                self.ready()
                return
            opening = self.box.open_shutter(0.1)
            assert self.unit.shutter.count == before + 1
            assert opening.number == before + 1
            self.box.listen(0.3)
            ended = self.box.last_opening()
            assert (ended.number, ended.t_open_s) == (opening.number, opening.t_open_s)
            self.openings.append(ended)
            if ended.ended == "pump":
                self.note_suction()
            elif ended.ended != "timed":
                self.seen.add(ended.ended)
            if ended.ended != "timed":
                self.get_ready()
        except CommandRefused as error:
            self.seen.add(str(int(error.code)))
            self.get_ready()
        except (BoxRebooted, PortTimeout, LinkLost) as error:
            assert self.unit.shutter.count <= before + 1
            self.recover(error)

    def note_suction(self):
        report = self.box.last_suction()
        if report is not None and report.ended not in ("dark", "timed"):
            self.seen.add(report.ended)

    def get_ready(self):
        try:
            self.ready()
        except CommandRefused as error:
            self.seen.add(str(int(error.code)))
        except (BoxRebooted, PortTimeout, LinkLost) as error:
            self.recover(error)

    def recover(self, error):
        for _ in range(20):
            self.seen.add(type(error).__name__)
            try:
                if isinstance(error, LinkLost):
                    self.world.clock.sleep(1.0)
                    self.box.port.reopen()
                else:
                    self.box.hello()
                self.ready()
                return
            except (BoxRebooted, PortTimeout, LinkLost) as again:
                error = again
        raise error


@pytest.mark.long
@pytest.mark.parametrize(("number", "faults", "expected"), ON_THE_LINE)
def test_probe_lights_once_per_accepted_opening_reports_end(number, faults, expected):
    world = World(RIG, seed=number, faults=Faults(**faults))
    name = world.register(next(NAMES))
    host = Host(world, f"sim://probe?world={name}")
    host.get_ready()
    for _ in range(24):
        host.measure()
    # a dead gauge and a stuck shutter are refused as well as told of
    refusals = {"-240"} if expected in ("gauge", "jam") else set()
    assert host.seen - refusals == (set() if expected is None else {expected})
    broken = faults.keys() & {"led_dead", "pump_leak", "pump_dead", "gauge_dead_after"}
    assert len(host.openings) > (0 if broken else 5) or broken
    for ended in host.openings:
        span_s = {"timed": 0.1, "jam": 0.12}.get(ended.ended)
        if span_s is not None:
            assert ended.t_shut_s - ended.t_open_s == pytest.approx(span_s, abs=3e-6)
    for light in world.switched:
        assert light.t_off_s - light.t_on_s <= 0.12 + 1e-9
    assert len(world.switched) <= host.unit.shutter.count
    host.box.port.close()
    world.unregister()


def test_controller_reset_mid_suction_vents_without_report():
    world = World(RIG, seed=3, faults=Faults(reset_after=4.0, boot_s=0.2))
    name = world.register(next(NAMES))
    host = Host(world, f"sim://probe?world={name}")
    host.ready()
    assert world.now < 3.9
    host.box.open_shutter(20.0)
    with pytest.raises(BoxRebooted):
        host.box.listen(5.0)
    (light,) = world.switched
    assert light.t_off_s == pytest.approx(4.0)
    assert not world.head_at(world.now).placed
    host.box.hello()
    assert host.box.last_opening() is host.box.last_suction() is host.box.placement() is None
    assert host.box.level() == 0.0
    host.box.arm()
    with pytest.raises(CommandRefused) as caught:
        host.box.suck(60.0, 5.0)
    assert caught.value.code == Code.IGNORED
    host.box.port.close()
    world.unregister()


def test_sagging_leaks_show_only_in_gauge():
    """The box vents what is not reached; whether 50 mbar will do for 60 is the host's to say."""
    readings = {}
    for leak in (0.0, 0.2):
        world = World(RIG, seed=1, faults=Faults(pump_leak=leak))
        name = world.register(next(NAMES))
        with ProbeBox(Port(f"sim://probe?world={name}", clock=world.clock)) as box:
            box.arm()
            box.place("cheek", 0.0)
            box.suck(60.0, 20.0)
            box.listen(3.0)
            assert box.suction().on
            readings[leak] = box.pressure_mbar()
        world.unregister()
    tolerance = RIG.probe.suction_tolerance_mbar
    assert abs(readings[0.0] - 60.0) < tolerance < abs(readings[0.2] - 60.0)
