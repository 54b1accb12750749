"""Maps of a state are compared with the truth of that state."""

import numpy as np
import pytest

from model import store
from model.skin import SkinAppearance, SkinMap
from skinrig.appearances.state_truth import find_comparison_truth, find_state_truth


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


def test_state_truth_is_own_or_missing_never_other(session):
    assert find_comparison_truth(session).name == "truth-face"
    assert find_comparison_truth(session, "smile").name == "truth-face-smile"
    assert find_comparison_truth(session, "anger") is None


def test_first_state_truth_of_session_has_no_suffix(tmp_path):
    write(tmp_path / "truth-face", "smile")
    write(tmp_path / "truth-face-neutral", "neutral")
    session = tmp_path / "session-face"
    assert find_comparison_truth(session, "smile").name == "truth-face"
    assert find_comparison_truth(session).name == "truth-face-neutral"


def test_truth_without_requested_state_is_session_truth(tmp_path):
    session = tmp_path / "session-face"
    assert find_comparison_truth(session) is None
    write(tmp_path / "truth-face", "hot")
    assert find_state_truth(session, "neutral") is None
    assert find_comparison_truth(session).name == "truth-face"
