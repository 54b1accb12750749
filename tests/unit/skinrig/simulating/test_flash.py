"""The simulated flash rig as it is asked for: where the face stands, what is said of it."""

import pytest

from capture.session import Session
from model import store
from skinrig.simulating.orders import SimulationError
from skinrig.simulating.simulation import simulate_session


def test_face_position_is_in_session_and_truth(tmp_path):
    done = simulate_session(
        "flash",
        tmp_path / "session-far",
        subject="II",
        width_px=64,
        nearer_mm=-40.0,
        leave_out=("lateral", "interreflections", "optics"),
    )
    asked = Session.open(done.session).manifest.extra["simulation"]
    truth = store.read(done.truth)
    assert asked["nearer_mm"] == -40.0
    assert truth.parameters["nearer_mm"] == pytest.approx(-40.0)
    skin = truth.maps["mask"].values > 0.5
    # a face at the tile's place reaches from 25 mm before the origin back to its ears
    assert truth.maps["position_mm"].values[skin][:, 2].max() < -10.0


@pytest.mark.parametrize(
    ("rig", "asked", "told"),
    [
        ("flash", {"nearer_mm": 500.0}, "got 500 mm, expected -500 to 500 mm"),
        ("flash", {"nearer_mm": float("nan")}, "got nan, expected a finite distance"),
        ("flash", {"nearer_mm": 9.0, "target": "white"}, "not of a target"),
        ("dome", {"nearer_mm": 9.0}, "not an option of the dome rig"),
        ("probe", {"nearer_mm": 9.0}, "not an option of the probe rig"),
    ],
)
def test_impossible_face_position_is_refused_before_folder_creation(tmp_path, rig, asked, told):
    with pytest.raises(SimulationError, match=f"^nearer: .*{told}"):
        simulate_session(rig, tmp_path / "session", width_px=64, **asked)
    assert not (tmp_path / "session").exists()


def test_sequence_has_no_own_position(tmp_path):
    from skinrig.capturing.sequences import SequenceOrder

    order = SequenceOrder(state="smile")
    with pytest.raises(SimulationError, match=r"nearer: .* not of a sequence"):
        simulate_session("flash", tmp_path / "session", sequence=order, nearer_mm=9.0)
