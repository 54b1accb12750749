"""Reliefs under strain by kernels, against skin whose stiff layer came to rest; two passes as one.

Rationale: the truth minimises the energy of a layer on soft tissue and knows of no kernel. Kernels
are fitted to other patches of the same site, as from caliper sessions.
Expected: the distribution of normals comes nearer to the truth's than a relief that does not
change, under every stretch; kernels of the opposite strain take it farther away.
"""

import numpy as np
import pytest

from reconstruction import normal_histogram
from rigsim.skin_patch.microrelief import make_micro_skin
from rigsim.skin_patch.stretch import stretch_skin
from skinrig.benchmarks.gradient_rig.microstructure import (
    TEXEL_UM,
    fit_kernel_table,
    measure_two_pass_error,
    strain_relief,
    strained_slopes,
)


def skin(seed, size_mm=2.0):
    return make_micro_skin("forehead", seed=seed, size_mm=size_mm, texel_um=TEXEL_UM)


def off(truth, relief, state):
    return normal_histogram.distance(
        normal_histogram.from_slopes(*strained_slopes(truth, state)),
        normal_histogram.from_slopes(*strained_slopes(relief, state)),
    )


@pytest.fixture(scope="module")
def table():
    return fit_kernel_table([skin(1)], (0.8, 0.9, 1.1, 1.22), every=2)


@pytest.mark.long
@pytest.mark.parametrize("angle_deg", [0.0, 35.0])
@pytest.mark.parametrize("stretch", [0.84, 1.18])
def test_fitted_kernels_bring_normals_nearer_settled_skin(table, stretch, angle_deg):
    unseen = skin(5)
    state = stretch_skin(unseen, stretch=stretch, angle_deg=angle_deg, compensation="none")
    static = off(state.height_um, unseen.height_um, state)
    # two patches of one kind of skin differ by about 0.05 already
    assert off(state.height_um, strain_relief(unseen, state, table, "cubic"), state) < 0.6 * static
    opposite = stretch_skin(unseen, stretch=2.0 - stretch, angle_deg=angle_deg, compensation="none")
    wrong = strain_relief(unseen, opposite, table, "cubic")
    assert off(state.height_um, wrong, state) > 1.2 * static


@pytest.mark.long
def test_stretch_smooths_and_compression_roughens_along_jaws_only(table):
    unseen = skin(6)
    before = strained_slopes(unseen.height_um, stretch_skin(unseen, stretch=1.0, angle_deg=0.0))
    for stretch in (0.84, 1.18):
        state = stretch_skin(unseen, stretch=stretch, angle_deg=0.0, compensation="none")
        after = strained_slopes(strain_relief(unseen, state, table, "cubic"), state)
        truth = strained_slopes(state.height_um, state)
        along, across = (np.log(after[i].var() / before[i].var()) for i in (0, 1))
        assert np.sign(along) == np.sign(1.0 - stretch)
        assert abs(across) < 0.5 * abs(along)
        assert abs(np.log(after[0].var() / truth[0].var())) < 0.5 * abs(along)


def test_constant_kernels_make_two_passes_exact_convolution(rng):
    for sigma_px, limit in ((1.5, 0.008), (3.0, 0.002)):
        error, _ = measure_two_pass_error(rotation_rad=0.0, growth=0.0, sigma_px=sigma_px, rng=rng)
        assert error < limit


def test_two_pass_error_grows_with_kernel_variation():
    def error(turn, growth):
        rng = np.random.default_rng(3)  # the same waves for all
        return measure_two_pass_error(rotation_rad=turn, growth=growth, side=120, rng=rng)[0]

    turning = [error(turn, 0.0) for turn in (0.05, 0.1, 0.2)]
    # to first order proportional to the turn; a sampling error would not grow at all
    assert turning[1] / turning[0] == pytest.approx(2.0, rel=0.25)
    assert turning[2] / turning[1] == pytest.approx(2.0, rel=0.25)
    assert error(0.0, 0.04) < 0.02
    assert error(0.0, 0.2) > 3.0 * error(0.0, 0.04)
