"""The flash rig's images by closed forms against Mitsuba's path tracer through polarizing films."""

import numpy as np
import pytest
from scipy import stats

from rigsim.render import Caster
from rigsim.render.variant import choose_variant
from rigsim.scenes.flash import polarizer_reference as reference

pytestmark = pytest.mark.render

FALSE_ALARM = 1e-3  # for all blocks of both images together


@pytest.fixture(scope="module", autouse=True)
def _needs_a_fast_polarized_variant() -> None:
    choice = choose_variant("mono_polarized")
    if not choice.is_vectorized:
        pytest.skip(f"scalar variants take minutes: {choice.why}")


@pytest.mark.parametrize("name", ["parallel", "crossed"])
def test_image_blocks_match_path_tracer_within_noise(name):
    """Rationale: filters, Fresnel, GGX, both lights, geometry and units at once.

    Expected: block means of ours within the path tracer's standard error, which comes from 12
    independent seeds. Tolerance: Student's t with Sidak's correction over the
    blocks of both images.
    """
    rig, view = reference.reference_rig(128)
    caster = Caster(reference.sphere_mesh(), choice=choose_variant("mono_polarized"))
    ours = reference.render_closed_forms(rig, view, caster, subpixels=4)[name]
    seeds = np.stack(
        [
            reference.render_polarized_with_mitsuba(rig, view, name, samples=16, seed=seed + 1)
            for seed in range(12)
        ]
    )

    def blocks(images: np.ndarray) -> np.ndarray:
        return images.reshape(*images.shape[:-2], 8, 16, 8, 16).mean(axis=(-3, -1))

    middle = blocks(np.minimum(ours, seeds.min(axis=0)) > 0.0) == 1.0  # no background in them
    assert middle.sum() >= 24
    theirs, one = blocks(seeds)[:, middle], blocks(ours)[middle]
    stderr = theirs.std(axis=0, ddof=1) / np.sqrt(len(seeds))
    t = (one - theirs.mean(axis=0)) / stderr
    per_block = 1.0 - (1.0 - FALSE_ALARM) ** (1.0 / (2 * t.size))
    assert np.abs(t).max() < stats.t.isf(per_block / 2, len(seeds) - 1)

    # The test can fail: two percent more light is noticed.
    wrong = (1.02 * one - theirs.mean(axis=0)) / stderr
    assert np.abs(wrong).max() > stats.t.isf(per_block / 2, len(seeds) - 1)


@pytest.mark.long
def test_image_pair_beats_path_tracer_speed_and_noise():
    result = reference.compare_polarizer_models(width_px=256, samples=64)
    assert result.speed_up >= 8.0
    assert result.noise_ratio >= 20.0
    for name in reference.ANALYZER_AXIS_DEG:
        # 2.8 % of noise over 50,000 pixels: 1.3e-4 of the mean.
        assert result.mean_ratio[name] == pytest.approx(1.0, abs=8e-4)
