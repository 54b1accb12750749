"""Maps of a state are compared with the truth of that state."""

import numpy as np
import pytest

from model import store
from model.skin import SkinAppearance, SkinMap
from skinrig.appearances.state_truth import truth_beside, truth_of_state


def write(folder, state):
    values = SkinMap(np.zeros((2, 2), np.float32), "1")
    store.write(
        folder,
        SkinAppearance({"mask": values}, "simulated", parameters={"kind": "truth", "state": state}),
    )


@pytest.fixture
def session(tmp_path):
    write(tmp_path / "truth-face", "neutral")
    write(tmp_path / "truth-face-smile", "smile")
    return tmp_path / "session-face"


def test_each_state_has_its_own_and_what_has_none_has_no_others(session):
    assert truth_beside(session).name == "truth-face"
    assert truth_beside(session, "smile").name == "truth-face-smile"
    assert truth_beside(session, "anger") is None


def test_a_session_that_begins_with_a_state_has_its_truth_without_a_suffix(tmp_path):
    write(tmp_path / "truth-face", "smile")
    write(tmp_path / "truth-face-neutral", "neutral")
    session = tmp_path / "session-face"
    assert truth_beside(session, "smile").name == "truth-face"
    assert truth_beside(session).name == "truth-face-neutral"


def test_where_no_state_is_asked_for_a_sessions_own_will_do(tmp_path):
    session = tmp_path / "session-face"
    assert truth_beside(session) is None
    write(tmp_path / "truth-face", "hot")
    assert truth_of_state(session, "neutral") is None
    assert truth_beside(session).name == "truth-face"
