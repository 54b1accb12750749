"""Sequences of the flash rig through the real drivers: shots and prompts at their times."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from capture.acquire import Operator, run_plan
from capture.devices.camera import open_camera
from capture.devices.flash import FlashBox
from capture.devices.port import Port
from capture.plan.multiplexed import course_plan, multiplexed_plan
from capture.rig import load_rig
from capture.session import Session, SubjectRecord
from rigsim.boxes.faults import Faults
from rigsim.world import World

RIG = load_rig("flash").resized(32)


class Stop(Exception):
    """The host is switched off."""


def run(path, plan, *, faults=None, stop_after=None, resume=False, host_s=1e9):
    """Run a plan on a world without light; return the session, the prompts heard, and the world."""
    if resume:
        session = Session.resume(path)
    else:
        session = Session.create(
            path,
            plan=plan,
            rig=RIG,
            devices={},
            subject=SubjectRecord("nobody", ("research",)),
            source="simulated",
            seed=0,
        )
    world = World(RIG, seed=1, faults=faults)
    name = world.register(session.id)
    heard, lines = [], []

    def progress(line):
        lines.append(line)
        if stop_after is not None and len(lines) > stop_after:
            raise Stop

    box = FlashBox(Port(f"sim://flash?world={name}", clock=world.clock, first_seq=1))
    camera = open_camera(f"sim://{name}/cam")
    try:
        run_plan(
            session.plan,
            RIG,
            boxes={"flash": box},
            cameras={"cam": camera},
            session=session,
            operator=Operator(
                progress=progress,
                signal=lambda state: heard.append((world.now, state)),
                timer=world.clock,
                clock=lambda: host_s + world.now,
                run_id="run",
            ),
        )
        session.close()
    except Stop:
        pass
    finally:
        camera.close()
        box.close()
        world.unregister()
        session.release()
    return Session.open(path), heard, world


def noted(session, key):
    return np.array([r.line.actual[key] for r in session.frames("subject")], float)


def planned(session):
    return np.array([r.step.settings["start_s"] for r in session.frames("subject")], float)


def test_shots_and_prompts_keep_periods_at_published_rate(tmp_path):
    session, heard, world = run(tmp_path / "s", multiplexed_plan(RIG, darks=1))
    assert len(session.frames("subject")) == 22
    late = noted(session, "time_s") - planned(session)
    assert np.all((late > 0) & (late < 0.02))
    assert noted(session, "late_s") == pytest.approx(late, abs=1e-9)
    # what the box says of its pops is what the world saw
    popped = np.array([pop.t_s for pop in world.pops])
    assert np.diff(popped) == pytest.approx(np.diff(noted(session, "time_s")), abs=2e-3)
    assert np.diff([t for t, _ in heard]) == pytest.approx(5.0, abs=1e-3)
    assert {(a, b) for (_, a), (_, b) in pairwise(heard)} == {
        ("smile", "neutral"),
        ("neutral", "smile"),
    }
    phases = noted(session, "phase_s")
    assert phases == pytest.approx(planned(session) % 10.0, abs=0.03)
    # before the first shot the subject has had a cycle to find the rhythm
    assert sum(t < popped[0] for t, _ in heard) == 3


@pytest.mark.parametrize("period", ["10.25", "6.1", "7.3"])
def test_no_period_stops_the_clock(tmp_path, period):
    plan = multiplexed_plan(RIG, shot_period_s=period, captures=15, darks=0)
    session, heard, _ = run(tmp_path / "s", plan)
    assert noted(session, "late_s").max() < 0.05
    assert np.diff([t for t, _ in heard]) == pytest.approx(5.0, abs=0.12)


def test_late_shot_is_recorded_with_true_time(tmp_path):
    # packs that charge four times as slowly hold shots up
    plan = multiplexed_plan(RIG, captures=8, darks=0)
    session, _, world = run(tmp_path / "s", plan, faults=Faults(slow_charge=4.5))
    late = noted(session, "late_s")
    assert late.max() > 0.5
    truth = np.array([pop.t_s for pop in world.pops])
    assert np.diff(noted(session, "time_s")) == pytest.approx(np.diff(truth), abs=5e-3)
    phases = {r.step_id: r.line.actual["phase_s"] for r in session.frames("subject")}
    planned = {step.id: float(step.index["phase_s"]) for step in plan.steps}
    assert sorted(phases, key=phases.__getitem__) != sorted(phases, key=planned.__getitem__)


def test_a_misfire_is_taken_again_whole_cycles_later(tmp_path):
    plan = multiplexed_plan(RIG, captures=10, darks=0)
    session, _, _ = run(tmp_path / "s", plan, faults=Faults(misfire=0.2))
    tries = noted(session, "tries")
    again = tries > 1
    assert again.any()
    assert not again.all()
    shift = noted(session, "time_s") - planned(session)
    assert shift[~again] == pytest.approx(0.0, abs=0.1)
    cycles = shift[again] / 10.0
    assert cycles == pytest.approx(np.round(cycles), abs=0.02)
    assert np.all(np.round(cycles) >= 1)
    assert noted(session, "phase_s") == pytest.approx(planned(session) % 10, abs=0.15)


def test_resumed_sequence_leads_in_and_meets_missing_phases(tmp_path):
    plan = multiplexed_plan(RIG, captures=12, darks=1)
    broken, _, _ = run(tmp_path / "s", plan, stop_after=6)
    assert 0 < len(broken.frames("subject")) < 12
    session, heard, world = run(tmp_path / "s", plan, resume=True)
    assert len(session.frames("subject")) == 12
    block = noted(session, "block")
    assert sorted(set(block)) == [0, 1]
    assert noted(session, "phase_s") == pytest.approx(planned(session) % 10, abs=0.03)
    assert noted(session, "time_s") == pytest.approx(planned(session), abs=0.03)
    first = next(pop.t_s for pop in world.pops)
    assert first - heard[0][0] >= 10.0


def test_steps_after_event_are_skipped_once_time_passed(tmp_path):
    plan = course_plan(RIG, before=1, darks=0)
    broken, heard, _ = run(tmp_path / "s", plan, stop_after=4)
    assert heard == []
    taken = len(broken.frames("subject"))
    session, _, _ = run(tmp_path / "s", plan, resume=True, host_s=1e9 + 40.0)
    kept = [r for r in session.frames("subject") if "time_s" in r.line.actual]
    assert len(session.omitted_steps()) > 0
    assert len(session.omitted_steps()) + len(session.frames("subject")) == 12
    assert len(kept) + 1 > taken
    late = [r.line.actual["time_s"] - r.step.settings["start_s"] for r in kept]
    assert np.max(np.abs(late)) < 0.05
    assert all("passed" in why for why in session.omitted_steps().values())


def test_shots_before_event_have_no_time_come_first(tmp_path):
    session, _, world = run(tmp_path / "s", course_plan(RIG, before=2, darks=1))
    records = session.frames("subject")
    assert ["time_s" in r.line.actual for r in records] == [False, False] + [True] * 11
    assert len(world.pops) == 13
