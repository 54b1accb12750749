"""The driver of the caliper's box, the same suite over sim://, a pty and TCP."""

import dataclasses
import itertools
from types import SimpleNamespace

import pytest

from capture.devices.caliper import CaliperBox
from capture.devices.port import BadAnswer, CommandRefused, Port, PortTimeout, WrongDevice
from capture.devices.wire import Code
from capture.rig import load_rig
from rigsim.boxes import caliper as emulated
from rigsim.boxes.faults import Faults
from rigsim.world import World
from rigsim.world.serve import serve_world

SLOW = load_rig("gradient").cropped(16)
# fast jaws, so that a suite in real time does not wait for them
RIG = dataclasses.replace(SLOW, caliper=dataclasses.replace(SLOW.caliper, speed_mm_per_s=40.0))
NAMES = (f"caliper-driver-{number}" for number in itertools.count())


@pytest.fixture(autouse=True)
def quick_ring(monkeypatch):
    monkeypatch.setattr(emulated, "ROTATION_DEG_PER_S", 3600.0)


@pytest.fixture(params=["sim", "pty", pytest.param("tcp", marks=pytest.mark.long)])
def bench(request):
    """A caliper's box behind one transport, and its driver."""
    if request.param == "sim":
        world = World(RIG, seed=5)
        name = world.register(next(NAMES))
        box = CaliperBox(Port(f"sim://caliper?world={name}", clock=world.clock))
        yield SimpleNamespace(world=world, box=box)
        box.close()
        world.unregister()
        return
    world = World(RIG, seed=5, clock="real", faults=Faults(baud=0.0))
    with serve_world(RIG, world=world, pty=request.param == "pty") as served:
        box = CaliperBox(Port(served.addresses["caliper"]))
        yield SimpleNamespace(world=world, box=box)
        box.close()


@pytest.fixture
def alone():
    """A caliper on a virtual clock with faults of one's own."""
    worlds = []

    def alone(seed=5, rig=RIG, **faults):
        world = World(rig, seed=seed, faults=Faults(**faults))
        worlds.append(world)
        name = world.register(next(NAMES))
        return world, CaliperBox(Port(f"sim://caliper?world={name}", clock=world.clock))

    yield alone
    for world in worlds:
        world.unregister()


def ready(box, limit_n=5.0):
    box.arm()
    box.set_force_limit(limit_n)
    return box.home()


def hold(box, limit_n=5.0, angle_deg=0.0):
    ready(box, limit_n)
    box.set_angle(angle_deg)
    box.attach()


def test_controller_reports_identity_and_limits(bench):
    assert bench.box.identify() == "RIGSIM,CALIPER1,CA-0001,1.0"
    assert (bench.box.identity.kind, bench.box.identity.serial) == ("caliper", "CA-0001")
    assert (bench.box.limits["step_min"], bench.box.limits["step_max"]) == (-4, 8)
    assert bench.box.limits["angles_deg"] == [0.0, 45.0, 90.0, 135.0]
    assert bench.box.force_limit_n() is None
    assert bench.box.reading_mm() is None
    assert bench.box.last_move() is None


def test_nothing_moves_unarmed_unlimited_or_unhomed(bench):
    box = bench.box
    codes = []
    for prepare in (lambda: None, box.arm, lambda: box.set_force_limit(2.5)):
        prepare()
        with pytest.raises(CommandRefused) as caught:
            box.move_to(1)
        codes.append(caught.value.code)
    assert codes == [Code.NOT_ARMED, Code.IGNORED, Code.IGNORED]
    assert box.force_limit_n() == 2.5
    assert box.home().ended == "reached"
    assert box.move_to(1).ended == "reached"
    assert len(bench.world.box("caliper").device.moves) == 2


def test_angle_is_stretched_and_compressed_moves_reported(bench):
    box = bench.box
    hold(box, angle_deg=45.0)
    assert (box.angle_deg(), box.is_attached(), box.status().homed) == (45.0, True, True)
    forces = {}
    for step in (-1, -2, 0, 1, 2):
        report = box.move_to(step)
        assert (report.ended, report.step) == ("reached", step)
        assert report.reading_mm == pytest.approx(8.0 + 0.8 * step)
        assert report == box.last_move()
        state = bench.world.skin.state
        assert (state.angle_deg, state.step, state.attached) == (45.0, step, True)
        # what the skin does is not what the jaws read
        assert abs(state.stretch - report.reading_mm / 8.0) > 5e-4
        forces[step] = report.force_n
        assert box.force_n() == report.force_n
    assert forces[-2] < forces[-1] < 0.0 < forces[1] < forces[2]
    assert [number for number, _ in enumerate(bench.world.box("caliper").device.moves)][-1] == 5
    box.release()
    assert not box.is_attached()
    assert not bench.world.skin.state.attached


def test_stretching_ends_where_the_skin_comes_off(bench):
    box = bench.box
    hold(box)
    reports = [box.move_to(step) for step in (2, 8)]
    assert [report.ended for report in reports] == ["reached", "detached"]
    assert 10.0 < reports[1].reading_mm < 12.0
    assert not box.is_attached()
    assert box.move_to(0).ended == "reached"


def test_reached_limit_returns_jaws_and_bars_direction(bench):
    box = bench.box
    hold(box, limit_n=0.15)
    box.move_to(1)
    report = box.move_to(3)
    assert (report.ended, report.step) == ("force", 1)
    assert report.force_n == pytest.approx(0.15, abs=0.1)
    assert 8.8 < report.reading_mm < 10.4
    assert box.reading_mm() == pytest.approx(8.8)
    assert box.status().force_tripped
    with pytest.raises(CommandRefused) as caught:
        box.move_to(3)
    assert caught.value.code == Code.FORCE
    with pytest.raises(CommandRefused) as caught:
        box.set_force_limit(0.05)
    assert caught.value.code == Code.FORCE
    box.set_force_limit(5.0)
    assert box.move_to(3).ended == "reached"


def test_listening_for_no_time_asks_nothing(bench):
    asked = bench.box.port.statistics.requests
    bench.box.listen(0.0)
    assert bench.box.port.statistics.requests == asked


def test_listening_keeps_skin_held_and_silence_releases(bench):
    box = bench.box
    box.set_lease(0.3)
    hold(box)
    box.move_to(1)
    box.listen(0.4)
    assert box.is_attached()
    box.port.listen(0.45)
    assert box.status().tripped
    assert not box.is_attached()
    assert not bench.world.skin.state.attached
    with pytest.raises(CommandRefused) as caught:
        box.move_to(0)
    assert caught.value.code == Code.WATCHDOG_TRIPPED


@pytest.mark.parametrize("end", ["dark", "close", "reset"])
def test_dark_commands_release_skin(bench, end):
    hold(bench.box)
    bench.box.move_to(1)
    getattr(bench.box, end)()
    state = bench.world.skin.state
    assert (state.attached, state.stretch) == (False, 1.0)


def test_nonfinite_numbers_are_refused_before_sending(bench):
    for call in (bench.box.set_force_limit, bench.box.set_angle):
        with pytest.raises(ValueError, match="finite"):
            call(float("nan"))


def test_stall_is_reported_and_requires_homing(alone):
    world, box = alone()
    hold(box)
    world.box("caliper").device._stall = 1.0
    assert box.move_to(3).ended == "stall"
    assert box.reading_mm() is None
    with pytest.raises(CommandRefused):
        box.home()  # skin is held
    world.box("caliper").device._stall = 0.0
    box.release()
    assert box.home().ended == "reached"
    box.close()


def test_a_missed_home_is_reported(alone):
    _, box = alone(home_missed=True)
    assert ready(box).ended == "no_home"
    box.close()


def test_a_dead_force_sensor_is_reported(alone):
    _, box = alone(force_dead=True)
    box.arm()
    box.set_force_limit(1.0)
    with pytest.raises(CommandRefused) as caught:
        box.home()
    assert caught.value.code == Code.HARDWARE
    box.close()


def test_stiff_skin_reaches_limit_but_typical_skin_not(alone):
    ends = []
    for stiff in (1.0, 20.0):
        _, box = alone(skin_stiff=stiff)
        hold(box, limit_n=1.5)
        ends.append(box.move_to(2).ended)
        box.close()
    assert ends == ["reached", "force"]


def test_move_report_names_emergency_stop_as_end(alone):
    world, box = alone(rig=SLOW, interlock_after=15.0)
    hold(box)
    while world.now < 14.6:
        box.listen(0.1)
    assert box.move_to(2).ended == "stopped"
    assert 14.9 < world.grips[-1][0] <= 15.0
    assert not world.skin.state.attached
    with pytest.raises(CommandRefused) as caught:
        box.move_to(0)
    assert caught.value.code == Code.INTERLOCK
    box.close()


def test_a_caliper_that_never_arrives_is_given_up(alone, monkeypatch):
    _, box = alone()
    ready(box)
    monkeypatch.setattr(emulated.CaliperUnit, "is_busy", lambda self, now: True)
    with pytest.raises(PortTimeout, match="still moves"):
        box._wait(0.5)
    box.port.close()


def test_end_report_of_different_move_is_refused(alone):
    _, box = alone()
    ready(box)
    said, ask = {"CAL:HOME": "7"}, box._port.ask
    box._port.ask = lambda text: said.get(text) or ask(text)
    with pytest.raises(BadAnswer, match="the end of move 7"):
        box.home()
    said["CAL:HOME"] = "x"
    with pytest.raises(BadAnswer, match="number of the move"):
        box.home()
    said["CAL:LAST?"] = "1,MELTED,0,8.0,0.0,5"
    with pytest.raises(BadAnswer, match=r"number,END,step,mm,N,us"):
        box.last_move()
    box.close()


def test_a_sphere_is_not_taken_for_a_caliper():
    world = World(RIG, seed=5)
    name = world.register(next(NAMES))
    with pytest.raises(WrongDevice, match="expected a 'caliper' controller"):
        CaliperBox(Port(f"sim://gradient_sphere?world={name}", clock=world.clock))
    world.unregister()


def test_a_url_without_a_world_makes_a_caliper():
    with CaliperBox(Port("sim://caliper?seed=4")) as box:
        assert box.limits["aperture_mm"] == 8.0
