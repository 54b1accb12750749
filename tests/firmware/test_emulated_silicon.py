"""What the pins of the images do; tests/hardware runs its own tests on them."""

import contextlib
import functools

import pytest
from fixtures.compiled.pinned import pin_name
from fixtures.compiled.targets import TARGETS, start_target

from capture.devices.checkup import CheckupPort
from capture.devices.port import CommandRefused
from capture.devices.wire import Code

# pyserial leaves ports to the collector
pytestmark = [
    pytest.mark.long,
    pytest.mark.timeout(240),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]
BOARDS = [(board, box) for board, (boxes, _) in TARGETS.items() for box in boxes]
LEASE_S = 0.3
HOLD_S = 0.25
"""Time in which the head is held, s."""
CYCLES_SLACK_S = 2e-3
DARK_SLACK_S = 0.010
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
    "probe": ("shutter", ("HEAD:SITE cheek,0", "PUMP ON,5000,50", "LED 1000", "SHUT OPEN,400")),
}
"""By box, a pin that is high while there is light, and what lights it for longer than a lease."""


@pytest.fixture(params=[pair for pair in BOARDS if pair[1] in LIT], ids="-".join)
def lit(request):
    board, box = request.param
    pin, texts = LIT[box]
    target = start_target(board, box, counted=True)
    with contextlib.closing(target), CheckupPort(target.url, timeout_s=0.5) as port:
        port.hello()
        port.ask(f"SYST:WDOG {round(1e3 * LEASE_S)}")
        port.ask("SYST:ARM")
        for text in texts:
            port.ask(text)
            if text.startswith("PUMP"):
                port.listen(HOLD_S)
        target.wait_for(lambda: rises(target, pin_name(board, pin)))
        yield target, port, pin_name(board, pin)


def test_killed_host_leaves_darkness_within_lease(lit):
    target, port, light = lit
    lit_s = rises(target, light)[-1].t_s
    port.close()  # the host dies here
    target.wait_for(lambda: [e for e in target.of_pin(light, 0.0) if e.t_s > lit_s])
    dark_s = next(e.t_s for e in target.of_pin(light, 0.0) if e.t_s > lit_s)
    # the lease counts from the command, which the light follows
    slack_s = BUSY_SLACK_S if target.board.startswith("posix") else DARK_SLACK_S
    assert dark_s - lit_s < LEASE_S + slack_s


def test_dome_steps_release_cameras_once_a_row():
    target = start_target("mps2-an500", "dome")
    with contextlib.closing(target), CheckupPort(target.url, timeout_s=0.5) as port:
        port.hello()
        rows = 12
        port.ask("SAFE:EYES CLOSED")
        port.ask("SEQ:DEF 0," + ";".join(f"{led}:1000:40000:7" for led in range(rows)))
        port.ask("SYST:ARM")
        port.ask(f"SEQ:ARM {rows}")
        port.ask("TRIG t1")
        port.listen(0.04 * rows + 0.2)
        assert port.ask("SEQ:POS?") == f"DONE,{rows - 1},{rows},t1"
        cameras = target.of_pin("camera")
        assert len(cameras) == rows
        for led in range(rows):
            on, off = target.of_pin(f"led{led}", 1.0), target.of_pin(f"led{led}", 0.0)
            assert (len(on), len(off)) == (1, 1)
            assert 0.035 < off[0].t_s - on[0].t_s < 0.04 + BUSY_SLACK_S
