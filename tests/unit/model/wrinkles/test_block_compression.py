"""Blocks decoded against hand-made bits of the format, and encoded near the best there is."""

import itertools

import numpy as np
import pytest

from model.wrinkles import block_compression as bc


def test_eight_value_block_decodes_by_format_ramp():
    # codes 0...7 twice, three bits each, the first texel in the lowest bits
    codes = list(range(8)) * 2
    bits = sum(code << (3 * i) for i, code in enumerate(codes))
    block = np.array([[[240, 30, *bits.to_bytes(6, "little")]]], np.uint8)
    ramp = [240, 30, *[(k * 240 + (7 - k) * 30) / 7 for k in range(6, 0, -1)]]
    np.testing.assert_allclose(bc.decode_bc4(block, (4, 4)).ravel() * 255, ramp * 2, rtol=1e-12)


def test_swapped_block_ends_decode_six_values_plus_extremes():
    codes = list(range(8)) * 2
    bits = sum(code << (3 * i) for i, code in enumerate(codes))
    block = np.array([[[30, 240, *bits.to_bytes(6, "little")]]], np.uint8)
    ramp = [30, 240, *[(k * 30 + (5 - k) * 240) / 5 for k in range(4, 0, -1)], 0, 255]
    np.testing.assert_allclose(bc.decode_bc4(block, (4, 4)).ravel() * 255, ramp * 2, rtol=1e-12)


def test_color_block_decodes_by_format_bits():
    red, blue = 31 << 11, 31
    codes = [0, 1, 2, 3] * 4
    bits = sum(code << (2 * i) for i, code in enumerate(codes)).to_bytes(4, "little")
    ends = red.to_bytes(2, "little") + blue.to_bytes(2, "little")
    four = bc.decode_bc1(np.frombuffer(ends + bits, np.uint8).reshape(1, 1, 8), (4, 4))
    thirds = [[1, 0, 0], [0, 0, 1], [2 / 3, 0, 1 / 3], [1 / 3, 0, 2 / 3]]
    np.testing.assert_allclose(four[0], thirds, atol=1e-12)
    turned = np.frombuffer(ends[2:] + ends[:2] + bits, np.uint8).reshape(1, 1, 8)
    three = [[0, 0, 1], [1, 0, 0], [0.5, 0, 0.5], [0, 0, 0]]
    np.testing.assert_allclose(bc.decode_bc1(turned, (4, 4))[0], three, atol=1e-12)
    always = bc.decode_bc1(turned, (4, 4), always_four=True)[0]
    np.testing.assert_allclose(always[3], [2 / 3, 0, 1 / 3], atol=1e-12)


@pytest.mark.parametrize("value", [0.0, 1.0, 0.4, 128 / 255])
def test_flat_block_round_trips_within_half_byte_step(value):
    back = bc.decode_bc4(bc.encode_bc4(np.full((8, 8), value)), (8, 8))
    np.testing.assert_allclose(back, value, atol=0.5 / 255)


def test_values_on_format_ramp_round_trip_exactly(rng):
    ramp = 30 + (240 - 30) * np.arange(8) / 7
    texture = rng.permuted(np.tile(np.repeat(ramp, 2), (9, 1)), axis=1).reshape(12, 12) / 255
    blocked = texture.reshape(-1, 16)
    assert blocked.shape[0] == 9
    grid = blocked.reshape(3, 3, 4, 4).swapaxes(1, 2).reshape(12, 12)
    np.testing.assert_allclose(bc.decode_bc4(bc.encode_bc4(grid), (12, 12)), grid, atol=1e-12)


def test_block_rms_error_is_within_half_ramp_step(rng):
    texture = rng.random((64, 64))
    back = bc.decode_bc4(bc.encode_bc4(texture), (64, 64))
    for y, x in itertools.product(range(0, 64, 4), repeat=2):
        part = texture[y : y + 4, x : x + 4]
        half_a_step = (np.ptp(part) + 2 / 255) / 14
        rms = np.sqrt(np.mean((back[y : y + 4, x : x + 4] - part) ** 2))
        assert rms <= half_a_step


def test_end_search_is_near_best_of_all_pairs(rng):
    texture = np.clip(0.5 + 0.1 * rng.standard_normal((4, 40)), 0, 1)
    back = bc.decode_bc4(bc.encode_bc4(texture), (4, 40))
    ours, best = [], []
    for x in range(0, 40, 4):
        v = texture[:, x : x + 4].ravel() * 255
        ours.append(((back[:, x : x + 4].ravel() * 255 - v) ** 2).sum())
        high, low = np.triu_indices(256)[::-1]
        steps = np.maximum(high - low, 1e-9)[:, None] / 7
        k = np.clip(np.rint((high[:, None] - v) / steps), 0, 7)
        best.append(((high[:, None] - k * steps - v) ** 2).sum(axis=1).min())
    assert np.all(np.array(ours) >= np.array(best) - 1e-6)
    assert sum(ours) <= 1.1 * sum(best)


def test_two_channels_do_not_touch_each_other(rng):
    texture = rng.random((9, 6, 2))
    blocks = bc.encode_bc5(texture)
    assert blocks.shape == (3, 2, 16)
    back = bc.decode_bc5(blocks, (9, 6))
    for c in (0, 1):
        alone = bc.decode_bc4(bc.encode_bc4(texture[..., c]), (9, 6))
        np.testing.assert_array_equal(back[..., c], alone)


def test_collinear_colors_round_trip_to_steps_of_ends(rng):
    ends = np.array([[8, 60, 25], [20, 10, 5]]) / [31, 63, 31]
    part = rng.integers(0, 4, (4, 4, 1)) / 3
    part[0, :2] = [[0], [1]]
    texture = ends[0] * (1 - part) + ends[1] * part
    np.testing.assert_allclose(bc.decode_bc1(bc.encode_bc1(texture), (4, 4)), texture, atol=1e-12)


def test_four_channels_cost_byte_per_texel_keep_masks():
    y, x = np.mgrid[:64, :64] / 63
    masks = np.stack([x, 1 - x, 0.5 * x + 0.2, y], axis=-1)
    blocks = bc.encode_bc3(masks)
    assert blocks.nbytes == 64 * 64
    back = bc.decode_bc3(blocks, (64, 64))
    assert np.abs(back - masks).max() < 0.03


@pytest.mark.parametrize("bad", [-0.01, 1.01, np.nan])
def test_values_outside_texture_range_are_refused(bad):
    with pytest.raises(bc.BlockError, match=r"texture: got"):
        bc.encode_bc4(np.full((4, 4), bad))


def test_blocks_of_another_size_are_refused():
    with pytest.raises(bc.BlockError, match="blocks: got"):
        bc.decode_bc4(np.zeros((1, 1, 8), np.uint8), (5, 4))
    with pytest.raises(bc.BlockError, match=r"expected \(h, w, 2\)"):
        bc.encode_bc5(np.zeros((4, 4, 3)))
