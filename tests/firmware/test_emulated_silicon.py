"""Light, cameras and the stop at the pins of the images; tests/hardware runs on them, too."""

import contextlib
import functools
import itertools

import pytest
from fixtures.compiled.pinned import pin_name
from fixtures.compiled.targets import TARGETS, start_target

from capture.devices import wire
from capture.devices.checkup import CheckupPort
from capture.devices.port import CommandRefused
from capture.devices.wire import Code

# pyserial leaves ports to the collector
pytestmark = [
    pytest.mark.long,
    pytest.mark.timeout(240),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]
BOARDS = [
    (board, box) for board, (boxes, _) in TARGETS.items() for box in boxes if board != "posix-tcp"
]
LEASE_S = 0.3
LIT_S = 0.4
"""Least time for which `LIT` lights, s."""
HOLD_S = 0.25
"""Time in which the head is held, s."""
HOLD_PARTS = 5
CYCLES_SLACK_S = 2e-3
DARK_SLACK_S = 0.010
JUDGED_ROWS = 480
BUSY_SLACK_S = 0.1


@pytest.fixture(params=["posix", "mega2560", "mps2-an385"])
def flash(request):
    target = start_target(request.param, "flash", counted=True)
    with contextlib.closing(target), CheckupPort(target.url, timeout_s=0.5) as port:
        port.hello()
        yield target, port, functools.partial(pin_name, request.param)


def rises(target, pin):
    return [edge for edge in target.of_pin(pin) if edge.value > 0.0]


def test_each_shot_is_one_camera_edge_and_pop(flash):
    target, port, pin = flash
    port.ask("FLAS:POW 0.01")
    port.ask("FLAS:SYNC 20000")
    for shot in range(4):
        port.ask("SYST:ARM")
        port.ask(f"FLAS:FIRE shot.{shot}")
        port.listen(0.05)
    port.ask("SAFE")
    with pytest.raises(CommandRefused) as caught:
        port.ask("FLAS:FIRE unarmed")
    assert caught.value.code == Code.NOT_ARMED
    target.wait_for(lambda: len(rises(target, pin("pop"))) >= 4)
    cameras, pops = rises(target, pin("camera")), rises(target, pin("pop"))
    assert (len(cameras), len(pops)) == (4, 4)
    delays_s = [b.t_s - a.t_s for a, b in zip(cameras, pops, strict=True)]
    # simavr and QEMU count cycles; a process has the time that this machine gives it
    late_s = BUSY_SLACK_S if target.board == "posix" else CYCLES_SLACK_S
    assert all(0.02 - 1e-4 <= delay_s <= 0.02 + late_s for delay_s in delays_s)


LIT = {
    "flash": ("led0", ("FLAS:LAMP ON,500",)),
    "dome": ("led3", ("SAFE:EYES CLOSED", "LED:ON 3,500,400")),
    "gradient_sphere": ("led3", ("SAFE:EYES CLOSED", "PATT FULL,500,100")),
    "scanner": ("led0", ("SAFE:EYES CLOSED", "TRIG k1,500")),
    "probe": ("shutter", ("HEAD:SITE cheek,0", "PUMP ON,5000,50", "LED 1000", "SHUT OPEN,400")),
}
"""By box, a pin that is high while there is light, and what lights it for longer than a lease."""


@pytest.fixture(params=[pair for pair in BOARDS if pair[1] in LIT], ids="-".join)
def dark(request):
    """A target, its port, the pin of its light, and a function that lights it."""
    board, box = request.param
    pin, texts = LIT[box]
    target = start_target(board, box, counted=True)
    with contextlib.ExitStack() as parts:
        parts.enter_context(contextlib.closing(target))
        with CheckupPort(target.url, timeout_s=0.5) as port:
            port.hello()  # at the start, a request may be lost
        # a repeated request would renew the lease
        port = parts.enter_context(CheckupPort(target.url, timeout_s=5.0))
        port.hello()

        def light():
            port.ask("SYST:ARM")
            for text in texts:
                port.ask(text)
                if text.startswith("PUMP"):
                    for _ in range(HOLD_PARTS):  # each question renews the lease
                        port.listen(HOLD_S / HOLD_PARTS)
                        port.ask("STAT?")
            target.wait_for(lambda: rises(target, pin_name(board, pin)))

        yield target, port, pin_name(board, pin), light


def test_killed_host_leaves_darkness_within_lease(dark):
    target, port, pin, light = dark
    port.ask(f"SYST:WDOG {round(1e3 * LEASE_S)}")
    light()
    lit_s = rises(target, pin)[-1].t_s
    port.close()  # the host dies here
    target.wait_for(lambda: [e for e in target.of_pin(pin, 0.0) if e.t_s > lit_s])
    dark_s = next(e.t_s for e in target.of_pin(pin, 0.0) if e.t_s > lit_s)
    # the lease counts from the command, which the light follows
    slack_s = BUSY_SLACK_S if target.board == "posix" else DARK_SLACK_S
    # an answer that waits renews the lease when it is given
    answered_s = {"scanner": 0.02}.get(target.box, 0.0)
    assert LEASE_S - slack_s < dark_s - lit_s < answered_s + LEASE_S + slack_s


def test_stop_puts_light_out_for_good(dark):
    target, port, pin, light = dark
    port.ask("SYST:WDOG 5000")
    light()
    target.command("S")
    target.wait_for(lambda: target.of_pin(pin)[-1].value == 0.0)
    assert int(port.ask("STAT?")) & 256
    with pytest.raises(CommandRefused) as caught:
        port.ask(LIT[target.box][1][-1])
    assert caught.value.code in (Code.INTERLOCK, Code.IGNORED)  # the probe's head is not placed
    target.command("s")
    port.listen(0.1)
    assert not int(port.ask("STAT?")) & 256 + 64
    assert target.of_pin(pin)[-1].value == 0.0
    assert max(lit_spans_s(target, pin)) < LIT_S - DARK_SLACK_S


def test_dome_steps_release_cameras_once_a_row():
    target = start_target("mps2-an500", "dome", counted=True)
    with contextlib.closing(target), CheckupPort(target.url, timeout_s=0.5) as port:
        port.hello()
        rows = 12
        port.ask("SAFE:EYES CLOSED")
        port.ask("SEQ:DEF 0," + ";".join(f"{led}:1000:40000:7" for led in range(rows)))
        port.ask("SYST:ARM")
        port.ask(f"SEQ:ARM {rows}")
        port.ask("TRIG t1")
        target.wait_for(lambda: target.of_pin(f"led{rows - 1}", 0.0))
        assert port.ask("SEQ:POS?") == f"DONE,{rows - 1},{rows},t1"
        cameras = target.of_pin("camera")
        assert len(cameras) == rows
        for led in range(rows):
            on, off = target.of_pin(f"led{led}", 1.0), target.of_pin(f"led{led}", 0.0)
            assert (len(on), len(off)) == (1, 1)
            assert 0.035 < off[0].t_s - on[0].t_s < 0.04 + DARK_SLACK_S


def lit_spans_s(target, pin):
    """Return how long each light of a pin lasted."""
    edges = target.of_pin(pin)
    return [b.t_s - a.t_s for a, b in itertools.pairwise(edges) if a.value > 0.0 and b.value == 0.0]


@pytest.fixture
def mega_flash():
    target = start_target("mega2560", "flash")
    with contextlib.closing(target), CheckupPort(target.url, timeout_s=0.5) as port:
        port.hello()
        yield target, port


def test_lamp_ends_in_time_beneath_long_answers(mega_flash):
    target, port = mega_flash
    port.ask("SYST:ARM")
    port.ask("FLAS:LAMP ON,200")
    asked = b"".join(wire.encode(port.make_request("SYST:CAP?")) for _ in range(9))
    port.exchange_raw(asked, 0.5)
    target.wait_for(lambda: lit_spans_s(target, "A3"))
    assert lit_spans_s(target, "A3") == [pytest.approx(0.2, abs=DARK_SLACK_S)]


def test_stop_frees_skin_each_time_it_opens():
    target = start_target("mega2560", "caliper")
    with contextlib.closing(target), CheckupPort(target.url, timeout_s=0.5) as port:
        port.hello()
        port.ask("SYST:WDOG 5000")
        port.ask("SYST:ARM")
        port.ask("CAL:FORC:LIM 2")
        port.ask("CAL:HOME")
        port.listen(2.0)
        for _ in range(2):
            port.ask("CAL:ATT")
            target.command("S")
            target.wait_for(lambda: target.of_pin("A7")[-1].value == 0.0)
            target.command("s")
            port.listen(0.05)
            assert port.ask("CAL:ATT?") == "0"


@pytest.fixture
def judged():
    """A dome with a long table, armed, and the frames of a burst that asks for its judgment."""
    target = start_target("mps2-an500", "dome", counted=True)
    with contextlib.closing(target), CheckupPort(target.url, timeout_s=2.0) as port:
        port.hello()
        port.ask("SAFE:EYES CLOSED")
        for first in range(0, JUDGED_ROWS, 40):
            rows = ";".join(f"{led % 150}:200:83333:1" for led in range(first, first + 40))
            port.ask(f"SEQ:DEF {first},{rows}")
        port.ask("SYST:WDOG 5000")
        port.ask("SYST:ARM")
        port.ask("LED:ON 149,100,200")

        def ask_at_once(*texts):
            """Send `SEQ:ARM` and texts in one burst; return the answers by text, in order."""
            texts = (f"SEQ:ARM {JUDGED_ROWS}", *texts)
            requests = [port.make_request(text) for text in texts]
            asked = {request.seq: request.text for request in requests}
            frames = [wire.encode(request) for request in requests]
            lines = port.exchange_raw(b"".join([*frames, frames[0]]), 1.0)
            while len(lines) < len(texts):
                lines += port.exchange_raw(b"", 10.0)
            replies = [wire.decode(line) for line in lines]
            return {asked[reply.seq]: reply for reply in replies if isinstance(reply, wire.Reply)}

        yield target, port, ask_at_once


def test_long_judgment_is_answered_last_and_once(judged):
    target, port, ask_at_once = judged
    began, refused, late = (*(answers := ask_at_once("SYST:PING?", "SEQ:CLE")).values(),)
    assert list(answers) == ["SYST:PING?", "SEQ:CLE", f"SEQ:ARM {JUDGED_ROWS}"]
    assert (refused.code, late.code) == (Code.IGNORED, Code.OK)
    judged_s = (int(port.ask("SYST:PING?")) - int(began.payload)) / 1e6
    stale = port.statistics.stale
    port.listen(0.1)
    assert port.statistics.stale == stale  # the retry is not answered again
    assert int(port.ask("STAT?")) & 32
    target.wait_for(lambda: lit_spans_s(target, "led149"))
    assert lit_spans_s(target, "led149")[0] <= 0.1 + DARK_SLACK_S  # SEQ:ARM puts the light out
    assert judged_s > 0.2  # without care the LED would have been lit for this long


@pytest.mark.parametrize(("text", "cleared"), [("SAFE", 32 + 1), ("SAFE:EYES OPEN", 32)])
def test_dark_ends_a_long_judgment(judged, text, cleared):
    _, port, ask_at_once = judged
    done, late = ask_at_once(text).values()
    assert (done.code, late.code) == (Code.OK, Code.HARDWARE)
    assert not int(port.ask("STAT?")) & cleared
