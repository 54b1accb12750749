"""Random hosts on a noisy line in virtual time: what must hold whatever they do.

At most once: no token pops twice, an acknowledged one has popped, a refused one has not. The tube's
recycle time holds between any two pops. A host that falls silent for a lease leaves the box dark
and disarmed. A box that has started again keeps its power-up settings until it is greeted.

Four boxes with one rule left out each must be caught: they test the test.
"""

import itertools
from collections import Counter, deque

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from capture.devices.port import BoxRebooted, CommandRefused, Port, PortTimeout
from capture.devices.wire import Code
from capture.rig import load_rig
from rigsim.boxes.controller import Controller
from rigsim.boxes.flash import FlashUnit
from rigsim.world import World
from rigsim.world.faults import Faults

RIG = load_rig("flash").resized(16)
NAMES = (f"stateful-{number}" for number in itertools.count())
# lease checks allow for a request's own bytes: it counts when the box has read it
SLACK_S = 0.05

NOISE = Faults(
    drop=0.001,
    flip=0.001,
    glue=0.01,
    cut=0.005,
    late=0.02,
    late_s=0.3,
    lose_answer=0.08,
    duplicate=0.03,
    babble=0.02,
)


class NoisyFlash(RuleBasedStateMachine):
    """A host, a noisy line, a flash box, and a ledger."""

    @initialize(seed=st.integers(0, 2**32 - 1))
    def plug_in(self, seed):
        self.world = World(RIG, seed=seed, faults=NOISE)
        name = self.world.register(next(NAMES))
        self.controller = self.world.box("flash")
        self.unit = self.controller.device
        self.port = Port(f"sim://flash?world={name}", clock=self.world.clock, first_seq=1)
        self.tokens = (f"t{number}" for number in itertools.count())
        self.acknowledged, self.refused = set(), set()
        self.greeted = False
        self.fresh_boot = None
        self.greet()

    def teardown(self):
        if hasattr(self, "world"):
            self.port.close()
            self.world.unregister()

    def ask(self, text):
        """Return the code of an answer, None when it is not known whether the act was done."""
        try:
            self.port.ask(text)
        except CommandRefused as error:
            return error.code
        except PortTimeout:
            return None
        except BoxRebooted:
            self.greeted = False
            return None
        return Code.OK

    @rule()
    def greet(self):
        try:
            self.port.hello()
        except PortTimeout:
            return
        self.greeted = True
        if self.port.boot == self.controller.boot:
            self.fresh_boot = None

    @rule()
    def arm(self):
        self.ask("SYST:ARM")

    @rule()
    def disarm(self):
        if self.ask("SAFE") == Code.OK:
            assert not self.controller.armed
            assert not self.unit.lit

    @rule(power=st.sampled_from([0.005, 0.1, 0.5, 1.0]))
    def set_power(self, power):
        if self.ask(f"FLAS:POW {power}") == Code.OK:
            assert self.unit.power == power

    @rule(stop=st.sampled_from(["PAR", "CROS"]))
    def turn(self, stop):
        if self.ask(f"FLAS:POL {stop}") == Code.OK:
            assert self.unit.polarizer == ("parallel" if stop == "PAR" else "crossed")

    @rule(lease_ms=st.sampled_from([300, 600, 1000]))
    def set_lease(self, lease_ms):
        self.ask(f"SYST:WDOG {lease_ms}")

    @rule(sync_us=st.sampled_from([0, 5000, 50_000]))
    def set_sync(self, sync_us):
        if self.ask(f"FLAS:SYNC {sync_us}") == Code.OK:
            assert self.unit.sync_s == sync_us / 1e6

    @rule(length_ms=st.integers(1, 500))
    def light_lamp(self, length_ms):
        self.ask(f"FLAS:LAMP ON,{length_ms}")

    @rule(times=st.integers(1, 3))
    def fire(self, times):
        self.ask("SYST:ARM")
        for _ in range(times):
            token = next(self.tokens)
            code = self.ask(f"FLAS:FIRE {token}")
            if code == Code.OK:
                self.acknowledged.add(token)
            elif code is not None:
                self.refused.add(token)

    @rule(pause_s=st.floats(0.01, 2.0))
    def wait_and_ping(self, pause_s):
        self.listen(pause_s)
        self.ask("SYST:PING?")

    @rule(pause_s=st.floats(0.3, 4.0))
    def fall_silent(self, pause_s):
        lease_s = self.controller._lease_ms / 1e3
        self.listen(pause_s)
        if pause_s >= lease_s + SLACK_S:
            assert not self.controller.armed
            assert not self.unit.lit

    @precondition(lambda self: self.greeted)
    @rule()
    def brown_out(self):
        self.controller.power_cycle(self.world.now, boot_s=0.1, announce=False)
        self.fresh_boot = self.controller.boot

    def listen(self, seconds):
        start = self.world.now
        try:
            self.port.listen(seconds)
        except BoxRebooted:
            self.greeted = False
        self.world.clock.sleep(max(0.0, start + seconds - self.world.now))

    @invariant()
    def nothing_is_done_twice_or_wrongly_acknowledged(self):
        made = Counter(pop.token for pop in self.world.pops)
        assert all(count == 1 for count in made.values())
        assert self.acknowledged <= set(made)
        assert not self.refused & set(made)

    @invariant()
    def the_tube_recovers_between_pops(self):
        for before, after in itertools.pairwise(self.world.pops):
            assert after.t_s - before.t_s >= RIG.recycle_s * before.power - 2e-6

    @invariant()
    def a_box_that_started_again_waits_to_be_greeted(self):
        if self.fresh_boot == self.controller.boot:
            assert (self.unit.power, self.unit.polarizer) == (1.0, "parallel")
            assert self.unit.sync_s == 0.0
            assert not self.controller.armed
            assert not self.unit.lit


def explore(examples, **more):
    run_state_machine_as_test(
        NoisyFlash,
        settings=settings(
            max_examples=examples,
            stateful_step_count=30,
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=list(HealthCheck),
            **more,
        ),
    )


def test_a_flash_box_behaves_on_a_noisy_line():
    explore(40)


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_flash_box_behaves_on_a_noisy_line_for_long():
    explore(600)


def forget_answers(monkeypatch):
    monkeypatch.setattr("rigsim.boxes.controller.CACHED_REPLIES", 0)


def skip_recycling(monkeypatch):
    honest = FlashUnit._fire

    def fire(self, arguments, now):
        self._last_pop = float("-inf")
        return honest(self, arguments, now)

    monkeypatch.setattr(FlashUnit, "_fire", fire)


def stop_watchdog(monkeypatch):
    monkeypatch.setattr(Controller, "_renew_lease", lambda self, now: None)


def ignore_boot(monkeypatch):
    monkeypatch.setattr(Controller, "_foreign_epoch", lambda self, boot: False)


@pytest.mark.parametrize(
    ("leave_out", "broken"),
    [
        (forget_answers, "nothing_is_done_twice_or_wrongly_acknowledged"),
        (skip_recycling, "the_tube_recovers_between_pops"),
        (stop_watchdog, "fall_silent"),
        (ignore_boot, "a_box_that_started_again_waits_to_be_greeted"),
    ],
)
def test_a_box_with_one_rule_left_out_is_caught(monkeypatch, leave_out, broken):
    leave_out(monkeypatch)
    with pytest.raises(AssertionError) as caught:
        explore(500, phases=[Phase.generate])
    assert broken in [entry.name for entry in caught.traceback]


def test_the_cache_of_answers_is_a_queue_of_eight():
    controller = World(RIG).box("flash")
    assert isinstance(controller._replies, deque)
    assert controller._replies.maxlen == 8
