"""The driver of the flash box, the same suite over sim://, a pty and TCP."""

import pytest

from capture.devices.flash import FlashBox, FlashReport
from capture.devices.port import (
    BadAnswer,
    BoxRebooted,
    CommandRefused,
    LinkLost,
    Port,
    PortBusy,
    PortTimeout,
    WrongDevice,
)
from capture.devices.wire import Code
from rigsim.boxes.faults import Faults
from rigsim.world import World


def test_controller_reports_identity_and_limits(bench):
    box = bench.box()
    assert box.identify() == "RIGSIM,FLASH2,FL-0001,1.0"
    assert (box.identity.kind, box.identity.serial) == ("flash", "FL-0001")
    assert box.limits["recycle_s"] == 1.5
    assert box.limits["power_max"] == 1.0


def test_settings_come_back_as_they_were_set(bench):
    box = bench.box()
    box.set_polarizer("crossed")
    assert (box.polarizer(), box.analyzer_deg()) == ("crossed", 90.0)
    box.set_analyzer(22.5)
    assert box.analyzer_deg() == 22.5
    box.set_power(0.0625)
    assert box.power() == 0.0625
    box.set_lease(0.75)
    assert box.lease_s() == 0.75
    box.reset()
    assert (box.polarizer(), box.power()) == ("parallel", 1.0)


def test_armed_pop_is_made_and_reported_with_light(bench):
    box = bench.box()
    with pytest.raises(CommandRefused) as caught:
        box.fire("early")
    assert caught.value.code == Code.NOT_ARMED
    assert box.last_pop() is None
    box.set_polarizer("crossed")
    box.set_power(0.125)
    box.wait_charged(5.0)
    box.arm()
    report = box.fire("shot-1")
    assert report == FlashReport("shot-1", report.t_box_s, 0.125, "crossed", 90.0, 1)
    assert report.t_box_s <= box.ping()
    assert box.last_pop() == report
    assert box.count() == 1
    assert [pop.token for pop in bench.world.pops] == ["shot-1"]


def test_waiting_for_charge_suffices_to_pop_again(bench):
    box = bench.box()
    box.arm()
    box.set_power(0.2)
    first = box.fire("a")
    assert not box.charge_state().ready
    box.wait_charged(5.0)
    assert box.charge_state().ready
    second = box.fire("b")  # waiting has kept the lease
    assert second.t_box_s - first.t_box_s >= 0.3


def test_missing_charge_ends_wait_with_timeout(bench):
    box = bench.box()
    box.arm()
    box.fire("a")
    with pytest.raises(PortTimeout, match="not ready"):
        box.wait_charged(0.1)


def test_lamps_go_out_by_themselves_and_by_command(bench):
    box = bench.box()
    box.arm()
    box.lamp_on(0.5)
    assert box.is_lamp_lit()
    assert box.status().lit
    box.lamp_off()
    assert not box.is_lamp_lit()
    box.lamp_on(0.05)
    box.port.listen(0.2)
    assert not box.is_lamp_lit()


def test_dark_disarms(bench):
    box = bench.box()
    box.arm()
    assert box.is_armed()
    box.lamp_on(0.5)
    box.dark()
    assert not box.is_armed()
    assert not box.is_lamp_lit()


def test_silence_trips_lease_until_deliberate_rearming(bench):
    box = bench.box()
    box.set_lease(0.3)
    box.arm()
    box.lamp_on(0.5)
    events = box.port.listen(0.45)
    assert [event.name for event in events] == ["WDOG:TRIP"]
    assert not bench.world.box("flash").device.lit
    assert box.status().tripped
    with pytest.raises(CommandRefused) as caught:
        box.fire("late")
    assert caught.value.code == Code.WATCHDOG_TRIPPED
    box.arm()
    assert not box.status().tripped


def test_refusals_are_queued_read_and_cleared(bench):
    box = bench.box()
    for angle_deg in (200.0, -1.0):
        with pytest.raises(CommandRefused) as caught:
            box.set_analyzer(angle_deg)
        assert caught.value.code == Code.OUT_OF_RANGE
    assert box.status().errors_waiting
    assert [code for code, _ in box.errors()] == [Code.OUT_OF_RANGE] * 2
    assert box.errors() == []
    with pytest.raises(CommandRefused):
        box.set_power(2.0)
    box.clear_errors()
    assert box.errors() == []


def test_analyzer_rotates_and_settles(bench):
    box = bench.box()
    for way in ("crossed", "parallel") * 8:  # on a real line a busy machine may ask when it is over
        box.set_polarizer(way)
        turning = not box.is_settled()
        box.port.listen(0.15)
        if turning:
            break
    assert turning
    assert box.is_settled()
    assert not box.status().turning


def test_the_cameras_can_be_triggered_without_light(bench):
    box = bench.box()
    assert 0.0 <= box.trigger_cameras("dark-1") <= box.ping()
    assert bench.world.pops == []


def test_controller_outlives_its_port(bench):
    box = bench.box()
    box.set_power(0.5)
    boot = box.identity.boot
    box.close()
    again = bench.box()
    assert again.identity.boot == boot
    assert again.power() == 0.5


def test_closing_goes_dark(bench):
    box = bench.box()
    box.arm()
    box.lamp_on(0.5)
    box.close()
    assert not bench.world.box("flash").armed
    assert not bench.world.box("flash").device.lit


def test_a_second_host_is_turned_away(bench):
    box = bench.box()
    with pytest.raises(LinkLost):
        bench.box()
    assert box.ping() >= 0.0
    if bench.transport in ("sim", "pty"):  # a network cannot say why it hangs up
        with pytest.raises(PortBusy, match="another program"):
            bench.box()


def test_other_serial_number_is_other_controller(bench):
    with pytest.raises(WrongDevice, match=r"FL-0001.*expected FL-0002"):
        bench.box(serial="FL-0002")
    assert bench.box(serial="FL-0001").identity.serial == "FL-0001"


def test_reset_controller_is_not_driven_on_old_assumptions(bench):
    box = bench.box()
    box.set_power(0.5)
    with bench.world.lock:
        now = bench.world.now
        bench.world.box("flash").power_cycle(now, boot_s=0.05, announce=False)
    with pytest.raises(BoxRebooted):
        box.set_polarizer("crossed")
    assert bench.world.box("flash").device.polarizer == "parallel"
    box.hello()
    assert box.power() == 1.0


# answers that no honest box gives -------------------------------------------------------------


@pytest.fixture
def liar(rig):
    """A box whose answers can be replaced: method name of the driver -> payload."""
    world = World(rig, seed=6)
    name = world.register("protocol-liar")
    box = FlashBox(Port(f"sim://flash?world={name}", clock=world.clock))

    def answer(payload):
        commands = world.box("flash").commands
        for header, command in commands.items():
            commands[header] = type(command)(
                lambda *_: payload, command.arguments, command.armed, command.bare
            )
        return box

    yield answer
    box.port.close()
    world.unregister()


@pytest.mark.parametrize(
    ("method", "arguments", "payload"),
    [
        ("charge_state", (), "0.5,1"),
        ("charge_state", (), "x,1,2"),
        ("power", (), "nan"),
        ("power", (), "full"),
        ("polarizer", (), "LEFT"),
        ("is_settled", (), "2"),
        ("count", (), ""),
        ("ping", (), "inf"),
        ("last_pop", (), "a,1,0.5,PAR,0"),
        ("last_pop", (), "a,1,0.5,UP,0,1"),
        ("last_pop", (), "a,1,much,PAR,0,1"),
        ("trigger_cameras", ("d",), "e,5"),
        ("trigger_cameras", ("d",), "d,x"),
        ("errors", (), "none"),
        ("errors", (), "5"),
        ("errors", (), 'x,"text"'),
        ("status", (), "armed"),
        ("hello", (), "{}*0000"),
        ("hello", (), "[]*0A50"),
    ],
)
def test_an_answer_that_makes_no_sense_is_named(liar, method, arguments, payload):
    with pytest.raises(BadAnswer, match="expected"):
        getattr(liar(payload), method)(*arguments)


def test_controller_of_other_kind_is_refused(rig, monkeypatch):
    monkeypatch.setattr("rigsim.boxes.flash.FlashUnit.kind", "dome")
    world = World(rig, faults=Faults())
    name = world.register("protocol-dome")
    with pytest.raises(WrongDevice, match="'dome' controller"):
        FlashBox(Port(f"sim://flash?world={name}"))
    assert not world.link("flash").attached
    world.unregister()


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_nonfinite_numbers_are_never_sent(liar, value):
    box = liar("")
    for send in (box.set_power, box.set_analyzer, box.lamp_on):
        with pytest.raises(ValueError, match="finite"):
            send(value)
    with pytest.raises(ValueError, match="polarizer"):
        box.set_polarizer("left")


def test_led_flashes_once_and_is_reported(bench):
    box = bench.box()
    box.set_led(590.0, 20.0)
    assert box.led() == "LED-590-20"
    box.wait_charged(5.0)
    box.arm()
    assert box.fire("shot-1").led == "LED-590-20"
    assert box.led() == ""
    assert box.last_pop().led == "LED-590-20"
