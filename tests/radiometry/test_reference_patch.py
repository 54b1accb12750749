"""Patches of a person as voxels: place, color and noise of their images."""

from dataclasses import replace

import numpy as np
import pytest

from capture.rig import load_rig
from rigsim.mitsuba.variant import choose_variant
from rigsim.scenes.reference.patch import draw_patch, pixel_truth, predict_patch, render_patch
from rigsim.subject.person_skin import PersonSkin

pytestmark = [
    pytest.mark.render,
    pytest.mark.skipif(
        not choose_variant("mono").is_vectorized, reason="Dr.Jit finds no LLVM 17 or newer here"
    ),
]


@pytest.fixture(scope="module")
def patch():
    """Skin whose quarter at +x, +y has much melanin."""
    drawn = draw_patch(PersonSkin.of_preset("II"), "cheek", field_mm=16.0, voxel_mm=0.5)
    melanin = np.full_like(drawn.melanin, 0.015)
    melanin[np.ix_(drawn.x_mm > 0.0, drawn.x_mm > 0.0)] = 0.2
    return replace(drawn, melanin=melanin, blood=np.full_like(drawn.blood, 0.01))


@pytest.fixture(scope="module")
def renders(patch):
    """Images of 4 x 4 pixels with few and with 16 times as many samples."""
    rig = load_rig("flash")
    return [render_patch(patch, rig, width_px=4, samples=n, seed=1) for n in (8, 128)]


def darkest_quarter(image):
    """Row and column of the darkest quarter."""
    quarters = image.mean(axis=-1).reshape(2, 2, 2, 2).mean(axis=(1, 3))
    return np.unravel_index(quarters.argmin(), quarters.shape)


@pytest.mark.long
def test_dark_quarter_is_upper_right_everywhere(patch, renders):
    """Rationale: row 0 is at the top, and x points to the right, as in the flash rig's images."""
    melanin, _ = pixel_truth(patch, 4)
    fast = predict_patch(patch, load_rig("flash"), width_px=4)
    assert darkest_quarter(-melanin[..., None]) == (0, 1)
    assert darkest_quarter(renders[1].rgb) == (0, 1)
    assert darkest_quarter(fast) == (0, 1)


@pytest.mark.long
def test_width_that_splits_voxels_is_refused(patch):
    with pytest.raises(ValueError, match="a divisor of"):
        pixel_truth(patch, 5)


@pytest.mark.long
def test_noise_of_patch_falls_with_samples(renders):
    """Tolerance: factor 4 of the expected ratio of 16; channels share bands, so that the variance
    of 16 pixels errs by a third, and the ratio's logarithm by .5.
    """
    few, many = (np.mean(image.variance) for image in renders)
    assert 4.0 < few / many < 64.0


@pytest.mark.long
def test_relief_changes_light_by_few_percent():
    """Rationale: slopes of .15 rms and grooves of 15 um leave the light within 10 %.

    Tolerance: the standard error of the ratio is 2 %, a fifth of the bound.
    """
    rig, person = load_rig("flash"), PersonSkin.of_preset("II")
    options = {"field_mm": 2.0, "voxel_mm": 0.05, "alpha": 0.15}
    flat, uneven = (
        render_patch(
            draw_patch(person, "forehead", relief=relief, **options),
            rig,
            width_px=4,
            samples=256,
            seed=2,
        ).rgb.mean(axis=(0, 1))
        for relief in (False, True)
    )
    assert 1e-4 < np.abs(uneven / flat - 1.0).max() < 0.1
