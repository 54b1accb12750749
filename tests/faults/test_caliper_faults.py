"""A caliper on a bad line and with bad luck: nothing moves twice, and every end is told."""

import dataclasses
import itertools

import pytest

from capture.devices.caliper import CaliperBox
from capture.devices.port import BoxRebooted, CommandRefused, LinkLost, Port, PortTimeout
from capture.rig import load_rig
from rigsim.boxes.faults import Faults
from rigsim.world import World

SLOW = load_rig("gradient").cropped(16)
RIG = dataclasses.replace(SLOW, caliper=dataclasses.replace(SLOW.caliper, speed_mm_per_s=8.0))
NAMES = (f"caliper-faults-{number}" for number in itertools.count())

# number in the catalogue, faults, error that must be seen at least once (None: none may be)
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
    (17, {"jaw_stall": 0.2}, "stall"),
    (17, {"skin_stiff": 30.0}, "force"),
]


class Host:
    """A host that stretches skin, notes what it was told, and recovers from what goes wrong."""

    def __init__(self, world, url):
        self.world, self.unit = world, world.box("caliper").device
        self.box = CaliperBox(Port(url, clock=world.clock, retries=12))
        self.seen = set()
        self.reports = []

    def ready(self):
        box = self.box
        box.dark()
        box.set_lease(2.0)
        box.arm()
        box.set_force_limit(2.0)
        if box.home().ended == "reached":
            box.attach()

    def move(self, step):
        before = len(self.unit.moves)
        try:
            report = self.box.move_to(step)
        except CommandRefused:
            assert len(self.unit.moves) == before
            self.get_ready()
            return
        except (BoxRebooted, PortTimeout, LinkLost) as error:
            assert len(self.unit.moves) <= before + 1
            self.recover(error)
            return
        assert len(self.unit.moves) == before + 1
        assert report.number == before + 1
        self.reports.append((step, report))
        if report.ended != "reached":
            self.seen.add(report.ended)
            self.get_ready()

    def get_ready(self):
        try:
            self.ready()
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
                # whatever has happened, nobody holds the skin without having said so again
                self.ready()
                return
            except (BoxRebooted, PortTimeout, LinkLost) as again:
                error = again
        raise error


@pytest.mark.parametrize(("number", "faults", "expected"), ON_THE_LINE)
def test_caliper_moves_once_per_accepted_move_reports_end(number, faults, expected):
    world = World(RIG, seed=number, faults=Faults(**faults))
    name = world.register(next(NAMES))
    host = Host(world, f"sim://caliper?world={name}")
    host.get_ready()
    for step in (1, -1, 2, 0, -2, 1, 2, -1, 0, 1, 2, 0, -3, 0, 1, 2):
        host.move(step)
    assert host.seen == (set() if expected is None else {expected})
    assert len(host.reports) > 5
    for step, report in host.reports:
        if report.ended == "reached":
            assert (report.step, report.reading_mm) == (step, pytest.approx(8.0 + 0.8 * step))
        assert abs(report.force_n) < 2.0 + 0.6 * (number == 17)
    host.box.port.close()
    world.unregister()


def test_controller_reset_mid_move_releases_without_move_report():
    world = World(SLOW, seed=3, faults=Faults(reset_after=16.0, boot_s=0.2))
    name = world.register(next(NAMES))
    host = Host(world, f"sim://caliper?world={name}")
    host.ready()
    while world.now < 15.7:
        host.box.listen(0.05)
    with pytest.raises(BoxRebooted):
        host.box.move_to(2)
    stands_mm = host.unit.aperture_mm
    assert 8.0 < stands_mm < 9.6
    assert not world.skin.state.attached
    host.box.hello()
    assert host.box.last_move() is None
    assert host.box.force_limit_n() is None
    assert host.box.reading_mm() is None
    world.clock.sleep(1.0)
    assert host.unit.aperture_mm == stands_mm
    host.box.port.close()
    world.unregister()


def test_same_seed_gives_same_bytes_at_same_times():
    def transcript(seed):
        world = World(RIG, seed=seed, faults=Faults(drop=0.001, flip=0.001, jaw_stall=0.1))
        name = world.register(next(NAMES))
        port = Port(f"sim://caliper?world={name}", clock=world.clock, first_seq=1)
        with CaliperBox(port) as box:
            box.arm()
            box.set_force_limit(2.0)
            box.home()
        world.unregister()
        return world.transcript_sha256

    assert transcript(1) == transcript(1)
    assert transcript(1) != transcript(2)
