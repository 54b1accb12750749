"""Packed scenes: errors as stated, the same bytes, text that survives."""

from __future__ import annotations

import gzip

import numpy as np
import pytest
from fixtures.packed_scenes import as_packed

from rigsim.geometry.mesh import Mesh
from skinrig.viewer import packing, page
from skinrig.viewer.scene import SceneError, Texture, ViewerScene


def _bytes_of(text):
    """Undo `page_text.as_text`, as the page does."""
    codes = []
    for one in map(ord, text):
        if one >= 128:
            codes.append(page.UNSAFE_CODES[(one >> 7) - 1])
        codes.append(one & 127)
    bits = np.array([[(code >> k) & 1 for k in range(6, -1, -1)] for code in codes], np.uint8)
    return np.packbits(bits.reshape(-1)).tobytes()


def _scene(**textures):
    triangle = Mesh(
        vertices_mm=np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0]], np.float32),
        normals=np.tile(np.float32([0, 0, 1]), (3, 1)),
        uv=np.array([[0, 0], [1, 0], [0, 1]], np.float32),
        faces=np.array([[0, 1, 2]], np.int32),
        shapes={"smile": np.array([[0, 0, 1], [0, 0.3, 0], [0, 0, 0]], np.float32)},
    )
    return ViewerScene(mesh=triangle, textures=textures, facts={"a": 1.5}, params={"b": 0.0})


@pytest.mark.parametrize("count", [1, 2, 6, 7, 8, 1000, 1001])
def test_text_gives_its_bytes_back(count, rng):
    data = rng.integers(0, 256, count, dtype=np.uint8).tobytes()
    text = page.encode_as_text(data)
    assert _bytes_of(text)[: len(data)] == data
    assert not {chr(code) for code in page.UNSAFE_CODES} & set(text)


def test_text_of_only_unsafe_bytes_is_safe_small():
    for fill in (0, 255):
        text = page.encode_as_text(bytes([fill]) * 7001)
        assert not {chr(code) for code in page.UNSAFE_CODES} & set(text)
        assert len(text.encode("utf-8")) <= 8 / 7 * 7001 + 2
        assert _bytes_of(text)[:7001] == bytes([fill]) * 7001


def test_text_holds_seven_bits_a_byte(rng):
    data = rng.integers(0, 256, 70_000, dtype=np.uint8).tobytes()
    assert len(page.encode_as_text(data).encode("utf-8")) == pytest.approx(80_000, rel=1e-3)


@pytest.mark.parametrize(("storage", "top"), [("u8", 255.0), ("u16", 65535.0)])
def test_a_quantized_texture_is_within_half_a_step(storage, top, rng):
    values = rng.normal(size=(3, 16, 8, 2)).astype(np.float32)
    texture = Texture(values, storage)
    words, low, high = packing.encode_texture(texture)
    off = np.abs(packing.dequantize(words, low, high) - values)
    half = 0.5 * (high - low)[:, None, None, :] / top
    assert np.all(off <= half * (1.0 + 1e-3) + 1e-6)
    assert packing.pack(_scene(noise=texture)).errors["noise"] == pytest.approx(off.max())


def test_a_constant_texture_is_exact():
    values = np.full((4, 4, 1), 0.37, np.float32)
    words, low, high = packing.encode_texture(Texture(values))
    np.testing.assert_array_equal(packing.dequantize(words, low, high), values)


def test_coarse_finest_octave_keeps_means_and_states_error(rng):
    smooth = np.add.outer(np.sin(np.arange(64) / 9.0), np.cos(np.arange(64) / 7.0))
    values = (smooth + 0.1 * rng.normal(size=(64, 64)))[..., None].astype(np.float32)
    step = float(np.ptp(values)) / 255.0
    found = as_packed(_scene(noise=Texture(values, fine=8))).textures["noise"].values
    off = found - values
    assert np.abs(off).max() <= (0.5 * 8 + 1.0) * step
    # the error is in the finest octave: means over blocks are far better than texels
    blocks = off.reshape(8, 8, 8, 8).mean(axis=(1, 3))
    assert np.abs(blocks).max() < 0.5 * np.abs(off).max()
    packed = packing.pack(_scene(noise=Texture(values, fine=8)))
    assert packed.errors["noise"] == pytest.approx(np.abs(off).max())
    assert packed.errors["noise rms"] == pytest.approx(off.std(), rel=0.01)
    assert len(packed.payload) < len(packing.pack(_scene(noise=Texture(values))).payload)


@pytest.mark.parametrize("predictor", packing.PREDICTOR_NAMES)
def test_differences_are_undone_by_sums(predictor, rng):
    words = rng.integers(0, 65536, (2, 9, 7, 3), dtype=np.uint16)
    back = packing._differences(words, predictor)
    if predictor in ("up", "plane"):
        back = np.cumsum(back, axis=1, dtype=np.uint16)
    if predictor in ("left", "plane"):
        back = np.cumsum(back, axis=2, dtype=np.uint16)
    np.testing.assert_array_equal(back, words)


def test_the_same_scene_gives_the_same_bytes(rng):
    values = rng.normal(size=(8, 8, 1)).astype(np.float32)
    first, second = (packing.pack(_scene(noise=Texture(values.copy()))) for _ in range(2))
    assert first.payload == second.payload
    assert first.header_bytes() == second.header_bytes()
    other = packing.pack(_scene(noise=Texture(values + np.float32(0.5) * (values > 1.0))))
    assert other.payload != first.payload


def test_arrays_are_at_offsets_in_header(rng):
    values = rng.normal(size=(8, 8, 1)).astype(np.float32)
    packed = packing.pack(_scene(noise=Texture(values, "f32")))
    entry = packed.header["textures"]["noise"]["data"]
    raw = gzip.decompress(packed.payload)[entry["offset"] : entry["offset"] + 4 * 64]
    ranks = np.frombuffer(raw, np.uint8).reshape(4, 64).T  # low bytes first
    words = np.ascontiguousarray(ranks).view("<u4").reshape(entry["shape"])
    for axis, names in ((0, ("up", "plane")), (1, ("left", "plane"))):
        if entry["predictor"] in names:
            words = np.cumsum(words, axis=axis, dtype=np.uint32)
    found = words.astype("<u4").view("<f4")
    np.testing.assert_array_equal(found[::-1], values)  # the page's row 0 is the bottom


def test_blend_shapes_are_quantized_to_quarter_micrometer():
    packed = as_packed(_scene()).mesh.shapes["smile"]
    assert np.abs(packed - _scene().mesh.shapes["smile"]).max() <= 0.5 * packing.SHAPE_STEP_MM


def test_vertices_at_same_position_share_normal():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 0]], np.float32)
    assert packing.weld_vertices(points).tolist() == [0, 1, 0]


@pytest.mark.parametrize(
    ("texture", "what"),
    [
        ({"values": np.zeros((4, 4), np.float32)}, "expected"),
        ({"values": np.full((4, 4, 1), np.nan, np.float32)}, "NaN"),
        ({"values": np.zeros((3, 4, 1), np.float32), "fine": 4}, "even"),
        ({"values": np.zeros((8200, 1, 1), np.float32)}, "--size-px"),
        ({"values": np.zeros((4, 4, 1), np.float32), "storage": "u4"}, "expected a storage"),
    ],
)
def test_invalid_texture_is_refused(texture, what):
    with pytest.raises(SceneError, match=what):
        Texture(**texture)


def test_two_builders_may_not_name_a_texture_alike():
    scene = _scene(noise=Texture(np.zeros((2, 2, 1), np.float32)))
    with pytest.raises(SceneError, match="two builders"):
        scene.with_assets({"textures": {"noise": Texture(np.zeros((2, 2, 1), np.float32))}})
