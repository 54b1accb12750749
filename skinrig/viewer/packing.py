"""Compress arrays for a page: quantize with a stated error, predict, deflate.

All arrays are in one gzip stream with a JSON header of their offsets. The words of an array are
replaced by differences from a prediction by neighbors (modulo the word), which a cumulative sum
inverts. Low and high bytes are separated. The predictor is the one that compresses best.
"""

import json
import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rigsim.geometry.mesh import Mesh
from skinrig.arrays import Float32Array, Float64Array, Int64Array, UInt8Array
from skinrig.viewer.scene import Storage, Texture, ViewerScene

Words = NDArray[Any]
"""uint8, uint16, int16, float16 or float32."""

PREDICTOR_NAMES: Final = ("none", "left", "up", "plane")
"""Predictors of a word from its neighbors; "plane" is left + up - upper left."""
NORMAL_STEPS: Final = 8191.0
"""Steps of a normal's component from 0 to 1: 0.005 degrees."""
SHAPE_BITS: Final = 32767
"""Maximum number of steps of a blend shape's largest displacement."""
SHAPE_STEP_MM: Final = 2.5e-4
"""Minimum step of blend shapes: a strain of 2e-4 over an edge of 1 mm."""


@dataclass(frozen=True, slots=True)
class PackedScene:
    """A scene as bytes.

    Attributes
    ----------
    header
        JSON values: all data except the arrays, and the arrays' offsets in the payload.
    payload
        gzip of the arrays.
    errors
        Maximum quantization error by array, in its own unit.
    """

    header: Mapping[str, Any]
    payload: bytes
    errors: Mapping[str, float]

    def header_bytes(self) -> bytes:
        """Return the header as JSON, the same bytes for the same scene."""
        return json.dumps(
            self.header, allow_nan=False, sort_keys=True, separators=(",", ":")
        ).encode("utf-8")


def _quantize(values: Float32Array, storage: Storage) -> tuple[Words, Float32Array, Float32Array]:
    """Quantize a texture; return its words, and the range of each layer and channel.

    Parameters
    ----------
    values
        Shape (H, W, C) or (L, H, W, C).
    storage
        "u8", "u16", "f16" or "f32"; floats are not scaled, their range is 0 to 1.

    Returns
    -------
    words, low, high
        Words of the same shape; low and high of shape (C,) or (L, C).
    """
    kept = (*range(values.ndim - 3), values.ndim - 1)
    shape = tuple(values.shape[axis] for axis in kept)
    if storage in ("f16", "f32"):
        kind = np.float16 if storage == "f16" else np.float32
        return values.astype(kind), np.zeros(shape, np.float32), np.ones(shape, np.float32)
    low, high = values.min(axis=(-3, -2)), values.max(axis=(-3, -2))
    top = 255.0 if storage == "u8" else 65535.0
    words = np.rint(np.clip(_shares(values, low, high), 0.0, 1.0) * top)
    return words.astype(np.uint8 if storage == "u8" else np.uint16), low, high


def dequantize(words: Words, low: Float32Array, high: Float32Array) -> Float32Array:
    """Return the values that the page decodes from words."""
    if words.dtype.kind == "f":
        return words.astype(np.float32)
    top = np.float32(np.iinfo(words.dtype).max)
    span = (high - low)[..., None, None, :]
    return np.asarray(low[..., None, None, :] + span * (words.astype(np.float32) / top), np.float32)


def encode_texture(texture: Texture) -> tuple[Words, Float32Array, Float32Array]:
    """Encode a texture as words with their range."""
    if texture.fine == 1:
        return _quantize(texture.values, texture.storage)
    _, low, high = _quantize(texture.values, "u8")
    coarse, steps = split_octave(_unrounded(texture.values, low, high), texture.fine)
    return join_octave(coarse, steps, texture.fine).reshape(texture.values.shape), low, high


def _unrounded(values: Float32Array, low: Float32Array, high: Float32Array) -> Float64Array:
    """Return values scaled to 0 to 255, before rounding, (L, H, W, C)."""
    return _shares(values, low, high).reshape(-1, *values.shape[-3:]) * 255.0


def _shares(values: Float32Array, low: Float32Array, high: Float32Array) -> Float64Array:
    """Normalize values by the range of each layer and channel."""
    spread = np.where(high > low, high - low, np.float32(1.0)).astype(np.float64)
    shares = (values.astype(np.float64) - low[..., None, None, :]) / spread[..., None, None, :]
    return np.asarray(shares)


def pack(scene: ViewerScene) -> PackedScene:
    """Pack a scene into a header and one compressed payload."""
    chunks: list[bytes] = []
    errors: dict[str, float] = {}
    offset = 0

    def put(words: Words) -> dict[str, Any]:
        nonlocal offset
        predictor, data = _choose_predictor(words)
        kind = words.dtype.str[1:]
        entry = {"offset": offset, "shape": list(words.shape), "type": kind, "predictor": predictor}
        # typed arrays require offsets that are multiples of their word size
        padded = data + b"\0" * (-len(data) % 4)
        chunks.append(padded)
        offset += len(padded)
        return entry

    mesh = scene.mesh
    kind = np.uint16 if len(mesh.vertices_mm) <= 65536 else np.uint32
    header: dict[str, Any] = {
        "mesh": {
            "positions": put(mesh.vertices_mm),
            "normals": put(np.rint(mesh.normals * NORMAL_STEPS).astype(np.int16)),
            "uv": put(mesh.uv),
            "faces": put(mesh.faces.astype(kind)),
            "weld": put(weld_vertices(mesh.vertices_mm).astype(kind)[:, None]),
            "shapes": {
                name: {"step": float(np.float32(step)), "deltas": put(words)}
                for name, (words, step) in encode_shape(mesh).items()
            },
        },
        "textures": {},
        "tables": {name: put(np.asarray(table)) for name, table in sorted(scene.tables.items())},
    }
    for name, (_, step) in encode_shape(mesh).items():
        errors[f"shape {name}"] = 0.5 * float(step)
    for name, texture in sorted(scene.textures.items()):
        words, low, high = encode_texture(texture)
        off = dequantize(words, low, high) - texture.values
        errors[name] = float(np.abs(off).max())
        data: dict[str, Any]
        if texture.fine == 1:
            data = put(np.ascontiguousarray(words[..., ::-1, :, :]))
        else:
            errors[f"{name} rms"] = float(np.sqrt(np.mean(off.astype(np.float64) ** 2)))
            turned = np.ascontiguousarray(_unrounded(texture.values, low, high)[:, ::-1])
            coarse, steps = split_octave(turned, texture.fine)
            data = {"predictor": "octaves", "fine": texture.fine}
            data |= {"coarse": put(coarse), "steps": put(steps)}
        *layers, height, width, channels = texture.values.shape
        header["textures"][name] = {
            "width": width,
            "height": height,
            "layers": layers[0] if layers else 0,
            "channels": channels,
            "storage": texture.storage,
            "filter": texture.filter,
            "low": low.tolist(),
            "high": high.tolist(),
            "data": data,
        }
    header |= {
        "page": scene.page,
        "params": scene.params,
        "presets": scene.presets,
        "facts": scene.facts,
        "provenance": scene.provenance,
        "left_out": [list(row) for row in scene.left_out],
        "added": [list(row) for row in scene.added],
        "quantization_error": errors,
        "bytes": offset,
    }
    payload = gzip_parts(chunks)
    header["packed_bytes"] = len(payload)
    plain = json.loads(json.dumps(header, allow_nan=False, default=dict))
    return PackedScene(plain, payload, errors)


def weld_vertices(positions: Float32Array) -> NDArray[np.intp]:
    """Return the first vertex at the position of each vertex, shape (V,)."""
    _, first, inverse = np.unique(positions, axis=0, return_index=True, return_inverse=True)
    return np.asarray(first[inverse.reshape(-1)])


def encode_shape(mesh: Mesh) -> dict[str, tuple[NDArray[np.int16], np.float32]]:
    """Quantize the displacements of blend shapes, (V, 3); return words and step, mm, by shape."""
    out = {}
    for name, deltas in mesh.shapes.items():
        step = np.float32(max(float(np.abs(deltas).max()) / SHAPE_BITS, SHAPE_STEP_MM))
        out[name] = (np.rint(deltas / step).astype(np.int16), step)
    return out


def _choose_predictor(words: Words) -> tuple[str, bytes]:
    """Choose the predictor with the smallest compressed size; also return the bytes."""
    little = words.astype(words.dtype.newbyteorder("<"), copy=False)
    if words.ndim < 2:
        return "raw", little.tobytes()
    # floats as words: neighbors share sign, exponent and leading digits
    little = np.ascontiguousarray(little).view(np.dtype(f"<u{words.dtype.itemsize}"))
    flat = little.reshape(-1, *words.shape[-3:]) if words.ndim >= 3 else little[None, :, None, :]
    tried = {name: _bytes_of(_differences(flat, name)) for name in PREDICTOR_NAMES}
    return min(tried.items(), key=lambda one: estimate_gzip_size(one[1]))


def _differences(words: NDArray[Any], predictor: str) -> NDArray[Any]:
    """Return words minus their prediction, modulo the word; shape (L, H, W, C)."""
    out = words.copy()
    if predictor in ("left", "plane"):
        out[:, :, 1:] -= out[:, :, :-1].copy()
    if predictor in ("up", "plane"):
        out[:, 1:] -= out[:, :-1].copy()
    return out


def _bytes_of(words: NDArray[Any]) -> bytes:
    """Return all low bytes, then all high bytes, as they compress better separately."""
    size = words.dtype.itemsize
    return words.reshape(-1).view(np.uint8).reshape(-1, size).T.tobytes()


_GZIP_HEADER: Final = b"\x1f\x8b\x08\x00\x00\x00\x00\x00\x02\xff"
"""Header of gzip without name, time and system (RFC 1952), equal on all platforms."""
_EMPTY_LAST_BLOCK: Final = b"\x03\x00"
"""An empty last block of deflate."""
_MEMORY_LEVEL: Final = 9
MAX_QUICK_RATIO: Final = 0.9
"""Maximum size ratio of a quick search from which a thorough search is made."""
MAX_MEASURED_BYTES: Final = 1 << 20
"""Maximum size of data that is compressed to measure its size; larger data are estimated."""


def gzip_parts(parts: Iterable[bytes]) -> bytes:
    """Compress concatenated parts as one gzip member, deterministically.

    Parameters
    ----------
    parts
        Parts, compressed independently.

    Examples
    --------
    >>> import gzip
    >>> gzip.decompress(gzip_parts([b"one " * 9, b"", b"two"])) == b"one " * 9 + b"two"
    True
    """
    out = [_GZIP_HEADER]
    check, size = 0, 0
    for part in parts:
        check = zlib.crc32(part, check)
        size += len(part)
        if part:
            out.append(_smallest(part))
    return b"".join([*out, _EMPTY_LAST_BLOCK, struct.pack("<II", check, size & 0xFFFFFFFF)])


def estimate_gzip_size(data: bytes) -> int:
    """Estimate the size of `gzip_parts` quickly, to compare orderings of data."""
    if len(data) < MAX_MEASURED_BYTES:
        return len(zlib.compress(data, 1))
    return min(len(_deflated(data, 1, strategy)) for strategy in _WITHOUT_SEARCH)


_WITHOUT_SEARCH: Final = (zlib.Z_HUFFMAN_ONLY, zlib.Z_RLE)


def _smallest(part: bytes) -> bytes:
    plain = min((_deflated(part, 1, strategy) for strategy in _WITHOUT_SEARCH), key=len)
    quick = _deflated(part, 6, zlib.Z_DEFAULT_STRATEGY)
    if len(quick) > MAX_QUICK_RATIO * len(plain):
        return min(plain, quick, key=len)
    return _deflated(part, 9, zlib.Z_DEFAULT_STRATEGY)


def _deflated(part: bytes, level: int, strategy: int) -> bytes:
    """Return non-final deflate blocks that end at a byte boundary (RFC 1951)."""
    packer = zlib.compressobj(level, zlib.DEFLATED, -zlib.MAX_WBITS, _MEMORY_LEVEL, strategy)
    return packer.compress(part) + packer.flush(zlib.Z_SYNC_FLUSH)


def split_octave(values: Float64Array, step_words: int) -> tuple[UInt8Array, UInt8Array]:
    """Split values into words of half the resolution and quantized steps of the finest octave.

    Parameters
    ----------
    values
        Words before they are rounded, 0 to 255, shape (L, H, W, C), H and W even.
    step_words
        Size of a step in words.

    Returns
    -------
    coarse, steps : ndarray of uint8
        (L, H/2, W/2, C), and (L, H, W, C) modulo 256; inverted by `join_octave`.
    """
    L, H, W, C = values.shape
    means = values.reshape(L, H // 2, 2, W // 2, 2, C).mean(axis=(2, 4))
    coarse = np.rint(means).astype(np.uint8)
    steps = np.rint((values - _upsample(coarse)) / step_words).astype(np.int64)
    return coarse, (steps % 256).astype(np.uint8)


def join_octave(coarse: UInt8Array, steps: UInt8Array, step_words: int) -> UInt8Array:
    """Join the two outputs of `split_octave` to words, (L, H, W, C)."""
    words = _upsample(coarse) + step_words * steps.view(np.int8).astype(np.int64)
    return np.clip(words, 0, 255).astype(np.uint8)


def _upsample(coarse: UInt8Array) -> Int64Array:
    """Upsample twofold by linear interpolation, rounded half up, (L, H, W, C).

    Arithmetic is in integers, so that the page computes identical words.
    """
    c = coarse.astype(np.int64)
    for axis in (1, 2):
        ahead = np.concatenate([c.take([0], axis), c.take(range(c.shape[axis] - 1), axis)], axis)
        behind = np.concatenate([c.take(range(1, c.shape[axis]), axis), c.take([-1], axis)], axis)
        pair = np.stack([3 * c + ahead, 3 * c + behind], axis=axis + 1)
        c = pair.reshape(*(n * (2 if k == axis else 1) for k, n in enumerate(c.shape)))
    return (c + 8) >> 4
