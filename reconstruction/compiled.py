"""Options of Numba kernels over pixels: eager compilation, read-only arrays, contraction.

Contraction is the only relaxation of arithmetic: NaN and infinity keep their meaning.
"""

from typing import Any, Final

from numba import types

FASTMATH_CONTRACT: Final = {"contract"}
"""Fast-math flags."""
PIXEL_KERNEL_OPTIONS: Final[dict[str, Any]] = {
    "parallel": True,
    "fastmath": FASTMATH_CONTRACT,
    "cache": True,
    "nogil": True,
    "boundscheck": False,
    "error_model": "numpy",
}
"""Options of a kernel that is called for all pixels."""
BLOCK_KERNEL_OPTIONS: Final[dict[str, Any]] = PIXEL_KERNEL_OPTIONS | {"parallel": False}
"""Options of a kernel that `model.threads.run_in_blocks` calls."""


def readonly_array_type(dtype: types.Type, axes: int) -> types.Array:
    """Return the type of a contiguous argument that is only read, and may be read-only."""
    return types.Array(dtype, axes, "C", readonly=True)
