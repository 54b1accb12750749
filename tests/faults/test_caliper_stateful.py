"""Random hosts of the caliper on a noisy line in virtual time: what must hold whatever they do.

The jaws move only while the box is armed, homed (or homing) and has been told a force limit; the
force goes beyond that limit for no longer than one control period, however stiff the skin is, and
however often the motor stalls. An accepted move begins once, a refused one never. A host that falls
silent for a lease has lost the skin, and nothing moves.

Six boxes with one rule left out each must be caught: they test the test.
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
from rigsim.boxes.caliper import CALIPER_CONTROL_PERIOD_S, CaliperUnit
from rigsim.boxes.controller import Controller
from rigsim.world import World
from rigsim.world.faults import Faults

SLOW = load_rig("gradient").cropped(16)
RIG = dataclasses.replace(SLOW, caliper=dataclasses.replace(SLOW.caliper, speed_mm_per_s=8.0))
NAMES = (f"caliper-stateful-{number}" for number in itertools.count())
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
    jaw_stall=0.05,
    skin_stiff=12.0,
)


class NoisyCaliper(RuleBasedStateMachine):
    """A host, a noisy line, a caliper's box with skin, and a witness of every movement."""

    @initialize(seed=st.integers(0, 2**32 - 1))
    def plug_in(self, seed):
        self.world = World(RIG, seed=seed, faults=NOISE)
        name = self.world.register(next(NAMES))
        self.controller = self.world.box("caliper")
        self.unit = self.controller.device
        self.port = Port(f"sim://caliper?world={name}", clock=self.world.clock, first_seq=1)
        self.faulty, self.over_since = [], None
        self.stood_mm = self.unit.aperture_mm
        self.note, self.unit._on_change = self.unit._on_change, self.witness
        self.greet()

    def teardown(self):
        if hasattr(self, "world"):
            self.port.close()
            self.world.unregister()

    def witness(self, now):
        """Look at what has just changed between the jaws."""
        self.note(now)
        unit = self.unit
        moved = unit.aperture_mm != self.stood_mm
        self.stood_mm = unit.aperture_mm
        if moved and not self.controller.armed:
            self.faulty.append(f"moved unarmed at {now}")
        if moved and unit.limit_n is None:
            self.faulty.append(f"moved without a limit at {now}")
        if moved and not (unit.homed or unit._move.homing):
            self.faulty.append(f"moved unhomed at {now}")
        over = unit.limit_n is not None and abs(unit.felt_n) >= unit.limit_n
        if (
            over
            and self.over_since is not None
            and now > self.over_since + CALIPER_CONTROL_PERIOD_S + 1e-9
        ):
            self.faulty.append(f"{unit.felt_n} N of {unit.limit_n} N at {now}")
        if not over:
            self.over_since = None
        elif self.over_since is None:
            self.over_since = now

    def ask(self, text):
        """Return the code of an answer, None when it is not known whether the act was done."""
        try:
            self.port.ask(text)
        except CommandRefused as error:
            return error.code
        except (PortTimeout, BoxRebooted):
            return None
        return Code.OK

    def begin(self, text):
        """Ask for a move: once when it is accepted, never when it is refused."""
        before = len(self.unit.moves)
        code = self.ask(text)
        begun = len(self.unit.moves) - before
        assert begun <= 1
        if code is not None:
            assert begun == (code == Code.OK)

    @rule()
    def greet(self):
        try:
            self.port.hello()
        except PortTimeout:
            return

    @rule(limit_n=st.sampled_from([0.1, 0.4, 1.0, 5.0]))
    def get_ready(self, limit_n):
        self.ask("SYST:ARM")
        self.ask(f"CAL:FORC:LIM {limit_n}")
        self.ask("CAL:REL")
        self.begin("CAL:HOME")
        self.stay(2.0)
        self.ask("CAL:ATT")

    @rule(step=st.integers(-4, 8), wait_s=st.sampled_from([0.0, 0.1, 0.6]))
    def step(self, step, wait_s):
        self.begin(f"CAL:STEP:ABS {step}")
        self.stay(wait_s)

    @rule(limit_n=st.sampled_from([0.1, 1.0]))
    def set_limit(self, limit_n):
        self.ask(f"CAL:FORC:LIM {limit_n}")

    @rule(text=st.sampled_from(["SYST:ARM", "CAL:ATT", "CAL:ANG 45", "CAL:REL", "*RST"]))
    def say(self, text):
        self.ask(text)

    @rule(armed=st.booleans())
    def home(self, armed):
        if armed:
            self.ask("SYST:ARM")
        self.begin("CAL:HOME")
        self.stay(0.2)

    @rule()
    def disarm(self):
        if self.ask("SAFE") == Code.OK:
            assert not self.controller.armed
            assert not self.unit.attached

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
            assert not self.controller.armed
            assert not self.unit.attached
            assert not self.unit.busy(self.world.now)
            assert not self.world.skin.state.attached

    def listen(self, seconds):
        start = self.world.now
        try:
            self.port.listen(seconds)
        except BoxRebooted:
            pass
        self.world.clock.sleep(max(0.0, start + seconds - self.world.now))

    @invariant()
    def nothing_moved_that_must_not(self):
        assert getattr(self, "faulty", []) == []

    @invariant()
    def skin_is_held_by_an_armed_box_only(self):
        if hasattr(self, "unit") and self.world.skin.state.attached:
            assert self.controller.armed
            assert self.unit.attached


def explore(examples, **more):
    run_machine(
        NoisyCaliper,
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


def test_a_calipers_box_behaves_on_a_noisy_line():
    explore(25)


@pytest.mark.long
@pytest.mark.timeout(900)
def test_a_calipers_box_behaves_on_a_noisy_line_for_long():
    explore(500)


def forget_answers(monkeypatch):
    monkeypatch.setattr("rigsim.boxes.controller.CACHED_REPLIES", 0)


def stop_watchdog(monkeypatch):
    monkeypatch.setattr(Controller, "_renew_lease", lambda self, now: None)


def go_on_beyond_the_limit(monkeypatch):
    def go_on(unit, move, now):
        if now >= move.arrives_s:
            unit._arrive(move, now)

    monkeypatch.setattr(CaliperUnit, "_turn_back", go_on)


def move_unarmed(monkeypatch):
    honest = CaliperUnit.commands

    def commands(unit):
        return {k: dataclasses.replace(c, armed=False) for k, c in honest(unit).items()}

    monkeypatch.setattr(CaliperUnit, "commands", commands)


def move_without_a_limit(monkeypatch):
    monkeypatch.setattr(CaliperUnit, "_require_limit", lambda self: None)


def keep_the_skin(monkeypatch):
    honest = CaliperUnit._release

    def release(unit, now, why):
        if why != "DARK" or not unit.attached:
            honest(unit, now, why)

    monkeypatch.setattr(CaliperUnit, "_release", release)


@pytest.mark.parametrize(
    ("leave_out", "broken"),
    [
        (forget_answers, "begin"),
        (stop_watchdog, "fall_silent"),
        pytest.param(go_on_beyond_the_limit, "nothing_moved_that_must_not", marks=pytest.mark.long),
        (move_unarmed, "nothing_moved_that_must_not"),
        (move_without_a_limit, "nothing_moved_that_must_not"),
        (keep_the_skin, ("disarm", "fall_silent", "skin_is_held_by_an_armed_box_only")),
    ],
)
def test_a_box_with_one_rule_left_out_is_caught(monkeypatch, leave_out, broken):
    leave_out(monkeypatch)
    with pytest.raises(AssertionError) as caught:
        explore(600, phases=[Phase.generate])
    names = {entry.name for entry in caught.traceback}
    assert names & ({broken} if isinstance(broken, str) else set(broken))
