"""Arrays of frozen results: converted, checked and made read-only."""

from typing import Any

import numpy as np


def freeze_array(
    row: Any, name: str, shape: tuple[int, ...], kind: Any = np.float64, of: str = ""
) -> None:
    """Replace a field by a read-only copy of the type; refuse another shape or infinite numbers.

    A field that is None becomes zeros.
    """
    given = getattr(row, name)
    array = np.array(np.zeros(shape) if given is None else given, dtype=kind)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(
            f"{type(row).__name__}.{name}: got shape {array.shape}, expected finite numbers of"
            f" shape {shape}{of}"
        )
    array.setflags(write=False)
    object.__setattr__(row, name, array)
