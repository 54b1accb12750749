"""Commands that controllers share, by a port that answers from a list: texts, units and errors."""

import logging
import math
from collections import deque
from types import SimpleNamespace

import pytest

from capture.devices import wire
from capture.devices.box import Box, BoxStatus, format_decimal, parse_whole_number
from capture.devices.led_box import EyeSafetyBox, LedBox, LedStatus
from capture.devices.port import BadAnswer, Hello, LinkLost, PortTimeout, WrongDevice


class ListedPort:
    """A port that expects texts and returns a payload for each, or raises an error."""

    url, boot = "/dev/box", 0x9F3A

    def __init__(self, *script, kind="plain"):
        self.script, self.kind = deque(script), kind
        self.waits, self.closed = [], 0
        self.statistics = SimpleNamespace(lost_events=3)

    def hello(self):
        return Hello(1, self.kind, "PL-0001", "1.0", self.boot)

    def capabilities(self):
        return {"leds": 4}

    def ask(self, text):
        expected, payload = self.script.popleft()
        assert text == expected
        if isinstance(payload, BaseException):
            raise payload
        return payload

    def listen(self, seconds):
        self.waits.append(seconds)
        return []

    def close(self):
        self.closed += 1


class PlainBox(Box):
    kind = "plain"


class PlainLedBox(LedBox):
    kind = "plain"


@pytest.fixture
def make_box():
    ports = []

    def make_box(*script, driver=PlainBox):
        ports.append(ListedPort(*script))
        return driver(ports[-1])

    yield make_box
    for port in ports:
        assert not port.script, "the exchange was not finished"


# identity -------------------------------------------------------------------------------------


def test_driver_has_identity_and_limits_of_hello(make_box):
    box = make_box(("*IDN?", "MAKER,PLAIN,PL-0001,1.0"))
    assert box.identity == box.port.hello()
    assert (box.limits, box.identify()) == ({"leds": 4}, "MAKER,PLAIN,PL-0001,1.0")
    assert PlainBox(ListedPort(), serial="PL-0001").hello(serial="PL-0001") == box.identity


@pytest.mark.parametrize(
    ("kind", "serial", "text"),
    [
        ("dome", "", "got a 'dome' controller with serial PL-0001, expected a 'plain' controller"),
        ("plain", "PL-0002", "got the plain controller PL-0001, expected PL-0002; exchange"),
    ],
)
def test_other_device_is_refused_and_closed(kind, serial, text):
    port = ListedPort(kind=kind)
    with pytest.raises(WrongDevice, match=text):
        PlainBox(port, serial=serial)
    assert port.closed == 1


@pytest.mark.parametrize(
    ("status", "place", "name"),
    [
        *((BoxStatus, 0, "armed"), (BoxStatus, 1, "tripped"), (BoxStatus, 2, "errors_waiting")),
        *((BoxStatus, 6, "lit"), (BoxStatus, 8, "stopped")),
        *((LedStatus, 4, "running"), (LedStatus, 9, "eyes_safe")),
    ],
)
def test_each_bit_of_status_has_its_name(status, place, name):
    assert getattr(status(1 << place), name) is True
    assert getattr(status(0xFFFF ^ (1 << place)), name) is False


# commands -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "arguments", "text"),
    [
        *(("arm", [], "SYST:ARM"), ("dark", [], "SAFE"), ("reset", [], "*RST")),
        *(("clear_errors", [], "*CLS"), ("set_lease", [0.75], "SYST:WDOG 750")),
        ("set_lease", [0.3006], "SYST:WDOG 301"),
    ],
)
def test_command_is_sent_in_its_unit(make_box, method, arguments, text):
    assert getattr(make_box((text, "")), method)(*arguments) is None


@pytest.mark.parametrize(
    ("method", "text", "payload", "value"),
    [
        *(("is_armed", "SYST:ARM?", "0", False), ("is_armed", "SYST:ARM?", "1", True)),
        *(("lease_s", "SYST:WDOG?", "750", 0.75), ("ping", "SYST:PING?", "1500000", 1.5)),
    ],
)
def test_answer_is_returned_in_its_unit(make_box, method, text, payload, value):
    found = getattr(make_box((text, payload)), method)()
    assert (found, type(found)) == (value, type(value))


@pytest.mark.parametrize(
    ("method", "text", "payload", "expected"),
    [
        ("is_armed", "SYST:ARM?", "2", "0 or 1"),
        ("lease_s", "SYST:WDOG?", "long", "a number"),
        ("ping", "SYST:PING?", "nan", "a finite number"),
        ("errors", "SYST:ERR?", "-102", 'code,"text"'),
        ("errors", "SYST:ERR?", '1.5,"x"', 'code,"text"'),
        ("errors", "SYST:ERR?", '--1,"x"', 'code,"text"'),
    ],
)
def test_strange_answer_names_query_and_expectation(make_box, method, text, payload, expected):
    with pytest.raises(BadAnswer) as caught:
        getattr(make_box((text, payload)), method)()
    assert str(caught.value) == (
        f"/dev/box: {text!r} was answered with {payload!r}, expected {expected}"
    )


def test_errors_are_read_up_to_zero(make_box):
    answers = ['-222,"Out of range"', '104,"Light dose"', '0,"No error"']
    box = make_box(*(("SYST:ERR?", one) for one in answers))
    assert box.errors() == [(-222, "Out of range"), (104, "Light dose")]


def test_endless_errors_are_read_64_times(make_box):
    box = make_box(*[("SYST:ERR?", '-222,"Out of range"')] * 64)
    assert box.errors() == [(-222, "Out of range")] * 64


# closing --------------------------------------------------------------------------------------


def test_context_ends_dark_and_closed(make_box):
    box = make_box(("SAFE", ""))
    with box as same:
        assert same is box
    assert box.port.closed == 1


def test_unknown_epoch_is_closed_without_request(make_box):
    """After a reboot the controller is dark, and a request would be refused."""
    box = make_box()
    box.port.boot = wire.UNKNOWN_BOOT
    box.close()
    assert box.port.closed == 1


def test_close_of_lost_controller_is_logged(make_box, caplog):
    box = make_box(("SAFE", LinkLost("/dev/box: the link was lost")))
    with caplog.at_level(logging.WARNING):
        box.close()
    assert box.port.closed == 1
    assert [record.getMessage() for record in caplog.records] == [
        "/dev/box: the link was lost; the lease of the controller switches its light off"
    ]


def test_interrupted_close_still_closes_port(make_box):
    box = make_box(("SAFE", KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        box.close()
    assert box.port.closed == 1


# answers and waits ----------------------------------------------------------------------------


def test_value_or_none_is_read(make_box):
    box = make_box(("X?", "NONE"), ("X?", "7"), ("X? 3", "many"))
    assert box._read_or_none("X?", int, "n or NONE") is None
    assert box._read_or_none("X?", int, "n or NONE") == 7
    with pytest.raises(BadAnswer, match=r"'X\?' was answered with 'many', expected n or NONE"):
        box._read_or_none("X? 3", int, "n or NONE", shown="X?")


def test_count_has_digits_alone(make_box):
    box = make_box(("X? 1", "12"), ("X? 1", "-1"))
    assert box._count("X? 1", "digits", shown="X?") == 12
    with pytest.raises(BadAnswer, match=r"'X\?' was answered with '-1', expected digits"):
        box._count("X? 1", "digits", shown="X?")
    for text in ("", " 1", "1.0", "+1", "x"):
        with pytest.raises(ValueError):
            parse_whole_number(text)
    assert parse_whole_number("007") == 7


def test_time_of_token_is_in_seconds(make_box):
    texts = ["GO a"] * 4
    box = make_box(*zip(texts, ["a,1500000", "b,1500000", "a,x", "a"], strict=True))
    assert box._token_time("GO", "a") == 1.5
    for shown in ("", "", "HALT"):
        expected = f"'{shown or 'GO'}' was answered with .*, expected token,us"
        with pytest.raises(BadAnswer, match=expected):
            box._token_time("GO", "a", shown=shown)


@pytest.mark.parametrize(("moves", "waits"), [(0, 0), (1, 1), (2, 2), (3, 3)])
def test_movement_is_awaited_in_polls(make_box, moves, waits):
    """A timeout of three polls: after the third, one more look."""
    box = make_box(*[("*OPC?", "0")] * moves, ("*OPC?", "1"))
    box._wait_settled(0.75, 0.25, box.port.listen, "it still moves")
    assert box.port.waits == [0.25] * waits


def test_endless_movement_ends_with_timeout(make_box):
    box = make_box(*[("*OPC?", "0")] * 4)
    with pytest.raises(PortTimeout, match="/dev/box: it still moves"):
        box._wait_settled(0.75, 0.25, box.port.listen, "it still moves")
    assert box.port.waits == [0.25] * 3


@pytest.mark.parametrize(
    ("seconds", "waits"),
    [(0.0, []), (-1.0, []), (0.125, [0.125]), (0.25, [0.25]), (0.625, [0.25, 0.25, 0.125])],
)
def test_lease_is_renewed_after_each_wait(make_box, seconds, waits):
    box = make_box(*[("SYST:PING?", "1")] * len(waits))
    box._keep_lease(seconds, 0.25)
    assert box.port.waits == waits


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        *((0.0, 3, "0"), (-0.0004, 3, "0"), (-0.0006, 3, "-0.001"), (100.0, 3, "100")),
        *((1.25, 1, "1.2"), (0.1, 9, "0.1"), (100.0, 0, "100"), (0.2, 0, "0"), (-7.5, 2, "-7.5")),
    ],
)
def test_number_has_digits_that_it_needs(value, digits, text):
    assert format_decimal("x", value, digits) == text


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_unfinite_number_is_not_formatted(value):
    with pytest.raises(ValueError, match=f"angle_deg: got {value}, expected a finite number"):
        format_decimal("angle_deg", value, 3)


# tables of LEDs -------------------------------------------------------------------------------


@pytest.mark.parametrize("eyes", ["open", "closed", "shielded"])
def test_state_of_eyes_is_sent_and_read(make_box, eyes):
    class EyesAlone(EyeSafetyBox):
        kind = "plain"

    script = (f"SAFE:EYES {eyes.upper()}", ""), ("SAFE:EYES?", eyes.upper()), ("SAFE:EYES?", "SHUT")
    box = make_box(*script, driver=EyesAlone)
    box.set_eyes(eyes)
    assert box.eyes() == eyes
    with pytest.raises(BadAnswer, match="'shut', expected OPEN, CLOSED or SHIELDED"):
        box.eyes()


@pytest.mark.parametrize(
    ("sizes", "lines"),
    [
        ((100, 99), [(0, 2)]),
        ((100, 100), [(0, 1), (1, 2)]),
        ((100, 99, 1), [(0, 2), (2, 3)]),
        ((250, 250), [(0, 1), (1, 2)]),
        ((3, 250, 3), [(0, 1), (1, 2), (2, 3)]),
        ((), []),
    ],
)
def test_table_is_sent_in_short_lines(make_box, sizes, lines):
    texts = [chr(ord("a") + number) * size for number, size in enumerate(sizes)]
    seal = f"{len(texts)},{wire.crc16(chr(10).join(texts).encode()):04X}"
    script = [("SEQ:CLE", "")]
    script += [(f"SEQ:DEF {first},{';'.join(texts[first:end])}", "") for first, end in lines]
    make_box(*script, ("SEQ:CRC?", seal), driver=PlainLedBox)._send_table("SEQ", texts, joint=";")
    wrong = make_box(*script, ("SEQ:CRC?", "9,0000"), driver=PlainLedBox)
    with pytest.raises(BadAnswer, match=f"'9,0000', expected {seal}, the table that was sent"):
        wrong._send_table("SEQ", texts, joint=";")


def test_sequence_is_armed_run_and_read(make_box):
    box = make_box(
        *(("SEQ:ARM 8", "1.5,0.2,0.3,0.4,0.5"), ("TRIG run", "run,1500000")),
        *(("SEQ:POS?", "RUN,3,8,run"), ("SEQ:POS?", "IDLE,-1,0,-")),
        *(("SEQ:STEP? 3", "2500000"), ("SEQ:STEP? 4", "NONE"), ("LED:FAIL?", "1A")),
        driver=PlainLedBox,
    )
    load = box._arm_table(8)
    assert (load.flashes_per_s, load.flicker_rms) == (1.5, 0.2)
    assert (load.duty, load.heat, load.dose_ws) == (0.3, 0.4, 0.5)
    assert box.trigger("run") == 1.5
    running, idle = box.position(), box.position()
    assert (running.state, running.row, running.rows, running.token) == ("RUN", 3, 8, "run")
    assert (idle.state, idle.row, idle.rows, idle.token) == ("IDLE", -1, 0, "")
    assert (box.step_time(3), box.step_time(4)) == (2.5, None)
    box.failed_leds.add(0)
    assert box.find_failed_leds() == {0}  # an older controller is not asked
    box._limits = {**box.limits, "protocol_minor": 3}
    assert box.find_failed_leds() == {1, 3, 4}
    assert box.failed_leds == {0, 1, 3, 4}


def test_releases_are_heard_while_lease_is_renewed(make_box, monkeypatch):
    """An event releases a row if its row and time are digits."""
    payloads = ["0,1500000", "12,2000000", "x,5", "3,y", "4", "-1,7"]
    heard = [[wire.Event(n, 1, "SEQ:STEP", one) for n, one in enumerate(payloads)]]
    heard += [[], [wire.Event(9, 1, "SEQ:STOP", "5,6"), wire.Event(10, 1, "SEQ:STEP", "13,1")]]
    box = make_box(*[("SYST:PING?", "1")] * 3, driver=PlainLedBox)
    waits = []
    monkeypatch.setattr(box.port, "listen", lambda span_s: waits.append(span_s) or heard.pop(0))
    assert box.listen(0.25) == {0: 1.5, 12: 2.0, 13: 1e-6}
    assert waits == pytest.approx([0.1, 0.1, 0.05])
    assert box.listen(0.0) == {}


@pytest.mark.parametrize(
    ("call", "text", "payload", "expected"),
    [
        (lambda box: box._arm_table(8), "SEQ:ARM 8", "1,2,3,4", "flashes,rms,duty,heat,Ws"),
        (lambda box: box.position(), "SEQ:POS?", "RUN,3,8", "state,row,rows,token"),
        (lambda box: box.step_time(3), "SEQ:STEP? 3", "-1", "us or NONE"),
        (lambda box: box.cameras(), "CAM:MASK?", "G", "hexadecimal digits"),
    ],
)
def test_strange_table_answer_names_expectation(make_box, call, text, payload, expected):
    box = make_box((text, payload), driver=PlainLedBox)
    query = text.partition(" ")[0]
    with pytest.raises(BadAnswer) as caught:
        call(box)
    assert str(caught.value) == (
        f"/dev/box: {query!r} was answered with {payload!r}, expected {expected}"
    )


def test_cameras_are_masked_in_hexadecimal_digits(make_box):
    script = ("CAM:MASK 1F", ""), ("CAM:MASK?", "1F"), ("CAM:TRIG a", "a,2000000")
    box = make_box(*script, driver=PlainLedBox)
    box.set_cameras(31)
    assert (box.cameras(), box.trigger_cameras("a")) == (31, 2.0)
