"""Two boxes of one rig are served side by side; programs that know nothing of us talk to both."""

import contextlib
import shutil
import subprocess

import pytest

from capture.devices.caliper import CaliperBox
from capture.devices.gradient_sphere import GradientSphereBox
from capture.devices.port import Port, PortBusy, WrongDevice
from capture.rig import load_rig
from rigsim.world.serve import ServeError, serve
from skinrig.capturing.addresses import addresses, require_addresses
from skinrig.errors import UsageError

RIG = load_rig("gradient").cropped(16)
IDN = {"gradient_sphere": "RIGSIM,SPHERE1,GS-0001,1.0", "caliper": "RIGSIM,CALIPER1,CA-0001,1.0"}
ACT = {"gradient_sphere": "PATT FULL,100", "caliper": "CAL:HOME"}
QUERY = {"gradient_sphere": ("PATT?", "DARK"), "caliper": ("CAL:FORC:LIM?", "NONE")}


@pytest.fixture(params=["pty", "tcp"])
def served(request):
    with serve(RIG, pty=request.param == "pty") as served:
        yield served


@pytest.mark.parametrize("name", IDN)
def test_bash_asks_and_is_refused_a_bare_command(served, name):
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("no bash")
    path = served.addresses[name].replace("socket://", "/dev/tcp/").replace(":", "/")
    query, answer = QUERY[name]
    script = f"exec 3<>{path}\n"
    for text, answers in (("*IDN?", 1), (ACT[name], 0), ("SYST:ERR?", 1), (query, 1)):
        script += f"printf '{text}\\n' >&3\n"
        script += 'read -r -t 5 -u 3 line; echo "$line"\n' * answers
    run = subprocess.run([bash, "-c", script], capture_output=True, text=True, timeout=120)
    assert run.stdout.splitlines() == [IDN[name], '203,"Unframed command"', answer], run.stderr
    assert served.world.switched == []
    assert served.world.box("caliper").device.moves == []


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
@pytest.mark.parametrize("name", IDN)
def test_pyvisa_asks_and_is_refused_a_bare_command(served, name):
    pyvisa = pytest.importorskip("pyvisa")
    pytest.importorskip("pyvisa_py")
    url = served.addresses[name]
    if url.startswith("socket://"):
        host, _, port = url.removeprefix("socket://").rpartition(":")
        resource = f"TCPIP::{host}::{port}::SOCKET"
    else:
        resource = f"ASRL{url}::INSTR"
    manager = pyvisa.ResourceManager("@py")
    box = manager.open_resource(
        resource, read_termination="\n", write_termination="\r\n", timeout=5000
    )
    assert box.query("*IDN?") == IDN[name]
    box.write(ACT[name])
    assert box.query("SYST:ERR?") == '203,"Unframed command"'
    assert box.query("SYST:CAP?").startswith(f'{{"kind":"{name}"')
    if name == "caliper":
        box.write("CAL:REL")  # what lets go needs no frame
        assert box.query("SYST:ERR?") == '0,"No error"'
    box.close()
    manager.close()


@pytest.mark.parametrize("name", IDN)
def test_serialx_asks_and_is_refused_a_bare_command(served, name):
    serialx = pytest.importorskip("serialx")
    with serialx.serial_for_url(served.addresses[name], baudrate=115_200, timeout=5.0) as box:

        def query(text):
            box.write(text.encode() + b"\r\n")
            return box.readline().decode().rstrip()

        assert query("*IDN?") == IDN[name]
        box.write(ACT[name].encode() + b"\n")
        assert query("SYST:ERR?") == '203,"Unframed command"'


def test_both_boxes_are_driven_at_once_and_neither_disturbs_the_other(served):
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


def test_a_box_that_is_held_is_busy_while_the_other_is_free():
    with (
        serve(RIG, pty=True) as served,
        CaliperBox(Port(served.addresses["caliper"])),
        GradientSphereBox(Port(served.addresses["gradient_sphere"])),
        pytest.raises(PortBusy),
    ):
        Port(served.addresses["caliper"])


def test_the_addresses_of_both_boxes_are_wanted():
    given = addresses(["gradient_sphere=/dev/a"], "--port")
    with pytest.raises(UsageError, match="--port caliper=URL --camera cam=URL"):
        require_addresses(RIG, given, {})
    require_addresses(RIG, {**given, "caliper": "/dev/b"}, {"cam": "sim://x/cam"})


def test_ports_follow_one_another_in_the_order_of_the_rig():
    for _ in range(5):  # another program may take a port meanwhile
        with serve(RIG) as probe:
            base = int(probe.addresses["gradient_sphere"].rpartition(":")[2])
        with contextlib.suppress(ServeError), serve(RIG, tcp=f"127.0.0.1:{base}") as served:
            urls = [url.partition("://")[2].split("/")[0] for url in served.addresses.values()]
            assert [int(url.rpartition(":")[2]) for url in urls] == [base, base + 1, base + 2]
            return
    raise AssertionError("five times in a row a port was taken")
