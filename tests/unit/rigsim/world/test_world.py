"""The simulated world: its time, its names, and ports and cameras on it."""

import dataclasses
import errno
import math
import termios

import numpy as np
import pytest
import serial
from serial.serialutil import PortNotOpenError

from capture.devices.camera import CameraUrlError, Exposure, open_camera
from capture.devices.port import Port
from capture.devices.wire import Request, encode
from capture.rig import load_rig
from rigsim import world as worlds
from rigsim.boxes.faults import Faults
from rigsim.urlhandler.protocol_sim import Serial, world_from_url
from rigsim.world.world import World

RIG = load_rig("flash").resized(16)


@pytest.fixture
def world():
    world = World(RIG, seed=4)
    world.register("unit-world")
    yield world
    world.unregister()


@pytest.fixture
def port(world):
    port = Serial(None, timeout=0.02, write_timeout=0.1)
    port.port = "sim://flash?world=unit-world"
    port.open()
    yield port
    port.close()


def play(world, times, script):
    """Feed framed commands at their times, advancing at `times` too; return what was said."""
    box, said = world.box("flash"), b""
    events = sorted([(t, "") for t in times] + script)
    for t, text in events:
        if text:
            said += box.feed(encode(Request(1000 + int(1000 * t), box.boot, text)), t)
        else:
            said += box.advance(t)
    return said, box.device.lamp_times, box.device.charge(9.0), box.device.count


SCRIPT = [
    (0.5, "SYST:ARM"),
    (0.6, "FLAS:LAMP ON,300"),
    (0.7, "FLAS:POW 0.7"),
    (1.2, "FLAS:FIRE a"),
    (1.3, "FLAS:LAMP ON,500"),
    (2.0, "FLAS:CHAR?"),
]


def test_one_big_step_equals_many_small_ones():
    big = play(World(RIG, seed=1), [9.0], SCRIPT)
    small = play(World(RIG, seed=1), [*np.arange(0.01, 9.0, 0.01), 9.0], SCRIPT)
    assert big[0] == small[0]
    assert b"WDOG:TRIP" in big[0]
    np.testing.assert_allclose(big[1], small[1], atol=1e-9)
    assert big[2:] == small[2:]


def test_virtual_time_passes_only_during_waits(world):
    assert world.now == 0.0
    world.clock.sleep(5.0)
    assert world.now == world.clock.monotonic() == 5.0
    world.advance(3.0)
    assert world.now == 5.0


def test_real_time_passes_without_waits():
    world = World(RIG, clock="real")
    before = world.now
    world.clock.sleep(0.02)
    assert world.now - before >= 0.02


def test_a_name_belongs_to_one_world(world):
    assert worlds.get_world("unit-world") is world
    assert world.register("unit-world") == "unit-world"
    with pytest.raises(ValueError, match="another world"):
        World(RIG).register("unit-world")
    world.unregister()
    world.unregister()
    with pytest.raises(KeyError, match="unit-world"):
        worlds.get_world("unit-world")


def test_url_without_world_makes_and_keeps_one():
    url = "sim://flash?seed=17&drop=0.25&reset_on_open=1"
    made, name = world_from_url(url)
    assert world_from_url(url) == (made, "flash")
    assert name == "flash"
    assert (made.seed, made.virtual, made.faults) == (17, True, Faults(drop=0.25, reset_on_open=1))
    made.unregister()
    again, _ = world_from_url(url)
    assert again is not made
    again.unregister()


def test_url_with_unknown_world_makes_world_so_named():
    made, _ = world_from_url("sim://flash?world=unit-made&clock=real")
    assert worlds.get_world("unit-made") is made
    assert not made.virtual
    made.unregister()


def test_world_is_addressed_equally_by_name_or_world():
    made, _ = world_from_url("sim://flash?name=unit-named")
    assert world_from_url("sim://flash?world=unit-named")[0] is made
    made.unregister()


@pytest.mark.parametrize("url", ["sim://probe", "sim://probe?seed=1&clock=virtual"])
def test_cameras_of_unnamed_world_are_found_by_controller(url):
    made, _ = world_from_url(url)
    camera = open_camera("sim://probe/cam")
    assert camera.info.serial == made.rig.view("cam").serial
    camera.close()
    other, _ = world_from_url("sim://probe?seed=2")
    with pytest.raises(CameraUrlError, match=r"of which there are 2, .* sim://BOX.world=NAME"):
        open_camera("sim://probe/cam")
    made.unregister()
    other.unregister()
    with pytest.raises(CameraUrlError, match="expected a registered one"):
        open_camera("sim://probe/cam")


@pytest.mark.parametrize(
    ("url", "match"),
    [
        ("sim://toaster", "expected one of flash"),
        ("sim://flash?seed=-1", "seed"),
        ("sim://flash?clock=fast", "clock"),
        ("sim://flash?dropp=1", "did you mean drop"),
        ("sim://flash?seed=1&seed=2", "twice"),
        ("sim://flash?drop=2", "probability"),
        ("sim://flash?seed", "bad query"),
        ("sim://flash?name=a&world=b", "world and name"),
    ],
)
def test_a_url_that_no_world_understands_is_named(url, match):
    with pytest.raises(ValueError, match=match):
        world_from_url(url)


def test_rig_with_unknown_controller_or_clock_is_refused():
    with pytest.raises(ValueError, match="clock"):
        World(RIG, clock="fast")
    with pytest.raises(KeyError, match="expected one of flash"):
        World(RIG).link("dome")


def test_frames_without_scene_have_black_level_read_noise():
    rig = load_rig("flash").resized(256)
    view = rig.view("cam")
    # two DN, so that rounding is noise like any other
    view = dataclasses.replace(view, read_noise_e=2.0 * view.gain_e_per_dn)
    rig = dataclasses.replace(rig, views=(view,))
    frame = World(rig).expose("cam", Exposure(0.01, 100), 0.0, seed=1)
    assert frame.shape == (view.height_px, view.width_px)
    noise_dn = view.read_noise_e / view.gain_e_per_dn
    # rounding adds 1/12; six standard errors: one seed in 10**9
    deviation = math.hypot(noise_dn, math.sqrt(1.0 / 12.0))
    assert abs(frame.mean() - view.black_level) < 6.0 * deviation / math.sqrt(frame.size)
    assert frame.std() == pytest.approx(deviation, rel=6.0 / math.sqrt(2.0 * frame.size))


def test_exposure_collects_pops_between_opening_and_closing(world):
    seen = []

    class Scene:
        def exposure(self, view_name, *, pops, exposure_s, seed):
            seen.append([pop.token for pop in pops])
            return np.zeros((10, 16), np.uint16)

    world.scene = Scene()
    box = world.box("flash")
    for seq, (t, text) in enumerate(
        [(1.0, "SYST:ARM"), (1.0, "FLAS:POW 0.01"), (1.5, "FLAS:FIRE a"), (2.0, "FLAS:FIRE b")]
    ):
        box.feed(encode(Request(seq, box.boot, text)), t)
    for start, length in [(1.0, 0.4), (1.0, 0.5), (1.5, 0.4), (1.5, 0.5), (1.6, 9.0)]:
        world.expose("cam", Exposure(length, 100), start, seed=0)
    assert seen == [[], ["a"], ["a"], ["a", "b"], ["b"]]


# the port, as pyserial's users see it ----------------------------------------------------------


def test_pyserial_finds_the_port_by_its_url(world):
    Port("sim://flash?world=unit-world").close()  # makes the handler known
    with serial.serial_for_url("sim://flash?world=unit-world", timeout=0.1) as port:
        port.write(b"*IDN?\n")
        assert port.read_until() == b"RIGSIM,FLASH2,FL-0001,1.0\n"


def test_bytes_take_their_time_on_the_line(world, port):
    port.write(b"*IDN?\n")
    assert port.in_waiting == 0
    answer = port.read(100)
    # 6 bytes there and 26 back at 86.8 us each, then silence up to the timeout
    assert len(answer) == 26
    assert world.transcript[-1].split()[0] == f"{32 * 10 / 115_200:.6f}"


def test_a_read_ends_at_its_timeout(world, port):
    before = world.now
    assert port.read(10) == b""
    assert world.now - before == pytest.approx(0.02)


def test_endless_read_without_timeout_is_refused(port):
    port.timeout = None
    with pytest.raises(serial.SerialException, match="needs a timeout"):
        port.read(1)


def test_flush_drops_received_bytes(world, port):
    port.write(b"*IDN?\n")
    world.clock.sleep(0.01)
    assert port.in_waiting == 26
    port.reset_input_buffer()
    assert port.in_waiting == 0


def test_closed_port_is_reported(port):
    port.close()
    for act in (lambda: port.read(1), lambda: port.write(b"x"), port.reset_input_buffer):
        with pytest.raises(PortNotOpenError):
            act()


def test_a_pulled_cable_fails_as_real_ones_do():
    world = World(RIG, faults=Faults(unplug_after=1.0))
    world.register("unit-unplugged")
    port = Serial(None, timeout=0.02)
    port.port = "sim://flash?world=unit-unplugged"
    port.open()
    world.clock.sleep(1.0)
    with pytest.raises(serial.SerialException, match="disconnected"):
        port.read(1)
    with pytest.raises(serial.SerialException, match="write failed"):
        port.write(b"x")
    with pytest.raises(OSError, match="Input/output") as caught:
        assert port.in_waiting
    assert not isinstance(caught.value, serial.SerialException)
    with pytest.raises(termios.error) as caught:
        port.reset_input_buffer()
    assert caught.value.args[0] == errno.EIO
    port.close()
    with pytest.raises(serial.SerialException, match="could not open"):
        port.open()
    world.unregister()


def test_a_stalled_line_is_a_write_timeout():
    world = World(RIG, faults=Faults(stall_after=0.0, stall_s=10.0))
    world.register("unit-stalled")
    port = Serial(None, timeout=0.02, write_timeout=0.1)
    port.port = "sim://flash?world=unit-stalled"
    port.open()
    port.write(b"x" * 200)
    with pytest.raises(serial.SerialTimeoutException):
        port.write(b"x" * 100)
    assert world.now == pytest.approx(0.1)
    port.close()
    world.unregister()
