"""Encode textures in 4 x 4 blocks: one channel in 8 bytes (BC4), two (BC5), colors (BC1, BC3).

A block contains two end values and, per texel, its step on the line between them. Decoding is exact
integer arithmetic; encoding searches the ends by least squares and then by single steps, which is
close to the optimum but not guaranteed to reach it.

References
----------
Khronos Data Format Specification 1.3, chapters "S3TC" (BC1, BC3) and "RGTC" (BC4, BC5).
"""

import numpy as np

from model.arrays import Float64Array, FloatArray, Int64Array, UInt8Array
from model.checks import Checks

BLOCK_SIDE = 4
"""Texels per side of a block."""
CHUNK_BLOCKS = 32_768
"""Blocks that are encoded at once."""
RANGE_INSETS = (0.0, 0.06, 0.12)
"""Fractions of a block's range by which its ends are moved inward at first."""
FIT_ROUNDS = 4
"""Rounds of least squares on the ends of a block."""


class BlockError(ValueError):
    """Error for a texture that cannot be encoded, or blocks that cannot be decoded."""


def block_grid_shape(shape: tuple[int, int]) -> tuple[int, int]:
    """Return rows and columns of blocks; the last ones may reach beyond the texture."""
    return -(-shape[0] // BLOCK_SIDE), -(-shape[1] // BLOCK_SIDE)


def encode_bc4(values: FloatArray) -> UInt8Array:
    """Encode one channel as BC4 blocks.

    Parameters
    ----------
    values : ndarray, shape (h, w)
        In [0, 1]. A border that does not fill a block is repeated outward.

    Returns
    -------
    ndarray of uint8, shape (ceil(h/4), ceil(w/4), 8)

    Examples
    --------
    >>> encode_bc4(np.full((4, 4), 0.2)).ravel().tolist()
    [51, 51, 0, 0, 0, 0, 0, 0]
    """
    texels = _cut(values[..., None])
    rows, columns = texels.shape[:2]
    flat = texels.reshape(-1, 16) * 255.0
    out = [_bc4_chunk(flat[i : i + CHUNK_BLOCKS]) for i in range(0, len(flat), CHUNK_BLOCKS)]
    return np.concatenate(out).reshape(rows, columns, 8)


def decode_bc4(blocks: UInt8Array, shape: tuple[int, int]) -> Float64Array:
    """Return the channel (h, w) in [0, 1] of blocks in either of the format's modes."""
    data = _checked(blocks, 8, shape).astype(np.int64)
    r0, r1 = data[..., 0], data[..., 1]
    bits = (data[..., 2:] << (8 * np.arange(6))).sum(axis=-1)
    codes = (bits[..., None] >> (3 * np.arange(16))) & 7
    ends = np.stack([r0, r1], axis=-1) / 255.0
    step = np.arange(1, 7)
    eight = ends[..., :1] + (ends[..., 1:] - ends[..., :1]) * step / 7.0
    six = ends[..., :1] + (ends[..., 1:] - ends[..., :1]) * step / 5.0
    six[..., 4], six[..., 5] = 0.0, 1.0
    palette = np.concatenate([ends, np.where((r0 > r1)[..., None], eight, six)], axis=-1)
    return _joined(np.take_along_axis(palette, codes, axis=-1)[..., None], shape)[..., 0]


def encode_bc5(values: FloatArray) -> UInt8Array:
    """Encode two channels (h, w, 2) in [0, 1], each as BC4: (ceil(h/4), ceil(w/4), 16)."""
    _channels(values, 2)
    return np.concatenate([encode_bc4(values[..., c]) for c in (0, 1)], axis=-1)


def decode_bc5(blocks: UInt8Array, shape: tuple[int, int]) -> Float64Array:
    """Return the two channels (h, w, 2) in [0, 1] of blocks."""
    data = _checked(blocks, 16, shape)
    return np.stack([decode_bc4(data[..., :8], shape), decode_bc4(data[..., 8:], shape)], axis=-1)


def encode_bc1(colors: FloatArray) -> UInt8Array:
    """Encode colors (h, w, 3) in [0, 1] without transparency: (ceil(h/4), ceil(w/4), 8)."""
    _channels(colors, 3)
    texels = _cut(colors)
    rows, columns = texels.shape[:2]
    flat = texels.reshape(-1, 16, 3)
    out = [_bc1_chunk(flat[i : i + CHUNK_BLOCKS]) for i in range(0, len(flat), CHUNK_BLOCKS)]
    return np.concatenate(out).reshape(rows, columns, 8)


def decode_bc1(
    blocks: UInt8Array, shape: tuple[int, int], *, always_four: bool = False
) -> Float64Array:
    """Return the colors (h, w, 3) in [0, 1] of blocks.

    Parameters
    ----------
    blocks : ndarray of uint8, shape (ceil(h/4), ceil(w/4), 8)
    shape : (int, int)
    always_four : bool
        True as part of BC3. False: blocks whose first end is not the larger one have three colors
        and black.
    """
    data = _checked(blocks, 8, shape).astype(np.int64)
    first, second = data[..., 0] | data[..., 1] << 8, data[..., 2] | data[..., 3] << 8
    bits = (data[..., 4:] << (8 * np.arange(4))).sum(axis=-1)
    codes = (bits[..., None] >> (2 * np.arange(16))) & 3
    a, b = _from_565(first), _from_565(second)
    four = np.stack([a, b, (2 * a + b) / 3, (a + 2 * b) / 3], axis=-2)
    three = np.stack([a, b, (a + b) / 2, np.zeros_like(a)], axis=-2)
    is_four = np.ones(first.shape, bool) if always_four else first > second
    palette = np.where(is_four[..., None, None], four, three)
    return _joined(np.take_along_axis(palette, codes[..., None], axis=-2), shape)


def encode_bc3(values: FloatArray) -> UInt8Array:
    """Encode four channels (h, w, 4) in [0, 1]: the last as BC4, then the others as BC1."""
    _channels(values, 4)
    return np.concatenate([encode_bc4(values[..., 3]), encode_bc1(values[..., :3])], axis=-1)


def decode_bc3(blocks: UInt8Array, shape: tuple[int, int]) -> Float64Array:
    """Return the four channels (h, w, 4) in [0, 1] of blocks."""
    data = _checked(blocks, 16, shape)
    last = decode_bc4(data[..., :8], shape)
    colors = decode_bc1(data[..., 8:], shape, always_four=True)
    return np.concatenate([colors, last[..., None]], axis=-1)


def _bc4_chunk(v: Float64Array) -> UInt8Array:
    """Encode (n, 16) values in [0, 255]: ends from the range, by least squares, by single steps."""
    most, least = v.max(axis=1), v.min(axis=1)
    high, low = np.ceil(most), np.floor(least)
    steps, error = _bc4_steps(v, high, low)
    tries = [
        (most - a * (most - least), least + b * (most - least))
        for a in RANGE_INSETS
        for b in RANGE_INSETS
    ]
    for _ in range(FIT_ROUNDS):
        tries.append(_least_squares_ends(v, steps / 7.0))
        for h, lo in tries:
            h, lo = np.clip(np.rint(h), 0, 255), np.clip(np.rint(lo), 0, 255)
            high, low, steps, error = _better(v, (high, low, steps, error), h, lo)
        tries = []
    for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, -1), (-1, 1)):
        h, lo = np.clip(high + a, 0, 255), np.clip(low + b, 0, 255)
        high, low, steps, error = _better(v, (high, low, steps, error), h, lo)
    codes = np.where(steps == 0, 0, np.where(steps == 7, 1, steps + 1)).astype(np.int64)
    codes[high <= low] = 0
    bits = (codes << (3 * np.arange(16))).sum(axis=1)
    out = np.empty((len(v), 8), np.uint8)
    out[:, 0], out[:, 1] = high, low
    out[:, 2:] = (bits[:, None] >> (8 * np.arange(6))) & 255
    return out


def _bc4_steps(
    v: Float64Array, high: Float64Array, low: Float64Array
) -> tuple[Float64Array, Float64Array]:
    width = high - low
    scale = np.divide(7.0, width, out=np.zeros_like(width), where=width > 0)
    steps = np.clip(np.rint((high[:, None] - v) * scale[:, None]), 0, 7)
    error = ((high[:, None] - steps * (width / 7.0)[:, None] - v) ** 2).sum(axis=1)
    return steps, np.where(width >= 0, error, np.inf)


def _better(
    v: Float64Array,
    found: tuple[Float64Array, Float64Array, Float64Array, Float64Array],
    high: Float64Array,
    low: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    steps, error = _bc4_steps(v, high, low)
    win = error < found[3]
    return (
        np.where(win, high, found[0]),
        np.where(win, low, found[1]),
        np.where(win[:, None], steps, found[2]),
        np.where(win, error, found[3]),
    )


def _least_squares_ends(v: Float64Array, part: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the least-squares ends, given each texel's weight of the second end."""
    axes = (slice(None), slice(None), *([None] * (v.ndim - 2)))
    p, q = (1.0 - part)[axes], part[axes]
    aa, ab, bb = (p * p).sum(axis=1), (p * q).sum(axis=1), (q * q).sum(axis=1)
    av, bv = (p * v).sum(axis=1), (q * v).sum(axis=1)
    det = aa * bb - ab * ab
    good = det > 1e-9
    safe = np.where(good, det, 1.0)
    mean = v.mean(axis=1)
    return (
        np.where(good, (bb * av - ab * bv) / safe, mean),
        np.where(good, (aa * bv - ab * av) / safe, mean),
    )


def _bc1_chunk(v: Float64Array) -> UInt8Array:
    """Encode (n, 16, 3) colors: ends on the principal axis, refined by least squares."""
    mean = v.mean(axis=1)
    about = v - mean[:, None]
    axis = np.linalg.eigh(np.einsum("nki,nkj->nij", about, about))[1][..., -1]
    along = np.einsum("nki,ni->nk", about, axis)
    a = mean + along.max(axis=1)[:, None] * axis
    b = mean + along.min(axis=1)[:, None] * axis
    best: tuple[Int64Array, ...] | None = None
    error = np.full(len(v), np.inf)
    for _ in range(FIT_ROUNDS):
        ends = _to_565(a), _to_565(b)
        steps, missed = _bc1_steps(v, _from_565(ends[0]), _from_565(ends[1]))
        win = missed < error
        error = np.where(win, missed, error)
        now = (ends[0], ends[1], steps)
        if best is None:
            best = now
        else:
            best = (
                np.where(win, now[0], best[0]),
                np.where(win, now[1], best[1]),
                np.where(win[:, None], steps, best[2]),
            )
        a, b = _least_squares_ends(v, best[2] / 3.0)
    assert best is not None  # noqa: S101
    first, second, steps = best
    swap = first < second  # the larger end comes first: this order selects the mode of four colors
    first, second = np.where(swap, second, first), np.where(swap, first, second)
    steps = np.where(swap[:, None], 3 - steps, steps)
    steps[first == second] = 0
    codes = np.array([0, 2, 3, 1])[steps]
    bits = (codes << (2 * np.arange(16))).sum(axis=1)
    out = np.empty((len(v), 8), np.uint8)
    for i, end in ((0, first), (2, second)):
        out[:, i], out[:, i + 1] = end & 255, end >> 8
    out[:, 4:] = (bits[:, None] >> (8 * np.arange(4))) & 255
    return out


def _bc1_steps(
    v: Float64Array, a: Float64Array, b: Float64Array
) -> tuple[Int64Array, Float64Array]:
    line = b - a
    length = (line * line).sum(axis=1)
    inverse = np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)
    place = np.einsum("nki,ni->nk", v - a[:, None], line) * inverse[:, None]
    steps = np.clip(np.rint(3.0 * place), 0, 3)
    shown = a[:, None] + (steps / 3.0)[..., None] * line[:, None]
    return steps.astype(np.int64), ((shown - v) ** 2).sum(axis=(1, 2))


def _to_565(colors: Float64Array) -> Int64Array:
    r, g, b = np.moveaxis(np.clip(np.rint(colors * [31, 63, 31]), 0, [31, 63, 31]), -1, 0)
    return (r.astype(np.int64) << 11) | (g.astype(np.int64) << 5) | b.astype(np.int64)


def _from_565(packed: Int64Array) -> Float64Array:
    parts = np.stack([packed >> 11, (packed >> 5) & 63, packed & 31], axis=-1)
    return parts / np.array([31.0, 63.0, 31.0])


def _cut(values: FloatArray) -> Float64Array:
    """Return blocks (rows, columns, 16, channels) of (h, w, channels), edges repeated."""
    v = Checks(BlockError).numbers("texture", values, ("h", "w", "channels"), interval="[0, 1]")
    h, w, channels = v.shape
    rows, columns = block_grid_shape((h, w))
    v = np.pad(v, ((0, rows * BLOCK_SIDE - h), (0, columns * BLOCK_SIDE - w), (0, 0)), mode="edge")
    v = v.reshape(rows, BLOCK_SIDE, columns, BLOCK_SIDE, channels).swapaxes(1, 2)
    return v.reshape(rows, columns, 16, channels)


def _joined(texels: Float64Array, shape: tuple[int, int]) -> Float64Array:
    rows, columns, _, channels = texels.shape
    v = texels.reshape(rows, columns, BLOCK_SIDE, BLOCK_SIDE, channels).swapaxes(1, 2)
    return v.reshape(rows * BLOCK_SIDE, columns * BLOCK_SIDE, channels)[: shape[0], : shape[1]]


def _channels(values: FloatArray, wanted: int) -> None:
    Checks(BlockError).shape("texture", values, ("h", "w", wanted))


def _checked(blocks: UInt8Array, size: int, shape: tuple[int, int]) -> UInt8Array:
    data = np.asarray(blocks)
    expected = (*block_grid_shape(shape), size)
    Checks(BlockError).choice("blocks", data.dtype, (np.dtype(np.uint8),))
    Checks(BlockError).shape("blocks", data, expected)
    return data
