"""Two boxes of one rig are served side by side."""

import contextlib

import pytest

from capture.devices.caliper import CaliperBox
from capture.devices.camera import open_camera
from capture.devices.gradient_sphere import GradientSphereBox
from capture.devices.port import Port, PortBusy, WrongDevice
from capture.rig import load_rig
from rigsim.world.serve import ServeError, serve_world
from skinrig.capturing.addresses import parse_addresses, require_addresses
from skinrig.errors import UsageError
from skinrig.simulating.serving import ServeOrder, _next_step

RIG = load_rig("gradient").cropped(16)


@pytest.fixture(params=["pty", "tcp"])
def served(request):
    with serve_world(RIG, pty=request.param == "pty") as served:
        yield served


def test_both_controllers_run_at_once_without_interference(served):
    assert list(served.addresses) == ["gradient_sphere", "caliper", "cam"]
    with (
        GradientSphereBox(Port(served.addresses["gradient_sphere"])) as sphere,
        CaliperBox(Port(served.addresses["caliper"])) as caliper,
    ):
        for box in (caliper, sphere):
            box.set_lease(5.0)
        caliper.arm()
        sphere.arm()
        # as long as it may be: a busy machine may ask late what is lit
        lit = []
        for _ in range(8):
            sphere.light("x", 0.5, level=0.5)
            lit.append(sphere.lit())
            if lit[-1] == "x":
                break
            sphere.listen(1.0)  # the duty of the LEDs
        assert lit[-1] == "x"
        caliper.dark()
        assert sphere.is_armed()
        assert not caliper.is_armed()
        sphere.listen(0.2)
    assert [light.pattern for light in served.world.switched] == ["x"] * len(lit)


def test_exchanged_addresses_are_noticed(served):
    with pytest.raises(WrongDevice, match="exchange the addresses"):
        CaliperBox(Port(served.addresses["gradient_sphere"]))


def test_held_controller_is_busy_while_other_is_free():
    with (
        serve_world(RIG, pty=True) as served,
        CaliperBox(Port(served.addresses["caliper"])),
        GradientSphereBox(Port(served.addresses["gradient_sphere"])),
        pytest.raises(PortBusy),
    ):
        Port(served.addresses["caliper"])


def test_controller_and_camera_addresses_are_required():
    probe = load_rig("probe")
    with pytest.raises(UsageError, match="--port probe=URL --camera cam=URL"):
        require_addresses(probe, {}, {})
    require_addresses(probe, {"probe": "/dev/b"}, {"cam": "sim://x/cam"})


def test_addresses_of_both_controllers_are_required():
    given = parse_addresses(["gradient_sphere=/dev/a"], "--port")
    with pytest.raises(UsageError, match="--port caliper=URL --camera cam=URL"):
        require_addresses(RIG, given, {})
    require_addresses(RIG, {**given, "caliper": "/dev/b"}, {"cam": "sim://x/cam"})


def test_ports_are_consecutive_in_rig_order():
    for _ in range(5):  # another program may take a port meanwhile
        with serve_world(RIG) as probe:
            base = int(probe.addresses["gradient_sphere"].rpartition(":")[2])
        with contextlib.suppress(ServeError), serve_world(RIG, tcp=f"127.0.0.1:{base}") as served:
            urls = [url.partition("://")[2].split("/")[0] for url in served.addresses.values()]
            assert [int(url.rpartition(":")[2]) for url in urls] == [base, base + 1, base + 2]
            return
    raise AssertionError("five times in a row a port was taken")


def test_dome_serves_scanner_with_its_cameras():
    """The printed command captures with the scanner, whose cameras answer like the dome's."""
    rig = load_rig("dome").with_scanner()
    with serve_world(rig) as served:
        assert {"dome", "scanner", "S0", "S3", rig.views[0].name} <= served.addresses.keys()
        with contextlib.closing(open_camera(served.addresses["S3"])) as camera:
            assert camera.info.width_px == rig.view("S3").width_px
        command = _next_step("dome", rig, served.addresses, ServeOrder())
    assert f"--port scanner={served.addresses['scanner']}" in command
    assert command.endswith("--scanner --eyes closed --out session")
