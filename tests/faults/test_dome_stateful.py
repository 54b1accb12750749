"""Random hosts of the dome on a noisy line in virtual time: what must hold whatever they do.

At most once: no token runs twice, an acknowledged one has run, a refused one has not. No LED gives
more than a quarter of any second. A host that falls silent for a lease leaves the box dark and
disarmed. Open eyes never see three flashes in a second.

Four boxes with one rule left out each must be caught: they test the test.
"""

import itertools
from collections import Counter

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from hypothesis.stateful import run_state_machine_as_test as run_machine

from capture.devices.port import BoxRebooted, CommandRefused, Port, PortTimeout
from capture.devices.wire import Code
from capture.plan.eye_light import eye_light
from capture.plan.flicker import (
    EYE_SAMPLE_S,
    MIN_FLASH_CHANGE,
    average_over_flicker_fusion,
    count_flashes,
)
from capture.rig import load_rig
from rigsim.boxes.controller import Controller
from rigsim.boxes.dome import DomeUnit
from rigsim.boxes.led_bank import LedBank
from rigsim.world import World
from rigsim.world.faults import Faults

RIG = load_rig("dome").subset(views=["C00", "C05"]).resized(16)
WEIGHTS = eye_light(RIG)
LEDS = [int(k) for k in np.argsort(-WEIGHTS)[[0, 20, 60, 149]]]
NAMES = (f"dome-stateful-{number}" for number in itertools.count())
SLACK_S = 0.05  # a request counts when the box has read it

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


class NoisyDome(RuleBasedStateMachine):
    """A host, a noisy line, a dome's box, and a ledger."""

    @initialize(seed=st.integers(0, 2**32 - 1))
    def plug_in(self, seed):
        self.world = World(RIG, seed=seed, faults=NOISE)
        name = self.world.register(next(NAMES))
        self.controller = self.world.box("dome")
        self.unit = self.controller.device
        self.port = Port(f"sim://dome?world={name}", clock=self.world.clock, first_seq=1)
        self.tokens = (f"t{number}" for number in itertools.count())
        self.acknowledged, self.refused = set(), set()
        self.table_rows = 0
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
        except (PortTimeout, BoxRebooted):
            return None
        return Code.OK

    @rule()
    def greet(self):
        try:
            self.port.hello()
        except PortTimeout:
            return

    @rule()
    def disarm(self):
        if self.ask("SAFE") == Code.OK:
            assert not self.controller.armed
            assert not self.unit.lit
            assert not self.unit.running

    @rule(
        led=st.sampled_from(LEDS),
        ms=st.sampled_from([20, 100, 240, 500]),
        level=st.sampled_from([200, 1000]),
    )
    def light(self, led, ms, level):
        self.ask("SYST:ARM")
        self.ask(f"LED:ON {led},{ms},{level}")

    @rule(times=st.integers(2, 6), pause_s=st.sampled_from([0.06, 0.12, 0.3]))
    def blink(self, times, pause_s):
        self.ask("SYST:ARM")
        for _ in range(times):
            self.ask(f"LED:ON {LEDS[0]},20")
            self.listen(pause_s)

    @rule(
        leds=st.lists(st.sampled_from(LEDS), min_size=1, max_size=8),
        ms=st.sampled_from([40, 90, 200]),
    )
    def load(self, leds, ms):
        self.ask("SEQ:CLE")
        rows = ";".join(f"{led}:1000:{ms * 1000}:3" for led in leds)
        if self.ask(f"SEQ:DEF 0,{rows}") == Code.OK:
            self.table_rows = len(leds)

    @rule(times=st.integers(1, 2))
    def run_table(self, times):
        self.ask("SYST:ARM")
        self.ask(f"SEQ:ARM {self.table_rows}")
        for _ in range(times):
            token = next(self.tokens)
            code = self.ask(f"TRIG {token}")
            if code == Code.OK:
                self.acknowledged.add(token)
            elif code is not None:
                self.refused.add(token)

    @rule(lease_ms=st.sampled_from([300, 1000]))
    def set_lease(self, lease_ms):
        self.ask(f"SYST:WDOG {lease_ms}")

    @rule(pause_s=st.floats(0.01, 1.0))
    def wait_and_ping(self, pause_s):
        self.listen(pause_s)
        self.ask("SYST:PING?")

    @rule(pause_s=st.floats(0.3, 2.0))
    def fall_silent(self, pause_s):
        lease_s = self.controller._lease_ms / 1e3
        self.listen(pause_s)
        if pause_s >= lease_s + SLACK_S:
            assert not self.controller.armed
            assert not self.unit.lit
            assert not self.unit.running

    def listen(self, seconds):
        start = self.world.now
        try:
            self.port.listen(seconds)
        except BoxRebooted:
            pass
        self.world.clock.sleep(max(0.0, start + seconds - self.world.now))

    @invariant()
    def nothing_runs_twice_or_is_wrongly_acknowledged(self):
        made = Counter(token for token, _ in self.unit.runs)
        assert all(count == 1 for count in made.values())
        assert self.acknowledged <= set(made)
        assert not self.refused & set(made)

    @invariant()
    def no_led_gives_more_than_its_duty(self):
        window = RIG.leds.duty_window_s
        for led in LEDS:
            pulses = [p for p in self.world.pulses if p.led == led]
            for end in [p.t_off_s for p in pulses]:
                given = sum(
                    p.level * max(0.0, min(p.t_off_s, end) - max(p.t_on_s, end - window))
                    for p in pulses
                )
                assert given / window <= RIG.leds.max_duty + 1e-6

    @invariant()
    def open_eyes_never_see_three_flashes_in_a_second(self):
        pulses = self.world.pulses
        if not pulses or self.unit.lit:
            return
        recent = [p for p in pulses if p.t_off_s > pulses[-1].t_off_s - 4.0]
        start = min(p.t_on_s for p in recent) - 0.2
        edges = np.arange(start, pulses[-1].t_off_s + 0.2, EYE_SAMPLE_S)
        signal = np.zeros(edges.size)
        for p in recent:
            signal[(edges >= p.t_on_s) & (edges < p.t_off_s)] += WEIGHTS[p.led] * p.level
        seen = average_over_flicker_fusion(signal)
        if seen.max() > 0.0:
            # the box judges a change by the brightest of the last second, this by all of them
            flashes = count_flashes(seen, least=2.0 * MIN_FLASH_CHANGE * WEIGHTS.max())
            assert flashes < RIG.leds.max_flashes_per_s + 0.5


def explore(examples, **more):
    run_machine(
        NoisyDome,
        settings=settings(
            max_examples=examples,
            stateful_step_count=20,
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=list(HealthCheck),
            **more,
        ),
    )


def test_a_domes_box_behaves_on_a_noisy_line():
    explore(25)


@pytest.mark.long
@pytest.mark.timeout(900)
def test_a_domes_box_behaves_on_a_noisy_line_for_long():
    explore(500)


def forget_answers(monkeypatch):
    monkeypatch.setattr("rigsim.boxes.controller.CACHED_REPLIES", 0)


def allow_any_duty(monkeypatch):
    monkeypatch.setattr(LedBank, "_duty", lambda self, led, new, now: 0.0)


def stop_watchdog(monkeypatch):
    monkeypatch.setattr(Controller, "_renew_lease", lambda self, now: None)


def ignore_flicker(monkeypatch):
    monkeypatch.setattr(DomeUnit, "_require_calm", lambda self, wanted, now: (0.0, 0.0))


@pytest.mark.parametrize(
    ("leave_out", "broken"),
    [
        (forget_answers, "nothing_runs_twice_or_is_wrongly_acknowledged"),
        (allow_any_duty, "no_led_gives_more_than_its_duty"),
        (stop_watchdog, "fall_silent"),
        (ignore_flicker, "open_eyes_never_see_three_flashes_in_a_second"),
    ],
)
def test_a_box_with_one_rule_left_out_is_caught(monkeypatch, leave_out, broken):
    leave_out(monkeypatch)
    with pytest.raises(AssertionError) as caught:
        explore(600, phases=[Phase.generate])
    assert broken in [entry.name for entry in caught.traceback]
