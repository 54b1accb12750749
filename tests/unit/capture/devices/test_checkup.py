"""The checks of attached controllers: a good one passes all, and each broken rule is named."""

import itertools
import json

import pytest

from capture.devices import wire
from capture.devices.checkup import (
    CONTROLLER_CHECKS,
    CheckupFault,
    CheckupPort,
    judge_controller,
    protocol_minor,
)
from capture.devices.flash import FlashBox
from capture.devices.port import Port, WrongDevice
from capture.rig import load_rig
from rigsim.boxes.controller import Controller
from rigsim.boxes.faults import Faults
from rigsim.world import World
from rigsim.world.rig_boxes import BOXES
from rigsim.world.serve import serve_world

NAMES = (f"checkup-{number}" for number in itertools.count())


@pytest.fixture
def serve():
    """Serve a controller on a pty in real time, and open a port to it."""
    opened = []

    def serve(kind="flash", **faults):
        rig = load_rig(BOXES[kind].rig)
        rig = rig.with_scanner() if kind == "scanner" else rig
        served = serve_world(rig, pty=True, faults=Faults(baud=0.0, **faults))
        port = CheckupPort(served.addresses[kind])
        opened.extend((served, port))
        return port

    yield serve
    for one in reversed(opened):
        one.close()


@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=() if kind == "flash" else pytest.mark.long) for kind in BOXES],
)
def test_emulated_controllers_pass_all_checks(serve, kind):
    results = judge_controller(serve(kind))
    assert [result.what for result in results] == list(CONTROLLER_CHECKS)
    assert all(result.fine for result in results), results


def forget_lease(monkeypatch):
    monkeypatch.setattr(Controller, "_renew_lease", lambda self, now: None)


def forget_answers(monkeypatch):
    monkeypatch.setattr(Controller, "_same_request", lambda *_: False)


def obey_bare_lines(monkeypatch):
    original = Controller._handle_bare_line
    monkeypatch.setattr(
        Controller,
        "_handle_bare_line",
        lambda self, line, now: self._arm("", now) or original(self, line, now),
    )


def light_longer(monkeypatch):
    monkeypatch.setattr("rigsim.boxes.flash.LAMP_RANGE_MS", (1.0, 900.0))


def queue_more_errors(monkeypatch):
    monkeypatch.setattr("rigsim.boxes.controller.MAX_QUEUED_ERRORS", 20)


def run_fast(monkeypatch):
    original = Controller._own_commands

    def commands(self):
        table = original(self)
        run = table["SYST:PING?"].run
        object.__setattr__(
            table["SYST:PING?"], "run", lambda text, now: str(int(1.02 * int(run(text, now))))
        )
        return table

    monkeypatch.setattr(Controller, "_own_commands", commands)


@pytest.mark.parametrize(
    ("break_rule", "check"),
    [
        (forget_lease, "lease"),
        (forget_answers, "retries"),
        (obey_bare_lines, "refusals"),
        (light_longer, "refusals"),
        (queue_more_errors, "refusals"),
        (run_fast, "clock"),
    ],
)
def test_broken_rule_is_named_by_its_check(serve, monkeypatch, break_rule, check):
    break_rule(monkeypatch)
    port = serve()
    port.hello()
    with pytest.raises(CheckupFault, match="expected"):
        CONTROLLER_CHECKS[check](port)


# versions --------------------------------------------------------------------------------------


@pytest.fixture
def flash_port():
    worlds = []

    def flash_port(**faults):
        world = World(load_rig("flash").resized(16), faults=Faults(**faults))
        worlds.append(world)
        return Port(f"sim://flash?world={world.register(next(NAMES))}", clock=world.clock)

    yield flash_port
    for world in worlds:
        world.unregister()


def drop_minor(monkeypatch):
    """Let controllers answer as those of protocol 1.0."""
    original = Controller._get_capabilities

    def older(self, arguments, now):
        limits = json.loads(wire.unseal(original(self, arguments, now)))
        del limits["protocol_minor"]
        return wire.seal(json.dumps(limits, separators=(",", ":")))

    monkeypatch.setattr(Controller, "_get_capabilities", older)


@pytest.mark.parametrize("older_box", [False, True])
def test_hosts_and_boxes_of_both_revisions_work_together(flash_port, monkeypatch, older_box):
    if older_box:
        drop_minor(monkeypatch)
    with FlashBox(flash_port()) as box:
        assert protocol_minor(dict(box.limits)) == (0 if older_box else 3)
        assert box.identity.version == 1
        box.arm()
        assert box.fire("a").count == 1


def test_another_major_version_is_refused(flash_port):
    with pytest.raises(WrongDevice, match="protocol 2"):
        FlashBox(flash_port(protocol=2))
