"""Bytes against the paper's figure, and the angle that each way of storing costs."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from model import wrinkles
from model.wrinkles import storage
from model.wrinkles.expressions import WrinkleError


def furrows(side, rng):
    """Return derivatives of smooth furrows, steepest 0.8."""
    h = gaussian_filter(rng.standard_normal((side, side)), side / 40, mode="wrap")
    dy, dx = np.gradient(h)
    return 0.8 * np.stack([-dx, dy], axis=-1) / max(np.abs(dx).max(), np.abs(dy).max())


def test_published_96_kilobytes_include_mip_maps_without_base():
    paper = storage.paper_footprint()
    assert paper.wrinkle_bytes == 64 * 1024
    assert paper.mask_bytes == 8 * 1024
    assert paper.total_bytes == 96 * 1024
    raw = storage.footprint((256, 256), (64, 64), maps="float32", masks="float32")
    assert raw.total_bytes == pytest.approx((8 * 2**16 + 32 * 2**12) * 4 / 3)


@pytest.mark.parametrize(("encoding", "bytes_"), storage.MAP_BYTES.items())
def test_counted_bytes_match_encoded_bytes(rng, encoding, bytes_):
    d = rng.uniform(-1, 1, (32, 16, 2))
    made = {
        "float32": d.astype(np.float32).nbytes,
        "float16": d.astype(np.float16).nbytes,
        "unit8": np.rint(wrinkles.to_unit(d) * 255).astype(np.uint8).nbytes,
        "bc5": storage.blocks.encode_bc5(wrinkles.to_unit(d)).nbytes,
    }
    assert made[encoding] == storage.texture_bytes((32, 16), bytes_, in_blocks=encoding == "bc5")


@pytest.mark.parametrize(
    ("encoding", "largest"), [("float32", 1e-7), ("float16", 5e-4), ("unit8", 1.0 / 255 + 1e-6)]
)
def test_stored_map_errs_by_half_step_of_encoding(rng, encoding, largest):
    d = rng.uniform(-1, 1, (20, 20, 2))
    assert np.abs(storage.round_trip_map(d, encoding) - d).max() <= largest


def test_eight_bits_cannot_store_flat_skin_blocks_nearly():
    flat = np.zeros((8, 8, 2))
    eight = storage.round_trip_map(flat, "unit8")
    np.testing.assert_allclose(np.abs(eight), 1 / 255, rtol=1e-6)
    assert np.abs(storage.round_trip_map(flat, "bc5")).max() < 1 / 255 / 3


def test_steeper_maps_than_the_encoding_holds_are_refused():
    with pytest.raises(WrinkleError, match=r"derivatives \(of encode\): got"):
        storage.round_trip_map(np.full((4, 4, 2), 1.5), "unit8")
    with pytest.raises(WrinkleError, match="derivatives: got"):
        storage.round_trip_map(np.full((4, 4, 2), 1e6), "float16")
    with pytest.raises(WrinkleError, match="masks as bc3: got"):
        storage.round_trip_masks(np.full((8, 4, 4), 1.2), "bc3")


@pytest.mark.parametrize("encoding", storage.MASK_BYTES)
@pytest.mark.parametrize("zones", [8, 5])
def test_masks_come_back_zone_by_zone(rng, encoding, zones):
    masks = np.clip(gaussian_filter(rng.standard_normal((zones, 16, 16)), (0, 4, 4)) * 6, 0, 1)
    back = storage.round_trip_masks(masks, encoding)
    assert back.shape == masks.shape
    assert np.abs(back - masks).max() < (0.35 if encoding == "bc3" else 0.003)
