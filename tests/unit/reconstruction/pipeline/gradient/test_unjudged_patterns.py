"""Findings about patterns name only images that exist, and a bad state stops no other one."""

from types import SimpleNamespace

import numpy as np
import pytest

from capture.plan.gradient import gradient_plan
from capture.rig import load_rig
from reconstruction.pipeline.diagnosed_images import DiagnosedImages, renumber
from reconstruction.pipeline.gradient import pattern_diagnosis
from reconstruction.pipeline.gradient.images import GradientImages, SkinState, StatePatterns
from reconstruction.pipeline.inputs import InputsError
from reconstruction.stack_diagnosis import Finding

SHAPE = 32, 32
KEYS = [(name, light) for light in ("parallel", "crossed") for name in ("full", "x", "y", "z")]


def make_patterns():
    image = np.full(SHAPE, 0.5, np.float32)
    return StatePatterns(dict.fromkeys(KEYS, image), {}, np.ones(SHAPE, bool))


class States:
    """Images of three states, of which the second one cannot be judged."""

    states = tuple(SkinState(name, 0.0, 0, np.nan, np.nan) for name in "abc")

    def of(self, state):
        if state.name == "b":
            raise InputsError("state b: got no lit image")
        return make_patterns()


class PlannedSession:
    """A session with a plan of another state."""

    plan = gradient_plan(load_rig("gradient").resized(32), angles=[0.0], steps=(0, 0))
    path = "s"

    def omitted_steps(self):
        return ()


def find(*frames):
    return Finding("exchanged patterns", frames, "normals turn", 2.0, 1.0, "exchange them")


def test_absent_patterns_are_not_named(monkeypatch):
    axes = find(1, 2, 4, 5)  # x, y and their inverses, which are not in the session
    monkeypatch.setattr(pattern_diagnosis, "find_pattern_faults", lambda *_, **__: (axes,))
    found = pattern_diagnosis.diagnose_state(make_patterns(), (), name="a")
    named = [[found.names[k] for k in one.frames] for one in found.findings]
    assert named == [[f"a {light} x", f"a {light} y"] for light in ("parallel", "crossed")]


def test_negative_numbers_of_images_are_refused():
    with pytest.raises(ValueError, match="expected none below 0"):
        renumber([find(0, 1)], [3, -1])
    with pytest.raises(ValueError, match="expected none below 0"):
        renumber([find(-1)], [3, 4])
    assert renumber([find(1, 0)], [3, 4])[0].frames == (3, 4)


def test_unjudged_state_is_noted_and_skipped(monkeypatch):
    monkeypatch.setattr(pattern_diagnosis, "find_pattern_faults", lambda *_, **__: ())
    found = pattern_diagnosis.diagnose_states(States(), PlannedSession())
    assert {name.split()[0] for name in found.names} == {"a", "c"}
    assert found.assumed == ("the patterns of b were not compared: state b: got no lit image",)
    inputs = SimpleNamespace(noted={}, assumed=["before"])
    found.record_in(inputs)
    assert inputs.assumed == ["before", *found.assumed]


def test_session_without_judged_state_is_refused(monkeypatch):
    nothing = DiagnosedImages((), (), (), assumed=("the patterns of a were not compared",))
    monkeypatch.setattr(pattern_diagnosis, "GradientImages", lambda _: None)
    monkeypatch.setattr(pattern_diagnosis, "diagnose_states", lambda *_: nothing)
    with pytest.raises(InputsError, match="s: the patterns of a were not compared"):
        pattern_diagnosis.diagnose_patterns(PlannedSession())


def test_frames_of_two_sizes_are_refused(monkeypatch):
    images = object.__new__(GradientImages)
    images._records = {"a": {("x", "crossed"): [32], ("y", "crossed"): [16]}}
    images._dark_variance = 0.0
    monkeypatch.setattr(images, "_darkness", lambda: None, raising=False)

    def mean(records):
        image = np.zeros((records[0], 32), np.float32)
        return image, image, image == 0

    monkeypatch.setattr(images, "_mean", mean, raising=False)
    with pytest.raises(InputsError, match="differ in size"):
        images.of(States.states[0])
