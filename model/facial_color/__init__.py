"""The hemoglobin rig: local statistics, basis, blends and documents."""

from model.facial_color.rig import (
    FacialColorError,
    HemoglobinBlend,
    HemoglobinRig,
    StateMaps,
    check_name,
    local_statistics,
)

__all__ = [
    "FacialColorError",
    "HemoglobinBlend",
    "HemoglobinRig",
    "StateMaps",
    "check_name",
    "local_statistics",
]
