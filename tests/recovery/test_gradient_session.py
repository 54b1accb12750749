"""Sessions of the simulated gradient rig: what frames and truth say of one another."""

import itertools

import numpy as np
import pytest

from capture.plan.gradient import group_by_state, strain_state
from capture.session import Session, verify
from model import store
from skinrig.simulating.gradient import GripLog
from skinrig.simulating.orders import SimulationError
from skinrig.simulating.simulation import simulate_session

SMALL = {"width_px": 48, "angles": (0.0,), "steps": (-1, 1), "seed": 4}


pytestmark = pytest.mark.long


class Killed(BaseException):
    """The host is gone: nothing is told to anybody."""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    out = tmp_path_factory.mktemp("gradient") / "session-skin"
    return simulate_session("gradient", out, **SMALL)


def mean_dn(session, name, **index):
    """Mean of one frame of a state above black, DN."""
    for record in session.frames("gradient", **index):
        if strain_state(record.step) == name:
            return float(session.read(record).cfa.mean()) - 64.0
    raise AssertionError(name)


def test_skin_session_is_sound_and_truth_lists_states(made):
    session = Session.open(made.session)
    assert session.closed
    assert verify(made.session).ok
    truth = store.read(made.truth)
    captured = [name for name, _ in group_by_state(session.plan)]
    rows = truth.parameters["states"]
    assert [row["name"] for row in rows] == captured == ["a000_n0", "a000_m1", "a000_p1"]
    assert all(row["attached"] and not row["buckled"] for row in rows)
    for name in captured:
        assert truth.maps[f"height_{name}"].values.shape == (48, 48)
        assert truth.maps[f"normals_{name}"].values.shape == (48, 48, 3)
    assert truth.inputs["session"] == session.content_hash
    assert not list(made.session.parent.glob(".*grips*"))


def test_skin_displacement_is_smaller_than_jaw_displacement(made):
    rows = {row["name"]: row for row in store.read(made.truth).parameters["states"]}
    session = Session.open(made.session)
    assert rows["a000_n0"]["stretch_s"] == pytest.approx(1.0)
    for record in session.frames("gradient", pattern="full", polarizer="parallel"):
        row = rows[strain_state(record.step)]
        assert row["aperture_mm"] == pytest.approx(record.actual["aperture_mm"], abs=2e-3)
        reading = record.actual["aperture_mm"] / 8.0
        if reading != pytest.approx(1.0, abs=1e-3):
            assert 0.3 < (row["stretch_s"] - 1.0) / (reading - 1.0) < 0.999


def test_complementary_patterns_sum_to_full_light(made):
    """Of one state, dark subtracted: x + -x = full, within what energy and noise differ by."""
    session = Session.open(made.session)
    for name, polarizer in itertools.product(("a000_n0", "a000_p1"), ("parallel", "crossed")):
        dark = mean_dn(session, name, pattern="dark", polarizer=polarizer)
        full = mean_dn(session, name, pattern="full", polarizer=polarizer) - dark
        assert full > 100.0
        assert abs(dark) < 5.0
        for axis in "xyz":
            pair = sum(
                mean_dn(session, name, pattern=sign + axis, polarizer=polarizer) - dark
                for sign in ("", "-")
            )
            # each pattern's energy scatters by 0.1 %: 1 % is six sigma of the sum
            assert pair == pytest.approx(full, rel=0.01)


def test_a_wrong_pattern_would_not_add_up(made):
    """The test above can fail: x and y together are not full."""
    session = Session.open(made.session)
    dark, full, x, z = (
        mean_dn(session, "a000_n0", pattern=p, polarizer="parallel")
        for p in ("dark", "full", "x", "z")
    )
    assert x + z - 2 * dark != pytest.approx(full - dark, rel=0.01)


def test_crossed_images_lack_surface_reflection(made):
    session = Session.open(made.session)
    dark, parallel, crossed = (
        mean_dn(session, "a000_n0", pattern=p, polarizer=q)
        for p, q in (("dark", "parallel"), ("full", "parallel"), ("full", "crossed"))
    )
    assert crossed - dark < 0.98 * (parallel - dark)


@pytest.mark.parametrize("commits", [3, 20])
def test_interrupted_simulation_resumes_same_settings_and_complete_truth(
    made, tmp_path, monkeypatch, commits
):
    out = tmp_path / "session-cut"
    honest, count = Session.commit_step, itertools.count(1)

    def commit(self, *args, **words):
        if next(count) > commits:
            raise Killed
        honest(self, *args, **words)

    with monkeypatch.context() as patch:
        patch.setattr(Session, "commit_step", commit)
        with pytest.raises(Killed):
            simulate_session("gradient", out, **SMALL)
    assert len(Session.open(out).frames()) == commits
    with pytest.raises(SimulationError, match="resume with the same settings"):
        simulate_session("gradient", out, **{**SMALL, "seed": 5}, resume=True)
    again = simulate_session("gradient", out, **SMALL, resume=True)
    session = Session.open(out)
    assert verify(out).ok
    assert session.omitted_steps() == {}
    cut, whole = (store.read(path).parameters["states"] for path in (again.truth, made.truth))
    assert cut == whole  # the run is replayed: skin is not taped again
    tapings = {
        str(path): [(strain_state(r.step), r.actual["attachment"]) for r in frames("gradient")]
        for path, frames in (
            (out, session.frames),
            (made.session, Session.open(made.session).frames),
        )
    }
    assert tapings[str(out)] == tapings[str(made.session)]


def test_truth_with_lost_log_is_not_invented(made, tmp_path):
    session = Session.open(made.session)
    with pytest.raises(SimulationError, match="simulate a new session"):
        GripLog(None, tmp_path / "truth-skin", resume=True, session=session)


def test_log_of_other_times_is_refused(made, tmp_path):
    session = Session.open(made.session)
    truth = tmp_path / "truth-skin"
    (tmp_path / ".truth-skin.grips.jsonl").write_text('{"run": 1, "t_s": -5.0, "grip": {}}\n')
    with pytest.raises(SimulationError, match="has no entry for state a000_n0"):
        GripLog(None, truth, resume=True, session=session).list_grips(session)


def test_same_seed_same_frames(made, tmp_path):
    more = {**SMALL, "steps": (0, 0)}
    first, second = (
        Session.open(simulate_session("gradient", tmp_path / f"session-{k}", **more).session)
        for k in range(2)
    )
    for a, b in zip(first.frames(), second.frames(), strict=True):
        np.testing.assert_array_equal(first.read(a).cfa, second.read(b).cfa)
        assert a.actual == b.actual
