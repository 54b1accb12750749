"""Faults of polarized pairs and gradient patterns over surfaces, tones, exposures and faults."""

import numpy as np
import pytest
from fixtures.faulty_patterns import PATTERN_FAULTS, make_pair, make_patterns
from fixtures.faulty_stacks import TONES
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruction.normal_maps import PhotometricStereoError
from reconstruction.stack_diagnosis import pattern_faults
from reconstruction.stack_diagnosis.polarized_pairs import find_pair_faults

FEW = settings(derandomize=True, deadline=None, max_examples=8, database=None)
VERY_FEW = settings(FEW, max_examples=3)
SEED = st.integers(0, 9999)
TONE = st.sampled_from(sorted(TONES))


@FEW
@given(seed=SEED, tone=TONE, unit=st.sampled_from([1e-6, 1.0, 1e6]), gray=st.booleans())
def test_exchanged_pair_is_found_in_any_unit(seed, tone, unit, gray):
    parallel, crossed, inside = make_pair("", seed, tone=tone, side=48, gray=gray)
    parallel, crossed = unit * parallel, unit * crossed
    assert not list(find_pair_faults(parallel, crossed, inside))
    highlights = np.quantile((parallel - crossed)[inside], 0.99) / np.quantile(
        parallel[inside], 0.95
    )
    found = [one.fault for one in find_pair_faults(crossed, parallel, inside)]
    assert found == ["exchanged polarizers"] or highlights < 0.1


@FEW
@given(seed=SEED, tone=TONE, ratio=st.sampled_from([0.4, 0.6, 1.7, 3.0]))
def test_unequal_exposures_of_colored_pair_are_measured(seed, tone, ratio):
    parallel, crossed, inside = make_pair("", seed, tone=tone, side=48)
    (one,) = find_pair_faults(ratio * parallel, crossed, inside)
    assert (one.fault, one.frames) == ("unequal exposures", (0, 1))
    np.testing.assert_allclose(np.exp(one.measured), max(ratio, 1 / ratio), rtol=0.12)


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
        list(find_pair_faults(image, image[:4], inside))
