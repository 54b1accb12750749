"""Requests, retries and lost links, byte by byte, on a line that a script plays."""

import errno
import sys
import termios
import threading

import pytest
import serial
from fixtures.scripted_line import HELLO, Line, StillClock, ask, greet, say

from capture.devices import port_url
from capture.devices.port import (
    BadAnswer,
    BoxRebooted,
    CommandRefused,
    LinkLost,
    Port,
    PortBusy,
    PortTimeout,
    PortUrlError,
    WrongDevice,
)
from capture.devices.wire import Event, Reply, Request, encode


def test_hello_after_newline_learns_the_epoch(open_port):
    port = open_port()
    assert port.boot == 0x9F3A
    assert port.statistics.requests == 1


def test_port_opens_exclusively_with_both_timeouts(open_port):
    options = open_port().line.options
    assert options["exclusive"] is True
    assert options["timeout"] > 0.0
    assert options["write_timeout"] > 0.0


def test_requests_are_numbered_and_answered(open_port):
    port = open_port((ask(8, "STAT?"), say(8, "0")), (ask(9, "*IDN?"), say(9, "x")))
    assert port.ask("STAT?") == "0"
    assert port.ask("*IDN?") == "x"
    assert port.statistics.retries == 0


def test_retry_sends_same_bytes_after_newline(open_port):
    port = open_port(
        (ask(8, "FLAS:FIRE a"), b""),
        (ask(8, "FLAS:FIRE a", retry=True), b""),
        (ask(8, "FLAS:FIRE a", retry=True), say(8, "done")),
    )
    frames = port.statistics.frames
    assert port.ask("FLAS:FIRE a") == "done"
    assert port.statistics.retries == 2
    assert port.statistics.frames == frames + 3


def test_nak_triggers_immediate_retry(open_port):
    port = open_port(
        (ask(8, "SAFE"), encode(Event(0, 0x9F3A, "NAK", "204"))),
        (ask(8, "SAFE", retry=True), say(8)),
    )
    assert port.ask("SAFE") == ""
    assert port.statistics.naks == 1


def test_silence_raises_timeout_error_subclass(open_port):
    port = open_port(*[(ask(8, "SAFE", retry=k > 0), b"") for k in range(3)])
    with pytest.raises(PortTimeout, match="after 3 attempts") as caught:
        port.ask("SAFE")
    assert isinstance(caught.value, TimeoutError)


def test_answer_to_earlier_request_is_discarded(open_port):
    port = open_port((ask(8, "STAT?"), say(7, "old") + say(8, "new")))
    assert port.ask("STAT?") == "new"
    assert port.statistics.stale == 1


def test_babble_and_damaged_answers_are_thrown_away(open_port):
    damaged = say(8, "5").replace(b"5", b"4", 1)
    port = open_port((ask(8, "STAT?"), b"boot v1\r\n" + damaged + say(8, "5")))
    assert port.ask("STAT?") == "5"
    assert port.statistics.bad_lines == 2


def test_endless_noise_ends_attempt_with_stopped_clock(open_port):
    noise = b"x" * 100_000
    port = open_port(*[(ask(8, "STAT?", retry=k > 0), noise) for k in range(3)])
    with pytest.raises(PortTimeout):
        port.ask("STAT?")


def test_a_refusal_carries_its_code(open_port):
    port = open_port((ask(8, "FLAS:FIRE a"), say(8, "Not armed", code=-203)))
    with pytest.raises(CommandRefused, match="nothing was done") as caught:
        port.ask("FLAS:FIRE a")
    assert caught.value.code == -203


@pytest.mark.parametrize(
    "answer", [say(8, "x", boot=0x1111), say(8, "Boot changed", boot=0x1111, code=201)]
)
def test_another_epoch_is_a_reboot_until_hello(open_port, answer):
    hello = (b"\n" + encode(Request(9, 0, "SYST:HELLO?")), say(9, HELLO, boot=0x1111))
    port = open_port((ask(8, "STAT?"), answer), hello, (ask(10, "STAT?", boot=0x1111), b""))
    with pytest.raises(BoxRebooted):
        port.ask("STAT?")
    with pytest.raises(BoxRebooted, match="call hello"):
        port.ask("STAT?")
    assert port.hello().boot == 0x1111
    port.line.script[-1] = (ask(10, "STAT?", boot=0x1111), say(10, "0", boot=0x1111))
    assert port.ask("STAT?") == "0"
    assert port.statistics.reboots == 1


def test_events_are_kept_and_number_gaps_counted(open_port):
    trips = [encode(Event(n, 0x9F3A, "WDOG:TRIP", "300")) for n in (0, 3)]
    port = open_port((ask(8, "STAT?"), b"".join(trips) + say(8, "2")))
    assert port.ask("STAT?") == "2"
    assert [event.number for event in port.listen(0.1)] == [0, 3]
    assert port.listen(0.1) == []
    assert port.statistics.lost_events == 2


def test_answers_while_listening_count_as_stale(open_port):
    port = open_port()
    port.line.arrived += say(3, "late") + encode(Event(0, 0x9F3A, "WDOG:TRIP", "300"))
    assert len(port.listen(0.1)) == 1
    assert port.statistics.stale == 1


FAILURES = [
    serial.SerialException("device reports readiness to read but returned no data"),
    OSError(errno.EIO, "Input/output error"),
    termios.error(5, "Input/output error"),
    TypeError("'NoneType' object cannot be interpreted as an integer"),
    AttributeError("'NoneType' object has no attribute 'select'"),
]


@pytest.mark.parametrize("failure", FAILURES, ids=lambda f: type(f).__name__)
@pytest.mark.parametrize("where", ["write", "read", "in_waiting", "reset_input_buffer"])
def test_lost_device_exceptions_map_to_same_error(open_port, monkeypatch, failure, where):
    port = open_port()
    line = port.line

    def fail(*_):
        raise failure

    monkeypatch.setattr(Line, where, property(fail) if where == "in_waiting" else fail)
    if where != "write":
        monkeypatch.setattr(Line, "write", lambda *_: None)
    with pytest.raises(LinkLost) as caught:
        port.hello() if where == "reset_input_buffer" else port.ask("STAT?")
    assert caught.value.__cause__ is failure
    assert isinstance(caught.value, ConnectionError)
    assert line.closed
    with pytest.raises(LinkLost, match="reopen"):
        port.hello()


def test_controller_accepting_no_bytes_is_retried_then_timeout(open_port):
    stalled = serial.SerialTimeoutException("Write timeout")
    port = open_port(*[(ask(8, "SAFE", retry=k > 0), stalled) for k in range(3)])
    with pytest.raises(PortTimeout):
        port.ask("SAFE")


@pytest.mark.parametrize(
    ("payload", "error"),
    [("2,flash,FL-0001,1.0", WrongDevice), ("flash", BadAnswer), ("", BadAnswer)],
)
def test_a_greeting_that_is_not_understood_is_refused(monkeypatch, payload, error):
    greeting = b"\n" + encode(Request(7, 0, "SYST:HELLO?"))
    line = Line([(greeting, encode(Reply(7, 0x9F3A, 0, payload)))])
    monkeypatch.setattr(serial, "serial_for_url", lambda url, **_: line)
    with pytest.raises(error):
        Port("/dev/box", clock=StillClock(), first_seq=7).hello()


def test_controller_ignoring_hello_is_timeout(monkeypatch):
    greeting = b"\n" + encode(Request(7, 0, "SYST:HELLO?"))
    line = Line([(greeting, b"")] * 4)
    monkeypatch.setattr(serial, "serial_for_url", lambda url, **_: line)
    with pytest.raises(PortTimeout, match="HELLO"):
        Port("/dev/box", clock=StillClock(), first_seq=7).hello(timeout_s=1.0)
    assert not line.script


def test_missing_port_is_lost_link(tmp_path):
    with pytest.raises(LinkLost, match="cannot open"):
        Port(str(tmp_path / "ttyUSB0"))


def test_a_port_that_another_program_holds_is_busy(monkeypatch):
    def locked(url, **_):
        raise serial.SerialException(errno.EAGAIN, "Could not exclusively lock port /dev/box")

    monkeypatch.setattr(serial, "serial_for_url", locked)
    with pytest.raises(PortBusy, match="another program"):
        Port("/dev/box")


def test_port_without_permission_is_not_called_busy(monkeypatch):
    """Advice to end another program would send the person to the wrong place."""

    def forbidden(url, **_):
        raise serial.SerialException(errno.EACCES, "could not open port: permission denied")

    monkeypatch.setattr(serial, "serial_for_url", forbidden)
    with pytest.raises(LinkLost, match="cannot open /dev/box: Permission denied") as caught:
        Port("/dev/box")
    assert not isinstance(caught.value, PortBusy)


@pytest.mark.parametrize("url", ["nonsense://box", "sim://flash?dorp=1", "sim://toaster"])
def test_unknown_port_url_is_reported_with_suggestion(url):
    with pytest.raises(PortUrlError, match=r"nonsense|did you mean drop|expected 'flash'|flash"):
        Port(url)


def test_an_import_error_inside_a_url_handler_shows(monkeypatch, tmp_path):
    package = tmp_path / "broken_handlers"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "protocol_broken.py").write_text("import no_such_library\n")
    monkeypatch.syspath_prepend(tmp_path)

    class EntryPoint:
        name, value = "broken", "broken_handlers"

    monkeypatch.setattr(port_url, "_handlers", lambda scheme: [EntryPoint])
    with pytest.raises(ModuleNotFoundError, match="no_such_library"):
        Port("broken://box")
    sys.modules.pop("broken_handlers", None)


def test_port_belongs_to_its_creating_thread(open_port):
    port = open_port()
    caught = []

    def elsewhere():
        try:
            port.ask("STAT?")
        except RuntimeError as error:
            caught.append(error)

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join(10.0)
    assert "two threads" in str(caught[0])


def test_first_numbers_differ_from_run_to_run(monkeypatch):
    monkeypatch.setattr(serial, "serial_for_url", lambda url, **_: Line([]))
    numbers = {Port("/dev/box")._seq for _ in range(8)}
    # two of eight equal by chance: 28 / 2**32
    assert len(numbers) == 8


@pytest.mark.parametrize(("field", "value"), [("timeout_s", 0.0), ("retries", -1)])
def test_settings_that_make_no_sense_are_refused(field, value):
    with pytest.raises(ValueError, match=field):
        Port("/dev/box", **{field: value})


def test_port_without_retries_asks_once(monkeypatch):
    line = Line([(ask(7, "STAT?"), b"")])
    monkeypatch.setattr(serial, "serial_for_url", lambda url, **_: line)
    port = Port("/dev/box", clock=StillClock(), first_seq=7, retries=0)
    port.boot = 0x9F3A
    with pytest.raises(PortTimeout):
        port.ask("STAT?")
    assert port.statistics.frames == 1


def test_hello_forgets_half_a_line(open_port):
    port = open_port((ask(8, "STAT?"), say(8, "0") + b"=9:9f3a 0 half"), greet(9))
    assert port.ask("STAT?") == "0"
    port.hello()
    assert port.statistics.retries == 0


def test_hello_of_another_thread_is_refused(open_port):
    port, raised = open_port(), []

    def greet_elsewhere():
        try:
            port.hello()
        except RuntimeError as error:
            raised.append(str(error))

    thread = threading.Thread(target=greet_elsewhere)
    thread.start()
    thread.join()
    assert ["used by two threads" in one for one in raised] == [True]


def test_reopened_port_keeps_its_address_or_takes_another(open_port):
    port = open_port(greet(8), greet(9))
    port.reopen()
    assert port.line.closed
    assert port.url == "/dev/box"
    port.reopen("/dev/other")
    assert port.url == "/dev/other"
