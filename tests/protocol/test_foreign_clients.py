"""Programs that know nothing of us talk to each served box: bash, PyVISA and serialx."""

import contextlib
import shutil
import socket
import subprocess

import pytest
import serial
from fixtures.box_manuals import ANY, BOXES, FLASH

from capture.devices.flash import FlashBox
from capture.devices.port import Port, PortBusy
from rigsim.world import World
from rigsim.world.box_endpoints import MAX_LEAVING
from rigsim.world.serve import ServeError, serve_world

UNFRAMED = '203,"Unframed command"'
NO_ERROR = '0,"No error"'

each_box = pytest.mark.parametrize("manual", BOXES.values(), ids=BOXES)


@pytest.fixture(params=["pty", "tcp"])
def url_of(request):
    """Serve a box's rig and return its address; gone when the test ends."""
    with contextlib.ExitStack() as stack:

        def url_of(manual):
            served = stack.enter_context(serve_world(manual.rig, pty=request.param == "pty"))
            url_of.box = served.world.box(manual.name)
            return served.addresses[manual.name]

        yield url_of


def exchange(manual):
    """What a program says to a box that nobody armed, and what each line is answered."""
    said = [("*IDN?", manual.identity)]
    for text in manual.acts:
        said += [(text, None), ("SYST:ERR?", UNFRAMED)]
    for text in manual.unframed:
        said += [(text, None), ("SYST:ERR?", NO_ERROR)]
    answers = manual.answers.values()
    return said + [(text, payload) for text, _, payload in answers if _plain_query(text, payload)]


def _plain_query(text, payload):
    return text.endswith("?") and payload is not ANY


@each_box
def test_bash_asks_and_is_refused_a_bare_command(url_of, manual):
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("no bash")
    path = url_of(manual).replace("socket://", "/dev/tcp/").replace(":", "/")
    said = exchange(manual)
    script = f"exec 3<>{path}\n"
    for text, answer in said:
        script += f"printf '{text}\\n' >&3\n"
        script += 'read -r -t 5 -u 3 line; echo "$line"\n' * (answer is not None)
    run = subprocess.run([bash, "-c", script], capture_output=True, text=True, timeout=120)
    expected = [answer for _, answer in said if answer is not None]
    assert run.stdout.splitlines() == expected, run.stderr
    assert manual.begun(url_of.box.device) == 0
    assert manual.idle(url_of.box.device)


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
@each_box
def test_pyvisa_asks_and_is_refused_a_bare_command(url_of, manual):
    pyvisa = pytest.importorskip("pyvisa")
    pytest.importorskip("pyvisa_py")
    url = url_of(manual)
    if url.startswith("socket://"):
        host, _, port = url.removeprefix("socket://").rpartition(":")
        name = f"TCPIP::{host}::{port}::SOCKET"
    else:
        name = f"ASRL{url}::INSTR"
    manager = pyvisa.ResourceManager("@py")
    box = manager.open_resource(name, read_termination="\n", write_termination="\r\n", timeout=5000)
    for text, answer in exchange(manual):
        if answer is None:
            box.write(text)
        else:
            assert box.query(text) == answer
    assert box.query("SYST:CAP?").startswith(f'{{"kind":"{manual.name}"')
    box.close()
    manager.close()


@each_box
def test_serialx_asks_and_is_refused_a_bare_command(url_of, manual):
    serialx = pytest.importorskip("serialx")
    with serialx.serial_for_url(url_of(manual), baudrate=115_200, timeout=5.0) as box:
        for text, answer in exchange(manual):
            box.write(text.encode() + b"\r\n")
            if answer is not None:
                assert box.readline().decode().rstrip() == answer


@each_box
def test_held_controller_is_busy(manual):
    with serve_world(manual.rig, pty=True) as served:
        url = served.addresses[manual.name]
        with contextlib.closing(Port(url)), pytest.raises(PortBusy):
            Port(url)


@pytest.fixture(params=["pty", "tcp"])
def served(request, rig):
    with serve_world(rig, pty=request.param == "pty") as served:
        yield served


def test_driver_works_on_serialx_instead_of_pyserial(served, monkeypatch):
    """The six methods that a port uses are the same there, so that a change is one file's."""
    serialx = pytest.importorskip("serialx")

    def serial_for_url(url, **settings):
        port = serialx.serial_for_url(url, **settings)
        port.open()  # pyserial's has done so
        return port

    monkeypatch.setattr(serial, "serial_for_url", serial_for_url)
    with FlashBox(Port(served.addresses["flash"])) as box:
        assert box.identify() == FLASH.identity
        box.wait_charged(5.0)
        box.arm()
        assert box.fire("serialx").count == 1
        assert box.port.statistics.retries == 0
    assert [pop.token for pop in served.world.pops] == ["serialx"]


def test_served_addresses_name_controllers_first(rig):
    with serve_world(rig) as served:
        assert list(served.addresses) == ["flash", "cam"]
        assert served.addresses["flash"].startswith("socket://127.0.0.1:")
        assert served.addresses["cam"].startswith("tcp://127.0.0.1:")


@pytest.mark.parametrize("tcp", ["0.0.0.0:0", "192.0.2.1:5000", "example.org:1"])
def test_an_address_that_others_reach_is_refused(rig, tcp):
    with pytest.raises(ServeError, match="ssh -L"):
        serve_world(rig, tcp=tcp)


BROWSER_REQUEST = b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n*IDN?\nSYST:ARM?\n"


@contextlib.contextmanager
def served_flash(rig):
    """Serve a flash; yield its URL, its host and port, and the service."""
    with serve_world(rig) as served:
        host, _, port = served.addresses["flash"].removeprefix("socket://").partition(":")
        yield served.addresses["flash"], (host, int(port)), served


@pytest.mark.parametrize("start", [BROWSER_REQUEST, b"\x16\x03\x01\x02\x00*IDN?\n"])
def test_request_of_a_browser_gets_no_answer(rig, start):
    with served_flash(rig) as (url, address, _):
        with socket.create_connection(address, timeout=5.0) as browser:
            browser.sendall(start)
            assert browser.recv(100) == b""
        with FlashBox(Port(url)) as box:
            assert box.errors() == []


def test_clients_that_never_leave_are_bounded(rig):
    with served_flash(rig) as (url, address, served), contextlib.ExitStack() as held:
        box = held.enter_context(FlashBox(Port(url)))
        for _ in range(3 * MAX_LEAVING):
            client = held.enter_context(socket.create_connection(address, timeout=5.0))
            assert client.recv(1) == b""
        assert len(served._ends[0]._leaving) <= MAX_LEAVING
        assert box.count() == 0


@pytest.mark.parametrize("tcp", ["127.0.0.1", ":5", "127.0.0.1:x", "127.0.0.1:99999"])
def test_invalid_serve_address_is_refused_with_expected_form(rig, tcp):
    with pytest.raises(ServeError, match="expected HOST:PORT"):
        serve_world(rig, tcp=tcp)


def test_a_taken_port_is_named(rig):
    with serve_world(rig) as served:
        taken = served.addresses["flash"].removeprefix("socket://")
        with pytest.raises(ServeError, match="cannot listen"):
            serve_world(rig, tcp=taken)


def test_world_on_virtual_clock_is_not_served(rig):
    with pytest.raises(ServeError, match="clock"):
        serve_world(rig, world=World(rig))
