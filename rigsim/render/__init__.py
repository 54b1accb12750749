"""Rendering: the only place that imports Mitsuba."""

from rigsim.render.caster import Caster
from rigsim.render.rays import RAY_OFFSET_MM, GBuffer, camera_rays, g_buffer, trace, visibility
from rigsim.render.renderer import RenderError, load_mitsuba, pad_memory, thread_count
from rigsim.render.scene_radiance import MovableLightScene, look_at, radiance
from rigsim.render.variant import VariantChoice, choose_variant

__all__ = [
    "RAY_OFFSET_MM",
    "Caster",
    "GBuffer",
    "MovableLightScene",
    "RenderError",
    "VariantChoice",
    "camera_rays",
    "choose_variant",
    "g_buffer",
    "load_mitsuba",
    "look_at",
    "pad_memory",
    "radiance",
    "thread_count",
    "trace",
    "visibility",
]
