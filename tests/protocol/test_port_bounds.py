"""Bounds of a port: how long it waits, how much it reads, what it counts, what it may open."""

import errno
import logging
import os
import threading
import time
from types import SimpleNamespace

import pytest
import serial
from fixtures.scripted_line import HELLO, Line, StillClock, ask, greet, say

from capture.devices import port as port_module
from capture.devices import wire
from capture.devices.port import (
    MAX_NOISE_BYTES,
    READ_SLICE_S,
    SYSTEM_CLOCK,
    BadAnswer,
    BoxRebooted,
    CommandRefused,
    Hello,
    LinkLost,
    Port,
    PortBusy,
    PortTimeout,
    PortUrlError,
    WrongDevice,
)
from capture.devices.wire import Event, Request, encode

BOOT = 0x9F3A
LAST = 2**32 - 1


def event(number, name="WDOG:TRIP"):
    return encode(Event(number, BOOT, name, "300"))


def note_reads(port):
    """Return the list of sizes that the port will ask its line for."""
    sizes, read = [], port.line.read
    port.line.read = lambda size: sizes.append(size) or read(size)
    return sizes


# times and sizes ------------------------------------------------------------------------------


def test_listening_ends_after_silent_reads(open_port):
    port = open_port()
    sizes = note_reads(port)
    port.line.arrived += b"x" * 7
    port.listen(5 * READ_SLICE_S)
    assert sizes == [7, 1, 1, 1, 1, 1]
    port.listen(0.0)
    assert len(sizes) == 6


class SteppingClock(StillClock):
    """A clock that goes on by 1/8 s at each look."""

    time_s = 100.0

    def monotonic(self):
        self.time_s += 0.125
        return self.time_s


class SlowLine(Line):
    """A line on which one byte waits whenever it is asked."""

    in_waiting = 1


def test_listening_to_noise_ends_by_clock(open_port):
    port = open_port()
    port.clock = SteppingClock()
    sizes = note_reads(port)
    port.line.arrived += b"x" * 5000
    port.line.__class__ = SlowLine
    port.listen(0.5)
    assert sizes == [1, 1, 1]


class EndlessNoise(Line):
    """A line that never falls silent, and fails a port that reads for ever."""

    in_waiting, bytes_read = 1024, 0

    def read(self, size):
        self.bytes_read += size
        assert self.bytes_read <= 4 * MAX_NOISE_BYTES
        return b"x" * size


def test_attempt_reads_bounded_noise(open_port):
    port = open_port(*[(ask(8, "STAT?", retry=k > 0), b"") for k in range(3)])
    port.line.__class__ = EndlessNoise
    assert port.listen(1.0) == []
    assert port.line.bytes_read == MAX_NOISE_BYTES
    port.line.bytes_read = 0
    with pytest.raises(PortTimeout):
        port.ask("STAT?")
    assert port.line.bytes_read == 3 * MAX_NOISE_BYTES


@pytest.mark.parametrize(("timeout_s", "attempts"), [(0.01, 1), (0.3, 1), (0.5, 2), (1.0, 4)])
def test_hello_is_repeated_for_its_time(monkeypatch, timeout_s, attempts):
    line = Line([(b"\n" + encode(Request(7, 0, "SYST:HELLO?")), b"")] * attempts)
    monkeypatch.setattr(serial, "serial_for_url", lambda url, **_: line)
    port = Port("/dev/box", clock=StillClock(), first_seq=7)
    with pytest.raises(PortTimeout, match=f"after {attempts} attempts of 0.25 s; the command"):
        port.hello(timeout_s=timeout_s)
    assert not line.script
    assert (port.statistics.requests, port.statistics.frames) == (1, attempts)
    assert port.statistics.retries == attempts - 1


def test_system_clock_is_time_of_machine(monkeypatch):
    slept = []
    monkeypatch.setattr(time, "monotonic", lambda: 12.5)
    monkeypatch.setattr(time, "sleep", slept.append)
    assert SYSTEM_CLOCK.monotonic() == 12.5
    SYSTEM_CLOCK.sleep(0.5)
    assert slept == [0.5]


# requests -------------------------------------------------------------------------------------


def test_request_numbers_start_again_after_last(open_port):
    port = open_port((ask(0, "STAT?"), say(0, "a")), (ask(1, "STAT?"), say(1, "b")), first_seq=LAST)
    assert [port.ask("STAT?"), port.ask("STAT?")] == ["a", "b"]
    assert port.statistics.requests == port.statistics.frames == 3


def test_stalled_write_is_repeated_and_logged(open_port, caplog):
    stalled = serial.SerialTimeoutException("Write timeout")
    port = open_port((ask(8, "SAFE"), stalled), (ask(8, "SAFE", retry=True), say(8, "done")))
    with caplog.at_level(logging.WARNING):
        assert port.ask("SAFE") == "done"
    assert [record.getMessage() for record in caplog.records] == [
        "/dev/box: the controller does not accept bytes"
    ]
    assert (port.statistics.frames, port.statistics.retries) == (3, 1)


def test_refused_request_is_not_repeated(open_port):
    port = open_port((ask(8, "SAFE"), say(8, "Syntax", code=-102)))
    with pytest.raises(CommandRefused, match="'SAFE' was refused with -102: Syntax"):
        port.ask("SAFE")
    assert port.statistics.retries == 0


def test_lost_link_names_action_and_cause(open_port):
    port = open_port((ask(8, "SAFE"), OSError(errno.EIO, "Input/output error")))
    with pytest.raises(LinkLost, match=r"the link was lost in write .*Input/output error"):
        port.ask("SAFE")
    for call, action in ((port.hello, "flush"), (lambda: port.listen(1.0), "read")):
        with pytest.raises(LinkLost, match=f"/dev/box: cannot {action}, the port is closed"):
            call()


@pytest.mark.parametrize("call", ["ask", "hello", "listen"])
def test_only_its_thread_uses_a_port(open_port, call):
    port, raised = open_port(), []
    arguments = {"ask": ["STAT?"], "hello": [], "listen": [0.0]}[call]

    def use():
        try:
            getattr(port, call)(*arguments)
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=use)
    thread.start()
    thread.join(10.0)
    assert [type(error) for error in raised] == [RuntimeError]
    assert "/dev/box: used by two threads" in str(raised[0])


# hello ----------------------------------------------------------------------------------------


def test_hello_returns_identity(open_port):
    port = open_port(greet(8))
    assert port.hello() == Hello(1, "flash", "FL-0001", "1.0", BOOT)


@pytest.mark.parametrize(
    ("payload", "error", "text"),
    [
        ("2,flash,FL-0001,1.0", WrongDevice, "speaks protocol 2, expected 1;"),
        ("0,flash,FL-0001,1.0", WrongDevice, "speaks protocol 0, expected 1;"),
        ("v1,flash,FL-0001,1.0", BadAnswer, "'v1,flash,FL-0001,1.0', expected 'version,"),
        ("1,flash,FL-0001,1.0,a", BadAnswer, "expected 'version,kind,serial,firmware'"),
        ("1,flash,FL-0001", BadAnswer, "expected 'version,kind,serial,firmware'"),
    ],
)
def test_strange_identity_leaves_epoch_unknown(open_port, payload, error, text):
    port = open_port((greet(8)[0], say(8, payload)))
    with pytest.raises(error, match=text):
        port.hello()
    with pytest.raises(BoxRebooted, match=r"epoch of the controller is not known; call hello\(\)"):
        port.ask("STAT?")


def test_refused_hello_is_refusal(open_port):
    port = open_port((greet(8)[0], say(8, "Undefined", code=-113)))
    with pytest.raises(CommandRefused, match=r"'SYST:HELLO\?' was refused with -113"):
        port.hello()


def test_hello_forgets_lines_and_event_numbers(open_port):
    port = open_port((ask(8, "STAT?"), event(5) + say(8, "0") + event(6)), greet(9))
    port.ask("STAT?")
    port.hello()
    port.line.arrived += event(0)
    assert [one.number for one in port.listen(0.1)] == [5, 0]
    assert (port.statistics.lost_events, port.statistics.stale) == (0, 0)


# events ---------------------------------------------------------------------------------------


def test_event_numbers_count_losses_across_zero(open_port):
    port = open_port()
    port.line.arrived += b"".join(event(number) for number in (LAST - 1, 1, 1, LAST, 2))
    assert [one.number for one in port.listen(0.1)] == [LAST - 1, 1, 2]
    assert port.statistics.lost_events == 2
    assert port.statistics.stale == 2


def test_damage_reports_are_not_events(open_port):
    port = open_port(
        (ask(8, "SAFE"), event(0, "NAK")),
        (ask(8, "SAFE", retry=True), event(1, "NAK")),
        (ask(8, "SAFE", retry=True), say(8)),
    )
    port.ask("SAFE")
    port.line.arrived += event(2)
    assert [one.name for one in port.listen(0.1)] == ["WDOG:TRIP"]
    assert (port.statistics.naks, port.statistics.lost_events) == (2, 0)


def test_events_wait_during_requests(open_port):
    port = open_port((ask(8, "STAT?"), event(0) + say(7) + event(1) + say(8, "0")))
    assert port.ask("STAT?") == "0"
    assert port.statistics.stale == 1
    assert [one.number for one in port.listen(0.0)] == [0, 1]
    assert port.listen(0.0) == []


def test_latest_256_events_are_kept(open_port):
    port = open_port()
    port.line.arrived += b"".join(event(number) for number in range(300))
    assert [one.number for one in port.listen(0.1)] == list(range(44, 300))
    assert port.statistics.lost_events == 0


def test_requests_of_a_controller_are_bad_lines(open_port):
    port = open_port()
    port.line.arrived += encode(Request(8, BOOT, "SAFE")) + b"noise\n"
    assert port.listen(0.1) == []
    assert (port.statistics.bad_lines, port.statistics.stale) == (2, 0)


def test_reboot_shows_while_listening(open_port):
    port = open_port()
    port.line.arrived += encode(Event(0, 0x1111, "BOOT", ""))
    with pytest.raises(BoxRebooted, match=r"started again \(epoch 1111\).*\[SR-CAP-005\]"):
        port.listen(0.1)
    assert (port.boot, port.statistics.reboots) == (wire.UNKNOWN_BOOT, 1)


# capabilities ---------------------------------------------------------------------------------


def parts(*payloads):
    asked = (f"SYST:CAP:PART? {number}" for number in range(len(payloads)))
    return [
        (ask(8 + k, text), say(8 + k, payload))
        for k, (text, payload) in enumerate(zip(asked, payloads, strict=True))
    ]


@pytest.mark.parametrize("count", [1, 2, 3])
def test_capabilities_are_joined_from_parts(open_port, monkeypatch, count):
    monkeypatch.setattr(port_module, "MAX_CAPABILITY_PARTS", 3)
    text = wire.seal('{"leds":150,"cameras":16}')
    pieces = [text[k * len(text) // count : (k + 1) * len(text) // count] for k in range(count)]
    script = [f"{int(k == count - 1)},{piece}" for k, piece in enumerate(pieces)]
    assert open_port(*parts(*script)).capabilities() == {"leds": 150, "cameras": 16}


@pytest.mark.parametrize(
    "payloads",
    [
        *(["2,{}"], ["{}"], ["1,"], ["0,"], ["0,{", "x,}"], ["0,{", "0,"]),
        *([f"1,{wire.seal('[1]')}"], ["1,{}*0000"], ["1,{}"], [f"1,{wire.seal('{')}"]),
        ["0,a", "0,b", "0,c", "0,d"],
    ],
)
def test_capabilities_without_sense_are_refused(open_port, monkeypatch, payloads):
    monkeypatch.setattr(port_module, "MAX_CAPABILITY_PARTS", 3)
    port = open_port(*parts(*payloads))
    with pytest.raises(BadAnswer, match="expected sealed JSON in parts"):
        port.capabilities()


# opening and closing --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("url", "write_timeout_s"), [("/dev/box", 0.5), ("rfc2217://127.0.0.1:1", None)]
)
def test_line_opens_with_settings_of_port(monkeypatch, url, write_timeout_s):
    opened = []
    monkeypatch.setattr(
        serial, "serial_for_url", lambda url, **words: opened.append((url, words)) or Line([])
    )
    Port(url, timeout_s=0.5, baudrate=9600)
    Port(url)
    words = {"timeout": READ_SLICE_S, "exclusive": True}
    timeouts = [write_timeout_s, None if write_timeout_s is None else 0.25]
    assert opened == [
        (url, {"baudrate": baud, "write_timeout": timeout_s, **words})
        for baud, timeout_s in zip((9600, 115_200), timeouts, strict=True)
    ]


LOCKED = "Could not exclusively lock port"


@pytest.mark.parametrize(
    ("failure", "kind", "reason"),
    [
        (serial.SerialException(errno.EAGAIN, LOCKED), PortBusy, LOCKED),
        (serial.SerialException(errno.EBUSY, LOCKED), PortBusy, LOCKED),
        (serial.SerialException(errno.EACCES, LOCKED), PortBusy, LOCKED),
        (serial.SerialException(errno.EBUSY, "in use"), LinkLost, os.strerror(errno.EBUSY)),
        (serial.SerialException(errno.ENOENT, LOCKED), LinkLost, os.strerror(errno.ENOENT)),
        (serial.SerialException("gone away"), LinkLost, "gone away"),
        (ValueError("invalid URL"), PortUrlError, "is not a port: invalid URL"),
    ],
)
def test_failed_opening_is_named_by_cause(monkeypatch, failure, kind, reason):
    def fail(url, **_):
        raise failure

    monkeypatch.setattr(serial, "serial_for_url", fail)
    with pytest.raises(kind) as caught:
        Port("/dev/box")
    assert type(caught.value) is kind
    assert reason in str(caught.value)
    assert ("[SR-CAP-001]" in str(caught.value)) == (kind is not PortUrlError)
    assert caught.value.__cause__ is failure


def test_port_closes_with_its_context(monkeypatch):
    line = Line([])
    monkeypatch.setattr(serial, "serial_for_url", lambda url, **_: line)
    with Port("/dev/box") as port:
        assert isinstance(port, Port)
        assert not line.closed
    assert line.closed
    port.close()


@pytest.mark.parametrize("failure", [OSError("gone"), AttributeError("gone"), TypeError("gone")])
def test_failing_close_is_over(monkeypatch, failure):
    def fail():
        closed.append(failure)
        raise failure

    closed = []
    line = SimpleNamespace(close=fail)
    monkeypatch.setattr(serial, "serial_for_url", lambda url, **_: line)
    port = Port("/dev/box")
    port.close()
    port.close()
    assert len(closed) == 1


def test_damaged_reply_to_hello_is_awaited(open_port):
    """The port ignores a damaged line; its next attempt is answered."""
    lost = greet(8)[1].replace(HELLO.encode(), b"1,flush")
    port = open_port((greet(8)[0], lost), greet(8))
    assert port.hello().kind == "flash"
    assert (port.statistics.bad_lines, port.statistics.retries) == (1, 1)
