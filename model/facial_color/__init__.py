"""The hemoglobin rig: local statistics, basis, blends and documents."""

from model.facial_color.rig import HemoglobinBlend, HemoglobinRig, local_statistics
from model.facial_color.state_maps import FacialColorError, StateMaps, check_name

__all__ = [
    "FacialColorError",
    "HemoglobinBlend",
    "HemoglobinRig",
    "StateMaps",
    "check_name",
    "local_statistics",
]
