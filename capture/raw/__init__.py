"""Raw frames: write and read our own DNG, read foreign files, convert to linear values."""

from capture.raw.dng import encode_dng, encode_frame, encode_frame_into, write_dng
from capture.raw.frame import CameraColor, RawError, RawFrame, noise_profile
from capture.raw.linear import Demosaic, LinearImage, interpolate, linear_mono, linear_rgb
from capture.raw.reading import decode, read

__all__ = [
    "CameraColor",
    "Demosaic",
    "LinearImage",
    "RawError",
    "RawFrame",
    "decode",
    "encode_dng",
    "encode_frame",
    "encode_frame_into",
    "interpolate",
    "linear_mono",
    "linear_rgb",
    "noise_profile",
    "read",
    "write_dng",
]
