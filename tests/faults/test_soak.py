"""Simulated rigs under seeded faults: promises hold, failures replay, planted bugs are found."""

import json
import os
from functools import cache

import numpy as np
import pytest
from fixtures.planted import BUGS, mutate, planted
from fixtures.product_code import ROOT, text_of

from rigsim.world import World
from rigsim.world.line_faults import LineFaults
from skinrig.cli import main
from skinrig.soaking import host_run, soak, soaked_session
from skinrig.soaking.fault_draw import HostFault
from skinrig.soaking.soak import run_soak
from skinrig.soaking.soaked_session import SoakedSession
from skinrig.soaking.witnesses import WITNESS_RIGS, DomeWitness, WitnessRig

SEED = 100
FIRST_DAY = 1
"""Of the fixed soak; its last day is that of the weak LED."""
BUGS_VARIABLE = "SOAK_BUGS"
""""all": the long test plants every bug."""
N_SOAKED_DAYS = 2
SAMPLE = 5
MIN_BUGS = 40
MAX_DAYS = 10


@pytest.fixture(autouse=True)
def box_side():
    """Leave the boxes emulated: bugs are planted into the emulation."""


@cache
def soak_day(seed, day):
    """Soak one day without any change; a day depends on seed and number alone."""
    return run_soak(seed, hours=24, first_day=day)


@pytest.mark.long
def test_soak_of_same_seed_repeats_every_byte():
    first, second, other = (run_soak(seed, hours=24, shots_per_day=30) for seed in (5, 5, 6))
    assert first.failure == second.failure == other.failure == ""
    assert first.digest == second.digest != other.digest
    assert first.faults == second.faults
    assert first.shots >= 30


def test_soak_finds_planted_bug_and_names_replay(capsys):
    bug = next(bug for bug in BUGS if bug["name"] == "lease is a tenth longer")
    day = str(bug["day"])
    with planted(bug["file"], mutate(bug)):
        argv = ["soak", "--seed", str(bug["seed"]), "--first-day", day, "--hours", "24", "--json"]
        assert main(argv) == 1
    document = json.loads(capsys.readouterr().out)
    assert "dark within lease + 10 ms" in document["failure"]
    assert " ".join(["skinrig", *argv[:-1]]) in document["failure"]


@pytest.mark.parametrize("name", WITNESS_RIGS)
def test_second_client_is_refused_in_every_rig(name, tmp_path, monkeypatch):
    """Each controller of the rig; the first host completes its session."""
    fault = HostFault("second client", 1)
    monkeypatch.setattr(soaked_session, "draw_host_fault", lambda rng: fault)
    witness, tried = WITNESS_RIGS[name], []

    class NotedPort(host_run.Port):
        def __init__(self, url, **words):
            tried.append(url)
            super().__init__(url, **words)

    monkeypatch.setattr(host_run, "Port", NotedPort)
    world = World(witness.rig, seed=3, scene=witness)
    rng, words = np.random.default_rng(3), {"label": "d0s0", "day": 0}
    monkeypatch.setattr(LineFaults, "pass_on", lambda self, way, line: [(0.0, line)])
    registered = world.register(f"second-{name}")
    soaked = SoakedSession(witness, world, registered, tmp_path, rng=rng, **words)
    outcome = soaked.run()
    assert outcome.faults["second client"] == outcome.runs == 1
    assert outcome.codes == {0: 1}
    assert {url.split("?")[0] for url in tried} == {f"sim://{kind}" for kind in witness.rig.boxes}


@pytest.mark.long
def test_weak_led_is_filed_and_would_be_noticed(monkeypatch):
    """No controller measures light: frames of a weak LED have less than their step requests."""
    seed, day = SEED, FIRST_DAY + N_SOAKED_DAYS - 1
    assert soak_day(seed, day).failure == ""
    monkeypatch.setattr(DomeWitness, "weaken", WitnessRig.weaken)
    failure = run_soak(seed, hours=24, first_day=day).failure
    assert "no frame is filed under a wrong light" in failure


def test_soak_begins_no_day_after_its_budget(monkeypatch):
    spent_s = [0.0]
    monkeypatch.setattr(soak, "_soak_day", lambda *_: spent_s.append(spent_s[-1] + 50.0))
    monkeypatch.setattr(soak.time, "process_time", lambda: spent_s[-1])
    result = run_soak(5, hours=2400.0, budget_s=170.0)
    assert (result.days, result.processor_s) == (4, 200.0)


@pytest.mark.parametrize("option", [("--hours", "-1"), ("--hours", "nan"), ("--budget", "0")])
def test_soak_refuses_unusable_numbers(option, capsys):
    assert main(["soak", *option]) == 3
    assert option[0] in capsys.readouterr().err


def test_planted_bugs_are_many_and_fit_sources():
    assert len({bug["name"] for bug in BUGS}) == len(BUGS) >= MIN_BUGS
    for bug in BUGS:
        assert mutate(bug)
        assert 0 <= bug["day"] < MAX_DAYS, bug["name"]
        assert bug["invariant"], bug["name"]


@pytest.mark.long
def test_sampled_planted_bugs_are_found():
    sample = sorted({*range(0, len(BUGS), len(BUGS) // SAMPLE), len(BUGS) - 1})
    chosen = BUGS if os.environ.get(BUGS_VARIABLE) == "all" else [BUGS[k] for k in sample]
    missed = []
    for bug in chosen:
        with planted(bug["file"], mutate(bug)) as changed:
            assert changed, bug["name"]
            failure = run_soak(bug["seed"], hours=24, first_day=bug["day"]).failure
            if f": {bug['invariant']}: " not in failure:
                missed.append((bug["name"], failure))
    assert missed == []
    for seed, day in sorted({(bug["seed"], bug["day"]) for bug in chosen}):
        assert soak_day(seed, day).failure == ""


def test_soak_names_replay_of_any_error(monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("lost")

    monkeypatch.setattr(soak, "_soak_day", fail)
    failure = run_soak(5, hours=48, first_day=3).failure
    assert failure.startswith("day 3, session 0: ZeroDivisionError: lost; skinrig soak --seed 5")


def test_planted_lines_without_change_change_nothing():
    bug = BUGS[0]
    with planted(bug["file"], "\n\n" + text_of(ROOT / bug["file"])) as changed:
        assert changed == 0


@pytest.mark.long
def test_soak_of_fixed_seed_keeps_all_promises():
    for day in range(FIRST_DAY, FIRST_DAY + N_SOAKED_DAYS):
        result = soak_day(SEED, day)
        assert result.failure == ""
        assert result.days == 1
        assert result.shots > 0
