"""Effects omitted from a simulation by the names in its list of effects."""

import dataclasses

import pytest

from capture.plan import flash_plan
from capture.rig import load_rig
from capture.session import Session
from rigsim.needs.effects import SceneEffects
from skinrig.simulating.effect_omission import SWITCHES_BY_RIG
from skinrig.simulating.orders import SimulationError
from skinrig.simulating.simulation import simulate_session


@pytest.mark.parametrize("rig", SWITCHES_BY_RIG)
def test_every_name_is_an_effect_that_scenes_take(rig):
    for name in SWITCHES_BY_RIG[rig]:
        asked = dataclasses.asdict(SceneEffects.from_switches({name: False}))
        assert list(asked.values()).count(False) == 1


@pytest.mark.long
def test_omitted_flash_effects_are_reported_by_name(tmp_path):
    rig = load_rig("flash").resized(48)
    asked = {"width_px": 48, "plan": flash_plan(rig), "leave_out": ("subsurface", "optics")}
    made = simulate_session("flash", tmp_path / "s", **asked)
    verdicts = {effect["switch"]: effect["verdict"] for effect in made.effects}
    assert verdicts["lateral"] == verdicts["optics"] == "asked"
    assert verdicts["interreflections"] == "built"
    noted = Session.open(tmp_path / "s").manifest.extra["simulation"]
    assert noted["leave_out"] == ["subsurface", "optics"]


@pytest.mark.parametrize(
    ("rig", "more", "match"),
    [
        ("flash", {"leave_out": ("shadow",)}, r"^--omit .*'shadow', expected for the flash rig"),
        ("gradient", {"leave_out": ("spectral",)}, "one of shadows, lateral, interreflections,"),
        ("probe", {"leave_out": ("optics",)}, "expected for the probe rig one of crosstalk"),
        ("dome", {"leave_out": ("lateral",), "subsurface": True}, "subsurface is also requested"),
        ("flash", {"leave_out": ("optics",), "target": "white"}, "not of a target"),
        ("dome", {"leave_out": ("optics",), "target": "white"}, "not of a target"),
    ],
)
def test_invalid_omission_is_refused_before_folder_creation(tmp_path, rig, more, match):
    with pytest.raises(SimulationError, match=match):
        simulate_session(rig, tmp_path / "s", **more)
    assert not (tmp_path / "s").exists()
