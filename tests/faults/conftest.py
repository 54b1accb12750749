"""A ledger of pops: what the host believes against what the flash box did; hosts to be struck."""

import itertools
import os
import subprocess
import sys
from collections import Counter
from contextlib import ExitStack

import pytest
from fixtures.compiled.sides import choose_side, leave_real_lines_to_one_side, on_both_sides

from capture.devices.flash import FlashBox
from capture.devices.port import (
    BoxRebooted,
    CommandRefused,
    DeviceError,
    LinkLost,
    Port,
    PortTimeout,
)
from capture.devices.wire import Code
from rigsim.boxes.controller import Controller
from rigsim.world.serve import serve_world

EMULATED_ONLY = {
    "test_controller_missing_any_rule_is_detected": "leaves rules of the emulation out",
    "test_answer_cache_is_queue_of_eight": "reads the emulated queue",
    "test_controller_obeys_rules_on_noisy_line_long_run": "its short run is made on both sides",
}
"""Tests that exchange parts of the emulation, with what they exchange."""


def pytest_generate_tests(metafunc):
    files = (
        *("test_wire_faults.py", "test_wire_capture.py", "test_stateful_boxes.py"),
        *("test_caliper_faults.py", "test_probe_faults.py"),
    )
    on_both_sides(metafunc, long=files)  # the compiled side is marked pytest.mark.long


def pytest_collection_modifyitems(config, items):
    leave_real_lines_to_one_side(config, items)


@pytest.fixture(autouse=True)
def box_side(request, monkeypatch):
    return choose_side(request, monkeypatch, EMULATED_ONLY)


@pytest.fixture(autouse=True)
def waiting_for_the_disk(no_waiting_for_the_disk, monkeypatch):
    """Wait for the disk as the product does: these tests are about what reaches it."""
    for name, call in no_waiting_for_the_disk.items():
        monkeypatch.setattr(os, name, call)


# pops of a low power: the tube recovers in 12 ms, so that a second pop would not be refused
POWER = 0.008


class Ledger:
    """A host that pops, notes what it was told, and recovers from what goes wrong."""

    def __init__(self, world, url):
        self.world = world
        self.url = url
        self.acknowledged, self.refused, self.unknown = {}, set(), set()
        self.errors = Counter()
        self.tokens = (f"t{number}" for number in itertools.count())
        self.box = None

    def open(self, **settings):
        settings.setdefault("clock", self.world.clock if self.world.virtual else None)
        self.port_settings = settings
        self.box = FlashBox(Port(self.url, **settings))
        return self.box

    def recover(self, error):
        """Make the box usable again after `error`, or raise."""
        self.errors[type(error).__name__] += 1
        if isinstance(error, LinkLost):
            self.world.clock.sleep(1.0)
            self.box.port.reopen()
        elif isinstance(error, (BoxRebooted, PortTimeout)):
            self.box.hello()
        else:
            raise error

    def pop(self):
        """Set up and pop once; whatever happens is noted."""
        token = next(self.tokens)
        sent = False
        try:
            self.box.set_power(POWER)
            self.box.wait_charged(120.0)
            self.box.arm()
            sent = True
            self.acknowledged[token] = self.box.fire(token)
            self.box.dark()
        except CommandRefused as error:
            self.errors[Code(error.code).name] += 1
            self.refused.add(token)
        except DeviceError as error:
            if sent and token not in self.acknowledged:
                self.unknown.add(token)
            for _ in range(20):
                try:
                    self.recover(error)
                    break
                except (LinkLost, BoxRebooted, PortTimeout) as again:
                    error = again
            else:
                raise

    def check(self):
        """Fail where a pop was made twice, made though refused, or acknowledged but not made."""
        made = Counter(pop.token for pop in self.world.pops)
        assert all(count == 1 for count in made.values()), made
        assert set(self.acknowledged) <= set(made)
        assert not self.refused & set(made)
        assert set(made) <= set(self.acknowledged) | self.unknown
        powers = {pop.token: pop.power for pop in self.world.pops}
        for token, report in self.acknowledged.items():
            assert report.token == token
            assert report.power == pytest.approx(powers[token], abs=1e-6)
            assert powers[token] == POWER


@pytest.fixture
def ledger():
    made = []

    def ledger(world, url):
        made.append(Ledger(world, url))
        return made[-1]

    yield ledger
    for one in made:
        if one.box is not None:
            one.box.port.close()


def end(host):
    host.kill()
    host.wait()
    host.stdout.close()


@pytest.fixture
def host_at_work():
    """Start a process that keeps served boxes at work; it is gone when the test ends.

    ``host_at_work(script, rig, lease_s, pty=, at_work=)`` runs the script with the boxes' addresses
    as arguments, and returns the served rig and the process when it has printed "at work" twice and
    ``at_work(world)`` holds. A busy machine may hold a host up for longer than its lease before
    anybody strikes it, which proves nothing: then another is started, on boxes of its own.
    """
    with ExitStack() as started:

        def host_at_work(script, rig, lease_s, *, pty, at_work):
            head = f"import sys\nfrom capture.devices.port import Port\nlease_s = {lease_s}\n"
            for _ in range(8):
                served = started.enter_context(serve_world(rig, pty=pty))
                command = [sys.executable, "-c", head + script, *served.addresses.values()]
                host = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
                started.callback(end, host)
                said = [host.stdout.readline() for _ in range(2)]
                if said == ["at work\n"] * 2 and at_work(served.world):
                    return served, host
            return pytest.fail("eight hosts in turn did not get to work")

        yield host_at_work


@pytest.fixture
def last_heard(monkeypatch):
    """Tell when a box was last given bytes, s on its world's clock: ``last_heard(box)``.

    What a host sent before it was struck may be under way for as long as a busy machine likes;
    from the last byte on, the box alone keeps the time.
    """
    heard = {}
    honest = Controller.feed

    def feed(box, data, now):
        if data:
            heard[id(box)] = now
        return honest(box, data, now)

    monkeypatch.setattr(Controller, "feed", feed)
    return lambda box: heard[id(box)]
