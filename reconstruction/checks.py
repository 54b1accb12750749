"""Checks of settings and shapes that estimators have in common."""

from typing import Any

import numpy as np


def require_settings(
    settings: object, error: type[ValueError], *rules: tuple[str, bool, str]
) -> None:
    """Refuse the first setting whose rule (name, whether it holds, what is expected) is broken."""
    for name, holds, expected in rules:
        if not holds:
            got = getattr(settings, name)
            raise error(f"{type(settings).__name__}.{name}: got {got}, expected {expected}")


def require_shapes(error: type[ValueError], *rules: tuple[str, Any, tuple[int, ...]]) -> None:
    """Refuse the first array (name, array, shape expected) of another shape; None fits any."""
    for name, array, shape in rules:
        if array is not None and np.shape(array) != shape:
            raise error(f"{name}: got shape {np.shape(array)}, expected {shape}")
