"""Programs that know nothing of us talk to what is served: bash, PyVISA and serialx."""

import shutil
import subprocess

import pytest
import serial

from capture.devices.flash import FlashBox
from capture.devices.port import Port
from rigsim.world import World
from rigsim.world.serve import ServeError, serve

IDN = "RIGSIM,FLASH2,FL-0001,1.0"
SCRIPT = """
printf '*IDN?\\n' >&3; read -r -t 5 -u 3 line; echo "$line"
printf 'FLAS:FIRE a\\n' >&3
printf 'SYST:ERR?\\n' >&3; read -r -t 5 -u 3 line; echo "$line"
printf 'FLAS:COUN?\\n' >&3; read -r -t 5 -u 3 line; echo "$line"
"""
ANSWERS = [IDN, '203,"Unframed command"', "0"]


@pytest.fixture(params=["pty", "tcp"])
def served(request, rig):
    with serve(rig, pty=request.param == "pty") as served:
        yield served


def test_bash_asks_and_is_refused_a_bare_command(served):
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("no bash")
    url = served.addresses["flash"]
    path = url.replace("socket://", "/dev/tcp/").replace(":", "/")
    run = subprocess.run(
        [bash, "-c", f"exec 3<>{path}\n{SCRIPT}"], capture_output=True, text=True, timeout=120
    )
    assert run.stdout.splitlines() == ANSWERS, run.stderr
    assert served.world.pops == []


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_pyvisa_asks_and_is_refused_a_bare_command(served):
    pyvisa = pytest.importorskip("pyvisa")
    pytest.importorskip("pyvisa_py")
    url = served.addresses["flash"]
    if url.startswith("socket://"):
        host, _, port = url.removeprefix("socket://").rpartition(":")
        name = f"TCPIP::{host}::{port}::SOCKET"
    else:
        name = f"ASRL{url}::INSTR"
    manager = pyvisa.ResourceManager("@py")
    box = manager.open_resource(name, read_termination="\n", write_termination="\r\n", timeout=5000)
    assert box.query("*IDN?") == IDN
    box.write("FLAS:FIRE a")
    assert [box.query("SYST:ERR?"), box.query("FLAS:COUN?")] == ANSWERS[1:]
    assert box.query("SYST:CAP?").startswith('{"kind":"flash"')
    box.close()
    manager.close()


def test_serialx_asks_and_is_refused_a_bare_command(served):
    serialx = pytest.importorskip("serialx")
    with serialx.serial_for_url(served.addresses["flash"], baudrate=115_200, timeout=5.0) as box:

        def query(text):
            box.write(text + b"\r\n")
            return box.readline().decode().rstrip()

        assert query(b"*IDN?") == IDN
        box.write(b"FLAS:FIRE a\n")
        assert [query(b"SYST:ERR?"), query(b"FLAS:COUN?")] == ANSWERS[1:]
    assert served.world.pops == []


def test_the_driver_works_on_serialx_in_place_of_pyserial(served, monkeypatch):
    """The six methods that a port uses are the same there, so that a change is one file's."""
    serialx = pytest.importorskip("serialx")

    def serial_for_url(url, **settings):
        port = serialx.serial_for_url(url, **settings)
        port.open()  # pyserial's has done so
        return port

    monkeypatch.setattr(serial, "serial_for_url", serial_for_url)
    with FlashBox(Port(served.addresses["flash"])) as box:
        assert box.identify() == IDN
        box.wait_charged(5.0)
        box.arm()
        assert box.fire("serialx").count == 1
        assert box.port.statistics.retries == 0
    assert [pop.token for pop in served.world.pops] == ["serialx"]


def test_served_addresses_name_boxes_first(rig):
    with serve(rig) as served:
        assert list(served.addresses) == ["flash", "cam"]
        assert served.addresses["flash"].startswith("socket://127.0.0.1:")
        assert served.addresses["cam"].startswith("tcp://127.0.0.1:")


@pytest.mark.parametrize("tcp", ["0.0.0.0:0", "192.0.2.1:5000", "example.org:1"])
def test_an_address_that_others_reach_must_be_permitted(rig, tcp):
    with pytest.raises(ServeError, match="fire the lights"):
        serve(rig, tcp=tcp)


def test_a_permitted_address_is_warned_about(rig, caplog):
    with serve(rig, tcp="0.0.0.0:0", allow_remote=True):
        assert "other machines" in caplog.text


@pytest.mark.parametrize("tcp", ["127.0.0.1", ":5", "127.0.0.1:x", "127.0.0.1:99999"])
def test_what_is_no_address_is_named(rig, tcp):
    with pytest.raises(ServeError, match="expected HOST:PORT"):
        serve(rig, tcp=tcp)


def test_a_taken_port_is_named(rig):
    with serve(rig) as served:
        taken = served.addresses["flash"].removeprefix("socket://")
        with pytest.raises(ServeError, match="cannot listen"):
            serve(rig, tcp=taken)


def test_a_world_on_a_virtual_clock_is_not_served(rig):
    with pytest.raises(ServeError, match="clock"):
        serve(rig, world=World(rig))
