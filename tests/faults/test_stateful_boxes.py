"""Random hosts of every box on a noisy line: what must hold whatever they do.

`fixtures/hosts` says of each box what that is. A box with one rule left out must be caught: these
cases test the test.
"""

from collections import deque

import pytest
from fixtures.hosts import caliper, dome, flash, gradient_sphere, probe, scanner
from fixtures.noisy_host import explore
from hypothesis import Phase

from rigsim.world import World

HOSTS = {
    "flash": (flash, flash.NoisyFlash, 30),
    "dome": (dome, dome.NoisyDome, 20),
    "gradient_sphere": (gradient_sphere, gradient_sphere.NoisySphere, 15),
    "caliper": (caliper, caliper.NoisyCaliper, 15),
    "probe": (probe, probe.NoisyProbe, 15),
    "scanner": (scanner, scanner.NoisyScanner, 15),
}
"""Module, state machine, and steps of an example."""
LEFT_OUT = [
    pytest.param(box, rule, caught, marks=marks, id=f"{box}-{rule.__name__}")
    for box, (module, _, _) in HOSTS.items()
    for rule, caught, marks in module.LEFT_OUT
]


@pytest.mark.parametrize("box", HOSTS)
def test_controller_obeys_rules_on_noisy_line(box):
    _, host, steps = HOSTS[box]
    explore(host, 15, steps=steps)


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize("box", HOSTS)
def test_controller_obeys_rules_on_noisy_line_long_run(box):
    _, host, steps = HOSTS[box]
    explore(host, 60, steps=steps)


@pytest.mark.long
@pytest.mark.parametrize(("box", "leave_out", "caught_by"), LEFT_OUT)
def test_controller_missing_any_rule_is_detected(monkeypatch, box, leave_out, caught_by):
    leave_out(monkeypatch)
    _, host, steps = HOSTS[box]
    with pytest.raises(AssertionError) as caught:
        explore(host, 600, steps=steps, phases=[Phase.generate])
    assert {entry.name for entry in caught.traceback} & set(caught_by)


def test_answer_cache_is_queue_of_eight():
    controller = World(flash.RIG).box("flash")
    assert isinstance(controller._replies, deque)
    assert controller._replies.maxlen == 8
