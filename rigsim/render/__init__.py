"""Rays of cameras and lights on a mesh, and the lens."""

from rigsim.render.caster import Caster
from rigsim.render.rays import GBuffer, camera_rays, g_buffer, texture_visibility, trace, visibility

__all__ = [
    "Caster",
    "GBuffer",
    "camera_rays",
    "g_buffer",
    "texture_visibility",
    "trace",
    "visibility",
]
