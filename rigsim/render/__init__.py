"""Rendering: the only place that imports Mitsuba."""

from rigsim.render.caster import Caster
from rigsim.render.rays import OFFSET_MM, GBuffer, camera_rays, g_buffer, trace, visibility
from rigsim.render.renderer import RenderError, load, thread_count, with_slack
from rigsim.render.scene_radiance import MovedLight, look_at, radiance
from rigsim.render.variant import VariantChoice, choose_variant

__all__ = [
    "OFFSET_MM",
    "Caster",
    "GBuffer",
    "MovedLight",
    "RenderError",
    "VariantChoice",
    "camera_rays",
    "choose_variant",
    "g_buffer",
    "load",
    "look_at",
    "radiance",
    "thread_count",
    "trace",
    "visibility",
    "with_slack",
]
