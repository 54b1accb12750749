"""The flash rig's images by `olat` against Mitsuba's path tracer through polarizing films."""

import numpy as np
import pytest
from scipy import stats

from rigsim.as_built.polarizers import Polarizers
from rigsim.mitsuba.scene_radiance import perspective, radiance
from rigsim.mitsuba.variant import choose_variant
from rigsim.scenes.flash import polarizer_reference as reference

pytestmark = pytest.mark.render

FALSE_ALARM = 1e-3  # for all blocks of both images together


@pytest.fixture(scope="module", autouse=True)
def _needs_a_fast_polarized_variant() -> None:
    choice = choose_variant("mono_polarized")
    if not choice.is_vectorized:
        pytest.skip(f"scalar variants take minutes: {choice.why}")


def block_deviation(image: np.ndarray, seeds: np.ndarray) -> float:
    """Return the largest deviation of 8 x 8 block means from those of seeds, over its limit."""
    side = image.shape[0] // 8

    def blocks(images: np.ndarray) -> np.ndarray:
        return images.reshape(*images.shape[:-2], 8, side, 8, side).mean(axis=(-3, -1))

    middle = blocks(np.minimum(image, seeds.min(axis=0)) > 0.0) == 1.0  # no background in them
    assert middle.sum() >= 24
    theirs, one = blocks(seeds)[:, middle], blocks(image)[middle]
    stderr = theirs.std(axis=0, ddof=1) / np.sqrt(len(seeds))
    t = (one - theirs.mean(axis=0)) / stderr
    per_block = 1.0 - (1.0 - FALSE_ALARM) ** (1.0 / (2 * t.size))
    return float(np.abs(t).max() / stats.t.isf(per_block / 2, len(seeds) - 1))


@pytest.mark.long
@pytest.mark.parametrize("name", ["parallel", "crossed"])
def test_image_blocks_match_path_tracer_within_noise(name):
    """Rationale: filters, Fresnel, GGX, both lights, geometry and units at once.

    Expected: block means of ours within the path tracer's standard error, which comes from 12
    independent seeds. Tolerance: Student's t with Sidak's correction over the
    blocks of both images.
    """
    rig, view = reference.reference_rig(128)
    ours = reference.render_by_olat(reference.plastic_sphere(rig), view, subpixels=4)[name]
    seeds = np.stack(
        [
            reference.render_polarized_with_mitsuba(rig, view, name, samples=16, seed=seed + 1)
            for seed in range(12)
        ]
    )

    assert block_deviation(ours, seeds) < 1.0
    assert block_deviation(1.02 * ours, seeds) > 1.0  # two percent more light is noticed


@pytest.mark.long
@pytest.mark.parametrize("name", ["parallel", "crossed"])
def test_own_scene_matches_path_tracer(name):
    """Rationale: the same `skincoat` and `ledarray`, with leaky polarizers, in a stock integrator
    of a polarized variant. Tolerance: as above, over the blocks of both images."""
    rig, view = reference.reference_rig(64)
    sphere = reference.plastic_sphere(rig, Polarizers(10.0, np.inf, 0.0))
    ours = reference.render_by_olat(sphere, view, subpixels=6)[name]
    scene = sphere.description | {
        "integrator": {"type": "volpath", "max_depth": 8},
        "sensor": perspective(view, "luminance", up=(0.0, 1.0, 0.0)),
        "analyzer": reference.describe_analyzer(view, reference.ANALYZER_AXIS_DEG[name]),
    }
    seeds = np.stack(
        [
            radiance(scene, kind="mono_polarized", samples=64, seed=seed + 1)[..., 0]
            for seed in range(12)
        ]
    )
    assert block_deviation(ours, seeds) < 1.0
    ideal = reference.render_by_olat(reference.plastic_sphere(rig), view, subpixels=6)[name]
    assert block_deviation(ideal, seeds) > 1.0


@pytest.mark.long
def test_image_pair_beats_path_tracer_speed_and_noise():
    result = reference.compare_polarizer_models(width_px=256, samples=64)
    assert result.speed_up >= 8.0
    assert result.noise_ratio >= 20.0
    for name in reference.ANALYZER_AXIS_DEG:
        # 2.8 % of noise over 50,000 pixels: 1.3e-4 of the mean.
        assert result.mean_ratio[name] == pytest.approx(1.0, abs=8e-4)
