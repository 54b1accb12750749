"""Everything that can go wrong on the line or in the box, and what is promised then."""

import itertools
import time

import pytest

from capture.devices.flash import FlashBox
from capture.devices.port import LinkLost, Port, PortTimeout, WrongDevice
from capture.rig import load_rig
from rigsim.boxes.faults import FAULT_CATALOG, Faults
from rigsim.world import World
from rigsim.world.serve import serve_world

RIG = load_rig("flash").resized(16)
NAMES = (f"faults-{number}" for number in itertools.count())

# number in the catalogue, faults, error that must be seen at least once (None: none may be)
ON_THE_LINE = [
    (1, {"drop": 0.003}, None),
    (2, {"flip": 0.003}, None),
    (3, {"glue": 0.1, "cut": 0.1}, None),
    (4, {"late": 0.2}, None),
    (5, {"lose_answer": 0.3}, None),
    (6, {"duplicate": 0.5}, None),
    (7, {"babble": 0.5}, None),
    (8, {"reset_on_open": True}, None),
    (9, {"reset_after": 3.0}, "BoxRebooted"),
    (9, {"brownout": 0.02, "boot_s": 0.3}, "BoxRebooted"),
    (10, {"unplug_after": 2.0, "replug_after": 0.5}, "LinkLost"),
    (12, {"stall_after": 2.0, "stall_s": 1.0}, None),
    (12, {"stall_after": 2.0, "stall_s": 4.0}, "PortTimeout"),
    (16, {"misfire": 0.3}, "HARDWARE"),
    (16, {"slow_charge": 30.0}, None),
]


@pytest.fixture
def world():
    made = []

    def world(seed=0, **faults):
        made.append(World(RIG, seed=seed, faults=Faults(**faults)))
        return made[-1], f"sim://flash?world={made[-1].register(next(NAMES))}"

    yield world
    for one in made:
        one.unregister()


@pytest.mark.long
@pytest.mark.parametrize(("number", "faults", "error"), ON_THE_LINE)
def test_nothing_is_done_twice_or_wrongly_acknowledged(world, ledger, number, faults, error):
    simulated, url = world(seed=number, **faults)
    host = ledger(simulated, url)
    host.open(retries=12)
    for _ in range(40):
        host.pop()
    host.check()
    seen = set(host.errors) - {"WATCHDOG_TRIPPED", "NOT_ARMED"}
    assert seen == (set() if error is None else {error})
    assert len(host.acknowledged) >= 20
    assert not simulated.box("flash").device.lit


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # pyserial leaves sockets to the collector
@pytest.mark.parametrize("transport", ["pty", "tcp"])
@pytest.mark.parametrize(
    ("faults", "error"),
    [
        ({"drop": 0.002, "flip": 0.002, "glue": 0.02}, None),
        ({"lose_answer": 0.2, "duplicate": 0.2, "babble": 0.2}, None),
        ({"brownout": 0.03, "boot_s": 0.1}, "BoxRebooted"),
    ],
)
def test_fault_rules_hold_in_real_time_real_lines(ledger, transport, faults, error):
    world = World(RIG, seed=2, clock="real", faults=Faults(baud=0.0, **faults))
    with serve_world(RIG, world=world, pty=transport == "pty") as served:
        host = ledger(world, served.addresses["flash"])
        host.open(retries=20, timeout_s=0.03)
        for _ in range(8):
            host.pop()
        host.check()
        assert (set(host.errors) - {"WATCHDOG_TRIPPED", "NOT_ARMED"}) <= {error}
        assert len(host.acknowledged) >= 3
        host.box.port.close()


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("transport", ["pty", "tcp"])
def test_pulled_cable_is_lost_link_on_real_lines(transport):
    faults = Faults(baud=0.0, unplug_after=0.3)
    world = World(RIG, clock="real", faults=faults)
    with serve_world(RIG, world=world, pty=transport == "pty") as served:
        port = Port(served.addresses["flash"], timeout_s=0.1)
        box = FlashBox(port)
        with pytest.raises(LinkLost):
            box.port.listen(10.0)
        with pytest.raises(LinkLost):
            port.reopen()


def test_stalled_controller_fills_line_and_times_out(world):
    _, url = world(stall_after=0.5, stall_s=60.0)
    box = FlashBox(Port(url, retries=20))
    box.port.listen(1.0)
    with pytest.raises(PortTimeout):
        box.ping()
    box.port.close()


@pytest.mark.parametrize(
    ("faults", "match"),
    [({"serial": "FL-0666"}, "got the flash controller FL-0666"), ({"protocol": 2}, "protocol 2")],
)
def test_wrong_controller_or_firmware_is_refused_before_sending(world, faults, match):
    simulated, url = world(**faults)
    with pytest.raises(WrongDevice, match=match):
        FlashBox(Port(url), serial="FL-0001")
    assert not simulated.link("flash").attached


def test_reconnected_controller_is_found_under_new_name(world):
    simulated, url = world(unplug_after=1.0, replug_after=2.0)
    box = FlashBox(Port(url))
    box.port.listen(0.5)
    with pytest.raises(LinkLost):
        box.port.listen(1.0)
    with pytest.raises(LinkLost):
        box.port.reopen()
    simulated.clock.sleep(2.0)
    simulated.unregister()
    other = simulated.register(next(NAMES))
    assert box.port.reopen(f"sim://flash?world={other}").serial == "FL-0001"
    box.close()


def test_flash_and_camera_faults_each_have_a_switch():
    assert [kind.number for kind in FAULT_CATALOG] == list(range(1, 21))
    fields = {"latency", "baud", *(name for kind in FAULT_CATALOG for name in kind.switches)}
    assert fields | {"interlock"} == set(Faults.__dataclass_fields__)
    tried = {number for number, _, _ in ON_THE_LINE}
    # 11, 13, 14, 15 and 17 to 20 have tests of their own
    assert tried == set(range(1, 21)) - {11, 13, 14, 15, 17, 18, 19, 20}


@pytest.mark.parametrize(
    "switches",
    [
        {"drop": "2"},
        {"late_s": "-1"},
        {"baud": "inf"},
        {"heat": "1"},
        {"slow_charge": "0"},
        {"drift_ppm": "1e9"},
        {"reset_on_open": "yes"},
        {"drop": "x"},
        {"flp": "0.1"},
    ],
)
def test_a_switch_that_makes_no_sense_is_named(switches):
    with pytest.raises(ValueError, match=next(iter(switches))):
        Faults.from_text(switches)


def noisy_run(ledger, world, url, requests):
    """Set, read back, pop; return the host after `requests` requests."""
    host = ledger(world, url)
    box = host.open(retries=12, first_seq=1)
    port, unit = box.port, world.box("flash").device
    step = 0
    while port.statistics.requests < requests:
        step += 1
        angle_deg = float(step % 181)
        box.set_analyzer(angle_deg)
        assert unit.angle_deg == angle_deg
        assert box.analyzer_deg() == angle_deg
        box.ping()
        if step % 10 == 0:
            host.pop()
    host.check()
    assert not host.errors
    return host


def test_a_noisy_line_does_nothing_wrong(world, ledger):
    simulated, url = world(seed=11, drop=0.001, flip=0.001)
    host = noisy_run(ledger, simulated, url, requests=3000)
    statistics = host.box.port.statistics
    print(f"retries per 1000 frames: {1000 * statistics.retries / statistics.frames:.1f}")
    # about 60 bytes a round trip: 1 - 0.998**60 = 11 % need a retry
    assert 0.05 < statistics.retries / statistics.requests < 0.25
    assert host.acknowledged


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
def test_a_noisy_line_does_nothing_wrong_for_long(world, ledger, seed):
    simulated, url = world(seed=seed, drop=0.001, flip=0.001, duplicate=0.01, late=0.005)
    noisy_run(ledger, simulated, url, requests=10_000)


def test_same_seed_gives_same_bytes_at_same_times(world, ledger):
    def transcript(seed):
        simulated, url = world(seed=seed, drop=0.001, flip=0.001, late=0.01, duplicate=0.01)
        noisy_run(ledger, simulated, url, requests=400)
        return simulated.transcript_sha256

    assert transcript(1) == transcript(1)
    assert transcript(1) != transcript(2)


@pytest.fixture
def refused_sleep(monkeypatch):
    """Make each sleep in real time an error, however busy the machine is."""

    def refuse(seconds):
        raise AssertionError(f"sleeps {seconds} s in real time")

    monkeypatch.setattr(time, "sleep", refuse)


@pytest.mark.usefixtures("refused_sleep")
def test_virtual_time_passes_without_sleep(world, ledger):
    simulated, url = world()
    host = ledger(simulated, url)
    host.open()
    started = time.process_time()  # of a world that reads a real clock until it is late enough
    for _ in range(60):
        host.pop()
    # 60 pops at 20 a minute last over two minutes
    assert simulated.now > 110.0
    assert simulated.now > 10.0 * (time.process_time() - started)


@pytest.mark.usefixtures("refused_sleep")
def test_sleep_in_real_time_would_be_found(ledger):
    simulated = World(RIG, clock="real")
    host = ledger(simulated, f"sim://flash?world={simulated.register(next(NAMES))}")
    try:
        with pytest.raises(AssertionError, match="in real time"):
            host.open()
    finally:
        simulated.unregister()
