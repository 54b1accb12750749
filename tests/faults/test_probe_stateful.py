"""Random hosts of the probe on a noisy line in virtual time: what must hold whatever they do.

Light comes out only while the box is armed and the head held, and never longer than was asked for.
The head is sucked at only while the box is armed and was told where it sits, no longer than asked,
and the skin has its rest between. An accepted opening or suction begins once, a refused one never.
A host that falls silent for a lease leaves a dark and vented head.

Eight boxes with one rule left out each must be caught: they test the test.
"""

import dataclasses
import itertools

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from hypothesis.stateful import run_state_machine_as_test as run_machine

from capture.devices.port import BoxRebooted, CommandRefused, Port, PortTimeout
from capture.devices.wire import Code
from capture.rig import load_rig
from rigsim.boxes.controller import Controller
from rigsim.boxes.probe import ProbeUnit
from rigsim.boxes.source_shutter import SourceShutter
from rigsim.boxes.suction_pump import SuctionPump
from rigsim.world import World
from rigsim.world.faults import Faults

SHIPPED = load_rig("probe")
REST_S, MOST_S = 1.0, 3.0
RIG = dataclasses.replace(
    SHIPPED, probe=dataclasses.replace(SHIPPED.probe, rest_s=REST_S, max_suction_s=MOST_S)
)
NAMES = (f"probe-stateful-{number}" for number in itertools.count())
SLACK_S = 0.05  # a request counts when the box has read it

NOISE = Faults(
    drop=0.001,
    flip=0.001,
    glue=0.01,
    cut=0.005,
    late=0.02,
    late_s=0.3,
    lose_answer=0.08,
    duplicate=0.05,
    babble=0.02,
    shutter_stuck=0.05,
    pump_leak=0.1,
    head_lifts_after=4.0,
)


class NoisyProbe(RuleBasedStateMachine):
    """A host, a noisy line, a probe's box with skin, and a witness of light and suction."""

    @initialize(seed=st.integers(0, 2**32 - 1))
    def plug_in(self, seed):
        self.world = World(RIG, seed=seed, faults=NOISE)
        name = self.world.register(next(NAMES))
        self.controller = self.world.box("probe")
        self.unit = self.controller.device
        self.port = Port(f"sim://probe?world={name}", clock=self.world.clock, first_seq=1)
        self.faulty, self.vented_s, self.drawn_s = [], None, None
        self.longest_s = 0.0
        head = self.world.head
        self.draw, head.draw = head.draw, self.witness_draw
        self.vent, head.vent = head.vent, self.witness_vent
        self.greet()

    def teardown(self):
        if hasattr(self, "world"):
            self.port.close()
            self.world.unregister()

    def witness_draw(self, mbar, now):
        """Look at a pump that is being switched on."""
        self.draw(mbar, now)
        if not self.controller.armed:
            self.faulty.append(f"sucked unarmed at {now}")
        if self.unit.pump.placement is None:
            self.faulty.append(f"sucked unplaced at {now}")
        if self.vented_s is not None and now < self.vented_s + REST_S - 2e-6:
            self.faulty.append(f"rested {now - self.vented_s} s at {now}")
        self.drawn_s = now

    def witness_vent(self, now):
        """Look at a vent that opens."""
        self.vent(now)
        if self.drawn_s is not None:
            if now > self.drawn_s + MOST_S + 1e-9:
                self.faulty.append(f"sucked for {now - self.drawn_s} s")
            self.vented_s, self.drawn_s = now, None

    def ask(self, text):
        """Return the code of an answer, None when it is not known whether the act was done."""
        try:
            self.port.ask(text)
        except CommandRefused as error:
            return error.code
        except (PortTimeout, BoxRebooted):
            return None
        return Code.OK

    def begin(self, text, count):
        """Ask for light or suction: once when it is accepted, never when it is refused."""
        before = count()
        code = self.ask(text)
        begun = count() - before
        assert begun <= 1
        if code == Code.OK:
            assert begun == 1
        elif code not in (None, Code.HARDWARE):  # a stuck shutter is tried
            assert begun == 0

    @rule()
    def greet(self):
        try:
            self.port.hello()
        except PortTimeout:
            return

    @rule(mbar=st.sampled_from([20, 60, 150]), span_ms=st.sampled_from([500, 3000]))
    def get_ready(self, mbar, span_ms):
        self.ask("SYST:ARM")
        self.ask("LED 1000")
        self.ask("HEAD:SITE cheek,0")
        self.suck(mbar, span_ms)
        self.stay(0.6)

    @rule(mbar=st.sampled_from([20, 60, 150]), span_ms=st.sampled_from([500, 3000]))
    def suck(self, mbar, span_ms):
        self.begin(f"PUMP ON,{span_ms},{mbar}", lambda: self.unit.pump.count)

    @rule(
        span_ms=st.sampled_from([5, 300, 1500]),
        wait_s=st.sampled_from([0.0, 0.2, 2.0]),
        led=st.booleans(),
    )
    def light(self, span_ms, wait_s, led):
        if led:
            self.ask("LED 1000")
        self.longest_s = max(self.longest_s, span_ms / 1e3)
        self.begin(f"SHUT OPEN,{span_ms}", lambda: self.unit.shutter.count)
        self.stay(wait_s)

    @rule(
        text=st.sampled_from(
            [
                "SYST:ARM",
                "HEAD:SITE chin,90",
                "PUMP VENT",
                "HEAD:FREE",
                "LED 500",
                "LED 0",
                "SHUT CLOSE",
                "FIB 3",
                "FIB ALL",
                "*RST",
            ]
        )
    )
    def say(self, text):
        self.ask(text)

    @rule(seconds=st.sampled_from([0.2, 1.0, 3.0]))
    def pass_time(self, seconds):
        self.stay(seconds)

    @rule()
    def disarm(self):
        if self.ask("SAFE") == Code.OK:
            self.require_let_go()

    @rule(lease_ms=st.sampled_from([300, 1000]))
    def set_lease(self, lease_ms):
        self.ask(f"SYST:WDOG {lease_ms}")

    def stay(self, seconds):
        """Let time pass and keep the lease."""
        until = self.world.now + seconds
        while self.world.now < until:
            self.listen(0.1)
            self.ask("SYST:PING?")

    @rule(pause_s=st.floats(0.3, 2.0))
    def fall_silent(self, pause_s):
        lease_s = self.controller._lease_ms / 1e3
        self.listen(pause_s)
        if pause_s >= lease_s + SLACK_S:
            self.require_let_go()

    def require_let_go(self):
        assert not self.controller.armed
        assert not self.unit.lit
        assert self.unit.shutter.level == 0
        assert not self.unit.pump.drawing
        assert self.unit.pump.placement is None
        assert not self.world.head_at(self.world.now).placed

    def listen(self, seconds):
        start = self.world.now
        try:
            self.port.listen(seconds)
        except BoxRebooted:
            pass
        self.world.clock.sleep(max(0.0, start + seconds - self.world.now))

    @invariant()
    def nothing_was_sucked_that_must_not(self):
        assert getattr(self, "faulty", []) == []

    @invariant()
    def light_is_of_an_armed_box_and_ends(self):
        if not hasattr(self, "unit"):
            return
        assert not self.unit.lit or (self.controller.armed and self.unit.pump.drawing)
        assert not self.unit.shutter.jammed
        for light in self.world.light_between(0.0, self.world.now):
            assert light.t_off_s - light.t_on_s <= self.longest_s + 1e-9
        assert len(self.world.sources) <= self.unit.shutter.count

    @invariant()
    def suction_is_of_an_armed_box(self):
        if hasattr(self, "unit") and self.unit.pump.drawing:
            assert self.controller.armed
            assert self.unit.pump.placement is not None


def explore(examples, **more):
    run_machine(
        NoisyProbe,
        settings=settings(
            max_examples=examples,
            stateful_step_count=15,
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=list(HealthCheck),
            **more,
        ),
    )


def test_a_probes_box_behaves_on_a_noisy_line():
    explore(25)


@pytest.mark.long
@pytest.mark.timeout(900)
def test_a_probes_box_behaves_on_a_noisy_line_for_long():
    explore(500)


def forget_answers(monkeypatch):
    monkeypatch.setattr("rigsim.boxes.controller.CACHED_REPLIES", 0)


def stop_watchdog(monkeypatch):
    monkeypatch.setattr(Controller, "_renew_lease", lambda self, now: None)


def act_unarmed(monkeypatch):
    honest = ProbeUnit.commands

    def commands(unit):
        return {k: dataclasses.replace(c, armed=False) for k, c in honest(unit).items()}

    monkeypatch.setattr(ProbeUnit, "commands", commands)


def rest_never(monkeypatch):
    monkeypatch.setattr(SuctionPump, "rest_ms", lambda self, now: 0)


def keep_the_place(monkeypatch):
    monkeypatch.setattr(SuctionPump, "take_away", lambda self, now: None)


def keep_shining(monkeypatch):
    monkeypatch.setattr(SourceShutter, "go_dark", lambda self, now, how: None)


def shine_unheld(monkeypatch):
    monkeypatch.setattr(SuctionPump, "holds", True)


def open_too_long(monkeypatch):
    honest = SourceShutter.open

    def open_long(shutter, seconds, now):
        return honest(shutter, 1.5 * seconds, now)

    monkeypatch.setattr(SourceShutter, "open", open_long)


SUCKED = "nothing_was_sucked_that_must_not"
LIGHT = "light_is_of_an_armed_box_and_ends"
SUCTION = "suction_is_of_an_armed_box"


@pytest.mark.parametrize(
    ("leave_out", "broken"),
    [
        (forget_answers, ("begin",)),
        (stop_watchdog, ("require_let_go",)),
        (act_unarmed, (SUCKED, LIGHT, SUCTION, "require_let_go")),
        (rest_never, (SUCKED,)),
        (keep_the_place, ("require_let_go",)),
        (keep_shining, ("require_let_go",)),
        pytest.param(shine_unheld, (LIGHT,), marks=pytest.mark.long),
        pytest.param(open_too_long, (LIGHT,), marks=pytest.mark.long),
    ],
)
def test_a_box_with_one_rule_left_out_is_caught(monkeypatch, leave_out, broken):
    leave_out(monkeypatch)
    with pytest.raises(AssertionError) as caught:
        explore(600, phases=[Phase.generate])
    assert {entry.name for entry in caught.traceback} & set(broken)
