"""Faults of images under listed lights are named with the right images; sound sets have none."""

import csv
import re
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fixtures.faulty_patterns import PAIR_FAULTS, PATTERN_FAULTS, make_pair, make_patterns
from fixtures.faulty_stacks import FAULTS, GRADED, make

from model.metrics import angular_error_rad
from reconstruction.normal_maps import PhotometricStereoError
from reconstruction.photometric_stereo import estimate_normals
from reconstruction.stack_diagnosis import diagnose_stack, diagnosis, light_labels, moved_images
from reconstruction.stack_diagnosis.shading_space import Agreement

LONG = pytest.mark.long
"""Of further seeds at which a rule once failed; the first of each kind is not long."""
NAMED_ALONE = {"two swapped", "dim", "zeros", "dark", "half of zeros", "mirrored"}
"""Faults from which nothing else follows: no other finding is expected."""


def named(stack):
    return [(one.fault, one.frames) for one in diagnose(stack).findings]


def diagnose(stack, **options):
    return diagnose_stack(
        stack.images, stack.lights, usable=stack.images < 0.998, inside=stack.inside,
        rng=np.random.default_rng(0), **options,
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_found_with_its_images(fault):
    stack = make(fault, 300, side=64, count=12)
    found = diagnose(stack)
    named = {(one.fault, one.frames) for one in found.findings}
    assert (FAULTS[fault], stack.frames) in named, named
    assert all(one.ratio_to_limit >= 1.0 for one in found.findings)
    if fault in NAMED_ALONE:
        assert len(named) == 1, named


@pytest.mark.parametrize(("seed", "rig"), [(20148, "flash"), (20146, "dome")])
def test_exchanged_neighbors_are_named_alone(seed, rig):
    """The last two of a list exchanged are no other order; the second's angle may be small."""
    stack = make("two swapped", seed, side=64, severity=15, rig=rig, tone="dark")
    (only,) = diagnose(stack).findings
    assert (only.fault, only.frames) == ("swapped lights", stack.frames)
    assert only.ratio_to_limit >= 1.0


def test_swapped_lights_are_measured_by_larger_angle():
    """Lights on an arc: one of the pair is 10 degrees from its row, the other only 5 of 6."""
    rows, seen = (
        np.array([[np.sin(a), 0.0, np.cos(a)] for a in np.radians(degrees)])
        for degrees in ([0.0, 8.0, 30.0, 50.0, -40.0], [10.0, 3.0, 30.0, 50.0, -40.0])
    )
    angle_deg = np.degrees(np.arccos(np.clip((rows * seen).sum(axis=1), -1.0, 1.0)))
    agreement = Agreement(seen, np.ones(5), angle_deg, 6.0, 0.01)
    (only,) = light_labels._explain_wrong([0], np.arange(5), agreement, rows)
    assert (only.fault, only.frames, only.order) == ("swapped lights", (0, 1), (1, 0, 2, 3, 4))
    assert only.ratio_to_limit == pytest.approx(10.0 / 6.0)


def test_flicker_is_found_beyond_its_severity():
    stack = make("flicker", 30100, side=64, severity=0.1, rig="flash", tone="medium")
    assert [one.fault for one in diagnose(stack).findings] == ["rolling flicker"]


@pytest.mark.parametrize("seed", [310, *(pytest.param(n, marks=LONG) for n in (311, 312))])
def test_sound_images_have_no_finding(seed):
    assert diagnose(make("", seed, side=64)).findings == ()


@pytest.mark.parametrize("gain", [1e-30, 1e30])
def test_unit_of_floating_point_images_does_not_matter(gain):
    stack = make("two swapped", 300, side=64, count=12)
    unit = stack.images * gain
    unit[3, 5, 5] = np.nan
    found = diagnose_stack(
        unit, stack.lights, inside=stack.inside, rng=np.random.default_rng(0)
    )  # fmt: skip
    assert {one.frames for one in found.findings if one.fault == "swapped lights"} == {stack.frames}


def test_proposed_order_restores_the_normals():
    """Rationale: a finding is worth its remedy. Expected: within 1 degree of the right list's."""
    stack, right = (make(fault, 301, side=64, count=24) for fault in ("shifted", ""))
    normals = [
        estimate_normals(images, lights, valid=stack.inside)
        for images, lights in (
            (stack.images, stack.lights[diagnose(stack).order]),
            (stack.images, stack.lights),
            (right.images, right.lights),
        )
    ]
    seen = stack.inside & np.logical_and.reduce([one.valid for one in normals])
    corrected, listed = (
        np.degrees(angular_error_rad(one.normals[seen], normals[2].normals[seen])).mean()
        for one in normals[:2]
    )
    assert corrected < 1.0
    assert listed > 3.0


@pytest.mark.parametrize(
    ("fault", "seed", "rig", "tone", "severity"),
    [
        ("moved", 110561, "gradient", "light", 5.0),  # a ball: its shading follows the shift
        pytest.param("moved", 110216, "dome", "dark", 2.0, marks=LONG),
        pytest.param("moved", 110474, "flash", "dark", 2.0, marks=LONG),
        ("moved", 122464, "gradient", "medium", 2.0),  # grazing light: most samples are dark
    ],
)
def test_move_of_smooth_object_is_found(fault, seed, rig, tone, severity):
    stack = make(fault, seed, rig=rig, tone=tone, severity=severity, side=64)
    (one,) = diagnose(stack).findings
    assert (one.fault, one.frames) == ("moved image", stack.frames)
    assert 0.5 * severity < one.measured < 1.5 * severity


@pytest.mark.parametrize("seed", [110524, *(pytest.param(n, marks=LONG) for n in (110677, 110683))])
def test_relief_under_grazing_light_is_sound(seed):
    """Most of its samples are in cast shadow: an image there fits nothing, wherever it is."""
    tone = "light" if seed == 110524 else "medium"
    assert diagnose(make("", seed, rig="gradient", tone=tone, side=64)).findings == ()


def test_text_names_images_among_all():
    """Rules see the images that are not left out; their texts count all images."""
    stack = make("one wrong", 300, side=64, count=12)
    (number,) = stack.frames
    empty = 0 if number else 1
    stack.images[empty] = 0.0
    found = {one.fault: one for one in diagnose(stack).findings}
    assert found["empty image"].frames == (empty,)
    assert found["wrong light"].frames == (number,)
    assert found["wrong light"].evidence.startswith(f"image {number + 1} is lit")


def test_few_images_refute_light_of_highlights(monkeypatch):
    """The other images' surface explains the image by its listed light, or does not."""
    stack = make("one wrong", 306, side=64, count=8)
    assert ("wrong light", stack.frames) in named(stack)
    listed = stack.lights.copy()
    sound = replace(stack, lights=make("", 306, side=64, count=8).lights)
    (number,) = stack.frames
    wrong = light_labels.Finding("wrong light", (number,), "", 12.0, 6.0, "")
    order = light_labels.find_order

    def suspect(*given):
        found, agreement, _ = order(*given)
        return found, agreement, [wrong]

    monkeypatch.setattr(diagnosis, "find_order", suspect)
    assert named(sound) == []
    assert ("wrong light", (number,)) in named(replace(stack, lights=listed))


def test_left_out_images_are_the_wrong_ones():
    for fault in ("zeros", "one wrong", "moved", "all lights on"):
        stack = make(fault, 300, side=64, count=12)
        assert tuple(np.flatnonzero(diagnose(stack).left_out)) == stack.frames


def test_shift_is_stated_in_pixels_of_images():
    """Images of twice the side have the same blocks, so that the shift is twice as large."""
    stack = make("moved", 300, side=96, count=12)
    large = replace(stack, images=stack.images.repeat(2, 1).repeat(2, 2),
                    inside=stack.inside.repeat(2, 0).repeat(2, 1))  # fmt: skip
    small, twice = (
        next(x for x in diagnose(one).findings if x.fault == "moved image")
        for one in (stack, large)
    )
    assert twice.frames == small.frames == stack.frames
    assert twice.measured == pytest.approx(2.0 * small.measured, rel=1e-6)
    assert twice.limit == pytest.approx(2.0 * small.limit)
    shift = [float(x) for x in re.findall(r"-?\d+\.\d", twice.evidence)[:2]]
    assert np.hypot(*shift) == pytest.approx(twice.measured, abs=0.1)


@pytest.mark.filterwarnings("error")
def test_image_of_few_lit_samples_is_not_compared():
    inside = np.ones((24, 24), bool)
    image = np.where(np.arange(24 * 24).reshape(24, 24) < 50, 0.5, 0.0)
    normals = np.broadcast_to([0.0, 0.0, 0.5], (24, 24, 3))
    usable = np.ones((2, 24, 24), bool)
    for images in (np.array([image, 0.0 * image]), -1.0 + 0.0 * np.array([image, image])):
        assert not list(
            moved_images.find_moved(images, usable, inside, normals, fit_without=lambda _: normals)
        )


def test_near_lists_are_not_judged_by_one_direction():
    stack = make("near", 300, side=64, count=12)
    assert diagnose(stack, near=True).findings == ()


@pytest.mark.parametrize(
    ("images", "lights", "message"),
    [
        (np.ones((5, 8, 8)), np.eye(3)[[0, 1, 2, 0, 1]], "5 images"),
        (np.zeros((8, 8, 8)), np.ones((8, 3)), "no light in any image"),
        (np.ones((8, 8, 8)), np.ones((7, 3)), "light_directions"),
        (np.full((8, 3, 3), 0.5), np.ones((8, 3)), "bright points"),
    ],
)
def test_unusable_stack_is_refused(images, lights, message):
    with pytest.raises(PhotometricStereoError, match=message):
        diagnose_stack(images, lights, rng=np.random.default_rng(0))


def test_empty_object_is_refused():
    with pytest.raises(PhotometricStereoError, match="inside: got no pixels"):
        diagnose_stack(
            np.ones((8, 8, 8)),
            np.ones((8, 3)),
            inside=np.zeros((8, 8), bool),
            rng=np.random.default_rng(0),
        )


def test_large_stacks_are_read_image_by_image():
    """Rationale: a stack may lie in a file. Expected: far less memory than one copy of it."""
    stack = make("", 310, side=64, count=12)
    images = stack.images.repeat(16, axis=1).repeat(16, axis=2)
    tracemalloc.start()
    diagnose_stack(images, stack.lights, rng=np.random.default_rng(0))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.6 * images.nbytes


@pytest.mark.long
def test_pain_suite_has_each_fault_of_the_diagnosis():
    table = Path(__file__).parents[4] / "tools" / "pain_suite.csv"
    rows = list(csv.DictReader(table.read_text().splitlines()))
    known = {"lights": GRADED, "pair": PAIR_FAULTS, "patterns": PATTERN_FAULTS}
    for images, faults in known.items():
        own = [row for row in rows if row["images"] == images]
        assert {row["fault"] for row in own} <= set(faults)
        stated = {faults[row["fault"]] for row in own if row["stated"] == "yes"}
        assert stated == set(faults.values())
    for row in rows:
        severity = float(row["severity"]) if row["severity"] else None
        makers = {"lights": make_stack, "pair": make_pair, "patterns": make_patterns}
        given = {"side": 24, "tone": "dark"} | ({"severity": severity} if severity else {})
        spoiled, sound = (makers[row["images"]](one, 0, **given) for one in (row["fault"], ""))
        assert not is_equal(spoiled, sound), row


def make_stack(fault, seed, **given):
    stack = make(fault, seed, rig="flash", **(given if fault else given | {"severity": None}))
    return stack.images, stack.lights


def is_equal(one, other):
    """Return whether two made sets have the same images."""
    a, b = (
        list(x.values()) if isinstance(x, dict) else list(np.asarray(x)) for x in (one[0], other[0])
    )
    images = len(a) == len(b) and all(map(np.array_equal, a, b))
    return images and np.array_equal(one[1], other[1])


@pytest.mark.long
def test_detection_and_false_alarms_over_seeds():
    """Rationale: seeds 400 on set no threshold.

    Expected: all faults but one found, all but two with the right images, 1 false alarm in 15
    sound sets at most. `tools/judge_diagnosis.py` counts over more seeds.
    """
    found = named = total = 0
    for number, fault in enumerate(FAULTS):
        stack = make(fault, 400 + 3 * number, side=64)
        faults = {(one.fault, one.frames) for one in diagnose(stack).findings}
        total += 1
        found += FAULTS[fault] in {one for one, _ in faults}
        named += (FAULTS[fault], stack.frames) in faults
    alarms = sum(bool(diagnose(make("", seed, side=64)).findings) for seed in range(700, 715))
    assert found >= total - 1, (found, total)
    assert named >= total - 2, (named, total)
    assert alarms <= 1
