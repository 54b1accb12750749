"""Bytes against the paper's figure, and the angle that each way of storing costs."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from model import wrinkles
from model.wrinkles import storage
from model.wrinkles.expressions import WrinkleError
from model.wrinkles.partial_derivatives import Layer


def furrows(side, rng):
    """Return derivatives of smooth furrows, steepest 0.8."""
    h = gaussian_filter(rng.standard_normal((side, side)), side / 40, mode="wrap")
    dy, dx = np.gradient(h)
    return 0.8 * np.stack([-dx, dy], axis=-1) / max(np.abs(dx).max(), np.abs(dy).max())


@pytest.fixture
def face(rng):
    y, x = np.mgrid[:16, :16] / 15.0
    centres = [(a, b) for b in (0, 1) for a in (0, 0.3, 0.6, 1)]
    masks = np.stack([np.exp(-8 * ((x - a) ** 2 + (y - b) ** 2)) for a, b in centres])
    return 0.3 * furrows(64, rng), Layer(furrows(64, rng), masks)


def test_the_paper_s_96_kilobytes_are_map_and_masks_with_mip_maps_and_without_the_base():
    paper = storage.paper_footprint()
    assert paper.wrinkle_bytes == 64 * 1024
    assert paper.mask_bytes == 8 * 1024
    assert paper.total_bytes == 96 * 1024
    exact = storage.mip_chain_bytes((256, 256), 1, in_blocks=True) + 2 * storage.mip_chain_bytes(
        (64, 64), 1, in_blocks=True
    )
    assert exact == pytest.approx(96 * 1024, rel=0.002)
    raw = storage.footprint((256, 256), (64, 64), maps="float32", masks="float32")
    assert raw.total_bytes == pytest.approx((8 * 2**16 + 32 * 2**12) * 4 / 3)


@pytest.mark.parametrize(("encoding", "bytes_"), storage.MAP_BYTES.items())
def test_the_bytes_counted_are_those_that_the_encoding_makes(rng, encoding, bytes_):
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
def test_a_stored_map_is_off_by_half_a_step_of_its_encoding(rng, encoding, largest):
    d = rng.uniform(-1, 1, (20, 20, 2))
    assert np.abs(storage.stored_map(d, encoding) - d).max() <= largest


def test_eight_bits_cannot_store_flat_skin_and_blocks_nearly_can():
    flat = np.zeros((8, 8, 2))
    eight = storage.stored_map(flat, "unit8")
    np.testing.assert_allclose(np.abs(eight), 1 / 255, rtol=1e-6)
    assert np.abs(storage.stored_map(flat, "bc5")).max() < 1 / 255 / 3


def test_error_falls_with_bytes_and_full_floats_cost_nothing(face):
    base, layer = face
    rows = storage.storage_table(
        base, layer, {"surprise": 1.0, "disgust": 0.6}, sides=(128, 64, 32, 16)
    )
    by = {(row.side, row.maps): row for row in rows}
    assert len(rows) == 12  # 128 is larger than the layer and left out
    assert by[64, "float32"].mean_deg < 1e-4
    for side in (64, 32, 16):
        sizes = [by[side, e].total_bytes for e in ("float32", "float16", "unit8", "bc5")]
        assert sizes == sorted(sizes, reverse=True)
    errors = [by[64, e].mean_deg for e in ("float32", "float16", "unit8", "bc5")]
    assert errors == sorted(errors)  # at lower resolutions the resolution outweighs the encoding
    floats = [by[side, "float32"].mean_deg for side in (64, 32, 16)]
    assert floats == sorted(floats)
    assert all(row.percentile_99_deg >= row.mean_deg for row in rows)


def test_steeper_maps_than_the_encoding_holds_are_refused():
    with pytest.raises(WrinkleError, match="expected encode's"):
        storage.stored_map(np.full((4, 4, 2), 1.5), "unit8")
    with pytest.raises(WrinkleError, match="beyond 65504"):
        storage.stored_map(np.full((4, 4, 2), 1e6), "float16")
    with pytest.raises(WrinkleError, match=r"expected \[0, 1\] for bc3"):
        storage.stored_masks(np.full((8, 4, 4), 1.2), "bc3")


@pytest.mark.parametrize("encoding", storage.MASK_BYTES)
@pytest.mark.parametrize("zones", [8, 5])
def test_masks_come_back_zone_by_zone(rng, encoding, zones):
    masks = np.clip(gaussian_filter(rng.standard_normal((zones, 16, 16)), (0, 4, 4)) * 6, 0, 1)
    back = storage.stored_masks(masks, encoding)
    assert back.shape == masks.shape
    assert np.abs(back - masks).max() < (0.35 if encoding == "bc3" else 0.003)


def test_the_angle_of_nothing_is_not_a_number():
    zero = np.zeros((2, 2, 3))
    assert np.isnan(storage.normal_error_deg(zero, zero)).all()
