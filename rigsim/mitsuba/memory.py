"""Memory that the renderer may read."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

PADDING_VALUES: Final = 64
ALIGNMENT_BYTES: Final = 64
"""Alignment that every kernel's memory has: the renderer's own arrays have it, too."""


def pad_memory(values: NDArray[np.generic]) -> NDArray[Any]:
    """Return a copy of a row of numbers with padding behind its end, aligned to 64 bytes.

    The renderer reads NumPy's memory directly, in whole vectors of up to 16 numbers, and Embree
    reads 16 bytes at a mesh's last corner. At the end of a memory page either would read beyond the
    process's memory and crash it. A kernel's code depends on the alignment of its memory: by chance
    aligned or not, the same kernel would be compiled again in another process.

    Examples
    --------
    >>> row = pad_memory(np.arange(5, dtype=np.float32))
    >>> row.tolist(), row.ctypes.data % 64
    ([0.0, 1.0, 2.0, 3.0, 4.0], 0)
    """
    size = values.size * values.itemsize
    held = np.zeros(size + PADDING_VALUES * values.itemsize + ALIGNMENT_BYTES, np.uint8)
    start = -held.ctypes.data % ALIGNMENT_BYTES
    row = held[start : start + size].view(values.dtype)
    row[:] = values.reshape(-1)
    return row
