"""Spots that are drawn and taken away again: number, place, color, and what they leave alone."""

import numpy as np
import pytest

from model.color_table import build
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.correspondence import charts, common_regions
from reconstruction.correspondence.common_parameterization import Correspondence, Cylinder
from skinrig.editing import pigment_spots, spot_removal
from skinrig.editing.pigment_spots import SPOT_KINDS, SpotError

SIDE = 120
RIM = 8


@pytest.fixture(scope="module")
def cheek():
    """A bent piece of skin of 60 mm, texels of half a millimetre: positions, R_d with grain."""
    along = (np.arange(SIDE) - (SIDE - 1) / 2) * 0.5
    u, v = np.meshgrid(along, -along)
    position = np.stack([90 * np.sin(u / 90), v, 90 * np.cos(u / 90) - 90], axis=-1)
    rng = np.random.default_rng(0)
    skin = np.array([0.30, 0.21, 0.17]) * (1 + 0.004 * rng.standard_normal((SIDE, SIDE, 1)))
    return position, skin.astype(np.float32), np.ones((SIDE, SIDE), bool)


def drawn(cheek, kind="freckles", seed=3, mask=None, **more):
    position, skin, on = cheek
    where = on.astype(float) if mask is None else mask
    rng = np.random.default_rng(seed)
    return pigment_spots.draw_spots(kind, skin, position, on, where, rng=rng, **more)


@pytest.mark.parametrize(("kind", "density"), [("freckles", 2.0), ("moles", 0.3)])
def test_requested_number_of_spots_keeps_distance(cheek, kind, density):
    found = drawn(cheek, kind, density_per_cm2=density)
    assert abs(len(found.center_mm) - 36 * density) <= 1
    apart = np.linalg.norm(found.center_mm[:, None] - found.center_mm, axis=-1)
    apart += 1e9 * np.eye(len(apart))
    assert apart.min() >= 0.6 * 10 / np.sqrt(density)


def test_same_seed_draws_same_spots_another_seed_others(cheek):
    np.testing.assert_array_equal(drawn(cheek).gain, drawn(cheek).gain)
    assert not np.array_equal(drawn(cheek).gain, drawn(cheek, seed=4).gain)


def test_edit_changes_nothing_outside_mask_or_at_zero(cheek):
    mask = np.zeros((SIDE, SIDE))
    mask[:, :40] = 1.0
    found = drawn(cheek, mask=mask)
    assert np.all(found.gain[:, 40:] == 1.0)
    assert found.gain[:, :40].min() < 0.8
    assert np.all(drawn(cheek, amount=0.0).gain == 1.0)


def test_a_spot_has_the_color_of_more_melanin(cheek):
    """On the curve of the color table at the skin's own blood, and fainter on darker skin."""
    table = build(
        pigment_spots.DOME_CAMERA, pigment_spots.DOME_ILLUMINANT, anisotropy=ANISOTROPY_SKIN
    )
    position, _, on = cheek

    def left(c_m):
        skin = np.broadcast_to(table.lookup(c_m, 0.03), position.shape).astype(np.float32)
        return pigment_spots.draw_spots(
            "freckles", skin, position, on, on, rng=np.random.default_rng(0)
        ).transmitted

    expected = table.lookup(0.02 + SPOT_KINDS["freckles"].melanin, 0.03) / table.lookup(0.02, 0.03)
    np.testing.assert_allclose(left(0.02), expected, rtol=0.05)
    assert np.all(left(0.25) > left(0.02))
    assert np.all((left(0.25) > 0) & (left(0.25) <= 1))


def test_spots_smaller_than_texel_darken_by_area(cheek):
    density = 20.0
    found = drawn(cheek, "follicles", density_per_cm2=density)
    diameter = found.diameter_mm
    area = float((np.pi / 4 * diameter**2).sum())
    # soft edges take and give about the same
    expected = area / 3600.0
    share = float((np.log(found.gain[..., 0]) / np.log(found.transmitted[0])).mean())
    assert 0.6 < share / expected < 1.6


def chart_of(position, on):
    frame = common_regions.standard_frame(side_mm=60.0, center_mm=(0.0, 0.0), size=SIDE)
    cylinder = Cylinder((0.0, 0.0, 0.0))
    return charts.chart_texels(position, on, Correspondence(cylinder), frame), frame


@pytest.mark.parametrize(("kind", "density"), [("freckles", 1.5), ("moles", 0.3)])
def test_added_spots_are_found_and_removed(cheek, kind, density):
    position, skin, on = cheek
    spots = drawn(cheek, kind, density_per_cm2=density)
    spotted = skin * spots.gain
    chart, frame = chart_of(position, on)
    found = spot_removal.fill_spots(
        spotted, on, chart, pixel_mm=frame.pixel_mm, range_mm=SPOT_KINDS[kind].range_mm
    )
    share = found.share[..., None]
    cleaned = spotted * (1 - share) + found.fill * share
    inner = (slice(RIM, -RIM), slice(RIM, -RIM))
    before = np.sqrt(np.mean(np.log(spotted[inner] / skin[inner]) ** 2))
    after = np.sqrt(np.mean(np.log(cleaned[inner] / skin[inner]) ** 2))
    assert after < 0.15 * before
    assert abs(found.spots - len(spots.center_mm)) <= 0.15 * len(spots.center_mm) + 1


def test_skin_without_spots_is_left_alone(cheek):
    position, skin, on = cheek
    chart, frame = chart_of(position, on)
    found = spot_removal.fill_spots(skin, on, chart, pixel_mm=frame.pixel_mm, range_mm=(0.8, 6.0))
    assert found.spots == 0
    assert not found.share.any()


def test_brow_is_not_a_spot():
    image = np.full((80, 80, 3), 0.3)
    image[40:43, 10:70] = 0.08
    image[20:24, 20:24] = 0.1
    spots, count = spot_removal.detect_dark_spots(
        image, np.ones((80, 80), bool), pixel_mm=0.8, range_mm=(0.8, 6.0)
    )
    assert count == 1
    assert spots[21, 21]
    assert not spots[41].any()


def test_orders_that_cannot_be_drawn_are_refused(cheek):
    with pytest.raises(SpotError, match="freckles, moles, follicles"):
        drawn(cheek, "warts")
    with pytest.raises(SpotError, match="at least 0"):
        drawn(cheek, amount=-1.0)
    with pytest.raises(SpotError, match="no texel"):
        drawn(cheek, mask=np.zeros((SIDE, SIDE)))
    with pytest.raises(SpotError, match="at most"):
        drawn(cheek, density_per_cm2=1e9)
    position, skin, on = cheek
    with pytest.raises(SpotError, match="expected skin"):
        pigment_spots.draw_spots("moles", 0 * skin, position, on, on, rng=np.random.default_rng(0))
