"""Faults of polarized pairs and gradient patterns over surfaces, tones, exposures and faults."""

import numpy as np
import pytest
from fixtures.faulty_patterns import PATTERN_FAULTS, make_pair, make_patterns
from fixtures.faulty_stacks import TONES
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruction.normal_maps import PhotometricStereoError
from reconstruction.stack_diagnosis import pattern_faults

FEW = settings(derandomize=True, deadline=None, max_examples=8, database=None)
VERY_FEW = settings(FEW, max_examples=3)
SEED = st.integers(0, 9999)
TONE = st.sampled_from(sorted(TONES))


@FEW
@given(seed=SEED, tone=TONE, unit=st.sampled_from([1e-6, 1.0, 1e6]))
def test_exchanged_pair_is_found_in_any_unit(seed, tone, unit):
    parallel, crossed, inside = make_pair("", seed, tone=tone, side=48)
    parallel, crossed = unit * parallel, unit * crossed
    assert not list(pattern_faults.find_exchanged_pair(parallel, crossed, inside))
    (one,) = pattern_faults.find_exchanged_pair(crossed, parallel, inside)
    assert (one.fault, one.frames) == ("exchanged polarizers", (0, 1))


@pytest.mark.parametrize("fault", [one for one in PATTERN_FAULTS if one != "x and -x"])
@VERY_FEW
@given(seed=SEED, tone=TONE, unit=st.sampled_from([1e-6, 1.0, 1e6]))
def test_faulty_pattern_is_named_in_any_unit(fault, seed, tone, unit):
    images, inside, names = make_patterns(fault, seed, tone=tone, side=48)
    images = {name: unit * image for name, image in images.items()}
    found = list(pattern_faults.find_pattern_faults(images, inside))
    numbers = tuple(sorted(pattern_faults.PATTERN_NAMES.index(name) for name in names))
    assert numbers in [one.frames for one in found]


@FEW
@given(seed=SEED, tone=TONE)
def test_sound_patterns_have_no_finding(seed, tone):
    images, inside, _ = make_patterns("", seed, tone=tone, side=48)
    assert not list(pattern_faults.find_pattern_faults(images, inside))
    four = {name: images[name] for name in pattern_faults.PATTERN_NAMES[:4]}
    assert not list(pattern_faults.find_pattern_faults(four, inside))
    nothing = np.zeros(inside.shape, bool)
    assert not list(pattern_faults.find_pattern_faults(images, nothing))


def test_flipped_axis_of_ball_is_named():
    images, inside, names = make_patterns("x and -x", 2, side=48)  # seed 2: a ball
    (one,) = pattern_faults.find_pattern_faults(images, inside)
    assert one.frames == tuple(sorted(pattern_faults.PATTERN_NAMES.index(name) for name in names))
    assert "(-x, y, z)" in one.remedy


def test_unknown_pattern_or_shape_is_refused():
    image, inside = np.ones((8, 8)), np.ones((8, 8), bool)
    with pytest.raises(PhotometricStereoError, match="images: got 'w'"):
        list(pattern_faults.find_pattern_faults({"w": image}, inside))
    with pytest.raises(PhotometricStereoError, match="crossed"):
        list(pattern_faults.find_exchanged_pair(image, image[:4], inside))
