"""A probe's box is served; programs that know nothing of us talk to it, and may vent."""

import shutil
import subprocess

import pytest

from capture.devices.port import Port, PortBusy
from capture.devices.probe import ProbeBox
from capture.rig import load_rig
from rigsim.world.serve import serve
from skinrig.capturing.addresses import require_addresses
from skinrig.errors import UsageError

RIG = load_rig("probe")
IDN = "RIGSIM,PROBE1,PR-0001,1.0"


@pytest.fixture(params=["pty", "tcp"])
def served(request):
    with serve(RIG, pty=request.param == "pty") as served:
        yield served


def test_bash_asks_and_is_refused_a_bare_command(served):
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("no bash")
    path = served.addresses["probe"].replace("socket://", "/dev/tcp/").replace(":", "/")
    script = f"exec 3<>{path}\n"
    asked = (
        ("*IDN?", 1),
        ("SHUT OPEN,100", 0),
        ("SYST:ERR?", 1),
        ("PUMP ON,5000,60", 0),
        ("SYST:ERR?", 1),
        ("PUMP VENT", 0),
        ("SYST:ERR?", 1),
        ("HEAD:SITE?", 1),
    )
    for text, answers in asked:
        script += f"printf '{text}\\n' >&3\n"
        script += 'read -r -t 5 -u 3 line; echo "$line"\n' * answers
    run = subprocess.run([bash, "-c", script], capture_output=True, text=True, timeout=120)
    unframed = '203,"Unframed command"'
    expected = [IDN, unframed, unframed, '0,"No error"', "NONE"]
    assert run.stdout.splitlines() == expected, run.stderr
    assert served.world.switched == []
    assert served.world.box("probe").device.pump.count == 0


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_pyvisa_asks_and_is_refused_a_bare_command(served):
    pyvisa = pytest.importorskip("pyvisa")
    pytest.importorskip("pyvisa_py")
    url = served.addresses["probe"]
    if url.startswith("socket://"):
        host, _, port = url.removeprefix("socket://").rpartition(":")
        resource = f"TCPIP::{host}::{port}::SOCKET"
    else:
        resource = f"ASRL{url}::INSTR"
    manager = pyvisa.ResourceManager("@py")
    box = manager.open_resource(
        resource, read_termination="\n", write_termination="\r\n", timeout=5000
    )
    assert box.query("*IDN?") == IDN
    box.write("LED 1000")
    assert box.query("SYST:ERR?") == '203,"Unframed command"'
    assert box.query("SYST:CAP?").startswith('{"kind":"probe"')
    assert abs(float(box.query("PRES?"))) < 5.0
    for harmless in ("SHUT CLOSE", "PUMP VENT", "HEAD:FREE"):
        box.write(harmless)
        assert box.query("SYST:ERR?") == '0,"No error"'
    box.close()
    manager.close()


def test_serialx_asks_and_is_refused_a_bare_command(served):
    serialx = pytest.importorskip("serialx")
    with serialx.serial_for_url(served.addresses["probe"], baudrate=115_200, timeout=5.0) as box:

        def query(text):
            box.write(text.encode() + b"\r\n")
            return box.readline().decode().rstrip()

        assert query("*IDN?") == IDN
        box.write(b"PUMP ON,5000,60\n")
        assert query("SYST:ERR?") == '203,"Unframed command"'


def test_a_box_that_is_held_is_busy():
    with (
        serve(RIG, pty=True) as served,
        ProbeBox(Port(served.addresses["probe"])),
        pytest.raises(PortBusy),
    ):
        Port(served.addresses["probe"])


def test_the_addresses_of_box_and_camera_are_wanted():
    with pytest.raises(UsageError, match="--port probe=URL --camera cam=URL"):
        require_addresses(RIG, {}, {})
    require_addresses(RIG, {"probe": "/dev/b"}, {"cam": "sim://x/cam"})
